"""A whole hierarchy's weights as one file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.policy import AgentHeader, AgentPolicy
from skillweave.collecting.lengths import calls_from_json, calls_to_json
from skillweave.envs.make import EnvSpec
from skillweave.errors import RunError
from skillweave.hierarchy.assembly import assembled
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.guidance import check_guided, ready_guide
from skillweave.hierarchy.nesting import every_hierarchy, every_skill, inner_of
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.messages import short
from skillweave.reading import fit, shown
from skillweave.runs.files import read_tensors, write_tensors
from skillweave.selectors import ReadySelector
from skillweave.settings import AtLeastOne, NonNegative
from skillweave.skills.foreign_policy import Foreign, Source, as_recorded, source_of
from skillweave.spaces import same_space
from skillweave.training.plain_agent import AGENT, PlainAgent
from skillweave.training.stage import CRITIC, SELECTOR
from skillweave.types import Policy


def write_weights(path: Path, declaration: Declaration | PlainAgent, policy: Policy) -> None:
    """Write skills and selector, or a plain agent; of ready policies what a run copies too."""
    place = {"env": declaration.spec.name, "env_kwargs": declaration.spec.json_kwargs}
    if isinstance(policy, AgentPolicy):
        weights, description = policy.to_file()
        write_tensors(path, weights, description | place)
        return
    assert isinstance(policy, HierarchyPolicy)
    assert isinstance(declaration, Declaration)
    tensors: dict[str, Tensor] = {}
    parts: dict[str, Any] = {}
    ready: dict[str, Any] = {}
    for name, trained, own in _parts_of(declaration, policy):
        if trained:
            assert isinstance(own, AgentPolicy)
            weights, parts[name] = own.to_file()
            tensors |= {f"{name}/{k}": v for k, v in weights.items()}
            continue
        ready[name] = source_of(own)
        if isinstance(own, Foreign) and (content := own.content()) is not None:
            tensors[f"{name}/content"] = torch.tensor(
                np.frombuffer(content, np.uint8), device="cpu"
            )
    hierarchies = dict(_hierarchies_of(declaration, policy))
    header = {
        "kind": "hierarchy",
        "recipe": getattr(declaration, "recipe", None),
        **place,
        "skills": [name for name, _ in every_skill(declaration.skills)],
        **hierarchies.pop(""),
        "hierarchies": hierarchies,
        "parts": parts,
        "ready": ready,
    }
    write_tensors(path, tensors, header)


def _parts_of(
    declaration: Declaration, policy: HierarchyPolicy, path: str = ""
) -> Iterator[tuple[str, bool, Policy]]:
    """All who act in a hierarchy: path, whether they were trained in it, policy."""
    trained = not isinstance(policy.selector, ReadySelector)
    yield path + SELECTOR, trained, policy.selector
    cuts = policy.skills.interruption
    if cuts is not None and cuts.critic is not None:
        yield path + CRITIC, True, cuts.critic
    for skill, own in zip(declaration.skills, policy.skills.policies, strict=True):
        inner = inner_of(skill)
        if inner is None:
            yield path + skill.name, skill.policy is None, own
        else:
            assert isinstance(own, HierarchyPolicy)
            yield from _parts_of(inner, own, f"{path}{skill.name}/")


def _hierarchies_of(
    declaration: Declaration, policy: HierarchyPolicy, path: str = ""
) -> Iterator[tuple[str, dict[str, Any]]]:
    """By path, how a hierarchy calls its skills, and how those below it do."""
    yield path, _how(declaration, policy)
    for skill, own in zip(declaration.skills, policy.skills.policies, strict=True):
        if (inner := inner_of(skill)) is not None:
            assert isinstance(own, HierarchyPolicy)
            yield from _hierarchies_of(inner, own, f"{path}/{skill.name}".removeprefix("/"))


def _how(declaration: Declaration, policy: HierarchyPolicy) -> dict[str, Any]:
    """How a hierarchy calls its skills."""
    guide = _restricting(declaration)
    return {
        **calls_to_json(declaration.call_steps),
        "interrupt": declaration.together.margin if declaration.together.interrupt else None,
        "greedy_skills": policy.skills.greedy,
        "greedy_selector": policy.skills.greedy_selector,
        **({} if guide is None else {"guide": source_of(guide)}),
    }


def _restricting(declaration: Declaration) -> ReadySelector | None:
    """Return the guide that restricts the selector; None: there is none."""
    guide = declaration.guide
    return ready_guide(declaration) if guide is not None and guide.restrict else None


class InnerHeader(TypedDict):
    """What the file says of how a hierarchy calls its skills."""

    call_steps: AtLeastOne | None
    call_lengths: NotRequired[list[AtLeastOne]]
    interrupt: NotRequired[NonNegative | None]
    greedy_skills: bool
    greedy_selector: bool
    guide: NotRequired[Source]
    """Of the ready selector that restricts the trained one."""


class HierarchyHeader(InnerHeader):
    """What the file of a hierarchy's weights says of them."""

    kind: str
    env: str
    env_kwargs: dict[str, Any]
    recipe: str | None
    skills: list[str]
    parts: dict[str, dict[str, Any]]
    ready: dict[str, Source]
    """Of skills by path, and of selectors."""
    hierarchies: dict[str, InnerHeader]
    """By path, skills that are hierarchies; their own skills are among all ``skills``."""


