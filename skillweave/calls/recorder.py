"""The recorder of calls: it reads traces, and is the only place in which a log of calls is made.

Every way of acting feeds it: ``record_calls`` and evaluations a step at a time, through a
``TraceFeed``; training with what its collectors have recorded in any case.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.paths import join
from skillweave._internal.policy_protocol import Memory
from skillweave.algorithms.batches import INFO, OF_STEP, Batch, Trace
from skillweave.calls.columns import GOAL, call_fields, fields_of
from skillweave.calls.log import CallLog, seen_places, skill_checksums, skill_code
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError
from skillweave.experience.views import OwnSteps, call_successes, info_numbers_of
from skillweave.experience.writer import TraceWriter
from skillweave.policies.core import LIMIT, RUNNING, Array, Step
from skillweave.runs.user_code import Texts, environment_texts
from skillweave.skills.base import RecordedSkill
from skillweave.skills.goals import Goals, goals_of
from skillweave.skills.skill_set import SkillSet, UntrainedHierarchy, skills_below
from skillweave.spaces import obs_dtype, obs_shape

SUMS = (
    ("number", np.int64),
    ("steps", np.int64),
    ("task_return", np.float64),
    ("own_return", np.float64),
    ("last_reward", np.float64),
    ("late", np.bool_),
)
"""Fields of a call that no log has: its number; its steps; with ``own_rewards`` the sum of the
environment's reward, not discounted, that of its skill's own reward (the environment's where it has
none; NaN where its code is not known), and this reward of its last step; and whether it went on to
its limit after it had succeeded, of skills with neither an end nor a length of their own."""
STEPS = {"next_obs": "next_obs", "action": "env_action", "reward": "env_reward"}
"""By a column of a log's steps, the column of a trace."""
MOST_BYTES = 4 * 2**30
"""The largest log."""
CALL = ("skill", "elapsed", "end", "length")
"""Fields of a hierarchy's memory that a recorder reads."""
FED_ROWS = 64
"""The most steps of a trace that is fed step by step."""
FED_BYTES = 2**25
"""The most bytes of observations in such a trace."""


@dataclass
class _Piece:
    """Calls that ended and steps that were made in one trace."""

    first: int
    """The number of the first call that started in it, or will start next."""
    calls: Array
    steps: dict[str, Array]

    @property
    def size(self) -> int:
        """The number of steps."""
        return len(self.steps["call"])


