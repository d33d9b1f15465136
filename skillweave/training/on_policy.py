"""The loop of every on-policy algorithm: collect, learn, report, and now and then a clean cut.

Collecting and learning overlap: while a rollout is learnt from on one thread, the next one is
collected with the policy from before. The lag is always exactly one update, so a run is as
reproducible as without it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from skillweave.algorithms.ppo import PPOAlgorithm, Rollout, State
from skillweave.buffers.rollout import RolloutBuffer
from skillweave.networks.actor import Actor
from skillweave.seeding import Seeds
from skillweave.types import Array, SkillweaveError, VecEnv, VecStep

WINDOW = 100  # episodes in the reported means


@dataclass
class Episodes:
    """Returns, lengths and successes of the latest episodes, for people to watch."""

    returns: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    task_returns: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    lengths: deque[int] = field(default_factory=lambda: deque(maxlen=WINDOW))
    successes: deque[bool] = field(default_factory=lambda: deque(maxlen=WINDOW))
    _sums: Array = field(default_factory=lambda: np.zeros((3, 0)))

    def add(self, step: VecStep) -> None:
        """Take one step of all environments into account."""
        n = len(step.reward)
        if self._sums.shape[1] != n:
            self._sums = np.zeros((3, n))
        # An options environment sums the undiscounted reward of a call apart.
        self._sums[0] += step.info.get("call_return", step.reward)
        if "task_reward" in step.info:
            self._sums[1] += step.info["task_reward"]
        self._sums[2] += step.steps
        ended = step.terminated | step.truncated
        if ended.any():
            for i in np.flatnonzero(ended):
                self.returns.append(float(self._sums[0, i]))
                if "task_reward" in step.info:
                    self.task_returns.append(float(self._sums[1, i]))
                self.lengths.append(int(self._sums[2, i]))
                if "success" in step.info:
                    self.successes.append(bool(step.info["success"][i]))
            self._sums[:, ended] = 0.0

    def cut(self) -> None:
        """Forget the episodes in flight."""
        self._sums[:] = 0.0

    def summary(self) -> dict[str, float]:
        """Means over the window; empty before the first episode ended."""
        named: dict[str, deque[Any]] = {
            "return": self.returns,
            "task_return": self.task_returns,
            "length": self.lengths,
            "success": self.successes,
        }
        return {k: float(np.mean(v)) for k, v in named.items() if v}


@dataclass
class Tick:
    """What the loop reports after each update."""

    update: int
    steps: int
    seconds: float  # of training, this process's part and those before it
    metrics: dict[str, float]
    state: State
    cut: bool  # a clean cut: resuming from this state is exact


def train_on_policy(
    algorithm: PPOAlgorithm,
    env: VecEnv,
    state: State,
    seeds: Seeds,
    budget: int,
    *,
    cut_every: int = 250_000,
    update: int = 0,
    steps: int = 0,
    seconds: float = 0.0,
    on_tick: Callable[[Tick], None] | None = None,
) -> State:
    """Train until ``budget`` environment steps are spent.

    Args:
        env: P·num_envs environments.
        cut_every: environment steps between clean cuts, at which episodes in flight are
            truncated and environments restart from a seed of their own (contract 8).
        update, steps, seconds: where a resumed run stands; a clean cut.
        on_tick: told after every update; may raise to stop.

    Raises:
        SkillweaveError: parameters or losses are no longer finite.
    """
    loop = _Loop(algorithm, env, seeds, members=len(state.params))
    learner = _Learner(algorithm, state, loop, budget, on_tick, time.perf_counter() - seconds)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        actor = algorithm.actor(state)
        loop.restart(update)
        while steps < budget:
            rollout, taken = loop.collect(actor, state, update)
            actor = learner.wait(actor)
            learner.start(rollout, update, steps, steps + taken)
            cut = (steps + taken) // cut_every > steps // cut_every or steps + taken >= budget
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
        budget: int,
        on_tick: Callable[[Tick], None] | None,
        started: float,
    ) -> None:
        self.algorithm, self.state, self.loop, self.budget = algorithm, state, loop, budget
        self.on_tick, self.started = on_tick, started
        set_threads = torch.set_num_threads  # torch counts threads for each thread
        self._worker = ThreadPoolExecutor(1, "learner", set_threads, (algorithm.config.threads,))
        self._pending: Future[dict[str, float]] | None = None
        self._at = (0, 0)  # the pending update's number, and the steps when it is done

    def start(self, rollout: Rollout, update: int, before: int, after: int) -> None:
        """Begin to learn from a rollout that was collected from step ``before`` to ``after``."""
        self._at = (update + 1, after)
        self._pending = self._worker.submit(self._learn, rollout, update, before / self.budget)

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
        return _to_numbers(metrics, update)


class _Loop:
    """One environment and the policy that acts in it, a rollout at a time."""

    def __init__(self, algorithm: PPOAlgorithm, env: VecEnv, seeds: Seeds, members: int) -> None:
        self.algorithm, self.env, self.seeds, self.members = algorithm, env, seeds, members
        self.episodes = Episodes()
        self._obs: Array = np.empty(0)

    def member_seeds(self, name: str, update: int) -> list[Seeds]:
        """A node of the seed tree for each member."""
        return [self.seeds / name / member / update for member in range(self.members)]

    def restart(self, update: int) -> None:
        """Start every environment anew from a seed of this update's."""
        self._obs = self.env.reset(self.seeds / "restart" / update)
        self.episodes.cut()

    @torch.inference_mode()
    def collect(self, actor: Actor, state: State, update: int) -> tuple[Rollout, int]:
        """A rollout and the environment steps it took."""
        algorithm, env = self.algorithm, self.env
        t, n, p = algorithm.config.n_steps, env.num_envs, self.members
        buffer = RolloutBuffer(t, n, p, env.observation_space)
        generators = [s.torch() for s in self.member_seeds("act", update)]
        noises = algorithm.net.head.noise(generators, t, n // p)
        mask, spent = env.mask(), 0
        for noise in noises:
            obs = self._obs
            rows = torch.from_numpy(obs).unflatten(0, (p, n // p))
            allowed = None if mask is None else torch.from_numpy(mask).unflatten(0, (p, n // p))
            action, head = algorithm.net.act(actor, rows, allowed, noise)
            step = env.step(algorithm.net.head.codec.to_env(action.flatten(0, 1).numpy()))
            buffer.add(obs, mask, action, head, step)
            self.episodes.add(step)
            self._obs, mask = step.obs, step.mask
            spent += int(step.steps.sum())
        transition, head = buffer.read(state.gamma)
        log_std = actor.views.get("actor.log_std")
        return Rollout(transition, head, None if log_std is None else log_std[:, None]), spent


def _to_numbers(metrics: dict[str, Any], update: int) -> dict[str, float]:
    """Member means; a value that is not finite stops the run, saying which and where."""
    numbers = {}
    for name, value in metrics.items():
        finite = torch.isfinite(value)
        if not bool(finite.all()):
            member = int((~finite).nonzero()[0])
            raise SkillweaveError(
                f"{name} of member {member} is {float(value[member])} at update {update}: training "
                "has diverged. Lower learning_rate or max_grad_norm; the last checkpoint is intact"
            )
        numbers[name] = float(value.mean())
    return numbers
