"""Skills, reflexes and selectors in an environment whose observations hold a task's state.

They were made for the environment itself, so each sees its observations alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import gymnasium as gym

from skillweave._internal.policy_protocol import Memory, Policy
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.planning.task_env import OwnView
from skillweave.policies.core import Array, LastCall, Step
from skillweave.policies.functional import Functional
from skillweave.policies.hierarchy import ActiveGuide
from skillweave.policies.leaves import Selector
from skillweave.policies.parts import Viewed
from skillweave.schema import as_json
from skillweave.skills import ReadySelector, Reflex, Skill
from skillweave.skills.base import own_methods
from skillweave.skills.foreign_policy import source_of
from skillweave.skills.goal_spaces import with_goal
from skillweave.skills.goals import Goals, goals_of
from skillweave.skills.own_part import OwnPart
from skillweave.skills.skill_set import SkillSet, policy_of


class OwnPolicy(Functional):
    """A policy that sees the environment's own observations, without a task's state.

    Args:
        policy: made for the environment's own observations.
        view: returns these.
        space: of the observations that hold the task's state.
        goals: of the skill whose policy it is, which then also observes a goal; None: it has none.
        part: of the environment's own observations and actions, where the skill has one. The policy
            then returns the actions of this part, corrected where the skill corrects others.
    """

    def __init__(
        self,
        policy: Policy,
        view: OwnView,
        space: gym.Space[Any],
        goals: Goals | None = None,
        part: OwnPart | None = None,
    ) -> None:
        def seen(obs: Array) -> Array:
            """Return the skill's own observations, without the state of the task."""
            own = view.obs(obs)
            return own if part is None else part.part.see(own)

        inside = Viewed(policy_of(policy, goals, part, "the policy's act()"), seen)
        space = space if goals is None else with_goal(space, goals.goal_space)
        acts = policy.action_space if part is None else part.written_space
        super().__init__(inside, space, acts, joins=goals is not None)
        self.policy = policy
        self.labels = policy.labels

    def source(self) -> dict[str, Any]:
        """Return the fields of the policy's source."""
        fields: dict[str, Any] = as_json(source_of(self.policy))
        return fields


class ViewedSelector(Viewed, Selector):
    """A ready selector that sees observations without a task's state, by ``view``."""

    policy: Selector

    def __post_init__(self) -> None:
        super().__post_init__()
        self.ends_matter = self.policy.ends_matter

    def chances(self, memory: Memory, rows: Array, obs: Array, may: Array) -> Array:
        """Return the probabilities of the selector's choices; see ``Selector``."""
        return self.policy.chances(memory, rows, self.view(obs), may)

    def ahead(self, memory: Memory, rows: Array, may: Array) -> Array:
        """Return the choices that the selector leaves; see ``Selector``."""
        return self.policy.ahead(memory, rows, may)

    def watch(self, memory: Memory, rows: Array, step: Step, last: LastCall) -> None:
        """Pass the selector its own view of a step, and how the last calls ended."""
        self.policy.watch(memory, rows, self.seen(step), last)


class OwnSelector(ReadySelector):
    """A ready selector that sees the environment's own observations; see ``OwnPolicy``."""

    def __init__(self, selector: Any, view: OwnView) -> None:
        super().__init__(selector.name)
        self.selector = selector
        self._view = view
        self.kind = selector.kind
        self.skills = selector.skills
        self.lengths = selector.lengths

    def among(self, skills: tuple[str, ...]) -> Self:
        """Return a copy that chooses among the skills of these names."""
        changed = super().among(skills)
        changed.selector = self.selector.among(skills)
        return changed

    def bind(
        self, observation_space: gym.Space[Any], action_space: gym.Space[Any], who: str
    ) -> Self:
        """Return a copy for these spaces; ``who`` begins messages."""
        bound = super().bind(observation_space, action_space, who)
        bound.selector = self.selector.bind(self._view.space, action_space, who)
        return bound

    @cached_property
    def in_place(self) -> ViewedSelector:  # type: ignore[override]
        """The selector, which sees its own observations."""
        return ViewedSelector(self.selector.in_place, self._view.obs)

    def source(self) -> dict[str, Any]:
        """Return the fields of the selector's source."""
        fields: dict[str, Any] = as_json(source_of(self.selector))
        return fields


def own_skills(skills: SkillSet, view: OwnView, space: gym.Space[Any]) -> SkillSet:
    """Return skills, of all levels, that see the environment's own observations.

    The ``policy`` of each is for a hierarchy with the same ``rest`` in which it is declared.

    Args:
        skills: with policies for the environment's own observations.
        view: returns these.
        space: of the observations that hold the task's state.
    """
    own: Any
    whole, policies = [], []
    for i, (skill, policy) in enumerate(zip(skills.skills, skills.policies, strict=True)):
        part = skills.part(i)
        if isinstance(policy, HierarchyPolicy):
            own = _own_hierarchy(policy, view, space)
        else:
            own = OwnPolicy(policy, view, space, goals_of(skill), part)
        whole.append(_own_skill(skill, own, view))
        policies.append(own if part is None else policy)
    parts = tuple(part and part.within(view.obs, space) for part in skills.parts)
    cuts = skills.interruption
    return replace(
        skills,
        skills=tuple(whole),
        policies=tuple(policies),
        parts=parts,
        reflexes=tuple(_own_reflex(reflex, view) for reflex in skills.reflexes),
        interruption=cuts and replace(cuts, worth=_of_own(cuts.worth, view)),
    )


def _own_hierarchy(
    policy: HierarchyPolicy, view: OwnView, space: gym.Space[Any]
) -> HierarchyPolicy:
    """Return a hierarchy that sees the environment's own observations, at all levels."""
    selector: Any = policy.selector
    spaces = space, selector.action_space
    if isinstance(selector, ReadySelector):
        selector = OwnSelector(selector, view).bind(*spaces, "selector")
    else:
        selector = OwnPolicy(selector, view, space)
    guide: ActiveGuide | None = policy.guide
    if guide is not None:
        ready: Any = guide.selector
        guide = replace(guide, selector=OwnSelector(ready, view).bind(*spaces, "guide"))
    return HierarchyPolicy(selector, own_skills(policy.skills, view, space), guide)


def _own_skill(skill: Skill, policy: Policy, view: OwnView) -> Skill:
    """Return a skill with the methods, limits and colour of another, and a ready policy."""

    def seeing(method: str) -> Any:
        """Return a skill's method that sees the environment's own observations."""
        asked = getattr(skill, method)

        def ask(about: Any, *more: Any) -> Any:
            """Return the method's answer about a step or observations of the environment."""
            own = view.step(about) if isinstance(about, Step) else view.obs(about)
            return asked(own, *more)

        return staticmethod(ask)

    # Without sees: the policy sees all, and cuts it to its part.
    fields = "name", "max_steps", "call_steps", "fade", "color", "reward_changes"
    attributes = {field: getattr(skill, field) for field in (*fields, "goal_space", "acts")}
    attributes |= {method: seeing(method) for method in own_methods(skill)}
    kind = type(type(skill).__name__, (Skill,), attributes | {"policy": policy})
    own: Skill = kind()
    own._path = skill._path
    return own


def _own_reflex(reflex: Reflex, view: OwnView) -> Reflex:
    action = _of_own(reflex.action, view) if callable(reflex.action) else reflex.action
    return Reflex(_of_own(reflex.condition, view), action, reflex.name)


def _of_own(function: Callable[[Array], Array], view: OwnView) -> Callable[[Array], Array]:
    return lambda obs: function(view.obs(obs))
