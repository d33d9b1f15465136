"""A whole hierarchy's weights as one file."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.policy import AgentPolicy
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.runs.files import read_tensors, write_tensors
from skillweave.skills.foreign import Foreign, as_recorded, source_of
from skillweave.types import Policy, SkillweaveError


def write_weights(path: Path, declaration: Declaration, policy: Policy, recipe: str | None) -> None:
    """Write skills and selector, or a flat agent; of ready policies what a run copies too."""
    place = {"env": declaration.spec.name, "env_kwargs": declaration.spec.kwargs}
    if isinstance(policy, AgentPolicy):
        weights, description = policy.to_file()
        write_tensors(path, weights, description | place)
        return
    assert isinstance(policy, HierarchyPolicy)
    tensors: dict[str, Tensor] = {}
    parts: dict[str, Any] = {}
    named: list[tuple[str, Policy]] = [("selector", policy.selector)]
    ready: dict[str, Any] = {}
    for skill, own in zip(declaration.skills, policy.skills.policies, strict=True):
        if skill.policy is None:
            named.append((skill.name, own))
            continue
        ready[skill.name] = source_of(own)
        if isinstance(own, Foreign) and (content := own.content()) is not None:
            tensors[f"{skill.name}/content"] = torch.tensor(np.frombuffer(content, np.uint8))
    for name, own in named:
        assert isinstance(own, AgentPolicy)
        weights, parts[name] = own.to_file()
        tensors |= {f"{name}/{k}": v for k, v in weights.items()}
    header = {
        "kind": "hierarchy",
        "recipe": recipe,
        **place,
        "skills": [s.name for s in declaration.skills],
        "call_steps": declaration.call_steps,
        "greedy_skills": declaration.greedy_skills,
        "parts": parts,
        "ready": ready,
    }
    write_tensors(path, tensors, header)


def read_weights(declaration: Declaration, path: Path) -> Policy:
    """The inverse of ``write_weights``; the declaration takes over the file's call length.

    Raises:
        SkillweaveError: the file is damaged, or belongs to other skills or another environment.
    """
    tensors, header = read_tensors(path)
    names = [s.name for s in declaration.skills]
    if header.get("kind") == "agent" and "algorithm" in header:
        return AgentPolicy.from_file(tensors, header, str(path))
    if header.get("kind") != "hierarchy":
        raise SkillweaveError(f"{path} holds a {header.get('kind')}, not a hierarchy")
    if header["skills"] != names or header["env"] != declaration.spec.name:
        raise SkillweaveError(
            f"{path} is of skills {', '.join(header['skills'])} on {header['env']}, but the "
            f"hierarchy has {', '.join(names)} on {declaration.spec.name}"
        )
    declaration.call_steps, declaration.greedy_skills = (
        header["call_steps"],
        header["greedy_skills"],
    )

    def part(name: str) -> AgentPolicy:
        own = {k.split("/", 1)[1]: v for k, v in tensors.items() if k.split("/", 1)[0] == name}
        if name not in header["parts"]:
            raise SkillweaveError(f"{path} holds no weights of {name!r}")
        return AgentPolicy.from_file(own, header["parts"][name], f"{path} ({name})")

    def copied(name: str) -> bytes | None:
        content = tensors.get(f"{name}/content")
        return None if content is None else content.numpy().tobytes()

    policies: list[Policy] = []
    ready, recorded = declaration.ready_policies(), header.get("ready", {})
    for name in names:
        if name in ready:
            read, where = partial(copied, name), f"{path}: skill {name!r}"
            policies.append(as_recorded(ready[name], recorded.get(name), read, where))
        else:
            policies.append(part(name))
    return HierarchyPolicy(part("selector"), declaration.skill_set(policies))
