"""The base of algorithms that learn from replay: reward scale, schedules, updates."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from skillweave.algorithms.base import AgentState, Algorithm
from skillweave.algorithms.batches import Report, Sample
from skillweave.algorithms.compiled import Compiled
from skillweave.algorithms.parameters import rate_now
from skillweave.ops.device import FLOAT, INT
from skillweave.ops.distributions import mask_logits


@dataclass
class OffPolicyState(AgentState):
    """Learnt numbers and counts of any algorithm with a replay buffer."""

    HOST = ("updates",)

    updates: Tensor  # (P,) int64, gradient steps; always on the CPU
    tau: Tensor  # (P,), as all below a hyperparameter of each member
    max_grad_norm: Tensor  # (P,)


class OffPolicyAlgorithm(Algorithm):
    """Base class of algorithms that learn from a replay buffer, one gradient step at a time."""

    store = "replay"
    follows_schedules = True
    member_hyperparameters: ClassVar[tuple[str, ...]] = (
        "learning_rate",
        "gamma",
        "tau",
        "max_grad_norm",
    )
    interval: int
    """Gradient steps between updates of the slower networks."""
    between: ClassVar[bool] = False
    """True if learning needs the observations between the first and the last of n steps."""

    @property
    def scales_rewards(self) -> bool:
        """Return whether learning needs the running moments of returns."""
        return bool(self.config.normalize_rewards)

    def fresh_fields(self, params: Tensor) -> dict[str, Tensor]:
        """Return the fields that every state has, and the count of gradient steps."""
        updates = torch.zeros(len(params), **INT)
        return super().fresh_fields(params) | {"updates": updates}

    def update(
        self, state: Any, batch: Sample, rng: Sequence[torch.Generator]
    ) -> tuple[Any, Report]:
        """Take one gradient step, in place; the report has the samples' errors (P, B)."""
        state.updates += 1
        due = int(state.updates[0]) % self.interval == 0
        drawn = self.learning_noise(rng, batch.reward.shape[1], due)
        noise = [x.to(batch.reward.device) for x in drawn]
        learn = self._compiled if self.config.compile else self.learn
        metrics, error = learn(state, batch, self.rate(state, batch.progress), noise, due)
        return state, Report(metrics, error)

    @functools.cached_property
    def _compiled(self) -> Compiled:
        return Compiled(self.learn, self.config)

    def learning_noise(self, rng: Sequence[torch.Generator], batch: int, due: bool) -> list[Tensor]:
        """Return the random numbers that ``learn`` needs, from one generator per member."""
        raise NotImplementedError

    def learn(
        self, state: Any, sample: Sample, rate: Tensor, noise: list[Tensor], due: bool
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Take the gradient step of ``update`` with tensor operations only, so it can be compiled.

        Args:
            rate: the learning rate now, (P,).
            noise: from ``learning_noise``.
            due: the slower networks are updated, too.

        Returns:
            Metrics (P,), and the error of each sample (P, B).
        """
        raise NotImplementedError

    def random_actions(
        self, generators: Sequence[torch.Generator], batch: int, mask: Tensor | None
    ) -> Tensor:
        """Draw actions (P, batch, ...) uniformly from the allowed ones, on the CPU."""
        drawn = [torch.rand(batch, self.codec.size, generator=g, **FLOAT) for g in generators]
        uniform = torch.stack(drawn)
        if not self.codec.discrete:
            return 2.0 * uniform - 1.0
        return mask_logits(uniform, mask).argmax(-1)

    def reward_scale(self, state: Any) -> Tensor | None:
        """Return the factor of rewards before critics learn from them, (P, 1); None: 1."""
        if not self.config.normalize_rewards:
            return None
        scale: Tensor = state.return_scale
        return scale.reciprocal()

    def rewards(self, state: Any, sample: Sample) -> Tensor:
        """Return rewards (P, B) in the units that critics learn in."""
        scale = self.reward_scale(state)
        return sample.reward if scale is None else sample.reward * scale

    def in_rewards(self, state: Any, value: Tensor) -> Tensor:
        """Convert values (P, B) from the critics' units to units of reward."""
        scale = self.reward_scale(state)
        return value if scale is None else value / scale

    def rate(self, state: Any, progress: float) -> Tensor:
        """Return the learning rate now, (P,)."""
        return rate_now(self.config, state.learning_rate, progress)


def normal(generators: Sequence[torch.Generator], *shape: int) -> Tensor:
    """Draw standard normal numbers (P, *shape), from one generator per member."""
    return torch.stack([torch.randn(shape, generator=g, **FLOAT) for g in generators])
