"""PPO (Schulman et al. 2017) for P members at once; a single agent is P = 1.

Read down the page: State, Actor, init, act, loss, update. The settings are ``config.PPO``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave.algorithms.config import PPO
from skillweave.networks.actor import Actor, ActorNet
from skillweave.networks.stacked import (
    Layout,
    Views,
    mlp,
    mlp_init_,
    mlp_shapes,
    take_rows,
)
from skillweave.ops.losses import approximate_kl, ppo_policy_loss, value_loss
from skillweave.ops.optim import adam_, clip_grad_norm_, kl_adapted_rate, merge_moments
from skillweave.ops.returns import explained_variance, gae, normalise
from skillweave.seeding import Seeds
from skillweave.types import Transition

REPORT = ("policy_loss", "value_loss", "entropy", "kl", "grad_norm")
"""Metrics of a minibatch."""
SETTINGS = (
    "learning_rate", "gamma", "gae_lambda", "clip_coef", "ent_coef", "vf_coef", "max_grad_norm",
)  # fmt: skip
"""Settings that each member has a value of its own of; all others shape the computation."""
_LR_RANGE = (1e-5, 1e-2)  # of the schedule 'kl', as in rl_games


@dataclass
class State:
    """Everything PPO learns and counts; P members, D parameters, O observation numbers."""

    params: Tensor  # (P, D), actor first, then critic
    mu: Tensor  # (P, D), Adam's first moment
    nu: Tensor  # (P, D), Adam's second moment
    count: Tensor  # (P,), Adam's steps
    obs_mean: Tensor  # (P, O)
    obs_var: Tensor  # (P, O)
    obs_count: Tensor  # (P,)
    return_mean: Tensor  # (P, 1)
    return_var: Tensor  # (P, 1)
    return_count: Tensor  # (P,)
    learning_rate: Tensor  # (P,); this and all below are settings, one a member
    gamma: Tensor  # (P,)
    gae_lambda: Tensor  # (P,)
    clip_coef: Tensor  # (P,)
    ent_coef: Tensor  # (P,)
    vf_coef: Tensor  # (P,)
    max_grad_norm: Tensor  # (P,)


@dataclass
class Rollout:
    """Transitions with what the acting policy's distribution was (``head``: logits, or mean)."""

    transition: Transition
    head: Tensor  # (P, T, B, A)
    log_std: Tensor | None  # (P, 1, 1, A), continuous actions


