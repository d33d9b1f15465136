"""Soft actor-critic (Haarnoja et al. 2018b) for P members at once, of forces and of choices.

Read down the page: State, init, act, update, losses. The settings are ``config.SAC``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave.algorithms.base import ActingParams, ParameterGroup
from skillweave.algorithms.config import SAC
from skillweave.algorithms.config_off_policy import check
from skillweave.algorithms.off_policy import Critics, OffPolicyAlgorithm, normal, regression
from skillweave.networks.encoders import Inputs
from skillweave.networks.heads import ActionHead
from skillweave.networks.net import Net
from skillweave.networks.stacked import Layout, Views
from skillweave.ops.distributions import mask_logits, tanh_log_det
from skillweave.ops.optim import adam_
from skillweave.seeding import Seeds
from skillweave.types import Sample

_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


@dataclass
class State:
    """Everything SAC learns and counts; P members, K = 2 critics, D parameters of a network."""

    params: Tensor  # (P, D), the actor
    mu: Tensor  # (P, D), Adam's first moment
    nu: Tensor  # (P, D), Adam's second moment
    count: Tensor  # (P,) int64, Adam's steps; (P, D) where parameters differ in age
    critic: Tensor  # (P, K, D)
    critic_target: Tensor  # (P, K, D)
    critic_mu: Tensor  # (P, K, D)
    critic_nu: Tensor  # (P, K, D)
    critic_count: Tensor  # (P,) int64, or (P, K, D)
    log_alpha: Tensor  # (P, 1), log of the temperature
    alpha_mu: Tensor  # (P, 1)
    alpha_nu: Tensor  # (P, 1)
    alpha_count: Tensor  # (P,) int64
    updates: Tensor  # (P,) int64, gradient steps
    obs_mean: Tensor  # (P, O)
    obs_var: Tensor  # (P, O)
    obs_count: Tensor  # (P,)
    return_mean: Tensor  # (P, 1)
    return_var: Tensor  # (P, 1)
    return_count: Tensor  # (P,)
    policy_loss: Tensor  # (P,), the latest, for the metrics
    entropy: Tensor  # (P,), the latest, nats
    learning_rate: Tensor  # (P,); this and all below are settings, one a member
    gamma: Tensor  # (P,)
    tau: Tensor  # (P,)
    max_grad_norm: Tensor  # (P,)
    ent_coef: Tensor  # (P,), the temperature where it is not learnt


class SACAlgorithm(OffPolicyAlgorithm):
    """SAC on one pair of spaces. Holds no learnt state: that is in ``State``."""

    state_type = State
    settings = ("learning_rate", "gamma", "tau", "max_grad_norm", "ent_coef")
    between = True

    def __init__(
        self, config: SAC, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        super().__init__(config, observation_space, action_space)
        self.interval = config.policy_delay
        self.head = ActionHead(self.codec, "state")
        self.net = Net("actor", self.obs, config.network, self.head.width)
        self.layout = self.acting = Layout(self.net.shapes)
        size, discrete = self.codec.size, self.codec.discrete
        critic = config.critic or config.network
        self.critics = Critics(self.obs, critic, size if discrete else 1, 0 if discrete else size)
        usual = 0.5 * math.log(size) if discrete else -float(size)
        self.target_entropy = usual if config.target_entropy is None else config.target_entropy
        highest = math.log(size) if discrete else size * math.log(2.0)  # of even chances
        check(
            config,
            "target_entropy",
            self.target_entropy <= highest,
            f"at most {highest:.4g}, the entropy of {action_space} at random",
        )

    def _fresh_state(self, seeds: list[Seeds]) -> State:
        members = len(seeds)
        params = torch.zeros(members, self.layout.size)
        generators = self.member_generators(seeds)
        self.net.init_(self.layout.views(params), 0.01, generators)
        critic = self.critics.init(generators)
        return State(
            params=params,
            mu=torch.zeros_like(params),
            nu=torch.zeros_like(params),
            count=torch.zeros(members, dtype=torch.int64),
            critic=critic,
            critic_target=critic.clone(),
            critic_mu=torch.zeros_like(critic),
            critic_nu=torch.zeros_like(critic),
            critic_count=torch.zeros(members, dtype=torch.int64),
            log_alpha=torch.full((members, 1), math.log(self.config.ent_coef)),
            alpha_mu=torch.zeros(members, 1),
            alpha_nu=torch.zeros(members, 1),
            alpha_count=torch.zeros(members, dtype=torch.int64),
            policy_loss=torch.zeros(members),
            entropy=torch.zeros(members),
            **self.fresh(members),
        )

    def groups(self) -> list[ParameterGroup]:
        """Everything in the state that has the shape of networks."""
        return [ParameterGroup(self.layout, (("network", self.net),)), self.critics.family()]

    def act(
        self,
        actor: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, None]:
        """Choices (P, B), or forces (P, B, A) in [−1, 1]; see ``Algorithm.act``."""
        head = self.net(actor.views, self.inputs(actor, obs))
        if self.codec.discrete:
            head = mask_logits(head, mask)
            return self.head.act(head, None, noise), head, None
        return self.head.act(head, None, noise).tanh(), head, None

    def learning_noise(
        self, generators: list[torch.Generator], batch: int, due: bool
    ) -> list[Tensor]:
        """Of the next actions, of those between, and of the actor's; (P, B or B·(n − 1), A)."""
        if self.codec.discrete:
            return []
        between = [batch * (self.config.n_step - 1)] * (self.config.n_step > 1)
        sizes = [batch, *between, *[batch] * due]
        return [normal(generators, size, self.codec.size) for size in sizes]

    def learn(
        self, state: State, sample: Sample, rate: Tensor, noise: list[Tensor], due: bool
    ) -> tuple[dict[str, Tensor], Tensor]:
        """One gradient step of critics, actor and temperature, in place."""
        actor = ActingParams({}, *self.scaling(state))
        eps, learnt = self.config.adam_eps, self.config.learn_ent_coef
        alpha = state.log_alpha.exp() if learnt else state.ent_coef[:, None]
        inputs = self.inputs(actor, sample.obs)
        leaves = self.critics.leaves(state.critic)
        loss, error, q = self.critic_loss(leaves, state, sample, actor, inputs, alpha, noise)
        norm = self.critics.step_(state, loss, leaves, rate, eps)
        if due:
            policy = self.layout.leaves(state.params)
            policy_loss, entropy = self.policy_loss(
                policy, state, sample.obs_mask, inputs, alpha, noise[-1:]
            )
            self.step_(state, policy_loss, policy, rate)
            state.policy_loss, state.entropy = policy_loss.detach(), entropy
            if learnt:
                # d/d log α of −log α·(log π + H̄), as in the authors' code, not of −α·(…).
                slope = (entropy - self.entropy_aim(sample.obs_mask))[:, None]
                moments = state.alpha_mu, state.alpha_nu, state.alpha_count
                adam_(state.log_alpha, slope, *moments, rate, eps=eps)
        state.critic_target.lerp_(state.critic, state.tau[:, None, None])
        metrics = {
            "critic_loss": loss.detach(),
            "policy_loss": state.policy_loss,
            "entropy": state.entropy,
            "ent_coef": alpha.squeeze(1),
            "q": q,
            "grad_norm": norm,
            "learning_rate": rate,
        }
        return metrics, error

    def critic_loss(
        self,
        views: Views,
        state: State,
        sample: Sample,
        actor: ActingParams,
        inputs: Inputs,
        alpha: Tensor,
        noise: list[Tensor],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Loss (P,), error of each sample (P, B) and mean value (P,)."""
        with torch.no_grad():
            slow, following = (
                self.critics.views(state.critic_target),
                self.inputs(actor, sample.next_obs),
            )
            head = self.net(self.layout.views(state.params), following)
            if self.codec.discrete:
                log_p = _log_p(head, sample.mask)
                q = self.critics(slow, following).amin(1)
                value = (log_p.exp() * (q - alpha[..., None] * log_p)).sum(-1)
            else:
                action, log_prob = self._sampled(head, noise[0])
                q = self.critics(slow, following, action).squeeze(-1).amin(1)
                value = q - alpha * log_prob
            reward = self.rewards(state, sample)
            if sample.between_obs is not None:
                reward = reward + alpha * self.entropy_between(state, sample, actor, noise[1:])
            target = self.target(reward, sample.discount, value)
        if self.codec.discrete:
            out = self.critics(views, inputs)  # (P, K, B, A)
            chosen = sample.action[:, None, :, None].expand(*out.shape[:3], 1)
            q = out.gather(-1, chosen).squeeze(-1)
        else:
            q = self.critics(views, inputs, sample.action).squeeze(-1)
        return regression(q, target, sample.weight)

    def policy_loss(
        self,
        views: Views,
        state: State,
        mask: Tensor | None,
        inputs: Inputs,
        alpha: Tensor,
        noise: list[Tensor],
    ) -> tuple[Tensor, Tensor]:
        """``E[α·log π − min Q]`` (eq. 7) and the policy's entropy, detached; each (P,)."""
        head, critics = self.net(views, inputs), self.critics.views(state.critic)
        if self.codec.discrete:
            log_p = _log_p(head, mask)
            p = log_p.exp()
            with torch.no_grad():
                q = self.critics(critics, inputs).amin(1)
            loss = (p * (alpha[..., None] * log_p - q)).sum(-1).mean(1)
            return loss, -(p * log_p).detach().sum(-1).mean(1)
        action, log_prob = self._sampled(head, noise[0])
        q = self.critics(critics, inputs, action).squeeze(-1).amin(1)
        return (alpha * log_prob - q).mean(1), -log_prob.detach().mean(1)

    def entropy_between(
        self, state: State, sample: Sample, actor: ActingParams, noise: list[Tensor]
    ) -> Tensor:
        """What the policy's entropy at the steps between adds to n steps' reward, (P, B).

        The soft value of the first step holds ``γᵏ·α·H(π(·|sₖ))`` for each k from 1 to n − 1
        (Haarnoja et al. 2018a, eq. 3). Of forces it is estimated by an action drawn now: of the
        one that was taken, by an older policy, −log π may be as large as it likes.
        """
        assert sample.between_obs is not None
        assert sample.between_discount is not None
        lead = sample.between_discount.shape
        inputs = self.inputs(actor, sample.between_obs.flatten(1, 2))
        head = self.net(self.layout.views(state.params), inputs)
        if self.codec.discrete:
            mask = sample.between_mask
            log_p = _log_p(head, None if mask is None else mask.flatten(1, 2))
            entropy = -(log_p.exp() * log_p).sum(-1)
        else:
            entropy = -self._sampled(head, noise[0])[1]
        # As in `target`: 0·NaN is NaN.
        discount = sample.between_discount
        return torch.where(discount == 0.0, 0.0, discount * entropy.view(lead)).sum(-1)

    def entropy_aim(self, mask: Tensor | None) -> Tensor | float:
        """The entropy aimed at: of m choices allowed instead of A, log m / log A of it; (P,)."""
        if mask is None or self.codec.size == 1:
            return self.target_entropy
        share = mask.sum(-1).clamp_min(1).log() / math.log(self.codec.size)
        return self.target_entropy * share.mean(1)

    def _sampled(self, head: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Squashed actions (P, B, A) and their log-probability (P, B); app. C."""
        mean, log_std = self.head.moments(head, None)
        u = torch.addcmul(mean, log_std.exp(), z)
        log_prob = -0.5 * z.square() - log_std - _HALF_LOG_TWO_PI - tanh_log_det(u)
        return u.tanh(), log_prob.sum(-1)


def _log_p(logits: Tensor, mask: Tensor | None) -> Tensor:
    """Log-probabilities; of forbidden choices a number whose exp is 0, but times α is finite."""
    return mask_logits(logits, mask).log_softmax(-1).clamp_min(-200.0)
