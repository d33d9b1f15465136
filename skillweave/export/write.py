"""The folder of an export: ONNX files, ``policy.json``, and the runner."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.envs.infos import observes_mask
from skillweave.export.graphs import leaves_of
from skillweave.export.states import States
from skillweave.runs.files import write_bytes
from skillweave.skills.foreign_policy import checksum
from skillweave.spaces import obs_dtype, obs_shape, space_to_json
from skillweave.spaces.packing import parts
from skillweave.terminal import printable
from skillweave.types import Policy

FORMAT = 2
"""Version of ``policy.json``."""
MANIFEST = "policy.json"
"""The name of the file that describes a policy."""


@dataclass(frozen=True)
class Export:
    """An export: its folder, its files, and the code that its runner needs."""

    path: Path  # the folder
    files: tuple[str, ...]  # their names in it
    code: dict[str, str]
    """By name, a description of each function that the runner needs."""
    functions: dict[str, Callable[..., Any]]
    """These functions, for a runner in this process: ``Runner(path, code=functions)``."""

    def __str__(self) -> str:
        summary = f"{self.path}: {len(self.files)} files"
        if not self.code:
            return printable(summary)
        needs = "\n".join(f"  {name!r}: {what}" for name, what in self.code.items())
        runner = f"Runner({str(self.path)!r}, code={{name: function}})"
        return printable(f"{summary}\n{runner} needs\n{needs}")


def write_export(
    path: Path, policy: Policy, env: str, *, licence: str = "", origin: str = ""
) -> Export:
    """Write a policy for machines without this library; files of the same names are replaced.

    Args:
        path: the folder.
        env: the environment's name, for readers of ``policy.json``.
        licence: of the policy, for them.
        origin: of the policy, for them: an address, for example.

    Raises:
        PolicyError: a part of it cannot be exported; the message names it, and what to do.
        MissingExtra: the packages that write ONNX are not installed.
    """
    states = States(policy.action_space)
    entry = states.policy(policy)
    space = policy.observation_space
    content = {
        "format": FORMAT,
        "env": env,
        "licence": licence,
        "origin": origin,
        "files": {name: checksum(data) for name, data in states.files.items()},
        "code": states.code,
        "dtype": _dtype_to_json(obs_dtype(space)),
        "shape": list(obs_shape(space)),
        "inputs": _inputs(space),
        "observation_space": space_to_json(space),
        "action_space": space_to_json(policy.action_space),
        "observed_mask": observes_mask(space, policy.action_space),
        "policy": entry,
    }
    text = json.dumps(content, indent=1, allow_nan=False)
    runner = Path(__file__).with_name("runner.py").read_bytes()
    files = states.files | {MANIFEST: text.encode(), "runner.py": runner}
    for name, data in files.items():
        write_bytes(path / name, data)
    return Export(path, tuple(files), states.code, states.functions)


def _inputs(space: gym.Space[Any]) -> list[list[Any]]:
    """Return for each leaf its name, its fields in the packed array, and its keys."""

    def within(space: gym.Space[Any], fields: list[str], keys: list[Any]) -> list[list[Any]]:
        inner = parts(space)
        if inner is None:
            return [[".".join(["obs", *fields]), fields, keys]]
        places = range(len(inner)) if isinstance(space, gym.spaces.Tuple) else inner
        return [
            leaf
            for (name, part), key in zip(inner.items(), places, strict=True)
            for leaf in within(part, [*fields, name], [*keys, key])
        ]

    leaves = within(space, [], [])
    assert [name for name, _, _ in leaves] == [leaf.name for leaf in leaves_of(space)]
    return leaves


def _dtype_to_json(dtype: np.dtype[Any]) -> Any:
    """Return a dtype as JSON that ``numpy.dtype`` reads."""
    if dtype.subdtype is not None:
        base, shape = dtype.subdtype
        return f"({','.join(map(str, shape))},){base.str}"
    if dtype.names is None:
        return dtype.str
    assert dtype.fields is not None
    fields = [dtype.fields[name][:2] for name in dtype.names]
    return {
        "names": list(dtype.names),
        "formats": [_dtype_to_json(d) for d, _ in fields],
        "offsets": [at for _, at in fields],
        "itemsize": dtype.itemsize,
    }
