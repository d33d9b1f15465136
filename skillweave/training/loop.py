"""The loop of all training: collect, store, learn, report, and write checkpoints.

Where the learner allows it, learning overlaps with collecting: while the learner updates on a
separate thread, the next batch is collected with the previous parameters. The lag is always exactly
one update, so a run is as reproducible as without overlap.

A checkpoint changes nothing: requests, updates and reports come in the same order with checkpoints
at any places, or with none. The next rows are already requested when a checkpoint is written, so it
also holds the parameters that collect them, and the metrics of an update without a report.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave._internal import interrupts
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Batch
from skillweave.experience.source import Source
from skillweave.ops.device import INT
from skillweave.ops.threads import WorkThread, torch_threads
from skillweave.spaces import to_tensor
from skillweave.training.episodes import Episodes, Tick, to_numbers
from skillweave.training.learner import Learner, crossed
from skillweave.types import Array, prefixed, unprefixed

CHECKPOINT_SECONDS = 60.0
"""Age of the latest checkpoint in seconds at which the next one is written."""
CHECKPOINT_SHARE = 0.05
"""The largest share of time for checkpoints by time; large ones are written less often."""


@dataclass
class Report:
    """Pending report of an update that has started."""

    update: int  # its number, from 1 on
    steps: int  # at its end
    due: bool  # it is written
    summary: dict[str, float]  # of the episodes, at its start


@dataclass
class Progress:
    """Counts and pending metrics of a stage's training."""

    update: int = 0
    steps: int = 0  # environment steps
    seconds: float = 0.0
    reported: int = 0
    """Environment steps at the latest report."""
    report: Report | None = None
    """Report of the latest update, until it is written."""
    metrics: dict[str, Tensor] = field(default_factory=dict)
    """Latest value of each metric, (P,), since the latest report."""

    def state(self) -> dict[str, Tensor]:
        """Return tensors for a checkpoint, beside ``update``, ``steps`` and ``seconds``."""
        report = self.report or Report(0, 0, False, {})
        numbers = [self.reported, report.update, report.steps, int(report.due)]
        summary = {
            k: torch.tensor(v, dtype=torch.float64, device="cpu") for k, v in report.summary.items()
        }
        metrics = {k: v.detach().cpu().clone() for k, v in self.metrics.items()}
        return (
            {"report": torch.tensor(numbers, **INT)}
            | prefixed("summary", summary)
            | prefixed("metrics", metrics)
        )

    def load(self, state: dict[str, Tensor]) -> None:
        """Restore a ``state``.

        Raises:
            ValueError: the tensors do not fit.
        """
        counts = state["report"]
        metrics = unprefixed("metrics", state)
        summary = unprefixed("summary", state)
        if counts.shape != (4,) or counts.dtype != torch.int64 or not bool((counts >= 0).all()):
            raise ValueError("its latest report is no row of four counts")
        reported, update, steps, due = counts.tolist()
        if reported > self.steps or steps > self.steps or update > self.update or due > 1:
            raise ValueError("its latest report is of a later time")
        if any(v.ndim != 1 or not v.is_floating_point() for v in metrics.values()):
            raise ValueError("its metrics are no rows of numbers")
        if any(v.ndim or v.dtype != torch.float64 for v in summary.values()):
            raise ValueError("its means of episodes are no numbers")
        self.reported = reported
        self.metrics = metrics
        means = {k: float(v) for k, v in summary.items()}
        self.report = Report(update, steps, bool(due), means) if update else None


@dataclass
class Saved:
    """Content of a checkpoint."""

    at: Progress
    states: list[Any]  # of each stack
    extra: dict[str, Tensor]  # environments, replay, and the rows that are requested


OnTick = Callable[[Tick], None]
OnCheckpoint = Callable[[Saved], None]
OnCalls = Callable[[Batch], None]


