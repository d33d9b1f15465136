"""Judges of rows from replay: they compute rewards and ends again.

A skill is judged by its own methods, a plain agent by its environment's ``compute_reward``. The
store that asks them is ``buffers.judged.JudgedStore``.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import error_text, short
from skillweave._internal.notices import notice
from skillweave.algorithms.batches import INFO, OF_STEP, RawRows, number_type
from skillweave.envs.env_infos import random_actions
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import DeclarationError, EnvError, SkillError, TrainingError
from skillweave.experience.views import learner_obs, own_actions, step_of
from skillweave.policies.core import Array, Step, part_of, read_only
from skillweave.policies.spaces import at, space_of
from skillweave.skills import Skill, call_method
from skillweave.skills.base import path_of
from skillweave.skills.goals import goals_of, reads_goal
from skillweave.skills.outputs import call_user, checked
from skillweave.skills.own_part import OwnPart
from skillweave.skills.residual import Residual
from skillweave.spaces import action_codec, choice_counts

ACHIEVED, DESIRED = "achieved_goal", "desired_goal"
"""Parts of the observations of an environment of goals."""
MANY = 100
"""Steps after which one of them should have reached a goal of the space."""


class SkillJudge:
    """The judge of a skill, under other goals and of other skills' steps.

    Args:
        part: of observations and actions that it has; None: all.
        hindsight: it is judged under goals that were reached.
        shared: it is judged in other skills' steps: the keys of ``info`` that are stored with them,
            with an example (1, …); None: in its own steps alone.

    Raises:
        DeclarationError: the skill cannot be judged so.
    """

    def __init__(
        self,
        skill: Skill,
        part: OwnPart | None,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        *,
        hindsight: bool = True,
        shared: Mapping[str, Array] | None = None,
    ) -> None:
        self.who = f"skill {path_of(skill)!r}"
        why = f"{self.who}: its algorithm has {'hindsight' if hindsight else 'shared_replay'}"
        if hindsight and skill.goal_space is None:
            raise DeclarationError(
                f"{why}, but it has no goals: set goal_space, or give it an algorithm of its own "
                "without hindsight"
            )
        if hindsight and not skill.defines("achieved_goal"):
            raise DeclarationError(
                f"{why}, but it does not say what it reaches: define achieved_goal(self, obs), "
                "which returns the goals that are reached in obs, (n, *goal_shape)"
            )
        if skill.reward_changes:
            raise DeclarationError(
                f"{why}, which computes rewards of past steps again, but reward_changes says that "
                "they would be others"
            )
        if shared is not None and isinstance(skill.policy, Residual):
            raise DeclarationError(
                f"{self.who}: its algorithm has shared_replay, but its actions are added to those "
                "of another policy (Residual), which other skills' actions are not: leave out "
                "shared_replay"
            )
        if shared is not None and part is not None and part.part.holds:
            raise DeclarationError(
                f"{self.who}: its algorithm has shared_replay, but rest is 'hold': it is unknown "
                "in which steps of other skills it could have left the rest of the action as it "
                "was: give rest numbers, or leave out shared_replay"
            )
        self._skill = skill
        self._part = part
        self._goals = goals_of(skill)
        self._keys = () if hindsight else tuple(shared or ())
        self._no_info = (
            f"{why}, which judges past steps again, but reads {{}}, which may be another one under "
            "another goal: compute it from step.next_obs"
        )
        if not hindsight:
            self._no_info = (
                f"{why}, which stores what it reads of info in the first step, but later it reads "
                "{}, too: read it in each step, or compute it from step.next_obs"
            )
        own_space = action_space if part is None else part.action_space
        self._codec = action_codec(own_space)
        self.observation_space: gym.Space[Any] = observation_space
        self.choices = sum(choice_counts(action_space))
        examples: dict[str, Array] = {
            "env_action": space_of(action_space).start(1),
            "env_reward": np.zeros(1, np.float32),
            "env_terminated": np.zeros(1, bool),
            "env_truncated": np.zeros(1, bool),
            "call_elapsed": np.zeros(1, np.int64),
        }
        if self._goals is not None:
            examples["goal"] = self._goals.start(1)
        examples |= {INFO + key: value for key, value in (shared or {}).items()}
        self.examples: Mapping[str, Array] = examples

    def goals(self, rows: RawRows) -> Array | None:
        """Return the goals that rows (…) had; None: it has none."""
        return None if self._goals is None else rows.columns["goal"].copy()

    def practised(self, obs: Array, rng: np.random.Generator) -> Array:
        """Return goals to practise in observations (k, …), by the skill's ``goals``."""
        assert self._goals is not None
        return self._goals.draw(obs, rng)

    def achieved(self, obs: Array) -> Array:
        """Return the goals that observations (k, …) have reached.

        Raises:
            SkillError: the skill's ``achieved_goal`` failed, or returned something else.
        """
        who = f"{self.who}: achieved_goal()"
        given = call_user(self._skill.achieved_goal, read_only(obs), who)
        assert self._goals is not None
        space = self._goals.space
        goals = space.goals(given, len(obs), who, self.who)
        for path, leaf in space.leaves.items():
            numbers = at(goals, path).reshape(len(goals), -1)
            if leaf.kind == "Box":
                if not np.isfinite(numbers).all():
                    raise SkillError(f"{who} returned NaN or infinity")
                continue
            low, high = (x.reshape(-1) for x in leaf.bounds)  # no network can see other choices
            if (wrong := ((numbers < low) | (numbers > high)).any(axis=1)).any():
                raise SkillError(space.is_out(goals[wrong][0], who, self.who))
        return goals

    def judged(self, rows: RawRows, goal: Array | None) -> tuple[Array, Array]:
        """Return the skill's rewards, and its and the environment's ends."""
        step = self._step(rows, goal)
        ids = np.arange(len(step.reward))
        ends = rows.columns["env_terminated"]
        if self._skill.defines("termination"):
            ends = ends | call_method(self._skill, "termination", step, ids)
        return call_method(self._skill, "reward", step, ids), ends

    def check_shared(self, rows: RawRows, goal: Array | None) -> None:
        """Raise a DeclarationError where the time of a call changes how its steps are judged."""
        shape = rows.columns["call_elapsed"].shape
        found = []
        for time in (1, 1 << 30):
            columns = {**rows.columns, "call_elapsed": np.full(shape, time)}
            found.append(self.judged(RawRows(rows.obs, rows.next_obs, columns), goal))
        for what, early, late in zip(("reward", "termination"), *found, strict=True):
            if not np.array_equal(early, late):
                raise DeclarationError(
                    f"{self.who}: its algorithm has shared_replay, but {what}() depends on "
                    "step.elapsed or step.timed_out, the time of its own call, which steps of "
                    "other skills do not have: let it depend on what step.obs, action and "
                    "next_obs show"
                )

    def check(self, rows: RawRows, goal: Array, *, differ: bool) -> None:
        """Raise an error where the skill's success reads ``info``, or nothing reads the goal.

        A notice is given where many goals were reached, and none of them is one to practise, or a
        success.
        """
        step = self._step(rows, goal)
        many = len(goal) >= MANY
        if self._skill.defines("success"):
            succeeds = call_method(self._skill, "success", step, np.arange(len(goal)))
            if many and not succeeds.any():
                notice(
                    f"{self.who}: success() is false in all of {len(goal):,} steps under the goals "
                    "that achieved_goal() says they have reached: does it return another goal?"
                )
        if not differ and not reads_goal(self._skill, step, ("reward", "termination")):
            raise DeclarationError(
                f"{self.who}: its algorithm has hindsight, but its reward() and termination() are "
                "the same for every goal: let them depend on step.goal, or leave out hindsight"
            )
        assert self._goals is not None
        if many and not self._goals.space.holds(goal).any():
            notice(
                f"{self.who}: none of the {len(goal):,} goals that achieved_goal() says were "
                f"reached is in goal_space (the first is {short(goal[0].tolist())}, goal_space is "
                f"{short(self._skill.goal_space)}): are they in the same units?"
            )

    def seen(self, obs: Array, goal: Array | None) -> Array:
        """Return observations (…) as the skill's networks see them."""
        return learner_obs(obs, goal, self._goals, self._part)

    def mask(self, mask: Array | None) -> Array | None:
        """Return the skill's part of the environment's action masks (…, A)."""
        return mask if self._part is None else self._part.part.mask(mask)

    def action(self, env_action: Array) -> tuple[Array, Array]:
        """Return the environment's actions (k, …) as the skill's, and which it could have done."""
        return own_actions(env_action, self._part, self._codec)

    def _step(self, rows: RawRows, goal: Array | None) -> Step:
        columns = {"obs": rows.obs, "next_obs": rows.next_obs, **rows.columns}
        elapsed = columns["call_elapsed"]
        stored = {key: columns[INFO + key] for key in self._keys}
        info = _StoredInfo(stored, self._no_info)
        step = step_of({name: columns[name] for name in OF_STEP}, elapsed, info)
        return part_of(step, elapsed, None, self._skill.max_steps, goal)


