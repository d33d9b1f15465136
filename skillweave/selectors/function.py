"""A function of observations as a selector."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Dict, Discrete

from skillweave.errors import SkillError
from skillweave.messages import short
from skillweave.policies.core import CallEnd, LastCall, observed
from skillweave.selectors.base import (
    ReadySelector,
    function_name,
    listed,
    skill_and_goal,
)
from skillweave.skills.foreign_policy import qualified
from skillweave.skills.goals import as_goals
from skillweave.skills.outputs import as_array, called, checked_actions, required_arguments
from skillweave.skills.probing import probe
from skillweave.types import Array, Memory, Step, read_only


class FunctionSelector(ReadySelector):
    """A function from observations (n, *obs_shape) to skills (n,): names, or places in the list.

    If it needs a second argument, that is the ``LastCall``. Where skills have goals, it returns
    skills and goals: ``(names, goals)``, the goals (n, *goal_shape), or a dict of such goals by
    skill where several have some. They count where the skill is chosen.

    Raises:
        SkillError: when it acts: the function failed, or chose an unknown skill, or a skill that
            may not start.
    """

    kind = "function"

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(f"function {function_name(function)}()")
        self.function = function
        self.takes_last_call = required_arguments(function) > 1

    def start(self, n: int) -> Memory:
        """Return the initial last call, for functions that use it; else an empty memory."""
        if not self.takes_last_call:
            return {}
        return {
            "skill": np.full(n, -1),
            "why": np.full(n, CallEnd.EPISODE, np.int8),
            "succeeded": np.zeros(n, bool),
        }

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return the function's choices, (n,), checked; with their goals where skills have some."""
        function = self.function
        if self.takes_last_call:
            last = LastCall(*(read_only(memory[k]) for k in ("skill", "why", "succeeded")))
            value = called(function, read_only(obs), self._who, more=(last,))
            arguments: Any = (obs, last)
        else:
            value = called(function, read_only(obs), self._who)
            arguments = obs
        goals, given = None, value
        if is_other := _is_other_form(value):
            value = None
        elif isinstance(value, tuple) and len(value) == 2 and _are_goals(value[1]):
            value, goals = value
        if (is_other or goals is not None) and not self.goal_spaces:
            raise SkillError(
                f"{self._who} returned skills and goals, but no skill that it selects has "
                "goals: set goal_space in the skill's class, or return the skills alone"
            )
        try:
            chosen = np.asarray(value)
        except ValueError:  # of parts of unequal lengths
            is_other = bool(self.goal_spaces)
        if is_other:
            raise SkillError(
                f"{self._who} returned {short(given)}: return (names, goals), one of each per "
                "environment"
            )
        chosen = as_array(value, self._who)
        if chosen.dtype.kind in "UO" and chosen.shape == (len(obs),):
            numbers = [self._number(name, self._who, SkillError) for name in chosen.tolist()]
            chosen = np.array(numbers, int)
        choices = Discrete(len(self.skills))
        chosen = checked_actions(chosen, len(obs), choices, self._who, SkillError)
        if goals is None:
            probe(function, arguments, len(obs), self._who)
        self._check_starts(chosen, obs, mask)
        if not self.goal_spaces:
            return chosen, memory
        return self.with_goals(chosen, self._goals(chosen, goals), obs), memory

    def _goals(self, chosen: Array, goals: Any) -> dict[str, tuple[Array, Array]]:
        """Return the goals of the chosen skills, with their rows, by skill."""
        names = list(self.goal_spaces)
        if goals is None:
            return {}
        # Of a Dict a dict has the parts of goals where none of its keys is a skill.
        space = self.goal_spaces[names[0]] if len(names) == 1 else None
        if isinstance(space, Dict) and isinstance(goals, Mapping):
            goals = goals if set(goals) & set(self.skills) else {names[0]: goals}
        if not isinstance(goals, Mapping):
            if len(names) > 1:
                raise SkillError(
                    f"{self._who} returned one array of goals, but {listed(tuple(names))} have "
                    "goals: return (names, {skill: goals})"
                )
            goals = {names[0]: goals}
        found = {}
        for name, values in goals.items():
            number = self._number(name, self._who, SkillError)
            rows = np.flatnonzero(chosen == number)
            space = self.goal_spaces.get(name)
            if space is not None:
                whose = f"skill {name!r}"
                values = as_goals(values, len(chosen), space, self._who, whose, rows=rows)
            found[name] = rows, values
        return found

    def _goal_advice(self, name: str) -> str:
        return "return (names, goals)"

    def watch(self, memory: Memory, step: Step, last: LastCall) -> Memory:
        """Store the end of the last call."""
        if not self.takes_last_call:
            return memory
        return {
            "skill": last.skill.copy(),
            "why": last.why.copy(),
            "succeeded": last.succeeded.copy(),
        }

    def source(self) -> dict[str, Any]:
        """Return the function's name."""
        return {"kind": self.kind, "name": qualified(self.function)}

    def _check_starts(self, chosen: Array, obs: Array, mask: Array | None) -> None:
        if mask is None:
            return
        wrong = np.flatnonzero(~mask[np.arange(len(obs)), chosen])
        if len(wrong):
            row = int(wrong[0])
            may = tuple(n for n, yes in zip(self.skills, mask[row], strict=True) if yes)
            raise SkillError(
                f"{self._who} chose skill {self.skills[int(chosen[row])]!r} in observation "
                f"{observed(obs[row])}, but its initiation() is False there; choose a skill that "
                f"may start there: {listed(may)}"
            )


def _are_goals(value: Any) -> bool:
    """Return whether the second of two values is goals: arrays, or a dict or tuple of them."""
    if isinstance(value, np.ndarray):
        return value.ndim > 0
    return isinstance(value, Mapping | list | tuple)


def _is_other_form(value: Any) -> bool:
    """Return whether skills and goals are paired otherwise than as ``(names, goals)``."""
    if isinstance(value, tuple) and len(value) == 2:
        first, second = value
        if second is None or (isinstance(first, str) and not isinstance(second, str)):
            return True
    return isinstance(value, list | tuple) and any(
        skill_and_goal(pair)[1] is not None for pair in value
    )
