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
    """Write the weights of skills and selector, or of a plain agent.

    Ready policies are written in as far as a run copies them.
    """
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
    for name, trained, part in _parts_of(declaration, policy):
        if trained:
            assert isinstance(part, AgentPolicy)
            weights, parts[name] = part.to_file()
            tensors |= {f"{name}/{k}": v for k, v in weights.items()}
            continue
        ready[name] = source_of(part)
        if isinstance(part, Foreign) and (content := part.content()) is not None:
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
    """Yield all policies of a hierarchy as (path, trained in it, policy)."""
    trained = not isinstance(policy.selector, ReadySelector)
    yield path + SELECTOR, trained, policy.selector
    interruption = policy.skills.interruption
    if interruption is not None and interruption.critic is not None:
        yield path + CRITIC, True, interruption.critic
    for skill, of_skill in zip(declaration.skills, policy.skills.policies, strict=True):
        inner = inner_of(skill)
        if inner is None:
            yield path + skill.name, skill.policy is None, of_skill
        else:
            assert isinstance(of_skill, HierarchyPolicy)
            yield from _parts_of(inner, of_skill, f"{path}{skill.name}/")


def _hierarchies_of(
    declaration: Declaration, policy: HierarchyPolicy, path: str = ""
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the headers of a hierarchy and of those below it, by path."""
    yield path, _calls_header(declaration, policy)
    for skill, of_skill in zip(declaration.skills, policy.skills.policies, strict=True):
        if (inner := inner_of(skill)) is not None:
            assert isinstance(of_skill, HierarchyPolicy)
            yield from _hierarchies_of(inner, of_skill, f"{path}/{skill.name}".removeprefix("/"))


def _calls_header(declaration: Declaration, policy: HierarchyPolicy) -> dict[str, Any]:
    """Return the header entries of a hierarchy's way to call its skills."""
    guide = _restricting(declaration)
    return {
        **calls_to_json(declaration.call_steps),
        "interrupt": declaration.together.margin if declaration.together.interrupt else None,
        "greedy_skills": policy.skills.greedy,
        "greedy_selector": policy.skills.greedy_selector,
        **({} if guide is None else {"guide": source_of(guide)}),
    }


def _restricting(declaration: Declaration) -> ReadySelector | None:
    """Return the guide that restricts the selector; None: it has none."""
    guide = declaration.guide
    return ready_guide(declaration) if guide is not None and guide.restrict else None


class InnerHeader(TypedDict):
    """Header entries of a hierarchy's way to call its skills."""

    call_steps: AtLeastOne | None
    call_lengths: NotRequired[list[AtLeastOne]]
    interrupt: NotRequired[NonNegative | None]
    greedy_skills: bool
    greedy_selector: bool
    guide: NotRequired[Source]
    """The source of the ready selector that restricts the trained one."""


class HierarchyHeader(InnerHeader):
    """Header of the file of a hierarchy's weights."""

    kind: str
    env: str
    env_kwargs: dict[str, Any]
    recipe: str | None
    skills: list[str]
    parts: dict[str, dict[str, Any]]
    ready: dict[str, Source]
    """Sources of ready skills and selectors, by path."""
    hierarchies: dict[str, InnerHeader]
    """Headers of skills that are hierarchies, by path; their own skills are in ``skills``, too."""


def open_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return the tensors and the header of a file of a hierarchy's or a plain agent's weights.

    Raises:
        RunError: the file is damaged, or of another kind.
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
    """Return a plain agent from the tensors and header that ``open_weights`` read.

    Raises:
        RunError: the file is damaged, or belongs to another environment.
    """
    if header["kind"] != "agent":
        raise RunError(f"{path} holds something of kind {short(header['kind'])}, not a plain agent")
    if (env := header.get("env", spec.name)) != spec.name:
        raise RunError(f"{path} is of an agent on {shown(env)}, but this is on {spec.name}")
    return AgentPolicy.from_file(tensors, header, str(path))


def read_weights(declaration: Declaration, path: Path) -> HierarchyPolicy | AgentPolicy:
    """Return the policy that ``write_weights`` wrote; apply the file's call settings.

    Raises:
        RunError: the file is damaged, or belongs to other skills or another environment.
    """
    tensors, header = open_weights(path)
    if header["kind"] == "agent":
        return read_agent(declaration.spec, tensors, header, path)
    skills = dict(every_skill(declaration.skills))
    names = list(skills)
    inner = {name for name, _ in every_hierarchy(declaration) if name}
    inner_headers = header["hierarchies"]
    if (
        header["skills"] != names
        or header["env"] != declaration.spec.name
        or set(inner_headers) != inner
    ):
        recorded_skills = ", ".join(header["skills"])
        raise RunError(
            f"{path} is of skills {recorded_skills[:300]} on {header['env'][:100]}, but the "
            f"hierarchy has {', '.join(names)} on {declaration.spec.name}"
        )

    def part(name: str) -> AgentPolicy:
        weights = {k[len(name) + 1 :]: v for k, v in tensors.items() if k.startswith(f"{name}/")}
        if name not in header["parts"]:
            raise RunError(f"{path} holds no weights of {name!r}")
        return AgentPolicy.from_file(weights, header["parts"][name], f"{path} ({name})")

    def copied(name: str) -> bytes | None:
        content = tensors.get(f"{name}/content")
        return None if content is None else content.contiguous().numpy().tobytes()

    policies: dict[str, Policy] = {}
    ready = declaration.ready_policies()
    recorded = header["ready"]
    for name, policy in ready.items():
        read = partial(copied, name)
        where = f"{path}: skill {name!r}"
        policies[name] = as_recorded(policy, recorded.get(name), read, where)
    for name, hierarchy in every_hierarchy(declaration):
        node = f"{name}/" if name else ""
        where = f"{path}: {name}" if name else str(path)
        entry = inner_headers[name] if name else header
        adopt_calls(hierarchy, entry)
        check_selector(hierarchy.ready_selector is not None, node + SELECTOR in recorded, where)
        for other in [SELECTOR, *([CRITIC] if hierarchy.together.interrupt else [])]:
            if node + other not in recorded:
                policies[node + other] = part(node + other)
        _check_guide(hierarchy, entry.get("guide"), where)
    for name, policy in declaration.ready_selectors().items():
        policies[name] = as_recorded(policy, recorded[name], lambda: None, f"{path}: the {name}")
    for name, skill in skills.items():
        if skill.policy is None:
            policies[name] = part(name)
    whole = assembled(declaration, policies)
    check_parts(declaration, whole, str(path))
    return whole


def _check_guide(declaration: Declaration, source: dict[str, Any] | None, where: str) -> None:
    """Raise a RunError where the selector was trained under another guide."""
    guide = _restricting(declaration)
    check_guided(guide is not None, source is not None, where)
    if guide is not None:
        as_recorded(guide, source, lambda: None, f"{where}: the guide")


def adopt_calls(declaration: Declaration, entry: Mapping[str, Any]) -> None:
    """Apply a recorded way to call skills to a hierarchy."""
    declaration.call_steps = calls_from_json(entry)
    kinds = {name: entry[name] for name in ("greedy_skills", "greedy_selector")}
    declaration.selection = replace(declaration.selection, **kinds)
    margin = entry.get("interrupt")
    declaration.together = replace(declaration.together, interrupt=margin is not None)
    if margin is not None:
        declaration.together = replace(declaration.together, margin=margin)


def check_selector(is_ready: bool, recorded: bool, where: str) -> None:
    """Raise a RunError where one selector is ready and the other is trained."""
    if is_ready != recorded:
        kinds = ("a trained selector", "a ready one (a function, an automaton or a tree)")
        raise RunError(
            f"{where} has {kinds[recorded]}, but this hierarchy has {kinds[is_ready]}: declare the "
            "selector as it was, or train again"
        )


def check_parts(declaration: Declaration, policy: HierarchyPolicy, where: str) -> None:
    """Raise a RunError where a policy has not the spaces of its place.

    Selectors choose among their skills; all skills have the spaces of the first.
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
    for skill, of_skill in zip(declaration.skills, policy.skills.policies, strict=True):
        places[skill.name] = of_skill, wanted
        if (inner := inner_of(skill)) is not None:
            assert isinstance(of_skill, HierarchyPolicy)
            _check_parts(inner, of_skill, wanted, where, f"{path}{skill.name}/")
    for name, (part, spaces) in places.items():
        for kind, space in spaces.items():
            actual = getattr(part, kind)
            if not same_space(actual, space):
                raise RunError(
                    f"{where}: the policy in the place of {path + name!r} has {kind} "
                    f"{shown(actual)}, but {shown(space)} belongs there"
                )
