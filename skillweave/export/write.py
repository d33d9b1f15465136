"""The folder of an export: ONNX files, ``policy.json``, the runner, and what acts in it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from skillweave import policies
from skillweave._internal.policy_protocol import Policy
from skillweave._internal.terminal import printable
from skillweave.export.compile import deployed
from skillweave.policies.codec import FORMAT, MANIFEST, Written
from skillweave.policies.untrusted import checksum
from skillweave.runs.files import write_bytes

PACKAGE = "skillweave_policies"
"""The name of ``skillweave.policies`` in an export, whose modules import one another by place."""


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
    path: Path, policy: Policy, env: str, *, license: str = "", origin: str = ""
) -> Export:
    """Write an export of a policy to a folder, for machines without this library.

    Files of the same names are replaced.

    Args:
        path: the folder.
        env: the environment's name, for readers of ``policy.json``.
        license: of the policy, for them.
        origin: of the policy, for them: an address, for example.

    Raises:
        PolicyError: a part of it cannot be exported; the message names it, and what to do.
        MissingExtra: the packages that write ONNX are not installed.
    """
    written = Written()
    tree = written.tree(deployed(policy))
    files = written.content()
    content = {
        "format": FORMAT,
        "env": env,
        "license": license,
        "origin": origin,
        "files": {name: checksum(data) for name, data in files.items()},
        "code": written.code,
        "policy": tree,
    }
    files |= {MANIFEST: json.dumps(content, indent=1, allow_nan=False).encode()}
    for name, data in files.items():
        write_bytes(path / name, data)
    for name, data in _programs().items():
        write_bytes(path / name, data, durable=False)
    return Export(path, (*files, *_programs()), written.code, written.functions)


@cache
def _programs() -> dict[str, bytes]:
    """Return the runner, and the package by which it acts."""
    runner = Path(__file__).with_name("runner.py").read_bytes()
    modules = sorted(Path(policies.__path__[0]).glob("*.py"))
    return {"runner.py": runner} | {
        f"{PACKAGE}/{module.name}": module.read_bytes() for module in modules
    }