def train(
    learner: Learner,
    collectors: Source,
    episodes: Episodes,
    seeds: Seeds,
    budget: int,
    *,
    resume_from: Progress | None = None,
    schedule_steps: int | None = None,
    skip_diverged: bool = False,
    checkpoint_every: int = 250_000,
    on_tick: OnTick | None = None,
    on_checkpoint: OnCheckpoint | None = None,
    on_calls: OnCalls | None = None,
) -> Progress:
    """Train until the ``budget`` is spent; states of the learner change.

    Args:
        collectors: fresh or already started.
        episodes: the latest episodes, for the metrics; new ones are added.
        budget: environment steps.
        schedule_steps: the part of the budget at which schedules end; None: all of it.
        skip_diverged: continue where a member diverges.
        checkpoint_every: environment steps between checkpoints. They are also written by time
            (``CHECKPOINT_SECONDS``), and on an interrupt.
        on_tick: called with each report; may raise to stop.
        on_checkpoint: writes a checkpoint; None: the loop writes none, and ignores interrupts.
        on_calls: records the calls in new steps, where collectors return them.

    Returns:
        Counts at the end of training.

    Raises:
        TrainingError: parameters or losses are no longer finite.
        KeyboardInterrupt: after an interrupt, when a checkpoint is written.
    """
    loop = _Loop(learner, collectors, episodes, seeds, resume_from or Progress(), on_tick)
    loop.schedule_steps = schedule_steps or budget
    loop.skip_diverged = skip_diverged
    loop.checkpoint_every = checkpoint_every
    loop.on_checkpoint, loop.on_calls = on_checkpoint, on_calls
    with torch_threads(1 if learner.overlap else learner.threads):
        try:
            collectors.start(seeds / "start")
            loop.request()
            while loop.at.steps < budget:
                loop.round(budget)
            loop.report()
        finally:
            loop.close()
    return loop.at