class _StoredInfo(Mapping[str, Any]):
    """The info of rows that are judged again: a few keys are stored, others are refused.

    Args:
        stored: numbers (k, …) by key.
        refusal: the message about another key, which stands in it as {}.
    """

    def __init__(self, stored: Mapping[str, Array], refusal: str) -> None:
        self._stored = stored
        self._refusal = refusal

    def __getitem__(self, key: str) -> Any:
        if key not in self._stored:
            self._refuse(key)
        return self._stored[key]

    def get(self, key: str, default: Any = None) -> Any:
        """Return a stored key; raise a DeclarationError that names another one."""
        return self[key]

    def __contains__(self, key: object) -> bool:
        if key not in self._stored:
            self._refuse(key)
        return True

    def __iter__(self) -> Iterator[str]:
        self._refuse("any key")

    def __len__(self) -> int:
        return len(self._stored)

    def _refuse(self, key: object) -> NoReturn:
        raise DeclarationError(self._refusal.format(f"info[{key!r}]"))


class _NotedInfo(Mapping[str, Any]):
    """The info of a step, which notes which keys are read."""

    def __init__(self, info: Mapping[str, Any]) -> None:
        self._info = info
        self.keys_so_far = getattr(info, "keys_so_far", None)
        self.read: dict[Any, None] = {}

    def __getitem__(self, key: str) -> Any:
        self.read[key] = None
        return self._info[key]

    def get(self, key: str, default: Any = None) -> Any:
        """Return a key, and note it; the default where no environment has given it."""
        self.read[key] = None
        return self._info.get(key, default)

    def __contains__(self, key: object) -> bool:
        self.read[key] = None
        return key in self._info

    def __iter__(self) -> Iterator[str]:
        return iter(self._info)

    def __len__(self) -> int:
        return len(self._info)


