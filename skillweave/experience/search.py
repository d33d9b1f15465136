"""The search for where a skill may start: calls of other skills, or random actions.

A skill that learns apart acts only where it may start. Until then others act in its environment,
while it acts in the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skillweave.envs.engine import Engine
from skillweave.envs.env_infos import allowed_rows, random_actions
from skillweave.errors import TrainingError
from skillweave.policies.core import (
    RUNNING,
    Array,
    Step,
    Turn,
    World,
    flat,
    observed,
    part_of,
    restart,
)
from skillweave.skills import Skill, call_method
from skillweave.skills.skill_set import SkillSet, acting_policy, within
from skillweave.spaces import obs_dtype, obs_shape

PATIENCE = 5_000
"""Steps of an environment in search of a state where the skill may start, if none is ever found."""
NAMED_SHARE = 0.5
"""Share of the episodes that start after a call of a named skill; the others start as usual, so
that what a skill can do from there is not forgotten."""


@dataclass(frozen=True)
class Starts:
    """Settings of how calls of a skill start that learns apart."""

    skills: SkillSet | None = None
    """Skills that can act already; None: random actions lead to where it may start."""
    calls: int = 0
    """The most calls of these that come first; their number is drawn evenly."""
    search_steps: int | None = None
    """Reset an episode in which it cannot start within this many steps; None: it goes on."""
    episode_calls: int = 1
    """The most calls of the skill in an episode."""
    after: tuple[str, ...] = ()
    """Names among ``skills``; in a share of the episodes a call of one of them comes last before
    the skill starts."""
    named_share: float = NAMED_SHARE
    """The share of episodes in which a named call comes last."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the skills that can act already."""
        return () if self.skills is None else tuple(s.name for s in self.skills.skills)

    @property
    def named(self) -> tuple[str, ...]:
        """The names in ``after`` of skills that can act already."""
        return tuple(name for name in self.names if name in self.after)

    @property
    def draws(self) -> bool:
        """True if calls of other skills come first, a number that is drawn for each episode."""
        return self.skills is not None and (self.calls > 0 or bool(self.named))

    def search(self, skill: Skill | None, engine: Engine) -> Search | None:
        """Return the search for a start of ``skill``; None: it starts wherever episodes do."""
        if skill is None or not (
            self.draws or self.episode_calls > 1 or skill.defines("initiation")
        ):
            return None
        return Search(skill, self, engine)


