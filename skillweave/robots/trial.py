"""What is measured: skills with their aims, and the robots on which they are played."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np

from skillweave._internal.messages import short
from skillweave._internal.seeding import Seeds
from skillweave.api import Hierarchy
from skillweave.calls.handover import START
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError, EnvError
from skillweave.hierarchy.fitting import check_settings, ready_policies
from skillweave.hierarchy.roles import roles_of
from skillweave.robots.aims import Aim, aims_of
from skillweave.robots.chains import ChainPlayer, OpenRobot, PlannedCall, Robot
from skillweave.robots.variation import Variation, with_settings
from skillweave.schema import AtLeastOne, fitted
from skillweave.skills import Skill
from skillweave.skills.skill_set import SkillSet, skills_below


class Ready(Skill):
    """A skill that is a ready policy alone."""

    def __init__(self, name: str, policy: Any) -> None:
        self.name = name
        self.policy = policy


def robots_of(variation: Variation, seed: int, first: int = 0) -> Iterator[Robot]:
    """Yield the robots of a seed without end, from a number on."""
    seeds = Seeds(seed) / "robots"
    for number in count(first):
        own = seeds / number
        yield Robot(number, own.integer(), variation.draw((own / "settings").numpy()))


@dataclass(frozen=True, eq=False)
class RobotTrial:
    """Skills of one robot, what their calls are for, and how robots differ."""

    spec: EnvSpec
    """Of the environment, without what is drawn."""
    skills: SkillSet
    aims: tuple[Aim, ...]
    steps: tuple[int, ...]
    """The most steps of a call, by skill."""
    cuts: tuple[tuple[int, int], ...]
    """The fewest and the most steps of a first call, by skill."""
    variation: Variation
    seed: int

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the skills."""
        return tuple(skill.name for skill in self.skills.skills)

    def robots(self, first: int = 0) -> Iterator[Robot]:
        """Return robots without end, from a number on."""
        return robots_of(self.variation, self.seed, first)

    def cut(self, robot: Robot, i: int) -> int:
        """Return the steps after which skill ``i`` is cut: on a robot always the same."""
        if self.aims[i].done is not None or self.aims[i].by_success:
            return self.steps[i]
        low, high = self.cuts[i]
        return int((Seeds(robot.seed) / "cut" / i).numpy().integers(low, high + 1))

    def player(
        self, where: OpenRobot, skills: SkillSet | None = None, more: int = 0
    ) -> ChainPlayer:
        """Return a player of the skills.

        Args:
            where: the environment.
            skills: others in their place.
            more: steps by which a call may be longer.
        """
        longest = max(*self.steps, *(high for _, high in self.cuts)) + more
        return ChainPlayer(self.skills if skills is None else skills, self.aims, where, longest)


def make_trial(
    env: Any,
    skills: Any,
    steps: Any,
    stays: Any,
    done: Any,
    follows: Any,
    vary: Any,
    cut: Any,
    seed: Any,
) -> RobotTrial:
    """Return a trial of the arguments of ``handovers``."""
    variation = Variation({} if vary is None else vary)
    spec = env if isinstance(env, EnvSpec) else EnvSpec(env)
    seed = fitted(int, seed, "seed")
    first = next(robots_of(variation, seed))
    ready = _skill_set(with_settings(spec, first.settings), skills)
    most = _steps_of(steps, [skill.name for skill in ready.skills])
    aims = aims_of(ready.skills, stays, done, follows)
    return RobotTrial(
        spec, ready, tuple(aims), tuple(most), tuple(_cuts(cut, most)), variation, seed
    )


def _skill_set(spec: EnvSpec, skills: Any) -> SkillSet:
    """Return skills with their policies, fitted to an environment."""
    if (ready := skills_below(skills)) is not None:
        found = ready
    else:
        declared = _declared(skills)
        names = [skill.name for skill in declared]
        hierarchy = Hierarchy(spec, declared, selector=lambda obs: names[:1] * len(obs))
        roles = roles_of(hierarchy)
        check_settings(roles)
        policies = ready_policies(roles)
        for path in roles.outermost.skills:
            if path not in policies:
                raise DeclarationError(
                    f"skill {path!r} has no policy: handovers() plays ready skills alone; train it "
                    "first, and give run.policy"
                )
        found = roles.outermost.skill_set(policies)
    for skill in found.skills:
        if skill.name == START:
            raise DeclarationError(
                f"a skill is named {START!r}, which means a fresh start here: give it another name"
            )
        if skill.goal_space is not None:
            raise DeclarationError(
                f"skill {skill.name!r} has goals, and handovers() would not know which to give: "
                "make a skill of each goal that you need, policy.with_goal((1.0, 0.0))"
            )
    return found


def _declared(skills: Any) -> list[Skill]:
    """Return the given skills, each with its name."""
    if isinstance(skills, Mapping):
        declared = []
        for name, value in skills.items():
            if isinstance(value, Skill):
                skill: Skill = copy.copy(value)
                skill.name = name
            else:
                skill = Ready(name, value)
            declared.append(skill)
    elif isinstance(skills, Sequence) and all(isinstance(skill, Skill) for skill in skills):
        declared = list(skills)
    else:
        declared = []
    if not declared:
        raise DeclarationError(
            f"skills is {short(skills)}; give policies by name, {{'walk': walk, 'wave': wave}}, a "
            "list of skills, or run.policy"
        )
    return declared


def _steps_of(steps: Any, names: Sequence[str]) -> list[int]:
    """Return the most steps of a call of each skill."""
    if not isinstance(steps, Mapping):
        return [fitted(AtLeastOne, steps, "steps")] * len(names)
    if missing := [name for name in names if name not in steps]:
        raise DeclarationError(f"steps has no number for the skill {missing[0]!r}")
    if unknown := [name for name in steps if name not in names]:
        raise DeclarationError(f"steps names {short(unknown[0])}, which is no skill")
    return [fitted(AtLeastOne, steps[name], f"steps[{name!r}]") for name in names]


def _cuts(cut: Any, most: Sequence[int]) -> list[tuple[int, int]]:
    """Return the fewest and the most steps of a first call, by skill."""
    if cut is None:
        return [(max(1, steps // 2), steps) for steps in most]
    low, high = fitted(tuple[AtLeastOne, AtLeastOne], cut, "cut")
    if low > high:
        raise DeclarationError(f"cut is {cut}; it must be (fewest, most) steps of the first call")
    return [(low, high)] * len(most)


def check_repeats(trial: RobotTrial, player: ChainPlayer, robot: Robot) -> None:
    """Raise an EnvError where the same robot does otherwise when a skill is played again."""
    for i, name in enumerate(trial.names):
        call = [PlannedCall(i, trial.steps[i], follows=False)]
        once, again = (player.play(robot, call)[0] for _ in range(2))
        if once.steps != again.steps or not np.array_equal(once.last, again.last):
            raise EnvError(
                f"reset(seed={robot.seed}) and the skill {name!r} came to another end when they "
                "were played again, so an entry cannot be compared with a fresh start of the same "
                "robot: let the environment draw all that is random from self.np_random, which "
                "reset(seed=) seeds, and let no policy keep a state of its own (state=)"
            )