def first_step(spec: EnvSpec) -> Step:
    """Return the first step of an episode, with an action at random."""
    engine = make_engine(spec, 1)
    rng = np.random.default_rng(0)
    try:
        obs = np.array(engine.reset(0))
        action = random_actions(engine.action_space, 1, rng, engine.mask())
        step = engine.step(action).seen(obs, action, np.ones(1, np.int64))
        return replace(step, next_obs=np.array(step.next_obs))
    finally:
        engine.close()


@dataclass
class Sharing:
    """Skills of a hierarchy that learn from each other's steps."""

    spec: EnvSpec
    skills: tuple[Skill, ...]

    @cached_property
    def info(self) -> dict[str, Array]:
        """The keys of ``info`` that rewards and ends of the skills read, with an example (1, …).

        Raises:
            DeclarationError: a key is no number of each environment, or is not always there.
            SkillError: a skill's method failed.
        """
        step = first_step(self.spec)
        found: dict[str, Array] = {}
        for skill in self.skills:
            info = _NotedInfo(step.info)
            goals = goals_of(skill)
            goal = None if goals is None else goals.draw(step.obs, np.random.default_rng(0))
            seen = part_of(replace(step, info=info), step.elapsed, None, skill.max_steps, goal)
            for method in filter(skill.defines, ("reward", "termination")):
                call_method(skill, method, seen)
            for key in info.read:
                given = step.info.get(key)
                value = np.asarray(given)
                named = isinstance(key, str)
                if not named or value.dtype.kind not in "biuf" or value.shape[:1] != (1,):
                    raise DeclarationError(
                        f"skill {path_of(skill)!r}: its algorithm has shared_replay, which stores "
                        f"what it reads of info in each step, but info[{key!r}] is {short(given)} "
                        "after the first step; a number for each environment is needed in each step"
                    )
                found[key] = value.astype(number_type(value.dtype))
        return found


