"""Fit a hierarchy to its environment: algorithms, reflexes, and all that is ready to act."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import gymnasium as gym

from skillweave._internal.paths import join
from skillweave._internal.policy_protocol import Policy
from skillweave.algorithms.base import read_by
from skillweave.algorithms.config import AlgorithmConfig, check_spaces
from skillweave.errors import DeclarationError, PolicyError
from skillweave.hierarchy.roles import Level, Roles
from skillweave.networks.config import Network
from skillweave.networks.net import seen_places
from skillweave.policies.hierarchy import ActiveGuide
from skillweave.policies.spaces import space_of
from skillweave.skills import ReadySelector, ready_policy
from skillweave.skills.foreign_policy import fitted
from skillweave.skills.goal_spaces import goal_part
from skillweave.skills.goals import goals_of
from skillweave.skills.learnable import Learnable
from skillweave.skills.ready import PART, fitted_to_skill
from skillweave.skills.skill_set import skills_below
from skillweave.spaces import obs_codec
from skillweave.training.env_check import check_rollout
from skillweave.training.role import Role


def check_settings(roles: Roles) -> None:
    """Raise a DeclarationError where algorithms, reflexes or guides do not fit the environment."""
    for skill in roles.skills.values():
        goals_of(skill)  # raises if its space is not supported
    for level in roles.levels.values():
        for path in level.skills:
            _check_learner(roles[path], f"skill {path!r}: ")
        _check_learner(roles[level.selector_path], f"{level.selector_path}: ")
        spaces = roles.spec.spaces
        if level.flat is not None:
            check_spaces(level.flat, spaces.action, "flat: ")
            read_by(level.flat, spaces.observation, "flat: ")
        of_skills = (skill.algorithm for skill in level.skills.values())
        for config in (level.algorithm, level.selector, level.flat, *of_skills):
            if isinstance(config, AlgorithmConfig):
                check_rollout(config, spaces.observation)
        for skill in level.skills.values():
            if skill.fade is not None and space_of(spaces.action).kind != "Box":
                raise DeclarationError(
                    f"skill {skill.name!r}: fade mixes the actions of two skills, which needs "
                    f"actions of a Box, not {spaces.action}"
                )
        for reflex in level.reflexes:
            reflex.override(space_of(spaces.action))  # raises where its fixed action does not fit
        if level.guide is not None:
            learning_guide(roles, level)


def _check_learner(role: Role, where: str) -> None:
    """Raise a DeclarationError where the algorithm of a role does not fit its spaces."""
    if role.config is not None:
        check_spaces(role.config, role.action_space, where)
        read_by(role.config, role.observation_space, where)
        _check_seen(role, where)
    if role.skill is not None and isinstance(role.skill.policy, Learnable):
        who = f"skill {role.path!r}"
        goals = role.skill.goal_space
        role.skill.policy.check(role.observation_space, role.action_space, goals, who)


def _check_seen(role: Role, where: str) -> None:
    """Raise a DeclarationError where networks see what is not there, or do not see a goal."""
    codec = obs_codec(role.observation_space)
    has_goals = role.skill is not None and role.skill.goal_space is not None
    goal = obs_codec(goal_part(role.observation_space)).size if has_goals else 0
    first = codec.size - goal
    for name in ("network", "critic"):
        network = getattr(role.config, name, None)
        if not isinstance(network, Network) or network.sees is None:
            continue
        try:
            places = seen_places(network, codec)
        except DeclarationError as error:
            raise DeclarationError(f"{where}{error}") from None
        if goal and max(places) < first:
            raise DeclarationError(
                f"{where}{name}.sees leaves out the goal, whose places are {first} to "
                f"{codec.size - 1}, after those of the observation: add them, or the key 'goal'"
            )


def ready_policies(roles: Roles) -> dict[str, Policy]:
    """Return the ready policies of skills, by path, fitted to their spaces.

    Raises:
        PolicyError: a policy does not fit.
    """
    policies: dict[str, Policy] = {}
    for path, skill in roles.skills.items():
        if path not in roles.levels and (policy := ready_policy(skill)) is not None:
            policies[path] = _fitted(policy, roles[path], f"skill {path!r}")
    return policies


def ready_selectors(roles: Roles) -> dict[str, Policy]:
    """Return the ready selectors, by path, fitted to their spaces.

    Raises:
        PolicyError: a selector does not fit, or fails.
    """
    return {
        level.selector_path: _fitted(ready, roles[level.selector_path], level.selector_path)
        for level in roles.levels.values()
        if (ready := level.ready_selector) is not None
    }


def _fitted(policy: Policy, role: Role, who: str) -> Policy:
    """Return a ready policy, fitted to the spaces of the role in which it acts."""
    env = role.spec.name
    if role.part is not None:
        env += PART
        if skills_below(policy) is not None:
            raise PolicyError(
                f"{who}: its policy is a hierarchy, which sees and writes all of its environment: "
                "leave out sees and acts"
            )
    return fitted_to_skill(policy, role.skill, *role.spaces, who, env)


def fitted_guide(level: Level, observation_space: gym.Space[Any]) -> ActiveGuide | None:
    """Return the guide of a selector that learns, on these observations; None: it has none.

    Raises:
        SkillError: the guide fails on these observations.
    """
    if level.guide is None or (guide := level.ready_guide) is None:
        return None
    choices = gym.spaces.Discrete(len(level.skills) * max(1, len(guide.lengths)))
    who = join(level.path, "guide")
    if any(goal is not None for *_, goal in guide.named()):
        raise DeclarationError(
            f"{who}: it gives a goal, but the selector that it guides chooses goals itself: leave "
            "out the goal"
        )
    selector = fitted(guide, observation_space, choices, who, level.spec.name)
    tells = level.guide.target_kl is not None
    return ActiveGuide(cast(ReadySelector, selector), level.guide.restrict, tells)


def restricting_guide(level: Level, observation_space: gym.Space[Any]) -> ActiveGuide | None:
    """Return the guide that restricts a selector after its training; None: it has none."""
    guide = fitted_guide(level, observation_space)
    return replace(guide, tells=False) if guide is not None and guide.restricts else None


def learning_guide(roles: Roles, level: Level) -> ActiveGuide | None:
    """Return the guide of a selector that learns; None: it has none."""
    if level.guide is None:
        return None
    return fitted_guide(level, roles[level.selector_path].observation_space)


def active_guide(roles: Roles, level: Level) -> ActiveGuide | None:
    """Return the selector that guides the learning one or decides in its place; None: no guide."""
    if (ready := level.ready_selector) is None:
        return learning_guide(roles, level)
    role = roles[level.selector_path]
    selector = _fitted(ready, role, role.path)
    return ActiveGuide(cast(ReadySelector, selector), decides=True)
