"""TD3 (Fujimoto et al. 2018) for P members at once; DDPG is a preset of it.

Read down the page: State, init, act, update. The settings are ``config.TD3``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave.algorithms.base import ActingParams, ParameterGroup
from skillweave.algorithms.config import TD3
from skillweave.algorithms.off_policy import Critics, OffPolicyAlgorithm, normal, regression
from skillweave.networks.encoders import Inputs
from skillweave.networks.heads import ActionHead
from skillweave.networks.net import Net
from skillweave.networks.stacked import Layout, Views
from skillweave.seeding import Seeds
from skillweave.types import Sample


@dataclass
class State:
    """Everything TD3 learns and counts; P members, K critics, D parameters of a network."""

    params: Tensor  # (P, D), the actor
    target: Tensor  # (P, D), its slow copy
    mu: Tensor  # (P, D), Adam's first moment
    nu: Tensor  # (P, D), Adam's second moment
    count: Tensor  # (P,) int64, Adam's steps; (P, D) where parameters differ in age
    critic: Tensor  # (P, K, D)
    critic_target: Tensor  # (P, K, D)
    critic_mu: Tensor  # (P, K, D)
    critic_nu: Tensor  # (P, K, D)
    critic_count: Tensor  # (P,) int64, or (P, K, D)
    updates: Tensor  # (P,) int64, gradient steps
    obs_mean: Tensor  # (P, O)
    obs_var: Tensor  # (P, O)
    obs_count: Tensor  # (P,)
    return_mean: Tensor  # (P, 1)
    return_var: Tensor  # (P, 1)
    return_count: Tensor  # (P,)
    policy_loss: Tensor  # (P,), the latest, for the metrics
    learning_rate: Tensor  # (P,); this and all below are settings, one a member
    gamma: Tensor  # (P,)
    tau: Tensor  # (P,)
    max_grad_norm: Tensor  # (P,)
    exploration_noise: Tensor  # (P,)
    target_noise: Tensor  # (P,)
    target_noise_clip: Tensor  # (P,)


class TD3Algorithm(OffPolicyAlgorithm):
    """TD3 on one pair of spaces. Holds no learnt state: that is in ``State``."""

    state_type = State
    settings = (
        "learning_rate", "gamma", "tau", "max_grad_norm", "exploration_noise", "target_noise",
        "target_noise_clip",
    )  # fmt: skip

    def __init__(
        self, config: TD3, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        super().__init__(config, observation_space, action_space)
        self.interval = config.policy_delay
        self.head = ActionHead(self.codec)
        self.net = Net("actor", self.obs, config.network, self.codec.size)
        self.layout = self.acting = Layout(self.net.shapes)
        network, count = config.critic or config.network, 2 if config.twin else 1
        self.critics = Critics(self.obs, network, 1, self.codec.size, count)

    def _fresh_state(self, seeds: list[Seeds]) -> State:
        params = torch.zeros(len(seeds), self.layout.size)
        generators = self.member_generators(seeds)
        self.net.init_(self.layout.views(params), 0.01, generators)
        critic = self.critics.init(generators)
        return State(
            params=params,
            target=params.clone(),
            mu=torch.zeros_like(params),
            nu=torch.zeros_like(params),
            count=torch.zeros(len(seeds), dtype=torch.int64),
            critic=critic,
            critic_target=critic.clone(),
            critic_mu=torch.zeros_like(critic),
            critic_nu=torch.zeros_like(critic),
            critic_count=torch.zeros(len(seeds), dtype=torch.int64),
            policy_loss=torch.zeros(len(seeds)),
            **self.fresh(len(seeds)),
        )

    def groups(self) -> list[ParameterGroup]:
        """Everything in the state that has the shape of networks."""
        actor = ParameterGroup(self.layout, (("network", self.net),), ("params", "target"))
        return [actor, self.critics.family()]

    def actor(self, state: State, progress: float = 1.0) -> ActingParams:
        """A copy of what acting needs, with the deviation of its noise."""
        actor = super().actor(state, progress)
        actor.extra["noise"] = state.exploration_noise[:, None, None].clone()
        return actor

    def act(
        self,
        actor: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, None, None]:
        """Actions (P, B, A) in [−1, 1]; see ``Algorithm.act``."""
        action = self.net(actor.views, self.inputs(actor, obs)).tanh()
        if noise is not None:
            scale = actor.extra.get("noise", self.config.exploration_noise)
            action = (action + scale * noise).clamp(-1.0, 1.0)
        return action, None, None

    def learning_noise(
        self, generators: list[torch.Generator], batch: int, due: bool
    ) -> list[Tensor]:
        """Of the target's actions, (P, B, A), where there is any."""
        return [normal(generators, batch, self.codec.size)] if self.config.target_noise else []

    def learn(
        self, state: State, sample: Sample, rate: Tensor, noise: list[Tensor], due: bool
    ) -> tuple[dict[str, Tensor], Tensor]:
        """One gradient step of the critics, and now and then of the actor, in place."""
        actor = ActingParams({}, *self.scaling(state))
        inputs = self.inputs(actor, sample.obs)
        leaves = self.critics.leaves(state.critic)
        loss, error, q = self.critic_loss(leaves, state, sample, actor, inputs, noise)
        norm = self.critics.step_(state, loss, leaves, rate, self.config.adam_eps)
        if due:
            policy = self.layout.leaves(state.params)
            policy_loss = self.policy_loss(policy, state, inputs)
            self.step_(state, policy_loss, policy, rate * self.config.actor_rate)
            state.target.lerp_(state.params, state.tau[:, None])
            state.critic_target.lerp_(state.critic, state.tau[:, None, None])
            state.policy_loss = policy_loss.detach()
        metrics = {"critic_loss": loss.detach(), "policy_loss": state.policy_loss, "q": q}
        return metrics | {"grad_norm": norm, "learning_rate": rate}, error

    def critic_loss(
        self,
        views: Views,
        state: State,
        sample: Sample,
        actor: ActingParams,
        inputs: Inputs,
        noise: list[Tensor],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Loss (P,), error of each sample (P, B) and mean value (P,)."""
        with torch.no_grad():
            following = self.inputs(actor, sample.next_obs)
            action = self.net(self.layout.views(state.target), following).tanh()
            if noise:
                bound = state.target_noise_clip[:, None, None]
                moved = (noise[0] * state.target_noise[:, None, None]).clamp(-bound, bound)
                action = (action + moved).clamp(-1.0, 1.0)
            slow = self.critics.views(state.critic_target)
            value = self.critics(slow, following, action).squeeze(-1).amin(1)
            target = self.target(self.rewards(state, sample), sample.discount, value)
        q = self.critics(views, inputs, sample.action).squeeze(-1)  # (P, K, B)
        return regression(q, target, sample.weight)

    def policy_loss(self, views: Views, state: State, inputs: Inputs) -> Tensor:
        """``−Q₁(s, π(s))`` (eq. 15 with one critic, as in the paper), (P,)."""
        first = self.critics.views(state.critic[:, :1])
        q = self.critics(first, inputs, self.net(views, inputs).tanh())
        return -q.flatten(1).mean(1)
