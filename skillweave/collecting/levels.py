"""A hierarchy that learns as a whole, as a tree: levels of skills, each below a selector."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from skillweave.collecting.acting import Acting
from skillweave.collecting.call_end import CallEnd, Interruption
from skillweave.collecting.collector import Collector
from skillweave.collecting.guide import ActiveGuide
from skillweave.collecting.pending_calls import Decisions, PendingCalls
from skillweave.collecting.player import LearnerActor, Player
from skillweave.collecting.skill_set import SkillSet
from skillweave.experience import Batch
from skillweave.paths import CRITIC, SELECTOR
from skillweave.skills import Skill
from skillweave.types import Array, Memory, Policy, unprefixed


@dataclass(frozen=True)
class UntrainedHierarchy:
    """Stands for the policy of a skill that is a hierarchy and learns."""

    skills: SkillSet
    """Those that learn have any policy."""
    selector: Policy | None
    """None: it learns."""
    guide: ActiveGuide | None = None
    """A ready selector beside it."""


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
        name = path + skill.name
        if name in learners:
            return LearnerActor(learners[name])
        if not isinstance(policy, UntrainedHierarchy):
            return policy
        chooser = learners.get(f"{name}/{SELECTOR}")
        selector = policy.selector if chooser is None else LearnerActor(chooser)
        below = with_learners(policy.skills, learners, margins, f"{name}/")
        return Player(below, selector, policy.guide)

    pairs = zip(skills.skills, skills.policies, strict=True)
    critic, interruption = path + CRITIC, None
    if critic in margins:
        interruption = Interruption(_worth(learners[critic]), margins[critic])
    policies = tuple(policy_of(*pair) for pair in pairs)
    return replace(skills, policies=policies, interruption=interruption)


def _worth(critic: Acting) -> Callable[[Array], Array]:
    def worth(obs: Array) -> Array:
        """Return the values of skills in observations (n, …), and of a new decision, (n, S + 1)."""
        found = critic.some(np.arange(len(obs)), obs, None, None).dist_params
        assert found is not None
        return found

    return worth


class Level:
    """Skills below one selector; the root's, or those of a skill that is a hierarchy.

    Args:
        collector: in which they act.
        memory: of the root's player.
        player: of this level.
        learners: by path, who learns.
        path: of these skills: empty, or ``inner/`` for example.
        prefix: of its memory in that of the root.
        first: the number of the first leaf.
    """

    def __init__(
        self,
        collector: Collector,
        memory: Memory,
        player: Player,
        learners: Mapping[str, Acting],
        path: str = "",
        prefix: str = "",
        first: int = 1,
    ) -> None:
        self.player, self.skills, self.path, self.prefix = player, player.skills, path, prefix
        self.has_critic = path + CRITIC in learners
        self.below: dict[int, NestedLevel] = {}
        self.leaves: dict[int, int] = {}  # by the skill's number, the leaf's, from 1
        self.learning: dict[int, LearnerActor] = {}
        at: int = first
        for i, (skill, actor) in enumerate(zip(self.skills.skills, player.actors, strict=True)):
            name = path + skill.name
            learns = any(k.startswith(f"{name}/") for k in learners)
            if learns and isinstance(actor, Player):
                self.below[i] = NestedLevel(
                    collector, memory, actor, learners, f"{name}/", f"{prefix}{i}.", at
                )
                at = self.below[i].end
                continue
            self.leaves[i], at = at, at + 1
            if isinstance(actor, LearnerActor):
                self.learning[i] = actor
        self.end: int = at
        """The number after that of the last leaf."""

    def all(self) -> Iterator[Level]:
        """This level and all below it, each before those below it."""
        yield self
        for level in self.below.values():
            yield from level.all()

    def leaf(self, memory: Memory, ids: Array) -> Array:
        """(k,) the numbers of the leaves that act in environments ``ids`` (k,)."""
        running = memory[f"{self.prefix}skill"][ids]
        table = np.array([self.leaves.get(i, 0) for i in range(len(self.skills.skills))])
        found: Array = table[running]
        for i, level in self.below.items():
            if len(rows := np.flatnonzero(running == i)):
                found[rows] = level.leaf(memory, ids[rows])
        return found

    def elapsed(self, memory: Memory, ids: Array) -> Array:
        """Return the steps of the calls of the leaves that act in environments ``ids`` (k,)."""
        running, found = memory[f"{self.prefix}skill"][ids], memory[f"{self.prefix}elapsed"][ids]
        for i, level in self.below.items():
            if len(rows := np.flatnonzero(running == i)):
                found[rows] = level.elapsed(memory, ids[rows])
        return found

    def called(self, memory: Memory, ids: Array) -> Iterator[tuple[int, Array]]:
        """Each skill's number, and the rows of ``ids`` in whose environments it is called."""
        running = memory[f"{self.prefix}skill"][ids]
        for i in range(len(self.skills.skills)):
            if len(rows := np.flatnonzero(running == i)):
                yield i, rows