class PPOAlgorithm:
    """PPO on one pair of spaces. Holds no learnt state: that is in ``State``."""

    def __init__(
        self, config: PPO, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        self.config = config
        self.observation_space, self.action_space = observation_space, action_space
        self.net = ActorNet(observation_space, action_space, config.network, config.normalize_obs)
        self.critic_net = config.critic or config.network
        critic = mlp_shapes("critic", self.net.obs.size, self.critic_net, 1)
        self.layout = Layout(self.net.layout.shapes | critic)

    def init(self, seeds: list[Seeds]) -> State:
        """Fresh members, one for each seed; a member does not depend on its neighbours."""
        members, cfg = len(seeds), self.config
        params = torch.zeros(members, self.layout.size)
        views = self.layout.views(params)
        generators = [(s / "init").torch() for s in seeds]
        mlp_init_(views, "actor", cfg.network, 0.01, generators)
        mlp_init_(views, "critic", self.critic_net, 1.0, generators)
        if not self.net.head.discrete:
            views["actor.log_std"].fill_(cfg.action_std_init).log_()

        return State(
            params=params,
            mu=torch.zeros_like(params),
            nu=torch.zeros_like(params),
            count=torch.zeros(members),
            obs_mean=torch.zeros(members, self.net.obs.size),
            obs_var=torch.ones(members, self.net.obs.size),
            obs_count=torch.full((members,), 1e-4),
            return_mean=torch.zeros(members, 1),
            return_var=torch.ones(members, 1),
            return_count=torch.full((members,), 1e-4),
            **{name: torch.full((members,), float(getattr(cfg, name))) for name in SETTINGS},
        )

    def actor(self, state: State) -> Actor:
        """A copy of what acting needs."""
        return self.net.copy(state.params, state.obs_mean, state.obs_var)

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of one member's ``weights``."""
        scaling = {"obs_mean": (self.net.obs.size,), "obs_var": (self.net.obs.size,)}
        return self.layout.shapes | (scaling if self.net.normalize_obs else {})

    def weights(self, state: State, member: int = 0) -> dict[str, Tensor]:
        """One member's policy by name: parameters and observation scaling, copied."""
        named = {k: v[member].clone() for k, v in self.layout.views(state.params).items()}
        if self.net.normalize_obs:
            named |= {"obs_mean": state.obs_mean[member].clone()}
            named |= {"obs_var": state.obs_var[member].clone()}
        return named

    def value(self, state: State, obs: Tensor) -> Tensor:
        """V in reward units; raw observations (P, B, *obs_shape) to (P, B)."""
        inputs = self.net.inputs(self.actor(state), obs)
        return self._value(self.layout.views(state.params), state, inputs)

    def update(
        self, state: State, rollout: Rollout, progress: float, seeds: list[Seeds]
    ) -> tuple[State, dict[str, Tensor]]:
        """Learn from a rollout, in place; returns the state and metrics of shape (P,).

        Args:
            progress: share of the budget that is spent, for the learning-rate schedule.
            seeds: one a member, for the order of the minibatches.
        """
        cfg, tr = self.config, rollout.transition
        data, metrics = self._prepare(state, rollout)
        leaves = self.layout.leaves(state.params)
        rate, ent_coef = state.learning_rate, state.ent_coef
        if cfg.learning_rate_schedule == "linear":
            rate = rate * (1.0 - progress)
        if cfg.ent_coef_final is not None:
            ent_coef = torch.lerp(ent_coef, torch.full_like(rate, cfg.ent_coef_final), progress)
        limit = (
            1.5 * cfg.target_kl if cfg.target_kl and cfg.learning_rate_schedule != "kl" else None
        )
        active = torch.ones(len(seeds), dtype=torch.bool)
        counted = torch.zeros(len(seeds))
        sums = torch.zeros(len(REPORT), len(seeds))
        for batch in self._minibatches(data, seeds):
            loss, report = self.loss(leaves, state, batch, ent_coef)
            grads = torch.autograd.grad(loss.sum(), list(leaves.values()))
            grad = torch.cat([g.flatten(1) for g in grads], dim=1)
            report["grad_norm"] = clip_grad_norm_(grad, state.max_grad_norm)
            counted = counted + active
            sums.addcmul_(torch.stack([report[k] for k in REPORT]), active.float())
            if limit is not None:
                # As in Stable-Baselines3: a member stops before the step that oversteps.
                active = active & (report["kl"] <= limit)
                if not bool(active.any()):
                    break
            adam_(
                state.params, grad, state.mu, state.nu, state.count, rate,
                eps=cfg.adam_eps, active=None if limit is None else active,
            )  # fmt: skip
        metrics |= dict(zip(REPORT, sums / counted, strict=True))
        if cfg.learning_rate_schedule == "kl":
            target = torch.full_like(rate, cfg.target_kl or 0.0)
            state.learning_rate = kl_adapted_rate(rate, metrics["kl"], target, *_LR_RANGE)
        metrics["learning_rate"] = rate
        metrics["samples"] = torch.full_like(rate, float(tr.reward[0].numel()))
        return state, metrics

    def _minibatches(
        self, data: Mapping[str, Tensor], seeds: list[Seeds]
    ) -> Iterator[dict[str, Tensor]]:
        """Every epoch's minibatches, (P, b, ...), each member's in an order of its own."""
        size = data["advantage"].shape[1]
        parts = max(1, size // self.config.batch_size)
        for epoch in range(self.config.update_epochs):
            order = [torch.randperm(size, generator=(s / epoch).torch()) for s in seeds]
            shuffled = {k: take_rows(v, torch.stack(order)) for k, v in data.items()}
            for part in range(parts):
                cut = slice(part * size // parts, (part + 1) * size // parts)
                yield {k: v[:, cut] for k, v in shuffled.items()}

    def loss(
        self, views: Views, state: State, batch: Mapping[str, Tensor], ent_coef: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Policy, value and entropy loss of one minibatch, (P,), and detached metrics (P,)."""
        head = mlp(views, "actor", self.config.network, batch["inputs"])
        log_std, mask = views.get("actor.log_std"), batch.get("mask")
        log_prob, entropy = self.net.head.stats(head, log_std, mask, batch["action"])
        policy = ppo_policy_loss(log_prob, batch["log_prob"], batch["advantage"], state.clip_coef)
        raw = mlp(views, "critic", self.critic_net, batch["inputs"]).squeeze(-1)
        clip = self.config.clip_value
        bound = None if clip is None else torch.full_like(state.clip_coef, clip)
        value = value_loss(raw, batch["target"], batch.get("old_value"), bound)
        bonus = entropy.mean(1)
        total = policy + state.vf_coef * value - ent_coef * bonus
        with torch.no_grad():
            kl = approximate_kl(log_prob, batch["log_prob"])
        report = {"policy_loss": policy, "value_loss": value, "entropy": bonus, "kl": kl}
        return total, {k: v.detach() for k, v in report.items()}

    @torch.no_grad()
    def _prepare(
        self, state: State, rollout: Rollout
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The rollout as flat (P, T·B) tensors: inputs, action, log-prob, advantage, target."""
        cfg, tr = self.config, rollout.transition
        members, lead = tr.reward.shape[0], tr.reward.shape
        batch = {"action": tr.action.flatten(1, 2), "head": rollout.head.flatten(1, 2)}
        if tr.mask is not None:
            batch["mask"] = tr.mask.flatten(1, 2)
        log_std = None if rollout.log_std is None else rollout.log_std.flatten(1, 2)
        head, mask = batch.pop("head"), batch.get("mask")
        old_log_prob, _ = self.net.head.stats(head, log_std, mask, batch["action"])
        if self.net.normalize_obs:
            encoded = self.net.obs.encode(tr.obs.flatten(1, 2))
            moments = state.obs_mean, state.obs_var, state.obs_count
            state.obs_mean, state.obs_var, state.obs_count = merge_moments(*moments, encoded)
        actor, views = self.actor(state), self.layout.views(state.params)
        inputs = self.net.inputs(actor, tr.obs.flatten(1, 2))
        value = self._value(views, state, inputs).view(lead)
        next_value = self._next_value(views, state, actor, value, tr)
        advantage = gae(tr.reward, tr.discount, value, next_value, tr.last, state.gae_lambda)
        returns = (advantage + value).flatten(1)
        metrics = {"explained_variance": explained_variance(value.flatten(1), returns)}
        if cfg.normalize_returns:
            moments = state.return_mean, state.return_var, state.return_count
            state.return_mean, state.return_var, state.return_count = merge_moments(
                *moments, returns[..., None]
            )
        if cfg.normalize_advantage:
            advantage = normalise(advantage)
        batch |= {
            "inputs": inputs,
            "log_prob": old_log_prob,
            "advantage": advantage.reshape(members, -1),
            "target": (returns - state.return_mean) / self._return_scale(state),
        }
        if cfg.clip_value is not None:
            old = value.flatten(1) - state.return_mean
            batch["old_value"] = old / self._return_scale(state)
        return batch, metrics

    def _next_value(
        self, views: Views, state: State, actor: Actor, value: Tensor, tr: Transition
    ) -> Tensor:
        """V(next_obs), (P, T, B): shifted values, computed anew only where trajectories end."""
        next_value = torch.zeros_like(value)
        next_value[:, :-1] = value[:, 1:]
        last = tr.last.flatten(1)
        widest = int(last.sum(1).max())
        # Members may have different numbers of ends: the first `widest` of a stable sort holds
        # them all. Surplus rows get what the shift gave them, the value of their true successor.
        rows = last.to(torch.int8).argsort(dim=1, descending=True, stable=True)[:, :widest]
        ends = self._value(
            views, state, self.net.inputs(actor, take_rows(tr.next_obs.flatten(1, 2), rows))
        )
        return next_value.flatten(1).scatter(1, rows, ends).view_as(value)

    def _value(self, views: Views, state: State, inputs: Tensor) -> Tensor:
        raw = mlp(views, "critic", self.critic_net, inputs).squeeze(-1)
        return raw * self._return_scale(state) + state.return_mean

    def _return_scale(self, state: State) -> Tensor:
        return (state.return_var + 1e-8).sqrt()