def open_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and header of a file of a hierarchy's weights, or of a plain agent's.

    Raises:
        RunError: the file is damaged, or holds something else.
    """
    tensors, header = read_tensors(path)
    if header.get("kind") == "agent" and "algorithm" in header:
        fit(AgentHeader, header, str(path))
        if (stage := header.get("stage", AGENT)) != AGENT:
            raise RunError(
                f"{path} holds the policy of stage {shown(stage)} alone; write the whole "
                "hierarchy's weights: skillweave weights RUN"
            )
        return tensors, header
    if header.get("kind") != "hierarchy":
        raise RunError(
            f"{path} holds something of kind {short(header.get('kind'))}, not a hierarchy"
        )
    fit(HierarchyHeader, header, str(path))
    return tensors, header


def read_agent(
    spec: EnvSpec, tensors: dict[str, Tensor], header: dict[str, Any], path: Path
) -> AgentPolicy:
    """A plain agent from what ``open_weights`` found in ``path``.

    Raises:
        RunError: the file is damaged, or belongs to another environment.
    """
    if header["kind"] != "agent":
        raise RunError(f"{path} holds something of kind {short(header['kind'])}, not a plain agent")
    if (env := header.get("env", spec.name)) != spec.name:
        raise RunError(f"{path} is of an agent on {shown(env)}, but this is on {spec.name}")
    return AgentPolicy.from_file(tensors, header, str(path))


def read_weights(declaration: Declaration, path: Path) -> HierarchyPolicy | AgentPolicy:
    """The inverse of ``write_weights``; the declaration takes over the file's call length.

    Raises:
        RunError: the file is damaged, or belongs to other skills or another environment.
    """
    tensors, header = open_weights(path)
    if header["kind"] == "agent":
        return read_agent(declaration.spec, tensors, header, path)
    skills = dict(every_skill(declaration.skills))
    names, inner = list(skills), {name for name, _ in every_hierarchy(declaration) if name}
    told = header["hierarchies"]
    if header["skills"] != names or header["env"] != declaration.spec.name or set(told) != inner:
        theirs = ", ".join(header["skills"])
        raise RunError(
            f"{path} is of skills {theirs[:300]} on {header['env'][:100]}, but the "
            f"hierarchy has {', '.join(names)} on {declaration.spec.name}"
        )

    def part(name: str) -> AgentPolicy:
        own = {k[len(name) + 1 :]: v for k, v in tensors.items() if k.startswith(f"{name}/")}
        if name not in header["parts"]:
            raise RunError(f"{path} holds no weights of {name!r}")
        return AgentPolicy.from_file(own, header["parts"][name], f"{path} ({name})")

    def copied(name: str) -> bytes | None:
        content = tensors.get(f"{name}/content")
        return None if content is None else content.contiguous().numpy().tobytes()

    found: dict[str, Policy] = {}
    ready, recorded = declaration.ready_policies(), header["ready"]
    for name, policy in ready.items():
        read, where = partial(copied, name), f"{path}: skill {name!r}"
        found[name] = as_recorded(policy, recorded.get(name), read, where)
    for name, own in every_hierarchy(declaration):
        node, where = f"{name}/" if name else "", f"{path}: {name}" if name else str(path)
        how = told[name] if name else header
        adopt_calls(own, how)
        check_selector(own.ready_selector is not None, node + SELECTOR in recorded, where)
        for other in [SELECTOR, *([CRITIC] if own.together.interrupt else [])]:
            if node + other not in recorded:
                found[node + other] = part(node + other)
        _check_guide(own, how.get("guide"), where)
    for name, policy in declaration.ready_selectors().items():
        found[name] = as_recorded(policy, recorded[name], lambda: None, f"{path}: the {name}")
    for name, skill in skills.items():
        if skill.policy is None:
            found[name] = part(name)
    whole = assembled(declaration, found)
    check_parts(declaration, whole, str(path))
    return whole


def _check_guide(declaration: Declaration, told: dict[str, Any] | None, where: str) -> None:
    """Raise a RunError where the selector was trained under another guide."""
    guide = _restricting(declaration)
    check_guided(guide is not None, told is not None, where)
    if guide is not None:
        as_recorded(guide, told, lambda: None, f"{where}: the guide")


def adopt_calls(declaration: Declaration, told: Mapping[str, Any]) -> None:
    """Take over how a hierarchy calls its skills."""
    declaration.call_steps = calls_from_json(told)
    kinds = {name: told[name] for name in ("greedy_skills", "greedy_selector")}
    declaration.selection = replace(declaration.selection, **kinds)
    margin = told.get("interrupt")
    declaration.together = replace(declaration.together, interrupt=margin is not None)
    if margin is not None:
        declaration.together = replace(declaration.together, margin=margin)


def check_selector(mine: bool, theirs: bool, where: str) -> None:
    """Raise a RunError where of two selectors one is ready and the other is trained."""
    if mine != theirs:
        kinds = ("a trained selector", "a ready one (a function, an automaton or a tree)")
        raise RunError(
            f"{where} has {kinds[theirs]}, but this hierarchy has {kinds[mine]}: declare the "
            "selector as it was, or train anew"
        )


def check_parts(declaration: Declaration, policy: HierarchyPolicy, where: str) -> None:
    """Raise a RunError where a policy is not of the spaces that its place asks for.

    Selectors choose among their skills; skills all see and do what the first of them does.
    """
    first = policy.skills.policies[0]
    wanted = {"observation_space": first.observation_space, "action_space": first.action_space}
    _check_parts(declaration, policy, wanted, where, "")


def _check_parts(
    declaration: Declaration,
    policy: HierarchyPolicy,
    wanted: dict[str, gym.Space[Any]],
    where: str,
    path: str,
) -> None:
    choices = gym.spaces.Discrete(declaration.choices)
    places = {SELECTOR: (policy.selector, wanted | {"action_space": choices})}
    for skill, own in zip(declaration.skills, policy.skills.policies, strict=True):
        places[skill.name] = own, wanted
        if (inner := inner_of(skill)) is not None:
            assert isinstance(own, HierarchyPolicy)
            _check_parts(inner, own, wanted, where, f"{path}{skill.name}/")
    for name, (own, spaces) in places.items():
        for kind, space in spaces.items():
            found = getattr(own, kind)
            if not same_space(found, space):
                raise RunError(
                    f"{where}: the policy in the place of {path + name!r} has {kind} "
                    f"{shown(found)}, but {shown(space)} belongs there"
                )
