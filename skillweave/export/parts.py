"""Own parts of skills in an export: their entry in ``policy.json``, and parts made of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, NotRequired, TypedDict

import gymnasium as gym

from skillweave.errors import PolicyError
from skillweave.export.graphs import dtype_to_json
from skillweave.settings import Count
from skillweave.skills.mapping import PolicyMapping
from skillweave.skills.own_part import OwnPart
from skillweave.skills.residual import Correction, Residual
from skillweave.spaces import obs_dtype, obs_shape, space_to_json
from skillweave.types import Policy


class PartEntry(TypedDict):
    """A policy that sees and writes a part; kind "Part". Further fields are for the runner."""

    policy: dict[str, Any]
    """What it is a part for: one of the other kinds."""
    base: dict[str, Any] | None
    """The ready policy that it corrects."""
    residual: NotRequired[Any]
    """The scale of the correction."""
    sees: dict[str, list[dict[str, Any]]] | None
    """The parts of each input, as of a Model; "": the only one."""
    acts: NotRequired[Any]
    """The places that it writes, as they were declared."""
    to: NotRequired[list[Count] | None]
    """These places, each by itself."""
    rest: NotRequired[Any]
    joined: NotRequired[dict[Literal["policy", "base"], bool]]
    """Of a skill with goals, which of the two observe observation and goal as one."""


def part_entry(
    part: OwnPart,
    policy: dict[str, Any],
    base: dict[str, Any] | None,
    name_of: Callable[[Callable[..., Any]], str],
) -> dict[str, Any]:
    """Return the entry of a policy with its part.

    Args:
        policy, base: the entries of the policy, and of the one that it corrects.
        name_of: returns the runner's name of a function of the user.

    Raises:
        PolicyError: the runner cannot follow it.
    """
    whole, written, rest = part.whole_action_space, part.written, part.rest
    if part.is_within:
        raise PolicyError(
            f"{part.who} acts where observations hold the state of a task, which no runner "
            "follows: export the run that its skills are from"
        )
    content = part.to_json()
    content.pop("policy", None)
    space = part.observation_space
    entry: dict[str, Any] = {
        "kind": "Part",
        "policy": policy,
        "base": base,
        **content,
        "sees": None,
        "shapes": {},
        "scaling": {},
        "goal": None,
        "dtype": dtype_to_json(obs_dtype(space)),
        "shape": list(obs_shape(space)),
        "action_space": space_to_json(part.action_space),
        "to": None,
        "columns": None,
        "fixed": None,
        "held": None,
        "step": None,
        "bounds": None,
    }
    if part.inputs is not None:
        sources = [source for given in part.inputs.values() for source, _ in given.sources]
        functions = [getattr(source, "function", None) for source in sources]
        names = {id(f): name_of(f) for f in functions if f is not None}
        entry["sees"] = {name: given.to_json(names) for name, given in part.inputs.items()}
        shapes = space.spaces if isinstance(space, gym.spaces.Dict) else {"": space}
        entry["shapes"] = {name: list(shapes[name].shape or ()) for name in part.inputs}
    if written is not None and written.places is not None:
        entry["to"] = written.places.tolist()
    if written is not None and written.columns is not None:
        entry["columns"] = written.columns.tolist()
    if rest is not None:
        entry["fixed"] = rest.filled(1, None).reshape(-1).tolist()
        entry["held"] = rest.held.reshape(-1).tolist()
    if part.correction is not None:
        own = whole if written is None else written.space
        assert isinstance(own, gym.spaces.Box)
        entry["step"] = part.correction.step.reshape(-1).tolist()
        entry["part_space"] = space_to_json(own)
    return entry


def part_of(
    entry: PartEntry,
    spaces: tuple[gym.Space[Any], gym.Space[Any]],
    who: str,
    code: Mapping[str, Callable[..., Any]],
) -> OwnPart:
    """Return the part of an entry, without the policy that it corrects.

    Args:
        spaces: of the environment.
        who: begins messages.
        code: the functions of the user, by name.

    Raises:
        DeclarationError: a field is wrong, or does not fit the spaces.
    """
    sees: Any = None
    if entry["sees"] is not None:
        inputs = PolicyMapping.from_json({"sees": entry["sees"]}, code).sees or {}
        sees = inputs[""] if set(inputs) == {""} else inputs
    return OwnPart(sees, entry.get("to"), entry.get("rest", "zero"), *spaces, who)


def with_base(part: OwnPart, base: Policy, scale: Any) -> OwnPart:
    """Return a part that corrects a ready policy."""
    return part.corrected(Correction(Residual(base, scale), base, part.action_space, part.who))
