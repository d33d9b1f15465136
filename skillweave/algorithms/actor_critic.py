"""The shared part of SAC and TD3: an actor, K critics with slow copies, and the critics' update."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.base import ActingParams
from skillweave.algorithms.batches import Sample
from skillweave.algorithms.off_policy import OffPolicyAlgorithm, OffPolicyState
from skillweave.algorithms.parameters import ParameterGroup
from skillweave.networks.config import Network
from skillweave.networks.net import Net
from skillweave.networks.stacked import Inputs, Layout, Views
from skillweave.ops.device import FLOAT, INT
from skillweave.ops.losses import critic_loss
from skillweave.ops.optim import adam_, clip_grad_norm_
from skillweave.spaces import ObsCodec


@dataclass
class ActorCriticState(OffPolicyState):
    """State that SAC and TD3 share; ``params`` is the actor, K the number of critics."""

    critic: Tensor  # (P, K, D)
    critic_target: Tensor  # (P, K, D), the slow copy
    critic_mu: Tensor  # (P, K, D)
    critic_nu: Tensor  # (P, K, D)
    critic_count: Tensor  # (P,) int64, or (P, K, D)
    policy_loss: Tensor  # (P,), the latest, for the metrics


class ActorCriticAlgorithm(OffPolicyAlgorithm):
    """Base of SAC and TD3: critics learn from ``critic_target``, the actor from the critics.

    A subclass creates ``net`` and ``critics``; it defines the critics' target (``critic_target``)
    and the actor's update (``improve_policy``).
    """

    actor_weights: ClassVar[tuple[str, ...]] = ("params",)
    """The fields of the state with the actor, and with its slow copy if it has one."""
    net: Net
    critics: Critics

    def fresh_fields(self, params: Tensor) -> dict[str, Tensor]:
        """Return the fresh fields of a state except the critics."""
        return super().fresh_fields(params) | {"policy_loss": torch.zeros(len(params), **FLOAT)}

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
        metrics = {"critic_loss": loss.detach(), "q": mean, "grad_norm": norm}
        if due:
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