class NestedLevel(Level):
    """The skills of a skill that is a hierarchy, and the decisions of its selector.

    Where the hierarchy is called again at once, after a limit, the call that its selector began
    goes on. Where another skill follows, that call is cut: what follows is worth to the selector
    what its state is worth there. Where the hierarchy ends by itself, nothing is.
    """

    def __init__(
        self,
        collector: Collector,
        memory: Memory,
        player: Player,
        learners: Mapping[str, Acting],
        path: str,
        prefix: str,
        first: int,
    ) -> None:
        super().__init__(collector, memory, player, learners, path, prefix, first)
        found = player.selector
        self.selector = found if isinstance(found, LearnerActor) else None
        """None: it is ready."""
        if self.selector is not None:
            own = unprefixed(prefix.removesuffix("."), memory)
            self.calls = PendingCalls(collector, player, self.selector, own, prefix=path)
            self.acted = np.zeros(collector.num_envs, bool)  # in the step before
            self.open = np.zeros(collector.num_envs, bool)  # a call of its selector is open
            collector.kept |= {f"{path}acted": self.acted, f"{path}open": self.open}
        self.out = Decisions(collector.num_envs)

    def decided(self, obs: Array, ids: Array) -> None:
        """In environments ``ids`` (k,) it acts; where its selector has decided, that is kept.

        Args:
            obs: what it acts on, (N, …).
        """
        if self.selector is None:
            return
        here = np.zeros(len(obs), bool)
        here[ids] = True
        gone = np.flatnonzero(self.open & ~here)
        if len(gone):
            cut = np.ones(len(gone), bool)
            self._close(gone, ~cut, cut, obs[gone])
        new = self.calls.begin()
        if len(new):
            self.calls.kept["first"][new] = ~self.acted[new]
            self.open[new] = True
        self.acted[:] = here

    def taken(self, obs: Array) -> Batch:
        """The decisions since this was last asked; ``obs`` as of ``Decisions.batch``."""
        out, self.out = self.out, Decisions(len(obs))
        return out.batch(self.calls, obs)

    def ends(self, memory: Memory, ids: Array, end: Array) -> Array:
        """Return why the calls of its skills ended, for what they learn, (k,).

        Args:
            end: why the hierarchy's own calls ended. It cuts those below it, unless it is called
                again at once.
        """
        found: Array = memory[f"{self.prefix}end"][ids]
        cut = (found == CallEnd.RUNNING) & (end != CallEnd.RUNNING)
        episode = end[cut] == CallEnd.EPISODE
        found[cut] = np.where(episode, np.int8(CallEnd.EPISODE), np.int8(CallEnd.LIMIT))
        return found

    def learn_from(
        self,
        ids: Array,
        reward: Array,
        terminated: Array,
        truncated: Array,
        next_obs: Array,
        closes: Array,
        gamma: Array,
    ) -> None:
        """Count a step of environments ``ids`` (k,), and keep the decisions that end with it.

        Args:
            terminated: nothing is worth anything to the hierarchy any more.
            truncated: its call is over in another way.
            closes: the calls that its selector began are over for certain.
        """
        known = self.open[ids]  # of a call that went on after an end there is no decision
        self.calls.count(ids[known], reward[known], gamma)
        rows = np.flatnonzero(known & closes)
        if len(rows):
            self._close(ids[rows], terminated[rows], truncated[rows], next_obs[rows])

    def _close(self, ids: Array, terminated: Array, truncated: Array, next_obs: Array) -> None:
        """Calls that the selector began are over, in environments ``ids`` (k,)."""
        self.out.put(ids, self.calls.row(ids, terminated, truncated, next_obs))
        self.open[ids] = False
