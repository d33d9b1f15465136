"""What the algorithms that learn from a replay buffer share: critics, reward scale, schedules."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor

from skillweave.algorithms.base import Algorithm, ParameterGroup
from skillweave.algorithms.compiled import compiled
from skillweave.networks.config import Network
from skillweave.networks.encoders import Inputs
from skillweave.networks.net import Net
from skillweave.networks.stacked import Layout, Views
from skillweave.ops.distributions import mask_logits
from skillweave.ops.losses import td_loss
from skillweave.ops.optim import adam_, clip_grad_norm_
from skillweave.spaces import ObsCodec
from skillweave.types import Sample


class OffPolicyAlgorithm(Algorithm):
    """Learns from samples of a replay buffer, one gradient step at a time."""

    interval: int
    """Gradient steps between those that the slower networks take part in."""
    between: ClassVar[bool] = False
    """Whether it learns from the observations between those that n steps begin and end with."""

    @property
    def scales_rewards(self) -> bool:
        """Whether it needs the running moments of returns."""
        return bool(self.config.normalize_rewards)

    def fresh(self, members: int) -> dict[str, Tensor]:
        """The fields that every state has, and the count of gradient steps."""
        return super().fresh(members) | {"updates": torch.zeros(members, dtype=torch.int64)}

    def update(
        self, state: Any, sample: Sample, progress: float, generators: list[torch.Generator]
    ) -> tuple[dict[str, Tensor], Tensor]:
        """One gradient step, in place.

        Args:
            progress: share of the budget that is spent, for the schedules.
            generators: one a member, for the noise that learning needs.

        Returns:
            Metrics (P,), and the samples' errors (P, B), for their priorities.
        """
        state.updates += 1
        due = int(state.updates[0]) % self.interval == 0
        noise = self.learning_noise(generators, sample.reward.shape[1], due)
        learn = self._compiled if self.config.compile else self.learn
        done: tuple[dict[str, Tensor], Tensor] = learn(
            state, sample, self.rate(state, progress), noise, due
        )
        return done

    @functools.cached_property
    def _compiled(self) -> Callable[..., Any]:
        return compiled(self.learn, f"{type(self.config).__name__}.compile")

    def learning_noise(
        self, generators: list[torch.Generator], batch: int, due: bool
    ) -> list[Tensor]:
        """What ``learn`` needs of chance, a stream a member."""
        raise NotImplementedError

    def learn(
        self, state: Any, sample: Sample, rate: Tensor, noise: list[Tensor], due: bool
    ) -> tuple[dict[str, Tensor], Tensor]:
        """``update`` as nothing but tensor operations, so that it can be compiled.

        Args:
            rate: the learning rate now, (P,).
            noise: of ``learning_noise``.
            due: whether it is the slower networks' turn, too.
        """
        raise NotImplementedError

    def random_actions(
        self, generators: list[torch.Generator], batch: int, mask: Tensor | None
    ) -> Tensor:
        """Actions (P, batch, ...) drawn uniformly from those allowed, a stream a member."""
        drawn = [torch.rand(batch, self.codec.size, generator=g) for g in generators]
        uniform = torch.stack(drawn)
        if not self.codec.discrete:
            return 2.0 * uniform - 1.0
        return mask_logits(uniform, mask).argmax(-1)

    def rewards(self, state: Any, sample: Sample) -> Tensor:
        """Rewards (P, B) in the units that critics learn in."""
        if not self.config.normalize_rewards:
            return sample.reward
        scale: Tensor = (state.return_var + 1e-8).rsqrt()
        return sample.reward * scale

    def rate(self, state: Any, progress: float) -> Tensor:
        """The learning rate now, (P,)."""
        rate: Tensor = state.learning_rate
        linear = self.config.learning_rate_schedule == "linear"
        return rate * (1.0 - progress) if linear else rate

    def target(self, reward: Tensor, discount: Tensor, value: Tensor) -> Tensor:
        """``r + discount·V(s′)``, each (P, B)."""
        # Not a product: what a terminal observation is worth may be anything, 0·NaN is NaN.
        return reward + torch.where(discount == 0.0, 0.0, discount * value)

    def step_(self, state: Any, loss: Tensor, leaves: Views, rate: Tensor) -> Tensor:
        """One gradient step on ``state.params``; the gradient's norm before clipping, (P,)."""
        grad = self.layout.gradient(loss, leaves)
        norm = clip_grad_norm_(grad, state.max_grad_norm)
        moments = state.mu, state.nu, state.count
        adam_(state.params, grad, *moments, rate, eps=self.config.adam_eps)
        return norm


