"""HTML for notebooks: plain tables with escaped text, in the notebook's own colours.

This module imports nothing of the library, and IPython only where it runs already.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any


class Markup(str):
    """HTML that is put into a table as it is."""


def in_notebook() -> bool:
    """Return whether this code runs in a notebook: in IPython, with a kernel."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


def table(head: Sequence[object], rows: Iterable[Sequence[object]], left: int = 1) -> Markup:
    """Return an HTML table, as notebooks show it.

    Args:
        head: the titles of the columns; none: the table has no titles.
        rows: the cells, row by row; everything but ``Markup`` is escaped.
        left: how many columns are aligned left; the others have numbers.
    """
    titles = f"<thead>{_row(head, left, 'th')}</thead>" if head else ""
    body = "".join(_row(row, left, "td") for row in rows)
    return Markup(f"<table>{titles}<tbody>{body}</tbody></table>")


def facts(rows: Iterable[tuple[str, object]]) -> Markup:
    """Return a table of two columns: names and their values."""
    return table((), ((Markup(f"<b>{escape(k)}</b>"), v) for k, v in rows), left=2)


def paragraph(text: object) -> Markup:
    """Return a paragraph of text."""
    return Markup(f"<p>{_html(text)}</p>")


def joined(parts: Iterable[str]) -> str:
    """Join pieces of HTML to a result of ``_repr_html_``."""
    return f"<div>{''.join(parts)}</div>"


class Area:
    """An output of a notebook's cell that can be changed."""

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, html: str, text: str) -> None:
        """Show this, in place of what was shown before; ``text`` is for outputs without HTML."""
        display: Any = importlib.import_module("IPython.display").display
        data = {"text/html": html, "text/plain": text}
        if self._handle is None:
            self._handle = display(data, raw=True, display_id=True)
        else:
            self._handle.update(data, raw=True)

    def clear(self) -> None:
        """Show nothing any more."""
        if self._handle is not None:
            self.show("", "")


def _row(cells: Sequence[object], left: int, tag: str) -> str:
    """Return a row of an HTML table for a notebook."""
    parts = []
    for i, cell in enumerate(cells):
        side = "left" if i < left else "right"
        parts.append(f'<{tag} style="text-align: {side}">{_html(cell)}</{tag}>')
    return f"<tr>{''.join(parts)}</tr>"


def _html(value: object) -> str:
    return value if isinstance(value, Markup) else escape(str(value))
