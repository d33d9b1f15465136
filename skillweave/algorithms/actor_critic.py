"""The shared part of SAC and TD3: an actor, K critics with slow copies, and the critics' update."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.base import ActingParams
from skillweave.algorithms.batches import Report, Sample
from skillweave.algorithms.off_policy import OffPolicyAlgorithm, OffPolicyState
from skillweave.algorithms.parameters import ParameterGroup
from skillweave.networks.config import Network
from skillweave.networks.net import Net
from skillweave.networks.stacked import Inputs, Layout, Views
from skillweave.ops.device import FLOAT, INT, all_false
from skillweave.ops.losses import critic_loss
from skillweave.ops.optim import adam_, clip_grad_norm_
from skillweave.spaces import ObsCodec

LEAST_STEP = 1e-3
"""The least unit of critics' values, as a share of what an end pays: for discounts of nearly 1."""


@dataclass
class ActorCriticState(OffPolicyState):
    """State that SAC and TD3 share; ``params`` is the actor, K the number of critics."""

    critic: Tensor  # (P, K, D)
    critic_target: Tensor  # (P, K, D), the slow copy
    critic_mu: Tensor  # (P, K, D)
    critic_nu: Tensor  # (P, K, D)
    critic_count: Tensor  # (P,) int64, or (P, K, D)
    policy_loss: Tensor  # (P,), the latest, for the metrics
    end_pay: Tensor  # (P,), the most that a terminal step has paid, at least 0
    paid_before: Tensor  # (P,), 1 where another step has paid or cost something, else 0


