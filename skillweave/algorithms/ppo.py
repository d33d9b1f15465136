"""PPO (Schulman et al. 2017) for P members at once; a single agent is P = 1.

Read down the page: State, init, act, update, loss. The settings are ``config.PPO``. What acted
may be an update old: the objective is the decoupled one of Hilton, Cobbe & Schulman 2022.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave.algorithms.base import ActingParams, Algorithm, ParameterGroup
from skillweave.algorithms.config import PPO
from skillweave.algorithms.minibatches import minibatches
from skillweave.networks.encoders import Inputs
from skillweave.networks.heads import ActionHead
from skillweave.networks.net import Net
from skillweave.networks.stacked import Layout, Views, take_rows
from skillweave.ops.distributions import mask_logits
from skillweave.ops.losses import approximate_kl, ppo_policy_loss, value_loss
from skillweave.ops.optim import adam_, clip_grad_norm_, kl_adapted_rate
from skillweave.ops.returns import explained_variance, gae, normalise
from skillweave.seeding import Seeds
from skillweave.types import Array, Transition

REPORT = ("policy_loss", "value_loss", "entropy", "kl", "grad_norm")
"""Metrics of a minibatch."""
_LR_RANGE = (1e-5, 1e-2)  # of the schedule 'kl', as in rl_games


@dataclass
class State:
    """Everything PPO learns and counts; P members, D parameters, O observation numbers."""

    params: Tensor  # (P, D), actor first, then critic
    mu: Tensor  # (P, D), Adam's first moment
    nu: Tensor  # (P, D), Adam's second moment
    count: Tensor  # (P,) int64, Adam's steps; (P, D) where parameters differ in age
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
    memory: Tensor | None = None  # (P, B, M), before the first step
    start: Tensor | None = None  # (P, T, B) bool, an episode begins within the rollout


class PPOAlgorithm(Algorithm):
    """PPO on one pair of spaces. Holds no learnt state: that is in ``State``."""

    state_type = State
    settings = (
        "learning_rate", "gamma", "gae_lambda", "clip_coef", "ent_coef", "vf_coef",
        "max_grad_norm",
    )  # fmt: skip

    def __init__(
        self, config: PPO, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        super().__init__(config, observation_space, action_space)
        self.head = ActionHead(self.codec, config.action_std, config.squash_actions)
        self.actor_net = Net("actor", self.obs, config.network, self.head.width)
        self.critic_net = Net("critic", self.obs, config.critic or config.network, 1)
        acting = dict(self.actor_net.shapes)
        if not self.head.discrete and not self.head.std_in_head:
            acting["actor.log_std"] = (1, self.codec.size)
        self.layout = Layout(acting | self.critic_net.shapes)
        self.memory = self.actor_net.memory + self.critic_net.memory
        # With memory the critic runs along while acting: its memory must be known, too.
        self.acting = self.layout if self.memory else Layout(acting)

    def _fresh_state(self, seeds: list[Seeds]) -> State:
        members, cfg = len(seeds), self.config
        params = torch.zeros(members, self.layout.size)
        views = self.layout.views(params)
        generators = self.member_generators(seeds)
        self.actor_net.init_(views, 0.01, generators)
        self.critic_net.init_(views, 1.0, generators)
        if self.head.std_in_head:
            bias = views[f"{self.actor_net.head}.bias"]
            bias[..., self.codec.size :].fill_(cfg.action_std_init).log_()
        elif not self.head.discrete:
            views["actor.log_std"].fill_(cfg.action_std_init).log_()
        return State(
            params=params,
            mu=torch.zeros_like(params),
            nu=torch.zeros_like(params),
            count=torch.zeros(members, dtype=torch.int64),
            **self.fresh(members),
        )

    def groups(self) -> list[ParameterGroup]:
        """Everything in the state that has the shape of networks."""
        nets = ("network", self.actor_net), ("critic", self.critic_net)
        return [ParameterGroup(self.layout, nets)]

    def act(
        self,
        actor: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Actions in policy units, the head they came from, and the memory; `Algorithm.act`."""
        inputs = self.inputs(actor, obs)
        if memory is None:
            head = self.actor_net(actor.views, inputs)
        else:
            cut = self.actor_net.memory
            head, after = self.actor_net.step(actor.views, inputs, memory[..., :cut])
            _, other = self.critic_net.step(actor.views, inputs, memory[..., cut:])
            memory = torch.cat([after, other], dim=-1)
        if self.head.discrete:
            head = mask_logits(head, mask)
        return self.head.act(head, actor.views.get("actor.log_std"), noise), head, memory

    def to_env(self, action: Array) -> Array:
        """Policy units (n, …) to the environment's."""
        return self.head.to_env(action)

    def value(self, state: State, obs: Tensor) -> Tensor:
        """V in reward units; raw observations (P, B, *item) to (P, B). Not for memories."""
        inputs = self.inputs(self.actor(state), obs)
        return self._in_rewards(state, self.critic_net(self.layout.views(state.params), inputs))

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
        limit = None if cfg.learning_rate_schedule == "kl" else cfg.target_kl
        active = torch.ones(len(seeds), dtype=torch.bool)
        counted = torch.zeros(len(seeds))
        sums = torch.zeros(len(REPORT), len(seeds))
        for batch in minibatches(data, seeds, cfg.update_epochs, cfg.batch_size):
            loss, report = self.loss(leaves, state, batch, ent_coef)
            grad = self.layout.gradient(loss, leaves)
            report["grad_norm"] = clip_grad_norm_(grad, state.max_grad_norm)
            counted = counted + active
            sums.addcmul_(torch.stack([report[k] for k in REPORT]), active.float())
            if limit is not None:
                # As in Stable-Baselines3: a member stops before the step that oversteps.
                active = active & (report["kl"] <= 1.5 * limit)
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

    def _run(self, net: Net, views: Views, batch: Mapping[str, Tensor]) -> Tensor:
        """A network's outputs for a batch, (P, N, out); sequences are laid end to end."""
        if "memory" not in batch:
            return net(views, _inputs(batch))
        cut = self.actor_net.memory
        memory = batch["memory"]
        memory = memory[..., :cut] if net is self.actor_net else memory[..., cut:]
        return net.sequence(views, _inputs(batch), memory, batch["start"])[0].flatten(1, 2)

    def loss(
        self, views: Views, state: State, batch: Mapping[str, Tensor], ent_coef: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Policy, value and entropy loss of one minibatch, (P,), and detached metrics (P,)."""
        head = self._run(self.actor_net, views, batch)
        raw = self._run(self.critic_net, views, batch).squeeze(-1)
        if "memory" in batch:
            batch = {k: v.flatten(1, 2) for k, v in batch.items() if k != "memory"}
        log_std, mask = views.get("actor.log_std"), batch.get("mask")
        log_prob, entropy = self.head.stats(head, log_std, mask, batch["action"])
        proximal, weight = batch["proximal"], batch["weight"]
        policy = ppo_policy_loss(log_prob, proximal, batch["advantage"], state.clip_coef, weight)
        clip = self.config.clip_value
        bound = None if clip is None else torch.full_like(state.clip_coef, clip)
        value = value_loss(raw, batch["target"], batch.get("old_value"), bound)
        bonus = entropy.mean(1)
        total = policy + state.vf_coef * value - ent_coef * bonus
        with torch.no_grad():
            kl = approximate_kl(log_prob, proximal, weight)
        report = {"policy_loss": policy, "value_loss": value, "entropy": bonus, "kl": kl}
        return total, {k: v.detach() for k, v in report.items()}

    @torch.no_grad()
    def _prepare(
        self, state: State, rollout: Rollout
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The rollout as (P, T, B, ...) tensors: inputs, action, advantage, target, and so on."""
        cfg, tr = self.config, rollout.transition
        self.see(state, tr.obs.flatten(1, 2))
        actor, views = self.actor(state), self.layout.views(state.params)
        inputs = self.inputs(actor, tr.obs.flatten(1, 2))
        data = {k: v.unflatten(1, tr.reward.shape[1:]) for k, v in inputs.items()}
        if rollout.memory is not None and rollout.start is not None:
            data |= {"memory": rollout.memory, "start": rollout.start}
            inputs = data
        acted, _ = self.head.stats(rollout.head, rollout.log_std, tr.mask, tr.action)
        # Clipping and KL count from the policy as it is now, whoever acted.
        head = self._run(self.actor_net, views, inputs).view_as(rollout.head)
        log_std = None if rollout.log_std is None else views["actor.log_std"][:, None]
        proximal, _ = self.head.stats(head, log_std, tr.mask, tr.action)
        value, next_value = self._values(views, state, actor, data, tr)
        advantage = gae(tr.reward, tr.discount, value, next_value, tr.last, state.gae_lambda)
        returns = advantage + value
        metrics = {"explained_variance": explained_variance(value.flatten(1), returns.flatten(1))}
        if cfg.normalize_returns:
            self.see_returns(state, returns.flatten(1))
        if cfg.normalize_advantage:
            advantage = normalise(advantage)
        mean, scale = state.return_mean[..., None], self._return_scale(state)[..., None]
        data |= {
            "action": tr.action,
            "proximal": proximal,
            "weight": (proximal - acted).exp(),
            "advantage": advantage,
            "target": (returns - mean) / scale,
        }
        if tr.mask is not None:
            data["mask"] = tr.mask
        if cfg.clip_value is not None:
            data["old_value"] = (value - mean) / scale
        return data, metrics

    def _values(
        self, views: Views, state: State, actor: ActingParams, data: Mapping[str, Tensor], tr: Transition
    ) -> tuple[Tensor, Tensor]:
        """V(obs) and V(next_obs), (P, T, B): the latter are the former, shifted, except at ends."""
        lead, after = tr.reward.shape, None
        if "memory" in data:
            own = data["memory"][..., self.actor_net.memory :]
            raw, after = self.critic_net.sequence(views, _inputs(data), own, data["start"])
            raw = raw.flatten(1, 2)
        else:
            raw = self.critic_net(views, {k: v.flatten(1, 2) for k, v in _inputs(data).items()})
        value = self._in_rewards(state, raw).view(lead)
        next_value = torch.zeros_like(value)
        next_value[:, :-1] = value[:, 1:]
        last = tr.last.flatten(1)
        widest = int(last.sum(1).max())
        # Members may have different numbers of ends: the first `widest` of a stable sort holds
        # them all. Surplus rows get what the shift gave them, the value of their true successor.
        rows = last.to(torch.int8).argsort(dim=1, descending=True, stable=True)[:, :widest]
        inputs = self.inputs(actor, take_rows(tr.next_obs.flatten(1, 2), rows))
        if after is None:
            ends = self.critic_net(views, inputs)
        else:
            ends, _ = self.critic_net.step(views, inputs, take_rows(after.flatten(1, 2), rows))
        ends = self._in_rewards(state, ends)
        return value, next_value.flatten(1).scatter(1, rows, ends).view(lead)

    def _in_rewards(self, state: State, raw: Tensor) -> Tensor:
        return raw.squeeze(-1) * self._return_scale(state) + state.return_mean

    def _return_scale(self, state: State) -> Tensor:
        return (state.return_var + 1e-8).sqrt()


def _inputs(batch: Mapping[str, Tensor]) -> Inputs:
    return {k: v for k, v in batch.items() if k == "vector" or k.startswith("image.")}
