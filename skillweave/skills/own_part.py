"""A skill's own part: what its policy sees of the observation, and what it writes of the action.

A skill that declares ``sees`` or ``acts`` has an observation and an action space of its own. Who
acts cuts observations to the part (``OwnPart.see``), and completes actions by what the hierarchy's
``rest`` says (``OwnPart.write``). Skills judge whole observations and whole actions.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MethodType
from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple

from skillweave.arguments import meant
from skillweave.errors import DeclarationError, PolicyError, SkillError
from skillweave.messages import short
from skillweave.policies.core import Around, Turn, observed
from skillweave.policies.core import Policy as InPlace
from skillweave.skills.foreign_policy import source_of
from skillweave.skills.goal_spaces import example_of, leaf_paths, outside, part_at, parts_of
from skillweave.skills.mapping import (
    Acts,
    PolicyMapping,
    checked_sees,
    is_places,
    places_to_json,
)
from skillweave.skills.outputs import required_arguments
from skillweave.skills.plan import Input, Plan, places_in
from skillweave.skills.residual import Correction
from skillweave.types import Array, Policy, Step

HOLD, ZERO = "hold", "zero"
"""Words for ``Hierarchy.rest``: the value of the last action, and zero."""


# What is declared


def declared_sees(sees: Any, who: str) -> PolicyMapping:
    """Return a skill's ``sees`` as the mapping of its inputs.

    Raises:
        DeclarationError: it is no ``sees`` of a skill; ``who`` begins the message.
    """
    if isinstance(sees, MethodType) and required_arguments(sees.__func__) == 1:
        sees = sees.__func__  # a function in a class's body becomes a method when it is looked up
    try:
        return PolicyMapping(sees=checked_sees(sees, of_skill=True))
    except DeclarationError as error:
        raise DeclarationError(f"{who}: {error}") from None


def computed(sees: Any, who: str) -> bool:
    """Return whether functions of the user are in a skill's ``sees``."""
    return bool(declared_sees(sees, who).functions())


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


def part_to_json(sees: Any, acts: Any, who: str) -> dict[str, Any]:
    """Return the ``sees`` and ``acts`` of a skill as JSON for runs; {}: it has none."""
    content: dict[str, Any] = {}
    if sees is not None:
        content["sees"] = declared_sees(sees, who).to_json()["sees"]
    if acts is not None:
        written = declared_acts(acts, who)
        named = isinstance(written, tuple) and isinstance(written[0], str)
        content["acts"] = list(written) if named else places_to_json(written)
    return content


