"""A whole hierarchy's weights as one file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from skillweave._internal.messages import short
from skillweave._internal.paths import AGENT, below, join, level_of
from skillweave._internal.policy_protocol import Policy
from skillweave.algorithms.agent_policy import AgentHeader, AgentPolicy
from skillweave.envs.make import EnvSpec
from skillweave.errors import RunError
from skillweave.hierarchy.assembly import assembled, own_parts_of, parts_of
from skillweave.hierarchy.fitting import ready_policies, ready_selectors
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.recorded import (
    check_guided,
    check_same_part,
    check_selector,
    level_entry,
    skill_entries,
    with_entry,
)
from skillweave.hierarchy.roles import Level, Roles
from skillweave.policies.untrusted import shown
from skillweave.runs.files import LARGEST_WEIGHTS, read_tensors, record_in, write_tensors
from skillweave.runs.manifest import GuideEntry, Recorded
from skillweave.runs.user_code import environment_texts, notice_changes
from skillweave.skills.foreign_policy import Foreign, as_recorded
from skillweave.skills.goal_spaces import goal_part, other_goals, with_goal, without_goal
from skillweave.spaces import same_space


@dataclass(kw_only=True)
class HierarchyHeader(Recorded):
    """The header of the file of a hierarchy's weights."""

    kind: Literal["hierarchy"] = "hierarchy"
    parts: dict[str, AgentHeader]
    """The headers of trained policies, by path."""


def write_agent(path: Path, spec: EnvSpec, policy: AgentPolicy) -> None:
    """Write the weights of a plain agent on the environment ``spec``."""
    weights, header = policy.to_file()
    write_tensors(path, weights, replace(header, **_place(spec), code=environment_texts(spec)))


def _place(spec: EnvSpec) -> dict[str, Any]:
    """Return the fields of a weights file's header that name its environment."""
    return {"env": spec.name, "env_kwargs": spec.json_kwargs}


def write_weights(
    path: Path, roles: Roles, policy: HierarchyPolicy, recipe: str | None = None
) -> None:
    """Write the weights of skills and selectors.

    Ready policies are written in as far as a run copies them.

    Args:
        roles: of the policy.
        recipe: the place of the declaration.
    """
    parts = parts_of(roles, policy)
    tensors: dict[str, Tensor] = {}
    trained: dict[str, AgentHeader] = {}
    ready: dict[str, Policy] = {}
    for name, part in parts.items():
        if name in roles.levels:
            continue
        role = roles[name]
        if role.config is not None or role.kind == "critic":
            assert isinstance(part, AgentPolicy)
            weights, trained[name] = part.to_file()
            tensors |= {join(name, k): v for k, v in weights.items()}
        else:
            ready[name] = part
            tensors |= _content_of(part, name)
    for name, own_part in own_parts_of(roles, policy).items():
        if own_part.base is not None:
            ready[name] = own_part.base
            tensors |= _content_of(own_part.base, f"{name}.base")

    def decided(level: Level) -> Level:
        """Return a level's settings with its policy's choice of greedy or sampling."""
        # The policy records whether skills and selector are greedy, if the level leaves it open.
        whole = parts[level.path]
        assert isinstance(whole, HierarchyPolicy)
        greedy, selector = whole.skills.greedy, whole.skills.greedy_selector
        selection = replace(level.selection, greedy_skills=greedy, greedy_selector=selector)
        return replace(level, selection=selection)

    roles = roles.changed(decided)
    header = HierarchyHeader(
        **_place(roles.spec),
        code=roles.code,
        recipe=recipe,
        hierarchy=level_entry(roles, roles.outermost),
        skills=skill_entries(roles, ready),
        parts=trained,
    )
    write_tensors(path, tensors, header)


def _content_of(policy: Policy, name: str) -> dict[str, Tensor]:
    """Return the content of a ready policy as a tensor of a weights file; {}: it has none."""
    if not isinstance(policy, Foreign) or (content := policy.content()) is None:
        return {}
    numbers = np.frombuffer(content, np.uint8)
    return {join(name, "content"): torch.tensor(numbers, device="cpu")}


def open_weights(path: Path) -> tuple[dict[str, Tensor], AgentHeader | HierarchyHeader]:
    """Return the tensors and the header of a file of a hierarchy's or a plain agent's weights.

    Raises:
        RunError: the file is damaged, or of another kind.
    """
    tensors, header = read_tensors(path, 8 * LARGEST_WEIGHTS)
    kind = header.get("kind")
    if kind == "agent" and "algorithm" in header:
        agent: AgentHeader = record_in(AgentHeader, header, path)
        if agent.stage not in (None, AGENT):
            raise RunError(
                f"{path} holds the policy of stage {shown(agent.stage)} alone; write the whole "
                "hierarchy's weights: skillweave weights RUN"
            )
        return tensors, agent
    if kind != "hierarchy":
        raise RunError(f"{path} holds something of kind {short(kind)}, not a hierarchy")
    return tensors, record_in(HierarchyHeader, header, path)


