"""A hierarchy that learns as a whole, as a tree: levels of skills, each below a selector."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from skillweave.collecting.acting import Acted, Acting
from skillweave.collecting.calls import Interruption, SkillSet, skills_below
from skillweave.collecting.collector import Collector
from skillweave.collecting.ends import ENDED, Why
from skillweave.collecting.open_calls import Decisions, OpenCalls
from skillweave.experience import Batch
from skillweave.skills import Skill
from skillweave.types import Array, Memory, Memoryless, Policy, unprefixed

SELECTOR = "selector"
"""What a selector is named, after the names of the hierarchies that it is in."""
CRITIC = "skill_critic"
"""What a critic of skills is named, in the same way."""


class LearningSkill(Memoryless):
    """A skill that learns, or a selector, as a policy; what it did last is kept.

    Args:
        acting: its learner, one member.
    """

    def __init__(self, acting: Acting) -> None:
        ((algorithm, _),) = acting.stacks
        self.acts, self.observation_space = acting, algorithm.observation_space
        self.action_space = algorithm.action_space
        self.acted: Acted | None = None
        """What it did in the latest step, in the environments where it was asked."""
        self.mask: Array | None = None  # what was allowed there
        self.before: Array | None = None  # what it remembered before

    def start(self, n: int) -> Memory:
        """Zeros, (n, M), where the network has a memory."""
        size = self.acts.memory_size
        return {"rnn": np.zeros((n, size), np.float32)} if size else {}

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Actions (n, …) in the environment's units, as the request says."""
        self.mask, self.before = mask, memory.get("rnn")
        self.acted = self.acts.these(obs, mask, self.before)
        after = self.acted.recurrent_state
        return self.acts.to_env(self.acted.action), {} if after is None else {"rnn": after}


@dataclass(frozen=True)
class Inner:
    """Stands for a skill that is a hierarchy, and learns, before it is known who acts in it."""

    skills: SkillSet
    """Those that learn have any policy."""
    selector: Policy | None
    """None: it learns."""
    make: Callable[[Any, SkillSet], Any]
    """The policy of a selector with its skills."""


def woven(
    skills: SkillSet, learners: Mapping[str, Acting], margins: Mapping[str, float], path: str = ""
) -> SkillSet:
    """The skills, in which those act that learn.

    Args:
        learners: by their paths, ``inner/skill`` for example, all who learn below the selector.
        margins: by the paths of critics, those that say where calls are to be cut.
        path: of these skills, ``inner/`` for example.
    """

    def policy_of(skill: Skill, policy: Any) -> Any:
        name = path + skill.name
        if name in learners:
            return LearningSkill(learners[name])
        if not isinstance(policy, Inner):
            return policy
        chooser = learners.get(f"{name}/{SELECTOR}")
        selector = policy.selector if chooser is None else LearningSkill(chooser)
        return policy.make(selector, woven(policy.skills, learners, margins, f"{name}/"))

    pairs = zip(skills.skills, skills.policies, strict=True)
    critic, cuts = path + CRITIC, None
    if critic in margins:
        cuts = Interruption(_worth(learners[critic]), margins[critic])
    return replace(
        skills,
        policies=tuple(policy_of(*p) for p in pairs),
        interruption=cuts,
        reflexes_apart=any(name.startswith(path) for name in learners),
    )


def _worth(critic: Acting) -> Callable[[Array], Array]:
    def worth(obs: Array) -> Array:
        """What each skill is worth in observations (n, …), and deciding anew, (n, S + 1)."""
        found = critic.these(obs, None, None).dist_params
        assert found is not None
        return found

    return worth


