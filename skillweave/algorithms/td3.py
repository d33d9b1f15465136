"""TD3 (Fujimoto et al. 2018) for P members at once; DDPG is a preset of it.

In the order of reading: State, init, act, value, learning; the critics' step is
``actor_critic.learn``. The settings are ``config.TD3``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.actor_critic import ActorCriticAlgorithm, ActorCriticState, Critics
from skillweave.algorithms.base import ActingParams
from skillweave.algorithms.batches import Sample
from skillweave.algorithms.config import TD3
from skillweave.algorithms.off_policy import normal
from skillweave.networks.heads import ActionHead
from skillweave.networks.net import Net
from skillweave.networks.stacked import Inputs, Layout, Views
from skillweave.ops.distributions import smoothed_action
from skillweave.ops.returns import td_target


@dataclass
class State(ActorCriticState):
    """Learnt numbers and counts of TD3."""

    target: Tensor  # (P, D), the actor's slow copy
    exploration_noise: Tensor  # (P,), as all below a hyperparameter of each member
    target_noise: Tensor  # (P,)
    target_noise_clip: Tensor  # (P,)


class TD3Algorithm(ActorCriticAlgorithm):
    """TD3 on one pair of spaces; all that is learnt is in ``State``."""

    state_type = State

    actor_weights = ("params", "target")
    member_hyperparameters = (
        "learning_rate",
        "gamma",
        "tau",
        "max_grad_norm",
        "exploration_noise",
        "target_noise",
        "target_noise_clip",
    )

    def __init__(
        self, config: TD3, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        super().__init__(config, observation_space, action_space)
        self.interval = config.policy_delay
        self.head = ActionHead(self.codec)
        self.net = Net("actor", self.obs, config.network, self.codec.size)
        self.layout = self.acting = Layout(self.net.shapes)
        network = config.critic or config.network
        count = 2 if config.twin else 1
        self.critics = Critics(self.obs, network, 1, self.codec.size, count)

    def fresh_state(self, seeds: Sequence[Seeds]) -> State:
        """Create the state of fresh members, one for each seed."""
        fields = self.fresh_networks(seeds)
        return State(**fields, target=fields["params"].clone())

    def exploration(self, state: State, progress: float) -> dict[str, Tensor]:
        """Return the deviation of the noise on actions, (P, 1, 1)."""
        return {"noise": state.exploration_noise[:, None, None]}

    def act(
        self,
        params: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, None, None]:
        """Return actions (P, B, A) in [−1, 1]; see ``Algorithm.act``."""
        action = self.net(params.views, self.inputs(params, obs)).tanh()
        if noise is not None:
            scale = params.extra.get("noise", self.config.exploration_noise)
            action = (action + scale * noise).clamp(-1.0, 1.0)
        return action, None, None

    def value(self, state: State, obs: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return ``min Q(s, π(s))`` over the critics, in units of reward, (P, B)."""
        params = self.learning_params(state)
        inputs = self.inputs(params, obs)
        action = self.net(params.views, inputs).tanh()
        return self.in_rewards(state, self.smallest(state.critic, inputs, action))

    def learning_noise(self, rng: Sequence[torch.Generator], batch: int, due: bool) -> list[Tensor]:
        """Draw noise of the target's actions, (P, B, A), if they have noise."""
        return [normal(rng, batch, self.codec.size)] if self.config.target_noise else []

    def critic_target(
        self, state: State, sample: Sample, params: ActingParams, noise: list[Tensor]
    ) -> Tensor:
        """Return ``r + discount·min Q̄(s′, π̄(s′) + noise)`` (eq. 10 and 14), (P, B)."""
        inputs = self.inputs(params, sample.next_obs)
        action = self.net(self.layout.views(state.target), inputs).tanh()
        if noise:
            std = state.target_noise
            bound = state.target_noise_clip
            action = smoothed_action(action, noise[0], std[:, None, None], bound[:, None, None])
        value = self.smallest(state.critic_target, inputs, action)
        return td_target(self.rewards(state, sample), sample.discount, value)

    def improve_policy(
        self, state: State, sample: Sample, inputs: Inputs, rate: Tensor, noise: list[Tensor]
    ) -> None:
        """Take one gradient step of the actor, in place."""
        leaves = self.layout.leaves(state.params)
        loss = self.policy_loss(leaves, state, inputs)
        self.step_(state, loss, leaves, rate * self.config.actor_rate)
        state.policy_loss = loss.detach()

    def policy_loss(self, views: Views, state: State, inputs: Inputs) -> Tensor:
        """Return ``−Q₁(s, π(s))`` (eq. 15, one critic as in the paper) plus ``action_l2``, (P,)."""
        first = self.critics.views(state.critic[:, :1])
        before_tanh = self.net(views, inputs)  # (P, B, A)
        q = self.critics(first, inputs, before_tanh.tanh()).flatten(1)
        size = before_tanh.square().flatten(1).mean(1)
        cost: Tensor = self.config.action_l2 * q.detach().abs().mean(1) * size
        return cost - q.mean(1)

    def move_targets(self, state: State, due: bool) -> None:
        """Move the slow copies towards the current weights where ``due``, in place."""
        if due:
            super().move_targets(state, due)
            state.target.lerp_(state.params, state.tau[:, None])
