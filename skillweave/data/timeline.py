"""The timeline of calls that were found in episodes, as a picture."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

from skillweave.reporting.palette import color_of, hex_of
from skillweave.schema import Count

MOST = 30
"""The most episodes that are shown."""
WIDTH, ROW, BAR, LEFT, TOP = 900, 16, 12, 96, 34
"""Sizes in pixels: of the picture, an episode, its bar, and the room beside and above them."""


@dataclass(frozen=True)
class Cuts:
    """The calls in the first episodes of a data set."""

    name: str
    """Of the data set."""
    episodes: Count
    """All of them."""
    skills: list[str]
    lengths: list[Count]
    """Steps of the episodes that are shown."""
    calls: list[list[tuple[Count, Count, Count]]]
    """Of each of these: number of the skill, first step, and steps."""
    sentences: list[str]

    def svg(self) -> str:
        """Return the picture: a row for each episode, a bar for each call."""
        height = TOP + ROW * len(self.lengths) + 8
        scale = (WIDTH - LEFT - 8) / max(self.lengths)
        parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
            'font-family="system-ui, sans-serif" font-size="12" style="max-width:100%">'
        ]
        at = LEFT
        for i, name in enumerate(self.skills):
            parts.append(_bar(at, 8, 12, i, name))
            parts.append(f'<text x="{at + 17}" y="18" fill="currentColor">{escape(name)}</text>')
            at += 34 + 7 * len(name)
        for number, (length, calls) in enumerate(zip(self.lengths, self.calls, strict=True)):
            y = TOP + ROW * number
            parts.append(
                f'<text x="{LEFT - 8}" y="{y + 10}" text-anchor="end" fill="currentColor">'
                f"episode {number + 1}</text>"
                f'<line x1="{LEFT}" x2="{LEFT + scale * length:.1f}" y1="{y + BAR / 2}" '
                f'y2="{y + BAR / 2}" stroke="#8d8d97"/>'
            )
            for skill, begin, steps in calls:
                words = f"{self.skills[skill]}: steps {begin + 1} to {begin + steps}"
                x, width = LEFT + scale * begin, max(1.0, scale * steps - 0.5)
                parts.append(_bar(x, y, width, skill, words))
        return "\n".join([*parts, "</svg>\n"])

    def html(self) -> str:
        """Return the picture, and sentences."""
        more = self.episodes - len(self.lengths)
        rest = [f"{more:,} more episodes are not shown"] if more else []
        notes = "".join(f"<p>{escape(sentence)}.</p>" for sentence in (*rest, *self.sentences))
        return f"<p>{escape(self.name)}</p>{self.svg()}{notes}"


def _bar(x: float, y: float, width: float, skill: int, words: str) -> str:
    return (
        f'<rect x="{x:.1f}" y="{y}" width="{width:.1f}" height="{BAR}" rx="1.5" '
        f'fill="{hex_of(color_of(skill))}"><title>{escape(words)}</title></rect>'
    )
