"""Action heads: what a policy network's last layer means."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from skillweave.ops.device import BOOL, FLOAT, INT, Constant
from skillweave.ops.distributions import (
    categorical_kl,
    categorical_sample,
    categorical_stats,
    clamp_inward,
    gumbel,
    mask_logits,
    normal_kl,
    normal_stats,
    tanh_log_det,
)
from skillweave.spaces import ActionCodec
from skillweave.types import Array

LOG_STD = (-5.0, 2.0)
"""Range of a log deviation that depends on the state."""
WIDEST = 1.0
"""The deviation of bounded actions beyond which the entropy bonus counts against it; their range
spans [−1, 1]."""


class ActionHead:
    """What a head (..., width) means.

    Of discrete actions it is logits; of a Box the mean, and perhaps the log deviation after it.
    Actions are (...) int64 for Discrete, (..., K) int64 for MultiDiscrete and MultiBinary,
    (..., A) float in policy units for a Box. A squashed Box action is kept as it was before tanh,
    where its log-probability is exact; ``to_env`` applies tanh.

    Args:
        codec: of the action space.
        std: whether a Box's deviation is a parameter or part of the head.
        squash: whether a Box's actions go through tanh.
    """

    def __init__(
        self,
        codec: ActionCodec,
        std: Literal["parameter", "state"] = "parameter",
        squash: bool = False,
    ) -> None:
        self.codec, self.squash = codec, squash and not codec.discrete
        self.std_in_head = std == "state" and not codec.discrete
        self.width = codec.size * (2 if self.std_in_head else 1)
        widest = max(codec.parts, default=0)
        # Where the parts' logits stand in a row (K, widest): parts of different sizes are padded.
        rows, start = [], 0
        for n in codec.parts:
            rows.append([start + min(i, n - 1) for i in range(widest)])
            start += n
        self._columns = Constant(torch.tensor(rows, **INT))
        exists = [[i < n for i in range(widest)] for n in codec.parts]
        self._exists = Constant(torch.tensor(exists, **BOOL))
        # Which dimensions of a Box have two bounds, and so units in which they span [−1, 1].
        bounded = [] if codec.discrete else codec.span[2].tolist()
        self._narrows = any(bounded) and not self.squash
        self._bounded = Constant(torch.tensor(bounded, **BOOL))

    @property
    def discrete(self) -> bool:
        """Return whether actions are discrete."""
        return self.codec.discrete

    def noise(self, generators: Sequence[torch.Generator], steps: int, batch: int) -> Tensor:
        """Noise for calls of ``act``.

        Args:
            generators: one for each of P members.
            steps: how many calls.
            batch: environments of each member.

        Returns:
            Normal or Gumbel noise, (S, P, B, A): steps, members, batch.
        """
        shape = (steps, batch, self.codec.size)
        if self.discrete:
            drawn = [gumbel(torch.rand(shape, generator=g, **FLOAT)) for g in generators]
        else:
            drawn = [torch.randn(shape, generator=g, **FLOAT) for g in generators]
        return torch.stack(drawn, dim=1)

    def act(self, head: Tensor, log_std: Tensor | None, noise: Tensor | None) -> Tensor:
        """Return the actions that a head means.

        Args:
            head: (..., width), logits masked already.
            log_std: (..., A) or broadcast to it, the log deviation where it is a parameter; else
                None.
            noise: one step of ``noise``; None: act greedily.

        Returns:
            Actions, (...) for Discrete, else (..., K) or (..., A).
        """
        if not self.discrete:
            mean, log_std = self.moments(head, log_std)
            return mean if noise is None else torch.addcmul(mean, log_std.exp(), noise)
        if self.codec.multi:
            head, noise = self._parts(head), None if noise is None else self._spread(noise)
        return head.argmax(-1) if noise is None else categorical_sample(head, noise)

    def stats(
        self, head: Tensor, log_std: Tensor | None, mask: Tensor | None, action: Tensor
    ) -> tuple[Tensor, Tensor]:
        """How likely actions are, and how spread out the distribution is.

        Args:
            head: (..., width), what a network's last layer says.
            log_std: (..., A) or broadcast to it, the log deviation where it is a parameter; else
                None.
            mask: (..., A) bool, allowed actions; None: all.
            action: (...) or (..., A), what was done.

        Returns:
            Log-probability and entropy in nats, each (...).
        """
        if self.discrete:
            head = mask_logits(head, mask)
            if not self.codec.multi:
                return categorical_stats(head, action)
            log_prob, entropy = categorical_stats(self._parts(head), action)
            return log_prob.sum(-1), entropy.sum(-1)
        mean, log_std = self.moments(head, log_std)
        log_prob, entropy = normal_stats(mean, log_std, action)
        if self.squash:
            log_prob = log_prob - tanh_log_det(action).sum(-1)
            # No closed form: one sample, the action, moved along with mean and deviation.
            z = ((action - mean) * (-log_std).exp()).detach()
            entropy = entropy + tanh_log_det(mean + log_std.exp() * z).sum(-1)
        return log_prob, entropy

    def surplus(self, head: Tensor, log_std: Tensor | None) -> Tensor | None:
        """What is too much of the entropy, in nats, (...); None: nothing.

        A normal's entropy grows with its deviation without end. A bonus for it would widen the
        deviation for ever where rewards are rare, until the mean does not matter. Actions of a
        bounded range are clipped to it: with a deviation of 1 (``WIDEST``) a third of them, with 2
        two thirds. So a wider normal explores no more, and each nat beyond counts against it.

        Args:
            head: (..., width), what a network's last layer says.
            log_std: (..., A) or broadcast to it, the log deviation where it is a parameter; else
                None.
        """
        if not self._narrows:
            return None
        mean, log_std = self.moments(head, log_std)
        beyond = (log_std - math.log(WIDEST)).clamp_min(0.0).expand_as(mean)
        return 2.0 * (beyond * self._bounded.on(beyond.device)).sum(-1)

    def kl(
        self,
        head: Tensor,
        log_std: Tensor | None,
        other: Tensor,
        other_log_std: Tensor | None,
        mask: Tensor | None,
    ) -> Tensor:
        """KL(p ‖ q), p by the first head and q by the other, before any squashing.

        Args:
            head: (..., width), what a network's last layer says.
            log_std: (..., A) or broadcast to it, the log deviation where it is a parameter; else
                None.
            other: (..., width), the head of q.
            other_log_std: as ``log_std``, of q.
            mask: (..., A) bool, allowed actions; None: all.

        Returns:
            The divergence in nats, (...).
        """
        if not self.discrete:
            return normal_kl(*self.moments(head, log_std), *self.moments(other, other_log_std))
        head, other = mask_logits(head, mask), mask_logits(other, mask)
        if not self.codec.multi:
            return categorical_kl(head, other)
        return categorical_kl(self._parts(head), self._parts(other)).sum(-1)

    def with_log_prob(self, action: Tensor, log_prob: Tensor, log_std: Tensor | None) -> Tensor:
        """Return a head under which Discrete or Box actions have exactly these log-probabilities (...).

        For a caller who knows what was done and how likely it was, but not the distribution.

        Args:
            action: (...) int64 or (..., A).
            log_prob: (...), in nats.
            log_std: (..., A) or broadcast to it, of a Box; else None.
        """
        if self.discrete:
            rest = torch.log1p(-log_prob.exp().clamp(max=1.0 - 1e-6))
            rest = rest - math.log(max(1, self.codec.size - 1))
            head = rest[..., None].expand(*rest.shape, self.codec.size)
            return head.scatter(-1, action[..., None], log_prob[..., None])
        assert log_std is not None
        peak, _ = normal_stats(action, log_std.expand_as(action), action)
        away = (2.0 * (peak - log_prob)).clamp(min=0.0) / self.codec.size
        return action - away.sqrt()[..., None] * log_std.exp()

    def moments(self, head: Tensor, log_std: Tensor | None) -> tuple[Tensor, Tensor]:
        """Mean and log deviation of a Box's normal, each (..., A) or broadcast to it.

        Args:
            head: (..., width), what a network's last layer says.
            log_std: (..., A) or broadcast to it, the log deviation where it is a parameter; else
                None.
        """
        if not self.std_in_head:
            assert log_std is not None
            return head, log_std
        mean, raw = head.chunk(2, dim=-1)
        return mean, clamp_inward(raw, *LOG_STD)

    def to_env(self, action: Array) -> Array:
        """Return an ``action`` (n, …) in policy units as the environment's."""
        return self.codec.to_env(torch.from_numpy(action).tanh().numpy() if self.squash else action)

    def _parts(self, logits: Tensor) -> Tensor:
        """Logits (..., ΣN) to (..., K, widest); what does not exist has the smallest number."""
        return mask_logits(self._spread(logits), self._exists.on(logits.device))

    def _spread(self, x: Tensor) -> Tensor:
        """(..., ΣN) to (..., K, widest), the last entry of short parts repeated."""
        return x[..., self._columns.on(x.device)]
