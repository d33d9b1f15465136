"""A hierarchy whose selector is a planner, in an environment that is scored by its task.

Stands alone because nothing of it is trained or written, unlike all else that makes a run.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

import gymnasium as gym

from skillweave.envs.make import EnvSpec
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.paths import SELECTOR
from skillweave.planning import Planner, successes
from skillweave.planning.mission_text import RESERVED
from skillweave.planning.predicates import WORD
from skillweave.planning.task_env import Tasked, own_step
from skillweave.types import Memory, Policy, Step

D = TypeVar("D", bound=Declaration)


class PlannedPolicy(HierarchyPolicy):
    """Skills under a planner, which observe what the environment itself gives, not their score."""

    def observe(self, memory: Memory, step: Step) -> Memory:
        """Return the ``memory`` after a ``step``, of the environment or of its ``TaskEnv``."""
        return super().observe(memory, own_step(step))


def planned(declared: D, policy: Policy, planner: Planner) -> tuple[D, HierarchyPolicy]:
    """Return a hierarchy and its policy with a planner in place of the outermost selector.

    Its environment has the task's reward and ends, so that evaluations, films and players are about
    the task. The selector's guide, interruption and target are left out: they belong to its
    training.
    """
    assert isinstance(policy, HierarchyPolicy)
    skills = replace(policy.skills, interruption=None)
    spaces = policy.selector.observation_space, gym.spaces.Discrete(skills.choices)
    selector: Any = planner.among(tuple(s.name for s in skills.skills)).bind(*spaces, SELECTOR)
    hierarchy = copy.copy(declared)
    spec = untasked(declared.spec)
    hierarchy.env = replace(spec, wrappers=(*spec.wrappers, Tasked(planner.task)))
    hierarchy.selector = planner
    hierarchy.guide = None
    hierarchy.together = replace(declared.together, interrupt=False)
    hierarchy.selection = replace(declared.selection, target_return=None)
    return hierarchy, PlannedPolicy(selector, skills)


def mission_words(declared: Declaration, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the predicates that a mission's text may name.

    They are the skills' successes by their names, the declaration's own, and those given, of which
    a later one replaces an earlier one of its name.
    """
    own = {
        name: success
        for name, success in successes(declared.skills).items()
        if name not in RESERVED and re.fullmatch(WORD, name)
    }
    return {**own, **declared.predicates, **given}


def untasked(spec: EnvSpec) -> EnvSpec:
    """Return an environment without the score of a planned task."""
    return replace(spec, wrappers=tuple(w for w in spec.wrappers if not isinstance(w, Tasked)))
