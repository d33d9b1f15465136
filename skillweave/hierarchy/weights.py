"""A whole hierarchy's weights as one file."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NotRequired, TypedDict, cast

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.policy import AgentHeader, AgentPolicy
from skillweave.collecting.lengths import calls_from_json, calls_to_json
from skillweave.envs.make import EnvSpec
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.guidance import check_guided, fitted_guide
from skillweave.hierarchy.policy import HierarchyPolicy, with_interruption
from skillweave.messages import short
from skillweave.reading import Positive, fit, shown
from skillweave.runs.files import read_tensors, write_tensors
from skillweave.selectors import ReadySelector
from skillweave.skills.foreign_policy import Foreign, Source, as_recorded, source_of
from skillweave.spaces import same_space
from skillweave.training.plain_agent import AGENT, PlainAgent
from skillweave.training.stage import CRITIC
from skillweave.types import Policy, SkillweaveError


def write_weights(path: Path, declaration: Declaration | PlainAgent, policy: Policy) -> None:
    """Write skills and selector, or a plain agent; of ready policies what a run copies too."""
    place = {"env": declaration.spec.name, "env_kwargs": declaration.spec.kwargs}
    if isinstance(policy, AgentPolicy):
        weights, description = policy.to_file()
        write_tensors(path, weights, description | place)
        return
    assert isinstance(policy, HierarchyPolicy)
    assert isinstance(declaration, Declaration)
    tensors: dict[str, Tensor] = {}
    parts: dict[str, Any] = {}
    named: list[tuple[str, Policy]] = []
    ready: dict[str, Any] = {}
    if isinstance(policy.selector, ReadySelector):
        ready["selector"] = source_of(policy.selector)
    else:
        named.append(("selector", policy.selector))
    cuts = policy.skills.interruption
    if cuts is not None and cuts.critic is not None:
        named.append((CRITIC, cuts.critic))
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
        "recipe": getattr(declaration, "recipe", None),
        **place,
        "skills": [s.name for s in declaration.skills],
        **calls_to_json(declaration.call_steps),
        "interrupt": None if cuts is None else cuts.margin,
        "greedy_skills": declaration.greedy_skills,
        "parts": parts,
        "ready": ready,
    }
    if policy.guide is not None:
        header["guide"] = source_of(cast(Policy, policy.guide.selector))
    write_tensors(path, tensors, header)


class HierarchyHeader(TypedDict):
    """What the file of a hierarchy's weights says of them."""

    kind: str
    env: str
    env_kwargs: NotRequired[dict[str, Any]]
    recipe: NotRequired[str | None]
    skills: list[str]
    call_steps: Positive | None
    call_lengths: NotRequired[list[Positive]]
    interrupt: NotRequired[float | None]
    greedy_skills: bool
    parts: dict[str, dict[str, Any]]
    guide: NotRequired[Source]
    """Of the ready selector that restricts the trained one."""
    ready: NotRequired[dict[str, Source]]
    """Of skills by name, and of "selector"."""


