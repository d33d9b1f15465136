"""A role: one part of a hierarchy that acts or learns, with its own observations and actions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import gymnasium as gym

from skillweave._internal.paths import AGENT, level_of
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.envs.make import EnvSpec
from skillweave.experience.judges import Sharing
from skillweave.skills import Skill
from skillweave.skills.goal_spaces import choice_space, with_goal
from skillweave.skills.own_part import OwnPart
from skillweave.skills.ready import has_part, own_part


@dataclass(frozen=True)
class Role:
    """A role in training: a skill, a selector or a critic of skills; or a plain agent."""

    path: str
    kind: Literal["agent", "skill", "selector", "critic"]
    spec: EnvSpec
    """The environment in which it acts."""
    config: AlgorithmConfig | None = None
    """The algorithm that it learns by; None: it is ready, a hierarchy, or a critic, whose settings
    follow from the selector's in each stage."""
    skill: Skill | None = None
    """The skill; None: of another kind."""
    choices: int | None = None
    """The number of a selector's choices, or of a critic's values; None: it acts in the
    environment."""
    chosen_goals: Mapping[str, gym.Space[Any]] = field(default_factory=dict)
    """The spaces of the goals that a selector chooses, by the names of their skills."""
    observed_goals: Mapping[str, gym.Space[Any]] = field(default_factory=dict)
    """The spaces of the goals of calls that a critic observes, by the names of skills."""
    own_goals: gym.Space[Any] | None = None
    """The space of the goals of the hierarchy as a skill, which its selector and critic observe;
    None: it has none."""
    skills: tuple[str, ...] = ()
    """The names of the skills that a selector chooses from, in order."""
    row_steps: int = 1
    """Approximate environment steps of a row of its experience."""
    greedy: bool = True
    """It acts greedily in evaluations."""
    rest: Any = "zero"
    """The value of actions where the skill writes nothing, of its hierarchy."""
    margin: float | None = None
    """A critic's margin of interruption; None: it interrupts no call."""
    guide_kl: float | None = None
    """A selector stays within this KL of its guide while it learns; None: without limit."""

    sharing: Sharing | None = None
    """The skills of its hierarchy that learn from each other's steps; None: it learns alone."""

    @property
    def level(self) -> str:
        """The path of its hierarchy."""
        return level_of(self.path)

    @property
    def observation_space(self) -> gym.Space[Any]:
        """The space of what it observes: the environment's or a skill's part, perhaps and goals.

        A skill with goals observes its own, a selector those of its hierarchy, and a critic these
        and those of all skills of its level.
        """
        space = self.spec.spaces.observation if self.part is None else self.part.observation_space
        if self.own_goals is not None:
            space = with_goal(space, self.own_goals)
        if self.observed_goals:
            return with_goal(space, gym.spaces.Dict(list(self.observed_goals.items())))
        if self.skill is None or self.skill.goal_space is None:
            return space
        return with_goal(space, self.skill.goal_space)

    @property
    def action_space(self) -> gym.Space[Any]:
        """The space of its actions, or of its choices."""
        if self.choices is not None:
            return choice_space(self.choices, self.chosen_goals, self.skills)
        return self.spec.spaces.action if self.part is None else self.part.action_space

    @property
    def spaces(self) -> tuple[gym.Space[Any], gym.Space[Any]]:
        """The spaces of its observations and of its actions."""
        return self.observation_space, self.action_space

    @cached_property
    def part(self) -> OwnPart | None:
        """A skill's own part of observations and actions; None: it has all.

        Raises:
            DeclarationError: it does not fit the environment's spaces.
            PolicyError: the ready policy that it corrects does not.
        """
        if self.skill is None or not has_part(self.skill):
            return None
        spaces = self.spec.spaces.observation, self.spec.spaces.action
        return own_part(self.skill, self.rest, spaces, f"skill {self.path!r}", self.spec.name)


def agent_role(spec: EnvSpec) -> Role:
    """Return the role of a plain agent in an environment."""
    return Role(AGENT, "agent", spec)
