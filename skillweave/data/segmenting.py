"""``Hierarchy.segment``: episodes are cut into calls, by what skills declare."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import aligned, as_path, short
from skillweave._internal.notebooks import joined, paragraph, table
from skillweave.algorithms.batches import INFO, Trace
from skillweave.api import Hierarchy
from skillweave.calls.log import CallLog
from skillweave.calls.recorder import Recorder
from skillweave.data.dataset import Dataset
from skillweave.data.timeline import MOST, Cuts
from skillweave.errors import DeclarationError, SkillError
from skillweave.hierarchy.assembly import learning_set
from skillweave.hierarchy.fitting import ready_policies, ready_selectors
from skillweave.hierarchy.roles import roles_of
from skillweave.policies.core import EPISODE, LIMIT, OWN, RUNNING, Array, Step, part_of, read_only
from skillweave.runs.files import write_bytes
from skillweave.schema import AtLeastOne, fitted
from skillweave.skills import Skill, call_method
from skillweave.skills.base import path_of
from skillweave.skills.goals import Goals, goals_of
from skillweave.skills.outputs import call_user
from skillweave.skills.skill_set import SkillSet

ROWS = 1 << 15
"""The most steps that are judged at once, about."""
FIRST = 16
"""Steps of each call that are judged first; then four times as many."""
AT_ONCE = 0.5
"""Share of calls of one step from which a skill is said to end where it starts."""


@dataclass(frozen=True)
class Segments:
    """Calls of skills that were found in episodes.

    Attributes:
        log: the calls, for everything that reads ``run.calls``. Only calls that succeed are found,
            so shares of success in it say nothing.
        data: the episodes.
        skill: (T,) int64, the skill of each step; -1: no skill claims it.
        call: (T,) int64, its call in ``log``; -1: none.
        may_start: (skills,) int64, the steps before which each skill may start.
        startable: (C, skills) bool, the skills that may start where each call does.
        goals: by skill with goals, (C, *goal_shape); of other skills' calls it means nothing.
        left_out: skills with goals for which no goals were given.
    """

    log: CallLog
    data: Dataset
    skill: Array
    call: Array
    may_start: Array
    startable: Array
    goals: dict[str, Array]
    left_out: tuple[str, ...] = ()

    @property
    def claimed(self) -> float:
        """The share of steps that a skill claims."""
        return float((self.skill >= 0).mean())

    @property
    def counts(self) -> dict[str, int]:
        """The calls of each skill."""
        counts = np.bincount(self.log.skill, minlength=len(self.log.skills))
        return dict(zip(self.log.skills, counts.tolist(), strict=True))

    @property
    def never_follow(self) -> list[tuple[str, str]]:
        """Pairs of skills of which the second never follows the first, though both are called."""
        log = self.log
        following = log.followed_by
        first = np.flatnonzero(following >= 0)
        shown = set(
            zip(log.skill[first].tolist(), log.skill[following[first]].tolist(), strict=True)
        )
        called = np.unique(log.skill).tolist()
        names = log.skills
        return [
            (names[a], names[b]) for a in called for b in called if a != b and (a, b) not in shown
        ]

    def pieces(self, skill: str) -> Dataset:
        """Return the calls of a skill as a data set: each is an episode that ends with the call.

        Args:
            skill: its name.

        Raises:
            DeclarationError: there is no such skill, or no call of it was found.
        """
        if skill not in self.log.skills:
            names = ", ".join(self.log.skills)
            raise DeclarationError(f"pieces(): skill is {short(skill)}; it must be one of {names}")
        number = self.log.skills.index(skill)
        calls = np.flatnonzero(self.log.skill == number)
        if not len(calls):
            raise DeclarationError(f"no call of {skill!r} was found in {self.data.name}")
        data = self.data
        order = np.argsort(self.call, kind="stable")
        first = np.searchsorted(self.call[order], calls)
        episodes = []
        for begin, steps, end in zip(
            first, self.log.tau[calls], self.log.end_reason[calls], strict=True
        ):
            rows = order[begin : begin + steps]
            ends = np.zeros(len(rows), bool)
            ends[-1] = bool(end == OWN) or bool(data.terminated[rows[-1]])
            episodes.append(
                {
                    "observations": np.concatenate([data.obs[rows], data.next_obs[rows[-1:]]]),
                    "actions": data.action[rows],
                    "rewards": data.reward[rows],
                    "terminations": ends,
                    "truncations": data.truncated[rows] & ~ends,
                    "infos": {key: value[rows] for key, value in data.info.items()},
                }
            )
        spaces: Any = {
            "observation_space": data.observation_space,
            "action_space": data.action_space,
        }
        return Dataset(episodes, name=f"{skill} in {data.name}", **spaces)

    def cuts(self) -> Cuts:
        """Return the calls of the first episodes, for a picture."""
        data, log = self.data, self.log
        lengths = data.lengths[:MOST].tolist()
        shown = self.call[: sum(lengths)]
        starts = np.flatnonzero((shown >= 0) & (np.diff(shown, prepend=-1) != 0))
        calls: list[list[tuple[int, int, int]]] = [[] for _ in lengths]
        for at in starts.tolist():
            number = int(np.searchsorted(data.offset, at, side="right")) - 1
            call = int(shown[at])
            begin = at - int(data.offset[number])
            calls[number].append((int(log.skill[call]), begin, int(log.tau[call])))
        return Cuts(data.name, len(data), list(log.skills), lengths, calls, self.sentences())

    @checked_names
    def save(self, path: str | Path) -> Path:
        """Write a picture of the calls, a row for each of the first episodes; return its path.

        Args:
            path: ``.svg``, or ``.html`` with what the data do not show.

        Raises:
            DeclarationError: it ends otherwise.
            RunError: it cannot be written.
        """
        path = as_path(path, "path")
        if path.suffix not in (".svg", ".html"):
            raise DeclarationError(
                f"save(): path is {short(str(path))}; it must end with .svg or .html"
            )
        cuts = self.cuts()
        write_bytes(path, (cuts.svg() if path.suffix == ".svg" else cuts.html()).encode())
        return path

    def _rows(self) -> list[list[str]]:
        log = self.log
        rows = []
        for i, name in enumerate(log.skills):
            mine = log.skill == i
            tau = log.tau[mine]
            lengths = f"{tau.min()} to {tau.max()}" if len(tau) else "-"
            mean = f"{tau.mean():.1f}" if len(tau) else "-"
            share = f"{(self.skill == i).mean():.0%}"
            begins = f"{self.may_start[i] / len(self.skill):.0%}"
            rows.append([name, f"{len(tau):,}", lengths, mean, share, begins])
        return rows

    def sentences(self) -> list[str]:
        """Return sentences on what the data do not show."""
        log = self.log
        notes = [f"{1 - self.claimed:.1%} of {self.data.steps:,} steps are claimed by no skill"]
        for i, name in enumerate(log.skills):
            tau = log.tau[log.skill == i]
            if name in self.left_out:
                notes.append(f"{name!r} has goals: give them, goals={{{name!r}: function}}")
            elif not self.may_start[i]:
                notes.append(f"{name!r} may start nowhere in the data (initiation)")
            elif not len(tau):
                notes.append(f"{name!r} never ends with success there (termination, success)")
            elif (tau == 1).mean() >= AT_ONCE:
                notes.append(
                    f"{name!r} ends at its first step in {(tau == 1).mean():.0%} of its calls: let "
                    "its initiation be false where its end holds, or give shortest=2"
                )
        if pairs := self.never_follow:
            shown = ", ".join(f"{a} > {b}" for a, b in pairs[:8]) + ", ..." * (len(pairs) > 8)
            notes.append(f"never one directly after the other: {shown}")
        return notes

    def __str__(self) -> str:
        return "\n".join([aligned([list(_HEAD), *self._rows()], left=1), "", *self.sentences()])

    def _repr_html_(self) -> str:
        return joined([table(_HEAD, self._rows(), left=1), *map(paragraph, self.sentences())])


_HEAD = ("skill", "calls", "steps", "mean", "of all steps", "may start")


def segment(
    hierarchy: Hierarchy, data: Any, *, shortest: int = 1, goals: Mapping[str, Any] | None = None
) -> Segments:
    """Cut episodes into calls of a hierarchy's skills; see ``Hierarchy.segment``."""
    shortest = fitted(AtLeastOne, shortest, "segment(): shortest")
    given = fitted(Mapping[str, Any], goals or {}, "segment(): goals")
    if not isinstance(data, Dataset):
        raise DeclarationError(f"segment(): data is {short(data)}; give a Dataset")
    hierarchy.validate()
    data.check_env(hierarchy.spec)
    roles = roles_of(hierarchy)
    policies = ready_policies(roles) | ready_selectors(roles)
    skills = learning_set(roles, roles.levels[""], policies)
    names = [skill.name for skill in skills.skills]
    if unknown := [name for name in given if name not in names]:
        raise DeclarationError(f"goals names {short(unknown[0])}; there are: {', '.join(names)}")
    cuts = _Cuts(data, skills, given, shortest)
    cuts.check_infos()
    cuts.find()
    return cuts.segments()