class Level:
    """Skills below one selector; the root's, or those of a skill that is a hierarchy.

    Args:
        collector: in which they act.
        memory: of the root's skills.
        skills: of this level.
        learners: by path, who learns.
        path: of these skills: empty, or ``inner/`` for example.
        prefix: of what they remember, in the memory of the root's skills.
        first: the number of the first leaf.
    """

    def __init__(
        self,
        collector: Collector,
        memory: Memory,
        skills: SkillSet,
        learners: Mapping[str, Acting],
        path: str = "",
        prefix: str = "",
        first: int = 1,
    ) -> None:
        self.skills, self.path, self.prefix = skills, path, prefix
        self.has_critic = path + CRITIC in learners
        self.below: dict[int, Inside] = {}
        self.leaves: dict[int, int] = {}  # by the skill's number, the leaf's, from 1
        self.learning: dict[int, LearningSkill] = {}
        at: int = first
        for i, (skill, policy) in enumerate(zip(skills.skills, skills.policies, strict=True)):
            name = path + skill.name
            below = skills_below(policy)
            if any(k.startswith(f"{name}/") for k in learners) and below is not None:
                self.below[i] = Inside(
                    collector, memory, below, learners, f"{name}/", f"{prefix}{i}.", at, policy
                )
                at = self.below[i].end
                continue
            self.leaves[i], at = at, at + 1
            if isinstance(policy, LearningSkill):
                self.learning[i] = policy
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

    def called(self, memory: Memory, ids: Array) -> Iterator[tuple[int, Array]]:
        """Each skill's number, and the rows of ``ids`` in whose environments it is called."""
        running = memory[f"{self.prefix}skill"][ids]
        for i in range(len(self.skills.skills)):
            if len(rows := np.flatnonzero(running == i)):
                yield i, rows


class Inside(Level):
    """The skills of a skill that is a hierarchy, and the decisions of its selector.

    Where the hierarchy is called again at once, after a limit, the call that its selector began
    goes on. Where another skill follows, that call is cut: what follows is worth to the selector
    what its state is worth there. Where the hierarchy ends by itself, nothing is.
    """

    def __init__(
        self,
        collector: Collector,
        memory: Memory,
        skills: SkillSet,
        learners: Mapping[str, Acting],
        path: str,
        prefix: str,
        first: int,
        policy: Any,
    ) -> None:
        super().__init__(collector, memory, skills, learners, path, prefix, first)
        found = policy.selector
        self.selector = found if isinstance(found, LearningSkill) else None
        """None: it is ready."""
        if self.selector is not None:
            size = self.selector.acts.memory_size
            own = unprefixed(prefix.removesuffix("."), memory)
            self.calls = OpenCalls(collector, skills, size, False, policy.guide, own, path)
            self.acted = np.zeros(collector.num_envs, bool)  # in the step before
            self.open = np.zeros(collector.num_envs, bool)  # a call of its selector is under way
            collector.kept |= {f"{path}acted": self.acted, f"{path}open": self.open}
        self.out = Decisions(collector.num_envs)

    def decided(self, memory: Memory, obs: Array, ids: Array) -> None:
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
        new = ids[memory[f"{self.prefix}elapsed"][ids] == 0]
        if len(new):
            acted = self.selector.acted
            assert acted is not None
            self.calls.kept["first"][new] = ~self.acted[new]
            if "allowed" in self.calls.kept:
                self.calls.kept["allowed"][new] = self.selector.mask
            choice = np.asarray(self.selector.acts.to_env(acted.action))
            self.calls.begin(new, obs[new], choice, acted, self.selector.before)
            self.open[new] = True
        self.acted[:] = here

    def taken(self, obs: Array) -> Batch:
        """The decisions since this was last asked; ``obs`` as of ``Decisions.batch``."""
        out, self.out = self.out, Decisions(len(obs))
        return out.batch(self.calls, obs)

    def ends(self, memory: Memory, ids: Array, why: Array) -> Array:
        """(k,) why the calls of its skills are over, for what they learn.

        Args:
            why: the hierarchy's own calls are over. It cuts those below it, unless it is called
                again at once.
        """
        found = memory[self.prefix + ENDED][ids].copy()
        cut = (found == Why.RUNNING) & (why != Why.RUNNING)
        found[cut] = np.where(why[cut] == Why.EPISODE, np.int8(Why.EPISODE), np.int8(Why.LIMIT))
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
