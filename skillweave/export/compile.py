"""A policy that acts here as one of plain data, with its networks as ONNX files."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from skillweave._internal.policy_protocol import Policy
from skillweave.algorithms.agent_policy import AgentPolicy, TrainedNetwork
from skillweave.errors import PolicyError
from skillweave.export.foreign import as_file
from skillweave.export.graphs import agent_graph, worth_graph
from skillweave.policies.actor import Deployed
from skillweave.policies.core import Around, RowPolicy
from skillweave.policies.functional import Returns
from skillweave.policies.hierarchy import (
    ActiveGuide,
    CallAndReturn,
    CalledSkill,
    CallGoals,
    Critic,
    Interruption,
)
from skillweave.policies.leaves import OnnxNetwork, Selector
from skillweave.policies.mapped import Function, Mapped, Outputs
from skillweave.policies.parts import Corrects, PartOf, Viewed
from skillweave.policies.planned import Planned
from skillweave.policies.spaces import Space, space_of
from skillweave.skills.goals import Goals
from skillweave.skills.skill_set import in_place


def deployed(policy: Policy) -> Deployed:
    """Return a policy of plain data, which acts the same.

    Raises:
        PolicyError: a part of it cannot be exported; the message names it, and what to do.
        MissingExtra: the packages that write ONNX are not installed.
    """
    spaces = policy.observation_space, policy.action_space
    sees, acts = map(space_of, spaces)
    return Deployed(_compiled(in_place(policy), "", sampled=False), sees, acts)


def _compiled(policy: RowPolicy, name: str, *, sampled: bool) -> RowPolicy:
    """Return a policy as plain data, with its networks as ONNX files.

    Args:
        name: its path: ``landing``, or ``outer/landing`` for a skill in a nested hierarchy.
        sampled: it samples; else it is greedy.
    """
    where = f"the policy of {name!r}" if name else "the policy"
    match policy:
        case CallAndReturn():
            return _hierarchy(policy, f"{name}/" if name else "", sampled)
        case Viewed() | PartOf() if isinstance(policy, Viewed) or policy.part.view is not None:
            raise PolicyError(
                f"{where} acts where observations hold the state of a task, which no runner "
                "follows: export the run that its skills are from"
            )
        case Around():
            made = replace(policy, policy=_compiled(policy.policy, name, sampled=sampled))
            if isinstance(made, Corrects):
                made.base = _compiled(made.base, f"{name}.base", sampled=False)
            return made
        case Mapped():
            return as_file(policy, where, sampled=sampled)
        case TrainedNetwork():
            return agent_graph(policy.agent, sampled, where)
        case Returns():
            return _function(policy, where)
        case Planned() if type(policy) is not Planned:
            raise PolicyError(
                f"{name} plans again for each goal that it observes, which the runner does not: "
                "export a plan of one goal, GoalTask(reached, goal=[...]), or train a selector"
            )
    return policy


def _function(policy: Returns, where: str) -> RowPolicy:
    """Return a user's policy for an export: a function without a memory."""
    inside = policy.policy
    if inside.start(1):
        kind = type(inside).__name__
        raise PolicyError(
            f"{where} is a {kind}, whose memory cannot be written as ONNX: train the skill, or "
            "give it an ONNX file"
        )
    space = space_of(inside.action_space)
    return Mapped(Function(partial(_actions, inside)), Outputs(space, logits=False))


def _actions(policy: Policy, obs: Any) -> Any:
    return policy.act({}, obs)[0]


def _hierarchy(policy: CallAndReturn, prefix: str, sampled: bool) -> CallAndReturn:
    """Return a hierarchy's policy for an export: its networks are ONNX files."""
    guide = policy.guide
    if guide is not None:
        of = _compiled(guide.selector, f"{prefix}guide", sampled=False)
        guide = ActiveGuide(of, guide.restricts)
    samples = sampled or not policy.greedy_selector
    assert policy.selector is not None
    ready = (policy.selector, None if guide is None else guide.selector)
    knows = any(isinstance(x, Selector) and x.ends_matter for x in ready)
    return CallAndReturn(
        _compiled(policy.selector, f"{prefix}selector", sampled=samples),
        tuple(_skill(one, prefix, knows, sampled=not policy.greedy) for one in policy.skills),
        policy.lengths,
        guide,
        _interruption(policy.interruption, prefix),
        policy.fresh_calls,
        policy.greedy,
        policy.greedy_selector,
    )


def _skill(skill: CalledSkill, prefix: str, knows: bool, *, sampled: bool) -> CalledSkill:
    """Return a skill for export; ``knows``: its selector knows whether calls have succeeded."""
    goals = skill.goals
    if isinstance(goals, Goals):
        clip = goals.skill.clip_goal if goals.skill.defines("clip_goal") else None
        goals = CallGoals(skill.path, goals.space, clip)
    inside = _compiled(skill.policy, prefix + skill.name, sampled=sampled)
    success = skill.success if knows else None
    return replace(skill, policy=inside, goals=goals, success=success)


def _interruption(how: Interruption | None, prefix: str) -> Interruption | None:
    """Return the rule of interruption for an export, with the skill critic as an ONNX file."""
    if how is None or isinstance(how.worth, Critic):
        return how
    if not isinstance(how.critic, AgentPolicy):
        raise PolicyError(f"the critic of {prefix or 'the selector'} is not trained")
    sees = space_of(how.critic.observation_space)
    file = worth_graph(how.critic, "the skill critic")
    values = int(how.critic.heads(sees.start(1)).shape[1])
    worth = Space("Box", "float32", (values,), np.array(-np.inf), np.array(np.inf))
    return Interruption(Critic(OnnxNetwork(file, sees, worth)), how.margin)
