"""Handover: how often each skill succeeds after each other one, chains, and why it fails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from html import escape
from typing import Any

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import aligned, short, suggest
from skillweave._internal.notebooks import table
from skillweave.errors import DeclarationError, RunError
from skillweave.planning.columns import CallColumns
from skillweave.planning.compared import feature_maps
from skillweave.planning.lacking import read_log
from skillweave.planning.mission import Mission
from skillweave.planning.neighbors import Standard, nearest
from skillweave.planning.predicates import Event, Held, as_event
from skillweave.policies.core import CallEnd
from skillweave.policies.plan import weights_of
from skillweave.schema import fitted
from skillweave.types import Array

START = "start"
"""The row of calls that begin an episode."""
Z = 1.96
"""Standard deviations of a 95 % interval."""
NEIGHBORS = 5
LEAST = 20
"""The fewest calls from which something is concluded."""
BEST = 1 / 3
"""The share of the first skill's ends that are compared with the others."""
LIKE_ELSEWHERE = 0.1
"""From ends that would do, the second skill is done at most this much less often than elsewhere."""
WORSE = 0.25
"""From the other ends it is done at least this much less often."""


@dataclass(frozen=True, eq=False)
class Handover:
    """Counts of calls and of those that were done, by the skill before.

    Attributes:
        skills: names, the columns.
        before: "start" and the skills, the rows.
        calls: (S + 1, S) int64.
        done: (S + 1, S) int64.
        cut: (S,) int64, calls of each skill that were left out, as the episode's time limit cut
            them.
        by_itself: skills without a ``success`` and an event of ``done``: a call of theirs is done
            if it ended by itself.
    """

    skills: tuple[str, ...]
    calls: Array
    done: Array
    cut: Array
    by_itself: tuple[str, ...] = ()

    @property
    def before(self) -> tuple[str, ...]:
        """The skills before, and "start" in front of them."""
        return (START, *self.skills)

    @property
    def rate(self) -> Array:
        """The share of calls that were done, (S + 1, S); NaN where there were none."""
        with np.errstate(invalid="ignore"):
            rate: Array = self.done / np.where(self.calls > 0, self.calls, np.nan)
        return rate

    @property
    def interval(self) -> tuple[Array, Array]:
        """The bounds of 95 % intervals of the rates, (S + 1, S) each (Wilson 1927)."""
        return wilson(self.done, self.calls)

    def of(self, skill: str, after: str = START) -> tuple[float, int]:
        """Return the rate of a skill after another one (or after "start"), and the calls.

        Raises:
            DeclarationError: the log has no skill of these names.
        """
        for name, known in ((skill, self.skills), (after, self.before)):
            if name not in known:
                raise DeclarationError(
                    f"the log has no skill {short(name)}{suggest(name, self.skills)}"
                )
        place = self.before.index(after), self.skills.index(skill)
        return float(self.rate[place]), int(self.calls[place])

    def weakest(self, least: int = 20) -> list[str]:
        """Return sentences on the skills that are never done, and on weak handovers.

        A handover is weak where a skill is done much less often after one skill than elsewhere.

        Args:
            least: the fewest calls that count.
        """
        never, (calls, done) = self._never(least), self._elsewhere
        sentences = [
            f"{skill!r} succeeds in {shown_rate(0, count)}, whatever came before"
            for skill, count, none in zip(self.skills, self.calls.sum(0), never, strict=True)
            if none
        ]
        for i, j in self.weak(least):
            if never[j]:
                continue
            skill, elsewhere = self.skills[j], shown_rate(done[i, j], calls[i, j])
            does = "ends by itself" if skill in self.by_itself else "succeeds"
            where = "at the start of an episode" if i == 0 else f"after {self.before[i]!r}"
            here = shown_rate(self.done[i, j], self.calls[i, j])
            sentences.append(f"{skill!r} {does} in {here} {where}; in {elsewhere} elsewhere")
        return sentences

    @property
    def _elsewhere(self) -> tuple[Array, Array]:
        """Calls of each skill in the other rows, and of these that were done, (S + 1, S) each."""
        return self.calls.sum(0) - self.calls, self.done.sum(0) - self.done

    def _never(self, least: int) -> Array:
        """Return the skills with a success that they never reach, (S,) bool."""
        never: Array = (self.calls.sum(0) >= least) & ~self.done.any(0)
        return never & ~np.isin(self.skills, self.by_itself)

    def weak(self, least: int = 20) -> list[tuple[int, int]]:
        """Return the places (row, column) that ``weakest`` is about."""
        calls, done = self._elsewhere
        weak = (self.calls >= least) & (calls >= least)
        weak &= self.interval[1] < wilson(done, calls)[0]
        weak |= self._never(least) & (self.calls > 0)
        return [(i, j) for j, i in np.argwhere(weak.T).tolist()]

    @property
    def meaning(self) -> str:
        """A sentence on what counts as done."""
        if not self.by_itself:
            return "A call is done if it succeeded."
        names = ", ".join(self.by_itself)
        if len(self.by_itself) == len(self.skills):
            return "No success() is known: a call is done if it ended by itself."
        return f"A call is done if it succeeded; without success() ({names}) if it ended by itself."

    def to_json(self) -> dict[str, Any]:
        """Return the counts, and the sentences of ``weakest``, as plain JSON."""
        return {
            "skills": list(self.skills),
            "before": list(self.before),
            "calls": self.calls.tolist(),
            "done": self.done.tolist(),
            "cut": self.cut.tolist(),
            "by_itself": list(self.by_itself),
            "weakest": self.weakest(),
        }

    def rows(self) -> list[list[str]]:
        """Return the rows of a table: the skill before, then rates, calls and intervals."""
        return [
            [
                name,
                *(
                    shown_rate(done, calls, "") if calls else "-"
                    for done, calls in zip(self.done[i], self.calls[i], strict=True)
                ),
            ]
            for i, name in enumerate(self.before)
        ]

    def __str__(self) -> str:
        """Return the matrix as a table of text: rates, calls, intervals, what is done."""
        return f"{aligned([('after', *self.skills), *self.rows()])}\n{self.meaning}"

    def _repr_html_(self) -> str:
        return table(["after", *self.skills], self.rows()) + f"<p>{escape(self.meaning)}</p>"


