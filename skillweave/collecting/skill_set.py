"""The skills below one selector: what a choice means, where it may be made, how long it lasts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.collecting.call_end import Interruption
from skillweave.collecting.lengths import Lengths
from skillweave.errors import SkillError
from skillweave.messages import observed
from skillweave.skills import Reflex, Skill, asked, path_of
from skillweave.skills.goal_spaces import choice_space
from skillweave.skills.own_part import OwnPart
from skillweave.types import Array, Policy


@dataclass(frozen=True)
class SkillSet:
    """Skills with their policies, and the limits of their calls; a ``Player`` lets them act.

    A choice is a number below ``choices``: a skill, or a skill and a length.
    """

    skills: tuple[Skill, ...]
    policies: tuple[Policy, ...]
    reflexes: tuple[Reflex, ...] = ()
    call_steps: int | Lengths | None = None
    """A call lasts at most so long; None: until the skill stops by itself."""
    greedy: bool = True
    """Skills act greedily; else they sample."""

    call_cost: float = 0.0
    """What a selector that learns pays for each call, in units of reward."""
    interruption: Interruption | None = None
    """When the selector cuts a call; None: never."""
    parts: tuple[OwnPart | None, ...] = ()
    """The own part of each skill's observations and actions, None: it has all; (): no skill has
    one."""
    greedy_selector: bool = True
    """The selector is greedy where its caller asks for deterministic actions; else it samples."""

    @property
    def lengths(self) -> tuple[int, ...]:
        """The lengths that are chosen from; none where no length is chosen."""
        return self.call_steps.steps if isinstance(self.call_steps, Lengths) else ()

    @property
    def choices(self) -> int:
        """The number of choices: the first skill with each length, then the next skill."""
        return len(self.skills) * max(1, len(self.lengths))

    @property
    def choice_space(self) -> gym.Space[Any]:
        """The space of choices; where skills have goals, a choice has some."""
        goal_spaces = {s.name: s.goal_space for s in self.skills if s.goal_space is not None}
        return choice_space(self.choices, goal_spaces, [s.name for s in self.skills])

    def mask(self, obs: Array, age: Array | None = None) -> Array | None:
        """Return the allowed choices, (n, choices) bool; None: all, everywhere.

        Args:
            age: (n,), steps of the episodes so far, for messages.

        Raises:
            SkillError: in some observation no skill may start.
        """
        if not self.restricts:
            return None
        mask = self.startable(obs)
        if not mask.any(axis=1).all():
            row = int(np.flatnonzero(~mask.any(axis=1))[0])
            names = ", ".join(repr(path_of(s)) for s in self.skills)
            where = observed(obs[row])
            where += "" if age is None else f", after {int(age[row])} steps of the episode"
            raise SkillError(
                f"no skill may start in observation {where}: the initiation() of {names} is False "
                "there. Let at least one start everywhere"
            )
        return mask

    def startable(self, obs: Array) -> Array:
        """Choices whose skill may start, (n, choices) bool; perhaps none in some observation."""
        may = [self._may_start(i, obs) for i in range(len(self.skills))]
        return np.stack(may, axis=1).repeat(max(1, len(self.lengths)), axis=1)

    @property
    def restricts(self) -> bool:
        """True if some skill, here or in a hierarchy below, may not start everywhere."""
        below = (skills_below(p) for p in self.policies)
        own = any(s.defines("initiation") for s in self.skills)
        return own or any(skills.restricts for skills in below if skills is not None)

    def _may_start(self, i: int, obs: Array) -> Array:
        """Return where skill ``i`` may start, (n,); of a hierarchy, also one of its skills."""
        skill, below = self.skills[i], skills_below(self.policies[i])
        may = np.ones(len(obs), bool)
        if skill.defines("initiation"):
            may = asked(skill, "initiation", obs, len(obs))
        if below is not None and below.restricts:
            may = may & below.startable(obs).any(axis=1)
        return may

    @property
    def action_space(self) -> gym.Space[Any]:
        """The environment's space of actions."""
        part = next((part for part in self.parts if part is not None), None)
        return self.policies[0].action_space if part is None else part.whole_action_space

    def part(self, i: int) -> OwnPart | None:
        """Return the own part of skill ``i``; None: it has all."""
        return self.parts[i] if self.parts else None

    @property
    def holds(self) -> bool:
        """True if the last action counts for some skill, here or in a hierarchy below."""
        below = (skills_below(p) for p in self.policies)
        own = any(part is not None and part.holds for part in self.parts)
        return own or any(skills.holds for skills in below if skills is not None)

    def skill_of(self, choice: Array) -> Array:
        """The skills that choices (k,) are of."""
        return choice // len(self.lengths) if self.lengths else choice

    def limit(self, i: int) -> int | None:
        """Steps after which a call of skill ``i`` is cut, its own limit included; None: never."""
        skill = self.skills[i]
        most = self.call_steps if skill.call_steps is None else skill.call_steps
        limits = [x for x in (most, skill.max_steps) if isinstance(x, int)]
        return min(limits) if limits else None


def skills_below(policy: Policy | None) -> SkillSet | None:
    """The skills of a policy that is a hierarchy; None: it is none."""
    found = getattr(policy, "skills", None)
    return found if isinstance(found, SkillSet) else None
