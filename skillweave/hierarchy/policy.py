"""The policy of a selector with its skills, which can be a skill of another hierarchy."""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave._internal.policy_protocol import Policy
from skillweave.errors import DeclarationError
from skillweave.policies.core import Array, Memory as InPlaceMemory, flat, split
from skillweave.policies.functional import Functional
from skillweave.policies.hierarchy import ActiveGuide, Interruption
from skillweave.policies.parts import OWN_GOAL
from skillweave.policies.untrusted import checksum
from skillweave.skills.foreign_policy import source_of
from skillweave.skills.goal_spaces import without_goal
from skillweave.skills.goals import Goals, goals_of
from skillweave.skills.skill_set import SkillSet, acting_alone, acting_policy


@checked_names
class HierarchyPolicy(Functional):
    """A selector and its skills as one policy; its memory is that of ``CallAndReturn``.

    Args:
        selector: chooses a row of the skills.
        skills: with their policies: ``OptionsEnv.skills``.
        guide: a ready selector that restricts what the selector may choose.
        goals: of the skill that it is in another hierarchy: it observes them, too.
    """

    def __init__(
        self,
        selector: Policy,
        skills: SkillSet,
        guide: ActiveGuide | None = None,
        goals: Goals | None = None,
    ) -> None:
        acting = acting_policy(skills, selector, guide, goals)
        joins = goals is not None
        super().__init__(acting, selector.observation_space, skills.action_space, joins=joins)
        self.goals = goals
        self.selector = selector
        self.skills = skills
        self.guide = guide
        self.labels = tuple(s.name for s in skills.skills)

    def source(self) -> dict[str, Any]:
        """Return a checksum of all that decides its actions, for a run with it as a skill.

        The user's code (termination, reflexes) enters by its names alone.
        """
        skill_set = self.skills
        sources = [source_of(policy) for policy in (self.selector, *skill_set.policies)]
        checksums: list[Any] = [[source.kind, source.sha256] for source in sources]
        skills = [
            [s.name, s.max_steps, *([] if s.call_steps is None else [s.call_steps])]
            for s in skill_set.skills
        ]
        checksums += [["fade", s.name, s.fade] for s in skill_set.skills if s.fade is not None]
        reflexes = [r.name for r in skill_set.reflexes]
        interruption = skill_set.interruption
        if interruption is not None and interruption.critic is not None:
            checksums.append([interruption.margin, source_of(interruption.critic).sha256])
        if self.guide is not None:
            guide = source_of(cast(Policy, self.guide.selector))
            checksums.append(["guide", guide.sha256])
        parts = (part for part in skill_set.parts if part is not None)
        checksums += [["part", part.who, part.to_json()] for part in parts]
        call_steps = skill_set.lengths or skill_set.call_steps
        greedy = [skill_set.greedy, skill_set.greedy_selector]
        whole = json.dumps([checksums, skills, reflexes, call_steps, *greedy])
        return {"sha256": checksum(whole.encode())}

    def goal_now(self, memory: InPlaceMemory, row: int = 0) -> Array | None:
        """Return the goal of the skill that acts in ``row`` of a ``memory``; None: it has none.

        Returns:
            (…) an element of ``goal_space``, or None.
        """
        memory = split(flat(memory))
        i = str(memory["skill"][row])
        policy = self.skills.policies[int(i)]
        if isinstance(policy, HierarchyPolicy):
            return policy.goal_now(memory[i], row)
        goals: Array | None = memory.get("goal", {}).get(i)
        return None if goals is None else goals[row]

    def acts(self, memory: InPlaceMemory, row: int = 0) -> str:
        """Return the path of the skill that acts in ``row`` of a ``memory``: ``inner/skill``."""
        memory = split(flat(memory))
        i = int(memory["skill"][row])
        name = self.labels[i]
        policy = self.skills.policies[i]
        if not isinstance(policy, HierarchyPolicy):
            return name
        return f"{name}/{policy.acts(memory[str(i)], row)}"


def with_interruption(skills: SkillSet, critic: Any, margin: float) -> SkillSet:
    """Return a skill set in which a trained critic ends calls where it prefers a new decision."""
    return replace(skills, interruption=Interruption(critic.heads, margin, critic))


class SkillAlone(Functional):
    """The policy of one skill of a hierarchy without the selector, with reflexes in force.

    It acts from an episode's start to its end, whatever its initiation set and ends. A skill that
    has goals is given one in each episode, by ``choose_goals``: the one of ``with_goal``, or one
    that is drawn.

    Args:
        skills: the skill and those beside it.
        name: of the skill.
        path: its name in reports; "": the skill's name.
    """

    def __init__(self, skills: SkillSet, name: str, path: str = "") -> None:
        at = [s.name for s in skills.skills].index(name)
        self.skill, self.policy = skills.skills[at], skills.policies[at]
        self.goals = goals_of(self.skill)
        sees = self.policy.observation_space
        sees = sees if self.goals is None else without_goal(sees)
        if (part := skills.part(at)) is not None:
            sees = part.whole_observation_space
        super().__init__(acting_alone(skills, at), sees, skills.action_space)
        self.path = path or name
        self.reflexes = skills.reflexes
        self.labels = self.policy.labels
        self.skills = getattr(self.policy, "skills", None)  # of a skill that is a hierarchy
        self._goal: Array | None = None  # (1, …), of all episodes; None: drawn for each
        self._gives = ""

    def with_goal(self, goal: Any, who: str) -> SkillAlone:
        """Return a copy that has one goal in all episodes; ``who`` gives it, for messages.

        Raises:
            DeclarationError: the skill has no goals.
            SkillError: the goal is out of its ``goal_space``.
        """
        if self.goals is None:
            raise DeclarationError(
                f"{who}: goal is {short(goal)}, but skill {self.path!r} has no goals: leave it "
                "out, or give the skill a goal_space"
            )
        alone = copy.copy(self)
        alone._goal = self.goals.one(goal, who)
        alone._gives = who
        return alone

    def goal_now(self, memory: InPlaceMemory, row: int = 0) -> Array | None:
        """Return its goal in environment ``row`` of a ``memory`` of ``in_place``; None: no goal."""
        if self.goals is not None:
            goal: Array = memory[OWN_GOAL][row]
            return goal
        below = self.policy
        return below.goal_now(memory, row) if isinstance(below, HierarchyPolicy) else None

    def choose_goals(
        self, memory: InPlaceMemory, rows: Array, obs: Array, rngs: Sequence[Any]
    ) -> None:
        """Set the goal of each episode that starts in ``rows`` (k,); ``Skill.goals`` draws it.

        Args:
            memory: of ``in_place``, of all environments; changed in place.
            obs: (k, …).
            rngs: the source of chance of each episode.
        """
        if self.goals is None:
            return
        for row, here, rng in zip(rows, obs[:, None], rngs, strict=True):
            goal = self._goal
            if goal is None:
                goal = self.goals.draw(here, rng)
            else:
                goal = self.goals.fitted(here, goal.copy(), self._gives)
            memory[OWN_GOAL][row] = goal[0]
