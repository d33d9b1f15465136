"""What the algorithms that learn from a replay buffer share: reward scale, schedules, updates."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from skillweave.algorithms.base import AgentState, Algorithm
from skillweave.algorithms.compiled import Compiled
from skillweave.algorithms.parameters import rate_now
from skillweave.experience import Report, Sample
from skillweave.networks.stacked import Views
from skillweave.ops.device import FLOAT, INT
from skillweave.ops.distributions import mask_logits
from skillweave.ops.optim import adam_, clip_grad_norm_


@dataclass
class OffPolicyState(AgentState):
    """What every algorithm with a replay buffer learns and counts."""

    HOST = ("updates",)

    updates: Tensor  # (P,) int64, gradient steps; always on the CPU
    tau: Tensor  # (P,), as all below a hyperparameter of each member
    max_grad_norm: Tensor  # (P,)


class OffPolicyAlgorithm(Algorithm):
    """Learns from samples of a replay buffer, one gradient step at a time."""

    store = "replay"
    follows_schedules = True
    member_hyperparameters: ClassVar[tuple[str, ...]] = (
        "learning_rate", "gamma", "tau", "max_grad_norm",
    )  # fmt: skip
    interval: int
    """Gradient steps between those that the slower networks take part in."""
    between: ClassVar[bool] = False
    """Whether it learns from the observations between those that n steps begin and end with."""

    @property
    def scales_rewards(self) -> bool:
        """Whether it needs the running moments of returns."""
        return bool(self.config.normalize_rewards)

    def fresh_fields(self, params: Tensor) -> dict[str, Tensor]:
        """The fields that every state has, and the count of gradient steps."""
        updates = torch.zeros(len(params), **INT)
        return super().fresh_fields(params) | {"updates": updates}

    def update(
        self, state: Any, batch: Sample, rng: Sequence[torch.Generator]
    ) -> tuple[Any, Report]:
        """One gradient step, in place; the report has the samples' errors (P, B)."""
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
        """The random numbers that ``learn`` needs, from one generator per member."""
        raise NotImplementedError

    def learn(
        self, state: Any, sample: Sample, rate: Tensor, noise: list[Tensor], due: bool
    ) -> tuple[dict[str, Tensor], Tensor]:
        """``update`` as nothing but tensor operations, so that it can be compiled.

        Args:
            rate: the learning rate now, (P,).
            noise: of ``learning_noise``.
            due: whether it is the slower networks' turn, too.

        Returns:
            Metrics (P,), and the error of each sample (P, B).
        """
        raise NotImplementedError

    def random_actions(
        self, generators: Sequence[torch.Generator], batch: int, mask: Tensor | None
    ) -> Tensor:
        """Actions (P, batch, ...) drawn uniformly from those allowed, on the CPU."""
        drawn = [torch.rand(batch, self.codec.size, generator=g, **FLOAT) for g in generators]
        uniform = torch.stack(drawn)
        if not self.codec.discrete:
            return 2.0 * uniform - 1.0
        return mask_logits(uniform, mask).argmax(-1)

    def reward_scale(self, state: Any) -> Tensor | None:
        """What rewards are multiplied by before critics learn from them, (P, 1); None: 1."""
        if not self.config.normalize_rewards:
            return None
        scale: Tensor = (state.return_var + 1e-8).rsqrt()
        return scale

    def rewards(self, state: Any, sample: Sample) -> Tensor:
        """Rewards (P, B) in the units that critics learn in."""
        scale = self.reward_scale(state)
        return sample.reward if scale is None else sample.reward * scale

    def in_rewards(self, state: Any, value: Tensor) -> Tensor:
        """Values (P, B) in the critics' units as such in units of reward."""
        scale = self.reward_scale(state)
        return value if scale is None else value / scale

    def rate(self, state: Any, progress: float) -> Tensor:
        """The learning rate now, (P,)."""
        return rate_now(self.config, state.learning_rate, progress)

    def step_(self, state: Any, loss: Tensor, leaves: Views, rate: Tensor) -> Tensor:
        """One gradient step on ``state.params``; the gradient's norm before clipping, (P,)."""
        grad = self.layout.gradient(loss, leaves)
        norm = clip_grad_norm_(grad, state.max_grad_norm)
        moments = state.mu, state.nu, state.count
        adam_(state.params, grad, *moments, rate, eps=self.config.adam_eps)
        return norm


def normal(generators: Sequence[torch.Generator], *shape: int) -> Tensor:
    """Standard normal numbers (P, *shape), from one generator per member."""
    return torch.stack([torch.randn(shape, generator=g, **FLOAT) for g in generators])
