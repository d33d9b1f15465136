"""Calls one after another on one robot: an environment with settings and a seed of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self

import numpy as np

from skillweave._internal.seeding import Seeds, global_generators
from skillweave.envs.engine import Engine
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import EnvError
from skillweave.experience.play import SeededEpisodes, play
from skillweave.policies.core import EPISODE, RUNNING, Array, Memory, RowPolicy, Step, Turn, part_of
from skillweave.robots.aims import Aim
from skillweave.robots.variation import with_settings
from skillweave.skills.lengths import Lengths
from skillweave.skills.skill_set import SkillSet, acting_policy, within


@dataclass(frozen=True)
class Robot:
    """One robot: the keywords that were drawn for it, and the seed of its resets."""

    number: int
    seed: int
    settings: dict[str, Any]


@dataclass(frozen=True)
class PlannedCall:
    """A call to be played: a skill's place, and its most steps."""

    skill: int
    steps: int
    follows: bool = True
    """It is judged whether what was asked for is followed."""


@dataclass(frozen=True)
class Outcome:
    """A call that was played."""

    skill: int
    steps: int
    done: bool
    followed: bool
    """What was asked for was followed, as far as it is judged; of calls that are done."""
    refused: bool
    """The skill may not start there."""
    last: Array
    """(*obs_shape), the observation after it."""

    @property
    def counts(self) -> bool:
        """True if it was done, and did what was asked for."""
        return self.done and self.followed


class Listed(RowPolicy):
    """A selector that chooses what a list says, in one environment."""

    def __init__(self) -> None:
        self.choices: list[int] = []
        """What is chosen next, from the last one on."""
        self.may_start: Callable[[Array], Array] | None = None
        """Returns which choices may start in observations, (n, choices); None: all may."""
        self.refused = False
        """The latest one may not start there: what follows does not count."""

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the next choice (1,)."""
        choice = self.choices.pop()
        self.refused = self.may_start is not None and not self.may_start(obs)[0, choice]
        return np.array([choice])


class OpenRobot:
    """The environment of one robot at a time; a context manager, as it stays open.

    Args:
        spec: of the environment, without what is drawn.
    """

    def __init__(self, spec: EnvSpec) -> None:
        self.name = spec.name
        self.steps = 0
        """Steps so far."""
        self._spec = replace(spec, engine="sync")  # the only one whose resets take seeds
        self._engine: Engine | None = None
        self._settings: dict[str, Any] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._close()

    def engine(self, robot: Robot) -> Engine:
        """Return the robot's environment: the open one where its settings are the same."""
        if self._engine is None or robot.settings != self._settings:
            self._close()
            self._engine = make_engine(with_settings(self._spec, robot.settings), 1)
            self._settings = robot.settings
        return self._engine

    def _close(self) -> None:
        if self._engine is not None:
            self._engine.close()
            self._engine = None


class ChainPlayer:
    """Plays calls one after another.

    Args:
        skills: with their policies.
        aims: what a call of each is for.
        where: the environment.
        longest: the most steps of a call.
    """

    def __init__(
        self, skills: SkillSet, aims: Sequence[Aim], where: OpenRobot, longest: int
    ) -> None:
        self.aims = tuple(aims)
        self._where = where
        self._longest = longest
        self._listed = Listed()
        lengths = Lengths(*range(1, longest + 1))
        whole = replace(skills, call_steps=lengths, interruption=None)
        self._policy = acting_policy(whole, self._listed)
        hierarchy = within(self._policy)
        if hierarchy.restricts:
            self._listed.may_start = hierarchy.may_start
            hierarchy.restricts = False  # where none may start, the call is refused, no more
        self._limits = [skills.limit(i) for i in range(len(skills.skills))]

    def play(self, robot: Robot, calls: Sequence[PlannedCall]) -> list[Outcome]:
        """Play calls from a fresh start of a robot, until one of them is not done.

        Raises:
            EnvError: the environment's time limit comes before the calls are over.
        """
        seeds = Seeds(robot.seed) / "chain"
        with global_generators(seeds):
            return self._play(self._where.engine(robot), robot, calls, seeds.numpy())

    def _play(
        self, engine: Engine, robot: Robot, calls: Sequence[PlannedCall], rng: np.random.Generator
    ) -> list[Outcome]:
        self._listed.choices = [c.skill * self._longest + c.steps - 1 for c in reversed(calls)]
        episodes = SeededEpisodes(engine, [robot.seed], len(calls) * self._longest + 1)
        found = list[Outcome]()
        one = _OpenCall(self.aims[calls[0].skill])
        for now in play(self._policy, episodes, rng=rng):
            self._where.steps += 1
            call = calls[len(found)]
            if self._listed.refused:
                found.append(Outcome(call.skill, 0, False, False, True, now.step.obs[0]))
                break
            end = int(now.memory["end"][0])
            if not one.add(now.step, ended=end != RUNNING):
                continue
            found.append(one.played(call))
            more = len(found) < len(calls)
            cut_off = more or (self._is_short(one, call, end) and not one.reached)
            if now.step.truncated[0] and one.ok and cut_off:
                raise EnvError(
                    f"{self._where.name}: its time limit ended an episode after "
                    f"{int(now.step.elapsed[0]):,} steps, before {len(calls)} calls were over: "
                    "give it a longer limit (max_episode_steps, for example), or shorter calls "
                    "(steps=, cut=). An episode that the robot ends, by a fall, is to be "
                    "terminated, not truncated"
                )
            if not more or not found[-1].done or now.over[0]:
                break
            one = _OpenCall(self.aims[calls[len(found)].skill])
        return found

    def _is_short(self, one: _OpenCall, call: PlannedCall, end: int) -> bool:
        """Return whether the episode's end has cut a call that would have gone on."""
        limit = self._limits[call.skill]
        whole = call.steps if limit is None else min(call.steps, limit)
        return end == EPISODE and len(one) < whole


class _OpenCall:
    """A call in the making."""

    def __init__(self, aim: Aim) -> None:
        self.aim = aim
        self.ok = True
        """What has to stay true has been true so far."""
        self.reached = False
        """What has to happen once has happened."""
        self._steps = 0
        self._kept: list[Step] = []
        self._last: Step | None = None

    def __len__(self) -> int:
        return self._steps

    def add(self, step: Step, *, ended: bool) -> bool:
        """Take in the next step; return whether the call is over, or lost."""
        aim = self.aim
        self._steps += 1
        step = part_of(step, np.array([self._steps]), max_steps=aim.skill.max_steps)
        self._last = step
        if aim.follows is not None:
            self._kept.append(step)
        if aim.stays is not None:
            self.ok = aim.holds(aim.stays, step)
        before = self.reached
        if aim.done is not None:
            self.reached = before or aim.holds(aim.done, step)
        if aim.by_success and ended:
            self.reached = aim.succeeds(step)
        if step.terminated[0] and aim.stays is not None and not (self.reached and not before):
            self.ok = False  # the episode is over before the call is
        return ended or not self.ok

    def played(self, call: PlannedCall) -> Outcome:
        """Return the call, which is over."""
        assert self._last is not None
        done = self.ok and (self.reached or (self.aim.done is None and not self.aim.by_success))
        followed = done and (not call.follows or self.aim.is_followed(self._kept))
        return Outcome(
            call.skill, self._steps, done, followed, False, self._last.next_obs[0].copy()
        )
