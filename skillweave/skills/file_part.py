"""The own part of a skill that learns on from a file: the file's input, and the file's output."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box

from skillweave._internal.messages import short
from skillweave.errors import PolicyError
from skillweave.policies.core import Array
from skillweave.policies.mapped import Affine, Input, Outputs, clipped
from skillweave.policies.spaces import space_of
from skillweave.skills.fit_mapping import fitted_inputs, fitted_outputs, for_model
from skillweave.skills.foreign_policy import SEES
from skillweave.skills.learnable import GoalColumns, NetworkFile
from skillweave.skills.mapping import Acts, Computed, Goal, Part, PolicyMapping


class BoundedGoal:
    """A user's function of observations whose goals stay in the range of their ``Goal``.

    Args:
        function: returns goals (n, G).
        low: the lowest goal; None: any.
        high: the highest goal.
    """

    def __init__(self, function: Callable[[Any], Any], low: Any, high: Any) -> None:
        self.function = function
        self.low = low
        self.high = high
        self.__name__ = getattr(function, "__name__", type(function).__name__)
        self.__qualname__ = getattr(function, "__qualname__", self.__name__)
        self.__module__ = getattr(function, "__module__", type(function).__module__)

    def __call__(self, obs: Any) -> Array:
        """Return goals (n, G)."""
        return clipped(np.asarray(self.function(obs)), self.low, self.high)


@dataclass(frozen=True, eq=False)
class FileInput:
    """The input of a file's network, as a skill observes it."""

    own: Input
    """What it observes, without a goal."""
    goal: GoalColumns | None
    """The place of the goal; None: it is an observation, or there is none."""


def file_input(
    file: NetworkFile, space: Space[Any], goal_space: Space[Any] | None, who: str
) -> FileInput:
    """Return the input of a file that learns on, for observations of a space.

    Args:
        file: with its mapping.
        space: of the environment's observations.
        goal_space: of the skill; None: it has no goals.
        who: begins messages.

    Raises:
        PolicyError: the mapping does not fit; the message names the field.
    """
    who = f"{who}: {file.name}"
    mapping = _whole(file, space, who)
    places = mapping.goal_places
    if goal_space is not None and not places:
        raise PolicyError(
            f"{who} takes no goal, but its skill has goals: write Goal() at its place in sees"
        )
    if len(places) > 1:
        raise PolicyError(
            f"{who}: sees has Goal() {len(places)} times, and a policy that learns on takes it once"
        )
    if callable(mapping.goal) and goal_space is None:
        mapping = _computed(mapping)
        places = []
    given: dict[str, tuple[int, ...]] = {}
    if goal_space is not None:
        given["goal"] = (space_of(goal_space).size,)
    elif mapping.goal is not None:
        given["goal"] = np.asarray(mapping.goal).shape
    plain = fitted_inputs(replace(mapping, scaling={}), space, who, given)
    for_model(plain, {file.input: file.shape}, who)  # before the normalisation in the file
    (whole,) = fitted_inputs(mapping, space, who, given).values()
    if not places:
        return FileInput(whole, None)
    return _without_goal(whole, places[0], mapping, goal_space, who)


def _whole(file: NetworkFile, space: Space[Any], who: str) -> PolicyMapping:
    """Return a mapping with inputs by the name of the file's, all of them written out."""
    mapping = file.mapping
    sees = mapping.sees
    if sees is None:
        if not isinstance(space, Box):
            raise PolicyError(f"{who} takes one array, but observations are of {space}: {SEES}")
        sees = {"": (Part(),)}
    if set(sees) not in ({""}, {file.input}):
        raise PolicyError(
            f"{who}: sees has the inputs {', '.join(map(repr, sees))}, but its output "
            f"{file.output!r} depends on {file.input!r} alone: give that one, sees=(...)"
        )
    (parts,) = sees.values()
    scaling = {file.input: mapping.scaling[""]} if mapping.scaling else {}
    return replace(mapping, sees={file.input: parts}, scaling=scaling)


