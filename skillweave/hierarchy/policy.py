"""The selector with its skills: a policy like any other, so it can be a skill again."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any, cast

import numpy as np

from skillweave.arguments import checked_names
from skillweave.collecting.calls import SkillSet
from skillweave.collecting.ends import Interruption
from skillweave.collecting.guide import ActiveGuide
from skillweave.collecting.player import Player, Turn
from skillweave.skills import apply_reflexes
from skillweave.skills.foreign_policy import checksum, source_of
from skillweave.types import Array, Memory, Policy, Step, unprefixed


@checked_names
class HierarchyPolicy:
    """A selector and its skills as one policy; its memory is that of a ``Player``.

    Args:
        selector: chooses a row of the skills.
        skills: with their policies: ``OptionsEnv.skills``.
        guide: a ready selector that restricts what the selector may choose.
    """

    def __init__(
        self, selector: Policy, skills: SkillSet, guide: ActiveGuide | None = None
    ) -> None:
        self.selector, self.skills, self.guide = selector, skills, guide
        self.player = Player(skills, selector, guide)
        self.observation_space = selector.observation_space
        self.action_space = skills.policies[0].action_space
        self.labels = tuple(s.name for s in skills.skills)

    def source(self) -> dict[str, Any]:
        """The checksum of all that it acts by, for a run that it is a skill of.

        Of the user's code (termination, reflexes) the names alone are in it.
        """
        told = self.skills
        parts = [source_of(policy) for policy in (self.selector, *told.policies)]
        acts = [[part["kind"], part.get("sha256")] for part in parts]
        limits = [[x for x in (s.call_steps,) if x is not None] for s in told.skills]
        skills = [[s.name, s.max_steps, *own] for s, own in zip(told.skills, limits, strict=True)]
        reflexes = [r.name for r in told.reflexes]
        cuts = told.interruption
        if cuts is not None and cuts.critic is not None:
            acts.append([cuts.margin, source_of(cuts.critic).get("sha256")])
        if self.guide is not None:
            acts.append(["guide", source_of(cast(Policy, self.guide.selector)).get("sha256")])
        greedy = [told.greedy, told.greedy_selector]
        whole = json.dumps([acts, skills, reflexes, told.lengths or told.call_steps, *greedy])
        return {"sha256": checksum(whole.encode())}

    def start(self, n: int) -> Memory:
        """Memory of ``n`` environments that wait for their first decision."""
        return self.player.start(n)

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Actions (n, ...) for ``obs`` (n, ...), among those that ``mask`` (n, A) allows.

        ``memory`` is of n environments; ``rng`` is the source of chance, where it samples.

        ``deterministic`` is about the selector, ``SkillSet.greedy`` about the skills. A selector
        that was kept because it samples (``SkillSet.greedy_selector``) samples in any case.
        """
        memory = {k: v.copy() for k, v in memory.items()}
        turn = Turn(deterministic, rng)
        return self.player.act(memory, np.arange(len(obs)), obs, mask, turn), memory

    def observe(self, memory: Memory, step: Step) -> Memory:
        """The ``memory`` after a ``step``: notice where calls are over."""
        memory = {k: v.copy() for k, v in memory.items()}
        self.player.observe(memory, np.arange(len(step.reward)), step)
        return memory

    def acting(self, memory: Memory) -> Array | None:
        """(n,) int64, by the ``memory`` the running skill."""
        return memory["skill"]

    def acts(self, memory: Memory, row: int = 0) -> str:
        """By the ``memory``, the path of who acts in environment ``row``: ``inner/skill``."""
        i = int(memory["skill"][row])
        name, policy = self.labels[i], self.skills.policies[i]
        if not isinstance(policy, HierarchyPolicy):
            return name
        return f"{name}/{policy.acts(unprefixed(str(i), memory), row)}"


def with_interruption(skills: SkillSet, critic: Any, margin: float) -> SkillSet:
    """The same skills, whose calls are cut where a trained critic would rather decide anew."""
    return replace(skills, interruption=Interruption(critic.heads, margin, critic))


class SkillAlone:
    """One skill as it acts under a selector that chooses no other: with the reflexes in force.

    It acts from an episode's start to its end, also where its own initiation set or ends say
    otherwise. Its memory is that of the skill's policy.

    Args:
        skills: the skill and those beside it.
        name: of the skill.
        path: what reports call it; "": its name.
    """

    def __init__(self, skills: SkillSet, name: str, path: str = "") -> None:
        at = [s.name for s in skills.skills].index(name)
        self.skill, self.path = skills.skills[at], path or name
        self.policy, self.reflexes = skills.policies[at], skills.reflexes
        self.observation_space = self.policy.observation_space
        self.action_space = self.policy.action_space
        self.labels = self.policy.labels
        self.skills = getattr(self.policy, "skills", None)  # of a skill that is a hierarchy
        self.start, self.observe = self.policy.start, self.policy.observe
        self.acting = self.policy.acting

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """The skill's actions, or those of the reflexes where one holds."""
        action, memory = self.policy.act(memory, obs, mask, deterministic=deterministic, rng=rng)
        action, _ = apply_reflexes(self.reflexes, obs, action, self.action_space)
        return action, memory
