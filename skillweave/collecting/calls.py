"""Calls: skills acting under a selector, from the decision that starts one until it stops.

Collectors (training) and ``HierarchyPolicy`` (everything else) both run skills through
``SkillSet``, so a skill behaves the same wherever it acts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from skillweave.collecting.ends import ENDED, Interruption, Why, skill_step
from skillweave.collecting.lengths import Lengths
from skillweave.envs.infos import allowed_rows
from skillweave.errors import PolicyError, SkillError
from skillweave.messages import observed
from skillweave.skills import Reflex, Skill, apply_reflexes, asked, path_of
from skillweave.skills.outputs import blame
from skillweave.types import Array, Memory, Policy, Step


@dataclass(frozen=True)
class SkillSet:
    """Skills with their policies, and how a call runs.

    What is chosen is a number of ``choices``: a skill, or a skill and a length.

    Memory rows: ``skill`` (the running one, −1 where no call has begun in the episode),
    ``elapsed`` (steps of its call), ``limit`` (the length that was chosen, where one is), and under
    ``<index>.<key>`` what each skill's own policy remembers. Where a skill is called again at once,
    in the same episode, its policy goes on with what it remembers; after another skill's call, or
    in a new episode, it starts afresh.
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
    reflexes_apart: bool = False
    """``act`` leaves reflexes to its caller, who asks ``override``."""
    greedy_selector: bool = True
    """The selector is greedy where its caller asks for deterministic actions; else it samples."""

    @property
    def lengths(self) -> tuple[int, ...]:
        """The lengths that are chosen from; none where no length is chosen."""
        return self.call_steps.steps if isinstance(self.call_steps, Lengths) else ()

    @property
    def choices(self) -> int:
        """Of how many a choice is one: the first skill with each length, then the next skill."""
        return len(self.skills) * max(1, len(self.lengths))

    @property
    def usual_steps(self) -> int | None:
        """Environment steps of a call, about; None: nothing says how long it lasts."""
        lengths = self.lengths
        return round(sum(lengths) / len(lengths)) if lengths else cast(Any, self.call_steps)

    @property
    def watches(self) -> bool:
        """Whether any skill needs to see transitions: to terminate, or because it remembers."""
        stops = any(s.defines("termination") for s in self.skills)
        remembers = any(p.start(1) for p in self.policies)
        return stops or remembers or self.interruption is not None

    def mask(self, obs: Array, age: Array | None = None) -> Array | None:
        """Which choices are allowed, (n, choices) bool; None: all, everywhere.

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
        """Whether some skill, here or in a hierarchy below, may not start everywhere."""
        below = (skills_below(p) for p in self.policies)
        own = any(s.defines("initiation") for s in self.skills)
        return own or any(skills.restricts for skills in below if skills is not None)

    def _may_start(self, i: int, obs: Array) -> Array:
        """Where skill ``i`` may start, (n,); a hierarchy only where one of its skills may."""
        skill, below = self.skills[i], skills_below(self.policies[i])
        may = np.ones(len(obs), bool)
        if skill.defines("initiation"):
            may = asked(skill, "initiation", obs, len(obs))
        if below is not None and below.restricts:
            may = may & below.startable(obs).any(axis=1)
        return may

    def start(self, n: int) -> Memory:
        """Memory of n environments in which no call has begun."""
        memory: Memory = {"skill": np.full(n, -1), "elapsed": np.zeros(n, np.int64)}
        if self.lengths:
            memory["limit"] = np.zeros(n, np.int64)
        for i, (skill, policy) in enumerate(zip(self.skills, self.policies, strict=True)):
            for k, v in policy.start(n).items():
                if v.dtype.kind not in "biuf":  # a checkpoint could not hold it
                    raise PolicyError(
                        f"skill {skill.name!r}: its policy remembers {k!r} as {v.dtype}; a memory "
                        "is an array of numbers whose first axis is the environment"
                    )
                memory[f"{i}.{k}"] = v
        return memory

    def skill_of(self, choice: Array) -> Array:
        """The skills that choices (k,) are of."""
        return choice // len(self.lengths) if self.lengths else choice

    def begin(self, memory: Memory, rows: Array, choice: Array) -> None:
        """Start the calls that ``choice`` (k,) says in environments ``rows`` (k,), in place."""
        skill = self.skill_of(choice)
        if self.lengths:
            memory["limit"][rows] = np.array(self.lengths)[choice % len(self.lengths)]
        changed = memory["skill"][rows] != skill
        memory["skill"][rows] = skill
        memory["elapsed"][rows] = 0
        for i, policy in enumerate(self.policies):
            fresh = policy.start(1)
            for k, v in fresh.items():
                memory[f"{i}.{k}"][rows[changed & (skill == i)]] = v[0]

    def forget(self, memory: Memory, rows: Array) -> None:
        """The episodes of environments ``rows`` are over: no call has begun, in place."""
        memory["skill"][rows] = -1

    def act(
        self,
        memory: Memory,
        rows: Array,
        obs: Array,
        rng: np.random.Generator | None = None,
        mask: Array | None = None,
    ) -> Array:
        """Actions of the running skills for ``obs`` (k, ...) of environments ``rows`` (k,).

        ``mask`` (k, A) bool are the actions that the environments allow. Trained skills and
        networks that return logits choose among them; other policies made elsewhere, and reflexes,
        may take another action, and then the environment decides what comes of it.
        """
        running = memory["skill"][rows]
        actions: Array | None = None
        for i, policy in enumerate(self.policies):
            mine = np.flatnonzero(running == i)
            if not len(mine):
                continue
            own = self._own(memory, i, rows[mine])
            allowed = allowed_rows(mask, mine)
            how: Any = {"deterministic": self.greedy, "rng": rng}
            try:
                some, after = policy.act(own, obs[mine], allowed, **how)
            except Exception as error:
                blame(error, f"skill {path_of(self.skills[i])!r}: its policy's act()")
            self._put(memory, i, rows[mine], after)
            if len(mine) == len(rows):
                actions = some
                break
            if actions is None:
                actions = np.zeros((len(rows), *some.shape[1:]), some.dtype)
            actions[mine] = some
        assert actions is not None, "act() before begin()"
        if not self.reflexes or self.reflexes_apart:
            return actions
        return self.override(obs, actions)[0]

    def override(self, obs: Array, actions: Array) -> tuple[Array, Array]:
        """Actions (k, …) with the reflexes in force, and (k,) bool: where one of them acted."""
        return apply_reflexes(self.reflexes, obs, actions, self.policies[0].action_space)

    def limit(self, i: int) -> int | None:
        """Steps after which a call of skill ``i`` is cut, its own limit included; None: never."""
        skill = self.skills[i]
        most = self.call_steps if skill.call_steps is None else skill.call_steps
        limits = [x for x in (most, skill.max_steps) if isinstance(x, int)]
        return min(limits) if limits else None

    def observe(self, memory: Memory, rows: Array, step: Step | None) -> Array:
        """Count a step of environments ``rows`` (k,); (k,) int8, ``Why`` their calls are over.

        That an episode ended is not noticed here.

        ``step`` may be None where nothing ``watches``; its ``elapsed`` and ``timed_out`` are set
        here, as seen by the running skill.
        """
        memory["elapsed"][rows] += 1
        elapsed, running = memory["elapsed"][rows], memory["skill"][rows]
        why = np.full(len(rows), Why.RUNNING, np.int8)
        if self.lengths:
            why[elapsed >= memory["limit"][rows]] = Why.LIMIT
        for i in range(len(self.skills)):
            if (limit := self.limit(i)) is not None:
                why[(running == i) & (elapsed >= limit)] = Why.LIMIT
        if step is None:
            return why
        for i, (skill, policy) in enumerate(zip(self.skills, self.policies, strict=True)):
            mine = np.flatnonzero(running == i)
            if not len(mine):
                continue
            part = skill_step(step, mine, elapsed[mine], skill.max_steps)
            own = self._own(memory, i, rows[mine])
            after = policy.observe(own, part)
            self._put(memory, i, rows[mine], after)
            why[mine[self._stuck(policy, after, part.next_obs)]] = Why.LIMIT
            if skill.defines("termination"):
                stops = asked(skill, "termination", part, len(mine), elapsed[mine], rows[mine])
                why[mine[stops]] = Why.OWN
        if self.interruption is not None:
            self._interrupt(self.interruption, running, step.next_obs, why)
        return why

    def _stuck(self, policy: Policy, memory: Memory, obs: Array) -> Array:
        """(m,) bool: the policy is a hierarchy that must decide, and none of its skills may start.

        Its own call ends there.
        """
        stuck = np.zeros(len(obs), bool)
        below = skills_below(policy)
        if below is not None and below.restricts:
            waits = np.flatnonzero(np.isin(memory[ENDED], (Why.RUNNING, Why.EPISODE), invert=True))
            stuck[waits] = ~below.startable(obs[waits]).any(axis=1)
        return stuck

    def _interrupt(self, how: Interruption, running: Array, obs: Array, why: Array) -> None:
        """Cut calls where it is worth more to decide anew, in place."""
        rows = np.flatnonzero(why == Why.RUNNING)
        if not len(rows):
            return
        worth, n = how.worth(obs[rows]), len(self.skills)
        own = worth[np.arange(len(rows)), running[rows]]
        may = self.startable(obs[rows])[:, :: max(1, len(self.lengths))]
        anew = np.where(may.any(axis=1), worth[:, n], -np.inf)  # else no skill could be called then
        why[rows[anew - own > how.margin]] = Why.INTERRUPTED

    def succeeded(self, memory: Memory, rows: Array, step: Step, why: Array) -> Array:
        """(k,) bool: the calls of environments ``rows`` (k,) that are over and have succeeded.

        The skill's ``success`` says so; of a skill without one, a call has that it ended by itself.

        Args:
            step: the one that ``observe`` was shown.
            why: what ``observe`` said of it, or that the episode is over.
        """
        found: Array = why == Why.OWN
        elapsed, running = memory["elapsed"][rows], memory["skill"][rows]
        for i, skill in enumerate(self.skills):
            if not skill.defines("success"):
                continue
            over = np.flatnonzero((running == i) & (why != Why.RUNNING))
            if len(over):
                part = skill_step(step, over, elapsed[over], skill.max_steps)
                found[over] = asked(skill, "success", part, len(over), elapsed[over], rows[over])
        return found

    def _own(self, memory: Memory, i: int, rows: Array) -> Memory:
        prefix = f"{i}."
        return {k[len(prefix) :]: v[rows] for k, v in memory.items() if k.startswith(prefix)}

    def _put(self, memory: Memory, i: int, rows: Array, own: Memory) -> None:
        for k, v in own.items():
            memory[f"{i}.{k}"][rows] = v


def skills_below(policy: Policy | None) -> SkillSet | None:
    """The skills of a policy that is a hierarchy; None: it is none."""
    found = getattr(policy, "skills", None)
    return found if isinstance(found, SkillSet) else None


__all__ = ["Interruption", "SkillSet", "Why", "skill_step", "skills_below"]
