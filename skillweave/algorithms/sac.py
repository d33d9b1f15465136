"""Soft actor-critic (Haarnoja et al. 2018b) for P members at once.

For continuous actions, and for discrete ones (Christodoulou 2019). In the order of reading: State,
init, act, value, learning; the critics' step is ``actor_critic.learn``. The settings are
``config.SAC``.
"""

from __future__ import annotations

import math
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
from skillweave.algorithms.config import SAC
from skillweave.algorithms.off_policy import normal
from skillweave.networks.heads import ActionHead
from skillweave.networks.net import Net
from skillweave.networks.stacked import Inputs, Layout, Views
from skillweave.ops.device import FLOAT, INT
from skillweave.ops.distributions import (
    mask_logits,
    masked_log_probs,
    squashed_entropy,
    squashed_sample,
)
from skillweave.ops.losses import expected_soft_value, masked_entropy_target
from skillweave.ops.optim import adam_
from skillweave.ops.returns import discounted, td_target
from skillweave.schema import check


@dataclass
class State(ActorCriticState):
    """Learnt numbers and counts of SAC."""

    log_alpha: Tensor  # (P, 1), log of the temperature
    alpha_mu: Tensor  # (P, 1)
    alpha_nu: Tensor  # (P, 1)
    alpha_count: Tensor  # (P,) int64
    entropy: Tensor  # (P,), the latest, nats
    ent_coef: Tensor  # (P,), of each member: the temperature where it is not learnt


