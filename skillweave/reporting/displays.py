"""Displays of progress: bars on a terminal, a table in a notebook."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from skillweave._internal.notebooks import Area, Markup, in_notebook, joined, paragraph, table
from skillweave._internal.terminal import end_quietly, printable


@dataclass
class Row:
    """A line of displayed progress."""

    name: str
    """The activity."""
    share: float | None
    """The share that is done, from 0 to 1; None: it has no such share."""
    steps: str = ""
    """The share in steps: done, and in all."""
    result: str = ""
    """Its result so far."""
    speed: str = ""
    """Steps per second."""
    left: str = ""
    """Time left, or taken."""
    under: str = ""
    """The stage that it belongs to."""

    @property
    def key(self) -> tuple[str, str]:
        """Return the identity of a row of progress."""
        return self.under, self.name


class Display:
    """A display of rows of progress, each under the ones before.

    It turns silent once it cannot be drawn, so that training continues: its reader has ended, or
    the disk of a log is full.
    """

    every: float
    """Seconds between two drawings."""

    def __init__(self) -> None:
        self._rows: dict[tuple[str, str], Row] = {}
        self._draws = True

    def put(self, row: Row) -> None:
        """Add a row, or replace the one of the same key; ``draw`` shows it."""
        self._rows[row.key] = row

    def draw(self) -> None:
        """Show all rows as they are now."""
        self._try(self._draw)

    def message(self, text: str) -> None:
        """Show a line of text."""
        self._try(self._message, text)

    def close(self) -> None:
        """Draw for the last time, and undo the display's changes in any case."""
        _open.remove(self)
        self._draws = True
        self._try(self._close)

    def _try(self, act: Callable[..., None], *arguments: str) -> None:
        """Draw, unless drawing failed before; a terminal that is gone ends the display."""
        if self._draws:
            try:
                act(*arguments)
            except (OSError, ValueError):
                self._draws = False
                end_quietly()

    def _draw(self) -> None:
        raise NotImplementedError

    def _message(self, text: str) -> None:
        raise NotImplementedError

    def _close(self) -> None:
        raise NotImplementedError


_open: list[Display] = []
"""The display that is drawn now: a terminal has room for one."""


def open_display(*, transient: bool = False) -> Display | None:
    """Return a display, or None where plain lines are to be written instead.

    Args:
        transient: nothing is left of it when it is closed.
    """
    if _open:
        return None
    display: Display | None = None
    try:
        if in_notebook():
            display = Cell(transient)
        elif _may_draw():
            display = make_bars(transient)
    except (OSError, ValueError):
        return None
    if display is not None:
        _open.append(display)
    return display


class Bars(Display):
    """Bars on a terminal, drawn by rich; messages are above them."""

    every = 0.25

    def __init__(self, bars: Any) -> None:
        super().__init__()
        self._bars = bars
        self._tasks = dict[tuple[str, str], Any]()
        bars.start()

    def _draw(self) -> None:
        """Draw the bars of progress on the terminal."""
        for key, row in self._rows.items():
            texts = {k: getattr(row, k) for k in ("steps", "result", "speed", "left")}
            if key not in self._tasks:
                name = printable(f"  {row.name}" if row.under else row.name)
                self._tasks[key] = self._bars.add_task(name, total=1.0, **texts)
            self._bars.update(self._tasks[key], completed=row.share or 0.0, **texts)
        self._bars.refresh()

    def _message(self, text: str) -> None:
        self._bars.console.print(text, markup=False, highlight=False)

    def _close(self) -> None:
        try:
            self._draw()
        finally:
            self._bars.stop()


class Cell(Display):
    """A table in the output of a notebook's cell; its last state stays in the notebook."""

    every = 0.5

    def __init__(self, transient: bool = False) -> None:
        super().__init__()
        self._area = Area()
        self._transient = transient
        self._messages: list[str] = []

    def _draw(self) -> None:
        """Draw the table of progress in a notebook's cell."""
        indent = "\N{NO-BREAK SPACE}" * 4
        cells, lines = [], []
        for row in self._rows.values():
            share = "" if row.share is None else f"{row.share:.0%}"
            bar = share and Markup(f'<progress value="{row.share:.3f}" max="1">{share}</progress>')
            texts = (row.steps, row.result, row.speed, row.left)
            cells.append(((indent if row.under else "") + row.name, bar, *texts))
            lines.append(" ".join(filter(None, (row.name, share, *texts))))
        shown = [table((), cells)] if cells else []
        html = joined([*shown, *map(paragraph, self._messages)])
        self._area.show(html, "\n".join([*lines, *self._messages]))

    def _message(self, text: str) -> None:
        self._messages.append(text)
        self._draw()

    def _close(self) -> None:
        if self._transient:
            self._area.clear()
        elif self._rows or self._messages:
            self._draw()


def _may_draw() -> bool:
    """Return whether bars may be possible, so that importing rich is worth its time."""
    if os.environ.get("TERM") == "dumb" or any(os.environ.get(v) for v in ("NO_COLOR", "CI")):
        return False
    return _is_terminal(sys.stderr)


def _is_terminal(stream: Any) -> bool:
    """Return whether a standard stream, which may be closed or None, is a terminal."""
    return stream is not None and not stream.closed and bool(stream.isatty())


def make_bars(transient: bool) -> Bars | None:
    """Return bars that are drawn only on request, or None where rich finds no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        return None
    right = functools.partial(TextColumn, justify="right", markup=False)
    bars = Progress(
        TextColumn("{task.description}", markup=False, style="bold"),
        BarColumn(bar_width=None, complete_style="cyan", finished_style="green"),
        right("{task.fields[steps]}"),
        right("{task.fields[result]}", style="green"),
        right("{task.fields[speed]}", style="cyan"),
        right("{task.fields[left]}"),
        console=console,
        auto_refresh=False,  # no thread beside training
        redirect_stdout=_is_terminal(sys.stdout),  # else print() would land on stderr
        expand=True,
        transient=transient,
    )
    return Bars(bars)
