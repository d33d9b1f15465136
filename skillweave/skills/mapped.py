"""Policies behind a mapping, fitted to spaces; ``policies.mapped`` acts.

``MappedPolicy`` is the base of the kinds of policies from elsewhere, which only make their models.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Self

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Tuple

from skillweave._internal.messages import short
from skillweave._internal.notices import notice
from skillweave.errors import DeclarationError, PolicyError, RunError
from skillweave.policies.core import Policy as InPlace
from skillweave.policies.functional import Functional
from skillweave.policies.mapped import Input, Mapped, Model, numbers_of
from skillweave.policies.spaces import Space as Data
from skillweave.skills.foreign_policy import SEES, Foreign, made_up
from skillweave.skills.goal_spaces import with_goal, without_goal
from skillweave.skills.goals import Goals
from skillweave.skills.mapping import LastAction, PolicyMapping
from skillweave.skills.outputs import Wrapped, of_numbers
from skillweave.skills.plan import described, fitted_inputs, fitted_outputs, for_model
from skillweave.types import Array, Memoryless


class MappedPolicy(Functional, Foreign, Model):
    """A policy from elsewhere behind a mapping; a subclass makes its model."""

    logits = True
    """Outputs that are no whole numbers are logits of choices."""
    acting = Memoryless.acting

    def __init__(
        self,
        name: str,
        observation_space: Any = None,
        action_space: Any = None,
        mapping: PolicyMapping | None = None,
    ) -> None:
        Foreign.__init__(self, name, observation_space, action_space)
        self.mapping = mapping or PolicyMapping()
        self._goals: Goals | None = None

    def __copy__(self) -> Self:
        twin = object.__new__(type(self))  # with the same model, which is not loaded again
        twin.__dict__ |= {k: v for k, v in vars(self).items() if k not in ("in_place", "_like")}
        return twin

    @property
    def model(self) -> Model:
        """Its model, for the spaces that it has."""
        return self

    @cached_property
    def in_place(self) -> InPlace:  # type: ignore[override]
        """The policy that acts, with the mapping fitted to the spaces.

        Raises:
            PolicyError: these are not known, or it does not fit; the message names the field.
        """
        self.must_be_bound()
        who, mapping, model, seen = self._who, self.mapping, self.model, self.observation_space
        goal_space: Data | None = None
        goal: Array | Wrapped | None = None
        if self._goals is not None:
            seen, goal_space = without_goal(seen), self._goals.space
        elif callable(mapping.goal):
            goal = of_numbers(mapping.goal, f"{who}: goal()")
        elif mapping.goal is not None:
            goal = np.array(mapping.goal)
        outputs = fitted_outputs(mapping.acts, self.action_space, who, self.logits)
        inputs: dict[str, Input] | None = None
        if mapping.sees is not None:
            last = any(isinstance(source, LastAction) for source in mapping.sources())
            if last and outputs.space.kind != "Box":
                raise PolicyError(
                    f"{who}: sees has LastAction(), which needs actions of a Box, not "
                    f"{self.action_space}"
                )
            own = {"last_action": (outputs.count,)}
            if goal_space is not None:
                own["goal"] = (goal_space.size,)
            elif isinstance(goal, Wrapped):
                own["goal"] = numbers_of(goal, made_up(seen, 2), f"{who}: goal()").shape[1:]
                if len(own["goal"]) != 1:
                    raise PolicyError(f"{who}: goal() must return (n, numbers)")
            elif goal is not None:
                own["goal"] = goal.shape
            inputs = for_model(fitted_inputs(mapping, seen, who, own), model.expected, who)
        every, chunk = mapping.every, mapping.chunk
        return Mapped(model, outputs, inputs, every, chunk, goal, goal_space, who)

    def must_be_bound(self) -> None:
        """Raise a PolicyError if it has not the spaces that it needs yet."""
        unseen = self.mapping.sees is not None and self.observation_space is None
        if unseen or self.action_space is None:
            raise PolicyError(f"{self._who} has no spaces yet: bind() it to an environment's")

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy for these spaces, with its mapping fitted to them.

        Raises:
            PolicyError: the mapping does not fit; the message names the field.
        """
        bound = super().bind(observation_space, action_space, who)
        _ = bound.in_place
        return bound

    @property
    def takes_goal(self) -> bool:
        """Return whether the goal of a skill is an input of it."""
        return bool(self.mapping.goal_places)

    def bind_with_goals(
        self, observation_space: Space[Any], action_space: Space[Any], who: str, goals: Goals
    ) -> Self:
        """Return a copy as of ``bind``, as the policy of a skill that has goals.

        It observes ``with_goal``.

        Raises:
            PolicyError: the goal is no input of it, or its mapping does not fit.
        """
        if not self.takes_goal:
            raise PolicyError(
                f"{who}: {self.name} takes no goal, but its skill has goals: {self.advice}"
            )
        check_range(goals, self.mapping.goal_places, f"{who}: {self.name}")
        aimed, seen = (
            copy.copy(self),
            observation_space if self._open[0] else self.observation_space,
        )
        aimed._goals, aimed.joins = goals, True
        aimed.observation_space = with_goal(seen, goals.goal_space)
        return aimed.bind(aimed.observation_space, action_space, who)

    @property
    def given(self) -> str:
        """Return the inputs that ``sees`` gives, or the observations, for messages."""
        inputs = getattr(self.in_place, "inputs", None)
        if inputs is None:
            return super().given
        named = (f"{k}: {described(x)}" if k else described(x) for k, x in inputs.items())
        return f"the inputs that sees gives, {'; '.join(named)}"

    def _advice_on(self, error: BaseException) -> str:
        """Return advice where an argument is missing, or whole observations are given."""
        if not self.mapping.state and "required positional argument" in str(error):
            return "; one with a recurrent state needs state=, the shape of this state"
        whole = self.mapping.sees is None and isinstance(self.observation_space, Dict | Tuple)
        return f"; {SEES}" if whole else ""

    advice = "write Goal() at its place in sees"
    """How the policy is given the goal, for messages."""

    def source(self) -> dict[str, Any]:
        """Return its source as JSON, with its mapping."""
        mapping = self.mapping.to_json()
        return super().source() | ({"mapping": mapping} if mapping else {})

    def remapped(self, data: dict[str, Any] | None, where: str) -> Self:
        """Return a copy with the recorded mapping ``data``.

        Raises:
            RunError: it cannot be read, or needs a function that this policy does not have.
        """
        policy = copy.copy(self)
        try:
            policy.mapping = PolicyMapping.from_json(data or {}, self.mapping.functions())
        except DeclarationError as error:
            raise RunError(
                f"{where}: its policy had another mapping, which cannot be restored: {error}"
            ) from error
        if "in_place" in vars(self):
            _ = policy.in_place
        return policy


def check_range(goals: Goals, places: Sequence[Any], who: str) -> None:
    """Give a notice where a skill has goals beyond the range of a policy's ``Goal``.

    Args:
        places: of the goal among the policy's inputs.
        who: begins the message.
    """
    if not isinstance(goals.goal_space, Box):
        return
    lowest, highest = goals.goal_space.low.reshape(-1), goals.goal_space.high.reshape(-1)
    for place in places:
        low = -np.inf if place.low is None else np.array(place.low)
        high = np.inf if place.high is None else np.array(place.high)
        fits = {np.size(low), np.size(high)} <= {1, len(lowest)}  # else refused later
        if fits and ((lowest < low - 1e-6).any() or (highest > high + 1e-6).any()):
            notice(
                f"{who}: goal_space is {short(goals.goal_space, 200)}, but Goal.low is "
                f"{short(place.low)} and Goal.high {short(place.high)}, the range for which the "
                "policy was made. It gets other goals clipped, and step.goal has them as they are: "
                "give goal_space that range"
            )