def _computed(mapping: PolicyMapping) -> PolicyMapping:
    """Return a mapping in which the function that gives the goal is a part of the observation."""
    function: Any = mapping.goal

    def part(source: Any) -> Any:
        if not isinstance(source, Goal):
            return source
        bounded = source.low is not None or source.high is not None
        goals = BoundedGoal(function, source.low, source.high) if bounded else function
        return Computed(function=goals, scale=source.scale, offset=source.offset, clip=source.clip)

    sees = {name: tuple(map(part, parts)) for name, parts in (mapping.sees or {}).items()}
    return replace(mapping, sees=sees, goal=None)


def _without_goal(
    whole: Input, place: Goal, mapping: PolicyMapping, goal_space: Space[Any] | None, who: str
) -> FileInput:
    """Return an input without its goal, and the goal's columns."""
    mask = np.concatenate([np.full(x.size, x.source == "goal") for x in whole.takes])
    own, goal = np.flatnonzero(~mask), np.flatnonzero(mask)
    if not len(own):
        raise PolicyError(f"{who}: sees has nothing but Goal(): name a part of the observation")
    rest = tuple(x for x in whole.takes if x.source != "goal")
    scalings = tuple(_columns(x, own) for x in whole.scalings)
    seen = Input(rest, (len(own),), scalings)
    of_goal = [_columns(x, goal) for x in whole.scalings]
    size = np.ones(len(goal))
    if goal_space is None:
        value = clipped(np.asarray(mapping.goal, np.float64)[None], place.low, place.high)
        for one in of_goal:
            value = one(value)
        return FileInput(seen, GoalColumns(goal, size, 0.0 * size, value[0]))
    if place.clip is not None:
        raise PolicyError(
            f"{who}: Goal has a clip, but the goals of calls are scaled in the first layer: leave "
            "out clip, and give goal_space the range of the goals"
        )
    if isinstance(goal_space, Box):
        low = -np.inf if place.low is None else np.array(place.low)
        high = np.inf if place.high is None else np.array(place.high)
        if (goal_space.low.ravel() < low - 1e-6).any() or (
            goal_space.high.ravel() > high + 1e-6
        ).any():
            raise PolicyError(
                f"{who}: goal_space is {short(goal_space, 200)}, but Goal.low is "
                f"{short(place.low)} and Goal.high {short(place.high)}, the range for which the "
                "policy was made: give goal_space that range"
            )
    scale, shift = size, 0.0 * size
    for one in of_goal:
        offset = 0.0 if one.offset is None else one.offset
        factor = 1.0 if one.scale is None else one.scale
        scale, shift = scale * factor, (shift - offset) * factor
    return FileInput(seen, GoalColumns(goal, scale, shift))


def _columns(scaling: Affine, places: Array) -> Affine:
    """Return a scaling of some columns alone."""

    def some(x: Array | None) -> Array | None:
        return x if x is None or x.size == 1 else x[places]

    return Affine(*map(some, (scaling.offset, scaling.scale, scaling.low, scaling.high)))


def file_output(
    file: NetworkFile, space: Space[Any], who: str
) -> tuple[Outputs | None, Space[Any]]:
    """Return the meaning of a file's output, and its space, in which the skill acts.

    The skill's actions are the outputs of the network, without bounds, or in [−1, 1] after a
    ``Tanh``; clip, scale and offset, and the bounds of the action space, follow where they are
    written. Of choices the outputs are logits.

    Args:
        file: with its mapping.
        space: of the environment's actions.
        who: begins messages.

    Raises:
        PolicyError: ``acts`` does not fit the space.
    """
    who = f"{who}: {file.name}"
    if not isinstance(space, Box):
        fitted_outputs(file.mapping.acts, space, who, logits=True)  # raises where acts is given
        if file.squashes:
            raise PolicyError(f"{who} ends in Tanh, which logits for {space} cannot")
        return None, space
    outputs = fitted_outputs(file.mapping.acts or Acts(), space, who, logits=True)
    most = np.float32(1.0 if file.squashes else np.inf)
    return outputs, Box(-most, most, (outputs.count,), np.float32)
