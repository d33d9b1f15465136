"""A hierarchy whose selector is a planner, in an environment that is scored by its task."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from skillweave._internal.messages import short
from skillweave._internal.paths import SELECTOR
from skillweave._internal.policy_protocol import Policy
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.config import PPO
from skillweave.api.task_views import OwnSelector, own_skills
from skillweave.calls import successes
from skillweave.calls.log import seen_places
from skillweave.calls.neighbors import FEATURES
from skillweave.calls.predicates import WORD
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError
from skillweave.experience.decisions import as_logits
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.settings import Guide, Selection
from skillweave.planning import Planner
from skillweave.planning.mission import RESERVED
from skillweave.planning.task_env import OwnView, Tasked
from skillweave.runs.initial_policies import Learnt
from skillweave.skills.skill_set import skills_below
from skillweave.spaces import obs_codec
from skillweave.training.imitation import imitate

D = TypeVar("D", bound=Declaration)


def planned(declared: D, policy: Policy, planner: Planner) -> tuple[D, HierarchyPolicy]:
    """Return a hierarchy and its policy with a planner in place of the outermost selector.

    Its environment has the task's reward and ends, so that evaluations, films and players are about
    the task. The selector's guide, interruption and target are left out: they belong to its
    training.
    """
    assert isinstance(policy, HierarchyPolicy)
    skills = replace(policy.skills, interruption=None)
    spaces = policy.selector.observation_space, skills.choice_space
    selector: Any = planner.among(tuple(s.name for s in skills.skills)).bind(*spaces, SELECTOR)
    hierarchy = copy.copy(declared)
    spec = untasked(declared.spec)
    hierarchy.env = tasked(spec, planner)
    hierarchy.selector = planner
    hierarchy.guide = None
    hierarchy.together = replace(declared.together, interrupt=False)
    hierarchy.selection = replace(declared.selection, target_return=None)
    return hierarchy, HierarchyPolicy(selector, skills)


def tasked(spec: EnvSpec, planner: Planner, *, observe: bool = False) -> EnvSpec:
    """Return an environment that is scored by a planner's task; see ``TaskEnv``."""
    wrapper = Tasked(planner.task, observe)
    # A pool would make the environment without its task.
    return replace(spec, wrappers=(*spec.wrappers, wrapper), engine="sync", pool=None)


def to_train(
    spec: EnvSpec,
    policy: HierarchyPolicy,
    planner: Planner,
    rest: Any,
    algorithm: Any,
    target_kl: float | None,
) -> dict[str, Any]:
    """Return arguments of a ``Hierarchy`` whose selector is trained on a planner's task.

    Args:
        spec: the environment without the task.
        policy: with the skills.
        planner: guides the selector.
        rest: the hierarchy's, of the actions that skills write a part of.
        algorithm: settings of PPO, by which the selector learns.
        target_kl: the KL within which it stays of the plan; None: without limit.
    """
    if not isinstance(algorithm, PPO):
        raise DeclarationError(
            f"with_selector(): algorithm is {short(algorithm)}; only a selector that learns by PPO "
            "can start from a plan: PPO()"
        )
    observed = tasked(spec, planner, observe=True)
    view = OwnView(spec.spaces.observation)
    skills = own_skills(replace(policy.skills, interruption=None), view, observed.spaces[0])
    guide = None
    # A guide says nothing about goals, so one of a single skill would say nothing at all.
    if target_kl is not None and (policy.skills.choices > 1 or not planner.log.goals):
        guide = Guide(OwnSelector(planner, view), restrict=False, target_kl=target_kl)
    return {
        "env": observed,
        "skills": list(skills.skills),
        "call_steps": skills.call_steps,
        "selector": algorithm,
        "rest": rest,
        "reflexes": skills.reflexes,
        "selection": Selection(
            deliberation_cost=skills.deliberation_cost, greedy_skills=skills.greedy
        ),
        "guide": guide,
    }


PAIRS = 10_000
"""The observations, each with a state of the task, by which a selector learns to act as a plan."""
GOALS = 64
"""The goals that they have, where observations hold goals."""


def start_of(
    planner: Planner, policy: HierarchyPolicy, spec: EnvSpec, config: PPO
) -> dict[str, Learnt]:
    """Return the policy with which a selector starts, by its path: it chooses as the plan does.

    It learns the plan's choices in logged observations, with states of the task drawn at random.

    Args:
        planner: with its log.
        policy: with the skills.
        spec: the environment whose observations hold the task's state.
        config: settings of the selector.
    """
    seeds = Seeds(0) / "plan"
    log = planner.log
    obs, state = planner.situations(PAIRS, GOALS, (seeds / "pairs").numpy())
    may = policy.skills.hierarchy.may_start(obs)
    may |= ~may.any(axis=1, keepdims=True)
    chosen, call = planner.choices(obs, state, may)
    chances = np.exp(as_logits(np.eye(log.choices, dtype=np.float32)[chosen], may)) * may
    view = OwnView(log.observation_space)
    seen = view.joined(obs, planner.machine.observe(state))
    with_goals = None
    if log.goals:
        space = policy.skills.choice_space
        bound = planner.among(log.skills).bind(log.observation_space, space, SELECTOR)
        with_goals = space, bound.in_place.record(chosen, call, obs)
    selector = imitate(config, seen, may, chances, spec.spaces.observation, seeds, with_goals)
    names = tuple(skill.name for skill in policy.skills.skills)
    sha256 = selector.source()["sha256"]
    return {SELECTOR: Learnt(selector, sha256, log.steps, "the plan", None, (names, log.lengths))}


def mission_words(declared: Declaration, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the predicates that a mission's text may name.

    They are the skills' successes by their names, the declaration's own, and those given, which
    replace others of their names.
    """
    own = {
        name: success
        for name, success in successes(declared.skills).items()
        if name not in RESERVED and re.fullmatch(WORD, name)
    }
    return {**own, **declared.predicates, **given}


def lacking_features(declared: Declaration, policy: Policy, skill: str | None = None) -> str:
    """Return a sentence if skills see images, by which calls cannot be compared; it may be empty.

    Args:
        policy: with the skills, of the whole hierarchy or of one level.
        skill: the name of the one that counts; None: all do.
    """
    skills = skills_below(policy)
    features = declared.features
    if skills is None or not obs_codec(declared.spec.spaces.observation).images:
        return ""
    for one, places in zip(skills.skills, seen_places(skills), strict=True):
        own = features.get(one.name) if isinstance(features, Mapping) else features
        if places is None and own is None and skill in (None, one.name):
            return f"calls of {one.name!r} cannot be compared by images; {FEATURES}"
    return ""


def untasked(spec: EnvSpec) -> EnvSpec:
    """Return an environment without the score of a planned task."""
    return replace(spec, wrappers=tuple(w for w in spec.wrappers if not isinstance(w, Tasked)))
