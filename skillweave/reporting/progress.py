"""Progress of training and evaluation: live on a terminal or in a notebook, else as lines.

Everything goes to stderr, so that stdout stays clean for results; in a notebook below the cell.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from skillweave._internal.terminal import printable, say
from skillweave.reporting.displays import Display, Row, open_display
from skillweave.runs.manifest import StageEntry
from skillweave.runs.trackers import Listener
from skillweave.training.episodes import INFO

EVERY = 5.0
"""Seconds between two plain lines at the start of a stage."""
SPREAD = 0.25
"""Later, the share of the stage's time between two lines, so that a long run has few lines."""
RECENT = 10.0
"""Seconds of training over which the speed is measured."""
PATIENCE = 1.0
"""Seconds that an evaluation may take before its progress is shown."""
PLAIN_PATIENCE = 30.0
"""The least seconds between two lines of an evaluation, without a terminal."""
IN_ALL = "in all"
LOG = logging.getLogger("skillweave")
LOG.addHandler(logging.NullHandler())


@dataclass
class _Stage:
    """A stage, and its training so far."""

    budget: int
    steps: int = 0
    seconds: float = 0.0
    over: bool = False

    @property
    def passed(self) -> int:
        """Steps of the budget that are over; a stage may end before it is spent."""
        return self.budget if self.over else min(self.steps, self.budget)


class Progress(Listener):
    """A display of each stage's steps, return (mean of the last 100 episodes), speed and time left.

    If several policies learn in a stage, each has a line below it: its share of the steps, and its
    own reward. If a run has several stages, their number and the time left in all are shown.

    A context manager and a listener of the training loops. Without a terminal or a notebook, in CI,
    and with NO_COLOR or TERM=dumb, it writes a line when a stage starts, some while it trains, and
    one when it ends. With ``quiet`` it writes nothing. Messages go to the logger "skillweave", too.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._display: Display | None = None
        self._stages: dict[str, _Stage] = {}
        self._several = False
        self._recent: deque[tuple[int, float]] = deque()  # (steps, seconds) of the latest ticks
        self._started = self._shown = 0.0

    def __enter__(self) -> Self:
        self._display = None if self._quiet else open_display()
        return self

    def __exit__(self, *_: object) -> None:
        if self._display is not None:
            self._display.close()
            self._display = None

    def plan(self, stages: Iterable[StageEntry]) -> None:
        """Set all stages of the run, as its manifest lists them."""
        for entry in stages:
            trained = entry.steps or 0, entry.seconds or 0.0
            self._stages[entry.name] = _Stage(entry.budget, *trained, entry.done)
        self._several = len(self._stages) > 1

    def stage(self, name: str, budget: int) -> None:
        """Start a stage, or continue it; ``budget`` in environment steps."""
        self._stages[name] = _Stage(budget)
        self._started = self._shown = time.monotonic()
        self._recent.clear()
        if self._display is None:
            self._line(f"{self._numbered(name)}: training for {budget:,} steps")
            return
        if self._several:
            self._put_total(self._display, name)
        self._display.put(Row(name, 0.0, f"0/{_short(budget)}"))
        self._display.draw()

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Report an update after ``steps`` and ``seconds`` of training."""
        stage = self._stages[name]
        stage.steps = steps
        stage.seconds = seconds
        self._recent.append((steps, seconds))
        while len(self._recent) > 2 and self._recent[1][1] < seconds - RECENT:
            self._recent.popleft()
        now = time.monotonic()
        pause = max(EVERY, SPREAD * (now - self._started))
        if self._display is not None:
            pause = self._display.every
        if self._quiet or now - self._shown < pause:
            return
        if self._display is None and steps >= stage.budget:
            return  # ``done`` reports it next
        self._shown = now
        left = _clock(self._left(stage))
        self._show(name, metrics, f"{self._speed():,.0f} steps/s", f"{left} left")

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """End a stage."""
        if name not in self._stages:
            self.stage(name, steps)
        self._stages[name] = _Stage(self._stages[name].budget, steps, seconds, over=True)
        if not self._quiet:
            speed = f"{steps / max(seconds, 1e-9):,.0f} steps/s"
            self._show(name, metrics, speed, f"done in {_clock(seconds)}")

    def message(self, text: str) -> None:
        """Show a line of text, above the bars where there are any."""
        text = printable(text)
        LOG.info("%s", text)
        if self._display is None:
            self._line(text)
        else:
            self._display.message(text)

    def _show(self, name: str, metrics: dict[str, float], speed: str, left: str) -> None:
        """Show a stage and what learns in it, as bars or as lines."""
        stage = self._stages[name]
        below = _below(name, metrics)
        share = min(stage.steps / stage.budget, 1.0)
        result = f"return {metrics['return']:.1f}" if "return" in metrics else ""
        if self._display is None:
            part = f"{stage.steps:,} of {stage.budget:,} steps ({share:.0%})"
            seconds = self._left_in_all(name)
            in_all = f"{_clock(seconds)} left in all" if seconds else ""
            numbers = (f"{row.name} {row.steps}" for row in below if row.name.startswith(INFO))
            text = ", ".join(filter(None, (part, result, *numbers, speed, left, in_all)))
            self._line(f"{self._numbered(name)}: {text}")
            for row in below if stage.over else ():
                if not row.name.startswith(INFO):
                    self._line(f"  {row.name}: " + ", ".join(filter(None, (row.steps, row.result))))
            return
        counted = f"{_short(stage.steps)}/{_short(stage.budget)}"
        for row in (Row(name, share, counted, result, speed, left), *below):
            self._display.put(row)
        if self._several:
            self._put_total(self._display, name)
        self._display.draw()

    def _put_total(self, display: Display, name: str) -> None:
        """Put the row of all stages."""
        stages = self._stages.values()
        budget, steps = sum(s.budget for s in stages), sum(s.steps for s in stages)
        share = sum(s.passed for s in stages) / budget
        left = self._left_in_all(name)
        if left is None:
            words = ""
        elif left == 0.0:
            words = f"done in {_clock(sum(s.seconds for s in stages))}"
        else:
            words = f"{_clock(left)} left"
        counted = f"{_short(steps)}/{_short(budget)}"
        display.put(Row(IN_ALL, share, counted, f"stage {self._place(name)}", "", words))

    def _place(self, name: str) -> str:
        return f"{list(self._stages).index(name) + 1} of {len(self._stages)}"

    def _numbered(self, name: str) -> str:
        """Return a stage's name, and of several which one it is."""
        return f"{name} ({self._place(name)})" if self._several else name

    def _speed(self) -> float:
        """Return the recent steps per second."""
        steps, seconds = self._recent[-1]
        then, since = self._recent[0] if len(self._recent) > 1 else (0, 0.0)
        return (steps - then) / max(seconds - since, 1e-9)

    def _left(self, stage: _Stage) -> float:
        """Return the seconds that a stage still takes at the recent speed."""
        return max(stage.budget - stage.steps, 0) / max(self._speed(), 1e-9)

    def _left_in_all(self, name: str) -> float | None:
        """Return the seconds that all stages still take; None: unknown, or there is one stage.

        The speed of stages that have not started is taken from all steps so far.
        """
        if not self._several:
            return None
        here = self._stages[name]
        stages = self._stages.values()
        later = sum(s.budget for s in stages if not s.over and s is not here)
        steps, seconds = sum(s.steps for s in stages), sum(s.seconds for s in stages)
        now = 0.0 if here.over else self._left(here) if self._recent else None
        if (later and not steps) or now is None:
            return None
        return now + (later * seconds / steps if later else 0.0)

    def _line(self, text: str) -> None:
        if not self._quiet:
            say(text)


