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

import numpy as np
import torch
from torch import Tensor

from skillweave._internal import interrupts
from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Batch
from skillweave.experience.group import CollectorGroup
from skillweave.ops.device import INT
from skillweave.ops.threads import WorkThread, torch_threads
from skillweave.policies.core import Array
from skillweave.spaces import to_tensor
from skillweave.training.episodes import Episodes, Tick, to_numbers
from skillweave.training.learner import Learner, crossed

CHECKPOINT_SECONDS = 60.0
"""Age of the latest checkpoint in seconds at which the next one is written."""
CHECKPOINT_SHARE = 0.05
"""The largest share of time for checkpoints by time; large ones are written less often."""


@dataclass
class PendingReport:
    """Pending report of an update that has started."""

    update: int  # its number, from 1 on
    steps: int  # at its end
    due: bool  # it is written
    summary: dict[str, float]  # of the episodes, at its start


@dataclass
class LoopState:
    """Counts and pending metrics of a stage's training."""

    update: int = 0
    steps: int = 0  # environment steps
    seconds: float = 0.0
    reported: int = 0
    """Environment steps at the latest report."""
    report: PendingReport | None = None
    """Report of the latest update, until it is written."""
    metrics: dict[str, Tensor] = field(default_factory=dict)
    """Latest value of each metric, (P,), since the latest report."""

    def state(self) -> dict[str, Tensor]:
        """Return tensors for a checkpoint, beside ``update``, ``steps`` and ``seconds``."""
        report = self.report or PendingReport(0, 0, False, {})
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
        """Restore a ``state``."""
        reported, update, steps, due = state["report"].tolist()
        self.reported = reported
        self.metrics = unprefixed("metrics", state)
        means = {k: float(v) for k, v in unprefixed("summary", state).items()}
        self.report = PendingReport(update, steps, bool(due), means) if update else None


@dataclass
class Saved:
    """Content of a checkpoint, beside the states of the stacks."""

    at: LoopState
    extra: dict[str, Tensor]  # environments, replay, and the rows that are requested


