"""A policy in one environment, an observation at a time: of ``Player``, and of exported folders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from .acting_errors import DeclarationError, PolicyError
from .core import RUNNING, Array, Memory, RowPolicy, Step, Turn, World, innermost
from .floats import in_usual_floats
from .hierarchy import CallAndReturn
from .infos import batched_infos
from .spaces import Space, allows_each, at

ROW = np.zeros(1, np.int64)
"""The one environment."""
MASK = "action_mask"
"""The name of masks in ``info`` and in observations."""


@dataclass(eq=False)
class Deployed:
    """A policy of plain data, with the spaces of its environment."""

    policy: RowPolicy
    sees: Space
    acts: Space


class Actor:
    """A policy that acts in one environment, for ``Player`` and exported folders.

    Args:
        deployed: the policy.
        deterministic: act greedily, else sample.
        seed: the seed of sampled actions.
        nan: what a NaN in an observation is: an error, or a zero.
    """

    def __init__(
        self,
        deployed: Deployed,
        *,
        deterministic: bool = True,
        seed: Any = 0,
        nan: Literal["error", "zero"] = "error",
    ) -> None:
        if nan not in ("error", "zero"):
            raise DeclarationError(f'nan is {nan!r}; it must be "error" or "zero"')
        self._deployed = deployed
        self._deterministic = deterministic
        self._nan = nan
        leaves = deployed.sees.leaves
        size = sum(deployed.acts.counts)
        self._real = [path for path, leaf in leaves.items() if leaf.record.kind == "f"]
        kinds = {leaf.record for leaf in leaves.values()}
        self._one_type = kinds.pop() if len(kinds) == 1 and len(self._real) == len(leaves) else None
        """The type of all numbers of an observation, if they are real and of one type."""
        self._choices = {path: leaf for path, leaf in leaves.items() if leaf.kind != "Box"}
        """The parts of observations that are choices, which networks see one-hot."""
        part = leaves.get((MASK,)) if deployed.sees.kind == "Dict" else None
        self._observed_mask = part is not None and size > 0 and int(np.prod(part.shape)) == size
        """Observations have a part that is the mask of actions."""
        self._world = World(np.random.default_rng(seed))
        self.reset()

    @in_usual_floats
    def reset(self) -> None:
        """Start a new episode with an empty memory."""
        self.memory: Memory = self._deployed.policy.start(1)
        self._before: tuple[Array, Array] | None = None
        self._elapsed = 0

    @in_usual_floats
    def act(
        self,
        obs: Any,
        reward: float = 0.0,
        info: Mapping[str, Any] | None = None,
        mask: Any = None,
        skill: str | None = None,
        goal: Any = None,
    ) -> Any:
        """Return the action for one observation, as the environment takes it.

        Args:
            obs: what the environment's ``reset`` or ``step`` returned.
            reward: the reward of the step; needed only where a skill's ``termination`` reads it.
            info: the step's info; an ``action_mask`` in it is used where ``mask`` is left out.
            mask: (A,) the actions that the environment allows, ``env.action_masks()`` for example;
                of a Dict or Tuple also a dict or tuple of masks. None: the mask in ``info``, or the
                observation's part ``action_mask``; else all.
            skill: the skill of the outermost hierarchy that acts, in place of the selector's, for
                a remote control. Another name than that of the running call starts a new call, and
                so does the same name where the call has ended; else the call goes on. Its
                ``initiation`` is not called, and of several lengths the longest counts. None: the
                selector chooses where the running call has ended.
            goal: of the named skill, where it has goals (``goal_space``). Another goal than before
                is for the running call: a new command starts no new call.

        Raises:
            DeclarationError: the observation, the mask or the goal does not fit the policy, or
                there is no such skill; the message names what does.
            SkillError: the goal is out of the skill's ``goal_space``.
        """
        deployed = self._deployed
        choices = self._deployed.acts.counts
        seen = self._seen(obs)
        given = dict(info or {})
        if choices and given.get(MASK) is not None:
            given[MASK] = self._allowed(given[MASK])[0]
        if self._before is not None:
            self._elapsed += 1
            if deployed.policy.watches:
                deployed.policy.observe(self.memory, ROW, self._step(seen, reward, given))
        if mask is not None and not choices:
            raise DeclarationError(
                f"act(): mask is {str(mask)[:100]}, but actions of {deployed.acts} are real "
                "numbers alone, none of which can be forbidden: leave it out"
            )
        if mask is None and choices:
            mask = given.get(MASK)
        if mask is None and self._observed_mask:
            mask = seen[MASK].reshape(-1)
        allowed = None if mask is None else self._allowed(mask)
        turn = Turn(self._world, allowed, greedy=self._deterministic)
        if self._before is None:
            self._begin(seen)
        if skill is not None:
            self._call(skill, goal, seen)
        elif goal is not None:
            raise DeclarationError(
                f"act(): goal is {str(goal)[:100]}, but no skill is named: act(obs, skill=..., "
                "goal=...)"
            )
        action = deployed.policy.act(self.memory, ROW, seen, turn)
        self._before = seen, action
        return deployed.acts.unpacked(action[0])

    def _begin(self, seen: Array) -> None:
        """Prepare the memory for an episode that starts in an observation (1, …)."""

    def _call(self, skill: str, goal: Any, seen: Array) -> None:
        """Let a skill's call go on, or start one, as the caller chooses it."""
        hierarchy = innermost(self._deployed.policy)
        if not isinstance(hierarchy, CallAndReturn):
            raise DeclarationError(
                f"act(): skill is {str(skill)[:100]!r}, but this policy has no skills to choose "
                "from: leave it out"
            )
        names = [one.name for one in hierarchy.skills]
        if skill not in names:
            raise DeclarationError(
                f"act(): skill is {str(skill)[:100]!r}; it must be one of "
                f"{', '.join(map(repr, names))}"
            )
        number = names.index(skill)
        goals = hierarchy.goals.get(number)
        if (goals is None) != (goal is None):
            has = "no goals: leave out goal" if goals is None else "goals: act(obs, skill=, goal=)"
            raise DeclarationError(f"act(): skill {skill!r} has {has}")
        given: dict[int, Array] = {}
        if goals is not None:
            try:
                one = np.array(goals.space.packed(goal))[None]
            except PolicyError as error:
                raise DeclarationError(
                    f"act(): goal does not fit {goals.space}: {error}"
                ) from error
            given[number] = goals.fitted(seen, one, "act()")
        running = self.memory["skill"][0] == number and self.memory["end"][0] == RUNNING
        if not running:
            longest = (number + 1) * hierarchy.each - 1
            hierarchy.begin(self.memory, ROW, np.array([longest]), given)
        elif goals is not None:
            self.memory["goal"][str(number)][ROW] = given[number]

    def _seen(self, obs: Any) -> Array:
        """Return one observation as a batch of one."""
        try:
            seen = np.array(self._deployed.sees.packed(obs))[None]  # the user may change it
        except PolicyError as error:
            space = str(self._deployed.sees)[:300]
            raise DeclarationError(
                f"act() was given an observation that does not fit {space}: {error}"
            ) from error
        for path, choices in self._choices.items():
            part = at(seen, path)
            low, high = choices.bounds
            if ((part < low) | (part > high)).any():
                raise DeclarationError(
                    f"act() was given an observation in which {_named(path)} is "
                    f"{str(part[0].tolist())[:100]}, which is not in {choices}"
                )
        # One look at all numbers takes a fraction of the time.
        if self._one_type is not None and not np.isnan(seen.view(self._one_type)).any():
            return seen
        for path in self._real:
            part = at(seen, path)
            if not np.isnan(part).any():
                continue
            where = _named(path)
            if self._nan == "error":
                raise DeclarationError(
                    f"act() was given an observation with NaN in {where}: find out what the sensor "
                    'gives there, or let a NaN count as 0, nan="zero"'
                )
            seen = seen.copy()
            at(seen, path)[...] = np.nan_to_num(part, posinf=np.inf, neginf=-np.inf)
        return seen

    def _allowed(self, mask: Any) -> Array:
        """Return a mask as a batch of one."""
        acts = self._deployed.acts
        try:
            allowed = acts.allowed(mask)
        except ValueError as error:
            raise DeclarationError(f"act(): {error}") from error
        if not allows_each(allowed, acts.counts):
            raise DeclarationError("act(): its action_mask allows no action")
        return allowed[None]

    def _step(self, seen: Array, reward: float, info: Mapping[str, Any]) -> Step:
        """Return the step that led to an observation."""
        assert self._before is not None
        obs, action = self._before
        no = np.zeros(1, bool)
        return Step(
            obs,
            action,
            seen,
            np.array([reward], np.float32),
            terminated=no,
            truncated=no,
            timed_out=no,
            elapsed=np.array([self._elapsed]),
            info=batched_infos([dict(info)]),
        )


def _named(path: tuple[str, ...]) -> str:
    """Return the part of an observation with these names, as a user writes it."""
    return "obs" + "".join(f"[{name!r}]" for name in path)
