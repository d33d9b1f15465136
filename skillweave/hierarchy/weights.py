"""A whole hierarchy's weights as one file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.policy import AgentHeader, AgentPolicy
from skillweave.collecting.lengths import calls_from_json, calls_to_json
from skillweave.collecting.user_code import Texts, environment_texts, notice_changes
from skillweave.envs.make import EnvSpec
from skillweave.errors import RunError
from skillweave.hierarchy.assembly import assembled, own_parts_of, parts_of
from skillweave.hierarchy.fitting import ready_policies, ready_selectors
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.roles import Level, Roles
from skillweave.messages import short
from skillweave.paths import AGENT, below, join
from skillweave.policies.files import shown
from skillweave.runs.files import read_tensors, write_tensors
from skillweave.schema import AtLeastOne, NonNegative, fit
from skillweave.skills.foreign_policy import Foreign, Source, as_recorded, source_of
from skillweave.skills.goal_spaces import goal_part, other_goals, with_goal, without_goal
from skillweave.skills.own_part import part_to_json
from skillweave.spaces import same_space
from skillweave.types import Policy


def write_agent(path: Path, spec: EnvSpec, policy: AgentPolicy) -> None:
    """Write the weights of a plain agent on the environment ``spec``."""
    weights, description = policy.to_file()
    write_tensors(path, weights, description | _place(spec, environment_texts(spec)))


def write_weights(
    path: Path, roles: Roles, policy: HierarchyPolicy, recipe: str | None = None
) -> None:
    """Write the weights of skills and selectors.

    Ready policies are written in as far as a run copies them.

    Args:
        roles: of the policy.
        recipe: the place of the declaration.
    """
    tensors: dict[str, Tensor] = {}
    trained: dict[str, Any] = {}
    ready: dict[str, Any] = {}
    levels: dict[str, Any] = {}
    for name, part in parts_of(roles, policy).items():
        if name in roles.levels:
            assert isinstance(part, HierarchyPolicy)
            levels[name] = _calls_header(roles.levels[name], part)
            continue
        role = roles[name]
        if role.config is not None or role.kind == "critic":
            assert isinstance(part, AgentPolicy)
            weights, trained[name] = part.to_file()
            tensors |= {join(name, k): v for k, v in weights.items()}
            continue
        ready[name] = source_of(part)
        tensors |= _content_of(part, name)
    own = own_parts_of(roles, policy)
    for name, own_part in own.items():
        if own_part.base is not None:
            tensors |= _content_of(own_part.base, f"{name}.base")
    header = {
        "kind": "hierarchy",
        "recipe": recipe,
        **_place(roles.spec, roles.code),
        "skills": list(roles.skills),
        **levels.pop(""),
        "hierarchies": levels,
        **({"own_parts": {k: part.to_json() for k, part in own.items()}} if own else {}),
        "parts": trained,
        "ready": ready,
    }
    write_tensors(path, tensors, header)


def _content_of(policy: Policy, name: str) -> dict[str, Tensor]:
    """Return the content of a ready policy, under its name; {}: it has none."""
    if not isinstance(policy, Foreign) or (content := policy.content()) is None:
        return {}
    numbers = np.frombuffer(content, np.uint8)
    return {join(name, "content"): torch.tensor(numbers, device="cpu")}


def _place(spec: EnvSpec, code: Texts) -> dict[str, Any]:
    """Return the header entries of an environment, and the texts of it and of skills."""
    return {"env": spec.name, "env_kwargs": spec.json_kwargs, "code": code}


def _calls_header(level: Level, policy: HierarchyPolicy) -> dict[str, Any]:
    """Return the header entries of a level's way to call its skills.

    Its policy records whether these are greedy, where the level leaves it open.
    """
    guide = level.restricting_guide
    return {
        **calls_to_json(level.call_steps),
        "interrupt": level.together.margin if level.together.interrupt else None,
        "greedy_skills": policy.skills.greedy,
        "greedy_selector": policy.skills.greedy_selector,
        **({} if guide is None else {"guide": source_of(guide)}),
    }


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
    code: NotRequired[Texts]
    recipe: str | None
    skills: list[str]
    parts: dict[str, dict[str, Any]]
    own_parts: NotRequired[dict[str, dict[str, Any]]]
    """``sees``, ``acts`` and ``rest`` of skills that have a part of their own, by path; of those
    that correct a ready policy its source, ``policy``, and ``residual``, the scale."""
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
    notice_changes(header.get("code", {}), environment_texts(spec), f"{path} was written")
    return AgentPolicy.from_file(tensors, header, str(path))


def read_weights(
    roles: Roles, tensors: dict[str, Tensor], header: dict[str, Any], path: Path
) -> tuple[Roles, HierarchyPolicy]:
    """Return a hierarchy's policy, and its roles with the file's call settings.

    Args:
        roles: as declared.
        tensors, header: what ``open_weights`` read from ``path``.

    Raises:
        RunError: the file is damaged, or belongs to other skills or another environment.
    """
    levels = {"": header, **header["hierarchies"]}
    if (
        header["skills"] != list(roles.skills)
        or header["env"] != roles.spec.name
        or set(levels) != set(roles.levels)
    ):
        recorded_skills = ", ".join(header["skills"])
        raise RunError(
            f"{path} is of skills {recorded_skills[:300]} on {header['env'][:100]}, but the "
            f"hierarchy has {', '.join(roles.skills)} on {roles.spec.name}"
        )
    notice_changes(header.get("code", {}), roles.code, f"{path} was written")
    recorded_parts = header.get("own_parts", {})
    for name in roles.skills:
        check_same_part(roles, name, recorded_parts.get(name, {}), f"{path}: skill {name!r}")
    roles = roles.changed(lambda level: with_calls(level, levels[level.path]))
    roles = roles.with_bases(
        lambda name, base: as_recorded(
            base,
            recorded_parts[name].get("policy"),
            partial(_content, tensors, f"{name}.base"),
            f"{path}: skill {name!r}",
        )
    )
    policies = _ready_parts(roles, tensors, header, path)
    for level in roles.levels.values():
        where = f"{path}: {level.path}" if level.path else str(path)
        is_ready = level.ready_selector is not None
        check_selector(is_ready, level.selector_path in header["ready"], where)
        _check_guide(level, levels[level.path].get("guide"), where)
    for name, role in roles.by_path.items():
        if role.config is not None or role.margin is not None:
            if name not in header["parts"]:
                raise RunError(f"{path} holds no weights of {name!r}")
            weights = below(tensors, name)
            policies[name] = AgentPolicy.from_file(
                weights, header["parts"][name], f"{path} ({name})"
            )
    policy = assembled(roles, policies)
    check_parts(roles, policy, str(path))
    return roles, policy


def _ready_parts(
    roles: Roles, tensors: Mapping[str, Tensor], header: Mapping[str, Any], path: Path
) -> dict[str, Policy]:
    """Return the ready policies and selectors as they were when the file was written, by path."""
    recorded = header["ready"]
    policies: dict[str, Policy] = {}
    for name, policy in ready_policies(roles).items():
        where = f"{path}: skill {name!r}"
        content = partial(_content, tensors, name)
        policies[name] = as_recorded(policy, recorded.get(name), content, where)
    for name, policy in ready_selectors(roles).items():
        where = f"{path}: the {name}"
        policies[name] = as_recorded(policy, recorded.get(name), lambda: None, where)
    return policies


def check_same_part(roles: Roles, path: str, recorded: Mapping[str, Any], who: str) -> None:
    """Raise a RunError where a skill had another part of observations or actions.

    Args:
        recorded: its ``sees``, ``acts`` and ``rest``, where it had some.
    """
    declared = part_to_json(roles.skills[path], roles[path].rest, f"skill {path!r}")
    for field in ("sees", "acts", "rest", "residual"):
        then, now = recorded.get(field), declared.get(field)
        if then != now:
            raise RunError(
                f"{who} was trained with {field} {shown(then)}, but now it is {shown(now)}: "
                "declare it as it was, or train again"
            )


def _content(tensors: Mapping[str, Tensor], name: str) -> bytes | None:
    """Return the content of a ready policy under a name; None: the file has none."""
    copied = tensors.get(join(name, "content"))
    return None if copied is None else copied.contiguous().numpy().tobytes()


def with_calls(level: Level, entry: Mapping[str, Any]) -> Level:
    """Return a level that calls its skills as a file records it."""
    margin = entry.get("interrupt")
    together = replace(level.together, interrupt=margin is not None)
    if margin is not None:
        together = replace(together, margin=margin)
    selection = replace(
        level.selection,
        greedy_skills=entry["greedy_skills"],
        greedy_selector=entry["greedy_selector"],
    )
    return replace(level, call_steps=calls_from_json(entry), together=together, selection=selection)


def check_selector(is_ready: bool, recorded: bool, where: str) -> None:
    """Raise a RunError where one selector is ready and the other is trained."""
    if is_ready != recorded:
        kinds = ("a trained selector", "a ready one (a function, an automaton or a tree)")
        raise RunError(
            f"{where} has {kinds[recorded]}, but this hierarchy has {kinds[is_ready]}: declare the "
            "selector as it was, or train again"
        )


def _check_guide(level: Level, source: dict[str, Any] | None, where: str) -> None:
    """Raise a RunError where the selector was trained under another guide."""
    guide = level.restricting_guide
    check_guided(guide is not None, source is not None, where)
    if guide is not None:
        as_recorded(guide, source, lambda: None, f"{where}: the guide")


def check_guided(is_guided: bool, recorded: bool, where: str) -> None:
    """Raise a RunError where only one of two selectors has a guide."""
    if is_guided != recorded:
        has = ("no guide", "a guide")
        raise RunError(
            f"{where}: the selector has {has[recorded]}, but the selector of this hierarchy has "
            f"{has[is_guided]}: declare guide= as it was, or train again"
        )


def check_parts(roles: Roles, policy: HierarchyPolicy, where: str) -> None:
    """Raise a RunError where a policy has not the spaces of its place.

    Selectors choose among their skills; all skills have the spaces of the first, or a part of the
    environment's. Without parts the environment is not needed.
    """
    first, whole = policy.skills.policies[0], policy.skills.part(0)
    seen, acts = first.observation_space, policy.action_space
    if whole is not None:
        seen = whole.whole_observation_space
    elif next(iter(roles.skills.values())).goal_space is not None:
        seen = without_goal(seen)
    for path, part in parts_of(roles, policy).items():
        role = roles.by_path.get(path)
        if role is None or role.kind == "critic":
            continue
        action_space = acts if role.choices is None else role.action_space
        goal_space = role.own_goals if role.skill is None else role.skill.goal_space
        own = seen if goal_space is None else with_goal(seen, goal_space)
        if role.part is not None:
            own, action_space = role.observation_space, role.action_space
        spaces = {"observation_space": own, "action_space": action_space}
        for kind, space in spaces.items():
            actual = getattr(part, kind)
            if not same_space(actual, space):
                raise RunError(
                    f"{where}: the policy in the place of {path!r} has {kind} "
                    f"{shown(actual)}, but {shown(space)} belongs there"
                )
        if goal_space is None:
            continue
        if says := other_goals(goal_part(part.observation_space), goal_space):
            who = f"skill {path!r}" if role.skill is not None else repr(path)
            raise RunError(f"{where}: {who} {says}")
