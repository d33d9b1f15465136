"""PPO (Schulman et al. 2017) for P members at once; a single agent is P = 1.

In the order of reading: State, init, act, value, update, learn, loss, the samples of a rollout;
then the terms of a loss. The settings are ``config.PPO``. The weights that acted may be one update
old, so the objective is the decoupled one of Hilton, Cobbe & Schulman 2022.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.base import ActingParams, AgentState, Algorithm
from skillweave.algorithms.batches import Reference, Rehearsal, Report, Rollout
from skillweave.algorithms.compiled import Compiled
from skillweave.algorithms.config import PPO
from skillweave.algorithms.parameters import ParameterGroup, epsilon_now, rate_now
from skillweave.algorithms.rollouts import Cells, Samples, minibatches, values_after
from skillweave.errors import DeclarationError
from skillweave.networks.heads import ChoiceHead, head_of
from skillweave.networks.net import Net
from skillweave.networks.stacked import Inputs, Layout, Views, take_rows
from skillweave.ops.device import FLOAT, all_false
from skillweave.ops.losses import approximate_kl, likelihood_ratio, ppo_policy_loss, value_loss
from skillweave.ops.moments import explained_variance, masked_mean, normalize
from skillweave.ops.optim import kl_adapted_rate
from skillweave.ops.returns import gae
from skillweave.policies.core import Array
from skillweave.spaces import ChoiceSpace

REHEARSAL_COST = 0.2
"""Cost of a nat of KL in the rehearsal's observations, where advantages have a deviation of 1."""
OPENNESS = 0.1
"""Cost of a nat of KL from uniform choices, times epsilon: the least likely of n choices keeps a
probability near 0.1·ε/n, where advantages have a deviation of 1, and can be learnt again."""
LEAST_RATE, LARGEST_RATE = 1e-5, 1e-2
"""Bounds of the schedule 'kl', as in rl_games."""
RISE = 10.0
"""The most by which the schedule 'kl' raises the rate that it begins with."""
FARTHEST, FARTHEST_BY_KL = 1.5, 4.0
"""The KL at which an update stops, in units of ``target_kl``: 1.5 as in Stable-Baselines3; the
schedule 'kl' lowers the rate at 2, and stops where that was too late."""
CRITIC_RATE = 1e-3
"""Adam's step size while the critic learns alone and the rate follows the KL, which is 0 then."""


@dataclass
class State(AgentState):
    """Learnt numbers and counts of PPO; ``params`` is the actor first, then the critic."""

    gae_lambda: Tensor  # (P,), as all below a hyperparameter of each member
    clip_coef: Tensor  # (P,)
    ent_coef: Tensor  # (P,)
    vf_coef: Tensor  # (P,)
    max_grad_norm: Tensor  # (P,)


