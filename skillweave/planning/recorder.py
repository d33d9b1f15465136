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

from skillweave.collecting.skill_set import SkillSet, skills_below
from skillweave.collecting.user_code import Texts, environment_texts
from skillweave.collecting.views import call_successes, info_numbers_of, judged
from skillweave.collecting.writer import kept_info
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError
from skillweave.experience import INFO, Batch, Trace
from skillweave.paths import join
from skillweave.planning.calls import CallLog, seen_places, skill_checksums, skill_code
from skillweave.policies.core import LIMIT, RUNNING
from skillweave.skills.base import RecordedSkill
from skillweave.skills.goals import Goals, goals_of
from skillweave.spaces import obs_dtype, obs_shape
from skillweave.types import Array, Memory, Step

MOST_BYTES = 4 * 2**30
"""The largest log."""
CALL = ("skill", "elapsed", "end", "limit")
"""What a recorder reads of a player's memory."""
FED_ROWS = 64
"""The most steps of a trace that is fed step by step."""
FED_BYTES = 2**25
"""The most bytes of observations in such a trace."""


@dataclass
class _Part:
    """Calls that started, steps that were made, and calls that ended, in one trace."""

    started: tuple[Array, ...]
    steps: tuple[Array, ...]
    ended: list[tuple[Array, ...]]

    @property
    def size(self) -> int:
        """The number of steps."""
        return len(self.steps[0])

    @property
    def nbytes(self) -> int:
        """The bytes of its steps."""
        return sum(column.nbytes for column in self.steps)


