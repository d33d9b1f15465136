"""The content of a run's ``lineage.jsonl``: generations, ancestors of the winner, and settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from skillweave.errors import RunError
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import LineageLine

COMPLEMENT = ("gamma", "gae_lambda")
"""Settings that are drawn as their difference from one."""


@dataclass(frozen=True)
class Lineage:
    """One stage's population over the generations."""

    born: dict[tuple[int, int], LineageLine]
    """By generation and number."""

    @property
    def winner(self) -> LineageLine:
        """Return the best member of all generations so far."""
        return max((b for b in self.born.values() if b.best), key=lambda b: b.generation)

    @property
    def varied(self) -> list[str]:
        """Return the settings in which members differ."""
        members = self.born.values()
        return [k for k in self.winner.settings if len({str(b.settings[k]) for b in members}) > 1]

    def scale(self, setting: str) -> str:
        """Return how a setting is drawn: as "words", or on a "log" or a "linear" scale."""
        values = [number_of(b, setting) for b in self.born.values()]
        if any(isinstance(value, str) for value in values):
            return "words"
        return "log" if min(values) > 0 and max(values) > 5 * min(values) else "linear"

    def parent(self, born: LineageLine) -> LineageLine | None:
        """Return a member's parent; None in the first generation."""
        if born.parent is None or born.generation == 0:
            return None
        return self.born.get((born.generation - 1, born.parent))

    def path(self, born: LineageLine) -> list[LineageLine]:
        """Return the line from the first generation to a member."""
        line: list[LineageLine] = []
        at: LineageLine | None = born
        while at is not None:
            line.append(at)
            at = self.parent(at)
        return line[::-1]


def read_lineage(run: RunDirectory, stage: str) -> Lineage | None:
    """Return the lineage of a stage, or None where nothing evolved in it.

    Raises:
        RunError: the file is damaged.
    """
    born: dict[tuple[int, int], LineageLine] = {}
    sorts: dict[str, str] = {}
    for each in run.lineage.read():
        if each.stage == stage:
            its_sorts = {k: _sort(v) for k, v in each.settings.items()}
            sorts = sorts or its_sorts
            if its_sorts != sorts:
                raise RunError(
                    f"{run.lineage.path} is damaged: the settings of member {each.member} in "
                    f"generation {each.generation} are not of the sorts of those before"
                )
            born[each.generation, each.member] = each
    return Lineage(born) if any(b.best for b in born.values()) else None


def _sort(value: Any) -> str:
    """Return the sort of a setting's value: a number, a word, or whole numbers."""
    if isinstance(value, list):
        return "numbers" if all(type(x) is int for x in value) else "?"
    return "number" if type(value) in (int, float) else type(value).__name__


def number_of(born: LineageLine, setting: str) -> Any:
    """Return the value of a setting as it is drawn: a word, or a number; of widths their sum."""
    value = born.settings[setting]
    number = sum(value) if isinstance(value, list) else value
    return 1.0 - number if setting in COMPLEMENT else number


def setting_title(setting: str) -> str:
    """Return the title of a setting's axis."""
    if setting == "hidden":
        return "hidden units, all layers"
    return f"1 − {setting}" if setting in COMPLEMENT else setting


def changes_words(born: LineageLine) -> str:
    """Return the changed settings of a member in words; empty: none."""
    return ", ".join(
        f"{k.removeprefix('network.')} {short_value(old)} → {short_value(new)}"
        for k, (old, new) in born.changes.items()
    )


def short_value(value: Any) -> str:
    """Return a setting's value in few letters, for figures of a population."""
    if isinstance(value, list):
        return "-".join(map(str, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)
