"""The policy of a selector with its skills, which can be a skill of another hierarchy."""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from skillweave.arguments import checked_names
from skillweave.collecting.call_end import Interruption
from skillweave.collecting.guide import ActiveGuide
from skillweave.collecting.player import Player, Turn
from skillweave.collecting.skill_set import SkillSet
from skillweave.errors import DeclarationError
from skillweave.messages import short
from skillweave.skills import apply_reflexes
from skillweave.skills.foreign_policy import checksum, source_of
from skillweave.skills.goal_spaces import without_goal
from skillweave.skills.goals import Goals, goals_of
from skillweave.types import Array, Memory, Policy, Step, prefixed, unprefixed


@checked_names
class HierarchyPolicy:
    """A selector and its skills as one policy; its memory is that of a ``Player``.

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
        self.selector = selector
        self.skills = skills
        self.guide = guide
        self.player = Player(skills, selector, guide, goals)
        self.observation_space = selector.observation_space
        self.action_space = skills.action_space
        self.labels = tuple(s.name for s in skills.skills)

    def source(self) -> dict[str, Any]:
        """Return a checksum of all that decides its actions, for a run with it as a skill.

        The user's code (termination, reflexes) enters by its names alone.
        """
        skill_set = self.skills
        sources = [source_of(policy) for policy in (self.selector, *skill_set.policies)]
        checksums = [[source["kind"], source.get("sha256")] for source in sources]
        skills = [
            [s.name, s.max_steps, *([] if s.call_steps is None else [s.call_steps])]
            for s in skill_set.skills
        ]
        reflexes = [r.name for r in skill_set.reflexes]
        interruption = skill_set.interruption
        if interruption is not None and interruption.critic is not None:
            critic = source_of(interruption.critic)
            checksums.append([interruption.margin, critic.get("sha256")])
        if self.guide is not None:
            guide = source_of(cast(Policy, self.guide.selector))
            checksums.append(["guide", guide.get("sha256")])
        parts = (part for part in skill_set.parts if part is not None)
        checksums += [["part", part.who, part.to_json()] for part in parts]
        call_steps = skill_set.lengths or skill_set.call_steps
        greedy = [skill_set.greedy, skill_set.greedy_selector]
        whole = json.dumps([checksums, skills, reflexes, call_steps, *greedy])
        return {"sha256": checksum(whole.encode())}

    def start(self, n: int) -> Memory:
        """Return the memory of ``n`` environments that wait for their first decision."""
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
        """Return actions (n, ...) for ``obs`` (n, ...), among those that ``mask`` (n, A) allows.

        ``memory`` is of n environments; ``rng`` is the source of random numbers for sampling.

        ``deterministic`` sets how the selector acts, ``SkillSet.greedy`` how the skills act. A
        selector that is to sample (not ``SkillSet.greedy_selector``) samples in any case.
        """
        memory = {k: v.copy() for k, v in memory.items()}
        turn = Turn(deterministic, rng)
        return self.player.act(memory, np.arange(len(obs)), obs, mask, turn), memory

    def observe(self, memory: Memory, step: Step) -> Memory:
        """Return the ``memory`` after a ``step``; calls that are over end in it."""
        memory = {k: v.copy() for k, v in memory.items()}
        self.player.observe(memory, np.arange(len(step.reward)), step)
        return memory

    def acting(self, memory: Memory) -> Array | None:
        """Return the running skills in a ``memory``, (n,) int64."""
        return memory["skill"]

    def goal_now(self, memory: Memory, row: int = 0) -> Array | None:
        """Return the goal of the skill that acts in ``row`` of ``memory``; None: it has none.

        Returns:
            (…) an element of ``goal_space``, or None.
        """
        i = int(memory["skill"][row])
        policy = self.skills.policies[i]
        if isinstance(policy, HierarchyPolicy):
            return policy.goal_now(unprefixed(str(i), memory), row)
        goal = self.player.goal_of(memory, i, np.array([row]))
        return None if goal is None else goal[0]

    def acts(self, memory: Memory, row: int = 0) -> str:
        """Return the path of the skill that acts in ``row`` of the ``memory``: ``inner/skill``."""
        i = int(memory["skill"][row])
        name = self.labels[i]
        policy = self.skills.policies[i]
        if not isinstance(policy, HierarchyPolicy):
            return name
        return f"{name}/{policy.acts(unprefixed(str(i), memory), row)}"


def with_interruption(skills: SkillSet, critic: Any, margin: float) -> SkillSet:
    """Return the skills with calls that end where a trained critic prefers a new decision."""
    return replace(skills, interruption=Interruption(critic.heads, margin, critic))


class SkillAlone:
    """Policy of one skill without a selector, with the reflexes in force.

    It acts from an episode's start to its end, whatever its initiation set and ends. Its memory is
    the memory of the skill's policy. A skill that has goals is given one in each episode, by
    ``choose_goals``: the one of ``with_goal``, or one that is drawn.

    Args:
        skills: the skill and those beside it.
        name: of the skill.
        path: its name in reports; "": the skill's name.
    """

    def __init__(self, skills: SkillSet, name: str, path: str = "") -> None:
        at = [s.name for s in skills.skills].index(name)
        self.skill = skills.skills[at]
        self.path = path or name
        self.policy = skills.policies[at]
        self.reflexes = skills.reflexes
        self.goals = goals_of(self.skill)
        self.part = skills.part(at)
        self.observation_space = self.policy.observation_space
        if self.goals is not None:
            self.observation_space = without_goal(self.observation_space)
        if self.part is not None:
            self.observation_space = self.part.whole_observation_space
        self.action_space = skills.action_space
        self.labels = self.policy.labels
        self.skills = getattr(self.policy, "skills", None)  # of a skill that is a hierarchy
        self.acting = self.policy.acting
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
        alone._goal, alone._gives = self.goals.one(goal, who), who
        return alone

    def start(self, n: int) -> Memory:
        """Return the memory of ``n`` environments whose episodes start."""
        return self.policy.start(n) | self._fresh(n)

    def _fresh(self, n: int) -> Memory:
        """Return what is remembered beside the skill's own policy, where episodes start."""
        fresh = {} if self.goals is None else {"goal": self.goals.start(n)}
        if self.part is not None and self.part.rest is not None and self.part.holds:
            fresh["last_action"] = self.part.rest.start(n)
        if self.part is not None and self.part.base is not None:
            fresh |= prefixed("base", self.part.base.start(n))
        return fresh

    def _divided(self, memory: Memory) -> tuple[Memory, Memory]:
        """Return the memory of the skill's own policy, and what is remembered beside it."""
        beside = self._fresh(0)
        own = {k: v for k, v in memory.items() if k not in beside}
        return own, {k: memory[k] for k in beside}

    def observe(self, memory: Memory, step: Step) -> Memory:
        """Return the ``memory`` after a ``step``."""
        own, beside = self._divided(memory)
        if "last_action" in beside:
            assert self.part is not None
            assert self.part.rest is not None
            beside["last_action"] = self.part.rest.stored(step.action)
        if self.part is not None:
            step = self.part.own_step(step)
            if self.part.base is not None:
                after = self.part.base.observe(unprefixed("base", beside), step)
                beside |= prefixed("base", after)
        if self.goals is not None:
            step = replace(step, goal=self.goals.read(memory["goal"]))
        return self.policy.observe(own, step) | beside

    def goal_now(self, memory: Memory, row: int = 0) -> Array | None:
        """Return its goal in ``row`` of the ``memory``; None: it has none."""
        if self.goals is not None:
            goal: Array = self.goals.read(memory["goal"])[row]
            return goal
        below = self.policy
        return below.goal_now(memory, row) if isinstance(below, HierarchyPolicy) else None

    def choose_goals(self, memory: Memory, rows: Array, obs: Array, rngs: Sequence[Any]) -> None:
        """Set the goal of each episode that starts in ``rows`` (k,); ``Skill.goals`` draws it.

        Args:
            memory: of all environments, changed in place.
            obs: (k, …).
            rngs: the source of chance of each episode.
        """
        if self.goals is not None:
            for i, rng in enumerate(rngs):
                memory["goal"][rows[i]] = self.goals.stored(self._next_goal(obs[i : i + 1], rng))[0]

    def _next_goal(self, obs: Array, rng: Any) -> Array:
        """Return the goal of an episode that starts in ``obs`` (1, …), (1, …)."""
        assert self.goals is not None
        if self._goal is None:
            return self.goals.draw(obs, rng)
        return self.goals.fitted(obs, self._goal.copy(), self._gives)

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return the skill's actions, or a reflex's action where its condition holds."""
        how: Any = {"deterministic": deterministic, "rng": rng}
        own, beside = self._divided(memory)
        part, seen, allowed = self.part, obs, mask
        if part is not None:
            seen, allowed = part.see(obs), part.mask(mask)
        if self.goals is not None:
            seen = self.goals.join(seen, self.goals.read(beside["goal"]))
        action, own = self.policy.act(own, seen, allowed, **how)
        if part is not None:
            corrected = None
            if part.base is not None:
                base = unprefixed("base", beside)
                corrected, base = part.base.act(base, seen, None, deterministic=True, rng=rng)
                beside |= prefixed("base", base)
            action = part.write(action, beside.get("last_action"), corrected)
            part.check_mask(mask, action)
        memory = own | beside
        action, _ = apply_reflexes(self.reflexes, obs, action, self.action_space)
        return action, memory
