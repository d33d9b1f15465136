"""The loop of every off-policy algorithm: act, remember, learn from what is remembered.

A round is ``train_freq`` steps of every environment and the gradient steps that are due after
them. Budgets count environment steps; the update ratio counts transitions, which a selector has
one of for each decision.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.off_policy import OffPolicyAlgorithm
from skillweave.buffers.replay import ReplayBuffer
from skillweave.seeding import Seeds
from skillweave.training.episodes import Episodes, Tick, to_numbers
from skillweave.training.members import by_member, member_seeds, passed
from skillweave.types import Array, VecEnv

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
    )


def train_off_policy(
    algorithm: OffPolicyAlgorithm,
    env: VecEnv,
    state: Any,
    seeds: Seeds,
    budget: int,
    *,
    saved: dict[str, Tensor] | None = None,
    shared: bool = False,
    cut_every: int = 250_000,
    update: int = 0,
    steps: int = 0,
    seconds: float = 0.0,
    on_tick: Callable[[Tick], None] | None = None,
) -> Any:
    """Train until ``budget`` environment steps are spent; returns the state.

    Args:
        env: P·num_envs environments.
        saved: the replay buffer as a checkpoint left it (``Tick.extra``). Without, it is filled
            with ``learning_starts`` transitions before learning begins, or goes on.
        shared: members learn from what all of them did, not from their own alone.
        cut_every: environment steps between clean cuts, at which episodes in flight are
            truncated and environments restart from a seed of their own (contract 8).
        update, steps, seconds: where a resumed run stands: rounds, and a clean cut.
        on_tick: told every thousand steps; may raise to stop.

    Raises:
        SkillweaveError: parameters or losses are no longer finite.
    """
    started = time.perf_counter() - seconds
    members, saves = len(state.params), algorithm.config.save_buffer
    buffer = make_buffer(algorithm, env, members, shared=shared)
    if saved:
        buffer.load(saved)
    loop = _Loop(algorithm, env, state, seeds, budget, buffer)
    threads = torch.get_num_threads()
    torch.set_num_threads(algorithm.config.threads)
    try:
        loop.restart(update)
        while steps < budget:
            taken = loop.collect(update, steps)
            loop.learn(update, steps + taken)
            cut = passed(cut_every, steps, steps + taken) or steps + taken >= budget
            tick = cut or passed(REPORT_EVERY, steps, steps + taken)
            update, steps = update + 1, steps + taken
            if cut:
                buffer.cut()
            if tick and on_tick is not None:
                metrics = to_numbers(loop.metrics, update) | loop.episodes.summary()
                # The last checkpoint needs no buffer: there is nothing left to learn from it.
                extra = buffer.state() if cut and saves and steps < budget else None
                seconds = time.perf_counter() - started
                on_tick(Tick(update, steps, seconds, metrics, state, cut, extra))
            if cut and steps < budget:
                loop.restart(update)
    finally:
        torch.set_num_threads(threads)
    return state


class _Loop:
    """One environment, what acts in it, and what it learns from, a round at a time."""

    def __init__(
        self,
        algorithm: OffPolicyAlgorithm,
        env: VecEnv,
        state: Any,
        seeds: Seeds,
        budget: int,
        buffer: ReplayBuffer,
    ) -> None:
        self.algorithm, self.env, self.state, self.seeds = algorithm, env, state, seeds
        self.budget, self.buffer = budget, buffer
        self.members = len(state.params)
        self._each = env.num_envs // self.members
        self.episodes = Episodes()
        self.metrics: dict[str, Tensor] = {}
        self._obs: Array = np.empty(0)
        self._returns = np.zeros(env.num_envs, np.float32)

    def restart(self, update: int) -> None:
        """Start every environment anew from a seed of this round's."""
        self._obs = self.env.reset(self.seeds / "restart" / update)
        self._returns[:] = 0.0
        self.episodes.cut()

    @torch.no_grad()
    def collect(self, update: int, steps: int) -> int:
        """Act ``train_freq`` times in every environment; the environment steps it took."""
        algorithm, env, cfg = self.algorithm, self.env, self.algorithm.config
        spent = 0
        actor = algorithm.actor(self.state, min(1.0, steps / self.budget))
        seeds = member_seeds(self.seeds, "act", self.members, update)
        generators = [s.torch() for s in seeds]
        noises = algorithm.noise(generators, cfg.train_freq, self._each)
        # A resumed run whose buffer was not saved fills it by what it has learnt already.
        at_random = update * self._round < cfg.learning_starts
        mask = env.mask()
        for noise in noises:
            obs = self._obs
            rows = by_member(obs, self.members)
            allowed = None if mask is None else by_member(mask, self.members)
            if at_random:
                chosen = algorithm.random_actions(generators, self._each, allowed)
            else:
                chosen, _, _ = algorithm.act(actor, rows, allowed, noise)
            action = chosen.flatten(0, 1).numpy()
            step = env.step(algorithm.to_env(action))
            self.buffer.add(obs, mask, action, step)
            self.episodes.add(step)
            self._see(rows, step)
            self._obs, mask = step.obs, step.mask
            spent += int(step.steps.sum())
        return spent

    @property
    def _round(self) -> int:
        """Transitions of a member in a round."""
        return int(self.algorithm.config.train_freq) * self._each

    def _see(self, rows: Tensor, step: Any) -> None:
        """Keep the running scales of observations and returns."""
        algorithm = self.algorithm
        algorithm.see(self.state, rows)
        if algorithm.config.normalize_rewards:
            gamma = np.repeat(self.state.gamma.numpy(), self._each)
            now = self._returns * gamma**step.steps + step.reward
            self._returns = now.astype(np.float32)  # a power of integers has 64 bits
            algorithm.see_returns(self.state, by_member(self._returns, self.members))
            self._returns[step.ended] = 0.0

    def learn(self, update: int, steps: int) -> None:
        """Make the gradient steps that are due after this round."""
        cfg, algorithm = self.algorithm.config, self.algorithm
        due = self._owed(update + 1) - self._owed(update)
        own = len(self.buffer) // self.members
        if not due or own < min(cfg.learning_starts, self.buffer.capacity // self.members // 2):
            return
        progress = min(1.0, steps / self.budget)
        beta = cfg.priority_beta + progress * (1.0 - cfg.priority_beta)
        seeds = member_seeds(self.seeds, "learn", self.members, update)
        rngs, generators = [s.numpy() for s in seeds], [s.torch() for s in seeds]
        # Several draws at once cost little more than one, but priorities change in between.
        together = 1 if cfg.prioritized else TOGETHER
        for first in range(0, due, together):
            size = cfg.batch_size * min(together, due - first)
            drawn = self.buffer.sample(size, self.state.gamma, rngs, beta)
            for sample in drawn.split(cfg.batch_size):
                self.metrics, error = algorithm.update(self.state, sample, progress, generators)
                if cfg.prioritized:
                    self.buffer.update_priorities(sample.index, error)

    def _owed(self, update: int) -> int:
        """Gradient steps that are due once ``update`` rounds are over."""
        cfg = self.algorithm.config
        return max(0, int((update * self._round - cfg.learning_starts) * cfg.update_ratio))
