"""What ``sw.handovers`` has measured: a table, the worst pair first, and chances of chains."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import aligned, as_path, short, suggest
from skillweave._internal.notebooks import table
from skillweave.calls.handover import START, wilson
from skillweave.errors import DeclarationError
from skillweave.policies.core import Array
from skillweave.robots.counts import exact_chance
from skillweave.robots.picture import matrix_svg, page
from skillweave.runs.files import write_bytes

SHOWN = 12
"""The most pairs in the list of a text."""
CLEAR = 0.05
"""The chance that any pair is called clearly worse where none is."""
DRAWS = 4000
"""Draws of the shares in a chain, for its interval."""
LATER = 20
"""The fewest later robots by which a pair is judged that was played on more than planned."""
SUFFIXES = (".json", ".html", ".svg")
"""Of files that can be written."""
FEW = 3
"""The fewest robots of which something is said about cuts."""


@dataclass(frozen=True)
class Entry:
    """A call that was played: after another skill, or from a fresh start."""

    robot: int
    """Its number: the same robot has it in all pairs."""
    seed: int
    """Of its resets."""
    after: str
    """The skill before, or "start"."""
    skill: str
    """The one that enters."""
    cut: int
    """Steps of the call before; 0 at a fresh start."""
    steps: int
    """Steps of the call; it ends where it is lost."""
    counts: bool
    """It was done, and did what was asked for."""
    done: bool
    """What it was for came true; see ``handovers``."""
    refused: bool
    """It might not start there (``initiation``)."""
    settings: dict[str, Any] = field(default_factory=dict)
    """The keywords of the robot's environment that were drawn."""

    def to_json(self) -> dict[str, Any]:
        """Return it as a plain dict; keywords of the robot have ``vary.`` in front."""
        own = {k: v for k, v in vars(self).items() if k != "settings"}
        return own | {f"vary.{name}": value for name, value in self.settings.items()}


@dataclass(frozen=True)
class Pair:
    """A skill after another one, beside fresh starts of the same robots.

    Attributes:
        after: the skill before.
        skill: the skill that enters.
        calls: its entries.
        done: those that were done, and followed.
        alone: of the same robots, those on which it is done from a fresh start.
        lost: robots on which it is done alone, but not after that skill.
        won: robots on which it is done after that skill, but not alone.
        chance: how likely such a difference is where the skill before makes none (McNemar's exact
            test), on robots that did not choose to look at this pair longer; where there are few of
            these, on all of them, twice as likely.
        not_followed: entries that stayed, and did not do what was asked for.
        refused: entries at which the skill may not start.
        cuts_lost: the fewest and the most steps of the call before, where it was not done; None: it
            always was.
        cuts_done: the same where it was done.
        falls: the median step at which it is lost; None: it never is.
    """

    after: str
    skill: str
    calls: int
    done: int
    alone: int
    lost: int
    won: int
    chance: float
    not_followed: int = 0
    refused: int = 0
    cuts_lost: tuple[int, int] | None = None
    cuts_done: tuple[int, int] | None = None
    falls: int | None = None

    @property
    def rate(self) -> float:
        """The share of entries that were done; NaN without any."""
        return self.done / self.calls if self.calls else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """A 95 % interval of the rate (Wilson 1927)."""
        low, high = wilson(self.done, self.calls)
        return float(low), float(high)

    def __str__(self) -> str:
        low, high = self.interval
        share = f"{self.rate:.0%}" if self.calls else "no entry"
        return (
            f"{self.skill} after {self.after}: {self.done} of {self.calls} ({share}, {low:.0%} to "
            f"{high:.0%}); alone {self.alone} of {self.calls}, lost {self.lost}, won {self.won}"
        )


@dataclass(frozen=True)
class ChainChance:
    """How likely skills are done one after another, from the shares of their pairs."""

    skills: tuple[str, ...]
    """In their order, from a fresh start."""
    estimate: float
    """The product of the shares of the pairs."""
    interval: tuple[float, float]
    """95 %, from draws of the pairs' shares (Jeffreys' prior)."""

    def __str__(self) -> str:
        low, high = self.interval
        return f"{' then '.join(self.skills)}: {self.estimate:.0%} ({low:.0%} to {high:.0%})"


