"""What helps where a skill fails after another one: chosen on some robots, reported on others."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from skillweave._internal.interrupts import deferred, requested
from skillweave._internal.messages import aligned
from skillweave.errors import DeclarationError
from skillweave.policies.core import Array
from skillweave.policies.spaces import space_of
from skillweave.reporting.progress import EpisodeProgress
from skillweave.robots.chains import OpenRobot, PlannedCall, Robot
from skillweave.robots.counts import exact_chance
from skillweave.robots.trial import RobotTrial
from skillweave.skills.mapped import MappedPolicy
from skillweave.skills.mapping import Acts, Elapsed, Table
from skillweave.skills.ready import as_policy
from skillweave.skills.skill_set import SkillSet

GAIN = 3
"""The robots that a remedy has to win, less those that it loses, to be chosen."""
CLOSE = 2
"""Of remedies that are so few robots behind the best, the gentlest is chosen: more is chance."""
SURE = 0.05
"""The chance at which a remedy is said to help."""
FINALISTS = 3
"""The remedies that are played on as many robots again, before one of them is chosen."""
SHARES = (8, 4)
"""Ramps, cross-fades and later cuts last this part of a call: an eighth, a quarter."""
APART = 1_000_000
"""The number of the first robot on which remedies are tried: ``handovers`` has used others."""
PATIENCE = 3
"""Tries for each wanted robot: the first skill may fail before."""


@dataclass(frozen=True)
class Tried:
    """A remedy, on the robots of the choice."""

    name: str
    """What it is: "cross-fade over 25 steps"."""
    how: str
    """What to write."""
    done: int
    """Robots on which the second skill was done."""
    won: int
    """Robots on which it is done with it, but not without."""
    lost: int
    """The reverse."""

    @property
    def gain(self) -> int:
        """Robots that are won, less those that are lost."""
        return self.won - self.lost


@dataclass(frozen=True)
class Effect:
    """What a remedy does to a pair, on robots that did not choose it."""

    after: str
    """The skill before."""
    robots: int
    """Robots on which that one was done."""
    without: int
    """Of these, those on which the second skill is done without the remedy."""
    done: int
    """Those on which it is done with it."""
    won: int
    """Done with it, but not without."""
    lost: int
    """The reverse."""

    @property
    def chance(self) -> float:
        """How likely such a difference is where the remedy makes none (McNemar's exact test)."""
        return exact_chance(self.lost, self.won)

    def __str__(self) -> str:
        return (
            f"after {self.after}: {self.without} of {self.robots} without, {self.done} with it "
            f"(won {self.won}, lost {self.lost}, chance alike {self.chance:.2g})"
        )


@dataclass(frozen=True)
class Remedies:
    """What was tried for a pair, and what the best of it does on other robots.

    Attributes:
        after: the skill before.
        skill: the one that fails after it.
        robots: those of the choice.
        without: of these, those on which the skill is done without a remedy.
        tried: all remedies, the best first.
        finals: the best few of them, with these robots and as many again, the chosen one first.
        again: all robots of the finals; of these ``without_again`` are done without a remedy.
        effect: of the chosen one, on other robots; None: no remedy gained enough to be chosen.
        elsewhere: where the remedy is in force after other skills, too: what it does there.
        stopped: Ctrl-C has ended it.
    """

    after: str
    skill: str
    robots: int
    without: int
    tried: tuple[Tried, ...]
    effect: Effect | None
    finals: tuple[Tried, ...] = ()
    again: int = 0
    without_again: int = 0
    elsewhere: tuple[Effect, ...] = ()
    stopped: bool = False

    @property
    def best(self) -> Tried | None:
        """The remedy that helps, also on other robots; None: none does."""
        effect = self.effect
        helps = effect is not None and effect.won > effect.lost and effect.chance < SURE
        return self.chosen if helps else None

    @property
    def chosen(self) -> Tried | None:
        """The remedy that was chosen; None: none gained enough, or it was stopped before."""
        if self.effect is None:
            return None
        return self.finals[0] if self.finals else self.tried[0]

    @property
    def harms(self) -> tuple[Effect, ...]:
        """Other pairs that the remedy makes worse."""
        return tuple(e for e in self.elsewhere if e.lost > e.won and e.chance < SURE)

    def to_json(self) -> dict[str, Any]:
        """Return it as plain JSON."""
        best = self.best
        return {
            "after": self.after,
            "skill": self.skill,
            "robots": self.robots,
            "without": self.without,
            "tried": [vars(one) for one in self.tried],
            "finals": [vars(one) for one in self.finals],
            "again": self.again,
            "without_again": self.without_again,
            "best": None if best is None else best.name,
            "effect": None if self.effect is None else vars(self.effect),
            "elsewhere": [vars(one) for one in self.elsewhere],
            "stopped": self.stopped,
        }

    def __str__(self) -> str:
        lines = [f"{self.skill} after {self.after}: on the robots of the choice", ""]
        lines += [_table(self.robots, self.without, self.tried), ""]
        if self.finals:
            lines += [f"The best of them, with {self.again - self.robots} more robots", ""]
            lines += [_table(self.again, self.without_again, self.finals), ""]
        if self.stopped:
            lines.append("It was stopped: nothing was chosen")
        elif self.effect is None:
            lines.append(f"None helps: no remedy wins {GAIN} robots more than it loses")
        else:
            assert self.chosen is not None
            lines.append(f"Chosen: {self.chosen.name}. On other robots: {self.effect}")
            sure = self.best is not None
            lines.append(f"Write {self.chosen.how}" if sure else "None helps for certain")
        lines += [f"It makes another pair worse, {effect}" for effect in self.harms]
        return "\n".join(lines)


def _table(robots: int, without: int, tried: Sequence[Tried]) -> str:
    """Return remedies as lines, with those robots that need none."""
    rows = [["remedy", f"done of {robots}", "won", "lost"], ["none", str(without), "", ""]]
    rows += [[one.name, str(one.done), str(one.won), str(one.lost)] for one in tried]
    return aligned(rows, left=1)


@dataclass(frozen=True)
class Way:
    """A way from the first skill to the second one."""

    name: str
    how: str
    skills: SkillSet
    between: int | None = None
    """The place of a skill that is called between the two."""
    later: int = 0
    """Steps by which the first skill is cut later."""
    everywhere: bool = False
    """It is in force after other skills, too."""


def find_remedies(
    trial: RobotTrial,
    after: str,
    skill: str,
    robots: int,
    instead: Mapping[str, Any],
    *,
    quiet: bool,
) -> Remedies:
    """Try remedies for a pair; see ``MeasuredHandovers.remedies``."""
    i, j = trial.names.index(after), trial.names.index(skill)
    ways = [Way("none", "", trial.skills), *_ways(trial, i, j, instead)]
    names = [way.name for way in ways]
    if twice := [name for name in instead if names.count(name) > 1]:
        raise DeclarationError(f"instead has {twice[0]!r}, which is a remedy already: rename it")
    every = range(len(ways))
    others = [k for k in range(len(trial.names)) if k not in (i, j)]
    rows, elsewhere = list[list[bool]](), list[Effect]()
    finals, both = list[int](), list[list[bool]]()
    effect, stopped = None, False
    total = robots * (len(ways) + FINALISTS + 3)
    with (
        OpenRobot(trial.spec) as where,
        EpisodeProgress(total, quiet=quiet, name="remedies", unit="calls") as shown,
    ):
        search = _Search(trial, where, ways, robots, shown)
        try:
            with deferred("after this call"):
                rows += search.compare(i, j, every)
                gains = _gains(rows)
                finals = sorted(every[1:], key=lambda k: -gains[k])[:FINALISTS]
                finals = [k for k in finals if gains[k] >= GAIN]
                if finals:
                    both = [[row[k] for k in (0, *finals)] for row in rows]
                    both += search.compare(i, j, (0, *finals))
                    best = _choice(finals, _gains(both)[1:])
                    first = finals.index(best)
                    effect = _effect(after, search.compare(i, j, (0, best)))
                    for k in others if ways[best].everywhere else ():
                        elsewhere.append(_effect(trial.names[k], search.compare(k, j, (0, best))))
        except KeyboardInterrupt:
            stopped, effect, both = True, None, []
    if effect is not None:  # the chosen one first
        order = [first, *(k for k in range(len(finals)) if k != first)]
        finals = [finals[k] for k in order]
        both = [[row[0], *(row[1 + k] for k in order)] for row in both]
    tried = sorted(_tried(ways[1:], rows), key=lambda one: -one.gain)
    return Remedies(
        after,
        skill,
        len(rows),
        sum(row[0] for row in rows),
        tuple(tried),
        effect,
        tuple(_tried([ways[k] for k in finals], both)) if both else (),
        len(both),
        sum(row[0] for row in both),
        tuple(elsewhere),
        stopped,
    )


def _choice(places: Sequence[int], gains: Sequence[int]) -> int:
    """Return the place of the way that is chosen: of those near the best, the gentlest."""
    close = [k for k, gain in zip(places, gains, strict=True) if gain >= max(gains) - CLOSE]
    return min(close)


class _Search:
    """Plays ways from a skill to another one, each on the same robots."""

    def __init__(
        self,
        trial: RobotTrial,
        where: OpenRobot,
        ways: Sequence[Way],
        robots: int,
        shown: EpisodeProgress,
    ) -> None:
        self._trial = trial
        self._where = where
        self._ways = ways
        more = max(way.later for way in ways)
        self._players = [trial.player(where, way.skills, more) for way in ways]
        self._robots = robots
        self._shown = shown
        self._fresh = trial.robots(APART)  # no robot is played twice

    def compare(self, i: int, j: int, ways: Iterable[int]) -> Iterator[list[bool]]:
        """Yield, of each robot on which skill ``i`` is done, whether ``j`` is, by each way."""
        found = 0
        for robot in islice(self._fresh, PATIENCE * self._robots):
            row = list[bool]()
            for k in ways:
                before = self._where.steps
                done = self._play(robot, i, j, k)
                self._shown.count(self._where.steps - before, 1)
                if requested():
                    return
                if done is None:
                    break
                row.append(done)
            else:
                found += 1
                yield row
            if found == self._robots:
                return

    def _play(self, robot: Robot, i: int, j: int, k: int) -> bool | None:
        """Return whether skill ``j`` is done after ``i`` by way ``k``; None: ``i`` is not."""
        trial, way = self._trial, self._ways[k]
        cut = trial.cut(robot, i)
        calls = [PlannedCall(i, cut + way.later, follows=False)]
        if way.between is not None:
            calls.append(PlannedCall(way.between, trial.cut(robot, way.between), follows=False))
        calls.append(PlannedCall(j, trial.steps[j]))
        found = self._players[k].play(robot, calls)
        if not found[0].done and not way.later:
            return None
        return len(found) == len(calls) and found[-1].counts


def _gains(rows: Sequence[Sequence[bool]]) -> list[int]:
    """Return how many robots each way wins, less those that it loses; rows are of robots."""
    done = np.array(rows, np.int64)
    return (done - done[:, :1]).sum(0).tolist() if len(done) else [0]


def _tried(ways: Sequence[Way], rows: Sequence[Sequence[bool]]) -> list[Tried]:
    """Return counts of ways; of a row, a robot, the first number is of no remedy."""
    done = np.array(rows, bool).reshape(len(rows), 1 + len(ways))
    return [
        Tried(way.name, way.how, int(own.sum()), *_differences(own, done[:, 0]))
        for way, own in zip(ways, done[:, 1:].T, strict=True)
    ]


def _effect(after: str, rows: Iterable[Sequence[bool]]) -> Effect:
    """Return what a remedy does, from its outcomes beside those without it."""
    done = np.array(list(rows), bool).reshape(-1, 2)
    plain, own = done.T
    return Effect(after, len(done), int(plain.sum()), int(own.sum()), *_differences(own, plain))


def _differences(own: Array, plain: Array) -> tuple[int, int]:
    """Return the robots that a remedy wins, and those that it loses."""
    return int((own & ~plain).sum()), int((plain & ~own).sum())


def _ways(trial: RobotTrial, i: int, j: int, instead: Mapping[str, Any]) -> Iterator[Way]:
    """Yield the remedies for skill ``j`` after skill ``i``, the gentlest first."""
    after, skill = trial.names[i], trial.names[j]
    skills = trial.skills
    policy = skills.policies[j]
    if space_of(skills.action_space).kind == "Box":
        for steps in reversed(_lengths(trial.steps[j])):
            how = f"fade = {{{after!r}: {steps}}} in the class of the skill {skill!r}"
            yield Way(f"cross-fade over {steps} steps", how, _faded(skills, j, after, steps))
        for steps in _lengths(trial.steps[j]) if isinstance(policy, MappedPolicy) else ():
            how = f"acts=sw.Acts(..., ramp={steps}) for the policy of {skill!r}"
            ramped = _with_policy(skills, j, _ramped(policy, steps))
            yield Way(f"ramp over {steps} steps", how, ramped, everywhere=True)
    for entry in _entries(policy, trial.steps[j]):
        how = f"entry={entry} for the policy of {skill!r}"
        entered = _with_policy(skills, j, _entered(policy, entry))
        yield Way(f"entry at step {entry}", how, entered, everywhere=True)
    for steps in _lengths(trial.steps[i]):
        how = f"calls of {after!r} that are {steps} steps longer"
        yield Way(f"{after} cut {steps} steps later", how, skills, later=steps)
    for k, name in enumerate(trial.names):
        if k not in (i, j):
            how = f"a call of {name!r} between the two"
            yield Way(f"{name} in between", how, skills, between=k)
    for name, value in instead.items():
        other = as_policy(value, f"instead[{name!r}]")
        if hasattr(other, "bind"):
            spaces = policy.observation_space, policy.action_space
            other = other.bind(*spaces, f"instead[{name!r}]")
        how = f"this policy in place of {skill!r}"
        yield Way(name, how, _with_policy(skills, j, other), everywhere=True)


def _lengths(steps: int) -> list[int]:
    """Return the lengths of ramps, cross-fades and later cuts: a part of a call, rising."""
    return sorted({steps // share for share in SHARES if steps // share > 1})


def _faded(skills: SkillSet, j: int, after: str, steps: int) -> SkillSet:
    """Return skills of which one fades in after another one."""
    skill = copy.copy(skills.skills[j])
    before = skill.fade if isinstance(skill.fade, Mapping) else {}
    skill.fade = {**before, after: steps}
    return replace(
        skills, skills=tuple(skill if k == j else s for k, s in enumerate(skills.skills))
    )


def _ramped(policy: MappedPolicy, steps: int) -> MappedPolicy:
    """Return a copy of a policy with a ramp."""
    acts = Acts() if policy.mapping.acts is None else policy.mapping.acts
    ramped = copy.copy(policy)
    ramped.mapping = replace(policy.mapping, acts=replace(acts, ramp=steps))
    return ramped


def _entries(policy: Any, steps: int) -> list[int]:
    """Return other steps at which a motion can be entered; none for a policy without one."""
    if not isinstance(policy, MappedPolicy):
        return []
    mapping = policy.mapping
    tables = [source for source in mapping.sources() if isinstance(source, Table)]
    clocks = [source for source in mapping.sources() if isinstance(source, Elapsed)]
    if not mapping.timed or (clocks and all(c.period is not None for c in clocks) and not tables):
        return []
    later = _lengths(steps)
    earlier = [-step for step in later if tables]
    entries = [mapping.entry + step for step in sorted(earlier + later, key=abs)]
    return [x for x in entries if all(_has_row(table, x) for table in tables)]


def _has_row(table: Table, entry: int) -> bool:
    """Return whether a table has a row for a step, and at least one after it."""
    return 0 <= table.start + table.rate * entry < len(table.file.numbers) - 1


def _entered(policy: MappedPolicy, entry: int) -> MappedPolicy:
    """Return a copy of a policy that starts at another step."""
    entered = copy.copy(policy)
    entered.mapping = replace(policy.mapping, entry=entry)
    return entered


def _with_policy(skills: SkillSet, j: int, policy: Any) -> SkillSet:
    """Return skills of which one has another policy."""
    policies = tuple(policy if k == j else p for k, p in enumerate(skills.policies))
    return replace(skills, policies=policies)
