"""A hierarchy that learns as a whole, as a tree: levels of skills, each below a selector."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from skillweave._internal.paths import CRITIC, SELECTOR
from skillweave.algorithms.batches import Trace
from skillweave.experience.acting import Acting
from skillweave.policies.core import Array, Memory
from skillweave.policies.hierarchy import CallAndReturn, Interruption
from skillweave.policies.leaves import Learning
from skillweave.skills import Skill
from skillweave.skills.goals import Goals, goals_of
from skillweave.skills.skill_set import SkillSet, UntrainedHierarchy, within


def with_learners(
    skills: SkillSet, learners: Mapping[str, Acting], margins: Mapping[str, float], path: str = ""
) -> SkillSet:
    """Return the skills with their learners, and hierarchies that learn, as policies.

    Args:
        learners: by their paths, ``inner/skill`` for example, all who learn below the selector.
        margins: by the paths of critics, those that end calls.
        path: of these skills, ``inner/`` for example.
    """

    def policy_of(skill: Skill, policy: Any) -> Any:
        """Return the acting learner of a skill, or its ready policy."""
        name = path + skill.name
        if name in learners:
            return Learning(learners[name], name)
        if not isinstance(policy, UntrainedHierarchy):
            return policy
        selector: Any = policy.selector
        if (chooser := f"{name}/{SELECTOR}") in learners:
            selector = Learning(learners[chooser], chooser, decides=True)
        below = with_learners(policy.skills, learners, margins, f"{name}/")
        return UntrainedHierarchy(below, selector, policy.guide, goals_of(skill))

    pairs = zip(skills.skills, skills.policies, strict=True)
    critic = path + CRITIC
    interruption = None
    if critic in margins:
        interruption = Interruption(_worth(learners[critic]), margins[critic])
    policies = tuple(policy_of(*pair) for pair in pairs)
    return replace(skills, policies=policies, interruption=interruption)


def own_memory(memory: Memory) -> Memory:
    """Return the memory of a skill's own policy, without that of the base policy it corrects."""
    own: Memory = memory.get("own", memory)
    return own


def _worth(critic: Acting) -> Callable[[Array], Array]:
    """Return a function of observations: the values of skills by the learning skill critic."""

    def worth(obs: Array) -> Array:
        """Return the values of skills in observations (n, …), and of a new decision, (n, S + 1)."""
        found = critic.some(np.arange(len(obs)), obs, None, None).dist_params
        assert found is not None
        return found

    return worth


@dataclass(frozen=True, eq=False)
class LearningLevel:
    """Skills below one selector: the root's, or those of a skill that is a hierarchy and learns."""

    skill_set: SkillSet
    hierarchy: CallAndReturn
    """The acting policy of these skills and their selector."""
    memory: Memory
    """The hierarchy's memory, of all environments; changed in place."""
    learners: Mapping[str, Acting]
    """All policies that learn below the outermost selector, by path."""
    skill: Skill | None = None
    """The skill that this level is in another hierarchy; None: it is the outermost one."""
    path: str = ""
    """Prefix of this level's columns in a trace: empty, or ``inner/`` for example."""

    @cached_property
    def goals(self) -> Goals | None:
        """The level's own goals, as a skill that has goals; None: it has none."""
        return goals_of(self.skill)

    @property
    def skills(self) -> tuple[Skill, ...]:
        """The skills, in order."""
        return self.skill_set.skills

    @property
    def selector(self) -> Learning | None:
        """The selector; None: it does not learn."""
        found = self.hierarchy.selector
        return found if isinstance(found, Learning) else None

    def seen(self, trace: Trace, name: str) -> Array:
        """Return the column ``name``, "obs" or "next_obs", as selector and critic see it."""
        own = self.goals
        return trace[name] if own is None else own.join(trace[name], trace[self.path + "goal"])

    @cached_property
    def below(self) -> dict[int, LearningLevel]:
        """The skills that are hierarchies in which something learns, by their place in the list."""
        found: dict[int, LearningLevel] = {}
        for i, (skill, policy) in enumerate(zip(self.skills, self.skill_set.policies, strict=True)):
            path = f"{self.path}{skill.name}/"
            if any(name.startswith(path) for name in self.learners):
                inside = within(self.hierarchy.skills[i].policy)
                memory = self.memory[str(i)]
                found[i] = LearningLevel(policy.skills, inside, memory, self.learners, skill, path)
        return found

    @cached_property
    def learning(self) -> dict[int, Learning]:
        """The skills that learn and are no hierarchies, by their place in the list."""
        policies = enumerate(self.skill_set.policies)
        return {i: policy for i, policy in policies if isinstance(policy, Learning)}

    def all(self) -> Iterator[LearningLevel]:
        """Return this level and all below it, each before those below it."""
        yield self
        for level in self.below.values():
            yield from level.all()
