"""Attribution of a failed handover: to the ends of the first skill, or to the second skill."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from skillweave.arguments import checked_names
from skillweave.errors import RunError
from skillweave.planning.compared import feature_maps
from skillweave.planning.handover import (
    START,
    LinkedCalls,
    before_each,
    calls_done,
    shown_rate,
    wilson,
)
from skillweave.planning.neighbors import Standard, nearest
from skillweave.types import Array

LEAST = 20
"""The fewest calls from which something is concluded."""
BEST = 1 / 3
"""The share of the first skill's ends that are compared with the others."""
LIKE_ELSEWHERE = 0.1
"""From ends that would do, the second skill is done at most this much less often than elsewhere."""
WORSE = 0.25
"""From the other ends it is done at least this much less often."""


@dataclass(frozen=True)
class Blame:
    """The reason why a skill fails after another one.

    Attributes:
        skill: the second skill.
        after: the first skill.
        rate: share of the second skill's calls that are done after the first one.
        elsewhere: this share after all others, and at the start of an episode; NaN: no call.
        calls: the number of calls after the first skill.
        calls_elsewhere: the number of all others.
        best: share that is done from the best third of the first skill's ends, as the other calls
            near each end predict them, beyond what follows from numbers that the first skill does
            not change; NaN where the calls are too few.
        others: share from its other ends.
        place: the number of the flat observation that the first skill changes and in which these
            ends differ most; None: there is none, or images.
        means: its mean at the best ends, and at the others.
        reasons: how the calls that failed ended: own, limit, interrupted, episode.
        first: True if other ends of the first skill would do, so that it is to blame.
    """

    skill: str
    after: str
    rate: float
    elsewhere: float
    calls: int
    calls_elsewhere: int
    best: float
    others: float
    place: int | None
    means: tuple[float, float]
    reasons: dict[str, int]
    first: bool

    @property
    def fine(self) -> bool:
        """True if the second skill is not clearly less often done than elsewhere."""
        elsewhere = 1.0 if np.isnan(self.elsewhere) else self.elsewhere
        high = float(wilson(self.rate * self.calls, self.calls)[1])
        return self.rate >= elsewhere or high >= elsewhere

    def __str__(self) -> str:
        """Return the reason in plain sentences."""
        where = "at the start of an episode" if self.after == START else f"after {self.after!r}"
        here = shown_rate(self.rate * self.calls, self.calls)
        parts = [f"{self.skill!r} is done in {here} {where}"]
        if rest := self.calls_elsewhere:
            parts[0] += f", and in {shown_rate(self.elsewhere * rest, rest)} elsewhere"
        if failed := sum(self.reasons.values()):
            words = ", ".join(
                f"{count / failed:.0%} {_ENDS[reason]}"
                for reason, count in sorted(self.reasons.items(), key=lambda x: -x[1])
                if count
            )
            parts.append(f"Of the calls that failed, {words}")
        if self.fine:
            parts.append("That is no worse than elsewhere, so neither skill is to blame")
        elif self.after == START:
            parts.append(f"So {self.skill!r} itself has to work from there")
        elif not np.isfinite(self.best):
            parts.append(
                f"These are too few calls to say which skill is to blame (at least {LEAST})"
            )
        else:
            third = _third(self.calls)
            best = shown_rate(self.best * third, third)
            worse = shown_rate(self.others * (self.calls - third), self.calls - third)
            parts.append(
                f"{self.after!r} is to blame for where it ends: from the best third of its ends "
                f"{self.skill!r} is done in {best}, from the others in {worse}"
                f"{self._difference()}"
                if self.first
                else f"It would not help if {self.after!r} ended elsewhere: "
                f"from the best third of its ends {self.skill!r} is done in {best}. So "
                f"{self.skill!r} itself has to work from there"
            )
        return ". ".join(parts) + "."

    def _difference(self) -> str:
        if self.place is None:
            return ""
        one, other = (f"{mean:.2g}" for mean in self.means)
        return (
            f" (number {self.place} of the observation is {one} there, and {other} at the others)"
        )


_ENDS = {
    "own": "ended by themselves",
    "limit": "reached their limit of steps",
    "interrupted": "were interrupted",
    "episode": "ended with the episode",
}