@dataclass
class Loop:
    """One stage's training; states of the learner change."""

    learner: Learner
    collectors: CollectorGroup
    """Fresh or already started."""
    episodes: Episodes
    """The latest episodes, for the metrics; new ones are added."""
    seeds: Seeds
    budget: int
    """Environment steps."""
    at: LoopState = field(default_factory=LoopState)
    """The counts so far."""
    schedule_steps: int | None = None
    """The part of the budget at which schedules end; None: all of it."""
    skip_diverged: bool = False
    """Continue where a member diverges."""
    checkpoint_every: int = 250_000
    """Environment steps between checkpoints. They are also written by time
    (``CHECKPOINT_SECONDS``), and on an interrupt."""
    on_tick: Callable[[Tick], None] | None = None
    """Called with each report; may call ``end``."""
    on_checkpoint: Callable[[Saved], None] | None = None
    """Writes a checkpoint; may call ``end``. None: the loop writes none, and ignores interrupts."""
    on_calls: Callable[[Batch], None] | None = None
    """Records the calls in new steps, where collectors return them."""
    ended: bool = False
    """``end`` was called."""

    def end(self) -> None:
        """Learn no more, whatever is left of the budget; ``run`` then returns."""
        self.ended = True

    def restore(self, saved: dict[str, Tensor]) -> Array:
        """Continue from a checkpoint, or in new episodes from the final state of a stage.

        Args:
            saved: the ``extra`` of one of these; the steps in ``at`` are those at that time.

        Returns:
            (k,) environments that start new episodes, as they did not repeat theirs exactly.
        """
        arrays = {k: v.numpy() for k, v in unprefixed("collector", saved).items()}
        of_learner = unprefixed("learner", saved)
        if not arrays:
            self.at.reported = self.at.steps
            if of_learner:
                self.learner.load(of_learner)
                self.learner.cut(np.arange(self.collectors.num_envs))
            self.collectors.start(self.seeds / "continued" / self.at.steps)
            return np.empty(0, np.int64)
        self.at.load(unprefixed("loop", saved))
        self.episodes.load(unprefixed("episodes", arrays))
        restarted = self.collectors.restore(arrays)
        self.learner.load(of_learner)
        self.learner.cut(restarted)
        return restarted

    def run(self) -> LoopState:
        """Train until the ``budget`` is spent, or ``end`` is called; return the counts at the end.

        Raises:
            TrainingError: parameters or losses are no longer finite.
            KeyboardInterrupt: after an interrupt, when a checkpoint is written.
        """
        learner = self.learner
        self._saved_at = time.perf_counter()
        self._saving_took = 0.0
        self._started = self._saved_at - self.at.seconds
        self._thread = WorkThread("learner", learner.threads)
        self._pending: Future[dict[str, Tensor]] | None = None
        with torch_threads(1 if learner.overlap else learner.threads):
            try:
                self.collectors.start(self.seeds / "start")
                self._request()
                while self.at.steps < self.budget and not self.ended:
                    self._round()
                if not self.ended:
                    self._report()
            finally:
                self._thread.close()  # after a pending update, as it changes states in place
        return self.at

    def _round(self) -> None:
        """Collect the rows of one request, and learn from them, or start to."""
        at, learner = self.at, self.learner
        collected = self.collectors.collect(self._requested)
        if self.on_calls is not None and collected.calls is not None:
            self.on_calls(collected.calls)
        self._report()
        if self.ended:
            return
        before, update = at.steps, at.update
        at.steps += collected.steps
        at.update += 1
        over = at.steps >= self.budget
        self.episodes.extend(collected.episodes, collected.info_keys, collected.longest)
        if len(collected.restarted):
            learner.cut(collected.restarted)
        learner.take(collected.batches)
        if learner.overlap and not over:
            self._request()  # before the parameters change
        every = learner.report_every
        self._start_update(update, not every or over or crossed(every, before, at.steps))
        if not learner.overlap:
            self._report()
            if self.ended:
                return
            if not over:
                self._request()
        if not over:
            self._save_if_due(before)

    def _request(self) -> None:
        """Prepare the next request with the present parameters."""
        at = self.at
        self._requested = self.learner.request(at.update, at.steps, self._progress())

    def _start_update(self, update: int, due: bool) -> None:
        """Learn, on the thread if the learner overlaps; write a report later if it is due."""
        arguments = update, self.at.steps, self._progress()
        # The means of episodes are of this moment, whatever the length of the update.
        summary = self.episodes.summary() if due and self.on_tick is not None else {}
        self.at.report = PendingReport(update + 1, self.at.steps, due, summary)
        if self.learner.overlap:
            self._pending = self._thread.submit(self.learner.learn, *arguments)
        else:
            self.at.metrics |= self.learner.learn(*arguments)

    def _finish_update(self) -> None:
        """Finish a pending update: wait for it, and keep its metrics."""
        if (pending := self._pending) is not None:
            self._pending = None
            self.at.metrics |= pending.result()

    def _report(self) -> None:
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
        if self.on_tick is not None:
            metrics |= report.summary
            self.on_tick(Tick(report.update, report.steps, since, self.at.seconds, metrics))

    def _progress(self) -> float:
        return min(1.0, self.at.steps / (self.schedule_steps or self.budget))

    def _take_time(self) -> None:
        self.at.seconds = time.perf_counter() - self._started

    def _save_if_due(self, before: int) -> None:
        """Write a checkpoint if it is due or after an interrupt; then stop for the interrupt."""
        if self.on_checkpoint is None:
            return
        stopping = interrupts.requested()
        if stopping or self.is_due(before):
            self._save()
        if stopping and not self.ended:
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
        restarted = self.collectors.take_restarted()
        if len(restarted):
            self.learner.cut(restarted)
        arrays |= prefixed("episodes", self.episodes.state())
        tensors = {k: to_tensor(np.array(v)) for k, v in arrays.items()}
        extra = prefixed("collector", tensors) | prefixed("learner", self.learner.kept())
        self._take_time()
        self.on_checkpoint(Saved(self.at, extra | prefixed("loop", self.at.state())))
        self._saved_at = time.perf_counter()
        self._saving_took = self._saved_at - since