@dataclass(frozen=True)
class Chain:
    """The chance that skills are done one after another, a call each."""

    skills: tuple[str, ...]
    estimate: float
    """Along logged calls: from where each call ended, the nearest calls of the next skill."""
    product: float
    """The product of the rates of the handover matrix; NaN where a pair has no call."""
    rates: tuple[float, ...]
    """The factors of the product."""
    calls: tuple[int, ...]
    """The number of calls that each factor was counted from."""

    def __str__(self) -> str:
        """Return the estimate and the product as a sentence."""
        text = f"{' then '.join(self.skills)}: {self.estimate:.0%} along the logged calls; "
        if 0 in self.calls:
            name = self.skills[self.calls.index(0)]
            return f"{text}no product, as no logged call of {name!r} came right after"
        factors = " x ".join(
            f"{rate:.0%} of {calls:,}" for rate, calls in zip(self.rates, self.calls, strict=True)
        )
        return f"{text}{self.product:.0%} as the product {factors}"


def pair_counts(before: Array, skill: Array, won: Array, count: int) -> tuple[Array, Array]:
    """Return how many calls follow each skill, and how many of these were done, (S + 1, S) each.

    Args:
        before: (C,) rows of the matrix.
        skill: (C,) columns.
        won: (C,) bool, the calls that were done.
        count: S.
    """
    place, shape = before * count + skill, (count + 1, count)
    calls, done = (np.bincount(x, minlength=np.prod(shape)) for x in (place, place[won]))
    return calls.reshape(shape), done.reshape(shape)


def before_each(log: CallColumns, won: Array, only_after_done: bool = True) -> Array:
    """Return the row of the matrix in which each call counts, (C,) int64; −1: in none.

    Args:
        won: (C,) bool, the calls that were done.
        only_after_done: as for ``CallLog.handover``.
    """
    before = np.full(len(log), -1)
    following = log.followed_by
    first = np.flatnonzero((following >= 0) & (won | (not only_after_done)))
    before[following[first]] = log.skill[first] + 1
    before[log.order == 0] = 0
    before[log.was_cut & ~won] = -1
    return before