class Recorder:
    """Calls of one level of skills in the making, from traces of its steps.

    A trace has the columns of ``SCHEMA`` that say what the environments did, and under the level's
    path ``skill`` (−1: none acts), ``call_elapsed``, ``call_end`` and, with chosen lengths,
    ``call_length``. A call starts where ``call_start`` is true, or without this column where
    ``call_elapsed`` is 1; an episode where ``elapsed`` is.

    Args:
        skills: of the level.
        spaces: of the environments' observations and actions.
        num_envs: N.
        info: keys of ``info`` to record.
        path: of the level, "" or ``inner`` for example.
        above: the place of each skill that is a hierarchy on the way to the level, by the path of
            the level that it is in.
        latest: the number of latest steps to keep at least; None: keep all.
        own_rewards: judge each step by the skill's own reward, too, for ``rows``.
        inside: keep the observations inside of calls.
        steps: keep the steps of calls; else there is no log, only ``rows`` without observations.
        spec: the environment, for the log's ``code``; None: it is not recorded.

    Raises:
        DeclarationError: the latest steps would take more than 4 GiB.
    """

    def __init__(
        self,
        skills: SkillSet,
        spaces: tuple[gym.Space[Any], gym.Space[Any]],
        num_envs: int,
        *,
        info: Sequence[str] = (),
        path: str = "",
        above: Mapping[str, int] | None = None,
        latest: int | None = None,
        own_rewards: bool = False,
        inside: bool = True,
        steps: bool = True,
        spec: EnvSpec | None = None,
    ) -> None:
        self.skills = skills
        self.spaces = spaces
        self.info = tuple(info)
        self.latest = latest
        self.path = path
        self._above = dict(above or {})
        self._columns = f"{path}/" if path else ""
        self._own_rewards = own_rewards
        self._inside = inside
        self._keeps_steps = steps
        self._environment = Texts() if spec is None else environment_texts(spec)
        self.goals: dict[str, Goals] = dict(goals_in(skills).values())
        """The goals of skills that have some, by name."""
        self.endless = np.array([is_endless(skills, i) for i in range(len(skills.skills))], bool)
        """(S,) bool, with ``own_rewards`` their ``success`` is asked in each step, for ``late``."""
        self.limits = tuple(skills.limit(i) for i in range(len(skills.skills)))
        """The most steps of a call, by skill; None: it has no limit."""
        self.steps = 0
        """Steps that are kept."""
        self._bytes = 0  # of all steps so far
        sizes = {k: goals.space.flat(goals.start(1)).shape[1] for k, goals in self.goals.items()}
        row = np.dtype([*SUMS, *call_fields(spaces[0], skills.choices, sizes, whole=steps)])
        n = num_envs
        self._latest = np.zeros(n, row)  # the latest call of each environment
        self._latest["number"] = -1
        self._open, self._won = np.zeros(n, bool), np.zeros(n, bool)  # it runs; success() is true
        self._episode = np.full(n, -1)
        self._count = np.zeros(n, np.int64)
        # The calls of an environment before its episode. Where that was open when the recording
        # began, its first calls are unknown, so the next one is number 1 in it.
        self._first = np.full(n, -1)
        self._episodes = self._calls = 0
        self._parts: deque[_Piece] = deque()
        self._last: tuple[Trace, Array] | None = None  # the last row of the trace before
        if latest is not None:
            check_size(latest, spaces)

    @property
    def calls(self) -> int:
        """The number of calls that have ended and are kept."""
        return sum(len(part.calls) for part in self._parts)

    @property
    def reads_infos(self) -> bool:
        """True if the recorder reads the ``info`` of steps."""
        methods = ("success", "reward") if self._own_rewards else ("success",)
        return bool(self.info) or any(
            skill.defines(method) for skill in self.skills.skills for method in methods
        )

    def add(self, trace: Batch, ids: Array | None = None) -> None:
        """Read the next steps of a trace.

        Args:
            trace: a ``Trace`` (T, k); or a batch of its columns, with ``call_succeeded`` and those
                of ``info``.
            ids: (k,) ascending, the environments of the trace; None: all N.

        Raises:
            EnvError: a key of ``info`` is missing, or holds no numbers.
            DeclarationError: the log would have more than 4 GiB.
        """
        ids = np.arange(len(self._open)) if ids is None else ids
        acts = self._acts(trace)
        begins = trace["elapsed"] == 1
        k = len(ids)
        starts = trace.get(self._columns + "call_start")
        if starts is None:
            starts = trace[self._columns + "call_elapsed"] == 1
        starts = starts & acts
        goes_on = acts & ~starts
        cut = ids[self._open[ids] & ~goes_on[0] & ~begins[0]]
        if self._last is not None and len(cut):
            last, before = self._last
            over = np.isin(before, cut)[None]
            self._end(last, over, self._latest, before[None][over])
        ended = self._latest[cut]
        over = acts & (trace[self._columns + "call_end"] != RUNNING)
        # Else its hierarchy was not called again, or was called with a fresh memory.
        over[:-1] |= acts[:-1] & ~goes_on[1:] & ~begins[1:]
        episode, order = self._episodes_of(begins, starts, ids)
        # A row for each call; a step's call is in the row ``at``.
        calls = np.concatenate([self._latest[ids], self._started(trace, starts, episode, order)])
        at = _numbered(starts, np.arange(k), k)
        mine = acts & (calls["number"][at] >= 0)
        over &= mine
        steps = self._steps(trace, mine, calls["number"][at])
        np.add.at(calls["steps"], at[mine], 1)
        if self._own_rewards:
            self._judge(trace, mine, over, calls, at, ids)
        self._end(trace, over, calls, at[over])
        part = _Piece(self._calls, np.concatenate([ended, calls[at[over]]]), steps)
        self._latest[ids] = calls[at[-1]]
        self._open[ids] = mine[-1] & ~over[-1]
        self._calls += len(calls) - k
        infos = trace.infos[-1:] if isinstance(trace, Trace) else ()
        self._last = Trace(infos, {name: x[-1:].copy() for name, x in trace.items()}), ids
        self._keep(part)

    def _episodes_of(self, begins: Array, starts: Array, ids: Array) -> tuple[Array, Array]:
        """Return the number of each step's episode, and of its call in that, (T, k) int64.

        Args:
            begins: (T, k) bool, an episode begins with the step.
            starts: (T, k) bool, a call starts with it.
            ids: (k,) the environments.
        """
        before = self._count[ids] + np.cumsum(starts, axis=0) - starts
        first = _running(np.where(begins, before, -1), self._first[ids])
        begins = begins.copy()
        begins[0] |= self._episode[ids] < 0
        episode = _numbered(begins, self._episode[ids], self._episodes)
        self._episode[ids], self._first[ids] = episode[-1], first[-1]
        self._count[ids] = before[-1] + starts[-1]
        self._episodes += int(begins.sum())
        return episode, before - first

    def rows(self) -> Array:
        """Return the calls that are kept and have ended, (C,), in the order of their starts.

        Their fields are those of ``SUMS`` and ``call_fields``.
        """
        rows = np.concatenate([self._latest[:0], *(part.calls for part in self._parts)])
        rows = rows[rows["number"] >= (self._parts[0].first if self._parts else 0)]
        return rows[np.argsort(rows["number"])]

    def log(self, learning: Collection[str] = ()) -> CallLog:
        """Return the calls that are kept and have ended, in the order of their starts.

        Args:
            learning: names of the skills that learnt meanwhile.
        """
        rows = self.rows()
        steps = self._joined()
        skills = self.skills
        inside = np.flatnonzero(np.isin(steps["call"], rows["number"]))
        inside = inside[np.argsort(steps["call"][inside], kind="stable")]
        steps = {k: x[inside] if len(x) else x for k, x in steps.items() if k != "call"}
        kept = [name for name in rows.dtype.names or () if name not in dict(SUMS)]
        columns = {name: np.ascontiguousarray(rows[name]) for name in kept} | steps
        columns["offset"] = np.concatenate([[0], np.cumsum(rows["steps"])])
        log = CallLog(
            tuple(s.name for s in skills.skills),
            skills.lengths,
            skill_checksums(skills, learning),
            seen_places(skills),
            tuple(map(_remembers, skills.policies)),
            tuple(skill.defines("success") for skill in skills.skills),
            *self.spaces,
            **fields_of(columns),
            code=self._environment | skill_code(skills),
            limits=self.limits,
        )
        return log if self.latest is None else log.latest(self.latest)

    def _acts(self, trace: Batch) -> Array:
        """Return the steps in which the level's skills act, (T, k) bool."""
        acts: Array = trace[self._columns + "skill"] >= 0
        if "valid" in trace:
            acts &= trace["valid"]
        for level, place in self._above.items():
            acts &= trace[join(level, "skill")] == place
        return acts

    def _started(self, trace: Batch, starts: Array, episode: Array, order: Array) -> Array:
        """Return the rows of calls that start in the steps ``starts`` (T, k) bool.

        Args:
            episode: (T, k) int64, the numbers of the steps' episodes.
            order: (T, k) int64, the numbers of their calls in these.
        """
        new = np.zeros(int(starts.sum()), self._latest.dtype)
        new["number"] = self._calls + np.arange(len(new))
        new["seed"] = -1
        new["choice"] = trace[self._columns + "skill"][starts]
        if lengths := self.skills.lengths:
            length = trace[self._columns + "call_length"][starts]
            new["choice"] = new["choice"] * len(lengths) + np.searchsorted(lengths, length)
        new["episode"], new["order"] = episode[starts], order[starts]
        new["age"] = trace["elapsed"][starts] - 1
        for name, goals in self.goals.items():
            new[GOAL + name] = goals.space.flat(trace[f"{self._columns}{name}/goal"][starts])
        if self._keeps_steps:
            new["start"] = trace["obs"][starts]
        return new

    def _steps(self, trace: Batch, mine: Array, number: Array) -> dict[str, Array]:
        """Return the columns of the steps ``mine`` (T, k) bool, in the order of time.

        Args:
            number: (T, k) int64, of each step's call.
        """
        if not self._keeps_steps:
            return {"call": np.zeros(0, np.int64)}
        columns = {"call": number}
        columns |= {name: trace[column] for name, column in STEPS.items()}
        for key in self.info:
            known = trace.get(INFO + key)
            columns[INFO + key] = info_numbers_of(trace, key) if known is None else known  # type: ignore[arg-type]
        every = mine.all()
        flat = {k: x.reshape(-1, *x.shape[2:]) if every else x[mine] for k, x in columns.items()}
        flat["reward"] = flat["reward"].astype(np.float32)
        if not self._inside:
            flat["next_obs"] = flat["next_obs"][:0].copy()
        return flat

    def _judge(
        self, trace: Any, mine: Array, over: Array, calls: Array, at: Array, ids: Array
    ) -> None:
        """Judge the steps ``mine`` (T, k) bool by the skills, for ``SUMS``; see ``add``."""
        skills = self.skills.skills
        running = trace[self._columns + "skill"]
        elapsed, end = (trace[f"{self._columns}call_{name}"] for name in ("elapsed", "end"))
        own = trace["env_reward"].astype(np.float64)
        np.add.at(calls["task_return"], at[mine], own[mine])
        for i, skill in enumerate(skills):
            acts = mine & (running == i)
            if isinstance(skill, RecordedSkill):
                own[acts] = np.nan
            elif skill.defines("reward") and acts.any():
                steps = OwnSteps.of_skill(trace, self._columns, skill, acts)
                own[acts] = steps.judged("reward")[acts]
        np.add.at(calls["own_return"], at[mine], own[mine])
        calls["last_reward"][at[over]] = own[over]
        endless = mine & self.endless[running]
        if endless.any():
            won = call_successes(trace, skills, self._columns, endless)
            before = np.concatenate([self._won[ids][None], won[:-1]])
            late = over & (end == LIMIT) & won & before & (elapsed > 1)
            calls["late"][at[late]] = True
            self._won[ids] = won[-1]

    def _end(self, trace: Batch, over: Array, calls: Array, at: Array) -> None:
        """Write in ``calls``, rows ``at`` (K,), how those whose last steps are ``over`` ended."""
        known = trace.get(self._columns + "call_succeeded")
        if known is None:
            skills = self.skills.skills
            known = call_successes(trace, skills, self._columns, over)  # type: ignore[arg-type]
        end = trace[self._columns + "call_end"][over]
        calls["end_reason"][at] = np.where(end == RUNNING, LIMIT, end)
        calls["succeeded"][at] = known[over]
        for name in ("terminated", "truncated"):
            calls[name][at] = trace[f"env_{name}"][over]
        if self._keeps_steps and len(at):
            may = self.skills.hierarchy.may_start(trace["next_obs"][over])
            calls["may_follow"][at] = may

    def _keep(self, part: _Piece) -> None:
        """Keep a new part, and forget the oldest ones that are not needed."""
        self._parts.append(part)
        self.steps += part.size
        self._bytes += sum(column.nbytes for column in part.steps.values())
        while self.latest is not None and self.steps - self._parts[0].size >= self.latest:
            self.steps -= self._parts.popleft().size
        if self.latest is None and self._bytes > MOST_BYTES:
            raise DeclarationError(
                f"the log of calls has {self.steps:,} steps and more than {MOST_BYTES // 2**30} "
                "GiB, the most that is recorded: play fewer episodes, or log no calls"
            )

    def _joined(self) -> dict[str, Array]:
        """Return the columns of all steps that are kept."""
        steps = [part.steps for part in self._parts]
        if steps:
            return {name: np.concatenate([some[name] for some in steps]) for name in steps[0]}
        observation, action = self.spaces
        return {
            "call": np.zeros(0, np.int64),
            "next_obs": np.zeros((0, *obs_shape(observation)), obs_dtype(observation)),
            "action": np.zeros((0, *(action.shape or ())), action.dtype),
            **{k: np.zeros(0, np.float32) for k in ("reward", *(INFO + key for key in self.info))},
        }


