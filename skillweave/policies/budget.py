"""The memory that a policy from a file may ask for, computed before anything is made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import prod
from typing import Any

import numpy as np

from .actor import Deployed
from .hierarchy import CallAndReturn
from .leaves import OnnxNetwork
from .mapped import LONGEST, Mapped, OnnxFile, Take
from .plan import Options
from .planned import LATEST, Planned
from .selectors import StateMachine
from .spaces import MOST, Space

BUDGET = 2**31
"""The most bytes that acting in one environment may take, those of arrays in files not counted."""
SESSION = 2**18
"""Bytes of a session of onnxruntime without its weights."""

Values = Mapping[str, Any]
"""The fields of an object that is not made yet, by name."""


def cost(kind: type[Any], values: Values) -> int:
    """Return about how many bytes an object of a policy's file takes while it acts.

    Objects in it are not counted.
    """
    counted = COSTS.get(kind)
    return 0 if counted is None else max(0, counted(values))


def _space(values: Values) -> int:
    """Return the bytes of a space in a policy's file."""
    if values.get("parts") is not None:
        return 0
    size: int = prod(values.get("shape", ()))
    if size > MOST:  # it is refused
        return 0
    # Choices are lists of Python's numbers.
    return size * (16 if values["kind"] == "Box" else 128)


def _bytes(space: Space) -> int:
    return sum(prod(x.shape) * np.dtype(x.dtype).itemsize for x in space.leaves.values())


def _deployed(values: Values) -> int:
    return 8 * (_bytes(values["sees"]) + _bytes(values["acts"]))


def _network(values: Values) -> int:
    """Return the bytes of a network in a policy's file, with its session of onnxruntime."""
    noise = sum(max(0, width) for _, width in values.get("noise", ()))
    memory: int = values.get("memory", 0)
    choices: int = values.get("choices", 0)
    numbers: int = 16 * memory + 32 * noise + 16 * choices
    return _session(values["file"]) + numbers


def _session(file: bytes) -> int:
    return SESSION + len(file) // 2


def _mapped(values: Values) -> int:
    states: int = sum(prod(shape) for shape, _ in values["model"].states)
    actions: int = min(values.get("chunk") or 1, LONGEST)
    numbers: int = 32 * states + 4 * actions * _bytes(values["outputs"].space)
    pasts = [one.past for one in (values.get("inputs") or {}).values() if one.past is not None]
    numbers += sum(32 * past.length * len(past.kept) for past in pasts)
    return numbers if values.get("sees") is None else numbers + 4 * _bytes(values["sees"])


def _take(values: Values) -> int:
    options: int = sum(max(0, count) for count, _ in values.get("choices", ()))
    return 32 * options


def _hierarchy(values: Values) -> int:
    return 64 * len(values["skills"]) * max(1, len(values.get("lengths", ())))


def _automaton(values: Values) -> int:
    return 8 * len(values["states"]) * len(values["skills"])


def _options(values: Values) -> int:
    """Return the bytes of the options of a plan in a policy's file."""
    found = 0
    widest = max((aims.shape[-1] for aims in values["aims"] if np.ndim(aims)), default=1)
    for group in values["groups"]:
        found += 64 * group.options * (1 + max(1, values["neighbors"]))
        if group.options > 1:  # each with each
            found += 8 * min(group.options, len(group.rows)) ** 2 * (4 + widest)
    return found


def _planned(values: Values) -> int:
    """Return the bytes of a planned selector in a policy's file."""
    options = values["options"]
    widest = max((aims.shape[-1] for aims in options.aims if aims is not None), default=1)
    features = max((len(one.places) for one in values["features"]), default=0)
    calls = len(options.choice_of) * (5 + widest) + 2 * len(values["features"]) * features
    return 8 * LATEST * calls


COSTS: dict[type[Any], Callable[[Values], int]] = {
    Space: _space,
    Deployed: _deployed,
    OnnxNetwork: _network,
    OnnxFile: lambda values: _session(values["content"]),
    Mapped: _mapped,
    Take: _take,
    CallAndReturn: _hierarchy,
    StateMachine: _automaton,
    Options: _options,
    Planned: _planned,
}