class PPOAlgorithm(Algorithm):
    """PPO on one pair of spaces; all that is learnt is in ``State``."""

    store = "rollout"
    follows_schedules = True
    state_type: ClassVar[type[State]] = State
    member_hyperparameters = (
        "learning_rate",
        "gamma",
        "gae_lambda",
        "clip_coef",
        "ent_coef",
        "vf_coef",
        "max_grad_norm",
    )

    def __init__(
        self, config: PPO, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        super().__init__(config, observation_space, action_space)
        if max(config.epsilon, config.epsilon_final or 0.0) and not isinstance(
            action_space, gym.spaces.Discrete | ChoiceSpace
        ):
            raise DeclarationError(f"epsilon needs discrete actions, but they are {action_space}")
        self.head = head_of(self.codec, config.action_std, config.squash_actions)
        self.choice = self.head.heads[0] if isinstance(self.head, ChoiceHead) else self.head
        self.actor_net = Net("actor", self.obs, config.network, self.head.width)
        self.critic_net = Net("critic", self.obs, config.critic or config.network, 1)
        acting = dict(self.actor_net.shapes)
        if self.head.log_std_size:
            acting["actor.log_std"] = (1, self.head.log_std_size)
        self.layout = Layout(acting | self.critic_net.shapes)
        self.memory_size = self.actor_net.memory_size + self.critic_net.memory_size
        # A recurrent critic runs while acting, too, because learning needs its recurrent state.
        self.acting = self.layout if self.memory_size else Layout(acting)

    def fresh_state(self, seeds: Sequence[Seeds]) -> State:
        """Create the state of fresh members, one for each seed."""
        params = torch.zeros(len(seeds), self.layout.size, **FLOAT)
        views = self.layout.views(params)
        generators = self.member_generators(seeds)
        self.actor_net.init_(views, 0.01, generators)
        # All values begin at 0. Until the first reward, a random critic's errors would be the only
        # advantages, and they could lead the policy away from that reward.
        self.critic_net.init_(views, 0.0, generators)
        if columns := self.head.std_columns:
            bias = views[f"{self.actor_net.head}.bias"]
            std = torch.full_like(bias[..., columns], self.config.action_std_init)
            bias[..., columns] = std.log_()
        if self.head.log_std_size:
            views["actor.log_std"].fill_(self.config.action_std_init).log_()
        return State(**self.fresh_fields(params))

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return the groups of state fields that have the shape of networks."""
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
        """Return actions in policy units, their dist_params and recurrent state; see the base."""
        inputs = self.inputs(params, obs)
        views = params.views
        if memory is None:
            dist_params = self.actor_net(views, inputs)
        else:
            actor, critic = memory.tensor_split([self.actor_net.memory_size], dim=-1)
            dist_params, actor = self.actor_net.step(views, inputs, actor)
            _, critic = self.critic_net.step(views, inputs, critic)
            memory = torch.cat([actor, critic], dim=-1)
        dist_params = self.head.masked(dist_params, mask, params.extra.get("epsilon"))
        action = self.head.act(dist_params, views.get("actor.log_std"), noise)
        return action, dist_params, memory

    def exploration(self, state: State, progress: float) -> dict[str, Tensor]:
        """Return epsilon, (P, 1, 1), if there is one."""
        epsilon = epsilon_now(self.config, progress, state.learning_rate)
        return {} if epsilon is None else {"epsilon": epsilon}

    def to_env(self, action: Array) -> Array:
        """Convert actions (n, …) from policy units to the environment's."""
        return self.head.to_env(action)

    def value(self, state: State, obs: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return V in units of reward, (P, B); a recurrent state starts empty."""
        params = self.learning_params(state)
        inputs = self.inputs(params, obs)
        size = self.critic_net.memory_size
        if not size:
            return self.in_rewards(state, self.critic_net(params.views, inputs))
        empty = state.params.new_zeros(*obs.shape[:2], size)
        return self.in_rewards(state, self.critic_net.step(params.views, inputs, empty)[0])

    def update(
        self, state: State, batch: Rollout, rng: Sequence[torch.Generator]
    ) -> tuple[State, Report]:
        """Learn from the valid rows of a rollout, in place; ``rng`` orders the minibatches."""
        cfg = self.config
        terms = Terms.of(cfg, state, batch)
        samples, metrics = self.samples(state, batch, terms)
        follows_kl = cfg.learning_rate_schedule == "kl" and not terms.critic_alone
        rate = terms.rate
        count = samples.count
        limited = self._kl_limit is not None
        target = torch.full_like(rate, cfg.target_kl or 0.0)
        reports: list[dict[str, Tensor]] = []  # of gradient steps
        learnt: list[Tensor] = []  # (P,) bool each, the members that took part
        compiles = cfg.compile and not self.memory_size
        # A compiled step makes its leaves itself; others share these.
        leaves = None if compiles else self.layout.leaves(state.params)
        learn = self._compiled if compiles else self.learn
        active = count > 0
        all_learn = not limited and samples.valid is None
        for minibatch in minibatches(samples, rng, cfg.update_epochs, cfg.minibatch):
            if batch.rehearsal is not None:
                size = minibatch.advantage.shape[1]
                terms.rehearsal = self._drawn(state, batch.rehearsal, size, rng)
            report, learns = learn(state, leaves, minibatch, terms, None if all_learn else active)
            if follows_kl and reports:  # before the first step there is nothing to measure
                adapted = kl_adapted_rate(terms.rate, report["kl"], target, *self._rates)
                terms.rate = torch.where(active, adapted, terms.rate)
            reports.append(report)
            learnt.append(active)
            active = active if learns is None else learns
            if limited and all_false(active):
                break
        counted = torch.stack(learnt).to(rate.dtype)
        steps = counted.sum(0).clamp_min(1.0)
        for name in reports[0]:
            metrics[name] = (torch.stack([r[name] for r in reports]) * counted).sum(0) / steps
        if follows_kl:
            state.learning_rate = terms.rate
        return state, Report(metrics | {"learning_rate": rate, "samples": count})

    @property
    def _kl_limit(self) -> float | None:
        """Return the KL beyond which a member stops learning from this rollout; None: no limit."""
        cfg = self.config
        if cfg.target_kl is None:
            return None
        farthest = FARTHEST_BY_KL if cfg.learning_rate_schedule == "kl" else FARTHEST
        return farthest * float(cfg.target_kl)

    @property
    def _rates(self) -> tuple[float, float]:
        """Return the lowest and the highest learning rate of the schedule 'kl'."""
        return LEAST_RATE, min(LARGEST_RATE, RISE * float(self.config.learning_rate))

    @functools.cached_property
    def _compiled(self) -> Compiled:
        # Where skills learn together, their rows are the steps in which they acted: n varies.
        return Compiled(self.learn, self.config, sizes_vary=True)

    def learn(
        self,
        state: State,
        leaves: Views | None,
        batch: Samples,
        terms: Terms,
        active: Tensor | None,
    ) -> tuple[dict[str, Tensor], Tensor | None]:
        """Take one gradient step in place, with tensor operations only, so it can be compiled.

        Args:
            leaves: of ``state.params``; None: create them here.
            active: (P,) bool, members that learn; None: all, always.

        Returns:
            Metrics (P,), and the members that learnt, (P,) bool: a member stops before a step that
            exceeds the limit of the KL.
        """
        leaves = self.layout.leaves(state.params) if leaves is None else leaves
        loss, report = self.loss(leaves, state, batch, terms)
        if active is not None and self._kl_limit is not None:
            active = active & (report["kl"] <= self._kl_limit)
        report["grad_norm"] = self.step_(state, loss, leaves, terms.rate, active=active)
        return report, active

    def loss(
        self, views: Views, state: State, batch: Samples, terms: Terms
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the loss of a minibatch (policy, value, entropy) and detached metrics, (P,)."""
        dist_params, _ = self.run(self.actor_net, views, batch.inputs, batch.memory, batch.starts)
        raw, _ = self.run(self.critic_net, views, batch.inputs, batch.memory, batch.starts)
        if batch.memory is not None:
            batch = batch.changed(lambda x: x.flatten(1, 2))
        log_std = views.get("actor.log_std")
        valid = batch.valid
        acted = batch.own
        log_prob, entropy = self.head.stats(dist_params, log_std, batch.mask, batch.action)
        old = batch.log_prob
        weight = batch.importance
        policy = ppo_policy_loss(log_prob, old, batch.advantage, state.clip_coef, weight, acted)
        clip = self.config.clip_value
        bound = None if clip is None else torch.full_like(state.clip_coef, clip)
        value = value_loss(raw.squeeze(-1), batch.target, batch.old_value, bound, valid)
        mean_entropy = bonus = masked_mean(entropy, acted)
        if (surplus := self.head.surplus(dist_params, log_std)) is not None:
            bonus = mean_entropy - masked_mean(surplus, acted)
        report = {"policy_loss": policy, "value_loss": value, "entropy": mean_entropy}
        with torch.no_grad():
            report["kl"] = approximate_kl(log_prob, old, weight, acted)
        if terms.critic_alone:
            return state.vf_coef * value, {k: v.detach() for k, v in report.items()}
        total = policy + state.vf_coef * value - terms.ent_coef * bonus
        if terms.openness is not None:
            logits = dist_params[..., : self.choice.width]  # without those of goals
            away = self.choice.kl(torch.zeros_like(logits), None, logits, None, batch.mask)
            total = total + terms.openness * masked_mean(away, acted)
        if terms.reference is not None:
            params = terms.reference.params
            other = None if params is None else params.views.get("actor.log_std")
            assert batch.reference is not None
            divergence = self.head.kl(dist_params, log_std, batch.reference, other, batch.mask)
            report["reference_kl"] = masked_mean(divergence, acted)
            total = total + terms.reference.coef * report["reference_kl"]
        if terms.rehearsal is not None:
            report["rehearsal_kl"] = self.rehearsal_kl(views, log_std, terms.rehearsal)
            total = total + REHEARSAL_COST * report["rehearsal_kl"]
        return total, {k: v.detach() for k, v in report.items()}

    def rehearsal_kl(
        self, views: Views, log_std: Tensor | None, rehearsal: RehearsalRows
    ) -> Tensor:
        """Return the mean KL(earlier ‖ present policy) in a rehearsal's observations, (P,).

        As in kickstarting (Schmitt et al. 2018), with the earlier policy as the teacher.
        """
        present = self.actor_net(views, rehearsal.inputs)
        earlier = rehearsal.dist_params, rehearsal.log_std
        return self.head.kl(*earlier, present, log_std, None).mean(1)

    def _drawn(
        self, state: State, rehearsal: Rehearsal, count: int, rng: Sequence[torch.Generator]
    ) -> RehearsalRows:
        """Draw ``count`` observations of a rehearsal for each member."""
        size = rehearsal.obs.shape[1]
        rows = torch.stack([torch.randint(size, (count,), generator=g, device="cpu") for g in rng])
        rows = rows.to(rehearsal.obs.device)
        inputs = self.inputs(self.learning_params(state), take_rows(rehearsal.obs, rows))
        return RehearsalRows(inputs, take_rows(rehearsal.dist_params, rows), rehearsal.log_std)

    def run(
        self,
        net: Net,
        views: Views,
        inputs: Inputs,
        memory: Tensor | None,
        starts: Tensor | None,
    ) -> tuple[Tensor, Tensor | None]:
        """Return a network's outputs (P, N, out) and recurrent states (P, N, M).

        Sequences (T, B) are flattened to N = T·B.
        """
        if memory is None or starts is None:
            return net(views, inputs), None
        actor, critic = memory.tensor_split([self.actor_net.memory_size], dim=-1)
        memory = actor if net is self.actor_net else critic
        out, after = net.sequence(views, inputs, memory, starts)
        return out.flatten(1, 2), after.flatten(1, 2)

    def in_rewards(self, state: State, raw: Tensor) -> Tensor:
        """Convert the critic's outputs (P, N, 1) to units of reward, (P, N)."""
        return raw.squeeze(-1) * state.return_scale + state.return_mean

    @torch.no_grad()
    def samples(
        self, state: State, rollout: Rollout, terms: Terms
    ) -> tuple[Samples, dict[str, Tensor]]:
        """Return the samples of a rollout that ``loss`` needs, and metrics (P,)."""
        cfg = self.config
        memory = rollout.recurrent_state
        starts = rollout.episode_start
        if not self.memory_size:
            memory = starts = None
        cells = Cells(rollout, all_cells=memory is not None)
        obs = cells.flat(rollout.obs)
        valid = cells.flat_or_none(rollout.valid)
        self.update_obs_stats(state, obs, valid, scales=not rollout.keeps_scaling)
        params = self.learning_params(state)
        inputs = self.inputs(params, obs)
        if memory is not None:
            inputs = {k: cells.unflat(v) for k, v in inputs.items()}
        raw, after = self.run(self.critic_net, params.views, inputs, memory, starts)
        value = self.in_rewards(state, raw)
        following = self.next_values(state, params, rollout, cells.grid(value), after)
        action = cells.flat(rollout.action)
        mask = cells.flat_or_none(rollout.mask)
        # Clipping and KL refer to the current policy, even if an older one, or one with epsilon,
        # acted. With a high epsilon, a ratio of mixtures would let the policy collapse within the
        # clip, because the policy can change only a share of 1 − epsilon of the mixture.
        dist_params, _ = self.run(self.actor_net, params.views, inputs, memory, starts)
        log_prob, _ = self.head.stats(dist_params, params.views.get("actor.log_std"), mask, action)
        importance = likelihood_ratio(log_prob, self._acted(rollout, cells, mask, action))
        # Values are those of the policy itself. Were they of its mixture with random choices,
        # waiting for these would seem to be worth something, and the policy alone would wait for
        # ever.
        own_share = None if terms.openness is None else importance.clamp_max(1.0)
        grid = gae(
            rollout.reward,
            rollout.discount,
            cells.grid(value),
            following,
            rollout.last,
            state.gae_lambda,
            None if own_share is None else cells.grid(own_share),
        )
        advantage = cells.flat(grid)
        returns = (advantage if own_share is None else own_share * advantage) + value
        metrics = {"explained_variance": explained_variance(value, returns, valid)}
        if cfg.normalize_returns:
            self.update_return_stats(state, returns, valid)
        mean, scale = state.return_mean, state.return_scale
        own = valid  # the samples whose action is the policy's own, not a reflex's
        if rollout.overridden is not None:
            free = ~cells.flat(rollout.overridden)
            own = free if valid is None else valid & free
        if cfg.normalize_advantage:
            advantage = normalize(advantage, own, min_std=cfg.min_advantage_std)
        if rollout.advantage is not None:  # of the stage, in the same units
            advantage = advantage + cells.flat(rollout.advantage)
        samples = Samples(
            inputs={} if memory is not None else inputs,
            action=action,
            log_prob=log_prob,
            importance=importance,
            advantage=advantage,
            reference=self._reference(terms, rollout, cells),
            target=(returns - mean) / scale,
            old_value=None if cfg.clip_value is None else (value - mean) / scale,
            mask=mask,
            valid=valid,
            own=own,
            most=cells.most,
        )
        if memory is not None:
            samples = samples.changed(cells.unflat)
            samples.inputs = inputs
            samples.memory = memory
            samples.starts = starts
        return samples, metrics

    def _reference(self, terms: Terms, rollout: Rollout, cells: Cells) -> Tensor | None:
        """Return dist_params (P, N, H) of the reference policy.

        A recurrent reference runs along each trajectory. Its recurrent state before the rollout's
        first row is unknown; the learner's, which is similar, takes its place.
        """
        if terms.reference is None:
            return None
        if terms.reference.params is None:
            return cells.flat_or_none(rollout.guide)
        params = terms.reference.params
        inputs = self.inputs(params, cells.flat(rollout.obs))
        if not self.memory_size:
            return self.actor_net(params.views, inputs)
        inputs = {k: cells.unflat(v) for k, v in inputs.items()}
        memory, starts = rollout.recurrent_state, rollout.episode_start
        return self.run(self.actor_net, params.views, inputs, memory, starts)[0]

    def _acted(self, rollout: Rollout, cells: Cells, mask: Tensor | None, action: Tensor) -> Tensor:
        """Return log-probabilities (P, N) of the actions under the policy that acted."""
        assert rollout.dist_params is not None
        log_std = rollout.log_std
        if log_std is not None:
            single = log_std.shape[2] == 1
            log_std = (
                log_std[:, 0] if single else cells.flat(log_std.expand(-1, cells.shape[0], -1, -1))
            )
        return self.head.stats(cells.flat(rollout.dist_params), log_std, mask, action)[0]

    def next_values(
        self,
        state: State,
        params: ActingParams,
        rollout: Rollout,
        value: Tensor,
        after: Tensor | None,
    ) -> Tensor:
        """Return V(next_obs), (P, T, B): the next row's V(obs), (P, T, B), except at ends.

        Args:
            after: (P, T·B, M), the critic's recurrent state after each row, if it has one.
        """

        def at_ends(rows: Tensor) -> Tensor:
            """Return the critic's values of the successors in these rows, in units of reward."""
            inputs = self.inputs(params, take_rows(rollout.next_obs.flatten(1, 2), rows))
            if after is None:
                raw = self.critic_net(params.views, inputs)
            else:
                raw, _ = self.critic_net.step(params.views, inputs, take_rows(after, rows))
            return self.in_rewards(state, raw)

        return values_after(value, rollout.last, at_ends)


@dataclass(slots=True)
class RehearsalRows:
    """B observations of a rehearsal for each of P members."""

    inputs: Inputs
    dist_params: Tensor  # (P, B, H), of the earlier policy
    log_std: Tensor | None  # (P, 1, A), of the earlier policy


@dataclass
class Terms:
    """The loss terms of one update that schedules and the stage determine."""

    rate: Tensor  # (P,), Adam's step size
    ent_coef: Tensor  # (P,)
    reference: Reference | None
    openness: Tensor | None  # (P,), cost of a nat of KL from uniform choices; None: no epsilon
    critic_alone: bool = False  # the policy stays as it is
    rehearsal: RehearsalRows | None = None  # of the present minibatch

    @classmethod
    def of(cls, config: PPO, state: Any, rollout: Rollout) -> Terms:
        """Return the terms of an update from this rollout."""
        progress = rollout.progress
        rate = rate_now(config, state.learning_rate, progress)
        if rollout.critic_alone and config.learning_rate_schedule == "kl":
            rate = torch.full_like(rate, CRITIC_RATE)
        ent_coef = state.ent_coef
        final = config.ent_coef_final
        if final is not None:
            ent_coef = torch.lerp(ent_coef, torch.full_like(ent_coef, final), progress)
        epsilon = epsilon_now(config, progress, rate)
        openness = None if epsilon is None else OPENNESS * epsilon.flatten()
        return cls(rate, ent_coef, rollout.reference, openness, rollout.critic_alone)
