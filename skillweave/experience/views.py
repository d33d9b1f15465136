"""Views of a trace: each learner's rows, judged by its own skill after the steps were made.

Everything here is a function of the trace's columns. Nothing else calls a skill's reward and
success on recorded steps; its reward is called once for all rows of a request in which it acted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from skillweave._internal.messages import short
from skillweave.algorithms.batches import INFO, OF_STEP, Batch, Trace
from skillweave.errors import EnvError, SkillweaveError
from skillweave.policies.core import OWN, RUNNING, Array, Step, own_step, part_of
from skillweave.policies.infos import Infos
from skillweave.skills import Skill, call_method
from skillweave.skills.goals import Goals, check_reads_goal
from skillweave.skills.outputs import missing_key
from skillweave.skills.own_part import OwnPart
from skillweave.skills.probing import first_time
from skillweave.spaces import ActionCodec

AT_ONCE = 1 << 26
"""Bytes of observations that a skill judges at once."""


def seen_by(
    skill: Skill, step: Step, elapsed: Array, rows: Array | None = None, goal: Array | None = None
) -> Step:
    """Return a step of a trace as a skill sees it, whose calls have their own time.

    Where the environment is scored by a task, a skill sees the environment's own reward.

    Args:
        elapsed: (m,) steps of its calls so far, this one included.
        rows: (m,) ascending, some rows of the step; None: all.
        goal: (m, *goal_shape) of its calls; None: it has no goals.
    """
    return part_of(own_step(step), elapsed, rows, skill.max_steps, goal)


def stops(skill: Skill, step: Step, ids: Array) -> Array:
    """Return where a skill's own termination is true, (n,) bool.

    Args:
        step: as the skill sees it.
        ids: (n,) the environments, for messages.
    """
    if not skill.defines("termination"):
        return np.zeros(len(ids), bool)
    return call_method(skill, "termination", step, ids)


@dataclass(frozen=True)
class OwnSteps:
    """The steps of a trace in which a skill acts, or the policy of the task."""

    trace: Trace
    skill: Skill | None
    """None: the task itself."""
    acts: Array
    """(T, N) bool, it acts."""
    elapsed: Array
    """(T, N) int64, steps of its call so far."""
    goal: Array | None
    """(T, N, *goal_shape) of its calls; None: it has no goals."""

    @classmethod
    def of_skill(cls, trace: Trace, path: str, skill: Skill, acts: Array) -> OwnSteps:
        """Return the steps of a skill that is called; ``path`` begins its level's columns."""
        goal = trace.get(f"{path}{skill.name}/goal")
        return cls(trace, skill, acts, trace[path + "call_elapsed"], goal)

    def rows(self, end: Array) -> Batch:
        """Return the rows of these steps, judged by the skill's own reward and ends.

        Args:
            end: (T, N) int8, ``CallEnd`` of its call after the step.

        Returns:
            ``reward``, ``terminated`` and ``truncated``, 0 in other rows; ``valid`` is ``acts``.
        """
        acts, skill = self.acts, self.skill
        if (
            self.goal is not None
            and skill is not None
            and acts.any()
            and first_time(skill, "its goal")
        ):
            t = int(acts.any(axis=1).argmax())
            check_reads_goal(skill, self._alone(skill, t, np.flatnonzero(acts[t])))
        terminated = acts & (self.trace["env_terminated"] | (end == OWN))
        truncated = acts & (end != RUNNING) & ~terminated
        reward = self.judged("reward")
        return Batch(reward=reward, terminated=terminated, truncated=truncated, valid=acts)

    @property
    def timed_out(self) -> Array:
        """Return where the skill's ``max_steps`` has ended its call, (T, N) bool."""
        if self.skill is None or self.skill.max_steps is None:
            return np.zeros(self.elapsed.shape, bool)
        found: Array = (self.elapsed >= self.skill.max_steps) & ~self.trace["env_terminated"]
        return found

    def judged(self, what: Literal["reward", "success"]) -> Array:
        """Return the skill's rewards or successes, (T, N); 0 where it does not act.

        A reward that changes (``Skill.reward_changes``) gets each step by itself, once, by time.

        Raises:
            SkillError: the skill's method failed, or returned a wrong result; the message is that
                of the first step in which it does.
        """
        if self.skill is None:
            paid = self.trace["env_reward"]
            return paid if self.acts.all() else np.where(self.acts, paid, 0)
        most = max(1, AT_ONCE // max(1, self.trace["obs"][0].nbytes))
        if what == "reward" and self.skill.reward_changes:
            most = 1
        found: Array = np.zeros(self.acts.shape, np.float32 if what == "reward" else np.bool_)
        for first in range(0, len(found), most):
            part = slice(first, first + most)
            found[part][self.acts[part]] = self._answers(self.skill, what, part)
        return found

    def _answers(self, skill: Skill, what: str, part: slice) -> Array:
        """Return a skill's reward or success in the rows ``part``, (K,) by time."""
        acts = self.acts[part]
        infos = self.trace.infos[part]
        every = acts.all()
        steps = np.flatnonzero(acts.any(axis=1)).tolist()

        def flat(x: Array) -> Array:
            x = x[part]
            return x.reshape(-1, *x.shape[2:]) if every else x[acts]

        if len(steps) > 1:
            info = JointInfo([infos[t] for t in steps] if infos else [], acts[steps])
            elapsed = flat(self.elapsed)
            goal = None if self.goal is None else flat(self.goal)
            step = step_of({name: flat(self.trace[name]) for name in OF_STEP}, elapsed, info)
            seen = seen_by(skill, step, elapsed, goal=goal)
            try:
                found = call_method(skill, what, seen, np.nonzero(acts)[1])
            except SkillweaveError:
                pass  # it is raised below, by the step that it is of
            else:
                if not info.mixed:
                    return found
        each: list[Array] = [np.zeros(0, bool)]
        for t in steps:
            ids = np.flatnonzero(acts[t])
            each.append(call_method(skill, what, self._alone(skill, part.start + t, ids), ids))
        return np.concatenate(each)

    def _alone(self, skill: Skill, t: int, ids: Array) -> Step:
        """Return step ``t`` of environments ``ids`` (k,), as the skill sees it."""
        infos = self.trace.infos
        columns = {name: self.trace[name][t] for name in OF_STEP}
        step = step_of(columns, self.elapsed[t], infos[t] if infos else {})
        goal = None if self.goal is None else self.goal[t, ids]
        return seen_by(skill, step, self.elapsed[t, ids], ids, goal)


def step_of(columns: Mapping[str, Array], elapsed: Array, info: Mapping[str, Any]) -> Step:
    """Return a step of the columns of ``OF_STEP``, in which nothing has timed out."""
    fields: dict[str, Any] = {field: columns[name] for name, field in OF_STEP.items()}
    never = np.zeros(len(elapsed), bool)
    return Step(**fields, timed_out=never, elapsed=elapsed, info=info)


def call_successes(trace: Trace, skills: Sequence[Skill], path: str, over: Array) -> Array:
    """Return which calls of a level have succeeded, (T, N) bool.

    By the skill's ``success`` in the call's last step; of a skill without one, if its own
    termination ended the call.

    Args:
        skills: of the level.
        path: of the level, before the names of its columns.
        over: (T, N) bool, the steps in which its calls ended.
    """
    succeeded: Array = over & (trace[path + "call_end"] == OWN)
    for i, skill in enumerate(skills):
        last = over & (trace[path + "skill"] == i)
        if skill.defines("success") and last.any():
            succeeded[last] = OwnSteps.of_skill(trace, path, skill, last).judged("success")[last]
    return succeeded


def rows_of(
    trace: Trace,
    steps: Batch,
    path: str,
    record: Sequence[str],
    goals: Goals | None = None,
    part: OwnPart | None = None,
    of_call: Mapping[str, Array] | None = None,
) -> Batch:
    """Return the rows of a learner: its judged steps, with the columns that it learns from.

    Args:
        path: before the names of the learner's own columns: empty, or ``inner/up/``.
        record: names of raw columns. With ``call_end`` among them, rows are to be judged again:
            observations and masks are the environment's, without a goal.
        goals: of the learner's skill: it observes them, too.
        part: of observations and actions that the learner's skill has; None: it has all.
        of_call: raw columns of the learner's calls.
    """
    columns = {**trace, **(of_call or {})}
    found = {k: columns.get(k) for k in ("mask", "next_mask", "overridden", *record)}
    goal = None if goals is None else trace[path + "goal"]
    if "call_end" in record:
        found |= {"obs": trace["obs"], "next_obs": trace["next_obs"], "goal": goal}
        found |= {name: _info_of(trace, name) for name in record if name.startswith(INFO)}
    else:
        found |= {k: learner_obs(trace[k], goal, goals, part) for k in ("obs", "next_obs")}
        if part is not None:
            found |= {k: part.part.mask(found[k]) for k in ("mask", "next_mask")}
    found |= {k: trace.get(path + k) for k in ("action", "dist_params")}
    return steps.replace(**found, steps=np.ones(trace.lead, np.int64))


def _info_of(trace: Trace, name: str) -> Array:
    """Return the column of a key of ``info`` that skills read in all steps, (T, N, …).

    Raises:
        EnvError: a step has no such key, or no number for each environment.
    """
    key = name.removeprefix(INFO)
    for info in trace.infos:
        if key not in info:
            raise EnvError(
                f"a skill with shared_replay reads info[{key!r}], which is stored with each step, "
                "but no environment has set it in a later step: let them set it in each step"
            )
    return info_numbers_of(trace, key)


def own_actions(env_action: Array, part: OwnPart | None, codec: ActionCodec) -> tuple[Array, Array]:
    """Return the environment's actions (k, …) in policy units of a skill.

    Returns:
        The skill's part of each, and where it could have acted so: it leaves the rest of the action
        as it was, or has the choice that was made, (k,) bool.
    """
    possible = np.ones(len(env_action), bool)
    if part is not None:
        mine = part.part.read(env_action)
        same = part.part.write(mine, env_action) == env_action
        possible = same.reshape(len(same), -1).all(axis=1)
        env_action = mine
    return codec.from_env(env_action), possible


def with_others(
    rows: Batch, trace: Trace, anyone: Array, end: Array, part: OwnPart | None, codec: ActionCodec
) -> Batch:
    """Return a skill's rows with those of others beside them, which its own judge may judge later.

    Args:
        rows: of the skill, with raw columns; it is ``valid`` where it acts.
        anyone: (T, N) bool, where the skill or another one acts.
        end: (T, N) int8, why calls ended after the step.
        part: of actions that the skill has; None: all.
        codec: of the skill's actions.
    """
    own = rows["valid"]
    others = anyone & ~own
    env_action = trace["env_action"]
    flat = env_action.reshape(-1, *env_action.shape[2:])
    action, possible = own_actions(flat, part, codec)
    action = action.reshape(rows["action"].shape)
    possible = possible.reshape(own.shape)
    valid = own | (others & possible)
    terminated = rows["terminated"] | (valid & others & trace["env_terminated"])
    truncated = valid & (end != RUNNING)
    truncated[:-1] &= trace.ended[:-1]
    truncated[:-1] |= valid[:-1] & ~valid[1:]
    if part is not None:  # the next step may be one that the skill could not have made
        truncated[-1] |= valid[-1] & others[-1]
    at = own.reshape(*own.shape, *[1] * (action.ndim - 2))
    return rows.replace(
        action=np.where(at, rows["action"], action),
        terminated=terminated,
        truncated=truncated & ~terminated,
        valid=valid,
        call_end=np.where(anyone, end, RUNNING),
        own=own,
    )


def learner_obs(obs: Array, goal: Any, goals: Goals | None, part: OwnPart | None) -> Array:
    """Return observations (…, *obs_shape) as a skill's networks see them: its part, and its goal.

    Args:
        goal: (…, *goal_shape) of its calls; None: it has none.
        goals: of the skill; None: it has none.
        part: of the observation that it sees; None: all.
    """
    if part is not None:
        obs = part.part.see(obs)
    return obs if goals is None else goals.join(obs, goal)


def info_numbers_of(trace: Trace, key: str) -> Array:
    """Return a key of ``info`` in all steps of a trace, (T, N, …) numbers.

    Raises:
        EnvError: a step has no such key, or no number for each environment.
    """
    values = []
    for info in trace.infos:
        known = info.keys_so_far.examples if isinstance(info, Infos) else info
        if key not in known:
            raise EnvError(f"info[{key!r}] is to be recorded, but {missing_key(info)}")
        values.append(np.asarray(info[key]))
        if values[-1].dtype.kind not in "biuf" or values[-1].shape[:1] != trace.lead[1:]:
            raise EnvError(
                f"info[{key!r}] is to be recorded, but it is {short(info[key])}; a number for each "
                "environment is needed"
            )
    return np.stack(values)


class JointInfo(Mapping[str, Any]):
    """The infos of several steps as one of K rows; a key is joined when it is read.

    Args:
        infos: of S steps.
        acts: (S, N) bool, the K rows.
        whole: the info that this one is part of.
    """

    def __init__(
        self, infos: Sequence[Mapping[str, Any]], acts: Array, whole: JointInfo | None = None
    ) -> None:
        self._infos = infos
        self._acts = acts
        self._whole = whole
        self.keys_so_far = getattr(infos[0], "keys_so_far", None) if infos else None
        self.mixed = False
        """A key was read that cannot be joined: it differs in its kind between steps."""

    def __getitem__(self, key: str) -> Any:
        """Return a key of ``info`` of all rows, joined from the steps of a trace."""
        values = [info[key] for info in self._infos if key in info or isinstance(info, Infos)]
        if not values:
            raise KeyError(key)
        first = values[0]
        envs = self._acts.shape[1]
        if len(values) < len(self._infos):
            self._mix()
        elif all(isinstance(v, dict) for v in values):
            return JointInfo(values, self._acts, self._whole or self)
        elif all(
            isinstance(v, np.ndarray)
            and v.shape[:1] == (envs,)
            and v.dtype == first.dtype
            and v.shape == first.shape
            for v in values
        ):
            return np.stack(values)[self._acts]
        else:
            self._mix()
        return first

    def __contains__(self, key: object) -> bool:
        given = [key in info for info in self._infos]
        if any(given) and not all(given):
            self._mix()
        return any(given)

    def get(self, key: str, default: Any = None) -> Any:
        """Return a key's values in the ``info`` of these steps, or ``default``: no one has it."""
        given = key in self
        return self[key] if given else default

    def __iter__(self) -> Iterator[str]:
        keys = {key: None for info in self._infos for key in info}
        if any(len(info) != len(keys) for info in self._infos):
            self._mix()
        return iter(keys)

    def __len__(self) -> int:
        return len(set(iter(self)))

    def _mix(self) -> None:
        (self._whole or self).mixed = True