class AgentJudge:
    """The judge of a plain agent: its rewards and ends are those that were recorded."""

    def __init__(self, spec: EnvSpec) -> None:
        self.who = f"the environment {spec.name}"
        self.observation_space: gym.Space[Any] = spec.spaces.observation
        self._codec = action_codec(spec.spaces.action)
        self.choices = sum(choice_counts(spec.spaces.action))
        self.examples: Mapping[str, Array] = {
            "env_action": space_of(spec.spaces.action).start(1),
            "env_reward": np.zeros(1, np.float32),
            "env_terminated": np.zeros(1, bool),
        }

    def goals(self, rows: RawRows) -> None:
        """Return None: it has no goals."""

    def practised(self, obs: Array, rng: np.random.Generator) -> Array:
        """Raise an error: it has no goals."""
        raise NotImplementedError

    def achieved(self, obs: Array) -> Array:
        """Raise an error: it has no goals."""
        raise NotImplementedError

    def judged(self, rows: RawRows, goal: Array | None) -> tuple[Array, Array]:
        """Return the recorded rewards and ends."""
        return rows.columns["env_reward"], rows.columns["env_terminated"]

    def check(self, rows: RawRows, goal: Array, *, differ: bool) -> None:
        """Raise an error: it has no goals."""
        raise NotImplementedError

    def check_shared(self, rows: RawRows, goal: Array | None) -> None:
        """Do nothing: recorded rewards do not depend on who acted."""

    def seen(self, obs: Array, goal: Array | None) -> Array:
        """Return observations (…) as they are."""
        return obs

    def mask(self, mask: Array | None) -> Array | None:
        """Return the environment's action masks as they are."""
        return mask

    def action(self, env_action: Array) -> tuple[Array, Array]:
        """Return the environment's actions (k, …) in policy units, all of them possible."""
        return self._codec.from_env(env_action), np.ones(len(env_action), bool)


