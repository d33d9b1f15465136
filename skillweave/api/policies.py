"""Policies as folders of ONNX files and a ``policy.json``: save one, or load one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from skillweave import schema
from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import as_path, short
from skillweave._internal.policy_protocol import Policy, is_policy
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError, PolicyError, RunError
from skillweave.export.read import read_policy
from skillweave.export.write import Export, write_export
from skillweave.policies.codec import MANIFEST
from skillweave.runs import hub
from skillweave.skills.foreign_policy import Foreign, fitted


@checked_names
def save_policy(
    policy: Policy,
    path: str | Path,
    env: Any = None,
    *,
    license: str = "",
    origin: str = "",
) -> Export:
    """Write a policy as ONNX files, ``policy.json`` and ``runner.py``; ``load_policy`` reads it.

    ``policy.json`` has the spaces, the mapping, the rate and the range of goals, the license, and a
    checksum of each ONNX file. Python code is not written: ``Export.code`` lists it.

    Args:
        policy: ``from_onnx(...)``, ``run.policy``, or any other that can be exported.
        path: a folder; files of the same names are replaced.
        env: the environment, as of a ``Hierarchy``, whose spaces a policy from elsewhere gets;
            None: the policy has its spaces.
        license: of the policy, "Apache-2.0" for example.
        origin: of the policy, an address for example.

    Returns:
        The folder, its files, and what is code.

    Raises:
        PolicyError: a part cannot be exported, or does not fit the environment.
        DeclarationError: an argument is wrong.
    """
    folder = as_path(path, "path")
    for name, text in (("license", license), ("origin", origin)):
        schema.fitted(str, text, name)
    if not is_policy(policy):
        raise DeclarationError(
            f"policy is {short(policy)}, which is no policy; give from_function(...) or "
            "from_torch(...) of it"
        )
    hub.must_be_own(folder)
    named = ""
    if env is not None:
        spec = env if isinstance(env, EnvSpec) else EnvSpec(env)
        named = spec.name
        policy = fitted(policy, *spec.spaces, "save_policy()", named)
    elif isinstance(policy, Foreign) and None in (policy.observation_space, policy.action_space):
        raise PolicyError(
            f"save_policy(): {policy.name} has no spaces yet: give the environment, "
            "save_policy(policy, path, env)"
        )
    return write_export(folder, policy, named, license=license, origin=origin)


@checked_names
def load_policy(
    path: str | Path,
    *,
    goal: Any = None,
    code: Mapping[str, Callable[..., Any]] | None = None,
    revision: str | None = None,
) -> Policy:
    """Load a policy that ``save_policy`` or ``Run.export`` wrote, from a folder or from the hub.

    Only data is read: ``policy.json`` and ONNX files with the recorded checksums. It needs the
    extra ``onnx``, and ``hub`` for the hub.

    Args:
        path: the folder; or ``owner/name`` on the Hugging Face Hub, if there is no such folder.
        goal: replaces the recorded goal, the value of ``Goal()``; see ``from_onnx``.
        code: the functions that its field ``code`` lists, by name.
        revision: on the hub, a branch, a tag or a commit; None: the latest.

    Returns:
        The policy with its spaces, for a skill's ``policy`` or ``evaluate``.

    Raises:
        RunError: a file is missing or damaged, or does not fit; the message names it and the field.
        PolicyError: it needs Python code that was not given.
        DeclarationError: an argument is wrong.
        MissingExtra: an extra is not installed.
    """
    folder = as_path(path, "path")
    schema.fitted(Mapping[str, Callable[..., Any]] | None, code, "code")
    if not folder.exists():
        name = str(path)
        if folder.is_absolute() or name.count("/") != 1 or name.startswith("."):
            raise RunError(f"{folder} does not exist")
        try:
            folder = hub.download(name, revision, policy=True)
        except RunError as error:
            raise RunError(
                f"there is no folder {name}, and it cannot be loaded from the hub: {error}"
            ) from error
    elif folder.is_file() and folder.name != MANIFEST:
        raise RunError(
            f"{folder} is a file; give a folder with {MANIFEST}. Models are opened by from_onnx, "
            "from_torch and from_sb3"
        )
    elif folder.is_file():
        folder = folder.parent
    elif not (folder / MANIFEST).exists() and (folder / "run.json").exists():
        raise RunError(
            f"{folder} is a run, not an exported policy: sw.load({str(folder)!r}, "
            "hierarchy).policy acts as it does"
        )
    return read_policy(folder, code, goal)