class SACAlgorithm(ActorCriticAlgorithm):
    """SAC on one pair of spaces; all that is learnt is in ``State``."""

    state_type = State
    member_hyperparameters = ("learning_rate", "gamma", "tau", "max_grad_norm", "ent_coef")
    between = True
    head: ActionHead

    def __init__(
        self, config: SAC, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        super().__init__(config, observation_space, action_space)
        self.interval = config.policy_delay
        self.head = ActionHead(self.codec, "state")
        self.net = Net("actor", self.obs, config.network, self.head.width)
        self.layout = self.acting = Layout(self.net.shapes)
        size = self.codec.size
        discrete = self.codec.discrete
        critic = config.critic or config.network
        self.critics = Critics(self.obs, critic, size if discrete else 1, 0 if discrete else size)
        default = 0.5 * math.log(size) if discrete else -float(size)
        self.target_entropy = default if config.target_entropy is None else config.target_entropy
        highest = math.log(size) if discrete else size * math.log(2.0)  # uniformly random
        check(
            config,
            "target_entropy",
            self.target_entropy <= highest,
            f"at most {highest:.4g}, the entropy of {action_space} at random",
        )

    def fresh_state(self, seeds: Sequence[Seeds]) -> State:
        """Create the state of fresh members, one for each seed."""
        members = len(seeds)
        return State(
            **self.fresh_networks(seeds),
            log_alpha=torch.full((members, 1), math.log(self.config.ent_coef), **FLOAT),
            alpha_mu=torch.zeros(members, 1, **FLOAT),
            alpha_nu=torch.zeros(members, 1, **FLOAT),
            alpha_count=torch.zeros(members, **INT),
            entropy=torch.zeros(members, **FLOAT),
        )

    def act(
        self,
        params: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, None]:
        """Return discrete actions (P, B) or continuous ones (P, B, A) in [−1, 1]; see the base."""
        dist_params = self.net(params.views, self.inputs(params, obs))
        if self.codec.discrete:
            dist_params = mask_logits(dist_params, mask)
            return self.head.act(dist_params, None, noise), dist_params, None
        return self.head.act(dist_params, None, noise).tanh(), dist_params, None

    def alpha(self, state: State) -> Tensor:
        """Return the temperature, (P, 1)."""
        return state.log_alpha.exp() if self.config.learn_ent_coef else state.ent_coef[:, None]

    def value(self, state: State, obs: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the soft value ``E[min Q − α·log π]`` in units of reward, (P, B).

        For continuous actions, Q of the greedy action plus ``squashed_entropy``.
        """
        params = self.learning_params(state)
        inputs = self.inputs(params, obs)
        alpha = self.alpha(state)
        dist_params = self.net(params.views, inputs)
        if self.codec.discrete:
            q = self.smallest(state.critic, inputs)
            return self.in_rewards(
                state, expected_soft_value(masked_log_probs(dist_params, mask), q, alpha)
            )
        mean, log_std = self.head.moments(dist_params, None)
        q = self.smallest(state.critic, inputs, mean.tanh())
        return self.in_rewards(state, q + alpha * squashed_entropy(mean, log_std))

    def learning_noise(self, rng: Sequence[torch.Generator], batch: int, due: bool) -> list[Tensor]:
        """Draw noise of the next, the between and the actor's actions: (P, B or B·(n − 1), A)."""
        if self.codec.discrete:
            return []
        between = [batch * (self.config.n_step - 1)] * (self.config.n_step > 1)
        sizes = [batch, *between, *[batch] * due]
        return [normal(rng, size, self.codec.size) for size in sizes]

    def learn(
        self, state: State, sample: Sample, rate: Tensor, noise: list[Tensor], due: bool
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Take one gradient step of critics, actor and temperature, in place."""
        alpha = self.alpha(state).squeeze(1)
        metrics, error = super().learn(state, sample, rate, noise, due)
        return metrics | {"entropy": state.entropy, "ent_coef": alpha}, error

    def critic_target(
        self, state: State, sample: Sample, params: ActingParams, noise: list[Tensor]
    ) -> Tensor:
        """Return ``r + discount·V̄(s′)``, V̄ the soft value of the slow critics (eq. 5), (P, B)."""
        inputs = self.inputs(params, sample.next_obs)
        alpha = self.alpha(state)
        dist_params = self.net(self.layout.views(state.params), inputs)
        slow = state.critic_target
        if self.codec.discrete:
            log_p = masked_log_probs(dist_params, sample.next_mask)
            value = expected_soft_value(log_p, self.smallest(slow, inputs), alpha)
        else:
            action, log_prob = squashed_sample(*self.head.moments(dist_params, None), noise[0])
            value = self.smallest(slow, inputs, action) - alpha * log_prob
        reward = self.rewards(state, sample)
        if sample.between_obs is not None:
            reward = reward + alpha * self.entropy_between(state, sample, params, noise[1:])
        return td_target(reward, sample.discount, value)

    def entropy_between(
        self, state: State, sample: Sample, params: ActingParams, noise: list[Tensor]
    ) -> Tensor:
        """Return the part of the n steps' reward from the entropy at the steps between, (P, B).

        The soft value of the first step includes ``γᵏ·α·H(π(·|sₖ))`` for each k from 1 to n − 1
        (Haarnoja et al. 2018a, eq. 3). For continuous actions H is estimated with an action drawn
        now: the recorded action is of an older policy, so its −log π may be any number.
        """
        assert sample.between_obs is not None
        assert sample.between_discount is not None
        lead = sample.between_discount.shape
        inputs = self.inputs(params, sample.between_obs.flatten(1, 2))
        dist_params = self.net(self.layout.views(state.params), inputs)
        if self.codec.discrete:
            mask = sample.between_mask
            log_p = masked_log_probs(dist_params, None if mask is None else mask.flatten(1, 2))
            entropy = -(log_p.exp() * log_p).sum(-1)
        else:
            entropy = -squashed_sample(*self.head.moments(dist_params, None), noise[0])[1]
        return discounted(sample.between_discount, entropy.view(lead)).sum(-1)

    def improve_policy(
        self, state: State, sample: Sample, inputs: Inputs, rate: Tensor, noise: list[Tensor]
    ) -> None:
        """Take one gradient step of the actor and of a learnt temperature, in place."""
        leaves = self.layout.leaves(state.params)
        mask = sample.mask
        loss, entropy = self.policy_loss(leaves, state, mask, inputs, noise[-1:])
        self.step_(state, loss, leaves, rate)
        state.policy_loss = loss.detach()
        state.entropy = entropy
        if self.config.learn_ent_coef:
            # d/d log α of −log α·(log π + H̄), as in the authors' code, not of −α·(…).
            slope = entropy - masked_entropy_target(self.target_entropy, mask)
            moments = state.alpha_mu, state.alpha_nu, state.alpha_count
            adam_(state.log_alpha, slope[:, None], *moments, rate, eps=self.config.adam_eps)

    def policy_loss(
        self, views: Views, state: State, mask: Tensor | None, inputs: Inputs, noise: list[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return ``E[α·log π − min Q]`` (eq. 7) and the detached policy entropy, each (P,)."""
        dist_params = self.net(views, inputs)
        alpha = self.alpha(state)
        if self.codec.discrete:
            log_p = masked_log_probs(dist_params, mask)
            with torch.no_grad():
                q = self.smallest(state.critic, inputs)
            entropy = -(log_p.exp() * log_p).detach().sum(-1)
            return -expected_soft_value(log_p, q, alpha).mean(1), entropy.mean(1)
        action, log_prob = squashed_sample(*self.head.moments(dist_params, None), noise[0])
        q = self.smallest(state.critic, inputs, action)
        return (alpha * log_prob - q).mean(1), -log_prob.detach().mean(1)