class TraceFeed:
    """Joins single steps into traces for recorders.

    Args:
        recorders: of the levels of one policy.
    """

    def __init__(self, recorders: Sequence[Recorder]) -> None:
        self.recorders = tuple(recorders)
        self._infos = any(recorder.reads_infos for recorder in recorders)
        self._each = _bytes_of(recorders[0].spaces[0])
        self._ids = np.zeros(0, np.int64)
        self._rows = 0
        self._out: TraceWriter | None = None

    def add(self, ids: Array, step: Step, levels: Mapping[str, Memory]) -> None:
        """Add a played step of environments ``ids`` (k,), ascending.

        Args:
            step: of these environments; ``elapsed`` counts the steps of the episode.
            levels: by path, what ``calls_in`` reads of each level's calls after the step.
        """
        if len(ids) < len(self._ids):  # some have stopped
            self.flush()
        if self._out is None:
            self._ids = ids
            self._rows = max(1, min(FED_ROWS, FED_BYTES // max(1, self._each * len(ids))))
            self._out = TraceWriter(self._rows, len(ids), keep_infos=self._infos)
        columns = {name: getattr(step, field) for name, field in OF_STEP.items()}
        columns["elapsed"] = step.elapsed
        for path, calls in levels.items():
            for key, values in calls.items():
                plain = key == "skill" or key.endswith("/goal")
                columns[join(path, key if plain else f"call_{key}")] = values
        self._out.write(**columns)
        self._out.next(step.info)
        if self._out.row == self._rows:
            self.flush()

    def flush(self) -> None:
        """Let the recorders read the steps so far."""
        if self._out is not None:
            trace = self._out.trace()
            ids = self._ids
            self._out = None
            self._ids = ids[:0]
            for recorder in self.recorders:
                recorder.add(trace, ids)


def calls_in(memory: Any, goals: Mapping[int, tuple[str, Goals]], rows: Array) -> Memory:
    """Return the fields of a hierarchy's memory that a ``TraceFeed`` reads.

    These are ``skill``, ``elapsed``, ``end`` and perhaps ``length``, (k,) each, and the goals of
    skills that have some, (k, *goal_shape).

    Args:
        goals: of ``goals_in``.
        rows: (k,) environments.
    """
    found = {key: memory[key][rows] for key in CALL if key in memory}
    return found | {f"{name}/goal": memory["goal"][str(i)][rows] for i, (name, _) in goals.items()}


def goals_in(skills: SkillSet) -> dict[int, tuple[str, Goals]]:
    """Return the names and goals of skills that have goals, by their places."""
    every = ((i, skill.name, goals_of(skill)) for i, skill in enumerate(skills.skills))
    return {i: (name, goals) for i, name, goals in every if goals is not None}


def levels_below(
    skills: SkillSet, path: str = "", above: Mapping[str, int] | None = None
) -> dict[str, tuple[SkillSet, dict[str, int]]]:
    """Return the skills of each level, by its path; and the places of the skills that lead there.

    These are by the path of the level that they are in. A level stands before those below it.

    Args:
        skills: of the outermost level.
        path: of this level.
        above: the places of the skills that lead to it.
    """
    levels = {path: (skills, dict(above or {}))}
    for i, (skill, policy) in enumerate(zip(skills.skills, skills.policies, strict=True)):
        if (below := skills_below(policy)) is not None:
            levels |= levels_below(below, join(path, skill.name), levels[path][1] | {path: i})
    return levels


def check_size(steps: int, spaces: tuple[gym.Space[Any], gym.Space[Any]]) -> None:
    """Raise a DeclarationError where a log of ``steps`` steps would be too large."""
    each = sum(map(_bytes_of, spaces)) + 4  # and the reward
    if steps * each > MOST_BYTES:
        raise DeclarationError(
            f"a log of {steps:,} steps would have {each * steps / 2**30:.1f} GiB ({each:,} bytes a "
            f"step); at most {MOST_BYTES // 2**30} GiB are recorded: record at most "
            f"{MOST_BYTES // each:,} steps"
        )


def _numbered(starts: Array, latest: Array, count: int) -> Array:
    """Return the number of what runs in each step, (T, k): numbers rise with each start.

    Args:
        starts: (T, k) bool.
        latest: (k,) numbers of what ran before; −1: nothing.
        count: the first number that is free.
    """
    numbers = np.full(starts.shape, -1)
    numbers[starts] = count + np.arange(starts.sum())
    return _running(numbers, latest)


def _running(values: Array, before: Array) -> Array:
    """Return the largest of ``before`` (k,) and the values (T, k) so far, which it may change."""
    values[0] = np.maximum(values[0], before)
    return np.maximum.accumulate(values, axis=0)


def is_endless(skills: SkillSet, i: int) -> bool:
    """Return True if skill ``i`` is no hierarchy and has neither an end nor a length of its own."""
    skill = skills.skills[i]
    if skill.max_steps is not None or skill.call_steps is not None or skill.defines("termination"):
        return False
    return skills_below(skills.policies[i]) is None


def _remembers(policy: Any) -> bool:
    """Return whether a skill's policy has a memory within a call; a hierarchy remembers its own.

    Args:
        policy: None: it learns, and is not there yet.
    """
    return policy is None or isinstance(policy, UntrainedHierarchy) or bool(policy.start(1))


def _bytes_of(space: gym.Space[Any]) -> int:
    return int(np.prod(obs_shape(space))) * obs_dtype(space).itemsize