def _third(calls: int) -> int:
    return max(1, round(calls * BEST))


def _predicted(at: Array, won: Array, known: Array, rows: Array) -> Array:
    """Return for the starts ``rows`` the share of the nearest other ones that were done.

    Args:
        at: (C, F) features of the starts of all calls.
        won: (C,) bool.
        known: (k,) the calls that count.
        rows: (n,) of these.
    """
    count = min(len(known) - 1, max(5, round(len(known) ** 0.5)))
    near, _ = nearest(at[known], at[rows], count + 1, np.arange(len(known)))
    others = known[near] != rows[:, None]
    score: Array = (won[known[near]] * others).sum(1) / others.sum(1)
    return score


def _largest_difference(
    vector: Array, best: Array, changes: Array
) -> tuple[int | None, tuple[float, float]]:
    """Return the number that differs most between two groups of ends, of those that change."""
    if not changes.any():
        return None, (float("nan"), float("nan"))
    one, other = vector[best].mean(0), vector[~best].mean(0)
    standard = Standard(vector)
    size = np.abs(standard(one) - standard(other))
    place = int(np.where(changes, size, -1).argmax())
    return place, (float(one[place]), float(other[place]))


class BlamedCalls(LinkedCalls):
    """Calls of which the failing ones are explained."""

    @checked_names
    def blame(
        self,
        skill: str,
        after: str,
        done: Mapping[str, Any] | None = None,
        *,
        features: Any = None,
    ) -> Blame:
        """Return why a skill fails after another one: would other ends of the first one do?

        Each call of the second skill after the first is predicted by the nearest other ones. If
        the third of the first skill's ends with the best predictions serve about as well as other
        starts do, and the other ends clearly worse, then the first skill is to blame for how it
        ends; else the second has never learnt to start there.

        Args:
            skill: the second skill.
            after: the first skill, or "start".
            done: as for ``handover``.
            features: as for ``Planner``; images need them.

        Raises:
            DeclarationError: the log has no skill of these names.
            RunError: the log has no call of the second skill after the first one.
        """
        number = self.number(skill)
        if after != START:
            self.number(after)
        won = calls_done(self, done)
        counts = self.skill == number
        before = before_each(self, won)
        wanted = 0 if after == START else self.number(after) + 1
        rows = np.flatnonzero(counts & (before == wanted))
        if not len(rows):
            raise RunError(
                f"the log has no call of {skill!r} after a call of {after!r} that was done; record "
                "more calls, chosen at random"
            )
        others = np.flatnonzero(counts & (before >= 0) & (before != wanted))
        elsewhere = float(won[others].mean()) if len(others) else float("nan")
        reasons = self.take(rows[~won[rows]]).reasons
        rate, nan = float(won[rows].mean()), float("nan")
        unknown = Blame(
            skill, after, rate, elsewhere, len(rows), len(others), nan, nan, None, (nan, nan),
            reasons, False,
        )  # fmt: skip
        if after == START or len(rows) < LEAST:
            return unknown
        maps = feature_maps(self, features, self.start)
        known = np.flatnonzero(counts & (~self.was_cut | won))
        starts, of_first = self.flat(self.start), self.skill[self.owner] == self.number(after)
        changes = (self.flat(self.before[of_first]) != self.flat(self.next_obs[of_first])).any(0)
        # Where a number that the first skill does not change decides, none of its ends is better.
        score = _predicted(maps[number](self.start), won, known, rows)
        score = score - _predicted(
            Standard(starts[:, ~changes])(starts[:, ~changes]), won, known, rows
        )
        best = np.zeros(len(rows), bool)
        best[np.argsort(-score, kind="stable")[: _third(len(rows))]] = True
        good, bad = float(won[rows[best]].mean()), float(won[rows[~best]].mean())
        as_elsewhere = rate if np.isnan(elsewhere) else elsewhere
        low, high = (
            wilson(won[rows[best]].sum(), best.sum())[0],
            wilson(won[rows[~best]].sum(), (~best).sum())[1],
        )
        first = good >= as_elsewhere - LIKE_ELSEWHERE and good - bad >= WORSE and low > high
        place, means = _largest_difference(starts[rows], best, changes)
        return replace(unknown, best=good, others=bad, place=place, means=means, first=bool(first))