class Search:
    """The search for where a skill may start, in a collector's N environments.

    It calls skills at random wherever they may start, and acts at random where none may. These
    skills sample, as a greedy skill may go round in circles forever. Where skills are named, all
    act as a selector lets them act, because their ends are the states to learn in.

    Args:
        skill: the skill that is to start.
        starts: how.
        engine: the environments.
    """

    def __init__(self, skill: Skill, starts: Starts, engine: Engine) -> None:
        n = engine.num_envs
        self.skill = skill
        self.starts = starts
        self._space = engine.action_space
        self._restricted = skill.defines("initiation")
        self._named = starts.named
        self._is_named = np.array([name in starts.after for name in starts.names], bool)
        self.kept: dict[str, Array] = {
            "elapsed": np.zeros(n, np.int64),  # steps of the skill's call
            "calls_made": np.zeros(n, np.int64),  # of the skill, in the open episode
            "searching": np.ones(n, bool),  # the skill may not start yet
            "searched": np.zeros(n, np.int64),  # steps since it last might
            "found": np.zeros(n, bool),  # it ever might
            "calls_left": np.zeros(n, np.int64),  # that come first; −1: to be drawn
        }
        """State of the search in each environment, (N, …) each; changed in place."""
        if self._named:
            self.kept["named"] = np.zeros(n, bool)  # the last of these calls must be named
            self.kept["sought"] = np.zeros(n, np.int64)  # steps until one ended; −1: one has
        self.holds = False
        """The last action counts for who is called."""
        if starts.skills is not None:
            # Not outermost: the collector keeps the last action, as the skill itself acts, too.
            skills = starts.skills if self._named else replace(starts.skills, greedy=False)
            self._policy = acting_policy(skills, outermost=False)
            self._hierarchy = within(self._policy)
            self.memory = self._policy.start(n)
            self.kept |= flat(self.memory, "starters.")
            self.holds = self._policy.holds

    def playing(self, obs: Array, world: World) -> tuple[Array, Array]:
        """Return the environments (k,) in which the skill acts, and the others; obs are of all N.

        Where a call of it is to start, how many calls of others come first is drawn.
        """
        ids = np.flatnonzero(self.kept["calls_left"] < 0)
        rng = world.rng
        if len(ids):
            assert rng is not None
            left = rng.integers(self.starts.calls + 1, size=len(ids))
            if self._named:
                named = rng.random(len(ids)) < self.starts.named_share
                self.kept["named"][ids] = named
                left += named
            self.kept["calls_left"][ids] = left
            self._look(ids, obs)
        searching = self.kept["searching"]
        return np.flatnonzero(~searching), np.flatnonzero(searching)

    def act(self, ids: Array, obs: Array, mask: Array | None, world: World) -> Array:
        """Return actions (k, …) in environments ``ids`` (k,); obs and mask are of all N."""
        rng = world.rng
        assert rng is not None
        if self.starts.skills is None:
            return random_actions(self._space, len(ids), rng, allowed_rows(mask, ids))
        self._call(ids[~self._runs(ids)], obs, rng)
        runs = self._runs(ids)
        called = ids[runs]
        free = ids[~runs]
        action: Array = np.zeros((len(ids), *obs_shape(self._space)), obs_dtype(self._space))
        if len(called):
            turn = Turn(world, allowed_rows(mask, called))
            action[runs] = self._policy.act(self.memory, called, obs[called], turn)
        if len(free):
            allowed = allowed_rows(mask, free)
            action[~runs] = random_actions(self._space, len(free), rng, allowed)
        return action

    def observe(self, ids: Array, step: Step) -> Array:
        """Notice a step of environments ``ids`` (k,) that search, of all N.

        Returns:
            Those that have searched for long enough, and are to be reset.

        Raises:
            TrainingError: nothing is ever found.
        """
        left = self.kept["calls_left"]
        last = self._last(ids)
        is_named = np.zeros(len(ids), bool)
        free = ids
        if self.starts.skills is not None:
            runs = self._runs(ids)
            called = ids[runs]
            rows = np.flatnonzero(runs)
            is_named[rows] = self._is_named[self.memory["skill"][called]]
            if len(called):
                part = part_of(step, step.elapsed[called], called)
                self._policy.observe(self.memory, called, part)
            free = ids[~self._runs(ids)]
        left[free] = np.maximum(left[free] - 1, 0)
        if self._named:
            left[ids[last & ~is_named]] = 1  # another call must follow
            self._seek(ids)
        waiting = self._look(ids, step.next_obs)
        enough = np.zeros(len(waiting), bool)
        if self.starts.search_steps is not None:
            enough = step.elapsed[waiting] >= self.starts.search_steps
        called = self.kept["calls_made"][waiting] > 0  # after a call of its own, at once
        return waiting[np.where(called, left[waiting] == 0, enough)]

    def again(self, ids: Array) -> Array:
        """Return those of environments ``ids`` (k,) in which the skill is called once more.

        Its calls have ended there at a limit, and the episodes go on.
        """
        made = self.kept["calls_made"]
        made[ids] += 1
        return ids[made[ids] < self.starts.episode_calls]

    def begin(self, ids: Array, obs: Array, *, episodes: bool) -> None:
        """Let new calls of the skill start in environments ``ids`` (k,), perhaps in new episodes.

        How long it was searched counts on from episode to episode; obs are of all N.
        """
        self.kept["elapsed"][ids] = 0
        if episodes:
            self.kept["calls_made"][ids] = 0
        self.kept["searching"][ids] = True
        self._stop(ids)
        self.kept["calls_left"][ids] = -1 if self.starts.draws else 0
        if not self.starts.draws:
            self._look(ids, obs)

    @property
    def given_up(self) -> Array:
        """Return the environments in which the skill seems unable to start, (N,) bool."""
        found: Array = self.kept["searched"] > PATIENCE
        return found

    def _runs(self, ids: Array) -> Array:
        """Return where a call of another skill runs, (k,) bool."""
        runs: Array = self.memory["end"][ids] == RUNNING
        return runs

    def _stop(self, ids: Array) -> None:
        """End other skills' calls in environments ``ids`` (k,): the skill or an episode starts."""
        if self.starts.skills is not None:
            restart(self._policy, self.memory, ids)

    def _last(self, ids: Array) -> Array:
        """Return where the next call must be a named skill's, (k,) bool."""
        if not self._named:
            return np.zeros(len(ids), bool)
        last: Array = self.kept["named"][ids] & (self.kept["calls_left"][ids] == 1)
        return last

    def _call(self, ids: Array, obs: Array, rng: np.random.Generator) -> None:
        """Start calls in environments ``ids`` (k,) where some skill may start; obs are of all N."""
        if not len(ids):
            return
        may = self._hierarchy.may_start(obs[ids])
        is_named = np.repeat(self._is_named, may.shape[1] // len(self._is_named))
        restricted = self._last(ids) & (may & is_named).any(axis=1)
        may = np.where(restricted[:, None], may & is_named, may)
        chance = np.where(may, rng.random(may.shape), -1.0)
        some = may.any(axis=1)
        choice = chance[some].argmax(axis=1)
        here = obs[ids[some]]
        skill = self._hierarchy.skill_of(choice)
        found = dict[int, Array]()
        for i, goals in self._hierarchy.goals.items():
            mine = np.flatnonzero(skill == i)
            if len(mine):
                found[i] = goals.start(len(choice))
                found[i][mine] = goals.draw(here[mine], rng)
        self._hierarchy.begin(self.memory, ids[some], choice, found)

    def _look(self, ids: Array, obs: Array) -> Array:
        """Find where the skill may start now among environments ``ids`` (k,) that search.

        Args:
            obs: (N, …), of all.

        Returns:
            Those in which it may not.
        """
        if not len(ids):
            return ids
        holds = np.ones(len(ids), bool)
        if self._restricted:
            holds = call_method(self.skill, "initiation", obs[ids], ids)
        found = ids[holds & (self.kept["calls_left"][ids] == 0)]
        waiting = ids[~holds]
        self.kept["searching"][found] = False
        self.kept["searched"][found] = 0
        self.kept["found"][found] = True
        self._stop(found)
        self.kept["searched"][waiting] += 1
        if self.kept["searched"].max() > PATIENCE and not self.kept["found"].any():
            raise TrainingError(
                f"skill {self.skill.name!r}: initiation() was never true in {PATIENCE:,} steps "
                f"{self._sought()}, so there is nothing to train on; the latest observation was "
                f"{observed(obs[waiting[0]])}. Widen it; or put the skills that lead to where "
                "it holds before it in skills, as skills are trained in that order; or give an "
                "environment that starts where it holds"
            )
        return waiting

    def _seek(self, ids: Array) -> None:
        """Count the steps in environments ``ids`` (k,) until a call of a named skill has ended."""
        sought = self.kept["sought"]
        named = ids[self.kept["named"][ids]]
        sought[named[self.kept["calls_left"][named] == 0]] = -1
        sought[named] += sought[named] >= 0
        if sought.max() > PATIENCE and sought.min() >= 0:
            names = " or ".join(map(repr, self._named))
            raise TrainingError(
                f"skill {self.skill.name!r} is to start after a call of {names} (start_calls), but "
                f"none has ended in {PATIENCE:,} steps: perhaps its initiation() is never true, or "
                "its calls have no limit. Give it max_steps, or leave it out of start_calls"
            )

    def _sought(self) -> str:
        """Return words on the search for a start, for messages."""
        by = "random acting"
        if self.starts.skills is not None:
            by = f"calling {', '.join(map(repr, self.starts.names))}"
        if self.starts.search_steps is None:
            return f"of {by}"
        return f"of {by}, reset after {self.starts.search_steps:,} of them (search_steps)"
