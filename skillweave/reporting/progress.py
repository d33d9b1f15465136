"""How training goes, for people: live bars on a terminal, plain lines anywhere else.

Everything goes to stderr, so that stdout stays clean for results.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import sys
import time
from collections import deque
from collections.abc import Iterator
from typing import Any, Self

REFRESH = 0.25  # seconds between two drawings of the bars
EVERY = 5.0  # seconds between two plain lines
RECENT = 10.0  # seconds of training over which the speed is taken


class Progress:
    """Shows each stage's steps, return (mean of the last 100 episodes), speed and time left.

    Where several learn in a stage, each has a line below it: how much it acts, and its own reward.

    A context manager and a listener of the training loops. Without a terminal, in CI, and with
    NO_COLOR or TERM=dumb, it writes a line when a stage begins, one about every 5 s, and one when
    it ends. With ``quiet`` it writes nothing.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._bars: Any = None  # rich.progress.Progress
        self._tasks: dict[str, Any] = {}
        self._budgets: dict[str, int] = {}
        self._recent: deque[tuple[int, float]] = deque()  # (steps, seconds) of the latest ticks
        self._shown = 0.0

    def __enter__(self) -> Self:
        self._bars = _make_bars() if not self._quiet and _may_draw() else None
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.refresh()
            self._bars.stop()
            self._bars = None

    def stage(self, name: str, budget: int) -> None:
        """A stage begins, or goes on; ``budget`` in environment steps."""
        self._budgets[name], self._shown = budget, time.monotonic()
        self._recent.clear()
        if self._bars is None:
            self._line(f"{name}: training for {budget:,} steps")
        else:
            fields = {"steps": f"0/{_short(budget)}", "result": "", "speed": "", "left": ""}
            self._tasks[name] = self._bars.add_task(name, total=budget, **fields)
            self._bars.refresh()

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """An update was made after ``steps`` and ``seconds`` of training."""
        self._recent.append((steps, seconds))
        while len(self._recent) > 2 and self._recent[1][1] < seconds - RECENT:
            self._recent.popleft()
        now = time.monotonic()
        if self._quiet or now - self._shown < (EVERY if self._bars is None else REFRESH):
            return
        self._shown = now
        then, since = self._recent[0] if len(self._recent) > 1 else (0, 0.0)
        speed = (steps - then) / max(seconds - since, 1e-9)
        budget = self._budgets[name]
        left = _clock(max(budget - steps, 0) / max(speed, 1e-9))
        self._show(name, steps, metrics, f"{speed:,.0f} steps/s", f"{left} left")

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """A stage is over."""
        if self._quiet:
            return
        if name not in self._budgets:
            self.stage(name, steps)
        speed = f"{steps / max(seconds, 1e-9):,.0f} steps/s"
        self._show(name, steps, metrics, speed, f"done in {_clock(seconds)}")

    def message(self, text: str) -> None:
        """A line of text, above the bars where there are any."""
        if self._bars is None:
            self._line(text)
        else:
            self._bars.console.print(text, markup=False, highlight=False)

    def _show(
        self, name: str, steps: int, metrics: dict[str, float], speed: str, left: str
    ) -> None:
        budget = self._budgets[name]
        result = f"return {metrics['return']:.1f}" if "return" in metrics else ""
        if self._bars is None:
            part = f"{steps:,} of {budget:,} steps ({min(steps / budget, 1):.0%})"
            self._line(f"{name}: " + ", ".join(filter(None, (part, result, speed, left))))
            for agent, _, acts, reward in _agents(metrics):
                self._line(f"  {agent}: " + ", ".join(filter(None, (acts, reward))))
        else:
            fields = {"result": result, "speed": speed, "left": left}
            fields["steps"] = f"{_short(steps)}/{_short(budget)}"
            self._bars.update(self._tasks[name], completed=min(steps, budget), **fields)
            for told in _agents(metrics):
                self._show_agent(name, *told)
            self._bars.refresh()

    def _show_agent(
        self, stage: str, name: str, usage: float | None, acts: str, reward: str
    ) -> None:
        """The bar of one who learns in a stage: how much it acts, of all steps."""
        path = f"{stage}/{name}"
        if path not in self._tasks:
            fields = {"steps": "", "result": "", "speed": "", "left": ""}
            self._tasks[path] = self._bars.add_task(f"  {name}", total=1.0, **fields)
        self._bars.update(self._tasks[path], completed=usage or 0.0, steps=acts, result=reward)

    def _line(self, text: str) -> None:
        if not self._quiet:
            print(text, file=sys.stderr, flush=True)


def _agents(metrics: dict[str, float]) -> Iterator[tuple[str, float | None, str, str]]:
    """Who learns side by side: name, share of the steps in which it acts, and both in words."""
    for key, value in metrics.items():
        name, _, what = key.rpartition(".")
        if what == "usage":
            reward = metrics.get(f"{name}.reward")
            words = "" if reward is None else f"reward {reward:.3g} a step"
            yield name, value, f"{value:.0%} of steps", words
        elif what == "call_length":
            yield name, None, f"calls of {value:.1f} steps", ""


def _may_draw() -> bool:
    """Whether it is worth importing rich to find out if bars can be drawn."""
    if os.environ.get("TERM") == "dumb" or any(os.environ.get(v) for v in ("NO_COLOR", "CI")):
        return False
    # A notebook's stderr is no terminal; rich draws there through ipywidgets, or warns each time.
    notebook = "IPython" in sys.modules and importlib.util.find_spec("ipywidgets") is not None
    return sys.stderr.isatty() or notebook


def _make_bars() -> Any:
    """A rich display that is drawn only when told, or None where rich sees no screen."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    if not (console.is_terminal or console.is_jupyter):
        return None
    right = functools.partial(TextColumn, justify="right", markup=False)
    return Progress(
        TextColumn("{task.description}", markup=False, style="bold"),
        BarColumn(bar_width=None, complete_style="cyan", finished_style="green"),
        right("{task.fields[steps]}"),
        right("{task.fields[result]}", style="green"),
        right("{task.fields[speed]}", style="cyan"),
        right("{task.fields[left]}"),
        console=console,
        auto_refresh=False,  # no thread beside training
        redirect_stdout=sys.stdout.isatty(),  # else print() would land on stderr, not in the pipe
        expand=True,
    )


def _short(steps: int) -> str:
    return f"{steps / 1e6:.3g}M" if steps >= 1_000_000 else f"{steps / 1e3:.3g}k"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