@dataclass(frozen=True)
class CallEnds:
    """The ends of one skill's calls."""

    skill: str
    calls: int
    reasons: dict[str, int]
    """Calls by the reason of their end: own, limit, interrupted, episode."""
    own_with_episode: int
    """Calls that ended by themselves in the episode's last step; ``reasons`` has them as own."""
    steps: float
    """Mean steps of a call."""
    succeeded: float
    """Share of calls that succeeded."""
    quantiles: Array
    """(3, F) numbers of the flat observation that 10, 50 and 90 % of the calls end below."""

    def __str__(self) -> str:
        """Return all but the quantiles as a sentence."""
        ends = ", ".join(f"{why} {count / self.calls:.0%}" for why, count in self.reasons.items())
        if self.own_with_episode:
            ends += f"; own in the episode's last step {self.own_with_episode / self.calls:.0%}"
        return (
            f"{self.skill}: {self.calls:,} calls of {self.steps:.1f} steps, of which "
            f"{self.succeeded:.0%} succeeded; ends: {ends}"
        )


def calls_done(log: CallColumns, done: Mapping[str, Any] | None) -> Array:
    """Return which calls were done, (C,) bool: by an event inside, or by the skill's success."""
    won = log.succeeded.copy()
    if done is None:
        return won
    for name, event in fitted(Mapping[str, Any], done, "done").items():
        rows = np.flatnonzero(log.skill == log.number(name))
        won[rows] = happened(log.take(rows), as_event(event, f"done of {name!r}"))
    return won


def happened(log: CallColumns, event: Event) -> Array:
    """Return the calls within which an event happened, (C,) bool."""
    steps = event.steps if isinstance(event, Held) else 1
    # By step, how often it held so far; the predicate is the first of the task's events.
    count = np.cumsum(np.pad(read_log(Mission(event), log).events[:, 0], (steps, 0)))
    full = (count[steps:] - count[:-steps] == steps) & (log.elapsed >= steps)
    found: Array = np.bincount(log.owner[full], minlength=len(log)) > 0
    return found


def wilson(successes: Any, trials: Any) -> tuple[Array, Array]:
    """Return the bounds of 95 % intervals of shares (Wilson 1927, "Probable inference").

    Args:
        successes: counts.
        trials: counts; where 0, the interval is 0 to 1.
    """
    n = np.asarray(trials, np.float64)
    safe = np.maximum(n, 1.0)
    share = np.asarray(successes) / safe
    middle = (share + Z * Z / (2 * safe)) / (1 + Z * Z / safe)
    half = Z / (1 + Z * Z / safe) * np.sqrt(share * (1 - share) / safe + (Z / (2 * safe)) ** 2)
    low = np.where(n > 0, np.clip(middle - half, 0.0, 1.0), 0.0)
    return low, np.where(n > 0, np.clip(middle + half, 0.0, 1.0), 1.0)


def shown_rate(done: float, calls: float, what: str = " calls") -> str:
    """Return a share with its count and its 95 % interval, in words."""
    low, high = wilson(done, calls)
    return f"{done / calls:.0%} of {calls:,}{what} ({low:.0%} to {high:.0%})"


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


