"""The declaration of a hierarchy: data and checks, no training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym

from skillweave.algorithms.config import PPO, AlgorithmConfig
from skillweave.envs.make import EnvSpec
from skillweave.hierarchy.calls import SkillSet
from skillweave.skills import Reflex, Skill
from skillweave.spaces import action_codec, obs_codec, same_space
from skillweave.types import Policy, SkillweaveError

RESERVED = ("selector", "flat")
"""Names of phases that are not skills."""


@dataclass
class Declaration:
    """Skills, reflexes and a selector on one environment, with budgets in environment steps.

    Raises:
        SkillweaveError: the declaration is wrong; the message names the skill and the field.
    """

    env: str | Callable[[], gym.Env[Any, Any]] | EnvSpec
    """A Gymnasium id, a function that makes an environment, or an ``EnvSpec`` for more."""
    skills: Sequence[Skill]
    """What the selector chooses from."""
    call_steps: int | None = 40
    """How long a skill acts before the selector decides again; None: until it stops by itself."""
    reflexes: Sequence[Reflex] = ()
    """Rules that override the running skill's action."""
    algorithm: AlgorithmConfig = field(default_factory=PPO)
    """Trains every skill that names none of its own."""
    selector: AlgorithmConfig = field(default_factory=PPO)
    """Trains the selector; its γ is that of one environment step, its n_steps count decisions."""
    skill_steps: int = 500_000
    """Training budget of every skill that names none of its own."""
    selector_steps: int = 1_000_000
    """Training budget of the selector, in environment steps."""
    flat: AlgorithmConfig | None = None
    """Trains the flat baseline; None: as ``algorithm``."""
    greedy_skills: bool = True
    """Skills act greedily under the selector; else they sample."""
    reflexes_in_training: bool = True
    """Reflexes are in force while skills train too: skills learn the body they will have."""
    cut_every: int = 100_000
    """Environment steps between checkpoints."""

    def __post_init__(self) -> None:
        self.skills, self.reflexes = tuple(self.skills), tuple(self.reflexes)
        if not self.skills:
            raise SkillweaveError("a hierarchy needs at least one skill: skills is empty")
        for skill in self.skills:
            if not isinstance(skill, Skill):
                hint = " (write Center(), not Center)" if isinstance(skill, type) else ""
                raise SkillweaveError(f"skills holds {skill!r}, which is not a Skill{hint}")
            skill.validate()
        names = [s.name for s in self.skills]
        for name in names:
            if names.count(name) > 1:
                raise SkillweaveError(
                    f"two skills are named {name!r}; give one another name: class attribute 'name'"
                )
            if name in RESERVED:
                raise SkillweaveError(f"a skill cannot be named {name!r}, which names a phase")
        if self.call_steps is not None and (
            not isinstance(self.call_steps, int) or self.call_steps < 1
        ):
            raise SkillweaveError(
                f"call_steps is {self.call_steps!r}; it must be at least 1, or None"
            )
        if self.call_steps is None:
            for skill in self.skills:
                if skill.max_steps is None and not skill.defines("termination"):
                    raise SkillweaveError(
                        f"call_steps is None, but skill {skill.name!r} never stops by itself: give "
                        "it max_steps or termination()"
                    )
        for field_name in ("skill_steps", "selector_steps", "cut_every"):
            if getattr(self, field_name) < 1:
                raise SkillweaveError(f"{field_name} is {getattr(self, field_name)}; at least 1")

    @property
    def spec(self) -> EnvSpec:
        """The environment, fully specified."""
        return self.env if isinstance(self.env, EnvSpec) else EnvSpec(self.env)

    @property
    def is_data(self) -> bool:
        """Whether acting needs none of the user's Python code, so a saved run says it all."""
        code = any(s.defines("termination") or s.defines("initiation") for s in self.skills)
        ready = any(s.policy is not None for s in self.skills)
        return not code and not ready and not self.reflexes and self.spec.is_data

    def skill(self, name: str) -> Skill:
        """The skill of this name."""
        for skill in self.skills:
            if skill.name == name:
                return skill
        raise SkillweaveError(
            f"no skill {name!r}; there are: {', '.join(s.name for s in self.skills)}"
        )

    def budget(self, skill: Skill) -> int:
        """A skill's training steps; 0 where its policy is ready."""
        return 0 if skill.policy is not None else skill.steps or self.skill_steps

    @property
    def total_steps(self) -> int:
        """All training steps of skills and selector: the flat baseline's budget."""
        return sum(self.budget(s) for s in self.skills) + self.selector_steps

    def scale(self, factor: float) -> None:
        """Multiply every training budget, in place."""
        if not 0.0 < factor < float("inf"):
            raise SkillweaveError(f"scale is {factor}; it must be positive and finite")
        for skill in self.skills:
            if skill.steps is not None:
                skill.steps = max(1, round(skill.steps * factor))
        self.skill_steps = max(1, round(self.skill_steps * factor))
        self.selector_steps = max(1, round(self.selector_steps * factor))

    def skill_set(self, policies: Sequence[Policy]) -> SkillSet:
        """The skills with their policies, ready to be called."""
        return SkillSet(
            tuple(self.skills),
            tuple(policies),
            tuple(self.reflexes),
            self.call_steps,
            self.greedy_skills,
        )

    def check_spaces(self) -> None:
        """Make the environment once; raise a SkillweaveError where something does not fit it."""
        env = self.spec.make()
        try:
            obs_codec(env.observation_space)
            action_codec(env.action_space)
            for skill in self.skills:
                if skill.policy is None:
                    continue
                for kind in ("observation_space", "action_space"):
                    mine, theirs = getattr(skill.policy, kind), getattr(env, kind)
                    if not same_space(mine, theirs):
                        raise SkillweaveError(
                            f"skill {skill.name!r}: its policy has {kind} {mine}, but the "
                            f"environment {self.spec.name} has {theirs}"
                        )
        finally:
            env.close()
