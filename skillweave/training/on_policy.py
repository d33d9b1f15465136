"""The loop of every on-policy algorithm: collect, learn, report, and now and then a clean cut.

Collecting and learning overlap: while a rollout is learnt from on one thread, the next one is
collected with the policy from before. The lag is always exactly one update, so a run is as
reproducible as without it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.base import ActingParams, Algorithm
from skillweave.buffers.rollout import RolloutBuffer
from skillweave.experience import Rollout
from skillweave.ops.threads import torch_threads
from skillweave.seeding import Seeds
from skillweave.training.collector import Collector
from skillweave.training.episodes import Tick, to_numbers
from skillweave.training.members import by_member, member_seeds, passed
from skillweave.types import prefixed


@torch_threads(1)
def train_on_policy(
    algorithm: Algorithm,
    collector: Collector,
    state: Any,
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
) -> Any:
    """Train until ``budget`` environment steps are spent.

    Args:
        collector: P·num_envs environments, fresh or under way.
        horizon: steps at which schedules end; None: the budget.
        tolerant: a member that diverges does not stop the others.
        cut_every: environment steps between clean cuts (contract 8).
        update, steps, seconds: where a resumed run stands; a clean cut.
        on_tick: told after every update; may raise to stop.

    Raises:
        SkillweaveError: parameters or losses are no longer finite.
    """
    loop = _Loop(algorithm, collector, seeds, members=len(state.params))
    started = time.perf_counter() - seconds
    learner = _Learner(algorithm, state, loop, horizon or budget, tolerant, on_tick, started)
    try:
        actor = algorithm.acting_params(state)
        collector.start(seeds / "start")
        while steps < budget:
            rollout = loop.collect(actor, state, update)
            taken = collector.spent()
            actor = learner.wait(actor)
            learner.start(rollout, update, steps, steps + taken)
            over = steps + taken >= budget
            cut = passed(cut_every, steps, steps + taken) or over
            update, steps = update + 1, steps + taken
            if cut or not algorithm.config.overlap:
                extra = loop.cut(update) if cut and not over else None
                steps += collector.spent()  # where an environment had to begin anew
                actor = learner.wait(actor, cut, extra, steps)
    finally:
        learner.close()
    return state


class _Learner:
    """Learns from one rollout at a time, on a thread of its own."""

    def __init__(
        self,
        algorithm: Algorithm,
        state: Any,
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
        self._told: dict[str, float] = {}  # of the episodes, when its rollout was complete

    def start(self, rollout: Rollout, update: int, before: int, after: int) -> None:
        """Begin to learn from a rollout that was collected from step ``before`` to ``after``."""
        self._at = (update + 1, after)
        self._told = self.loop.collector.episodes.summary()
        self._pending = self._worker.submit(self._learn, rollout, update, before / self.horizon)

    def wait(
        self,
        actor: ActingParams,
        cut: bool = False,
        extra: dict[str, Tensor] | None = None,
        steps: int | None = None,
    ) -> ActingParams:
        """Let a pending update end, report it, and return what acts from now on.

        Args:
            cut, extra: of the ``Tick``.
            steps: taken so far; None: as many as when its rollout was complete.
        """
        if self._pending is None:
            return actor
        metrics, self._pending = self._pending.result(), None
        if self.on_tick is not None:
            metrics |= self._told
            elapsed = time.perf_counter() - self.started
            update, before = self._at
            steps = before if steps is None else steps
            self.on_tick(Tick(update, steps, elapsed, metrics, self.state, cut, extra))
        return self.algorithm.acting_params(self.state)

    def close(self) -> None:
        """Stop; a pending update is finished first, as it changes the state in place."""
        self._worker.shutdown(wait=True)

    def _learn(self, rollout: Rollout, update: int, progress: float) -> dict[str, float]:
        rng = [s.torch() for s in self.loop.member_seeds("learn", update)]
        rollout = replace(rollout, progress=min(1.0, progress))
        _, report = self.algorithm.update(self.state, rollout, rng)
        return to_numbers(report.metrics, update, tolerant=self.tolerant)


class _Loop:
    """Environments and the policy that acts in them, a rollout at a time."""

    def __init__(
        self, algorithm: Algorithm, collector: Collector, seeds: Seeds, members: int
    ) -> None:
        self.algorithm, self.collector = algorithm, collector
        self.seeds, self.members = seeds, members

    def member_seeds(self, name: str, update: int) -> list[Seeds]:
        """A node of the seed tree for each member."""
        return member_seeds(self.seeds, name, self.members, update)

    def cut(self, update: int) -> dict[str, Tensor]:
        """Make a clean cut; what resuming from it needs of the environments."""
        self.collector.cut(self.seeds / "cut" / update)
        return prefixed("collector", self.collector.state())

    @torch.no_grad()  # not inference_mode: learning may differentiate through the batch
    def collect(self, actor: ActingParams, state: Any, update: int) -> Rollout:
        """A rollout of ``n_steps`` environment steps of each environment.

        Where actions last several steps it has fewer of them, and may last longer by one.
        """
        algorithm, collector, p = self.algorithm, self.collector, self.members
        t, n = algorithm.config.n_steps, collector.num_envs
        buffer = RolloutBuffer(t, n, p, collector.env.observation_space)
        generators = [s.torch() for s in self.member_seeds("act", update)]
        noises = algorithm.noise(generators, t, n // p)
        memory = self._memory()
        before = None if memory is None else memory.clone()
        starts = torch.zeros(p, t, n // p, dtype=torch.bool)
        spent = 0
        for i, noise in enumerate(noises):
            obs, mask = collector.obs, collector.mask()
            rows = by_member(obs, p)
            allowed = None if mask is None else by_member(mask, p)
            action, head, after = algorithm.act(actor, rows, allowed, noise, memory)
            assert head is not None
            step = collector.step(algorithm.to_env(action.flatten(0, 1).numpy()))
            buffer.add(obs, mask, action, head, step)
            spent += int(step.steps.sum())
            if memory is not None and after is not None:
                ended = torch.from_numpy(step.ended).view(p, -1)
                memory.copy_(after * ~ended[..., None])
                if i + 1 < t:
                    starts[:, i + 1] = ended
            if spent >= t * n:
                break
        rollout = buffer.read(state.gamma)
        log_std = actor.views.get("actor.log_std")
        log_std = None if log_std is None else log_std[:, None]
        starts = starts[:, : rollout.reward.shape[1]]
        return replace(rollout, log_std=log_std, memory=before, starts=starts)

    def _memory(self) -> Tensor | None:
        """What the network remembers of each environment, (P, B, M), kept by the collector."""
        if not (size := self.algorithm.memory_size):
            return None
        kept = self.collector.carry("memory", np.zeros((self.collector.num_envs, size), np.float32))
        return by_member(kept, self.members)
