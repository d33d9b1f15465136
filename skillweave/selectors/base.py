"""The base of ready selectors, which choose skills without training."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Dict

from skillweave.errors import DeclarationError, SkillError, SkillweaveError
from skillweave.messages import short, shortened
from skillweave.policies.core import LastCall, observed
from skillweave.policies.parts import GOAL
from skillweave.skills.foreign_policy import Foreign
from skillweave.skills.goal_spaces import blank_choices, number_of, repeated
from skillweave.skills.goals import as_goals
from skillweave.skills.outputs import called
from skillweave.terminal import one_line
from skillweave.types import Array, Memory, Step, read_only


class ReadySelector(Foreign):
    """A selector that is not trained: a policy over skills that also observes the ends of calls.

    It is called only where a call is over. It respects the skills' initiation sets, which are its
    mask. Its whole state is its memory, with a row for each environment.
    """

    lengths: tuple[int, ...] = ()
    """The lengths of calls that it chooses with skills; empty: it chooses skills alone."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.skills: tuple[str, ...] = ()

    @property
    def ranges(self) -> dict[str, range]:
        """Return the valid range of each index in its memory, by name."""
        return {}

    def among(self, skills: tuple[str, ...]) -> Self:
        """Return a copy that chooses among the skills of these names, in the hierarchy's order.

        Raises:
            DeclarationError: it names another skill.
        """
        selector = copy.copy(self)
        selector.skills = skills
        return selector

    @property
    def gives_goals(self) -> bool:
        """Return whether it is declared with goals for skills."""
        return False

    @property
    def goal_spaces(self) -> dict[str, Space[Any]]:
        """Return the spaces of goals of the skills that have some, by name, once it is bound."""
        space = self.action_space
        goals = space[GOAL] if isinstance(space, Dict) else None
        return dict(goals.spaces) if isinstance(goals, Dict) else {}

    def with_goals(self, skill: Array, goals: Mapping[str, tuple[Array, Any]], obs: Array) -> Array:
        """Return choices of skills (n,) with their goals, as a ``Hierarchy`` takes them.

        Args:
            skill: (n,) the chosen skills.
            goals: by skill, rows (k,) and their goals (k, *goal_shape).
            obs: (n, …), for messages.

        Raises:
            SkillError: a skill with goals was chosen without one, or one without goals with one.
        """
        spaces = self.goal_spaces
        lacks = np.ones(len(skill), bool)
        choices = blank_choices(self.action_space, skill) if spaces else skill
        for name, (rows, values) in goals.items():
            if name not in spaces:
                number = self._number(name, self._who, SkillError)
                raise SkillError(
                    f"{self._who} gave a goal for skill {self.skills[number]!r}, which has no "
                    "goals: set its goal_space, or leave out the goal"
                )
            whose = f"skill {name!r}"
            choices[GOAL][name][rows] = as_goals(values, len(rows), spaces[name], self._who, whose)
            lacks[rows] = False
        for name in spaces:
            wrong = np.flatnonzero(lacks & (skill == self.skills.index(name)))
            if len(wrong):
                raise SkillError(
                    f"{self._who} chose skill {name!r} without a goal in observation "
                    f"{observed(obs[wrong[0]])}, but it has goals of {short(spaces[name])}: "
                    f"{self._goal_advice(name)}"
                )
        return choices

    def _joined_goals(self, name: str, parts: Sequence[tuple[Array, Any]]) -> tuple[Array, Any]:
        """Return the goals of several rows of skill ``name`` as one array with its rows."""
        space = self.goal_spaces.get(name)
        if space is None or len(parts) == 1:
            return parts[0]
        whose = f"skill {name!r}"
        arrays = [as_goals(goals, len(rows), space, self._who, whose) for rows, goals in parts]
        return np.concatenate([rows for rows, _ in parts]), np.concatenate(arrays)

    def _goal_advice(self, name: str) -> str:
        """Return how a goal is given to skill ``name``, for messages."""
        return f"write ({name!r}, goal) in place of {name!r}"

    def chances(self, memory: Memory, obs: Array, mask: Array | None) -> tuple[Array, Memory]:
        """Return the probability of each choice where a call is over, (n, choices) float32.

        Returns:
            The probabilities, and the memory after the choice.
        """
        choice, after = self.act(memory, obs, mask)
        choices = len(self.skills) * max(1, len(self.lengths))
        return np.eye(choices, dtype=np.float32)[number_of(choice)], after

    def allowed(self, memory: Memory) -> Array | None:
        """Return the skills that it may choose next, (n, S) bool; None: depends on observations."""
        return None

    def watch(self, memory: Memory, step: Step, last: LastCall) -> Memory:
        """Return the memory after a step of n environments; called after every step.

        Args:
            step: the environments' transition; ``elapsed`` counts as for any policy.
            last: the last calls; ``why`` is 0 (``CallEnd.RUNNING``) where the call continues.
        """
        return memory

    def _number(
        self, skill: Any, where: str, kind: type[SkillweaveError] = DeclarationError
    ) -> int:
        """Return the place of a skill in the hierarchy's list.

        Raises:
            DeclarationError: no skill has this name; the message begins with ``where``. ``kind`` is
                the type of the error.
        """
        if not isinstance(skill, str) or skill not in self.skills:
            raise kind(
                f"{where} names {short(skill)}, which is no skill of the hierarchy; its skills "
                f"are: {listed(self.skills)}"
            )
        return self.skills.index(skill)


def skill_and_goal(value: Any) -> tuple[Any, Any]:
    """Return the name and the goal of ``(name, goal)``; of anything else itself, and None."""
    if isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], str):
        name, goal = value
        if goal is not None and not isinstance(goal, str):
            return name, goal
    return value, None


def goals_at(goal: Any, space: Space[Any] | None, obs: Array, who: str) -> Any:
    """Return the goals of ``(name, goal)`` in observations (k, …): fixed, or by a function.

    ``space`` is that of the skill's goals; None: it has none, which is said later.
    """
    if callable(goal):
        return called(goal, read_only(obs), who)
    return goal if space is None else repeated(space, goal, len(obs))


def goal_as_json(goal: Any) -> Any:
    """Return a goal of ``(name, goal)`` for checksums; of a function its name."""
    if callable(goal):
        return {"function": function_name(goal)}
    return repr(goal.tolist() if isinstance(goal, np.ndarray) else goal)


def listed(names: tuple[str, ...]) -> str:
    """Join names to a part of a sentence."""
    return shortened(one_line(", ".join(names)), 300)


def function_name(function: Any) -> str:
    """Return a user function's name for messages and checksums."""
    return str(getattr(function, "__name__", type(function).__name__))
