"""Checks and conversions that fit a declared hierarchy to its environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym

from skillweave.algorithms.base import read_by
from skillweave.algorithms.config import AlgorithmConfig, check_spaces
from skillweave.envs.make import Spaces
from skillweave.hierarchy.guidance import fitted_guide
from skillweave.hierarchy.nesting import every_skill, inner_hierarchies, inner_of
from skillweave.skills import path_of, ready_policy
from skillweave.skills.foreign_policy import fitted
from skillweave.training.checks import check_rollout
from skillweave.training.stage import SELECTOR
from skillweave.types import Policy

if TYPE_CHECKING:
    from skillweave.hierarchy.declaration import Declaration


def check_settings(declared: Declaration, spaces: Spaces, path: str = "") -> None:
    """Raise a DeclarationError where algorithms or reflexes do not fit an environment.

    Args:
        path: of the hierarchy, ``inner/`` for example.
    """
    space = spaces.action
    for skill in declared.skills:
        if skill.policy is None:
            config = skill.algorithm or declared.algorithm
            where = f"skill {path_of(skill)!r}: "
            check_spaces(config, space, where)
            read_by(config, spaces.observation, where)
    if isinstance(declared.selector, AlgorithmConfig):
        choices = gym.spaces.Discrete(declared.choices)
        check_spaces(declared.selector, choices, f"{path}{SELECTOR}: ")
        read_by(declared.selector, spaces.observation, f"{path}{SELECTOR}: ")
    if declared.train_defaults.flat is not None:
        check_spaces(declared.train_defaults.flat, space, "flat: ")
        read_by(declared.train_defaults.flat, spaces.observation, "flat: ")
    of_skills = (s.algorithm for s in declared.skills)
    for config in (
        declared.algorithm,
        declared.selector,
        declared.train_defaults.flat,
        *of_skills,
    ):
        if isinstance(config, AlgorithmConfig):
            check_rollout(config, spaces.observation)
    for reflex in declared.reflexes:
        reflex.check(space)
    fitted_guide(declared, spaces.observation, path)
    for skill, inner in inner_hierarchies(declared.skills):
        check_settings(inner, spaces, f"{path}{skill.name}/")


def fitted_policies(declared: Declaration, spaces: Spaces) -> dict[str, Policy]:
    """Return the ready policies of skills, by path, on the environment's spaces."""
    return {
        path: fitted(policy, *spaces, f"skill {path!r}", declared.spec.name)
        for path, skill in every_skill(declared.skills)
        if inner_of(skill) is None and (policy := ready_policy(skill)) is not None
    }


def fitted_selectors(
    declared: Declaration, observation_space: gym.Space[Any], path: str = ""
) -> dict[str, Policy]:
    """Return the ready selectors, by path, on these observations."""
    selectors: dict[str, Policy] = {}
    if (ready := declared.ready_selector) is not None:
        choices = gym.spaces.Discrete(len(declared.skills))
        name = path + SELECTOR
        selectors[name] = fitted(ready, observation_space, choices, name, declared.spec.name)
    for skill, inner in inner_hierarchies(declared.skills):
        selectors |= fitted_selectors(inner, observation_space, f"{path}{skill.name}/")
    return selectors
