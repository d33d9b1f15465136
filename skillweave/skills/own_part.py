"""A skill's own part: what its policy sees of the observation, and what it writes of the action.

A skill that declares ``sees`` or ``acts`` has an observation and an action space of its own.
``OwnPart`` checks what is declared; ``policies.parts.Part`` cuts observations to the part, and
completes actions by what the hierarchy's ``rest`` says. Skills judge whole observations and whole
actions.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from math import prod
from types import MethodType
from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Discrete

from skillweave._internal.messages import short, shortened, suggest
from skillweave._internal.policy_protocol import Policy
from skillweave.errors import DeclarationError, PolicyError
from skillweave.policies.core import Array
from skillweave.policies.mapped import Input
from skillweave.policies.parts import Correction, Slice
from skillweave.policies.spaces import Space as Data, space_of
from skillweave.schema import as_json
from skillweave.skills.file_part import file_input, file_output
from skillweave.skills.fit_mapping import fitted_inputs, places_in
from skillweave.skills.foreign_policy import source_of
from skillweave.skills.learnable import GoalColumns, Learnable, NetworkFile
from skillweave.skills.mapping import (
    Acts,
    PolicyMapping,
    checked_sees,
    is_places,
    to_json,
)
from skillweave.skills.outputs import required_arguments
from skillweave.skills.residual import Residual

HOLD, ZERO = "hold", "zero"
"""Words for ``Hierarchy.rest``: the value of the last action, and zero."""


# What is declared


def declared_sees(sees: Any, who: str) -> PolicyMapping:
    """Return a skill's ``sees`` as the mapping of its inputs.

    Raises:
        DeclarationError: it is no ``sees`` of a skill; ``who`` begins the message.
    """
    if isinstance(sees, MethodType) and required_arguments(sees.__func__) <= 1:
        sees = sees.__func__  # a function in a class's body becomes a method when it is looked up
    try:
        return PolicyMapping(sees=checked_sees(sees, of_skill=True))
    except DeclarationError as error:
        raise DeclarationError(f"{who}: {error}") from None


def declared_acts(acts: Any, who: str) -> Any:
    """Return a skill's ``acts``: names of parts of a Dict action, or places of another one.

    Raises:
        DeclarationError: it is neither; ``who`` begins the message.
    """
    names = (acts,) if isinstance(acts, str) else acts
    if isinstance(names, list | tuple) and names and all(isinstance(x, str) and x for x in names):
        if len(set(names)) != len(names):
            raise DeclarationError(f"{who}: acts names a part of the action twice: {short(acts)}")
        return tuple(names)
    if callable(acts) and not isinstance(acts, Acts):
        raise DeclarationError(
            f"{who}: acts is a function, but it names the part of the action that the skill "
            "writes, acts = (0, 1, 2): what computes actions is policy(self, obs)"
        )
    if is_places(acts) or isinstance(acts, list | tuple):
        try:
            acts = Acts(to=acts)
        except DeclarationError as error:
            raise DeclarationError(f"{who}: acts: {error}") from None
    if isinstance(acts, Acts) and acts.to is not None:
        if acts.rest is not None:
            raise DeclarationError(
                f"{who}: acts has rest, but the rest of the action is the hierarchy's: write "
                "Hierarchy(..., rest=...)"
            )
        if not acts.plain:
            raise DeclarationError(
                f"{who}: acts has a scale, an offset or a clip, which only the acts of a policy "
                "from elsewhere has: give the places alone, acts = (0, 1, 2)"
            )
        return acts.to
    raise DeclarationError(
        f"{who}: acts is {short(acts)}; it must be the places of its numbers in the action, "
        "acts = (0, 1, 2) or slice(0, 3), or the names of parts of a Dict action: acts = 'arm'"
    )


def part_to_json(skill: Any, rest: Any, who: str) -> dict[str, Any]:
    """Return the part of a skill as JSON for runs, see ``OwnPart``; {}: it has none."""
    content: dict[str, Any] = {}
    if (file := file_of(skill)) is not None:
        content["learns_on"] = file.to_json()
    if skill.sees is not None:
        content["sees"] = declared_sees(skill.sees, who).to_json()["sees"]
    if skill.acts is not None:
        content["acts"] = to_json(declared_acts(skill.acts, who))
        content["rest"] = to_json(rest)
    if isinstance(skill.policy, Residual):
        content["residual"] = skill.policy.scale
    return content


def file_of(skill: Any) -> NetworkFile | None:
    """Return the file from which a skill learns on, which has a mapping; None: it has none."""
    return skill.policy.file if isinstance(skill.policy, Learnable) else None


def part_from_json(sees: Any, acts: Any, learns_on: Any = None) -> dict[str, Any]:
    """Return the attributes of a skill as ``part_to_json`` wrote them; None: it has none.

    They are ``sees``, ``acts``, and a ``policy`` without weights where it learnt on from a file.

    Raises:
        DeclarationError: a value is wrong, or needs a function.
    """
    attributes: dict[str, Any] = {}
    if learns_on is not None:
        file = NetworkFile.from_json(learns_on)
        attributes["policy"] = Learnable(file.name, "PPO", {}, file=file)
    if sees is not None:
        inputs = PolicyMapping.from_json({"sees": sees}).sees or {}
        attributes["sees"] = inputs[""] if set(inputs) == {""} else inputs
    if acts is not None:
        attributes["acts"] = Acts(to=acts).to if isinstance(acts, str) else tuple(acts)
    return attributes


# The rest of the action


def checked_rest(rest: Any) -> None:
    """Raise a DeclarationError where ``Hierarchy.rest`` is none for any action space."""
    word = isinstance(rest, str)
    if rest is None or isinstance(rest, bool) or (word and rest not in (HOLD, ZERO)):
        raise DeclarationError(f"rest is {short(rest)}; {_REST}")
    for value in rest.values() if isinstance(rest, Mapping) else ():
        checked_rest(value)


_REST = (
    "it must be 'zero', 'hold', a number, or a list with a number or 'hold' for each number of the "
    "action; of a Dict action a dict of these"
)


Held = tuple[tuple[tuple[str, ...], Array], ...]
"""The names that lead to a leaf of an action, and which of its numbers keep their values."""


def rest_of(rest: Any, space: Space[Any]) -> tuple[Array, Held]:
    """Return the action (1, …) where the skill that acts writes nothing, and what it holds.

    Args:
        rest: "zero", "hold", a number, or a list with one or the other for each number; of a Dict
            action a dict of these by its keys, zero where one is left out.
        space: of actions.

    Raises:
        DeclarationError: it does not fit the space.
    """
    checked_rest(rest)
    data = space_of(space)
    fixed = data.start(1)
    return fixed, tuple(_filled(fixed[0, ...], rest, data, "rest"))


def _filled(
    zero: Array, rest: Any, space: Data, where: str, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Array]]:
    """Write a declared rest's numbers over the zeros (…) of an action, or of a part of it.

    Yields:
        The path of each leaf, and (…) bool, which of its numbers are held, where some are.
    """
    if space.parts is not None:
        if not isinstance(rest, str | Mapping):
            raise DeclarationError(
                f"{where} is {short(rest)}, but the action is {_shown(space)}: give a dict by its "
                "keys"
            )
        given = dict.fromkeys(space.parts, rest) if isinstance(rest, str) else rest
        for key in given:
            if key not in space.parts:
                hint = suggest(key, space.parts)
                raise DeclarationError(f"{where} has {key!r}, which the action does not have{hint}")
        for key, part in space.parts.items():
            inside = zero[key], given.get(key, ZERO), part, f"{where}[{key!r}]"
            yield from _filled(*inside, (*path, key))
        return
    entries = np.asarray(rest, object).reshape(-1)
    words = np.array([x if isinstance(x, str) else "" for x in entries])
    plain = ~np.isin(words, (HOLD, ZERO))
    numbers = entries[plain]
    right = all(isinstance(x, int | float | np.number) for x in numbers)
    if not right or entries.size not in (1, zero.size):
        raise DeclarationError(
            f"{where} is {short(rest)}, but the action has {zero.size} numbers ({_shown(space)}); "
            f"{_REST}"
        )
    written = np.broadcast_to(plain, zero.size).reshape(zero.shape)
    zero[written] = numbers.astype(np.float64)
    if zero.dtype.kind in "iu" and (zero[written] != numbers.astype(np.float64)).any():
        raise DeclarationError(f"{where} is {short(rest)}, but {_shown(space)} has whole numbers")
    if not space.holds(zero[None]).all():
        raise DeclarationError(f"{where} is {short(rest)}, which is out of {_shown(space)}")
    held = np.broadcast_to(words == HOLD, zero.size).reshape(zero.shape)
    if held.any():
        yield path, held


def _shown(space: Data) -> str:
    return shortened(str(space), 100)


# A part of an action


Paths = tuple[tuple[tuple[str, ...], tuple[str, ...]], ...]
"""A value of ``Slice.paths``."""


def _written(acts: Any, space: Space[Any], who: str) -> tuple[Data, tuple[int, ...] | None, Paths]:
    """Return the space that a skill's declared ``acts`` writes, and its places or paths."""
    named = isinstance(acts, tuple) and isinstance(acts[0], str)
    data = space_of(space)
    if data.parts is not None and not named:
        raise DeclarationError(
            f"{who}: acts is {short(acts)}, but the action has parts with names "
            f"({', '.join(map(repr, data.parts))}): name them, acts = ({next(iter(data.parts))!r},)"
        )
    if data.parts is not None:
        own, paths = _named(acts, data, who)
        return own, None, paths
    if named:
        raise DeclarationError(
            f"{who}: acts names {acts[0]!r}, a part of the action that does not exist: "
            f"{short(space)} has places, counted from 0"
        )
    one = data.kind == "Discrete"
    size = sum(data.counts) if one else prod(data.shape)
    places = places_in(acts, size, f"{who}: acts", space)
    if one:
        low = np.array(0)
        high = np.array(len(places) - 1)
        data = Data("Discrete", "int64", (), low, high)
    else:
        low, high = (np.broadcast_to(x, data.shape).reshape(-1)[places] for x in data.bounds)
        data = Data(data.kind, data.dtype, (len(places),), low, high)
    return data, tuple(places.tolist()), ()


