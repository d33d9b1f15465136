"""The picture of a matrix of handovers, as SVG, and the page that has it."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

CELL, ROW = 96, 46
"""Width and height of a cell."""
LEFT, TOP = 130, 58
"""The room for the names of rows and columns."""
GOOD, BAD, NONE = (226, 240, 229), (214, 84, 62), (243, 243, 243)
"""Colours: of a pair that is always done, of one that never is, of one that was not played."""
LETTER = 8.2
"""The width of a letter."""


def matrix_svg(skills: Sequence[str], counts: Sequence[Sequence[tuple[int, int] | None]]) -> str:
    """Return a picture of counts: a row for what came before, a column for each skill.

    Args:
        counts: (S + 1, S), done and all; None: it was not played. The first row is of fresh starts.
    """
    left = max(LEFT, int(LETTER * max(len(name) for name in skills)) + 70)
    width, height = left + CELL * len(skills) + 16, TOP + ROW * (len(skills) + 1) + 16
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" font-family="system-ui, sans-serif" font-size="14">',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for j, name in enumerate(skills):
        parts.append(_text(left + CELL * (j + 0.5), TOP - 14, name, "middle", weight=600))
    for i, row in enumerate(counts):
        y = TOP + ROW * i
        before = f"after {skills[i - 1]}" if i else "fresh start"
        parts.append(_text(left - 12, y + ROW / 2 + 5, before, "end"))
        for j, pair in enumerate(row):
            parts += _cell(left + CELL * j, y, pair)
    return "\n".join([*parts, "</svg>\n"])


def _cell(x: float, y: float, pair: tuple[int, int] | None) -> list[str]:
    done, every = pair or (0, 0)
    share = done / every if every else 0.0
    pairs = zip(BAD, GOOD, strict=True)
    color = tuple(round(b + (g - b) * share) for b, g in pairs) if every else NONE
    found = [
        f'<rect x="{x + 1}" y="{y + 1}" width="{CELL - 2}" height="{ROW - 2}" rx="4" '
        f'fill="rgb{color}"/>'
    ]
    if pair is not None:
        words = f"{done} of {every}" if every else "none"
        ink = "#fff" if every and share < 0.4 else "#222"
        found.append(_text(x + CELL / 2, y + ROW / 2 + 5, words, "middle", ink))
    return found


def _text(x: float, y: float, words: str, anchor: str, ink: str = "#222", weight: int = 400) -> str:
    return (
        f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}" fill="{ink}" '
        f'font-weight="{weight}">{escape(words)}</text>'
    )


def page(title: str, picture: str, lists: str, sentences: Sequence[str]) -> str:
    """Return a page with a picture, a table in HTML, and sentences."""
    notes = "".join(f"<p>{escape(sentence)}.</p>" for sentence in sentences)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>Handovers</title><style>{STYLE}</style></head><body><h1>Handovers</h1>"
        f"<p>{escape(title)}</p><div>{picture}</div>{lists}{notes}</body></html>\n"
    )


STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;"
    "color:#222}div{overflow-x:auto}table{border-collapse:collapse;margin:1rem 0}"
    "td,th{padding:.3rem .8rem;border-bottom:1px solid #ddd;text-align:right}"
    "td:first-child,th:first-child{text-align:left}"
)