class GoalEnvJudge:
    """The judge of a plain agent in an environment of goals: the environment itself.

    Such environments (gymnasium-robotics) observe ``achieved_goal`` and ``desired_goal``, and
    compute rewards, and perhaps ends, of many pairs of these at once. One of them answers.

    Raises:
        DeclarationError: it is none.
    """

    def __init__(self, spec: EnvSpec) -> None:
        self.who = f"the environment {spec.name}"
        space: gym.Space[Any] = spec.spaces.observation
        self.observation_space = space
        parts = space.spaces if isinstance(space, gym.spaces.Dict) else {}
        if missing := [name for name in (ACHIEVED, DESIRED) if name not in parts]:
            raise DeclarationError(
                f"hindsight needs goals, but {self.who} has no {missing[0]!r} in its observations: "
                "take an environment of goals (a Dict with observation, achieved_goal and "
                "desired_goal), or a Hierarchy with a skill that has goals"
            )
        if parts[ACHIEVED] != parts[DESIRED]:
            raise DeclarationError(
                f"{self.who}: what is achieved is {short(parts[ACHIEVED])}, but what is desired is "
                f"{short(parts[DESIRED])}: hindsight puts one in the other's place, so both must "
                "have one space"
            )
        env = spec.make()
        weakref.finalize(self, env.close)
        env.reset(seed=0)
        self._reward = self._method(env, "compute_reward")
        if self._reward is None:
            raise DeclarationError(
                f"hindsight computes rewards again, but {self.who} has no "
                "compute_reward(achieved_goal, desired_goal, info)"
            )
        self._ends = self._method(env, "compute_terminated")
        self._one_by_one: set[str] = set()
        self.examples: Mapping[str, Array] = {
            "env_terminated": np.zeros(1, bool),
            "call_elapsed": np.zeros(1, np.int64),
        }
        self.choices = sum(choice_counts(spec.spaces.action))
        self._codec = action_codec(spec.spaces.action)

    @staticmethod
    def _method(env: gym.Env[Any, Any], name: str) -> Any:
        return env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None

    def goals(self, rows: RawRows) -> Array:
        """Return the goals that rows (…) had, as they were seen before the steps."""
        desired: Array = rows.obs[DESIRED].copy()
        return desired

    def practised(self, obs: Array, rng: np.random.Generator) -> Array:
        """Return the goals that recorded observations (k,) had: an environment draws them."""
        desired: Array = obs[DESIRED].copy()
        return desired

    def achieved(self, obs: Array) -> Array:
        """Return the goals that observations (k,) have reached."""
        reached: Array = obs[ACHIEVED]
        return reached

    def judged(self, rows: RawRows, goal: Array | None) -> tuple[Array, Array]:
        """Return the environment's rewards and ends."""
        assert goal is not None
        reached = rows.next_obs[ACHIEVED]
        reward = self._answers("compute_reward", self._reward, reached, goal, np.float32)
        if self._ends is not None:
            return reward, self._answers("compute_terminated", self._ends, reached, goal, bool)
        ends = rows.columns["env_terminated"]
        if ends.any():
            raise TrainingError(
                f"{self.who} terminates episodes, but has no compute_terminated(achieved_goal, "
                "desired_goal, info), so it is unknown where they end under another goal: let it "
                "truncate episodes instead, or define that method"
            )
        return reward, ends

    def check(self, rows: RawRows, goal: Array, *, differ: bool) -> None:
        """Give a notice where other goals have made no difference in many steps."""
        if not differ and len(goal) >= MANY:
            notice(
                f"{self.who}: in {len(goal):,} steps compute_reward() answers under the goals that "
                "were reached as it does under the desired ones, so hindsight teaches nothing: "
                "does it depend on the goal?"
            )

    def seen(self, obs: Array, goal: Array | None) -> Array:
        """Return observations (…) with these goals as ``desired_goal``."""
        obs = obs.copy()
        obs[DESIRED] = goal
        return obs

    def mask(self, mask: Array | None) -> Array | None:
        """Return the environment's action masks as they are."""
        return mask

    def action(self, env_action: Array) -> tuple[Array, Array]:
        """Return the environment's actions (k, …) in policy units, all of them possible."""
        return self._codec.from_env(env_action), np.ones(len(env_action), bool)

    def check_shared(self, rows: RawRows, goal: Array | None) -> None:
        """Do nothing: rewards are computed of goals alone."""

    def _answers(self, name: str, method: Any, reached: Array, goal: Array, kind: Any) -> Array:
        """Return a method's answers (k,), of all pairs at once if it takes them so."""
        n = len(goal)
        who = f"{self.who}: {name}()"
        if name not in self._one_by_one:
            try:
                found = np.asarray(method(_plain(reached), _plain(goal), {}))
            except Exception:
                found = None
            if found is not None and found.shape == (n,):
                return _checked(found, n, kind, who)
            self._one_by_one.add(name)
        each = []
        for i in range(n):
            try:
                each.append(method(_plain(reached[i]), _plain(goal[i]), {}))
            except Exception as error:
                reads = "; hindsight calls it with an empty info" * isinstance(error, KeyError)
                raise EnvError(f"{who} raised {error_text(error)}{reads}") from error
            if np.size(each[-1]) != 1 or each[-1] is None:
                raise EnvError(f"{who} returned {short(each[-1])}, but one number is needed")
        return _checked(np.array([np.asarray(x).reshape(()) for x in each]), n, kind, who)


def _checked(found: Array, n: int, kind: Any, who: str) -> Array:
    """Return an environment's answers (n,) as rewards or ends.

    Raises:
        EnvError: they are something else, or not finite.
    """
    try:
        return checked(found, n, kind, who)
    except SkillError as error:
        raise EnvError(str(error)) from error


def _plain(goals: Array) -> Any:
    """Return a copy of goals for a user's function; parts are a dict of arrays."""
    if goals.dtype.names is None:
        return goals.copy()
    return {name: _plain(goals[name]) for name in goals.dtype.names}
