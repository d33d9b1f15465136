"""The folder of an export: ONNX files, ``policy.json``, and the runner."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from skillweave.envs.infos import observes_mask
from skillweave.errors import PolicyError
from skillweave.export.graphs import dtype_to_json, inputs_of
from skillweave.export.states import States
from skillweave.messages import short
from skillweave.runs.files import write_bytes
from skillweave.skills.foreign_policy import checksum
from skillweave.spaces import obs_dtype, obs_shape, space_to_json
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
    if isinstance(policy.action_space, gym.spaces.Dict | gym.spaces.Tuple):
        raise PolicyError(
            f"actions of {short(policy.action_space, 200)} cannot be exported, as the runner "
            "returns one array: let a wrapper (gymnasium.wrappers.TransformAction) make a Box or a "
            "MultiDiscrete of them and train with it, or act by run.player() where this library is"
        )
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
        "dtype": dtype_to_json(obs_dtype(space)),
        "shape": list(obs_shape(space)),
        "inputs": inputs_of(space),
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