class _Cuts:
    """The calls in all episodes, found side by side.

    Args:
        data: the episodes.
        skills: of the outermost level.
        goals: by skill, a function of observations that returns goals.
        shortest: the fewest steps of a call.
    """

    def __init__(
        self, data: Dataset, skills: SkillSet, goals: Mapping[str, Any], shortest: int
    ) -> None:
        self.data = data
        self.skills = skills
        self.shortest = shortest
        count = len(skills.skills)
        self.goal_spaces = [goals_of(skill) for skill in skills.skills]
        """The goals of skills that have some."""
        self.given = [goals.get(skill.name) for skill in skills.skills]
        self.left_out = tuple(
            skill.name
            for skill, own, function in zip(
                skills.skills, self.goal_spaces, self.given, strict=True
            )
            if own is not None and function is None
        )
        limits = [skills.limit(i) for i in range(count)]
        self.limits = np.array([data.steps if limit is None else limit for limit in limits])
        self.over = np.repeat(data.offset[1:], data.lengths)
        """(T,) the first step after the episode of each."""
        self.whole = np.repeat(data.whole, data.lengths)
        """(T,) bool, the last observation of its episode is known."""
        self.elapsed = np.arange(data.steps) - np.repeat(data.offset[:-1], data.lengths) + 1
        self.may = self._may_start()
        self.goal: dict[int, Array] = {}
        """By skill with goals, (T, *goal_shape), the goal of a call that starts there."""
        for i, own in enumerate(self.goal_spaces):
            if own is not None and self.given[i] is not None:
                self.goal[i] = self._goals(i, own)
        self.skill = np.full(data.steps, -1)
        self.since = np.zeros(data.steps, np.int64)
        """(T,) the first step of the call of each."""
        self.end = np.zeros(data.steps, np.int8)
        """(T,) why the call ended with the step; 0: it did not."""

    # What skills answer

    def _may_start(self) -> Array:
        """Return where each skill may start, (T, skills) bool."""
        hierarchy = self.skills.hierarchy
        each = hierarchy.each
        found = np.zeros((self.data.steps, len(self.skills.skills)), bool)
        for rows in _chunks(self.data.steps):
            found[rows] = hierarchy.may_start(read_only(self.data.obs[rows]))[:, ::each]
        for i, skill in enumerate(self.skills.skills):
            if skill.name in self.left_out:
                found[:, i] = False
        return found

    def _goals(self, i: int, own: Goals) -> Array:
        """Return the goals of calls of a skill, by the step before which they start."""
        who = f"goals[{self.skills.skills[i].name!r}]"
        parts = []
        for rows in _chunks(self.data.steps):
            obs = read_only(self.data.obs[rows])
            given = call_user(self.given[i], obs, who)
            try:
                parts.append(own.fitted(obs, given, who))
            except SkillError as error:
                raise DeclarationError(str(error)) from error
        return np.concatenate(parts)

    def _step(self, i: int, rows: Array, elapsed: Array, start: Array) -> Step:
        """Return steps as a skill sees them in its own call.

        Args:
            rows: (k,) of the data.
            elapsed: (k,) steps of the call.
            start: (k,) the first step of the call.
        """
        goal = self.goal[i][start] if i in self.goal else None
        data, skill = self.data, self.skills.skills[i]
        whole = Step(
            data.obs[rows], data.action[rows], data.next_obs[rows], data.reward[rows],
            data.terminated[rows], data.truncated[rows], np.zeros(len(rows), bool),
            self.elapsed[rows], _DataInfo(data, rows, skill),
        )  # fmt: skip
        return part_of(whole, elapsed, None, skill.max_steps, goal)

    def check_infos(self) -> None:
        """Raise a DeclarationError that names each key of ``info`` that a skill lacks."""
        lacks = []
        first = np.zeros(1, np.int64)
        for i, skill in enumerate(self.skills.skills):
            if skill.name in self.left_out:
                continue
            for method in ("termination", "success"):
                if not skill.defines(method):
                    continue
                try:
                    call_method(skill, method, self._step(i, first, first + 1, first))
                except _LacksInfo as error:
                    lacks.append(str(error))
                except SkillError:
                    continue  # it is raised where it counts
        if lacks:
            has = ", ".join(self.data.info) or "none"
            raise DeclarationError(
                f"{'; '.join(dict.fromkeys(lacks))}: {self.data.name} has the keys {has} of info"
            )

    # Calls

    def find(self) -> None:
        """Find the calls of all episodes, one after another in each."""
        at = self.data.offset[:-1].copy()
        ends = self.data.offset[1:]
        while len(open_ := np.flatnonzero(at < ends)):
            rows = at[open_]
            best = np.full(len(rows), self.data.steps)
            skill, why = np.full(len(rows), -1), np.zeros(len(rows), np.int8)
            for i in range(len(self.skills.skills)):
                mine = np.flatnonzero(self.may[rows, i])
                if not len(mine):
                    continue
                last, reason = self._ends(i, rows[mine])
                sooner = last < best[mine]
                best[mine[sooner]] = last[sooner]
                skill[mine[sooner]], why[mine[sooner]] = i, reason[sooner]
            claimed = np.flatnonzero(skill >= 0)
            for k in claimed.tolist():
                call = slice(int(rows[k]), int(best[k]) + 1)
                self.skill[call], self.since[call] = skill[k], rows[k]
            self.end[best[claimed]] = why[claimed]
            at[open_] = np.where(skill >= 0, best + 1, rows + 1)

    def _ends(self, i: int, starts: Array) -> tuple[Array, Array]:
        """Return the last step of calls of a skill that end with success, and why they end.

        Args:
            starts: (k,) their first steps.

        Returns:
            (k,) each; the last step is T where a call does not end with success.
        """
        skill = self.skills.skills[i]
        steps = self.data.steps
        final = np.minimum(starts + self.limits[i], self.over[starts]) - 1
        last, reason = np.full(len(starts), steps), np.zeros(len(starts), np.int8)
        waits = np.arange(len(starts))
        begin, size = starts.copy(), FIRST
        if not skill.defines("termination"):
            waits, begin = waits[:0], final + 1
        while len(waits):
            width = max(1, min(size, ROWS // len(waits)))
            counts = np.minimum(width, final[waits] - begin[waits] + 1)
            of = np.repeat(np.arange(len(waits)), counts)
            before = np.cumsum(counts) - counts
            rows = (begin[waits] - before)[of] + np.arange(len(of))
            first = starts[waits][of]
            stops = call_method(skill, "termination", self._step(i, rows, rows - first + 1, first))
            # An episode's last observation may not be known: nothing ends by itself there.
            stops = stops & self._known(rows)
            place = np.flatnonzero(stops)
            found, which = np.unique(of[place], return_index=True)
            last[waits[found]] = rows[place[which]]
            reason[waits[found]] = OWN
            begin[waits] += counts
            left = np.ones(len(waits), bool)
            left[found] = False
            waits = waits[left & (begin[waits] <= final[waits])]
            size *= 4
        if not skill.defines("success"):
            return np.where(reason == OWN, self._long_enough(last, starts), steps), reason
        # A call that a limit or the episode ends succeeds, too, where success() holds there.
        cut = reason == 0
        last[cut] = final[cut]
        with_episode = final == self.over[starts] - 1
        reason[cut] = np.where(with_episode, EPISODE, LIMIT)[cut]
        known = np.flatnonzero(self._known(last))
        good = np.zeros(len(starts), bool)
        if len(known):
            step = self._step(i, last[known], (last - starts + 1)[known], starts[known])
            good[known] = call_method(skill, "success", step)
        return np.where(good, self._long_enough(last, starts), steps), reason

    def _known(self, rows: Array) -> Array:
        """Return of which steps the next observation is known, (k,) bool."""
        known: Array = (rows < self.over[rows] - 1) | self.whole[rows]
        return known

    def _long_enough(self, last: Array, starts: Array) -> Array:
        """Return the last steps of calls, T for those that are too short."""
        return np.where(last - starts + 1 >= self.shortest, last, self.data.steps)

    # The log

    def segments(self) -> Segments:
        """Return what was found."""
        data = self.data
        lead = (data.steps, 1)
        runs = self.skill >= 0
        call_elapsed = np.where(runs, np.arange(data.steps) - self.since + 1, 0)
        columns: dict[str, Array] = {
            "obs": data.obs,
            "next_obs": data.next_obs,
            "env_action": data.action,
            "env_reward": data.reward,
            "env_terminated": data.terminated,
            "env_truncated": data.truncated,
            "elapsed": self.elapsed,
            "skill": self.skill,
            "call_elapsed": call_elapsed,
            "call_end": np.where(self.end == 0, RUNNING, self.end).astype(np.int8),
            "call_succeeded": self.end != 0,
        }
        if lengths := self.skills.lengths:
            columns["call_length"] = np.full(data.steps, lengths[-1])
        for i, goal in self.goal.items():
            columns[f"{self.skills.skills[i].name}/goal"] = goal[self.since]
        for i, own in enumerate(self.goal_spaces):
            if own is not None and i not in self.goal:
                columns[f"{self.skills.skills[i].name}/goal"] = own.start(data.steps)
        columns |= {INFO + key: value for key, value in data.info.items() if value.ndim == 1}
        trace = Trace((), {name: x.reshape(*lead, *x.shape[1:]) for name, x in columns.items()})
        info = [key for key, value in data.info.items() if value.ndim == 1]
        spaces = data.observation_space, data.action_space
        recorder = Recorder(self.skills, spaces, 1, info=info)
        recorder.add(trace)
        log = recorder.log(learning=[skill.name for skill in self.skills.skills])
        starts = runs & (self.since == np.arange(data.steps))
        call = np.where(runs, np.cumsum(starts) - 1, -1)
        episode = np.searchsorted(data.offset, np.flatnonzero(starts), side="right") - 1
        log = replace(log, episode=episode)
        first = np.flatnonzero(starts)
        goals = {self.skills.skills[i].name: goal[first] for i, goal in self.goal.items()}
        may = self.may.sum(axis=0)
        return Segments(log, data, self.skill, call, may, self.may[first], goals, self.left_out)


class _LacksInfo(DeclarationError):
    """A skill reads a key of ``info`` that data do not have."""


class _DataInfo(Mapping[str, Any]):
    """The info of steps of data; a key that these do not have is refused."""

    def __init__(self, data: Dataset, rows: Array, skill: Skill) -> None:
        self._data = data
        self._rows = rows
        self._skill = skill

    def _refuse(self, key: object) -> NoReturn:
        raise _LacksInfo(f"skill {path_of(self._skill)!r} reads info[{key!r}]")

    def __getitem__(self, key: str) -> Any:
        if key not in self._data.info:
            self._refuse(key)
        return self._data.info[key][self._rows]

    def get(self, key: str, default: Any = None) -> Any:
        """Return a key; raise a DeclarationError that names one that is not there."""
        return self[key]

    def __contains__(self, key: object) -> bool:
        if key not in self._data.info:
            self._refuse(key)
        return True

    def __iter__(self) -> Iterator[str]:
        return iter(self._data.info)

    def __len__(self) -> int:
        return len(self._data.info)


def _chunks(steps: int) -> Iterator[slice]:
    """Yield slices of steps that are judged at once."""
    for begin in range(0, steps, ROWS):
        yield slice(begin, min(begin + ROWS, steps))