def _named(names: tuple[str, ...], space: Data, who: str) -> tuple[Data, Paths]:
    """Return the parts of a Dict action that a skill's ``acts`` names, and their paths."""
    found: dict[tuple[str, ...], Data] = {}
    for name in names:
        path = tuple(name.split("."))
        part: Data | None = space
        for key in path:
            part = None if part is None else (part.parts or {}).get(key)
        if part is None:
            hint = suggest(name, [".".join(p) for p in space.leaves])
            raise DeclarationError(
                f"{who}: acts names {name!r}, a part of the action that does not exist{hint}"
            )
        found[path] = part
    if any(a != b and b[: len(a)] == a for a in found for b in found):
        raise DeclarationError(f"{who}: acts names a part of the action twice: {short(names)}")
    if len(found) == 1:
        path, own = next(iter(found.items()))
        return own, tuple(((*path, *x), x) for x in own.leaves)
    own = Data("Dict", parts={".".join(path): part for path, part in found.items()})
    inside = [((*p, *x), (".".join(p), *x)) for p, part in found.items() for x in part.leaves]
    return own, tuple(inside)


# Both


class OwnPart:
    """A declared skill's part of observations and actions, checked and fitted to spaces.

    Args:
        skill: sees all without ``sees``, and writes all without ``acts``.
        rest: its hierarchy's, for the other numbers of the action.
        observation_space: of the environment.
        action_space: of the environment.
        who: begins messages: "skill 'arm'".

    Raises:
        DeclarationError: they do not fit the spaces; the message names the field.
    """

    def __init__(
        self,
        skill: Any,
        rest: Any,
        observation_space: Space[Any],
        action_space: Space[Any],
        who: str,
    ) -> None:
        from skillweave.spaces.saving import gym_space  # needs torch, which declaring does not

        self.who = who
        self._skill = skill
        self._rest = rest
        sees, acts = skill.sees, skill.acts
        self.whole_observation_space = observation_space
        self.whole_action_space = self.written_space = action_space
        self.observation_space = observation_space
        """The space of the skill's own observations, without a goal."""
        self.base: Policy | None = None
        """The ready policy to whose actions its own are added; None: there is none."""
        self.correction: Correction | None = None
        """The correction that adds the skill's actions to those of the base policy."""
        self.goal_columns: GoalColumns | None = None
        """The goal in the input of the file from which the skill learns on; None: it has none."""
        how: dict[str, Any] = {}
        file = file_of(skill)
        if file is not None and (sees is not None or acts is not None):
            given = " and ".join(k for k in ("sees", "acts") if getattr(skill, k) is not None)
            raise DeclarationError(
                f"{who} has {given}, but its policy {file.name} learns on with the sees and acts "
                f"of from_onnx(): leave out {given} of the skill"
            )
        try:
            if file is not None:
                how = self._fit_file(file)
            if sees is not None:
                how = self._fit_sees(sees)
            if acts is not None:
                written, how["places"], how["paths"] = _written(
                    declared_acts(acts, who), action_space, who
                )
                self.written_space = gym_space(written)
        except PolicyError as error:
            raise DeclarationError(str(error)) from None
        if acts is not None and not isinstance(action_space, Discrete):
            how["fixed"], how["held"] = rest_of(rest, action_space)
        elif acts is not None and not (isinstance(rest, str) and rest == ZERO):
            raise DeclarationError(
                f"rest is {short(rest)}, but an action is one choice ({short(action_space)}), "
                "of which nothing is left: leave out rest"
            )
        self.action_space: Space[Any] = self.written_space
        """The space of the skill's own actions."""
        spaces = space_of(action_space), space_of(self.written_space)
        self.part = Slice(*spaces, axes=len(observation_space.shape or ()), who=who, **how)
        """The part that acts."""

    def to_json(self) -> dict[str, Any]:
        """Return the declaration of the part as JSON."""
        content = part_to_json(self._skill, self._rest, self.who)
        return content if self.base is None else content | {"policy": as_json(source_of(self.base))}

    def _fit_file(self, file: NetworkFile) -> dict[str, Any]:
        """Return the fields of ``Slice`` where the skill learns on from a file."""
        from skillweave.spaces import same_space  # needs torch, which declaring does not

        declared = self._skill.policy
        whole = self.whole_observation_space, self.whole_action_space
        for kind, mine, theirs in zip(
            ("observation_space", "action_space"),
            (declared.observation_space, declared.action_space),
            whole,
            strict=True,
        ):
            if mine is not None and not same_space(mine, theirs):
                raise PolicyError(
                    f"{self.who}: {file.name} has {kind} {mine}, but the environment has {theirs}"
                )
        found = file_input(file, whole[0], self._skill.goal_space, self.who)
        self.goal_columns = found.goal
        size = prod(found.own.shape)
        self.observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        outputs, self.written_space = file_output(file, whole[1], self.who)
        sees = space_of(self.observation_space)
        return {"inputs": {"": found.own}, "sees": sees, "outputs": outputs}

    def _fit_sees(self, sees: Any) -> dict[str, Any]:
        """Return the fields ``inputs`` and ``sees`` of ``Slice``: the skill's own observations."""
        mapping = declared_sees(sees, self.who)
        inputs = fitted_inputs(mapping, self.whole_observation_space, self.who, {})
        spaces = {name: self._input_space(given) for name, given in inputs.items()}
        self.observation_space = spaces[""] if set(spaces) == {""} else Dict(list(spaces.items()))
        return {"inputs": inputs, "sees": space_of(self.observation_space)}

    def _input_space(self, given: Input) -> Space[Any]:
        """Return the space of one input."""
        from skillweave.spaces.observations import image_layout
        from skillweave.spaces.packing import leaf_spaces

        leaves = leaf_spaces(self.whole_observation_space)
        take = given.takes[0]
        read = [leaves[x.fields] for x in given.takes if x.source == "observation"]
        if len(given.takes) > 1 and any(image_layout(leaf) is not None for leaf in read):
            raise DeclarationError(
                f"{self.who}: sees joins an image with other parts of the observation: give each "
                "an input of its own, sees = {'image': 'camera', 'rest': ('joints', ...)}"
            )
        changed = take.places is not None or take.choices or given.scalings
        if len(given.takes) == len(read) == 1 and not changed and isinstance(read[0], Box):
            return read[0]
        return Box(-np.inf, np.inf, given.shape or (1,), np.float32)

    def correct(self, base: Policy, added: Correction) -> None:
        """Let its actions correct those of a ready policy, which is fitted to its spaces."""
        self.base = base
        self.correction = added
        self.action_space = Box(-1.0, 1.0, self.written_space.shape, np.float32)

    def within(self, view: Callable[[Array], Array], observation_space: Space[Any]) -> OwnPart:
        """Return the part of larger observations, of which ``view`` returns the environment's."""
        part = copy.copy(self)
        part.whole_observation_space = observation_space
        part.part = replace(self.part, view=view)
        return part