class Critics:
    """K critics of each member as one stack of P·K: their parameters are (P, K, D)."""

    def __init__(
        self, obs: ObsCodec, network: Network, outputs: int, extra: int = 0, count: int = 2
    ) -> None:
        self.count = count
        self.net = Net("critic", obs, network, outputs, extra)
        self.layout = Layout(self.net.shapes)

    def init(self, generators: list[torch.Generator]) -> Tensor:
        """Fresh parameters (P, K, D), one generator a member."""
        flat = torch.zeros(len(generators), self.count, self.layout.size)
        for member, generator in enumerate(generators):
            self.net.init_(self.layout.views(flat[member]), 1.0, [generator] * self.count)
        return flat

    def __call__(self, views: Views, inputs: Inputs, action: Tensor | None = None) -> Tensor:
        """Inputs (P, B, …) and actions (P, B, A) to values (P, K, B, out).

        The views are of (P·K, D); of as many critics as they hold, if fewer.
        """
        members = next(iter(inputs.values())).shape[0]
        count = next(iter(views.values())).shape[0] // members

        def each(x: Tensor) -> Tensor:
            # Without a copy where P = 1: expanded, not repeated.
            return x[:, None].expand(-1, count, *x.shape[1:]).reshape(-1, *x.shape[1:])

        extra = None if action is None else each(action)
        out = self.net(views, {k: each(v) for k, v in inputs.items()}, extra)
        return out.view(members, count, *out.shape[1:])

    def family(self) -> ParameterGroup:
        """The fields of a state that hold critics."""
        weights, moments = ("critic", "critic_target"), ("critic_mu", "critic_nu")
        return ParameterGroup(self.layout, (("critic", self.net),), weights, moments, "critic_count")

    def views(self, flat: Tensor) -> dict[str, Tensor]:
        """Windows into (P, K, D), each (P·K, *shape)."""
        return self.layout.views(flat.flatten(0, 1))

    def leaves(self, flat: Tensor) -> dict[str, Tensor]:
        """Like ``views``, each a leaf that can be differentiated by."""
        return self.layout.leaves(flat.flatten(0, 1))

    def step_(self, state: Any, loss: Tensor, leaves: Views, rate: Tensor, eps: float) -> Tensor:
        """One gradient step on ``state.critic``; the gradient's norm before clipping, (P,)."""
        grad = self.layout.gradient(loss, leaves).view(len(state.critic), -1)
        norm = clip_grad_norm_(grad, state.max_grad_norm)
        flat = [x.flatten(1) for x in (state.critic, state.critic_mu, state.critic_nu)]
        adam_(flat[0], grad, flat[1], flat[2], state.critic_count, rate, eps=eps)
        return norm


def weighted_mean(loss: Tensor, weight: Tensor | None) -> Tensor:
    """Mean over the batch, (P, B) to (P,), with the weights of prioritised replay."""
    return loss.mean(1) if weight is None else (loss * weight).mean(1)


def regression(q: Tensor, target: Tensor, weight: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Critics' values (P, K, B) against one target (P, B), half the squared error.

    Returns:
        Loss (P,), summed over the critics, and detached the error of each sample (P, B) and the
        mean value (P,).
    """
    target = target[:, None]
    loss = weighted_mean(td_loss(q, target, "mse").sum(1), weight)
    error = (q.detach() - target).abs().mean(1)
    return loss, error, q.detach().mean((1, 2))


def normal(generators: list[torch.Generator], *shape: int) -> Tensor:
    """Standard normal numbers (P, *shape), a stream a member."""
    return torch.stack([torch.randn(shape, generator=g) for g in generators])
