"""The loop of every off-policy algorithm: act, remember, learn from what is remembered.

A round is ``train_freq`` steps of every environment and the gradient steps that are due after
them. Budgets and ``learning_starts`` count environment steps; the update ratio counts transitions,
which a selector has one of for each decision.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.config import OffPolicy
from skillweave.algorithms.off_policy import OffPolicyAlgorithm
from skillweave.buffers.replay import ReplayBuffer
from skillweave.ops.threads import torch_threads
from skillweave.seeding import Seeds
from skillweave.training.collector import Collector
from skillweave.training.episodes import Tick, to_numbers
from skillweave.training.members import Stack, by_member, member_seeds, passed
from skillweave.types import Array, VecEnv, prefixed

REPORT_EVERY = 1_000
"""Environment steps between reports."""
TOGETHER = 8
"""Gradient steps whose samples are drawn at once."""


def make_buffer(
    algorithm: OffPolicyAlgorithm, env: VecEnv, members: int, *, shared: bool = False
) -> ReplayBuffer:
    """An empty replay buffer as the settings ask for.

    Raises:
        SkillweaveError: it is larger than the machine's memory.
    """
    cfg, codec = algorithm.config, algorithm.codec
    return ReplayBuffer(
        cfg.buffer_size * (1 if shared else members),
        env.num_envs,
        members,
        env.observation_space,
        () if codec.discrete else (codec.size,),
        np.int64 if codec.discrete else np.float32,
        mask_size=codec.size if codec.discrete else None,
        shared=shared,
        n_step=cfg.n_step,
        prioritized=cfg.prioritized,
        alpha=cfg.priority_alpha,
        between=algorithm.between,
    )


def train_off_policy(
    algorithm: OffPolicyAlgorithm,
    collector: Collector,
    state: Any,
    seeds: Seeds,
    budget: int,
    *,
    saved: dict[str, Tensor] | None = None,
    shared: bool = False,
    on_tick: Callable[[Tick], None] | None = None,
    **where: Any,
) -> Any:
    """Train one stack until ``budget`` environment steps are spent; returns the state.

    Args:
        collector: P·num_envs environments, fresh or under way.
        saved: the replay buffer as a checkpoint left it (``buffer.…`` of ``Tick.extra``). Without,
            ``learning_starts`` steps are taken before learning begins, or goes on.
        shared: members learn from what all of them did, not from their own alone.
        on_tick, where: as of ``train_stacks``.

    Raises:
        SkillweaveError: parameters or losses are no longer finite.
    """
    buffer = make_buffer(algorithm, collector.env, len(state.params), shared=shared)
    if saved:
        buffer.load(saved)
        buffer.cut(collector.begun_anew)

    def tell(tick: Tick) -> None:
        if on_tick is not None:
            on_tick(replace(tick, state=state))

    train_stacks([Stack(algorithm, state)], collector, seeds, budget, buffer, on_tick=tell, **where)
    return state


def train_stacks(
    stacks: Sequence[Stack],
    collector: Collector,
    seeds: Seeds,
    budget: int,
    buffer: ReplayBuffer,
    *,
    horizon: int | None = None,
    tolerant: bool = False,
    cut_every: int = 250_000,
    update: int = 0,
    steps: int = 0,
    seconds: float = 0.0,
    on_tick: Callable[[Tick], None] | None = None,
) -> None:
    """Train stacks side by side, in one environment and from one buffer, states in place.

    What shapes the experience (``num_envs``, ``train_freq``, ``n_step``, the buffer's settings)
    is that of the first stack.

    Args:
        collector: num_envs environments for each member, in the order of the stacks.
        horizon: steps at which schedules end; None: the budget.
        tolerant: a member that diverges does not stop the others.
        cut_every: environment steps between clean cuts (contract 8).
        update, steps, seconds: where a resumed run stands: rounds, and a clean cut.
        on_tick: told every thousand steps, with the stacks as its state; may raise to stop.

    Raises:
        SkillweaveError: parameters or losses are no longer finite.
    """
    started = time.perf_counter() - seconds
    config = stacks[0].algorithm.config
    loop = _Loop(stacks, collector, seeds, horizon or budget, buffer, steps)
    with torch_threads(config.threads):
        collector.start(seeds / "start")
        while steps < budget:
            loop.collect(update, steps)
            taken = collector.spent()
            loop.learn(update, steps + taken)
            over = steps + taken >= budget
            cut = passed(cut_every, steps, steps + taken) or over
            tick = cut or passed(REPORT_EVERY, steps, steps + taken)
            update, steps = update + 1, steps + taken
            # The last checkpoint needs no more: there is nothing left to learn.
            extra = loop.cut(update) if cut and not over else None
            steps += collector.spent()  # where an environment had to begin anew
            if tick and on_tick is not None:
                metrics = to_numbers(loop.metrics, update, tolerant=tolerant)
                loop.metrics = {}  # a line tells what was learnt since the one before
                seconds = time.perf_counter() - started
                metrics |= collector.episodes.summary()
                on_tick(Tick(update, steps, seconds, metrics, stacks, cut, extra))


class _Loop:
    """One environment, who acts in it, and what they learn from, a round at a time."""

    def __init__(
        self,
        stacks: Sequence[Stack],
        collector: Collector,
        seeds: Seeds,
        horizon: int,
        buffer: ReplayBuffer,
        steps: int,
    ) -> None:
        self.stacks, self.collector, self.seeds = stacks, collector, seeds
        self.horizon, self.buffer = horizon, buffer
        self.members = sum(s.members for s in stacks)
        self.config = stacks[0].algorithm.config
        self._each = collector.num_envs // self.members
        self._first = [0, *itertools.accumulate(s.members for s in stacks)]
        self._random_until = int(self.config.learning_starts) * self.members
        # A resumed run whose buffer was not saved fills it by what it has learnt already.
        self._learns_from = self._random_until + (0 if len(buffer) else steps)
        self.metrics: dict[str, Tensor] = {}
        self._returns = collector.carry("returns", np.zeros(collector.num_envs, np.float32))

    def cut(self, update: int) -> dict[str, Tensor]:
        """Make a clean cut; what resuming from it needs besides the states."""
        self.buffer.cut(self.collector.cut(self.seeds / "cut" / update))
        buffer = self.buffer.state() if self.config.save_buffer else {}
        return prefixed("collector", self.collector.state()) | prefixed("buffer", buffer)

    @torch.no_grad()
    def collect(self, update: int, steps: int) -> None:
        """Act ``train_freq`` times in every environment."""
        collector = self.collector
        actors = [_Actor(self, i, update, steps) for i in range(len(self.stacks))]
        for at in range(self.config.train_freq):
            obs, mask = collector.obs, collector.mask()
            chosen = [actor.act(obs, mask, at) for actor in actors]
            action = chosen[0] if len(chosen) == 1 else np.concatenate(chosen)
            step = collector.step(self.stacks[0].algorithm.to_env(action))
            self.buffer.add(obs, mask, action, step)
            self._see(obs, step)

    def rows(self, stack: int) -> slice:
        """The environments of a stack."""
        return slice(self._first[stack] * self._each, self._first[stack + 1] * self._each)

    def seeds_of(self, stack: int, name: str, update: int) -> list[Seeds]:
        """A node of the seed tree for each member of a stack."""
        members = self.stacks[stack].members
        return member_seeds(self.seeds, name, members, update, self._first[stack])

    def acts_at_random(self, steps: int) -> bool:
        """Whether it is too early to act by what was learnt."""
        return steps < self._random_until

    @property
    def _round(self) -> int:
        """Transitions of a member in a round."""
        return int(self.config.train_freq) * self._each

    def _see(self, obs: Array, step: Any) -> None:
        """Keep the running scales of observations and returns."""
        for i, stack in enumerate(self.stacks):
            algorithm, state, part = stack.algorithm, stack.state, self.rows(i)
            algorithm.update_obs_stats(state, by_member(obs[part], stack.members))
            if algorithm.scales_rewards:
                gamma = np.repeat(state.gamma.numpy(), self._each)
                now = self._returns[part] * gamma ** step.steps[part] + step.reward[part]
                self._returns[part] = now
                algorithm.update_return_stats(state, by_member(self._returns[part], stack.members))
        self._returns[step.ended] = 0.0

    def learn(self, update: int, steps: int) -> None:
        """Make the gradient steps that are due after this round."""
        if steps <= self._learns_from:
            return
        found = [self._learn(i, update, steps) for i in range(len(self.stacks))]
        if all(found):
            self.metrics = {k: torch.cat([m[k] for m in found]) for k in found[0]}

    def _learn(self, at: int, update: int, steps: int) -> dict[str, Tensor]:
        """A stack's gradient steps; the metrics (P,) of the last one, if there were any."""
        algorithm, state, first = self.stacks[at].algorithm, self.stacks[at].state, self._first[at]
        cfg = algorithm.config
        metrics: dict[str, Tensor] = {}
        due = self._owed(cfg, update + 1) - self._owed(cfg, update)
        if not due:
            return metrics
        progress = min(1.0, steps / self.horizon)
        beta = cfg.priority_beta + progress * (1.0 - cfg.priority_beta)
        seeds = self.seeds_of(at, "learn", update)
        rngs, generators = [s.numpy() for s in seeds], [s.torch() for s in seeds]
        # Several draws at once cost little more than one, but priorities change in between.
        together = 1 if cfg.prioritized else TOGETHER
        for done in range(0, due, together):
            size = cfg.batch_size * min(together, due - done)
            drawn = self.buffer.sample(size, state.gamma, rngs, beta, first)
            for sample in drawn.split(cfg.batch_size):
                sample.progress = progress
                _, report = algorithm.update(state, sample, generators)
                metrics = report.metrics
                if cfg.prioritized and report.error is not None:
                    self.buffer.update_priorities(sample.index, report.error, first)
        return metrics

    def _owed(self, config: OffPolicy, update: int) -> int:
        """Gradient steps that would be due once ``update`` rounds are over, had all been learnt."""
        return int(update * self._round * config.update_ratio)


class _Actor:
    """A stack that acts for a round: a copy of its parameters, and its noise."""

    def __init__(self, loop: _Loop, at: int, update: int, steps: int) -> None:
        self._stack, self._rows, self._each = loop.stacks[at], loop.rows(at), loop._each
        algorithm = self._stack.algorithm
        self._actor = algorithm.acting_params(self._stack.state, min(1.0, steps / loop.horizon))
        self._generators = [s.torch() for s in loop.seeds_of(at, "act", update)]
        self._noises = algorithm.noise(self._generators, loop.config.train_freq, loop._each)
        self._at_random = loop.acts_at_random(steps)

    def act(self, obs: Array, mask: Array | None, at: int) -> Array:
        """Actions of the stack's environments in policy units, given all environments' rows."""
        stack, algorithm = self._stack, self._stack.algorithm
        allowed = None if mask is None else by_member(mask[self._rows], stack.members)
        if self._at_random:
            chosen = algorithm.random_actions(self._generators, self._each, allowed)
        else:
            rows = by_member(obs[self._rows], stack.members)
            chosen, _, _ = algorithm.act(self._actor, rows, allowed, self._noises[at])
        # A member that has diverged must not spoil what all learn from.
        found: Array = chosen.flatten(0, 1).nan_to_num().numpy()
        return found
