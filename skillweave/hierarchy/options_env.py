"""OptionsEnv: an environment whose actions are skills, as an ordinary Gymnasium VectorEnv."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from skillweave._internal.messages import short
from skillweave._internal.seeding import Seeds
from skillweave.envs.checked import LONGEST_EPISODE
from skillweave.envs.engine import Engine
from skillweave.envs.env_infos import allowed_rows
from skillweave.errors import DeclarationError
from skillweave.policies.core import RUNNING, Array, Turn, World, restart
from skillweave.policies.floats import in_usual_floats
from skillweave.policies.hierarchy import SKILL, unless_none
from skillweave.policies.parts import GOAL
from skillweave.policies.spaces import space_of
from skillweave.skills.skill_set import SkillSet, acting_policy, within
from skillweave.spaces import obs_dtype, unpack
from skillweave.spaces.choices import ChoiceSpace


class OptionsEnv(VectorEnv[Any, Any, Any]):
    """Each action is a call of a skill; within one ``step`` every environment finishes its call.

    A call ends when its skill stops, ``call_steps`` are over, or the episode ends; an environment
    whose call is over waits without being stepped. The reward is ``Σ γᵏ rₖ`` over the call, to be
    discounted by γ^τ afterwards (Sutton, Precup & Singh 1999, sec. 3). Environments reset in the
    same step.

    ``info`` of a step, arrays over N environments: ``steps`` (τ), ``discount`` (γ^τ, or 0 where
    terminated), ``call_return`` (Σ rₖ), ``next_obs`` (the true successors, one array whatever the
    space: see ``spaces.pack``), and Gymnasium's ``final_obs``. Where initiation sets exist:
    ``action_mask`` (N, S), and ``next_action_mask``, the mask of ``next_obs`` (all True where the
    episode terminated, or no skill may start).

    Args:
        engine: the environments; stepped in part where calls differ in length.
        skills: the meaning of the actions.
        gamma: γ of one primitive step.
        seed: of the sampling of skills that are not greedy. The random numbers of a call depend on
            it and on the number of earlier calls alone, so no generator's state is stored.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, engine: Engine, skills: SkillSet, gamma: float, seed: int = 0) -> None:
        self.engine = engine
        self.skills = skills
        self.num_envs = engine.num_envs
        self.single_observation_space = engine.observation_space
        self.single_action_space = skills.choice_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._gamma = float(gamma)
        self._policy = acting_policy(skills)
        self._hierarchy = within(self._policy)
        self._all = np.arange(engine.num_envs)
        self._seed = seed
        self._obs: Array = np.empty(0)
        self._mask: Array | None = None
        self._ready = False
        """It has been reset, and not been closed."""

    @in_usual_floats
    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset every environment.

        Args:
            seed: one for all; None: continue from the last one.
            options: not used.

        Returns:
            Observations (N, *obs_shape), and infos.

        Raises:
            DeclarationError: more than one seed was given, or it is closed.
        """
        if self.closed:
            raise DeclarationError("OptionsEnv.reset: it is closed; make another one")
        if isinstance(seed, list):
            raise DeclarationError("OptionsEnv.reset takes one seed for all environments")
        self._seed = self._seed + 1 if seed is None else seed
        self._calls = 0
        self._memory = self._policy.start(self.num_envs)
        self._obs = self.engine.reset(self._seed)
        self._mask = self._hierarchy.mask(self._obs)
        self._ready = True
        info = {} if self._mask is None else {"action_mask": self._mask}
        return unpack(self.single_observation_space, self._obs), info

    @in_usual_floats
    def step(self, actions: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Run one call in each environment.

        Args:
            actions: (N,) int64, a skill for each environment. Where skills have goals, a dict of
                arrays: ``skill`` (N,), and ``goal``, a dict of goals (N, *goal_shape) by skill.

        Returns:
            Observations (N, *obs_shape); rewards, terminated, truncated (N,); ``info``, see above.

        Raises:
            DeclarationError: an action is no skill, or the skill may not start there; or it has
                not been reset, or is closed.
        """
        if not self._ready:
            instead = "it is closed; make another one" if self.closed else "call reset() first"
            raise DeclarationError(f"OptionsEnv.step: {instead}")
        n = self.num_envs
        if self._hierarchy.goals:
            choice = self._hierarchy.fitted(self._choices(actions), self._obs, "OptionsEnv.step")
            skill = choice[SKILL]
        else:
            choice = skill = self._checked(actions)
        self._hierarchy.begin(self._memory, self._all, choice)
        world = World((Seeds(self._seed) / "call" / self._calls).numpy())
        self._calls += 1
        obs = self._obs.copy()
        next_obs = np.empty_like(obs)
        reward = np.zeros(n)
        call_return = np.zeros(n)
        discount = np.ones(n)
        steps = np.zeros(n, np.int64)
        terminated = np.zeros(n, bool)
        truncated = np.zeros(n, bool)
        rows = np.arange(n)
        while len(rows):
            self._hierarchy.check_lengths(self._memory, LONGEST_EPISODE)
            rows_obs = obs[rows]
            allowed = allowed_rows(self.engine.mask(), rows)
            action = self._policy.act(self._memory, rows, rows_obs, Turn(world, allowed))
            raw = self.engine.step(action, None if len(rows) == n else rows)
            reward[rows] += discount[rows] * raw.reward
            call_return[rows] += raw.reward
            discount[rows] *= self._gamma
            steps[rows] += 1
            next_obs[rows] = raw.next_obs
            step = raw.seen(rows_obs, action, steps[rows])
            self._policy.observe(self._memory, rows, step)
            over = self._memory["end"][rows] != RUNNING
            ended = raw.terminated | raw.truncated
            obs[rows] = raw.next_obs
            if ended.any():
                terminated[rows] = raw.terminated
                truncated[rows] = raw.truncated
                obs[rows[ended]] = self.engine.reset_some(rows[ended])
                restart(self._policy, self._memory, rows[ended])
            if over.any():
                rows = rows[~over]
        self._obs = obs
        self._mask = self._hierarchy.mask(obs)
        info = {
            "steps": steps,
            "discount": (discount * ~terminated).astype(np.float32),
            "call_return": call_return,
            "next_obs": next_obs,
            "skill": skill,
            **self._masks(next_obs, terminated, truncated),
            **self._final(next_obs, terminated | truncated),
        }
        unpacked = unpack(self.single_observation_space, obs)
        return unpacked, reward.astype(np.float32), terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """Release the engine; ``kwargs`` are not used."""
        self._ready = False
        self.engine.close()

    def _masks(self, next_obs: Array, terminated: Array, truncated: Array) -> dict[str, Any]:
        """Return masks of the skills that may start: in the next observations and successors."""
        if self._mask is None:
            return {}
        mask = self._mask.copy()
        mask[terminated] = True
        limited = np.flatnonzero(truncated & ~terminated)
        if len(limited):
            mask[limited] = unless_none(self._hierarchy.may_start(next_obs[limited]))
        return {"action_mask": self._mask, "next_action_mask": mask}

    def _final(self, next_obs: Array, ended: Array) -> dict[str, Any]:
        """Return the last observations of ended episodes, in Gymnasium's form."""
        if not ended.any():
            return {}
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended):
            final[i] = unpack(self.single_observation_space, next_obs[i])
        return {"final_obs": final, "_final_obs": ended}

    def _choices(self, actions: Any) -> Array:
        """Return skills with goals as choices (N,); no number of a goal changes."""
        space = self.single_action_space
        assert isinstance(space, ChoiceSpace)
        if isinstance(actions, np.ndarray) and actions.dtype.fields is not None:
            self._checked(actions[SKILL])
            return actions.reshape(self.num_envs)
        given = actions.get(GOAL) if isinstance(actions, Mapping) else None
        goals_of: Mapping[str, Any] = given if isinstance(given, Mapping) else {}
        if set(space.goal_spaces) - set(goals_of) or SKILL not in actions:
            raise DeclarationError(
                f"OptionsEnv.step: actions are {short(actions)}, but skills have goals: give a "
                "dict with 'skill', a number for each environment, and 'goal', a dict with goals "
                f"for {', '.join(map(repr, space.goal_spaces))}"
            )
        choice = np.zeros(self.num_envs, obs_dtype(space))
        choice[SKILL] = self._checked(actions[SKILL])
        for name, part in space.goal_spaces.items():
            whose = f"skill {name!r}"
            goals = space_of(part).goals(goals_of[name], self.num_envs, "OptionsEnv.step", whose)
            choice[GOAL][name] = goals
        return choice

    def _checked(self, actions: Any) -> Array:
        """Return the numbers of skills (N,)."""
        skill = np.asarray(actions)
        count = self.skills.choices
        if skill.size != self.num_envs or skill.dtype.kind not in "iu":
            raise DeclarationError(
                f"OptionsEnv.step: the skills are {short(actions)}; they must be a whole number "
                f"for each of {self.num_envs} environments, from 0 to {count - 1}"
            )
        skill = skill.reshape(self.num_envs)
        wrong = skill[(skill < 0) | (skill >= count)]
        if len(wrong):
            raise DeclarationError(f"action {int(wrong[0])} is no skill: there are {count}")
        if self._mask is not None and not (may := self._mask[self._all, skill]).all():
            row = int(may.argmin())
            one = self.skills.skills[int(self.skills.skill_of(skill[row]))]
            raise DeclarationError(
                f"skill {one.name!r} may not start in environment {row}: its initiation() is False "
                "there; choose among info['action_mask']"
            )
        return skill