class Recorder:
    """Calls of one level of skills in the making, from traces of its steps.

    A trace has the columns of ``SCHEMA`` that say what the environments did, and under the level's
    path ``skill``, ``call_elapsed``, ``call_end`` and, with chosen lengths, ``call_limit``. A call
    starts where ``call_elapsed`` is 1, an episode where ``elapsed`` is.

    Args:
        skills: of the level.
        spaces: of the environments' observations and actions.
        num_envs: N.
        info: keys of ``info`` to record.
        path: of the level, "" or ``inner`` for example.
        above: the place of each skill that is a hierarchy on the way to the level, by the path of
            the level that it is in.
        latest: the number of latest steps to keep at least; None: keep all.
        own_rewards: compute each step by the skill's own reward, too, for ``own_returns``.
        inside: keep the observations inside of calls.
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
        spec: EnvSpec | None = None,
    ) -> None:
        self.skills, self.spaces, self.info, self.latest = skills, spaces, tuple(info), latest
        self.path, self._above = path, dict(above or {})
        self._columns = f"{path}/" if path else ""
        self._own_rewards, self._inside = own_rewards, inside
        self._environment = Texts() if spec is None else environment_texts(spec)
        self.goals: dict[str, Goals] = dict(goals_in(skills).values())
        """The goals of skills that have some, by name."""
        self.steps = 0
        """Steps that are kept."""
        self._bytes = 0
        n = num_envs
        self._call = np.full(n, -1)  # the latest call of each environment
        self._open = np.zeros(n, bool)  # it runs
        self._episode, self._order = np.full(n, -1), np.zeros(n, np.int64)
        self._episodes = self._calls = 0
        self._parts: deque[_Part] = deque()
        self._last: tuple[Trace, Array] | None = None  # the last row of the trace before
        if latest is not None:
            check_size(latest, spaces)

    @property
    def calls(self) -> int:
        """The number of calls that have ended and are kept."""
        return sum(len(some[0]) for part in self._parts for some in part.ended)

    @property
    def reads_infos(self) -> bool:
        """It reads the ``info`` of steps."""
        methods = ("success", "reward") if self._own_rewards else ("success",)
        return bool(self.info) or any(
            skill.defines(method) for skill in self.skills.skills for method in methods
        )

    def add(self, trace: Batch, ids: Array | None = None) -> None:
        """Read the next steps.

        Args:
            trace: a ``Trace`` (T, k); or a batch of its columns, with ``call_succeeded`` and those
                of ``info``.
            ids: (k,) ascending, the environments of the trace; None: all N.

        Raises:
            EnvError: a key of ``info`` is missing, or holds no numbers.
            DeclarationError: the log would have more than 4 GiB.
        """
        ids = np.arange(len(self._call)) if ids is None else ids
        acts, lead = self._acts(trace), trace["elapsed"].shape
        end = trace[self._columns + "call_end"]
        starts = acts & (trace[self._columns + "call_elapsed"] == 1)
        begins = trace["elapsed"] == 1
        ended = self._cut_before(acts[0] | begins[0], ids)
        # Of an episode that was open when the recording began, the first calls are unknown.
        late = (self._episode[ids] < 0) & ~begins[0]
        self._order[ids[late]] = 1
        call = _numbered(starts, self._call[ids], self._calls)
        count = np.cumsum(starts, axis=0)
        began = np.maximum.accumulate(np.where(begins, np.arange(lead[0])[:, None], -1), axis=0)
        before = (count - starts)[np.maximum(began, 0), np.arange(lead[1])]
        order = count - 1 + np.where(began < 0, self._order[ids], -before)
        begins[0] |= late
        episode = _numbered(begins, self._episode[ids], self._episodes)
        started = (
            call[starts],
            trace["obs"][starts],
            self._choice(trace, starts),
            episode[starts],
            order[starts],
            trace["elapsed"][starts] - 1,
            *(
                goals.space.flat(trace[f"{self._columns}{name}/goal"][starts])
                for name, goals in self.goals.items()
            ),
        )
        over = acts & (end != RUNNING)
        if self.path:
            over[:-1] |= acts[:-1] & ~acts[1:] & ~begins[1:]  # its hierarchy was not called again
        over &= call >= 0
        if over.any():
            ended.append(self._ends(trace, over, call))
        part = _Part(started, self._steps(trace, acts & (call >= 0), call), ended)
        self._parts.append(part)
        self._call[ids], self._episode[ids], self._order[ids] = call[-1], episode[-1], order[-1] + 1
        self._calls += len(started[0])
        self._episodes += int(begins.sum())
        if self.path:
            self._open[ids] = acts[-1] & (call[-1] >= 0) & (end[-1] == RUNNING)
            infos = trace.infos[-1:] if isinstance(trace, Trace) else ()
            self._last = Trace(infos, {k: v[-1:] for k, v in trace.items()}), ids
        self._forget(part)

    def log(self, learning: Collection[str] = ()) -> CallLog:
        """Return the calls that are kept and have ended, in the order of their starts.

        Args:
            learning: names of the skills that learnt meanwhile.
        """
        starts, steps, ends = self._joined()
        known, start, choice, episode, order, age, *goals = starts
        _, end_reason, succeeded, terminated, truncated, may = ends
        call, next_obs, action, reward = steps[:4]
        counts = np.bincount(np.searchsorted(known, call), minlength=len(known))
        skills = self.skills
        log = CallLog(
            tuple(s.name for s in skills.skills),
            skills.lengths,
            skill_checksums(skills, learning),
            seen_places(skills),
            # A hierarchy that learns has no policy yet; it remembers its call.
            tuple(not hasattr(p, "start") or bool(p.start(1)) for p in skills.policies),
            tuple(skill.defines("success") for skill in skills.skills),
            *self.spaces,
            start=start,
            choice=choice,
            end_reason=end_reason,
            succeeded=succeeded,
            terminated=terminated,
            truncated=truncated,
            episode=episode,
            seed=np.full(len(episode), -1),
            order=order,
            age=age,
            may_follow=may,
            offset=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            next_obs=next_obs,
            action=action,
            reward=reward,
            info=dict(zip(self.info, steps[4:], strict=False)),
            goals=dict(zip(self.goals, goals, strict=True)),
            code=self._environment | skill_code(skills),
        )
        return log if self.latest is None else log.latest(self.latest)

    def own_returns(self) -> Array:
        """Return Σ of the skill's own reward of each call of the log, not discounted, (C,).

        Of a skill without a reward it is the environment's; NaN: unknown, as the skill's code is.
        """
        starts, steps, _ = self._joined()
        place = np.searchsorted(starts[0], steps[0])
        return np.bincount(place, steps[-1], minlength=len(starts[0]))

    def _acts(self, trace: Batch) -> Array:
        """Return the steps in which the level's skills act, (T, k) bool."""
        acts: Array = np.ones(trace["elapsed"].shape, bool)
        if "valid" in trace:
            acts &= trace["valid"]
        for level, place in self._above.items():
            acts &= trace[join(level, "skill")] == place
        return acts

    def _choice(self, trace: Batch, starts: Array) -> Array:
        choice, lengths = (
            trace[self._columns + "skill"][starts].astype(np.int64),
            self.skills.lengths,
        )
        if lengths:
            limit = trace[self._columns + "call_limit"][starts]
            choice = choice * len(lengths) + np.searchsorted(lengths, limit)
        return choice

    def _steps(self, trace: Batch, mine: Array, call: Array) -> tuple[Array, ...]:
        """Return the columns of the steps ``mine`` (T, k) bool, in the order of time."""
        columns = [call, trace["next_obs"], trace["env_action"], trace["env_reward"]]
        for key in self.info:
            known = trace.get(INFO + key)
            columns.append(info_numbers_of(trace, key) if known is None else known)  # type: ignore[arg-type]
        if self._own_rewards:
            columns.append(self._own(trace, mine))  # type: ignore[arg-type]
        if mine.all():
            flat = [c.reshape(-1, *c.shape[2:]) for c in columns]
        else:
            flat = [c[mine] for c in columns]
        flat[3] = flat[3].astype(np.float32)
        if not self._inside:
            flat[1] = flat[1][:0]
        return tuple(flat)

    def _own(self, trace: Trace, mine: Array) -> Array:
        """Return each step's reward by its skill, (T, k) float64."""
        own = trace["env_reward"].astype(np.float64)
        elapsed = trace[self._columns + "call_elapsed"]
        for i, skill in enumerate(self.skills.skills):
            acts = mine & (trace[self._columns + "skill"] == i)
            if isinstance(skill, RecordedSkill):
                own[acts] = np.nan
            elif skill.defines("reward") and acts.any():
                goal = trace.get(f"{self._columns}{skill.name}/goal")
                own[acts] = judged(trace, skill, "reward", acts, elapsed, goal)
        return own

    def _ends(self, trace: Batch, over: Array, call: Array) -> tuple[Array, ...]:
        """Return the ends of the calls whose last steps are ``over`` (T, k) bool."""
        known = trace.get(self._columns + "call_succeeded")
        if known is None:
            skills = self.skills.skills
            known = call_successes(trace, skills, self._columns, over)  # type: ignore[arg-type]
        end = trace[self._columns + "call_end"][over].astype(np.int8)
        return (
            call[over],
            np.where(end == RUNNING, np.int8(LIMIT), end),
            known[over],
            trace["env_terminated"][over],
            trace["env_truncated"][over],
            self.skills.hierarchy.may_start(trace["next_obs"][over]),
        )

    def _cut_before(self, goes_on: Array, ids: Array) -> list[tuple[Array, ...]]:
        """Return the ends of calls that ran at the end of the trace before, and were cut there.

        Args:
            goes_on: (k,) bool, the level acts on in environments ``ids``, or a new episode starts.
        """
        cut = ids[~goes_on & self._open[ids]]
        self._open[ids] = False
        if self._last is None or not len(cut):
            return []
        trace, before = self._last
        over = np.isin(before, cut)[None]
        return [self._ends(trace, over, self._call[before][None])]

    def _forget(self, part: _Part) -> None:
        """Count a new part, and forget the oldest ones that are not needed."""
        self.steps += part.size
        self._bytes += part.nbytes
        while self.latest is not None and self.steps - self._parts[0].size >= self.latest:
            oldest = self._parts.popleft()
            self.steps -= oldest.size
            self._bytes -= oldest.nbytes
        if self.latest is None and self._bytes > MOST_BYTES:
            raise DeclarationError(
                f"the log of calls has {self.steps:,} steps and more than {MOST_BYTES // 2**30} "
                "GiB, the most that is recorded: play fewer episodes, or log no calls"
            )

    def _joined(self) -> tuple[tuple[Array, ...], tuple[Array, ...], tuple[Array, ...]]:
        """Return starts, steps and ends of the calls that are whole, in the order of starts."""
        parts = [self._nothing(), *self._parts]
        starts = _concatenated([part.started for part in parts])
        ends = _concatenated([some for part in parts for some in part.ended])
        steps = _concatenated([part.steps for part in parts])
        known = np.intersect1d(starts[0], ends[0], assume_unique=True)
        inside = np.flatnonzero(np.isin(steps[0], known))
        inside = inside[np.argsort(steps[0][inside], kind="stable")]
        by_call = np.argsort(ends[0], kind="stable")
        by_call = by_call[np.isin(ends[0][by_call], known)]
        first = np.searchsorted(starts[0], known)
        kept = steps if self._inside else (*steps[:1], *steps[2:])
        taken = [column[inside] for column in kept]
        if not self._inside:
            taken.insert(1, steps[1])
        return (
            tuple(column[first] for column in starts),
            tuple(taken),
            tuple(column[by_call] for column in ends),
        )

    def _nothing(self) -> _Part:
        """Return a part without a step, whose columns have the types of others."""
        observation, action = self.spaces
        obs = np.zeros((0, *obs_shape(observation)), obs_dtype(observation))
        whole, truth = np.zeros(0, np.int64), np.zeros(0, bool)
        first = self._parts[0].steps if self._parts else None
        actions = np.zeros((0, *(action.shape or ())), action.dtype)
        more = [np.zeros(0, np.float32)] * (len(self.info) + self._own_rewards)
        steps: tuple[Array, ...] = (whole, obs, actions, np.zeros(0, np.float32), *more)
        return _Part(
            (
                *(whole, obs, whole, whole, whole, whole),
                *(goals.space.flat(goals.start(0)) for goals in self.goals.values()),
            ),
            steps if first is None else tuple(column[:0] for column in first),
            [
                (
                    whole,
                    np.zeros(0, np.int8),
                    truth,
                    truth,
                    truth,
                    self.skills.hierarchy.may_start(obs),
                )
            ],
        )


