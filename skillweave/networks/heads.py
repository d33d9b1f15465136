"""Action heads: what a policy network's last layer means."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from skillweave.ops.distributions import (
    categorical_sample,
    categorical_stats,
    gumbel,
    mask_logits,
    normal_stats,
)
from skillweave.spaces import ActionCodec


@dataclass(frozen=True)
class ActionHead:
    """Discrete: the head is logits. Box: it is the mean, beside a ``log_std`` of its own.

    ``head`` is (..., A), actions are (...) int64 or (..., A) float, in policy units.
    """

    codec: ActionCodec

    @property
    def size(self) -> int:
        """A, the width of the head."""
        return self.codec.size

    @property
    def discrete(self) -> bool:
        """Whether actions are choices."""
        return self.codec.discrete

    def noise(self, generators: list[torch.Generator], steps: int, batch: int) -> Tensor:
        """Noise for ``steps`` calls of ``act``: (steps, P, batch, A), a stream a member."""
        shape = (steps, batch, self.size)
        if self.discrete:
            drawn = [gumbel(torch.rand(shape, generator=g)) for g in generators]
        else:
            drawn = [torch.randn(shape, generator=g) for g in generators]
        return torch.stack(drawn, dim=1)

    def act(self, head: Tensor, log_std: Tensor | None, noise: Tensor | None) -> Tensor:
        """Actions; greedy where ``noise`` is None. Logits come masked."""
        if log_std is None:
            return head.argmax(-1) if noise is None else categorical_sample(head, noise)
        return head if noise is None else torch.addcmul(head, log_std.exp(), noise)

    def stats(
        self, head: Tensor, log_std: Tensor | None, mask: Tensor | None, action: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Log-probability of the actions, and entropy; each (...)."""
        if log_std is None:
            return categorical_stats(mask_logits(head, mask), action)
        return normal_stats(head, log_std, action)