class LinkedCalls(CallColumns):
    """Calls, counted by the skill before; the failing ones are explained."""

    @checked_names
    def handover(
        self, done: Mapping[str, Any] | None = None, *, only_after_done: bool = True
    ) -> Handover:
        """Count how often each skill is done after each other one.

        A row counts the calls that follow a call of its skill. Calls that the episode's time limit
        cut before they were done are left out.

        Args:
            done: by skill, the event that its calls are for, in place of the skill's ``success``:
                a predicate, a function of observations or of a ``Step``, or ``held(...)``; a call
                is done if it happened within the call. A call of a skill with neither is done if it
                ended by itself.
            only_after_done: leave out calls that follow a call that was not done.

        Raises:
            DeclarationError: ``done`` names an unknown skill, or holds no event.
        """
        count = len(self.skills)
        won = calls_done(self, done)
        before = before_each(self, won, only_after_done)
        rows = np.flatnonzero(before >= 0)
        calls, did = pair_counts(before[rows], self.skill[rows], won[rows], count)
        cut = np.bincount(self.skill[self.was_cut & ~won], minlength=count)
        by_itself = tuple(
            name
            for name, judged in zip(self.skills, self.own_success, strict=True)
            if not judged and name not in (done or {})
        )
        return Handover(self.skills, calls, did, cut, by_itself)

    @checked_names
    def chain(
        self, *skills: str, done: Mapping[str, Any] | None = None, features: Any = None
    ) -> Chain:
        """Estimate how often skills are done one after another, a call each, from episodes' starts.

        The estimate follows logged calls: from where a call ended, the nearest calls of the next
        skill count, by distance. So it knows that a skill ends elsewhere after another one, which
        the product of rates does not.

        Args:
            *skills: names, in their order.
            done: as for ``handover``.
            features: as for ``Planner``.

        Raises:
            DeclarationError: no skill is named, or one that is unknown.
            RunError: the log has no call of a skill, or none of the first at an episode's start.
        """
        if not skills:
            raise DeclarationError("chain() needs the names of skills: chain('left', 'right')")
        numbers = [self.number(name) for name in skills]
        won = calls_done(self, done)
        counts = ~self.was_cut | won
        rows = [np.flatnonzero(counts & (self.skill == number)) for number in numbers]
        rows[0] = rows[0][self.order[rows[0]] == 0]
        for name, some in zip(skills, rows, strict=True):
            if not len(some):
                where = " at the start of an episode" if some is rows[0] else ""
                raise RunError(
                    f"the log has no complete call of {name!r}{where}; record more calls, chosen "
                    "at random"
                )
        maps = feature_maps(self, features, np.concatenate([self.start, self.end]))
        # From the last skill back: the chance that the rest of the chain is done after each call.
        chance = won[rows[-1]].astype(np.float64)
        for i in reversed(range(len(skills) - 1)):
            here = maps[numbers[i + 1]]
            starts, ends = here(self.start[rows[i + 1]]), here(self.end[rows[i]])
            near, distance = nearest(starts, ends, NEIGHBORS, rows[i + 1])
            follows = (weights_of(distance) * chance[near]).sum(1)
            may = self.may_follow[rows[i]].reshape(len(rows[i]), len(self.skills), -1)
            goes_on = won[rows[i]] & ~self.terminated[rows[i]]
            follows_on = goes_on & may[:, numbers[i + 1]].any(1)
            if goes_on.any() and not follows_on.any():
                raise RunError(
                    f"{skills[i + 1]!r} may not start where any logged call of {skills[i]!r} was "
                    "done (its initiation() is False there), so this chain cannot be run"
                )
            chance = np.where(follows_on, follows, 0.0)
        matrix = self.handover(done)
        pairs = [matrix.of(b, a) for a, b in zip((START, *skills), skills, strict=False)]
        rates = tuple(rate for rate, _ in pairs)
        return Chain(
            tuple(skills),
            float(chance.mean()),
            float(np.prod(rates)),
            rates,
            tuple(count for _, count in pairs),
        )

    @checked_names
    def call_ends(self, skill: str) -> CallEnds:
        """Return where the calls of a skill end, and why.

        Args:
            skill: its name.

        Raises:
            DeclarationError: the log has no skill of this name.
            RunError: the log has no call of it.
        """
        some = self.of(skill)
        if not len(some):
            raise RunError(f"the log has no call of {skill!r}; record some")
        return CallEnds(
            skill,
            len(some),
            some.reasons,
            int(((some.end_reason == CallEnd.OWN) & (some.terminated | some.truncated)).sum()),
            float(some.tau.mean()),
            float(some.succeeded.mean()),
            np.quantile(self.flat(some.end), (0.1, 0.5, 0.9), axis=0),
        )

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
        wanted = 0 if after == START else self.number(after) + 1
        won = calls_done(self, done)
        counts = self.skill == number
        before = before_each(self, won)
        rows = np.flatnonzero(counts & (before == wanted))
        if not len(rows):
            raise RunError(
                f"the log has no call of {skill!r} after a call of {after!r} that was done; record "
                "more calls, chosen at random"
            )
        others = np.flatnonzero(counts & (before >= 0) & (before != wanted))
        nan, did = float("nan"), won[rows]
        elsewhere = float(won[others].mean()) if len(others) else nan
        reasons, rate = self.take(rows[~did]).reasons, float(did.mean())
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
        good, bad = float(did[best].mean()), float(did[~best].mean())
        as_elsewhere = rate if np.isnan(elsewhere) else elsewhere
        low, _ = wilson(did[best].sum(), best.sum())
        _, high = wilson(did[~best].sum(), (~best).sum())
        first = good >= as_elsewhere - LIKE_ELSEWHERE and good - bad >= WORSE and low > high
        place, means = _largest_difference(starts[rows], best, changes)
        return replace(unknown, best=good, others=bad, place=place, means=means, first=bool(first))