class _Loop:
    """One stage's training."""

    schedule_steps: int
    skip_diverged: bool
    checkpoint_every: int
    on_checkpoint: OnCheckpoint | None
    on_calls: OnCalls | None

    def __init__(
        self,
        learner: Learner,
        collectors: Source,
        episodes: Episodes,
        seeds: Seeds,
        at: Progress,
        on_tick: OnTick | None,
    ) -> None:
        self.learner = learner
        self.collectors = collectors
        self.episodes = episodes
        self.seeds = seeds
        self.at = at
        self._on_tick = on_tick
        self._started = time.perf_counter() - at.seconds
        self._thread = WorkThread("learner", learner.threads)
        self._pending: Future[dict[str, Tensor]] | None = None
        self._saved_at = time.perf_counter()
        self._saving_took = 0.0

    def round(self, budget: int) -> None:
        """Collect once, and learn from the result, or start to."""
        at, learner = self.at, self.learner
        collected = self.collectors.collect(self._request)
        if self.on_calls is not None and collected.calls is not None:
            self.on_calls(collected.calls)
        self.report()
        before, update = at.steps, at.update
        at.steps += collected.steps
        at.update += 1
        over = at.steps >= budget
        self.episodes.extend(collected.episodes, collected.info_keys, collected.longest)
        if len(collected.begun_anew):
            learner.cut(collected.begun_anew)
        learner.take(collected.batches)
        if learner.overlap and not over:
            self.request()  # before the parameters change
        every = learner.report_every
        self._start_update(update, not every or over or crossed(every, before, at.steps))
        if not learner.overlap:
            self.report()
            if not over:
                self.request()
        if not over:
            self._save_if_due(before)

    def request(self) -> None:
        """Prepare the next request with the present parameters."""
        at = self.at
        self._request = self.learner.request(at.update, at.steps, self._progress())

    def _start_update(self, update: int, due: bool) -> None:
        """Learn, on the thread if the learner overlaps; write a report later if it is due."""
        arguments = update, self.at.steps, self._progress()
        # The means of episodes are of this moment, whatever the length of the update.
        summary = self.episodes.summary() if due and self._on_tick is not None else {}
        self.at.report = Report(update + 1, self.at.steps, due, summary)
        if self.learner.overlap:
            self._pending = self._thread.submit(self.learner.learn, *arguments)
        else:
            self.at.metrics |= self.learner.learn(*arguments)

    def _finish_update(self) -> None:
        """Finish a pending update: wait for it, and keep its metrics."""
        if self._pending is not None:
            metrics = self._pending.result()
            self._pending = None
            self.at.metrics |= metrics

    def report(self) -> None:
        """Finish a pending update, and write its report."""
        self._finish_update()
        report = self.at.report
        self.at.report = None
        if report is None or not report.due:
            return
        self._take_time()
        metrics = to_numbers(self.at.metrics, report.update, skip_diverged=self.skip_diverged)
        since = self.at.reported
        self.at.reported = report.steps
        self.at.metrics = {}
        if self._on_tick is not None:
            state = [stack.state for stack in self.learner.stacks]
            metrics |= report.summary
            self._on_tick(Tick(report.update, report.steps, since, self.at.seconds, metrics, state))

    def close(self) -> None:
        """Stop after a pending update, as it changes states in place."""
        self._thread.close()

    def _progress(self) -> float:
        return min(1.0, self.at.steps / self.schedule_steps)

    def _take_time(self) -> None:
        self.at.seconds = time.perf_counter() - self._started

    def _save_if_due(self, before: int) -> None:
        """Write a checkpoint if it is due or after an interrupt; then stop for the interrupt."""
        if self.on_checkpoint is None:
            return
        stopping = interrupts.requested()
        if stopping or self.is_due(before):
            self._save()
        if stopping:
            interrupts.stop()

    def is_due(self, before: int) -> bool:
        """Return True if a checkpoint is due; ``before`` are the steps before this round."""
        age = time.perf_counter() - self._saved_at
        by_time = age > max(CHECKPOINT_SECONDS, self._saving_took / CHECKPOINT_SHARE)
        return by_time or crossed(self.checkpoint_every, before, self.at.steps)

    def _save(self) -> None:
        """Write a checkpoint; the request of the next rows stays open."""
        assert self.on_checkpoint is not None
        since = time.perf_counter()
        arrays = self.collectors.state()  # while the learner learns
        self._finish_update()
        if not all(bool(torch.isfinite(v).all()) for v in self.at.metrics.values()):
            return  # training has diverged, as the next report shows; keep the previous checkpoint
        differing = self.collectors.differing()
        if len(differing):
            self.learner.cut(differing)
        arrays |= prefixed("episodes", self.episodes.state())
        tensors = {k: to_tensor(np.array(v)) for k, v in arrays.items()}
        extra = prefixed("collector", tensors) | prefixed("learner", self.learner.kept())
        self._take_time()
        states = [stack.state for stack in self.learner.stacks]
        self.on_checkpoint(Saved(self.at, states, extra | prefixed("loop", self.at.state())))
        self._saved_at = time.perf_counter()
        self._saving_took = self._saved_at - since


def resume(
    learner: Learner,
    collectors: Source,
    episodes: Episodes,
    saved: dict[str, Tensor],
    at: Progress,
) -> Array:
    """Restore the state of a checkpoint; return environments (k,) that start new episodes.

    These environments did not repeat their episodes exactly.

    Args:
        saved: the checkpoint's ``extra``.
        at: its steps; the pending report is added.
    """
    arrays = {k: v.numpy() for k, v in unprefixed("collector", saved).items()}
    at.load(unprefixed("loop", saved))
    episodes.load(unprefixed("episodes", arrays))
    restarted = collectors.restore(arrays)
    learner.load(unprefixed("learner", saved))
    learner.cut(restarted)
    return restarted


def begin_episodes(
    learner: Learner,
    collectors: Source,
    saved: dict[str, Tensor],
    at: Progress,
    seeds: Seeds,
) -> None:
    """Continue a finished stage in new episodes.

    Args:
        saved: the ``extra`` of its final state.
        at: its steps.
        seeds: of the stage; the new episodes differ from those at its start.
    """
    at.reported = at.steps
    if learner_state := unprefixed("learner", saved):
        learner.load(learner_state)
        learner.cut(np.arange(collectors.num_envs))
    collectors.start(seeds / "continued" / at.steps)
