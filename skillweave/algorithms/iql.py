"""Implicit Q-learning (Kostrikov et al. 2022) for P members at once.

For continuous actions and for discrete ones. In the order of reading: init, act, value, learning;
the critics' step is ``actor_critic.learn``. The settings are ``config.IQL``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.actor_critic import ActorCriticAlgorithm, ActorCriticState, Critics
from skillweave.algorithms.base import ActingParams
from skillweave.algorithms.batches import Sample
from skillweave.algorithms.config import IQL
from skillweave.algorithms.parameters import ParameterGroup
from skillweave.networks.heads import ActionHead
from skillweave.networks.net import Net
from skillweave.networks.stacked import Inputs, Layout, Views
from skillweave.ops.distributions import mask_logits
from skillweave.ops.losses import expectile_loss
from skillweave.ops.returns import td_target

LARGEST_WEIGHT = 100.0
"""The most that one action is imitated more than another, as in the authors' code."""
FIRST_STD = 0.5
"""Deviation of continuous actions at the start, where a bounded range spans [−1, 1]."""


class IQLAlgorithm(ActorCriticAlgorithm):
    """IQL on one pair of spaces; ``params`` are the actor, and the net of states' values."""

    state_type = ActorCriticState
    follows_critics = False
    interval = 1
    head: ActionHead

    def __init__(
        self, config: IQL, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        super().__init__(config, observation_space, action_space)
        self.head = ActionHead(self.codec)
        self.net = Net("actor", self.obs, config.network, self.head.width)
        critic = config.critic or config.network
        self.value_net = Net("value", self.obs, critic, 1)
        acting = dict(self.net.shapes)
        if self.head.log_std_size:
            acting["actor.log_std"] = (1, self.head.log_std_size)
        self.layout = Layout(acting | self.value_net.shapes)
        self.acting = Layout(acting)
        size = self.codec.size
        discrete = self.codec.discrete
        self.critics = Critics(self.obs, critic, size if discrete else 1, 0 if discrete else size)

    def fresh_state(self, seeds: Sequence[Seeds]) -> ActorCriticState:
        """Create the state of fresh members, one for each seed."""
        fields = self.fresh_networks(seeds)
        views = self.layout.views(fields["params"])
        self.value_net.init_(views, 1.0, [(each / "value").torch() for each in seeds])
        if self.head.log_std_size:
            views["actor.log_std"].fill_(math.log(FIRST_STD))
        return ActorCriticState(**fields)

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return the groups of state fields that have the shape of networks."""
        nets = ("network", self.net), ("critic", self.value_net)
        return [ParameterGroup(self.layout, nets), self.critics.group()]

    def act(
        self,
        params: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, None]:
        """Return discrete actions (P, B) or continuous ones (P, B, A) in [−1, 1]; see the base."""
        dist_params = self._dist_params(params.views, self.inputs(params, obs))
        if self.codec.discrete:
            dist_params = mask_logits(dist_params, mask)
            return self.head.act(dist_params, None, noise), dist_params, None
        action = self.head.act(dist_params, params.views["actor.log_std"], noise)
        return action.clamp(-1.0, 1.0), dist_params, None

    def value(self, state: ActorCriticState, obs: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return V in units of reward, (P, B)."""
        params = self.learning_params(state)
        return self.in_rewards(state, self._value(params.views, self.inputs(params, obs)))

    def learning_noise(self, rng: Sequence[torch.Generator], batch: int, due: bool) -> list[Tensor]:
        """Return nothing: no action is drawn to learn from."""
        return []

    def critic_target(
        self, state: ActorCriticState, sample: Sample, params: ActingParams, noise: list[Tensor]
    ) -> Tensor:
        """Return ``r + discount·V(s′)`` (eq. 6), (P, B)."""
        views = self.layout.views(state.params)
        value = self._value(views, self.inputs(params, sample.next_obs))
        return td_target(self.rewards(state, sample), sample.discount, value)

    def improve_policy(
        self,
        state: ActorCriticState,
        sample: Sample,
        inputs: Inputs,
        rate: Tensor,
        noise: list[Tensor],
    ) -> None:
        """Take one gradient step of the actor and of states' values, in place."""
        leaves = self.layout.leaves(state.params)
        value_loss, policy_loss = self.losses(leaves, state, sample, inputs)
        self.step_(state, value_loss + policy_loss, leaves, rate)
        state.policy_loss = policy_loss.detach()

    def losses(
        self, views: Views, state: ActorCriticState, sample: Sample, inputs: Inputs
    ) -> tuple[Tensor, Tensor]:
        """Return the loss of states' values (eq. 5) and that of the policy (eq. 7), each (P,).

        The policy's is ``−exp(β·(Q̄(s, a) − V(s)))·log π(a|s)``: advantage-weighted regression.
        """
        with torch.no_grad():
            slow = self.critics.views(state.critic_target)
            q = self.critics.chosen(slow, inputs, sample.action).amin(1)
        value = self._value(views, inputs)
        advantage = (q - value).detach()
        weight = (self.config.beta * advantage).exp().clamp_max(LARGEST_WEIGHT)
        dist_params = self._dist_params(views, inputs)
        log_std = views.get("actor.log_std")
        log_prob, _ = self.head.stats(dist_params, log_std, sample.mask, sample.action)
        value_loss = expectile_loss(value, q, self.config.expectile).mean(1)
        return value_loss, -(weight * log_prob).mean(1)

    def _dist_params(self, views: Views, inputs: Inputs) -> Tensor:
        """Return logits, or means in [−1, 1], (P, B, A)."""
        found = self.net(views, inputs)
        return found if self.codec.discrete else found.tanh()

    def _value(self, views: Views, inputs: Inputs) -> Tensor:
        """Return V in the critics' units, (P, B)."""
        value: Tensor = self.value_net(views, inputs).squeeze(-1)
        return value
