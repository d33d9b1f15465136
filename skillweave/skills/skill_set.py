"""The skills below one selector: what a choice means, where it may be made, how long it lasts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gymnasium as gym

from skillweave._internal.policy_protocol import Memoryless, Policy
from skillweave.errors import PolicyError
from skillweave.policies.core import Choices, RowPolicy, innermost
from skillweave.policies.functional import Functional, Returns
from skillweave.policies.hierarchy import ActiveGuide, CallAndReturn, CalledSkill, Interruption
from skillweave.policies.parts import Corrects, Given, Joined, PartOf, Reflexes, Remembers
from skillweave.policies.spaces import space_of
from skillweave.skills import Reflex, Skill, path_of
from skillweave.skills.goal_spaces import choice_space
from skillweave.skills.goals import Goals, goals_of
from skillweave.skills.lengths import Lengths
from skillweave.skills.outputs import blame, call_skill
from skillweave.skills.own_part import OwnPart


class LimitedCalls(Choices):
    """Calls of skills that ``call_steps`` limits."""

    call_steps: int | Lengths | None

    @property
    def lengths(self) -> tuple[int, ...]:
        """The lengths that are chosen from; none where no length is chosen."""
        return self.call_steps.steps if isinstance(self.call_steps, Lengths) else ()


@dataclass(frozen=True)
class SkillSet(LimitedCalls):
    """The declared skills below a selector, with policies and limits; for ``acting_policy``."""

    skills: tuple[Skill, ...]
    policies: tuple[Any, ...]
    reflexes: tuple[Reflex, ...] = ()
    call_steps: int | Lengths | None = None
    """A call lasts at most so long; None: until the skill stops by itself."""
    greedy: bool = True
    """Skills act greedily; else they sample."""

    deliberation_cost: float = 0.0
    """Cost of each call for a selector that learns, in units of reward."""
    interruption: Interruption | None = None
    """Rule by which the selector cuts a call; None: it never does."""
    parts: tuple[OwnPart | None, ...] = ()
    """The own part of each skill's observations and actions, None: it has all; (): no skill has
    one."""
    greedy_selector: bool = True
    """The selector is greedy where its caller asks for deterministic actions; else it samples."""

    @property
    def choice_space(self) -> gym.Space[Any]:
        """The space of choices; where skills have goals, a choice has some."""
        goal_spaces = {s.name: s.goal_space for s in self.skills if s.goal_space is not None}
        return choice_space(self.choices, goal_spaces, [s.name for s in self.skills])

    @cached_property
    def hierarchy(self) -> CallAndReturn:
        """The skills in calls, without a selector."""
        return within(acting_policy(self, outermost=False))

    @property
    def action_space(self) -> gym.Space[Any]:
        """The environment's space of actions."""
        part = next((part for part in self.parts if part is not None), None)
        if part is not None:
            return part.whole_action_space
        space: gym.Space[Any] = next(p for p in self.policies if p is not None).action_space
        return space

    def part(self, i: int) -> OwnPart | None:
        """Return the own part of skill ``i``; None: it has all."""
        return self.parts[i] if self.parts else None

    def limit(self, i: int) -> int | None:
        """Return the steps after which a call of skill ``i`` is cut, by any limit; None: never."""
        skill = self.skills[i]
        most = self.call_steps if skill.call_steps is None else skill.call_steps
        limits = [x for x in (most, skill.max_steps) if isinstance(x, int)]
        return min(limits) if limits else None


@dataclass(frozen=True)
class UntrainedHierarchy:
    """A placeholder for the policy of a skill that is a hierarchy and learns."""

    skills: SkillSet
    """The skills; the policies of those that learn are not used."""
    selector: Policy | None
    """The ready selector; None: it learns."""
    guide: ActiveGuide | None = None
    """A ready selector beside the learning one."""
    goals: Goals | None = None
    """The hierarchy's own goals, as a skill that has goals; None: it has none."""

    @property
    def action_space(self) -> gym.Space[Any]:
        """The environment's."""
        return self.skills.action_space


def skills_below(policy: Any) -> SkillSet | None:
    """Return the skills of a policy that is a hierarchy; None: it is none."""
    found = getattr(policy, "skills", None)
    return found if isinstance(found, SkillSet) else None


def acting_policy(
    skills: SkillSet,
    selector: Any = None,
    guide: ActiveGuide | None = None,
    goals: Goals | None = None,
    *,
    outermost: bool = True,
) -> RowPolicy:
    """Compile a selector and its declared skills to the policy that acts in calls, with reflexes.

    Args:
        skills: with their policies; one that has skills and a selector itself is a hierarchy.
        selector: chooses where a call has ended; None: the caller does, by ``begin``.
        guide: a ready selector that restricts the choices.
        goals: of the hierarchy, as a skill that has goals.
        outermost: it remembers the last action, where that counts for a skill; else
            it is in the ``World``.
    """
    if guide is not None and guide.decides:
        selector = guide.selector
        guide = None
    policy: RowPolicy = CallAndReturn(
        None if selector is None else in_place(selector, "the selector's act()"),
        tuple(_skill(skills, i) for i in range(len(skills.skills))),
        lengths=skills.lengths,
        guide=guide and replace(guide, selector=in_place(guide.selector, "the guide")),
        interruption=skills.interruption,
        fresh_calls=goals is not None,
        greedy=skills.greedy,
        greedy_selector=skills.greedy_selector,
        call_user=call_skill,
    )
    if skills.reflexes:
        policy = _overridden(policy, skills.reflexes, skills.action_space)
    return _remembering(policy, skills) if outermost else policy