class EpisodeProgress:
    """A display of the episodes of an evaluation that are over, if it takes longer than a second.

    It disappears when the evaluation ends. Without a terminal or a notebook it writes lines, the
    first after half a minute.

    Args:
        episodes: the number of episodes.
        quiet: show nothing.
        name: the name of the evaluation, for the display.
        unit: what is counted.
    """

    def __init__(
        self,
        episodes: int,
        *,
        quiet: bool = False,
        name: str = "evaluation",
        unit: str = "episodes",
    ) -> None:
        self.episodes = episodes
        """The number of episodes; more may come to it."""
        self._unit = unit
        self._quiet = quiet
        self._name = name
        self._over = self._steps = 0
        self._display: Display | None = None
        self._tried = False

    def __enter__(self) -> Self:
        self._started = self._shown = time.monotonic()
        self._pause = PATIENCE
        return self

    def __exit__(self, *_: object) -> None:
        if self._display is not None:
            self._display.close()
            self._display = None

    def watch(self, played: Any) -> None:
        """Count a step of some episodes (``PlayedStep``)."""
        over = np.count_nonzero(played.over & (played.episode >= 0))
        self.count(int(played.lasted.sum()), int(over))

    def count(self, steps: int, over: int) -> None:
        """Count ``steps`` more steps, and ``over`` more episodes that have ended."""
        if self._quiet:
            return
        self._steps += steps
        self._over += over
        self.episodes = max(self.episodes, self._over)
        now = time.monotonic()
        if now - self._shown < self._pause:
            return
        self._shown = now
        if not self._tried:
            self._tried = True
            self._display = open_display(transient=True)
            if self._display is None:
                self._pause = PLAIN_PATIENCE
                return
            self._pause = self._display.every
        episodes = f"{self._over:,} of {self.episodes:,} {self._unit}"
        played = f"{self._steps:,} steps"
        taken = now - self._started
        if self._display is None:
            say(f"{self._name}: {episodes}, {played}")
            self._pause = max(PLAIN_PATIENCE, SPREAD * taken)
            return
        share = self._over / self.episodes
        left = f"{_clock(taken / share - taken)} left" if share else ""
        self._display.put(Row(self._name, share, episodes, played, left=left))
        self._display.draw()


def _below(name: str, metrics: dict[str, float]) -> list[Row]:
    """Return the rows below a stage: its learners, then the numbers from infos."""
    learners, infos = [], []
    for key, value in metrics.items():
        agent, _, what = key.rpartition(".")
        if key.startswith(INFO):  # a key may have a dot of its own
            infos.append(Row(key, None, f"{value:.4g}", under=name))
        elif what == "usage":
            reward = metrics.get(f"{agent}.reward")
            words = "" if reward is None else f"reward {reward:.3g} a step"
            learners.append(Row(agent, value, f"{value:.0%} of steps", words, under=name))
        elif what == "call_length":
            learners.append(Row(agent, None, f"calls of {value:.1f} steps", under=name))
    return [*learners, *infos]


def _short(steps: int) -> str:
    return f"{steps / 1e6:.3g}M" if steps >= 1_000_000 else f"{steps / 1e3:.3g}k"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