@dataclass(frozen=True)
class Between:
    """Skills that may stand between two others, the likeliest first."""

    direct: ChainChance
    """Without a skill in between."""
    chains: tuple[ChainChance, ...]
    """With each other skill, without the fresh start of the first."""

    def __str__(self) -> str:
        lines = [f"directly: {self.direct}", *map(str, self.chains)]
        if len(self.chains) > 1:
            lines.append(
                "These are products of measured pairs. The best of several is usually a little "
                "worse when it is tried"
            )
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class HandoverTable:
    """Counts of each skill after each other one, each beside a fresh start of the same robot.

    Attributes:
        skills: their names.
        entries: all calls that count, each with its robot.
        calls: the entries that each pair was to have.
        steps: the most steps of a call, by skill.
        varied: what was drawn for each robot, in words; empty: nothing.
        no_entry: by first skill, tries in which it was not done by its cut, and all tries.
        played: environment steps in all.
        seconds: taken in all.
        stopped: Ctrl-C has ended it.
    """

    skills: tuple[str, ...]
    entries: tuple[Entry, ...]
    calls: int
    steps: tuple[int, ...]
    varied: str = ""
    no_entry: tuple[tuple[str, tuple[int, int]], ...] = ()
    played: int = 0
    seconds: float = 0.0
    stopped: bool = False

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """All pairs, the worst first: by robots lost, then by the rate."""
        found = [
            self._pair(after, skill) for skill in self.skills for after in self.skills
            if after != skill
        ]  # fmt: skip
        return tuple(sorted(found, key=_badness))

    @property
    def robots(self) -> int:
        """The number of robots."""
        return len({entry.robot for entry in self.entries})

    def alone(self, skill: str) -> tuple[int, int]:
        """Return the fresh starts from which a skill was done, and all of them.

        Args:
            skill: its name.

        Raises:
            DeclarationError: there is no such skill.
        """
        return self._count(START, self._known(skill))

    def pair(self, after: str, skill: str) -> Pair:
        """Return the counts of a skill after another one.

        Args:
            after: the name of the skill before.
            skill: of the one that enters.

        Raises:
            DeclarationError: there is no such skill, or it is the same twice.
        """
        self._known(after, skill)
        if after == skill:
            raise DeclarationError(
                f"{skill!r} after itself was not played: a skill that is called again goes on"
            )
        return next(p for p in self.pairs if (p.after, p.skill) == (after, skill))

    @checked_names
    def chain(self, *skills: str) -> ChainChance:
        """Return how likely these skills are done one after another, from a fresh start.

        Args:
            *skills: names, in their order.

        Raises:
            DeclarationError: there is no such skill, or none is named; or the same follows itself.
        """
        if not skills:
            raise DeclarationError("chain() needs the names of skills: chain('walk', 'wave')")
        counts = [self.alone(skills[0])]
        for after, skill in pairwise(skills):
            pair = self.pair(after, skill)
            counts.append((pair.done, pair.calls))
        return _chance(skills, counts)

    @checked_names
    def between(self, after: str, skill: str) -> Between:
        """Return what may stand between two skills, with the chances of both handovers.

        Args:
            after: the name of the first skill.
            skill: of the last one.

        Raises:
            DeclarationError: there is no such skill.
        """
        direct = self.pair(after, skill)
        chains = []
        for name in self.skills:
            if name not in (after, skill):
                both = self.pair(after, name), self.pair(name, skill)
                counts = [(pair.done, pair.calls) for pair in both]
                chains.append(_chance((after, name, skill), counts))
        chains.sort(key=lambda one: (-one.estimate, -one.interval[0]))
        return Between(_chance((after, skill), [(direct.done, direct.calls)]), tuple(chains))

    def clearly_worse(self) -> list[Pair]:
        """Return the pairs that lose robots by more than chance, though there are many pairs."""
        tested = [pair for pair in self.pairs if pair.calls]
        return [p for p in tested if p.lost > p.won and p.chance * len(tested) < CLEAR]

    def rows(self) -> list[dict[str, Any]]:
        """Return all entries as plain dicts, for a table of your own."""
        return [entry.to_json() for entry in self.entries]

    def to_json(self) -> dict[str, Any]:
        """Return all of it as plain JSON."""
        return {
            "skills": list(self.skills),
            "calls": self.calls,
            "steps": dict(zip(self.skills, self.steps, strict=True)),
            "varied": self.varied,
            "robots": self.robots,
            "played": self.played,
            "seconds": self.seconds,
            "stopped": self.stopped,
            "alone": {name: list(self.alone(name)) for name in self.skills},
            "pairs": [
                vars(pair) | {"rate": pair.rate if pair.calls else None} for pair in self.pairs
            ],
            "no_entry": {name: list(counts) for name, counts in self.no_entry},
            "entries": self.rows(),
        }

    @checked_names
    def save(self, path: str | Path) -> Path:
        """Write it as a file, and return its path.

        Args:
            path: ``.json`` for all entries, ``.html`` for a page, ``.svg`` for the matrix alone.

        Raises:
            DeclarationError: it ends otherwise.
            RunError: it cannot be written.
        """
        path = as_path(path, "path")
        check_suffix(path)
        if path.suffix == ".json":
            content = json.dumps(self.to_json(), indent=1) + "\n"
        elif path.suffix == ".svg":
            content = self._picture()
        else:
            content = page(self._title(), self._picture(), self._list(), self.sentences())
        write_bytes(path, content.encode())
        return path

    def __str__(self) -> str:
        parts = [self._title(), self._matrix_text()]
        if shown := self._pairs_text():
            parts.append(shown)
        parts.append("\n".join(self.sentences()))
        return "\n\n".join(part for part in parts if part)

    def _repr_html_(self) -> str:
        return f"{self._picture()}{self._list()}{table((), [[s] for s in self.sentences()])}"

    def _list(self) -> str:
        """Return the pairs that are listed, as a table in HTML."""
        rows = [_pair_row(pair) for pair in self._shown()]
        return str(table(_HEAD, rows)) if rows else ""

    def _picture(self) -> str:
        """Return the matrix as SVG."""
        rows = [
            [None if after == skill else self._count(after, skill) for skill in self.skills]
            for after in (START, *self.skills)
        ]
        return matrix_svg(self.skills, rows)

    def sentences(self) -> list[str]:
        """Return what else is to be known: how it fails, what is missing, what was varied."""
        found = [*self._of_pairs()]
        for name, (failed, tries) in self.no_entry:
            if failed:
                found.append(
                    f"{name!r} was not done before its cut on {failed} of {tries} tries: these are "
                    "no entries of the skill after it"
                )
        for pair in self.pairs:
            if not pair.calls:
                found.append(f"{pair.skill!r} has no entry after {pair.after!r}")
            elif pair.calls < self.calls:
                found.append(f"{pair.skill!r} has only {pair.calls} entries after {pair.after!r}")
        for name in self.skills:
            done, every = self.alone(name)
            if every and not done:
                found.append(
                    f"{name!r} is never done, not even from a fresh start: look at its mapping "
                    "(sees, acts), and at what stays= and done= ask for"
                )
        if self.varied:
            found.append(f"Robots are varied: {self.varied}")
        else:
            found.append(
                "Robots differ by what reset(seed=...) draws alone: on a nominal robot nearly "
                "every handover works. Draw what differs between real robots by vary="
            )
        if self.stopped:
            found.append("It was stopped before all pairs had their entries")
        return found

    def _of_pairs(self) -> list[str]:
        """Return sentences on how the pairs fail that are clearly worse."""
        found = []
        for pair in self.clearly_worse():
            words = [
                f"{pair.skill!r} is clearly worse after {pair.after!r} than from a fresh start"
            ]
            if pair.falls is not None:
                words.append(f"it is lost after {pair.falls} steps (median)")
            if pair.not_followed:
                words.append(f"{pair.not_followed} stayed, but did not do what was asked for")
            if pair.refused:
                words.append(f"it may not start at {pair.refused} (initiation)")
            lost, done = pair.cuts_lost, pair.cuts_done
            if lost is not None and done is not None and min(pair.done, pair.lost) >= FEW:
                words.append(
                    f"{pair.after!r} was cut at {lost[0]} to {lost[1]} steps where it was lost, at "
                    f"{done[0]} to {done[1]} where it was done"
                )
            found.append("; ".join(words))
        return found

    def _title(self) -> str:
        return (
            f"{len(self.skills)} skills, {self.robots} robots, {len(self.entries):,} calls, "
            f"{self.played:,} steps, {self.seconds:.0f} s"
        )

    def _matrix(self) -> list[list[str]]:
        """Return the table of counts: a row for what came before, a column for each skill."""
        rows = [["after", *self.skills]]
        for after in (START, *self.skills):
            cells = []
            for skill in self.skills:
                done, every = self._count(after, skill)
                cells.append("-" if after == skill else f"{done} of {every}")
            rows.append([after, *cells])
        return rows

    def _matrix_text(self) -> str:
        return aligned(self._matrix(), left=1)

    def _shown(self) -> list[Pair]:
        """Return the pairs that are listed: those that lose or win robots, or fail."""
        return [p for p in self.pairs if p.calls and (p.lost or p.won or p.done < p.calls)][:SHOWN]

    def _pairs_text(self) -> str:
        pairs = self._shown()
        if not pairs:
            return ""
        return aligned([list(_HEAD), *(_pair_row(pair) for pair in pairs)], left=1)

    def _known(self, *names: str) -> str:
        for name in names:
            if name not in self.skills:
                raise DeclarationError(
                    f"there is no skill {short(name)}{suggest(name, self.skills)}"
                )
        return names[0]

    @cached_property
    def _cells(self) -> dict[tuple[str, str], list[Entry]]:
        cells: dict[tuple[str, str], list[Entry]] = {}
        for entry in self.entries:
            cells.setdefault((entry.after, entry.skill), []).append(entry)
        return cells

    def _of(self, after: str, skill: str) -> list[Entry]:
        return self._cells.get((after, skill), [])

    def _count(self, after: str, skill: str) -> tuple[int, int]:
        """Return the entries of a skill after another one that count, and all of them."""
        some = self._of(after, skill)
        return sum(entry.counts for entry in some), len(some)

    def _pair(self, after: str, skill: str) -> Pair:
        """Return the counts of a pair, from its entries and the fresh starts of their robots."""
        some = self._of(after, skill)
        fresh = {entry.robot: entry.counts for entry in self._of(START, skill)}
        some = [entry for entry in some if entry.robot in fresh]
        lost = np.array([fresh[e.robot] and not e.counts for e in some], bool)
        won = np.array([e.counts and not fresh[e.robot] for e in some], bool)
        # More robots than planned were played as the first ones differed: these do not count. Where
        # few came after them, all do, for a chance of two looks.
        later = len(some) - self.calls
        own = slice(self.calls, None) if later >= LATER else slice(None)
        looks = 2 if 0 < later < LATER else 1
        failing = [entry for entry in some if not entry.counts]
        done = [entry for entry in some if entry.counts]
        falls = [entry.steps for entry in failing if not entry.done and not entry.refused]
        return Pair(
            after,
            skill,
            len(some),
            len(done),
            sum(fresh[entry.robot] for entry in some),
            int(lost.sum()),
            int(won.sum()),
            min(1.0, looks * exact_chance(int(lost[own].sum()), int(won[own].sum()))),
            sum(entry.done for entry in failing),
            sum(entry.refused for entry in failing),
            _range([entry.cut for entry in failing]),
            _range([entry.cut for entry in done]),
            int(np.median(falls)) if falls else None,
        )