def acting_alone(skills: SkillSet, i: int) -> RowPolicy:
    """Compile the declared skill ``i``, without a selector, to a policy with reflexes."""
    skill = skills.skills[i]
    space = skills.action_space
    policy = acting_apart(skills.policies[i], skill, skills.part(i), skills.reflexes, space)
    goals = goals_of(skill)
    return _remembering(policy if goals is None else Given(policy, goals), skills)


def within(policy: RowPolicy) -> CallAndReturn:
    """Return the hierarchy inside of reflexes and other combinators."""
    inside = innermost(policy)
    assert isinstance(inside, CallAndReturn)
    return inside


def in_place(policy: Any, who: str = "the policy's act()") -> RowPolicy:
    """Return a skill's policy, of any form, as a ``RowPolicy``; ``who`` is for messages."""
    if isinstance(policy, RowPolicy):
        return policy
    if isinstance(policy, Functional) and policy.is_plain:
        return policy.in_place
    watches = getattr(type(policy), "observe", None) is not Memoryless.observe
    return Returns(policy, who, blame, watches=watches)


def acting_apart(
    policy: Any,
    skill: Skill | None,
    part: OwnPart | None,
    reflexes: tuple[Reflex, ...],
    space: gym.Space[Any],
) -> RowPolicy:
    """Compile a declared skill that acts by itself, or a plain agent, to a policy with reflexes.

    Args:
        policy: the skill's; see ``policy_of``.
        skill: None: a plain agent.
        part: of the skill.
        reflexes: in force.
        space: of the environment's actions.
    """
    whole = _whole(policy, skill, part)
    return _overridden(whole, reflexes, space) if reflexes else whole


def _overridden(
    policy: RowPolicy, reflexes: tuple[Reflex, ...], space: gym.Space[Any]
) -> RowPolicy:
    """Return a policy with the declared reflexes around it."""
    acts = space_of(space)
    return Reflexes(policy, tuple(reflex.override(acts) for reflex in reflexes), acts)


def _whole(policy: Any, skill: Skill | None, part: OwnPart | None) -> RowPolicy:
    """Return a skill's policy, whose actions are whole ones."""
    who = "" if skill is None else f"skill {path_of(skill)!r}: its policy's act()"
    found = policy_of(policy, goals_of(skill), part, who)
    return found if part is None else PartOf(found, part.part)


def _skill(skills: SkillSet, i: int) -> CalledSkill:
    """Return a declared skill as the ``CalledSkill`` that acts in its hierarchy."""
    skill = skills.skills[i]
    path, goals = path_of(skill), goals_of(skill)
    policy = _whole(skills.policies[i], skill, skills.part(i))
    asks = {name: getattr(skill, name) for name in ENDS if skill.defines(name)}
    fades = fades_of(skill, [s.name for s in skills.skills])
    return CalledSkill(
        skill.name, path, policy, skills.limit(i), skill.max_steps, goals=goals, fades=fades, **asks
    )


def fades_of(skill: Skill, names: Sequence[str]) -> tuple[int, ...]:
    """Return, by the place of the skill before, the steps in which a skill fades in; (): none."""
    if skill.fade is None:
        return ()
    by_name = skill.fade if isinstance(skill.fade, Mapping) else dict.fromkeys(names, skill.fade)
    return tuple(0 if name == skill.name else by_name.get(name, 0) for name in names)


def _remembering(policy: RowPolicy, skills: SkillSet) -> RowPolicy:
    """Return a policy that remembers the last action where that counts."""
    return Remembers(policy, space_of(skills.action_space)) if policy.holds else policy


def policy_of(
    policy: Any, goals: Goals | None, part: OwnPart | None, who: str, *, outermost: bool = False
) -> RowPolicy:
    """Return a skill's policy, whose actions are those of its own part.

    Args:
        policy: of any form; None: it is not there yet.
        goals, part: of the skill.
        who: for messages.
        outermost: see ``acting_policy``.
    """
    if policy is None:
        return RowPolicy()
    if isinstance(policy, UntrainedHierarchy):
        how = policy.skills, policy.selector, policy.guide, policy.goals
        inside = acting_policy(*how, outermost=outermost)
        joins = policy.goals is None
    else:
        inside = in_place(policy, who)
        joins = isinstance(inside, Returns) or not getattr(policy, "joins", False)
        if isinstance(inside, Remembers) and not outermost:
            inside = inside.policy
        _check_memory(inside)
    inside = Joined(inside) if joins and goals is not None else inside
    if part is None or part.correction is None:
        return inside
    who = f"{part.who}: the act() of the policy that it corrects"
    # A hierarchy that is corrected remembers its own last actions.
    return Corrects(inside, policy_of(part.base, goals, None, who, outermost=True), part.correction)


ENDS = ("initiation", "termination", "success")
"""The methods of a skill that are called while it acts."""


def _check_memory(policy: RowPolicy) -> None:
    """Raise a PolicyError where a checkpoint could not hold the memory of a user's policy."""
    if not isinstance(policy, Returns):
        return
    for name, value in policy.start(1).items():
        if value.dtype.names is None and value.dtype.kind not in "biuf":
            raise PolicyError(
                f"{policy.who} remembers {name!r} as {value.dtype}; a memory is an array of "
                "numbers whose first axis is the environment"
            )