def open_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and header of a file of a hierarchy's weights, or of a plain agent's.

    Raises:
        SkillweaveError: the file is damaged, or holds something else.
    """
    tensors, header = read_tensors(path)
    if header.get("kind") == "agent" and "algorithm" in header:
        fit(AgentHeader, header, str(path))
        if (stage := header.get("stage", AGENT)) not in (AGENT, "flat"):  # its older name
            raise SkillweaveError(
                f"{path} holds the policy of stage {shown(stage)} alone; write the whole "
                "hierarchy's weights: skillweave weights RUN"
            )
        return tensors, header
    if header.get("kind") != "hierarchy":
        raise SkillweaveError(
            f"{path} holds something of kind {short(header.get('kind'))}, not a hierarchy"
        )
    fit(HierarchyHeader, header, str(path))
    return tensors, header


def read_agent(
    spec: EnvSpec, tensors: dict[str, Tensor], header: dict[str, Any], path: Path
) -> AgentPolicy:
    """A plain agent from what ``open_weights`` found in ``path``.

    Raises:
        SkillweaveError: the file is damaged, or belongs to another environment.
    """
    if header["kind"] != "agent":
        raise SkillweaveError(
            f"{path} holds something of kind {short(header['kind'])}, not a plain agent"
        )
    if (env := header.get("env", spec.name)) != spec.name:
        raise SkillweaveError(f"{path} is of an agent on {shown(env)}, but this is on {spec.name}")
    return AgentPolicy.from_file(tensors, header, str(path))


def read_weights(declaration: Declaration, path: Path) -> HierarchyPolicy | AgentPolicy:
    """The inverse of ``write_weights``; the declaration takes over the file's call length.

    Raises:
        SkillweaveError: the file is damaged, or belongs to other skills or another environment.
    """
    tensors, header = open_weights(path)
    if header["kind"] == "agent":
        return read_agent(declaration.spec, tensors, header, path)
    names = [s.name for s in declaration.skills]
    if header["skills"] != names or header["env"] != declaration.spec.name:
        theirs = ", ".join(header["skills"])
        raise SkillweaveError(
            f"{path} is of skills {theirs[:300]} on {header['env'][:100]}, but the "
            f"hierarchy has {', '.join(names)} on {declaration.spec.name}"
        )

    def part(name: str) -> AgentPolicy:
        own = {k.split("/", 1)[1]: v for k, v in tensors.items() if k.split("/", 1)[0] == name}
        if name not in header["parts"]:
            raise SkillweaveError(f"{path} holds no weights of {name!r}")
        return AgentPolicy.from_file(own, header["parts"][name], f"{path} ({name})")

    def copied(name: str) -> bytes | None:
        content = tensors.get(f"{name}/content")
        return None if content is None else content.contiguous().numpy().tobytes()

    policies: list[Policy] = []
    ready, recorded = declaration.ready_policies(), header.get("ready", {})
    for name in names:
        if name in ready:
            read, where = partial(copied, name), f"{path}: skill {name!r}"
            policies.append(as_recorded(ready[name], recorded.get(name), read, where))
        else:
            policies.append(part(name))
    declaration.call_steps = calls_from_json(header)
    selector = declaration.fitted_selector(policies[0].observation_space)
    check_selector(selector is not None, "selector" in recorded, str(path))
    if selector is None:
        selector = part("selector")
    else:
        place = f"{path}: the selector"
        selector = as_recorded(selector, recorded["selector"], lambda: None, place)
    check_parts(declaration, policies, selector, str(path))
    declaration.greedy_skills = header["greedy_skills"]
    skills = declaration.skill_set(policies)
    if (margin := header.get("interrupt")) is not None:
        skills = with_interruption(skills, part(CRITIC), margin)
    guide = fitted_guide(declaration, selector.observation_space)
    restricts = guide is not None and guide.restricts
    check_guided(restricts, "guide" in header, str(path))
    if guide is None or not restricts:
        return HierarchyPolicy(selector, skills)
    own = cast(Policy, guide.selector)
    as_recorded(own, header["guide"], lambda: None, f"{path}: the guide")
    return HierarchyPolicy(selector, skills, guide)


def check_selector(mine: bool, theirs: bool, where: str) -> None:
    """Raise a SkillweaveError where of two selectors one is ready and the other is trained."""
    if mine != theirs:
        kinds = ("a trained selector", "a ready one (a function, an automaton or a tree)")
        raise SkillweaveError(
            f"{where} has {kinds[theirs]}, but this hierarchy has {kinds[mine]}: declare the "
            "selector as it was, or train anew"
        )


def check_parts(
    declaration: Declaration, policies: Sequence[Policy], selector: Policy, where: str
) -> None:
    """Raise a SkillweaveError where a policy is not of the spaces that its place asks for.

    The selector chooses among the skills; they all see and do what the first of them does.
    """
    first = policies[0]
    wanted = {"observation_space": first.observation_space, "action_space": first.action_space}
    places = {s.name: (p, wanted) for s, p in zip(declaration.skills, policies, strict=True)}
    choices = gym.spaces.Discrete(declaration.choices)
    places["selector"] = selector, wanted | {"action_space": choices}
    for name, (policy, spaces) in places.items():
        for kind, space in spaces.items():
            found = getattr(policy, kind)
            if not same_space(found, space):
                raise SkillweaveError(
                    f"{where}: the policy in the place of {name!r} has {kind} {shown(found)}, but "
                    f"{shown(space)} belongs there"
                )