class ActorCriticAlgorithm(OffPolicyAlgorithm):
    """Base of SAC and TD3: critics learn from ``critic_target``, the actor from the critics.

    A subclass creates ``net`` and ``critics``; it defines the critics' target (``critic_target``)
    and the actor's update (``improve_policy``).
    """

    actor_weights: ClassVar[tuple[str, ...]] = ("params",)
    """The fields of the state with the actor, and with its slow copy if it has one."""
    follows_critics: ClassVar[bool] = True
    """The policy is improved by the critics' values alone: it may wait until they have learnt
    something, and their units are free, see ``units``."""
    net: Net
    critics: Critics

    def fresh_fields(self, params: Tensor) -> dict[str, Tensor]:
        """Return the fresh fields of a state except the critics."""
        members = len(params)
        return super().fresh_fields(params) | {
            "policy_loss": torch.zeros(members, **FLOAT),
            "end_pay": torch.zeros(members, **FLOAT),
            "paid_before": torch.zeros(members, **FLOAT),
        }

    def fresh_networks(self, seeds: Sequence[Seeds]) -> dict[str, Tensor]:
        """Return the fresh fields of a state with fresh networks."""
        params = torch.zeros(len(seeds), self.layout.size, **FLOAT)
        generators = self.member_generators(seeds)
        self.net.init_(self.layout.views(params), 0.01, generators)
        critic = self.critics.init(generators)
        return self.fresh_fields(params) | {
            "critic": critic,
            "critic_target": critic.clone(),
            "critic_mu": torch.zeros_like(critic),
            "critic_nu": torch.zeros_like(critic),
            "critic_count": torch.zeros(len(seeds), **INT),
        }

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return the groups of state fields that have the shape of networks."""
        actor = ParameterGroup(self.layout, (("network", self.net),), self.actor_weights)
        return [actor, self.critics.group()]

    def update(
        self, state: Any, batch: Sample, rng: Sequence[torch.Generator]
    ) -> tuple[Any, Report]:
        """Take one gradient step, in place, in the units that the rewards seen so far ask for."""
        if self.follows_critics:
            self._see_rewards(state, batch)
        return super().update(state, batch, rng)

    @torch.no_grad()
    def _see_rewards(self, state: Any, sample: Sample) -> None:
        """Note which steps pay; where that changes the units, let critics keep their values."""
        ends = sample.discount == 0.0
        paid = torch.where(ends, sample.reward, 0.0).amax(1)
        other = ((sample.reward != 0.0) & ~ends).any(1)
        before = state.paid_before.maximum(other.to(state.paid_before.dtype))
        most = state.end_pay.maximum(paid)
        if all_false((most != state.end_pay) | (before != state.paid_before)):
            return
        shift, unit = self.units(state)
        first = state.end_pay[:, None] == 0.0  # nothing was paid: there are no values to keep
        state.end_pay, state.paid_before = most, before
        new_shift, new_unit = self.units(state)
        factor = torch.where(first, 1.0, unit / new_unit)
        moved = torch.where(first, 0.0, (shift - new_shift) / new_unit)
        self.critics.convert_(state, factor, moved)

    def units(self, state: Any) -> tuple[Tensor, Tensor]:
        """Return the shift and the unit of critics' values, (P, 1): V = unit · output + shift.

        Where terminal steps alone pay, at most c, critics learn V − c in units of (1 − γ)c, exact
        for any rewards, r′ = r − c(1 − discount): as if each step cost 1 and an end that pays c
        nothing. Around V itself values of near and far states would differ by so little that
        entropy, whose unit is 1, outweighs them.
        """
        scale = self.reward_scale(state)
        usual = state.gamma.new_ones(len(state.gamma), 1) if scale is None else scale.reciprocal()
        if not self.follows_critics:
            return torch.zeros_like(usual), usual
        pay = torch.where(state.paid_before > 0.0, 0.0, state.end_pay)[:, None]
        unit = pay * (1.0 - state.gamma[:, None]).clamp_min(LEAST_STEP)
        return pay, torch.where(pay > 0.0, unit, usual)

    def rewards(self, state: Any, sample: Sample) -> Tensor:
        """Return rewards (P, B) in the units that critics learn in."""
        if not self.follows_critics:
            return super().rewards(state, sample)
        shift, unit = self.units(state)
        return (sample.reward - shift * (1.0 - sample.discount)) / unit

    def in_rewards(self, state: Any, value: Tensor) -> Tensor:
        """Convert values (P, B) from the critics' units to units of reward."""
        if not self.follows_critics:
            return super().in_rewards(state, value)
        shift, unit = self.units(state)
        return value * unit + shift

    def learn(
        self, state: Any, sample: Sample, rate: Tensor, noise: list[Tensor], due: bool
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Take one gradient step of the critics and, where ``due``, of the actor, in place."""
        params = ActingParams({}, *self.scaling(state))
        inputs = self.inputs(params, sample.obs)
        with torch.no_grad():
            target = self.critic_target(state, sample, params, noise)
        leaves = self.critics.leaves(state.critic)
        q = self.critics.chosen(leaves, inputs, sample.action)
        loss, error, mean = critic_loss(q, target, sample.weight)
        norm = self.critics.step_(state, loss, leaves, rate, self.config.adam_eps)
        mean = self.in_rewards(state, mean[:, None])[:, 0]
        metrics = {"critic_loss": loss.detach(), "q": mean, "grad_norm": norm}
        if due and not sample.critic_alone:
            self.improve_policy(state, sample, inputs, rate, noise)
        self.move_targets(state, due)
        return metrics | {"policy_loss": state.policy_loss, "learning_rate": rate}, error

    def critic_target(
        self, state: Any, sample: Sample, params: ActingParams, noise: list[Tensor]
    ) -> Tensor:
        """Return the target value of all critics for the sample's actions, (P, B)."""
        raise NotImplementedError

    def improve_policy(
        self, state: Any, sample: Sample, inputs: Inputs, rate: Tensor, noise: list[Tensor]
    ) -> None:
        """Take one gradient step of the actor, in place."""
        raise NotImplementedError

    def move_targets(self, state: Any, due: bool) -> None:
        """Move the slow copies towards the current weights, in place."""
        state.critic_target.lerp_(state.critic, state.tau[:, None, None])

    def smallest(self, flat: Tensor, inputs: Inputs, action: Tensor | None = None) -> Tensor:
        """Return the smallest value of critics (P, K, D): (P, B); without actions (P, B, A)."""
        q = self.critics(self.critics.views(flat), inputs, action).amin(1)
        return q if action is None else q.squeeze(-1)


class Critics:
    """K critics of each member as one stack of P·K: their parameters are (P, K, D)."""

    def __init__(
        self, obs: ObsCodec, network: Network, outputs: int, extra: int = 0, count: int = 2
    ) -> None:
        self.count = count
        self.net = Net("critic", obs, network, outputs, extra)
        self.layout = Layout(self.net.shapes)

    def init(self, generators: list[torch.Generator]) -> Tensor:
        """Return fresh parameters (P, K, D), drawn with one generator per member."""
        flat = torch.zeros(len(generators), self.count, self.layout.size, **FLOAT)
        for member, generator in enumerate(generators):
            self.net.init_(self.layout.views(flat[member]), 1.0, [generator] * self.count)
        return flat

    def __call__(self, views: Views, inputs: Inputs, action: Tensor | None = None) -> Tensor:
        """Map inputs (P, B, …) and actions (P, B, A) to values (P, K, B, out).

        The views are of (P·K, D). If they hold fewer critics, K is their number.
        """
        members = next(iter(inputs.values())).shape[0]
        count = next(iter(views.values())).shape[0] // members

        def each(x: Tensor) -> Tensor:
            # Without a copy where P = 1: expanded, not repeated.
            return x[:, None].expand(-1, count, *x.shape[1:]).reshape(-1, *x.shape[1:])

        extra = None if action is None else each(action)
        out = self.net(views, {k: each(v) for k, v in inputs.items()}, extra)
        return out.view(members, count, *out.shape[1:])

    def chosen(self, views: Views, inputs: Inputs, action: Tensor) -> Tensor:
        """Return values (P, K, B) of discrete actions (P, B), or of continuous ones (P, B, A)."""
        if action.is_floating_point():
            return self(views, inputs, action).squeeze(-1)
        out = self(views, inputs)  # (P, K, B, A)
        return out.gather(-1, action[:, None, :, None].expand(*out.shape[:3], 1)).squeeze(-1)

    def group(self) -> ParameterGroup:
        """Return the fields of a state that hold critics."""
        weights = ("critic", "critic_target")
        moments = ("critic_mu", "critic_nu")
        nets = (("critic", self.net),)
        return ParameterGroup(self.layout, nets, weights, moments, "critic_count")

    def convert_(self, state: Any, factor: Tensor, shift: Tensor) -> None:
        """Change the last layers of critics and slow copies: output · factor + shift, (P, 1)."""
        each = [x.repeat_interleave(self.count, 0)[:, None] for x in (factor, shift)]  # (P·K, 1, 1)
        for flat in (state.critic, state.critic_target):
            views = self.views(flat)
            views[f"{self.net.head}.weight"].mul_(each[0])
            views[f"{self.net.head}.bias"].mul_(each[0]).add_(each[1])

    def views(self, flat: Tensor) -> dict[str, Tensor]:
        """Return windows into (P, K, D), each (P·K, *shape)."""
        return self.layout.views(flat.flatten(0, 1))

    def leaves(self, flat: Tensor) -> dict[str, Tensor]:
        """Return ``views`` as leaves that a loss can be differentiated by."""
        return self.layout.leaves(flat.flatten(0, 1))

    def step_(self, state: Any, loss: Tensor, leaves: Views, rate: Tensor, eps: float) -> Tensor:
        """Take one gradient step on ``state.critic``; return the unclipped gradient norm, (P,)."""
        grad = self.layout.gradient(loss, leaves).view(len(state.critic), -1)
        norm = clip_grad_norm_(grad, state.max_grad_norm)
        flat = [x.flatten(1) for x in (state.critic, state.critic_mu, state.critic_nu)]
        adam_(flat[0], grad, flat[1], flat[2], state.critic_count, rate, eps=eps)
        return norm