def part_from_json(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes ``sees`` and ``acts`` that ``part_to_json`` wrote, where it has some.

    Raises:
        DeclarationError: a value is wrong, or needs a function.
    """
    found: dict[str, Any] = {}
    if "sees" in content:
        inputs = PolicyMapping.from_json({"sees": content["sees"]}).sees or {}
        found["sees"] = inputs[""] if set(inputs) == {""} else inputs
    if "acts" in content:
        acts = content["acts"]
        found["acts"] = Acts(to=acts).to if isinstance(acts, str) else tuple(acts)
    return found


# The rest of the action


def checked_rest(rest: Any) -> None:
    """Raise a DeclarationError where ``Hierarchy.rest`` is none for any action space."""
    if isinstance(rest, str) and rest not in (HOLD, ZERO):
        raise DeclarationError(f"rest is {short(rest)}; {_REST}")
    values = rest.values() if isinstance(rest, Mapping) else ()
    for value in values:
        checked_rest(value)
    if rest is None or isinstance(rest, bool):
        raise DeclarationError(f"rest is {short(rest)}; {_REST}")


def rest_to_json(rest: Any) -> Any:
    """Return ``Hierarchy.rest`` as JSON."""
    if isinstance(rest, Mapping):
        return {key: rest_to_json(value) for key, value in rest.items()}
    if isinstance(rest, Sequence) and not isinstance(rest, str):
        return [rest_to_json(value) for value in rest]
    return rest.tolist() if isinstance(rest, np.ndarray | np.generic) else rest


_REST = (
    "it must be 'zero', 'hold', a number, or a list with a number or 'hold' for each number of the "
    "action; of a Dict action a dict of these"
)


@dataclass(frozen=True, eq=False)
class _Leaf:
    """The rest of one leaf of the action."""

    path: tuple[str, ...]
    fixed: Array  # (*shape), in the leaf's type
    held: Array  # (*shape) bool, numbers that keep the value of the last action


class Rest:
    """The value of an action where the skill that acts writes nothing.

    Args:
        rest: "zero", "hold", a number, or a list with one or the other for each number; of a Dict
            action a dict of these by its keys, zero where one is left out.
        space: of actions.

    Raises:
        DeclarationError: it does not fit the space.
    """

    def __init__(self, rest: Any, space: Space[Any]) -> None:
        from skillweave.spaces.packing import obs_dtype, obs_shape  # needs torch

        checked_rest(rest)
        self.space = space
        self._leaves = _leaves(rest, space, "rest", ())
        self.holds = any(bool(leaf.held.any()) for leaf in self._leaves)
        """The last action counts."""
        self._one = np.zeros((1, *obs_shape(space)), obs_dtype(space))
        for leaf in self._leaves:
            part_at(self._one, leaf.path)[...] = leaf.fixed
        self._first = np.array(example_of(space), self._one.dtype)[None]

    @property
    def held(self) -> Array:
        """The numbers that keep the value of the last action, (*shape) bool; not of a Dict."""
        return self._leaves[0].held

    def start(self, n: int) -> Array:
        """Return what stands for the last actions where n episodes start: zeros, (n, …)."""
        return self._first.repeat(n, axis=0)

    def filled(self, n: int, last: Array | None) -> Array:
        """Return n new actions that hold the rest everywhere.

        Args:
            last: (n, …), the last actions; None: nothing is held.
        """
        action = self._one.repeat(n, axis=0)
        if self.holds and last is not None:
            for leaf in self._leaves:
                if leaf.held.any():
                    held = part_at(last, leaf.path)
                    part_at(action, leaf.path)[...] = np.where(leaf.held, held, leaf.fixed)
        return action


def _leaves(rest: Any, space: Space[Any], where: str, path: tuple[str, ...]) -> list[_Leaf]:
    inner = parts_of(space)
    if inner is None:
        return [_leaf(rest, space, where, path)]
    if isinstance(rest, Mapping):
        for key in rest:
            if key not in inner:
                hint = meant(str(key), list(inner), "it has")
                raise DeclarationError(f"{where} has {key!r}, which the action does not have{hint}")
        by_name = {name: rest.get(name, ZERO) for name in inner}
    elif isinstance(rest, str):
        by_name = dict.fromkeys(inner, rest)
    else:
        raise DeclarationError(
            f"{where} is {short(rest)}, but the action is {short(space)}: give a dict by its keys"
        )
    return [
        leaf
        for name, part in inner.items()
        for leaf in _leaves(by_name[name], part, f"{where}[{name!r}]", (*path, name))
    ]


def _leaf(rest: Any, space: Space[Any], where: str, path: tuple[str, ...]) -> _Leaf:
    zero, shape = example_of(space), tuple(space.shape or ())
    if isinstance(rest, str):
        return _Leaf(path, zero, np.full(shape, rest == HOLD))
    wrong = DeclarationError(
        f"{where} is {short(rest)}, but the action has {zero.size} numbers ({short(space)}); "
        f"{_REST}"
    )
    entries = np.empty(1, object)
    if isinstance(rest, Sequence | np.ndarray) and np.ndim(np.asarray(rest, object)) > 0:
        entries = np.asarray(rest, object).reshape(-1)
    else:
        entries[0] = rest
    if isinstance(rest, Mapping) or entries.size not in (1, zero.size):
        raise wrong
    if entries.size == 1:
        entries = entries.repeat(zero.size)
    held = np.array([isinstance(x, str) and x == HOLD for x in entries], bool)
    zeros = np.array([isinstance(x, str) and x == ZERO for x in entries], bool)
    numbers = entries[~(held | zeros)]
    if not all(isinstance(x, int | float | np.number) for x in numbers):
        raise wrong
    fixed = zero.reshape(-1).copy()
    fixed[~(held | zeros)] = numbers.astype(np.float64)
    if fixed.dtype.kind in "iu" and (fixed[~(held | zeros)] != numbers.astype(np.float64)).any():
        raise DeclarationError(f"{where} is {short(rest)}, but {short(space)} has whole numbers")
    fixed = fixed.reshape(shape)
    if outside(space, fixed[None]) is not None:
        raise DeclarationError(f"{where} is {short(rest)}, which is out of {short(space)}")
    return _Leaf(path, fixed, held.reshape(shape))


# A part of an action


@dataclass(frozen=True, eq=False)
class _Written:
    """The part that a skill writes of an action of some space."""

    space: Space[Any]
    """Of its own actions."""
    places: Array | None = None
    """Of its numbers in the flat action; of a Discrete action its choices, from 0."""
    paths: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = ()
    """Of a Dict action: the names that lead to a leaf in it, and in the skill's own action."""
    choices: Array | None = None
    """The places of its choices among all choices of an action; None: it has none."""
    columns: Array | None = None
    """The numbers of a mask that are for them."""


def _written(acts: Any, space: Space[Any], who: str) -> _Written:
    named = isinstance(acts, tuple) and isinstance(acts[0], str)
    if isinstance(space, Dict | Tuple):
        if not named:
            names = ", ".join(map(repr, parts_of(space) or ()))
            raise DeclarationError(
                f"{who}: acts is {short(acts)}, but the action has parts with names ({names}): "
                f"name them, acts = ({next(iter(parts_of(space) or ()))!r},)"
            )
        return _named(acts, space, who)
    if named:
        raise DeclarationError(
            f"{who}: acts names {acts[0]!r}, a part of the action that does not exist: "
            f"{short(space)} has places, counted from 0"
        )
    size = int(space.n) if isinstance(space, Discrete) else int(np.prod(space.shape or ()))
    try:
        places = places_in(acts, size, who)
    except PolicyError:
        raise DeclarationError(
            f"{who}: acts is {short(acts)}, a part of the action that does not exist: "
            f"{short(space)} has places 0 to {size - 1}"
        ) from None
    if isinstance(space, Discrete):
        return _Written(Discrete(len(places)), places, columns=places)
    columns = _columns(space, places)
    if isinstance(space, MultiBinary):
        return _Written(MultiBinary(len(places)), places, choices=places, columns=columns)
    if isinstance(space, MultiDiscrete):
        first = np.broadcast_to(space.start, space.shape).reshape(-1)[places]
        own = MultiDiscrete(space.nvec.reshape(-1)[places], dtype=space.dtype, start=first)
        return _Written(own, places, choices=places, columns=columns)
    assert isinstance(space, Box)
    low, high = space.low.reshape(-1)[places], space.high.reshape(-1)[places]
    choices = None if columns is None else places
    return _Written(Box(low, high, dtype=space.dtype), places, choices=choices, columns=columns)


def _columns(space: Space[Any], choices: Array) -> Array | None:
    """Return the numbers of a mask that are for these choices of an action; None: it has none."""
    from skillweave.spaces import choice_counts  # needs torch

    starts = np.cumsum([0, *choice_counts(space)])
    if len(starts) == 1 or not len(choices):
        return None
    return np.concatenate([np.arange(starts[i], starts[i + 1]) for i in choices])


def _named(names: tuple[str, ...], space: Space[Any], who: str) -> _Written:
    found: dict[str, tuple[tuple[str, ...], Space[Any]]] = {}
    for name in names:
        path, part = tuple(name.split(".")), space
        for key in path:
            inner = parts_of(part) or {}
            if key not in inner:
                hint = meant(name, [".".join(p) for p in leaf_paths(space)], "its parts are")
                raise DeclarationError(
                    f"{who}: acts names {name!r}, a part of the action that does not exist{hint}"
                )
            part = inner[key]
        found[name] = path, part
    paths = [path for path, _ in found.values()]
    if any(a != b and b[: len(a)] == a for a in paths for b in paths):
        raise DeclarationError(f"{who}: acts names a part of the action twice: {short(names)}")
    if len(found) == 1:
        path, own = next(iter(found.values()))
        inside = [((*path, *x), x) for x in leaf_paths(own)]
    else:
        inside = [((*p, *x), (n, *x)) for n, (p, part) in found.items() for x in leaf_paths(part)]
        own = Dict([(name, part) for name, (_, part) in found.items()])
    choices = _choices_at([path for path, _ in inside], space)
    columns = _columns(space, choices)
    return _Written(own, paths=tuple(inside), choices=choices, columns=columns)


def _choices_at(paths: Sequence[tuple[str, ...]], space: Space[Any]) -> Array:
    """Return the places of the choices of some leaves among all choices of a Dict action."""
    from skillweave.spaces import choice_counts  # needs torch

    places: dict[tuple[str, ...], list[int]] = {}
    start = 0
    for path in leaf_paths(space):
        leaf = space
        for name in path:
            leaf = (parts_of(leaf) or {})[name]
        places[path] = list(range(start, start + len(choice_counts(leaf))))
        start += len(places[path])
    return np.array([place for path in paths for place in places[path]], np.int64)


def _joined(space: Space[Any], paths: Any, action: Array) -> Array:
    """Return the part of whole actions (n,) of a Dict that lies at ``paths``."""
    from skillweave.spaces.packing import obs_dtype, obs_shape  # needs torch

    if paths == ((paths[0][0], ()),):
        return part_at(action, paths[0][0])
    own = np.zeros((len(action), *obs_shape(space)), obs_dtype(space))
    for path, inside in paths:
        part_at(own, inside)[...] = part_at(action, path)
    return own


# Both


class OwnPart:
    """The part of observations that a skill sees, and of actions that it writes.

    Args:
        sees: the skill's; None: it sees all.
        acts: the skill's; None: it writes all.
        rest: the hierarchy's, for the other numbers of the action.
        observation_space: of the environment.
        action_space: of the environment.
        who: begins messages: "skill 'arm'".

    Raises:
        DeclarationError: they do not fit the spaces; the message names the field.
    """

    def __init__(
        self,
        sees: Any,
        acts: Any,
        rest: Any,
        observation_space: Space[Any],
        action_space: Space[Any],
        who: str,
    ) -> None:
        from skillweave.spaces.packing import obs_shape  # needs torch

        self.who = who
        self._declared = sees, acts, rest
        self.whole_observation_space = observation_space
        self.whole_action_space = action_space
        self.observation_space = observation_space
        """Of what its policy sees, without a goal."""
        self.action_space = action_space
        """Of its own actions."""
        self._ndim = len(obs_shape(observation_space))
        self.inputs: dict[str, Input] | None = None
        """What it sees, by the name of the input; None: all."""
        self.written: _Written | None = None
        """What it writes; None: all."""
        self._view: Callable[[Array], Array] | None = None
        self.correction: Correction | None = None
        """The ready policy to whose actions its own are added; None: there is none."""
        if sees is not None:
            self._fit_sees(sees, observation_space, action_space)
        self.rest: Rest | None = None
        """The rest of the action; None: there is none."""
        if acts is not None:
            self.written = _written(declared_acts(acts, who), action_space, who)
            self.action_space = self.written.space
            if not isinstance(action_space, Discrete):
                self.rest = Rest(rest, action_space)
            elif not (isinstance(rest, str) and rest == ZERO):
                raise DeclarationError(
                    f"rest is {short(rest)}, but an action is one choice ({short(action_space)}), "
                    "of which nothing is left: leave out rest"
                )

    def to_json(self) -> dict[str, Any]:
        """Return what was declared as JSON."""
        sees, acts, rest = self._declared
        content = part_to_json(sees, acts, self.who)
        if self.rest is not None:
            content["rest"] = rest_to_json(rest)
        if self.correction is not None:
            content["residual"] = self.correction.scale
            content["policy"] = source_of(self.correction.base)
        return content

    @property
    def holds(self) -> bool:
        """Return whether the last action of the environment counts."""
        return self.rest is not None and self.rest.holds

    def _fit_sees(self, sees: Any, space: Space[Any], action_space: Space[Any]) -> None:
        mapping = declared_sees(sees, self.who)
        try:
            self._plan = Plan(mapping, space, action_space, {}, self.who)
        except PolicyError as error:
            raise DeclarationError(str(error)) from None
        assert self._plan.inputs is not None
        self.inputs, self._computes = self._plan.inputs, bool(mapping.functions())
        spaces = {name: self._input_space(name, given) for name, given in self.inputs.items()}
        self.observation_space = spaces[""] if set(spaces) == {""} else Dict(list(spaces.items()))

    def _input_space(self, name: str, given: Input) -> Space[Any]:
        """Return the space of one input."""
        leaves = given.leaves
        if len(given.sources) > 1 and any(leaf is not None and leaf.image for leaf, _ in leaves):
            raise DeclarationError(
                f"{self.who}: sees joins an image with other parts of the observation: give each "
                "an input of its own, sees = {'image': 'camera', 'rest': ('joints', ...)}"
            )
        leaf, whole = leaves[0]
        if leaf is not None and whole and len(leaves) == 1 and not given.scalings:
            space: Space[Any] = self._plan.spaces[0]
            for field in leaf.fields:
                space = (parts_of(space) or {})[field]
            if isinstance(space, Box):
                return space
        return Box(-np.inf, np.inf, given.shape or (1,), np.float32)

    def corrected(self, correction: Correction) -> OwnPart:
        """Return the part of a skill whose actions correct those of a ready policy."""
        part = copy.copy(self)
        part.correction, part.action_space = correction, correction.space
        return part

    @property
    def base(self) -> Policy | None:
        """The ready policy that it corrects; None: there is none."""
        return None if self.correction is None else self.correction.base

    @property
    def written_space(self) -> Space[Any]:
        """The space of what it writes, after its correction."""
        return self.whole_action_space if self.written is None else self.written.space

    def within(self, view: Callable[[Array], Array], observation_space: Space[Any]) -> OwnPart:
        """Return the part of larger observations, of which ``view`` returns the environment's."""
        part = copy.copy(self)
        part._view, part.whole_observation_space = view, observation_space
        return part

    def see(self, obs: Array) -> Array:
        """Return what its policy sees of observations (…, *obs_shape), without a goal."""
        if self._view is not None:
            obs = self._view(obs)
        if self.inputs is None:
            return obs
        from skillweave.spaces.packing import obs_dtype  # needs torch

        lead = obs.shape[: obs.ndim - self._ndim]
        flat = obs if len(lead) == 1 else obs.reshape(-1, *obs.shape[len(lead) :])
        seen = self._plan.read(flat, None, None)
        if self._computes:
            self._check_finite(seen, flat)
        space = self.observation_space
        if "" in seen:
            assert isinstance(space, Box)
            return np.ascontiguousarray(seen[""], space.dtype).reshape(*lead, *space.shape)
        # Zeros, because the bytes between parts are written to files.
        joint = np.zeros(len(flat), obs_dtype(space))
        for name, value in seen.items():
            joint[name] = value.reshape(joint[name].shape)
        return joint.reshape(lead)

    def _check_finite(self, seen: Mapping[str, Array], obs: Array) -> None:
        """Raise a SkillError where functions of ``sees`` made NaN or infinity of ``obs`` (n, …)."""
        for value in seen.values():
            finite = np.isfinite(value)
            if not finite.all():
                row = int(np.argwhere(~finite)[0, 0])
                raise SkillError(
                    f"{self.who}: sees gives {observed(value[row])}, which is not finite, for the "
                    f"observation {observed(obs[row])}: let its functions return finite numbers"
                )

    def mask(self, mask: Array | None) -> Array | None:
        """Return which of its own choices a mask (…, A) allows; all where it allows none."""
        if mask is None or self.written is None:
            return mask
        if self.written.columns is None:  # real numbers alone, which a mask is not for
            return None
        own = mask[..., self.written.columns]
        free = self._free(own)
        return own if free.all() else own | ~free[..., None]

    def _free(self, own: Array) -> Array:
        """Return where each of its own parts has an allowed choice, (…) bool."""
        from skillweave.spaces import allows_each, choice_counts  # needs torch

        assert self.written is not None
        return allows_each(own, choice_counts(self.written.space))

    def check_mask(self, mask: Array | None, action: Array) -> None:
        """Raise a SkillError where a mask (n, A) leaves it no choice, or forbids the rest.

        Args:
            action: (n, …), the whole actions.
        """
        from skillweave.spaces import action_codec  # needs torch

        if mask is None or self.written is None:
            return
        own, space = self.written, self.whole_action_space
        if own.columns is not None and not self._free(mask[:, own.columns]).all():
            raise SkillError(
                f"{self.who}: the environment's action mask allows none of the choices that it "
                "owns (acts): let it start only where one is allowed, or let it own more"
            )
        if isinstance(space, Discrete):
            return
        codec = action_codec(space)
        choice = codec.choices_in(action)
        first = np.cumsum([0, *codec.counts[:-1]])
        allowed = np.take_along_axis(mask, first + choice, axis=1)
        if own.choices is not None:
            allowed[:, own.choices] = True
        if not allowed.all():
            row, place = np.argwhere(~allowed)[0].tolist()
            where = "place" if isinstance(space, MultiDiscrete | MultiBinary | Box) else "choice"
            raise SkillError(
                f"{self.who}: the environment's action mask forbids the value "
                f"{int(choice[row, place])} at {where} {place} of the action, which rest leaves it "
                f"at: give the hierarchy another rest, or let the skill own this {where} (acts)"
            )

    @property
    def is_within(self) -> bool:
        """Return whether it is a part of larger observations than the environment's."""
        return self._view is not None

    def own_step(self, step: Step) -> Step:
        """Return a step as its policy sees it: its part of observations and of the action."""
        obs, next_obs = self.see(step.obs), self.see(step.next_obs)
        return replace(step, obs=obs, next_obs=next_obs, action=self._read(step.action))

    def _read(self, action: Array) -> Array:
        """Return its part of whole actions (n, …)."""
        written = self.written
        if written is None:
            return action
        space = written.space
        if isinstance(self.whole_action_space, Discrete):
            assert written.places is not None
            chosen = (action - self.whole_action_space.start)[:, None] == written.places
            return np.asarray(chosen.argmax(axis=1), space.dtype)  # 0 where a reflex chose another
        if written.places is not None:
            own = action.reshape(len(action), -1)[:, written.places]
            return own.reshape(len(action), *(space.shape or ()))
        return _joined(space, written.paths, action)

    def write(self, own: Array, last: Array | None) -> Array:
        """Return whole actions (n, …) of its own ones (n, …).

        Args:
            last: (n, …), the last actions; needed only where it ``holds``.
        """
        written = self.written
        if written is None:
            return own
        if isinstance(self.whole_action_space, Discrete):
            assert written.places is not None
            choice = written.places[own] + self.whole_action_space.start
            return np.asarray(choice, self.whole_action_space.dtype)
        assert self.rest is not None
        action = self.rest.filled(len(own), last)
        if written.places is not None:
            action.reshape(len(own), -1)[:, written.places] = own.reshape(len(own), -1)
        for path, inside in written.paths:
            part_at(action, path)[...] = part_at(own, inside)
        return action


class PartOf(Around):
    """A policy that sees and writes an own part."""

    def __init__(self, part: OwnPart, policy: InPlace) -> None:
        super().__init__(policy)
        self._part = part

    def act(self, memory: dict[str, Any], rows: Array, obs: Array, turn: Turn) -> Array:
        """Return whole actions (k, …)."""
        part, last = self._part, turn.world.last_action
        own = Turn(turn.world, part.mask(turn.mask), turn.goal, turn.greedy)
        actions = super().act(memory, rows, part.see(obs), own)
        actions = part.write(actions, None if last is None else last[rows])
        part.check_mask(turn.mask, actions)
        return actions

    def observe(self, memory: dict[str, Any], rows: Array, step: Step) -> None:
        """Notice the part of a step."""
        if self.watches:
            super().observe(memory, rows, self._part.own_step(step))