class TraceFeed:
    """Joins single steps into traces for recorders.

    Args:
        recorders: of the levels of one policy.
    """

    def __init__(self, recorders: Sequence[Recorder]) -> None:
        self.recorders = tuple(recorders)
        self._infos = any(recorder.reads_infos for recorder in recorders)
        self._each = _bytes_of(recorders[0].spaces[0])
        # Each engine and player gives arrays of its own in each step, so these are not copied.
        self._steps: list[tuple[Array, Step, Mapping[str, Memory], Mapping[str, Any]]] = []
        self._rows = 0

    def add(self, ids: Array, step: Step, levels: Mapping[str, Memory]) -> None:
        """Add a step of environments ``ids`` (k,), ascending.

        Args:
            step: of these environments; ``elapsed`` counts the steps of the episode.
            levels: by path, what ``calls_in`` reads of each level's calls after the step.
        """
        # Environments stop one after another; when half have stopped, a new trace begins.
        if self._steps and 2 * len(ids) < len(self._steps[0][0]):
            self.flush()
        if not self._steps:
            self._rows = max(1, min(FED_ROWS, FED_BYTES // max(1, self._each * len(ids))))
        info = kept_info(step.info) if self._infos else {}
        self._steps.append((ids, step, levels, info))
        if len(self._steps) == self._rows:
            self.flush()

    def flush(self) -> None:
        """Let the recorders read the steps so far."""
        if self._steps:
            trace, ids = self._trace(), self._steps[0][0]
            self._steps = []
            for recorder in self.recorders:
                recorder.add(trace, ids)

    def _trace(self) -> Trace:
        """Return the steps as a trace of the environments of the first one."""
        every, steps, levels, infos = zip(*self._steps, strict=True)
        columns = {name: [getattr(step, field) for step in steps] for name, field in FED.items()}
        for path, calls in levels[0].items():
            for key in calls:
                plain = key == "skill" or key.endswith("/goal")
                name = join(path, key if plain else f"call_{key}")
                columns[name] = [level[path][key] for level in levels]
        joined = {name: np.concatenate(parts) for name, parts in columns.items()}
        lead = len(steps), len(every[0])
        if len(joined["elapsed"]) == lead[0] * lead[1]:
            whole = {name: x.reshape(*lead, *x.shape[1:]) for name, x in joined.items()}
            return Trace(infos, whole)
        places = [np.searchsorted(every[0], ids) for ids in every]
        at = np.repeat(np.arange(lead[0]), [len(ids) for ids in every]), np.concatenate(places)
        whole = {"valid": np.zeros(lead, bool)}
        whole["valid"][at] = True
        for name, x in joined.items():
            whole[name] = np.zeros((*lead, *x.shape[1:]), x.dtype)
            whole[name][at] = x
        pairs = zip(infos, places, strict=True)
        return Trace([_spread(info, place, lead[1]) for info, place in pairs], whole)


def calls_in(memory: Any, goals: Mapping[int, tuple[str, Goals]], rows: Array) -> Memory:
    """Return what a ``TraceFeed`` takes of a hierarchy's memory.

    These are ``skill``, ``elapsed``, ``end`` and perhaps ``limit``, (k,) each, and the goals of
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


FED = {
    "obs": "obs",
    "env_action": "action",
    "next_obs": "next_obs",
    "env_reward": "reward",
    "env_terminated": "terminated",
    "env_truncated": "truncated",
    "elapsed": "elapsed",
}
"""By a column of a trace, the field of a ``Step``."""


def levels_below(skills: SkillSet) -> dict[str, tuple[SkillSet, dict[str, int]]]:
    """Return the skills of each level, by its path; and the places of the skills that lead there.

    These are by the path of the level that they are in.
    """
    found: dict[str, tuple[SkillSet, dict[str, int]]] = {"": (skills, {})}
    waiting = [""]
    while waiting:
        path = waiting.pop()
        here, above = found[path]
        for i, (skill, policy) in enumerate(zip(here.skills, here.policies, strict=True)):
            if (below := skills_below(policy)) is not None:
                inner = join(path, skill.name)
                found[inner] = below, above | {path: i}
                waiting.append(inner)
    return found


def check_size(steps: int, spaces: tuple[gym.Space[Any], gym.Space[Any]]) -> None:
    """Raise a DeclarationError where a log of ``steps`` steps would be too large."""
    each = sum(map(_bytes_of, spaces)) + 4  # and the reward
    if steps * each > MOST_BYTES:
        _refuse(steps, each)


def _spread(info: Mapping[str, Any], place: Array, n: int) -> dict[str, Any]:
    """Return an ``info`` of environments ``place`` (k,) as one of n; the others have zeros."""
    whole: dict[str, Any] = {}
    for key, value in info.items():
        if isinstance(value, np.ndarray) and value.shape[:1] == place.shape:
            whole[key] = np.zeros((n, *value.shape[1:]), value.dtype)
            whole[key][place] = value
        else:
            whole[key] = _spread(value, place, n) if isinstance(value, dict) else value
    return whole


def _numbered(starts: Array, latest: Array, count: int) -> Array:
    """Return the number of what runs in each step, (T, k): numbers rise with each start.

    Args:
        starts: (T, k) bool.
        latest: (k,) numbers of what ran before; −1: nothing.
        count: the first number that is free.
    """
    numbers = np.full(starts.shape, -1)
    numbers[starts] = count + np.arange(starts.sum())
    numbers[0] = np.maximum(numbers[0], latest)
    return np.maximum.accumulate(numbers, axis=0)


def _concatenated(parts: Sequence[tuple[Array, ...]]) -> tuple[Array, ...]:
    return tuple(np.concatenate(columns) for columns in zip(*parts, strict=True))


def _bytes_of(space: gym.Space[Any]) -> int:
    return int(np.prod(obs_shape(space))) * obs_dtype(space).itemsize


def _refuse(steps: int, each: int) -> None:
    raise DeclarationError(
        f"a log of {steps:,} steps would have {each * steps / 2**30:.1f} GiB ({each:,} bytes a "
        f"step); at most {MOST_BYTES // 2**30} GiB are recorded: record at most "
        f"{MOST_BYTES // each:,} steps"
    )