def read_agent(
    spec: EnvSpec, tensors: dict[str, Tensor], header: AgentHeader | HierarchyHeader, path: Path
) -> AgentPolicy:
    """Return a plain agent from the tensors and header that ``open_weights`` read.

    Raises:
        RunError: the file is damaged, or belongs to another environment.
    """
    if isinstance(header, HierarchyHeader):
        raise RunError(f"{path} holds something of kind {short(header.kind)}, not a plain agent")
    if header.env not in (None, spec.name):
        raise RunError(f"{path} is of an agent on {shown(header.env)}, but this is on {spec.name}")
    notice_changes(header.code, environment_texts(spec), f"{path} was written")
    return AgentPolicy.from_file(tensors, header, str(path))


def read_weights(
    roles: Roles, tensors: dict[str, Tensor], header: HierarchyHeader, path: Path
) -> tuple[Roles, HierarchyPolicy]:
    """Return a hierarchy's policy, and its roles with the file's settings.

    Args:
        roles: as declared.
        tensors, header: as ``open_weights`` read them from ``path``.

    Raises:
        RunError: the file is damaged, or belongs to other skills or another environment.
    """
    levels, skills = header.levels, header.by_path
    if (
        list(skills) != list(roles.skills)
        or header.env != roles.spec.name
        or set(levels) != set(roles.levels)
    ):
        raise RunError(
            f"{path} is of skills {', '.join(skills)[:300]} on {header.env[:100]}, but the "
            f"hierarchy has {', '.join(roles.skills)} on {roles.spec.name}"
        )
    notice_changes(header.code, roles.code, f"{path} was written")
    for entry in header.skills:
        check_same_part(roles, entry, str(path))
    for level in roles.levels.values():
        where = f"{path}: {level.path}" if level.path else str(path)
        recorded = levels[level.path]
        check_selector(level.ready_selector is not None, recorded.selector is not None, where)
        _check_guide(level, recorded.guide, where)
    roles = roles.changed(lambda level: with_entry(level, levels[level.path]))

    def restored(name: str, policy: Policy, content: str) -> Policy:
        read = partial(_content, tensors, content)
        return as_recorded(policy, skills[name].policy, read, f"{path}: skill {name!r}")

    roles = roles.with_bases(lambda name, base: restored(name, base, f"{name}.base"))
    policies = {name: restored(name, x, name) for name, x in ready_policies(roles).items()}
    for name, policy in ready_selectors(roles).items():
        source = levels[level_of(name)].selector
        policies[name] = as_recorded(policy, source, lambda: None, f"{path}: the {name}")
    for name, role in roles.by_path.items():
        if role.config is not None or role.margin is not None:
            if name not in header.parts:
                raise RunError(f"{path} holds no weights of {name!r}")
            weights = below(tensors, name)
            part = header.parts[name]
            policies[name] = AgentPolicy.from_file(weights, part, f"{path} ({name})")
    policy = assembled(roles, policies)
    check_parts(roles, policy, str(path))
    return roles, policy


def _content(tensors: Mapping[str, Tensor], name: str) -> bytes | None:
    """Return the content of a ready policy in a weights file, by its name; None: it has none."""
    copied = tensors.get(join(name, "content"))
    return None if copied is None else copied.contiguous().numpy().tobytes()


def _check_guide(level: Level, recorded: GuideEntry | None, where: str) -> None:
    """Raise a RunError where the selector was restricted by another guide."""
    guide = level.restricting_guide
    source = recorded.source if recorded is not None and recorded.restrict else None
    check_guided(guide is not None, source is not None, where)
    if guide is not None:
        as_recorded(guide, source, lambda: None, f"{where}: the guide")


def check_parts(roles: Roles, policy: HierarchyPolicy, where: str) -> None:
    """Raise a RunError where a part of a hierarchy's policy has not the spaces of its place.

    Selectors choose among their skills; all skills have the spaces of the first, or a part of the
    environment's. Without parts the environment is not needed.
    """
    first = policy.skills.policies[0]
    whole = policy.skills.part(0)
    seen, acts = first.observation_space, policy.action_space
    if whole is not None:
        seen = whole.whole_observation_space
    elif next(iter(roles.skills.values())).goal_space is not None:
        seen = without_goal(seen)
    for path, part in parts_of(roles, policy).items():
        role = roles.by_path.get(path)
        if role is None:
            continue
        if role.kind == "critic":
            critic: Any = part
            if not getattr(critic.algorithm.config, "deciding", False):
                raise RunError(
                    f"{where}: {path!r} has not learnt what a new decision is worth, which "
                    "hierarchy.interrupt needs"
                )
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
