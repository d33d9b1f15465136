"""The loop of all training: collect, keep, learn, report, and now and then a clean cut.

Where the learner may, learning overlaps with collecting: while it learns from one experience on a
thread of its own, the next one is collected with the parameters from before. The lag is always
exactly one update, so a run is as reproducible as without it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from skillweave.collecting.group import Collectors
from skillweave.ops.threads import torch_threads
from skillweave.seeding import Seeds
from skillweave.spaces import to_tensor
from skillweave.training.episodes import Episodes, Tick, to_numbers
from skillweave.training.learner import Learner, crossed
from skillweave.types import Array, prefixed, unprefixed


@dataclass
class Progress:
    """Where training stands: a clean cut, or the start."""

    update: int = 0
    steps: int = 0  # environment steps
    seconds: float = 0.0


OnTick = Callable[[Tick], None]


def train(
    learner: Learner,
    collectors: Collectors,
    episodes: Episodes,
    seeds: Seeds,
    budget: int,
    *,
    resume_from: Progress | None = None,
    schedule_steps: int | None = None,
    skip_diverged: bool = False,
    cut_every: int = 250_000,
    on_tick: OnTick | None = None,
) -> Progress:
    """Train until ``budget`` environment steps are spent; states of the learner change.

    Args:
        collectors: fresh or under way.
        episodes: the latest ones, for the metrics; added to.
        schedule_steps: steps at which schedules end; None: the budget.
        skip_diverged: a member that diverges does not stop the others.
        cut_every: environment steps between clean cuts (contract 8).
        on_tick: told after updates; may raise to stop.

    Returns:
        Where training stands.

    Raises:
        SkillweaveError: parameters or losses are no longer finite.
    """
    loop = _Loop(learner, collectors, episodes, seeds, resume_from or Progress(), on_tick)
    loop.schedule_steps, loop.skip_diverged = schedule_steps or budget, skip_diverged
    with torch_threads(1 if learner.overlap else learner.threads):
        try:
            collectors.start(seeds / "start")
            loop.ask()
            while loop.at.steps < budget:
                loop.round(budget, cut_every)
        finally:
            loop.close()
    return loop.at


class _Loop:
    """One stage's training under way."""

    schedule_steps: int
    skip_diverged: bool

    def __init__(
        self,
        learner: Learner,
        collectors: Collectors,
        episodes: Episodes,
        seeds: Seeds,
        at: Progress,
        on_tick: OnTick | None,
    ) -> None:
        self.learner, self.collectors, self.episodes, self.seeds = (
            learner, collectors, episodes, seeds,
        )  # fmt: skip
        self.at, self._on_tick = at, on_tick
        self._started = time.perf_counter() - at.seconds
        self._metrics: dict[str, Tensor] = {}
        self._summary: dict[str, float] = {}
        set_threads = torch.set_num_threads  # torch counts threads for each thread
        self._thread = ThreadPoolExecutor(1, "learner", set_threads, (learner.threads,))
        self._pending: Future[dict[str, Tensor]] | None = None
        self._told = 0, 0, False
        """The pending update's number, the steps when it is done, and whether it is reported."""

    def round(self, budget: int, cut_every: int) -> None:
        """Collect, and learn from it, or begin to."""
        at, learner = self.at, self.learner
        collected = self.collectors.collect(self._request)
        self.wait()
        before, at.steps = at.steps, at.steps + collected.experience.spent
        update, at.update = at.update, at.update + 1
        over = at.steps >= budget
        cut = crossed(cut_every, before, at.steps) or over
        self.episodes.extend(collected.episodes)
        if len(collected.begun_anew):
            learner.cut(collected.begun_anew)
        learner.take(collected.experience)
        if learner.overlap and not cut:
            self.ask()  # before the parameters change
        every = learner.report_every
        self._begin(update, not every or cut or crossed(every, before, at.steps))
        if cut or not learner.overlap:
            self.wait(cut, self._cut() if cut and not over else None)
            if not over:
                self.ask()

    def ask(self) -> None:
        """Say what is to be collected next, with the parameters as they are now."""
        at = self.at
        self._request = self.learner.request(at.update, at.steps, self._progress(at.steps))

    def _begin(self, update: int, due: bool) -> None:
        """Learn, on the thread if it may overlap; the update is reported if that is due."""
        about = update, self.at.steps, self._progress(self.at.steps)
        self._told = update + 1, self.at.steps, due
        if self.learner.overlap:
            self._summary = self.episodes.summary() if due else {}
            self._pending = self._thread.submit(self.learner.learn, *about)
        else:
            self._pending = Future()
            self._pending.set_result(self.learner.learn(*about))

    def wait(self, cut: bool = False, kept: dict[str, Tensor] | None = None) -> None:
        """Let a pending update end, and report it."""
        if self._pending is None:
            return
        found, self._pending = self._pending.result(), None
        self._metrics |= found
        update, steps, due = self._told
        if not due:
            return
        self.at.seconds = time.perf_counter() - self._started
        metrics = to_numbers(self._metrics, update, skip_diverged=self.skip_diverged)
        self._metrics = {}
        if self._on_tick is None:
            return
        # Those of the episodes are from when the update began, where it was not waited for.
        metrics |= self._summary if self.learner.overlap else self.episodes.summary()
        state = [stack.state for stack in self.learner.stacks]
        self._on_tick(Tick(update, steps, self.at.seconds, metrics, state, cut, kept))

    def close(self) -> None:
        """Stop; a pending update is finished first, as it changes states in place."""
        self._thread.shutdown(wait=True)

    def _progress(self, steps: int) -> float:
        return min(1.0, steps / self.schedule_steps)

    def _cut(self) -> dict[str, Tensor]:
        """Make a clean cut; what going on from it needs beside the states of the stacks."""
        if self._pending is not None:
            self._pending.result()
        self.learner.cut(self.collectors.cut(self.seeds / "cut" / self.at.update))
        found = self.collectors.state() | prefixed("episodes", self.episodes.state())
        self.learner.cut(self.collectors.differing())
        tensors = {k: to_tensor(np.array(v)) for k, v in found.items()}
        return prefixed("collector", tensors) | prefixed("learner", self.learner.kept())


def resume(
    learner: Learner, collectors: Collectors, episodes: Episodes, saved: dict[str, Tensor]
) -> Array:
    """Stand where a clean cut left everything; (k,) environments that begin anew.

    They are those that did not repeat themselves.
    """
    arrays = {k: v.numpy() for k, v in unprefixed("collector", saved).items()}
    episodes.load(unprefixed("episodes", arrays))
    begun = collectors.restore(arrays)
    learner.load(unprefixed("learner", saved))
    learner.cut(begun)
    return begun
