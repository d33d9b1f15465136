"""PPO (Schulman et al. 2017) for P members at once; a single agent is P = 1.

Read down the page: State, init, act, value, update, loss, preparation. The settings are
``config.PPO``. What acted may be an update old: the objective is the decoupled one of Hilton, Cobbe
& Schulman 2022.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave.algorithms.base import ActingParams, AgentState, Algorithm
from skillweave.algorithms.config import PPO
from skillweave.algorithms.parameters import ParameterGroup
from skillweave.algorithms.rollouts import (
    Cells,
    Samples,
    minibatches,
    rows_where,
)
from skillweave.experience import Report, Rollout
from skillweave.networks.encoders import Inputs
from skillweave.networks.heads import ActionHead
from skillweave.networks.net import Net
from skillweave.networks.stacked import Layout, Views, take_rows
from skillweave.ops.device import all_false
from skillweave.ops.distributions import mask_logits
from skillweave.ops.losses import approximate_kl, ppo_policy_loss, value_loss
from skillweave.ops.moments import explained_variance, masked_mean, normalise
from skillweave.ops.optim import adam_, clip_grad_norm_, kl_adapted_rate
from skillweave.ops.returns import gae
from skillweave.seeding import Seeds
from skillweave.types import Array

REPORT = ("policy_loss", "value_loss", "entropy", "kl", "grad_norm")
"""Metrics of a minibatch."""
_LR_RANGE = (1e-5, 1e-2)  # of the schedule 'kl', as in rl_games


@dataclass
class State(AgentState):
    """Everything PPO learns and counts; ``params`` is the actor first, then the critic."""

    gae_lambda: Tensor  # (P,), as all below a hyperparameter of each member
    clip_coef: Tensor  # (P,)
    ent_coef: Tensor  # (P,)
    vf_coef: Tensor  # (P,)
    max_grad_norm: Tensor  # (P,)


class PPOAlgorithm(Algorithm):
    """PPO on one pair of spaces. Holds no learnt state: that is in ``State``."""

    store = "rollout"
    state_type = State
    member_hyperparameters = (
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
        self.memory_size = self.actor_net.memory_size + self.critic_net.memory_size
        # With memory the critic runs along while acting: its memory must be known, too.
        self.acting = self.layout if self.memory_size else Layout(acting)

    def fresh_state(self, seeds: Sequence[Seeds]) -> State:
        """A state of fresh members, one for each seed."""
        params = torch.zeros(len(seeds), self.layout.size)
        views, generators = self.layout.views(params), self.member_generators(seeds)
        self.actor_net.init_(views, 0.01, generators)
        self.critic_net.init_(views, 1.0, generators)
        if self.head.std_in_head:
            bias = views[f"{self.actor_net.head}.bias"]
            bias[..., self.codec.size :].fill_(self.config.action_std_init).log_()
        elif not self.head.discrete:
            views["actor.log_std"].fill_(self.config.action_std_init).log_()
        return State(**self.fresh_fields(params))

    def parameter_groups(self) -> list[ParameterGroup]:
        """Everything in the state that has the shape of networks."""
        nets = ("network", self.actor_net), ("critic", self.critic_net)
        return [ParameterGroup(self.layout, nets)]

    def act(
        self,
        params: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Actions in policy units, the head they came from, and the memory; `Algorithm.act`."""
        inputs, views = self.inputs(params, obs), params.views
        if memory is None:
            head = self.actor_net(views, inputs)
        else:
            own, other = memory.tensor_split([self.actor_net.memory_size], dim=-1)
            head, own = self.actor_net.step(views, inputs, own)
            _, other = self.critic_net.step(views, inputs, other)
            memory = torch.cat([own, other], dim=-1)
        if self.head.discrete:
            head = mask_logits(head, mask)
        return self.head.act(head, views.get("actor.log_std"), noise), head, memory

    def to_env(self, action: Array) -> Array:
        """Policy units (n, …) to the environment's."""
        return self.head.to_env(action)

    def value(self, state: State, obs: Tensor, mask: Tensor | None = None) -> Tensor:
        """V in units of reward, (P, B); with a memory, that of an episode's first observation."""
        params = self.learning_params(state)
        inputs, size = self.inputs(params, obs), self.critic_net.memory_size
        if not size:
            return self._in_rewards(state, self.critic_net(params.views, inputs))
        empty = state.params.new_zeros(*obs.shape[:2], size)
        return self._in_rewards(state, self.critic_net.step(params.views, inputs, empty)[0])

    def update(
        self, state: State, batch: Rollout, rng: Sequence[torch.Generator]
    ) -> tuple[State, Report]:
        """Learn from the valid rows of a rollout, in place; ``rng`` orders the minibatches."""
        cfg = self.config
        samples, metrics = self._prepare(state, batch)
        leaves = self.layout.leaves(state.params)
        rate, ent_coef = self._scheduled(state, batch.progress)
        limit = None if cfg.learning_rate_schedule == "kl" else cfg.target_kl
        count = samples.count
        active, all_learn = count > 0, limit is None and samples.valid is None
        taken, sums = torch.zeros_like(rate), rate.new_zeros(len(REPORT), len(rate))
        for minibatch in minibatches(samples, rng, cfg.update_epochs, cfg.batch_size):
            loss, report = self.loss(leaves, state, minibatch, ent_coef)
            grad = self.layout.gradient(loss, leaves)
            report["grad_norm"] = clip_grad_norm_(grad, state.max_grad_norm)
            taken = taken + active
            sums.addcmul_(torch.stack([report[k] for k in REPORT]), active.float())
            if limit is not None:
                # As in Stable-Baselines3: a member stops before the step that oversteps.
                active = active & (report["kl"] <= 1.5 * limit)
                if all_false(active):
                    break
            adam_(
                state.params, grad, state.mu, state.nu, state.count, rate,
                eps=cfg.adam_eps, active=None if all_learn else active,
            )  # fmt: skip
        metrics |= dict(zip(REPORT, sums / taken.clamp_min(1.0), strict=True))
        if cfg.learning_rate_schedule == "kl":
            target = torch.full_like(rate, cfg.target_kl or 0.0)
            state.learning_rate = kl_adapted_rate(rate, metrics["kl"], target, *_LR_RANGE)
        return state, Report(metrics | {"learning_rate": rate, "samples": count})

    def _scheduled(self, state: State, progress: float) -> tuple[Tensor, Tensor]:
        """Learning rate and entropy coefficient now, each (P,)."""
        rate, ent_coef, final = state.learning_rate, state.ent_coef, self.config.ent_coef_final
        if self.config.learning_rate_schedule == "linear":
            rate = rate * (1.0 - progress)
        if final is not None:
            ent_coef = torch.lerp(ent_coef, torch.full_like(ent_coef, final), progress)
        return rate, ent_coef

    def loss(
        self, views: Views, state: State, batch: Samples, ent_coef: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Policy, value and entropy loss of one minibatch, (P,), and detached metrics (P,)."""
        head, _ = self._run(self.actor_net, views, batch.inputs, batch.memory, batch.starts)
        raw, _ = self._run(self.critic_net, views, batch.inputs, batch.memory, batch.starts)
        if batch.memory is not None:
            batch = batch.changed(lambda x: x.flatten(1, 2))
        log_std, valid = views.get("actor.log_std"), batch.valid
        log_prob, entropy = self.head.stats(head, log_std, batch.mask, batch.action)
        old, weight = batch.log_prob, batch.importance
        policy = ppo_policy_loss(log_prob, old, batch.advantage, state.clip_coef, weight, valid)
        clip = self.config.clip_value
        bound = None if clip is None else torch.full_like(state.clip_coef, clip)
        value = value_loss(raw.squeeze(-1), batch.target, batch.old_value, bound, valid)
        bonus = masked_mean(entropy, valid)
        total = policy + state.vf_coef * value - ent_coef * bonus
        with torch.no_grad():
            kl = approximate_kl(log_prob, old, weight, valid)
        report = {"policy_loss": policy, "value_loss": value, "entropy": bonus, "kl": kl}
        return total, {k: v.detach() for k, v in report.items()}

    @torch.no_grad()
    def _prepare(self, state: State, rollout: Rollout) -> tuple[Samples, dict[str, Tensor]]:
        """What ``loss`` needs of a rollout, and metrics (P,)."""
        cfg, memory, starts = self.config, rollout.memory, rollout.starts
        if not self.memory_size:
            memory = starts = None
        cells = Cells(rollout, all_cells=memory is not None)
        obs, valid = cells.flat(rollout.obs), cells.flat_or_none(rollout.valid)
        self.update_obs_stats(state, obs, valid)
        params = self.learning_params(state)
        inputs = self.inputs(params, obs)
        if memory is not None:
            inputs = {k: cells.unflat(v) for k, v in inputs.items()}
        raw, after = self._run(self.critic_net, params.views, inputs, memory, starts)
        value = self._in_rewards(state, raw)
        following = self._next_values(state, params, rollout, cells.grid(value), after)
        reward, discount, last = rollout.reward, rollout.discount, rollout.last
        grid = gae(reward, discount, cells.grid(value), following, last, state.gae_lambda)
        advantage = cells.flat(grid)
        returns = advantage + value
        metrics = {"explained_variance": explained_variance(value, returns, valid)}
        if cfg.normalize_returns:
            self.update_return_stats(state, returns, valid)
        mean, scale = state.return_mean, self._return_scale(state)
        action, mask = cells.flat(rollout.action), cells.flat_or_none(rollout.obs_mask)
        # Clipping and KL count from the policy as it is now, whoever acted.
        head, _ = self._run(self.actor_net, params.views, inputs, memory, starts)
        log_prob, _ = self.head.stats(head, params.views.get("actor.log_std"), mask, action)
        samples = Samples(
            inputs={} if memory is not None else inputs,
            action=action,
            log_prob=log_prob,
            importance=(log_prob - self._acted(rollout, cells, mask, action)).exp(),
            advantage=normalise(advantage, valid) if cfg.normalize_advantage else advantage,
            target=(returns - mean) / scale,
            old_value=None if cfg.clip_value is None else (value - mean) / scale,
            mask=mask,
            valid=valid,
            most=cells.most,
        )
        if memory is not None:
            samples = samples.changed(cells.unflat)
            samples.inputs, samples.memory, samples.starts = inputs, memory, starts
        return samples, metrics

    def _acted(self, rollout: Rollout, cells: Cells, mask: Tensor | None, action: Tensor) -> Tensor:
        """Log-probabilities (P, N) of the actions by the policy that acted."""
        assert rollout.head is not None
        log_std = None if rollout.log_std is None else rollout.log_std.flatten(1, 2)
        return self.head.stats(cells.flat(rollout.head), log_std, mask, action)[0]

    def _next_values(
        self,
        state: State,
        params: ActingParams,
        rollout: Rollout,
        value: Tensor,
        after: Tensor | None,
    ) -> Tensor:
        """V(next_obs), (P, T, B): V(obs), (P, T, B), of the next row, except at ends.

        Args:
            after: (P, T·B, M), the critic's memory after each row, if it has one.
        """
        following = torch.zeros_like(value)
        following[:, :-1] = value[:, 1:]
        # Surplus rows of members with fewer ends get what the shift gave them.
        rows = rows_where(rollout.last.flatten(1))
        inputs = self.inputs(params, take_rows(rollout.next_obs.flatten(1, 2), rows))
        if after is None:
            raw = self.critic_net(params.views, inputs)
        else:
            raw, _ = self.critic_net.step(params.views, inputs, take_rows(after, rows))
        ends = self._in_rewards(state, raw)
        return following.flatten(1).scatter(1, rows, ends).view_as(value)

    def _run(
        self,
        net: Net,
        views: Views,
        inputs: Inputs,
        memory: Tensor | None,
        starts: Tensor | None,
    ) -> tuple[Tensor, Tensor | None]:
        """A network's outputs (P, N, out) and memories (P, N, M); sequences are laid end to end."""
        if memory is None or starts is None:
            return net(views, inputs), None
        own, other = memory.tensor_split([self.actor_net.memory_size], dim=-1)
        memory = own if net is self.actor_net else other
        out, after = net.sequence(views, inputs, memory, starts)
        return out.flatten(1, 2), after.flatten(1, 2)

    def _in_rewards(self, state: State, raw: Tensor) -> Tensor:
        return raw.squeeze(-1) * self._return_scale(state) + state.return_mean

    def _return_scale(self, state: State) -> Tensor:
        return (state.return_var + 1e-8).sqrt()
