"""Progress of training and evaluation: live on a terminal or in a notebook, else as lines.

Everything goes to stderr, so that stdout stays clean for results; in a notebook below the cell.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterable
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
        self._plan: dict[str, int] = {}
        """Budgets of stages, in their order."""
        self._several = False
        self._spent: dict[str, tuple[int, float]] = {}
        """Steps and seconds of each stage so far."""
        self._over: set[str] = set()
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
        for stage in stages:
            self._plan[stage.name] = stage.budget
            if stage.done:
                self._spent[stage.name] = stage.steps or 0, stage.seconds or 0.0
                self._over.add(stage.name)
        self._several = len(self._plan) > 1

    def stage(self, name: str, budget: int) -> None:
        """Start a stage, or continue it; ``budget`` in environment steps."""
        self._plan[name] = budget
        self._started = self._shown = time.monotonic()
        self._recent.clear()
        if self._display is None:
            self._line(f"{self._numbered(name)}: training for {budget:,} steps")
            return
        if self._several:
            self._put_total(name)
        self._display.put(Row(name, 0.0, f"0/{_short(budget)}"))
        self._display.draw()

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Report an update after ``steps`` and ``seconds`` of training."""
        self._recent.append((steps, seconds))
        self._spent[name] = steps, seconds
        while len(self._recent) > 2 and self._recent[1][1] < seconds - RECENT:
            self._recent.popleft()
        now = time.monotonic()
        pause = max(EVERY, SPREAD * (now - self._started))
        if self._display is not None:
            pause = self._display.every
        if self._quiet or now - self._shown < pause:
            return
        if self._display is None and steps >= self._plan[name]:
            return  # ``done`` reports it next
        self._shown = now
        left = _clock(self._left(name))
        self._show(name, steps, metrics, f"{self._speed():,.0f} steps/s", f"{left} left")

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """End a stage."""
        if name not in self._plan:
            self.stage(name, steps)
        self._spent[name] = steps, seconds
        self._over.add(name)
        if self._quiet:
            return
        speed = f"{steps / max(seconds, 1e-9):,.0f} steps/s"
        self._show(name, steps, metrics, speed, f"done in {_clock(seconds)}")

    def message(self, text: str) -> None:
        """Show a line of text, above the bars where there are any."""
        text = printable(text)
        LOG.info("%s", text)
        if self._display is None:
            self._line(text)
        else:
            self._display.message(text)

    def _show(
        self, name: str, steps: int, metrics: dict[str, float], speed: str, left: str
    ) -> None:
        budget = self._plan[name]
        share = min(steps / budget, 1.0)
        result = f"return {metrics['return']:.1f}" if "return" in metrics else ""
        below = _below(name, metrics)
        if self._display is None:
            part = f"{steps:,} of {budget:,} steps ({share:.0%})"
            seconds = self._left_in_all(name)
            in_all = f"{_clock(seconds)} left in all" if seconds else ""
            numbers = (f"{row.name} {row.steps}" for row in below if row.name.startswith(INFO))
            text = ", ".join(filter(None, (part, result, *numbers, speed, left, in_all)))
            self._line(f"{self._numbered(name)}: {text}")
            for row in below if name in self._over else ():
                if not row.name.startswith(INFO):
                    self._line(f"  {row.name}: " + ", ".join(filter(None, (row.steps, row.result))))
            return
        counted = f"{_short(steps)}/{_short(budget)}"
        self._display.put(Row(name, share, counted, result, speed, left))
        for row in below:
            self._display.put(row)
        if self._several:
            self._put_total(name)
        self._display.draw()

    def _put_total(self, name: str) -> None:
        """Put the row of all stages."""
        assert self._display is not None
        budget = sum(self._plan.values())
        passed = sum(self._plan[n] for n in self._over)
        if name not in self._over:
            passed += min(self._spent.get(name, (0, 0.0))[0], self._plan[name])
        steps = sum(steps for steps, _ in self._spent.values())
        left = self._left_in_all(name)
        if left is None:
            words = ""
        elif left == 0.0:
            words = f"done in {_clock(sum(seconds for _, seconds in self._spent.values()))}"
        else:
            words = f"{_clock(left)} left"
        at = f"stage {list(self._plan).index(name) + 1} of {len(self._plan)}"
        counted = f"{_short(steps)}/{_short(budget)}"
        self._display.put(Row(IN_ALL, passed / budget, counted, at, "", words))

    def _numbered(self, name: str) -> str:
        """Return a stage's name, and of several which one it is."""
        if not self._several:
            return name
        return f"{name} ({list(self._plan).index(name) + 1} of {len(self._plan)})"

    def _speed(self) -> float:
        """Return the recent steps per second."""
        steps, seconds = self._recent[-1]
        then, since = self._recent[0] if len(self._recent) > 1 else (0, 0.0)
        return (steps - then) / max(seconds - since, 1e-9)

    def _left(self, name: str) -> float:
        """Return the seconds that a stage still takes at the recent speed."""
        return max(self._plan[name] - self._recent[-1][0], 0) / max(self._speed(), 1e-9)

    def _left_in_all(self, name: str) -> float | None:
        """Return the seconds that all stages still take; None: unknown, or there is one stage.

        The speed of stages that have not started is taken from all steps so far.
        """
        if not self._several:
            return None
        later = sum(b for n, b in self._plan.items() if n not in self._over and n != name)
        steps = sum(steps for steps, _ in self._spent.values())
        seconds = sum(seconds for _, seconds in self._spent.values())
        now = 0.0 if name in self._over else self._left(name) if self._recent else None
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
    """

    def __init__(self, episodes: int, *, quiet: bool = False, name: str = "evaluation") -> None:
        self._episodes = episodes
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
        """Count a step of some episodes (``Played``)."""
        over = np.count_nonzero(played.over & (played.episode >= 0))
        self.count(int(played.lasted.sum()), int(over))

    def count(self, steps: int, over: int) -> None:
        """Count ``steps`` more steps, and ``over`` more episodes that have ended."""
        if self._quiet:
            return
        self._steps += steps
        self._over += over
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
        if self._display is not None:
            self._draw(now)
            return
        text = f"{self._over:,} of {self._episodes:,} episodes, {self._steps:,} steps"
        say(f"{self._name}: {text}")
        self._pause = max(PLAIN_PATIENCE, SPREAD * (now - self._started))

    def _draw(self, now: float) -> None:
        assert self._display is not None
        taken = now - self._started
        share = self._over / self._episodes
        left = f"{_clock(taken / share - taken)} left" if share else ""
        counted = f"{self._over:,} of {self._episodes:,} episodes"
        self._display.put(Row(self._name, share, counted, f"{self._steps:,} steps", left=left))
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
