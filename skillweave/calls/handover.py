"""Handover: how often each skill succeeds after each other one, chains, and why it fails."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from html import escape
from itertools import pairwise
from typing import Any

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import aligned, short, suggest
from skillweave._internal.notebooks import table
from skillweave.calls.columns import CallColumns
from skillweave.calls.compared import feature_maps
from skillweave.calls.neighbors import Standard, nearest
from skillweave.calls.predicates import Event, Held, as_event, predicate_of, reads_of
from skillweave.errors import DeclarationError, RunError
from skillweave.policies.core import Array, CallEnd
from skillweave.policies.plan import weights_of
from skillweave.schema import fitted

START = "start"
"""The row of calls that begin an episode."""
Z = 1.96
"""Standard deviations of a 95 % interval."""
NEIGHBORS = 5
LEAST = 20
"""The fewest calls from which something is concluded in any case."""
FEW = 5
"""The fewest calls that are called weak, where they are clearly worse than the others."""
CHANCE = 0.01
"""The chance that any pair of a matrix is called weak where all are alike."""
GOOD = 0.95
"""A pair that is done at least this often is not weak."""
DOUBTFUL = 0.1
"""A pair with few calls may be weak where it is done so much less often than elsewhere."""
ALIKE = 0.02
"""Ends are alike where no number is on average farther from its mean, relative to its range over
the log."""
DIVIDES = 0.7
"""A number divides calls where this share of those that fail starts outside of the others."""
SELDOM = 0.25
"""A skill is seldom done where its rate is clearly below."""
SHOWN = 4
"""Pairs that a sentence names at most."""
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
        began_late: (S + 1, S) int64, calls that are left out, as they began too late to run their
            whole length before the episode's time limit.
        by_itself: skills without a ``success`` and an event of ``done``: a call of theirs is done
            if it ended by itself.
        time_limit: the steps after which episodes are truncated; 0: none is seen.
        needed: (S + 1, S) int64, the steps of an episode in which half of the calls that began too
            late would have counted, 0: there were none; None: unknown.
        steps: the logged steps; 0: unknown.
        cut_else: calls that count, and were cut by a truncation before the time limit: they count
            as they ended.
    """

    skills: tuple[str, ...]
    calls: Array
    done: Array
    began_late: Array
    by_itself: tuple[str, ...] = ()
    time_limit: int = 0
    needed: Array | None = None
    steps: int = 0
    cut_else: int = 0

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

    def time_words(self, skill: str, after: str) -> str:
        """Return words on the calls of a pair that began too late to count; empty: few did."""
        place = np.zeros(self.calls.shape, bool)
        place[self.before.index(after), self.skills.index(skill)] = True
        late = place & self._lacks_time
        if not late.any():
            return ""
        return (
            f"{int(self.began_late[late].sum()):,} of {int(self._all[late].sum()):,} calls began "
            f"too late to run their whole length; {self._more_time(late)}"
        )

    def weakest(self, least: int = FEW) -> list[str]:
        """Return sentences on the skills that are never done, on weak handovers, and on few calls.

        A handover is weak where a skill is done less often after one skill than elsewhere, and by
        more than chance, though there are many pairs (Fisher's exact test). Pairs that may be weak,
        but have too few calls to say so, are named, with the logged steps that it takes; and pairs
        whose calls began too late to count.

        Args:
            least: the fewest calls that count.
        """
        few = (self.calls > 0) & (self.calls < LEAST) & ~self._is_weak(least)
        weak = [*self.weak_sentences(least), *self._seldom(least)]
        return [*weak, *self._doubtful(few), *self._without_time()]

    def _seldom(self, least: int) -> list[str]:
        """Return a sentence on each skill that is seldom done, wherever it is called."""
        calls, done = self.calls.sum(0), self.done.sum(0)
        seldom = (calls >= least) & (done > 0) & (wilson(done, calls)[1] < SELDOM)
        seldom &= ~np.isin(self.skills, self.by_itself)
        return [
            f"{self.skills[j]!r} succeeds in only {shown_rate(done[j], calls[j])} in all"
            for j in np.flatnonzero(seldom)
        ]

    def weak_sentences(self, least: int = FEW) -> list[str]:
        """Return the sentences of ``weakest`` on the places of ``weak``."""
        never = self._never(least)
        (calls, done) = self._elsewhere
        sentences = [
            f"{skill!r} succeeds in {shown_rate(0, count)}, whatever came before"
            for skill, count, none in zip(self.skills, self.calls.sum(0), never, strict=True)
            if none
        ]
        for i, j in self.weak(least):
            if never[j]:
                continue
            skill = self.skills[j]
            elsewhere = shown_rate(done[i, j], calls[i, j])
            does = "ends by itself" if skill in self.by_itself else "succeeds"
            where = "at the start of an episode" if i == 0 else f"after {self.before[i]!r}"
            here = shown_rate(self.done[i, j], self.calls[i, j])
            sentences.append(f"{skill!r} {does} in {here} {where}; in {elsewhere} elsewhere")
        return sentences

    def _doubtful(self, few: Array) -> list[str]:
        """Return a sentence on the pairs ``few`` (S + 1, S) that may be weak, if there are any."""
        calls, done = self._elsewhere
        with np.errstate(invalid="ignore"):
            worse = self.rate < done / np.where(calls > 0, calls, np.nan) - DOUBTFUL
        if not (few & worse).any():
            return []
        pairs = self._pairs(
            few & worse, lambda place: shown_rate(self.done[place], self.calls[place])
        )
        more = "record more calls"
        if self.steps:
            steps = rounded_up(self.steps * LEAST / int(self.calls[few & worse].min()))
            more = (
                f"with about {steps:,} logged steps, in place of {self.steps:,}, each has {LEAST}"
            )
        return [f"Too few calls to say whether a handover is weak: {pairs}; {more}"]

    def _without_time(self) -> list[str]:
        """Return a sentence on the pairs most of whose calls began too late; none if none is."""
        place = self._lacks_time
        if not place.any():
            return []
        pairs = self._pairs(place, lambda at: f"{self.calls[at]:,} of {self._all[at]:,} calls")
        return [f"Too few calls begin early enough to count: {pairs}; {self._more_time(place)}"]

    def _more_time(self, place: Array) -> str:
        """Return words on what makes the calls of pairs ``place`` (S + 1, S) count."""
        assert self.needed is not None
        needed = int(np.median(self.needed[place]))
        return (
            f"that takes episodes of about {needed:,} steps, in place of {self.time_limit:,}, or "
            "shorter calls (call_steps, max_steps)"
        )

    def _pairs(self, place: Array, words: Callable[[tuple[int, int]], str]) -> str:
        """Return a list of the pairs ``place`` (S + 1, S) bool, with words on each."""
        at = [(i, j) for j, i in np.argwhere(place.T).tolist()]
        each = [
            f"{self.skills[j]!r} {f'after {self.before[i]!r}' if i else 'at the start'} "
            f"({words((i, j))})"
            for i, j in at[:SHOWN]
        ]
        more = [f"{len(at) - SHOWN} more"] if len(at) > SHOWN else []
        return ", ".join([*each, *more])

    @property
    def _lacks_time(self) -> Array:
        """The pairs with few calls, as most began too late, (S + 1, S) bool."""
        lacks: Array = (self.calls < LEAST) & (self.began_late > np.maximum(self.calls, 2))
        return lacks

    @property
    def _all(self) -> Array:
        """Calls of each pair, with those that began too late, (S + 1, S)."""
        every: Array = self.calls + self.began_late
        return every

    @property
    def _elsewhere(self) -> tuple[Array, Array]:
        """Calls of each skill in the other rows, and of these that were done, (S + 1, S) each."""
        return self.calls.sum(0) - self.calls, self.done.sum(0) - self.done

    def _never(self, least: int) -> Array:
        """Return the skills with a success that they never reach, (S,) bool."""
        never: Array = (self.calls.sum(0) >= least) & ~self.done.any(0)
        return never & ~np.isin(self.skills, self.by_itself)

    def _is_weak(self, least: int) -> Array:
        """Return the places of ``weak`` as a mask, (S + 1, S) bool."""
        calls, done = self._elsewhere
        compared = (self.calls > 0) & (calls > 0)
        worse = compared & (self.calls >= least) & (calls >= least) & (self.rate < GOOD)
        weak = self._never(least) & (self.calls > 0)
        for i, j in np.argwhere(worse & (self.rate * calls < done)).tolist():
            chance = _chance_of_fewer(
                int(self.done[i, j]), int(self.calls[i, j]), int(done[i, j]), int(calls[i, j])
            )
            weak[i, j] |= chance < CHANCE / int(compared.sum())
        return weak

    def weak(self, least: int = FEW) -> list[tuple[int, int]]:
        """Return the places (row, column) of skills that are never done, and of weak handovers."""
        return [(i, j) for j, i in np.argwhere(self._is_weak(least).T).tolist()]

    @property
    def meaning(self) -> str:
        """A sentence on what counts as done."""
        if not self.by_itself:
            return "A call is done if it succeeded."
        names = ", ".join(self.by_itself)
        if len(self.by_itself) == len(self.skills):
            return "No success() is known: a call is done if it ended by itself."
        return f"A call is done if it succeeded; without success() ({names}) if it ended by itself."

    @property
    def left_out(self) -> str:
        """Sentences on calls that began too late, or were cut otherwise; empty: there were none."""
        late = int(self.began_late.sum())
        sentences = []
        if late:
            few = self._lacks_time
            more = f". Some pairs have few calls left; {self._more_time(few)}" if few.any() else ""
            sentences.append(
                "Left out, as they began too late to run their whole length before the episode's "
                f"time limit of {self.time_limit:,} steps: {late:,} call{'s' * (late != 1)}{more}."
            )
        if self.cut_else:
            before = f" before step {self.time_limit:,}" if self.time_limit else ""
            sentences.append(
                f"In {self.cut_else:,} call{'s' * (self.cut_else != 1)} the environment truncated "
                f"the episode{before}, which counts as the end of the call."
            )
        return " ".join(sentences)

    def to_json(self) -> dict[str, Any]:
        """Return the counts, and the sentences of ``weakest``, as plain JSON."""
        return {
            "skills": list(self.skills),
            "before": list(self.before),
            "calls": self.calls.tolist(),
            "done": self.done.tolist(),
            "began_late": self.began_late.tolist(),
            "by_itself": list(self.by_itself),
            "time_limit": self.time_limit,
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
        words = " ".join(filter(None, (self.meaning, self.left_out)))
        return f"{aligned([('after', *self.skills), *self.rows()])}\n{words}"

    def _repr_html_(self) -> str:
        words = " ".join(filter(None, (self.meaning, self.left_out)))
        return table(["after", *self.skills], self.rows()) + f"<p>{escape(words)}</p>"


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
    interval: tuple[float, float]
    """The 95 % interval of the estimate, by the episodes whose calls count at the scarcest step."""

    def __str__(self) -> str:
        """Return the estimate and the product as a sentence."""
        low, high = self.interval
        text = (
            f"{' then '.join(self.skills)}: {self.estimate:.0%} ({low:.0%} to {high:.0%}) along "
            "the logged calls; "
        )
        if 0 in self.calls:
            name = self.skills[self.calls.index(0)]
            return f"{text}no product, as no logged call of {name!r} came right after and counts"
        factors = " x ".join(
            f"{rate:.0%} of {calls:,}" for rate, calls in zip(self.rates, self.calls, strict=True)
        )
        return f"{text}{self.product:.0%} as the product {factors}"


def pair_counts(
    before: Array, skill: Array, won: Array, count: int, counts: Array | None = None
) -> tuple[Array, Array]:
    """Return how many calls follow each skill, and how many of these were done, (S + 1, S) each.

    Args:
        before: (C,) rows of the matrix.
        skill: (C,) columns.
        won: (C,) bool, the calls that were done.
        count: S.
        counts: (C,) bool, the calls that are counted; None: all.
    """
    if counts is not None:
        before = before[counts]
        skill = skill[counts]
        won = won[counts]
    place = before * count + skill
    shape = (count + 1, count)
    calls, done = (np.bincount(x, minlength=np.prod(shape)) for x in (place, place[won]))
    return calls.reshape(shape), done.reshape(shape)


def before_each(log: CallColumns, won: Array, only_after_done: bool = True) -> Array:
    """Return the row of the matrix in which each call counts, (C,) int64; −1: in none.

    Args:
        won: (C,) bool, the calls that were done.
        only_after_done: as for ``CallLog.handover``.
    """
    return np.where(log.began_late, -1, _row_of_each(log, won, only_after_done))


def _row_of_each(log: CallColumns, won: Array, only_after_done: bool) -> Array:
    """Return ``before_each``, with the calls that began too late."""
    before = np.full(len(log), -1)
    following = log.followed_by
    first = np.flatnonzero((following >= 0) & (won | (not only_after_done)))
    before[following[first]] = log.skill[first] + 1
    before[log.order == 0] = 0
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
    with reads_of(log):
        holds = predicate_of(event).holds(log.as_steps())
    count = np.cumsum(np.pad(holds, (steps, 0)))  # by step, how often it held so far
    full = (count[steps:] - count[:-steps] == steps) & (log.elapsed >= steps)
    found: Array = np.bincount(log.owner[full], minlength=len(log)) > 0
    return found


def wilson(successes: Any, trials: Any) -> tuple[Array, Array]:
    """Return the bounds of 95 % intervals of shares, such as handover rates (Wilson 1927).

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


def _others(starts: Array, ends: Array, calls: Array, own: Array) -> tuple[Array, Array]:
    """Return the nearest calls to ends, and their weights, (n, K) each.

    The call that followed an end is left out: its outcome would be its own forecast.

    Args:
        starts: (m, F) of calls.
        ends: (n, F).
        calls: (m,) the calls' numbers.
        own: (n,) the number of the call that followed each end; −1: none.
    """
    near, distance = nearest(starts, ends, NEIGHBORS + 1, calls)
    is_own = (calls[near] == own[:, None]) & (np.isfinite(distance).sum(1) > 1)[:, None]
    distance = np.where(is_own, np.inf, distance)
    order = np.argsort(distance, axis=1, kind="stable")[:, :NEIGHBORS]
    near, distance = (np.take_along_axis(x, order, 1) for x in (near, distance))
    return near, weights_of(distance)


def _bounds(estimate: float, share: Array, episode: Array) -> tuple[float, float]:
    """Return a 95 % interval of a chance, as far as it follows from the calls of one step.

    Calls of one episode are not independent, and few of them may count for most.

    Args:
        estimate: the chance of all steps.
        share: (n,) of the chains that come by each call of the step.
        episode: (n,) of each call.
    """
    reached = float(share.sum())
    if not reached:
        return 0.0, 1.0
    by_episode = np.bincount(np.unique(episode, return_inverse=True)[1], share)
    count = reached**2 / float(np.square(by_episode).sum())
    low, high = wilson(estimate / reached * count, count)
    return reached * float(low), reached * float(high)


def _chance_of_fewer(done: int, calls: int, done_elsewhere: int, calls_elsewhere: int) -> float:
    """Return the chance of at most ``done`` of ``calls``, if it is as elsewhere (Fisher 1934)."""
    won, all_calls = done + done_elsewhere, calls + calls_elsewhere
    logs = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, all_calls + 1)))])

    def choose(n: int, k: Array) -> Array:
        ways: Array = logs[n] - logs[k] - logs[n - k]
        return ways

    k = np.arange(max(0, calls - (all_calls - won)), done + 1)
    ways = choose(won, k) + choose(all_calls - won, calls - k) - choose(all_calls, np.array(calls))
    return float(np.exp(ways).sum())


def rounded_up(number: float) -> int:
    """Return a number with its first two digits, rounded up."""
    unit = int(10 ** max(0, len(str(int(number))) - 2))
    return int(-(-number // unit)) * unit


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
        reasons: the ends of the calls that failed: own, limit, interrupted, episode.
        first: True if other ends of the first skill would do, so that it is to blame.
        works: where the second skill is clearly more often done: the skill before ("start": none),
            its calls that are done there, and all.
        differs: the number of the flat observation, of those that the first skill changes, that
            divides calls best; the bounds of 90 % of the starts from which the second skill is
            done anywhere; and the share of the calls that fail here that start outside. None: no
            number divides them.
        alike: True if all ends of the first skill are alike.
        stuck: True if nothing changes any more in the last quarter of most calls that failed.
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
    works: tuple[tuple[str, int, int], ...] = ()
    differs: tuple[int, float, float, float] | None = None
    alike: bool = False
    stuck: bool = False

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
            if self.reasons.get("limit") == failed:
                parts.append(
                    "Most stood still before it, so more steps alone would not help"
                    if self.stuck
                    else "So they may need more steps (call_steps, max_steps)"
                )
        if self.fine:
            parts.append("That is no worse than elsewhere, so neither skill is to blame")
        elif self.after == START:
            parts.append(f"So {self.skill!r} itself has to work from there")
        elif not np.isfinite(self.best):
            parts.append(
                f"These are too few calls to say which skill is to blame (at least {LEAST})"
            )
        else:
            parts.append(self._verdict())
        if not self.fine and not self.first and self.works:
            parts.append(self._elsewhere())
        return ". ".join(parts) + "."

    def _verdict(self) -> str:
        """Return words on which of the two skills is to blame."""
        third = _third(self.calls)
        best = shown_rate(self.best * third, third)
        worse = shown_rate(self.others * (self.calls - third), self.calls - third)
        if self.first:
            return (
                f"{self.after!r} is to blame for where it ends: from the best third of its ends "
                f"{self.skill!r} is done in {best}, from the others in {worse}{self._difference()}"
            )
        if self.alike:
            ends = (
                f"All ends of {self.after!r} are alike, so they do not say whether others would do"
            )
        else:
            ends = f"From the best third of the ends of {self.after!r} it is done in {best}"
        if self.works:
            return ends
        return f"{ends}. So {self.skill!r} itself has to work from there"

    def _elsewhere(self) -> str:
        """Return words on where the second skill works, and how these starts differ."""
        where = ", ".join(
            f"{'at the start of an episode' if name == START else f'after {name!r}'} "
            f"({shown_rate(done, calls)})"
            for name, done, calls in self.works[:SHOWN]
        )
        text = f"{self.skill!r} works {where}"
        if self.differs is not None:
            place, low, high, outside = self.differs
            text += (
                f". Where it is done, number {place} of the observation is from {low:.2g} to "
                f"{high:.2g} at the start; {outside:.0%} of the calls that fail here start outside"
            )
        if self.after == START:
            return f"{text}. So it has to learn to start here, too"
        between = "another skill has to come in between"
        text = f"{text}. So {self.skill!r} itself has to work from there"
        if self.differs is None:
            return f"{text}, or {between}"
        return f"{text}, {between}, or {self.after!r} has to end where {self.skill!r} works"

    def _difference(self) -> str:
        """Return words on the number that differs most between the starts of calls."""
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
    """Return the number that differs most between two groups of starts, of those that change.

    Args:
        vector: (n, F) of the starts.
        best: (n,) bool, those of the first group.
        changes: (F,) bool, the numbers that count.
    """
    if not changes.any():
        return None, (float("nan"), float("nan"))
    one = vector[best].mean(0)
    other = vector[~best].mean(0)
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

        A row counts the calls that follow a call of its skill. A call that began too late to run
        its whole length before the episode's time limit is left out, whatever its outcome. Its
        whole length is its limit; without one, the longest call of that skill that came to its own
        end.

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
        before = _row_of_each(self, won, only_after_done)
        by_itself = tuple(
            name
            for name, judged in zip(self.skills, self.own_success, strict=True)
            if not judged and name not in (done or {})
        )
        known = before >= 0
        calls, did = pair_counts(before, self.skill, won, count, known & ~self.began_late)
        late, _ = pair_counts(before, self.skill, won, count, known & self.began_late)
        needed = np.zeros_like(late)
        for i, j in np.argwhere(late > 0).tolist():
            rows = self.began_late & (before == i) & (self.skill == j)
            ends = self.age[rows] + self.whole_steps[self.choice[rows]]
            needed[i, j] = np.quantile(ends, 0.5, method="higher")
        else_cut = known & ~self.began_late & self.was_cut
        else_cut &= self.age + self.tau != self.time_limit
        return Handover(
            self.skills,
            calls,
            did,
            late,
            by_itself,
            self.time_limit,
            needed,
            self.steps,
            int(else_cut.sum()),
        )

    def _too_late(self, calls: Array) -> str:
        """Return words on calls (k,) that began too late; empty: there are none."""
        late = calls[self.began_late[calls]]
        if not len(late):
            return ""
        needed = self.age[late] + self.whole_steps[self.choice[late]]
        return (
            f": {len(late):,} began too late to run their whole length before the episode's time "
            f"limit of {self.time_limit:,} steps; that takes episodes of about "
            f"{int(np.median(needed)):,} steps, or shorter calls (call_steps, max_steps)"
        )

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
        every = [np.flatnonzero(self.skill == number) for number in numbers]
        every[0] = every[0][self.order[every[0]] == 0]
        rows = [some[~self.began_late[some]] for some in every]
        for name, some, with_late in zip(skills, rows, every, strict=True):
            if not len(some):
                where = " at the start of an episode" if some is rows[0] else ""
                raise RunError(
                    f"the log has no call of {name!r}{where} that counts"
                    + self._too_late(with_late)
                    + "; record more calls, chosen at random"
                )
        seen = np.concatenate([self.start, self.end])
        maps = feature_maps(self, features, seen, skills=numbers[1:] or numbers)
        links = list[tuple[Array, Array]]()
        for i, (some, following) in enumerate(pairwise(rows)):
            here = maps[numbers[i + 1]]
            starts, ends = here(self.start[following]), here(self.end[some])
            near, weights = _others(starts, ends, following, self.followed_by[some])
            may = self.may_follow[some].reshape(len(some), len(self.skills), -1)
            goes_on = won[some] & ~self.terminated[some]
            follows_on = goes_on & may[:, numbers[i + 1]].any(1)
            if goes_on.any() and not follows_on.any():
                raise RunError(
                    f"{skills[i + 1]!r} may not start where any logged call of {skills[i]!r} was "
                    "done (its initiation() is False there), so this chain cannot be run"
                )
            links.append((near, weights * follows_on[:, None]))
        # Of each call the share of chains that come by it: at a start, then along the links.
        shares = [np.full(len(rows[0]), 1 / len(rows[0]))]
        for (near, weights), following in zip(links, rows[1:], strict=True):
            passed = shares[-1][:, None] * weights
            shares.append(np.bincount(near.ravel(), passed.ravel(), minlength=len(following)))
        estimate = float(shares[-1] @ won[rows[-1]])
        bounds = [
            _bounds(estimate, share, self.episode[some])
            for share, some in zip(shares, rows, strict=True)
        ]
        matrix = self.handover(done)
        pairs = [matrix.of(b, a) for a, b in zip((START, *skills), skills, strict=False)]
        rates = tuple(rate for rate, _ in pairs)
        return Chain(
            tuple(skills),
            estimate,
            float(np.prod(rates)),
            rates,
            tuple(count for _, count in pairs),
            (min(low for low, _ in bounds), max(high for _, high in bounds)),
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
        ends. Else the second one has not learnt to start there; where it works is named.

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
        every = _row_of_each(self, won, only_after_done=True)
        before = np.where(self.began_late, -1, every)
        rows = np.flatnonzero(counts & (before == wanted))
        if not len(rows):
            raise RunError(
                f"the log has no call of {skill!r} after a call of {after!r} that was done"
                + self._too_late(np.flatnonzero(counts & (every == wanted)))
                + "; record more calls, chosen at random"
            )
        others = np.flatnonzero(counts & (before >= 0) & (before != wanted))
        nan = float("nan")
        did = won[rows]
        elsewhere = float(won[others].mean()) if len(others) else nan
        reasons = self.take(rows[~did]).reasons
        rate = float(did.mean())
        starts = self.flat(self.start)
        changes = np.ones(starts.shape[1], bool)
        if after != START:
            of_first = self.skill[self.owner] == self.number(after)
            changes = (self.flat(self.before[of_first]) != self.flat(self.next_obs[of_first])).any(
                0
            )
        works, differs = self._works(won, before, number, rows, starts, changes)
        unknown = Blame(
            skill, after, rate, elsewhere, len(rows), len(others), nan, nan, None, (nan, nan),
            reasons, False, works, differs, stuck=self._stuck(rows[~did]),
        )  # fmt: skip
        if after == START or len(rows) < LEAST:
            return unknown
        maps = feature_maps(self, features, self.start, skills=[number])
        known = np.flatnonzero(counts & ~self.began_late)
        # Where a number that the first skill does not change decides, none of its ends is better.
        score = _predicted(maps[number](self.start), won, known, rows)
        score = score - _predicted(
            Standard(starts[:, ~changes])(starts[:, ~changes]), won, known, rows
        )
        best = np.zeros(len(rows), bool)
        best[np.argsort(-score, kind="stable")[: _third(len(rows))]] = True
        good = float(did[best].mean())
        bad = float(did[~best].mean())
        as_elsewhere = rate if np.isnan(elsewhere) else elsewhere
        low, _ = wilson(did[best].sum(), best.sum())
        _, high = wilson(did[~best].sum(), (~best).sum())
        first = good >= as_elsewhere - LIKE_ELSEWHERE and good - bad >= WORSE and low > high
        place, means = _largest_difference(starts[rows], best, changes)
        low, high = np.quantile(starts[:, changes], (0.05, 0.95), axis=0)
        ends = starts[rows][:, changes]
        alike = np.abs(ends - ends.mean(0)).mean(0) <= ALIKE * (high - low)
        return replace(
            unknown,
            best=good,
            others=bad,
            place=place,
            means=means,
            first=bool(first),
            alike=bool(changes.any() and alike.all()),
        )

    def _stuck(self, calls: Array) -> bool:
        """Return whether nothing changes in the last quarter of most of these calls (k,)."""
        if not len(calls):
            return False
        last = self.offset[calls + 1] - 1
        earlier = np.maximum(last - self.tau[calls] // 4, self.offset[calls])
        end, before = self.flat(self.next_obs[last]), self.flat(self.next_obs[earlier])
        still = (end == before).all(1) & (earlier < last)
        return end.size > 0 and 2 * int(still.sum()) > len(calls)

    def _works(
        self,
        won: Array,
        before: Array,
        number: int,
        rows: Array,
        starts: Array,
        changes: Array,
    ) -> tuple[tuple[tuple[str, int, int], ...], tuple[int, float, float, float] | None]:
        """Return ``works`` and ``differs`` of a ``Blame``.

        Args:
            won: (C,) bool, the calls that were done.
            before: (C,) of ``before_each``.
            number: of the skill.
            rows: (n,) its calls that it is to explain.
            starts: (C, F) flat observations at the starts of all calls.
            changes: (F,) bool, the numbers that the first skill changes.
        """
        of_skill = (before >= 0) & (self.skill == number)
        high = wilson(won[rows].sum(), len(rows))[1]
        works = list[tuple[str, int, int]]()
        for row in np.unique(before[of_skill]).tolist():
            some = of_skill & (before == row)
            done = int(won[some].sum())
            calls = int(some.sum())
            if wilson(done, calls)[0] > high:
                works.append(((START, *self.skills)[row], done, calls))
        works.sort(key=lambda entry: -entry[1] / entry[2])
        failed = starts[rows[~won[rows]]]
        if not works or not len(failed) or not changes.any():
            return tuple(works), None
        low, top = np.quantile(starts[of_skill & won], (0.05, 0.95), axis=0)
        outside = np.where(changes, ((failed < low) | (failed > top)).mean(0), 0.0)
        place = int(outside.argmax())
        if outside[place] < DIVIDES:
            return tuple(works), None
        return tuple(works), (place, float(low[place]), float(top[place]), float(outside[place]))