def check_suffix(path: Path) -> None:
    """Raise a DeclarationError where handovers cannot be written as this file."""
    if path.suffix not in SUFFIXES:
        raise DeclarationError(f"{path} must end in one of {', '.join(SUFFIXES)}")
    if not path.parent.is_dir():
        raise DeclarationError(f"{path}: there is no folder {path.parent}")


_HEAD = ("pair", "done", "fresh start, same robots", "lost", "won", "chance alike")


def _pair_row(pair: Pair) -> list[str]:
    chance = "< 0.0001" if pair.chance < 0.0001 else f"{pair.chance:.2g}"
    return [
        f"{pair.skill} after {pair.after}",
        f"{pair.done} of {pair.calls}",
        f"{pair.alone} of {pair.calls}",
        str(pair.lost),
        str(pair.won),
        chance,
    ]


def _badness(pair: Pair) -> tuple[float, float, str, str]:
    if not pair.calls:
        return (1.0, 1.0, pair.skill, pair.after)
    return ((pair.won - pair.lost) / pair.calls, pair.rate, pair.skill, pair.after)


def _range(values: Sequence[int]) -> tuple[int, int] | None:
    return (min(values), max(values)) if values else None


def _chance(skills: Sequence[str], counts: Sequence[tuple[int, int]]) -> ChainChance:
    """Return the product of shares, with an interval.

    Args:
        counts: done and all, of each link.
    """
    done, every = np.array(counts, np.float64).T
    with np.errstate(invalid="ignore"):
        estimate = float(np.prod(done / every))
    rng = np.random.default_rng(0)
    draws: Array = rng.beta(done + 0.5, every - done + 0.5, (DRAWS, len(counts))).prod(axis=1)
    low, high = np.quantile(draws, (0.025, 0.975)).tolist()
    # What always, or never, was done may always, or never, be (Brown, Cai & DasGupta 2001).
    low, high = (0.0 if estimate == 0 else low), (1.0 if estimate == 1 else high)
    return ChainChance(tuple(skills), estimate, (low, high))
