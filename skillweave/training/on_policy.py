"""The loop of every on-policy algorithm: collect, learn, report, and now and then a clean cut.

Collecting and learning overlap: while a rollout is learnt from on one thread, the next one is
collected with the policy from before. The lag is always exactly one update, so a run is as
reproducible as without it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import torch

from skillweave.algorithms.base import Actor
from skillweave.algorithms.ppo import PPOAlgorithm, Rollout, State
from skillweave.buffers.rollout import RolloutBuffer
from skillweave.seeding import Seeds
from skillweave.training.episodes import Episodes, Tick, to_numbers
from skillweave.training.members import by_member, member_seeds, passed
from skillweave.types import Array, VecEnv


def train_on_policy(
    algorithm: PPOAlgorithm,
    env: VecEnv,
    state: State,
    seeds: Seeds,
    budget: int,
    *,
    horizon: int | None = None,
    tolerant: bool = False,
    cut_every: int = 250_000,
    update: int = 0,
    steps: int = 0,
    seconds: float = 0.0,
    on_tick: Callable[[Tick], None] | None = None,
) -> State:
    """Train until ``budget`` environment steps are spent.

    Args:
        env: P·num_envs environments.
        horizon: steps at which schedules end; None: the budget.
        tolerant: a member that diverges does not stop the others.
        cut_every: environment steps between clean cuts, at which episodes in flight are
            truncated and environments restart from a seed of their own (contract 8).
        update, steps, seconds: where a resumed run stands; a clean cut.
        on_tick: told after every update; may raise to stop.

    Raises:
        SkillweaveError: parameters or losses are no longer finite.
    """
    loop = _Loop(algorithm, env, seeds, members=len(state.params))
    started = time.perf_counter() - seconds
    learner = _Learner(algorithm, state, loop, horizon or budget, tolerant, on_tick, started)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        actor = algorithm.actor(state)
        loop.restart(update)
        while steps < budget:
            rollout, taken = loop.collect(actor, state, update)
            actor = learner.wait(actor)
            learner.start(rollout, update, steps, steps + taken)
            cut = passed(cut_every, steps, steps + taken) or steps + taken >= budget
            update, steps = update + 1, steps + taken
            if cut or not algorithm.config.overlap:
                actor = learner.wait(actor, cut)
                if cut and steps < budget:
                    loop.restart(update)
    finally:
        learner.close()
        torch.set_num_threads(threads)
    return state


class _Learner:
    """Learns from one rollout at a time, on a thread of its own."""

    def __init__(
        self,
        algorithm: PPOAlgorithm,
        state: State,
        loop: _Loop,
        horizon: int,
        tolerant: bool,
        on_tick: Callable[[Tick], None] | None,
        started: float,
    ) -> None:
        self.algorithm, self.state, self.loop, self.horizon = algorithm, state, loop, horizon
        self.tolerant, self.on_tick, self.started = tolerant, on_tick, started
        set_threads = torch.set_num_threads  # torch counts threads for each thread
        self._worker = ThreadPoolExecutor(1, "learner", set_threads, (algorithm.config.threads,))
        self._pending: Future[dict[str, float]] | None = None
        self._at = (0, 0)  # the pending update's number, and the steps when it is done

    def start(self, rollout: Rollout, update: int, before: int, after: int) -> None:
        """Begin to learn from a rollout that was collected from step ``before`` to ``after``."""
        self._at = (update + 1, after)
        self._pending = self._worker.submit(self._learn, rollout, update, before / self.horizon)

    def wait(self, actor: Actor, cut: bool = False) -> Actor:
        """Let a pending update end, report it, and return what acts from now on."""
        if self._pending is None:
            return actor
        metrics, self._pending = self._pending.result(), None
        if self.on_tick is not None:
            metrics |= self.loop.episodes.summary()
            elapsed = time.perf_counter() - self.started
            self.on_tick(Tick(*self._at, elapsed, metrics, self.state, cut))
        return self.algorithm.actor(self.state)

    def close(self) -> None:
        """Stop; a pending update is finished first, as it changes the state in place."""
        self._worker.shutdown(wait=True)

    def _learn(self, rollout: Rollout, update: int, progress: float) -> dict[str, float]:
        seeds = self.loop.member_seeds("learn", update)
        _, metrics = self.algorithm.update(self.state, rollout, min(1.0, progress), seeds)
        return to_numbers(metrics, update, tolerant=self.tolerant)


class _Loop:
    """One environment and the policy that acts in it, a rollout at a time."""

    def __init__(self, algorithm: PPOAlgorithm, env: VecEnv, seeds: Seeds, members: int) -> None:
        self.algorithm, self.env, self.seeds, self.members = algorithm, env, seeds, members
        self.episodes = Episodes()
        self._obs: Array = np.empty(0)
        self._memory: torch.Tensor | None = None

    def member_seeds(self, name: str, update: int) -> list[Seeds]:
        """A node of the seed tree for each member."""
        return member_seeds(self.seeds, name, self.members, update)

    def restart(self, update: int) -> None:
        """Start every environment anew from a seed of this update's."""
        self._obs = self.env.reset(self.seeds / "restart" / update)
        self.episodes.cut()
        if size := self.algorithm.memory:
            p = self.members
            self._memory = torch.zeros(p, self.env.num_envs // p, size)

    @torch.inference_mode()
    def collect(self, actor: Actor, state: State, update: int) -> tuple[Rollout, int]:
        """A rollout and the environment steps it took."""
        algorithm, env = self.algorithm, self.env
        t, n, p = algorithm.config.n_steps, env.num_envs, self.members
        buffer = RolloutBuffer(t, n, p, env.observation_space)
        generators = [s.torch() for s in self.member_seeds("act", update)]
        noises = algorithm.noise(generators, t, n // p)
        mask, spent, before = env.mask(), 0, self._memory
        starts = torch.zeros(p, t, n // p, dtype=torch.bool)
        for i, noise in enumerate(noises):
            obs = self._obs
            rows = by_member(obs, p)
            allowed = None if mask is None else by_member(mask, p)
            action, head, memory = algorithm.act(actor, rows, allowed, noise, self._memory)
            step = env.step(algorithm.to_env(action.flatten(0, 1).numpy()))
            buffer.add(obs, mask, action, head, step)
            self.episodes.add(step)
            self._obs, mask = step.obs, step.mask
            spent += int(step.steps.sum())
            if memory is not None:
                ended = torch.from_numpy(step.ended).view(p, -1)
                self._memory = memory * ~ended[..., None]
                if i + 1 < t:
                    starts[:, i + 1] = ended
        transition, head = buffer.read(state.gamma)
        log_std = actor.views.get("actor.log_std")
        log_std = None if log_std is None else log_std[:, None]
        return Rollout(transition, head, log_std, before, starts), spent
