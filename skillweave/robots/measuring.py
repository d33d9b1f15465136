"""``sw.handovers``: which of several ready skills can follow which, measured by playing them."""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.interrupts import deferred, requested
from skillweave._internal.messages import short
from skillweave._internal.notices import notice
from skillweave._internal.seeding import Seeds
from skillweave.api import Hierarchy
from skillweave.calls.handover import START
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError, EnvError
from skillweave.hierarchy.fitting import ready_policies
from skillweave.hierarchy.roles import roles_of
from skillweave.reporting.progress import EpisodeProgress
from skillweave.robots.aims import Aim, aims_of
from skillweave.robots.chains import ChainPlayer, Outcome, PlannedCall, Robot
from skillweave.robots.measured import Entry, MeasuredHandovers
from skillweave.robots.variation import Variation
from skillweave.schema import AtLeastOne, fitted
from skillweave.skills import Skill
from skillweave.skills.skill_set import SkillSet, skills_below

MOST = 60
"""Entries of a pair that differs from fresh starts in the first ones."""
DIFFERS = 3
"""A pair is measured further where it has lost so many robots more than it has won."""
PATIENCE = 3
"""Tries for each wanted entry: the first skill may fail before."""

Cell = tuple[int, int]
"""A skill's place, and before it that of the skill before; −1: a fresh start."""


class Ready(Skill):
    """A skill that is a ready policy alone."""

    def __init__(self, name: str, policy: Any) -> None:
        self.name = name
        self.policy = policy


@checked_names
def handovers(
    env: Any,
    skills: Any,
    *,
    steps: int | Mapping[str, int],
    stays: Any = None,
    done: Any = None,
    follows: Any = None,
    calls: int = 20,
    vary: Mapping[str, Any] | None = None,
    cut: tuple[int, int] | None = None,
    seed: int = 0,
    quiet: bool = False,
) -> MeasuredHandovers:
    """Play each skill after each other one, and count how often it is done there.

    Nothing is trained, and no selector is needed. Each entry is paired with a fresh start of the
    same robot, so that what is lost by the skill before is told apart from what the skill cannot do
    anyway. Pairs that differ in the first entries are played on more robots, ``MOST`` at most.
    Ctrl-C ends it with what is measured so far.

    A call is done if ``stays`` is true in each of its steps, if ``done`` is true in one of them
    (both, where both are given), and then if ``follows`` says so; without ``stays`` and ``done`` by
    the skill's own ``success``. A skill enters only where the call before was done, but for
    ``follows``; it is cut at a step that is drawn, unless it has ``done``.

    Args:
        env: an ``EnvSpec``, a Gymnasium id, or a function that makes an environment.
        skills: by name, policies (as of a skill's ``policy``) or skills; a list of skills; or a
            policy of skills (``run.policy``).
        steps: the most steps of a call; or by skill.
        stays: a function of observations (n, …) or of a ``Step`` that returns (n,) bool: the robot
            is upright, for example. One for all skills, or by skill.
        done: in the same way, what must happen once within the call.
        follows: a function of a ``Step`` whose rows are the steps of one call, in the order of
            time, that returns one True or False: the robot has moved as fast as it was asked to.
            One for all skills, or by skill.
        calls: entries of each pair.
        vary: keywords of the environment that are drawn for each robot: (lowest, highest), or a
            list of values. None: robots differ by what ``reset(seed=...)`` draws.
        cut: the fewest and the most steps of the first call; None: from half of its steps to all.
        seed: of robots and cuts.
        quiet: no progress.

    Raises:
        DeclarationError: an argument is wrong, a skill has no policy or has goals, or nothing says
            when a call is done.
        PolicyError: a policy does not fit the environment.
        EnvError: the environment cannot be made with these keywords, ignores its seed, or its time
            limit is too short.
    """
    calls = fitted(AtLeastOne, calls, "calls")
    variation = Variation({} if vary is None else vary)
    spec = env if isinstance(env, EnvSpec) else EnvSpec(env)
    robots = _robots(variation, Seeds(fitted(int, seed, "seed")) / "robots")
    first = next(robots)
    declared = EnvSpec(spec.env, {**spec.kwargs, **first.settings}, spec.wrappers)
    ready = _skill_set(declared, skills)
    names = [skill.name for skill in ready.skills]
    most = _steps_of(steps, names)
    aims = aims_of(ready.skills, stays, done, follows)
    cuts = _cuts(cut, most)
    longest = max(*most, *(high for _, high in cuts))
    with ChainPlayer(ready, aims, spec, longest) as player:
        plan = _Plan(player, aims, most, cuts, calls)
        _check_repeats(player, first, most[0])
        started = time.monotonic()
        stopped = False
        try:
            with deferred("after this call"):
                plan.measure(first, robots, quiet=quiet)
        except KeyboardInterrupt:
            stopped = True
            notice("handovers() was stopped: the table has what was measured until then")
    return MeasuredHandovers(
        tuple(names),
        tuple(plan.entries),
        calls,
        tuple(most),
        str(variation),
        tuple(plan.no_entry.items()),
        player.steps,
        time.monotonic() - started,
        stopped,
    )


class _Plan:
    """Which calls are played on which robot, and what came out."""

    def __init__(
        self,
        player: ChainPlayer,
        aims: Sequence[Aim],
        steps: Sequence[int],
        cuts: Sequence[tuple[int, int]],
        calls: int,
    ) -> None:
        self.entries: list[Entry] = []
        self.no_entry: dict[str, tuple[int, int]] = {}
        """By the name of a first skill: tries after which no other could enter, and all."""
        self._player = player
        self._aims = aims
        self._names = [aim.skill.name for aim in aims]
        self._steps = steps
        self._cuts = cuts
        self._calls = calls
        places = range(len(aims))
        self._cells: list[Cell] = [(j, i) for j in places for i in (-1, *places) if i != j]
        self._count = dict.fromkeys(self._cells, 0)
        self._tries = dict.fromkeys(self._cells, 0)
        self._lost = dict.fromkeys(self._cells, 0)
        """Robots that the pair lost, less those that it won."""
        self._targets = dict.fromkeys(self._cells, calls)

    def measure(self, first: Robot, more: Iterator[Robot], *, quiet: bool) -> None:
        """Play until each cell has its entries, or is tried too often."""
        robot = first
        with EpisodeProgress(len(self._cells) * self._calls, quiet=quiet, name="calls") as shown:
            while (wanted := self._wanted()) and not requested():
                self._on_robot(robot, wanted, shown)
                robot = next(more)

    def _wanted(self) -> list[Cell]:
        """Return the cells that need entries, the rarest first."""
        cells = [
            cell
            for cell in self._cells
            if self._count[cell] < self._targets[cell]
            and self._tries[cell] < PATIENCE * self._targets[cell]
        ]
        return sorted(cells, key=lambda cell: self._count[cell])

    def _on_robot(self, robot: Robot, wanted: Sequence[Cell], shown: EpisodeProgress) -> None:
        """Play the wanted cells on one robot, with the fresh starts that they are paired with."""
        alone = dict[int, bool]()  # of the skills that were played from a fresh start
        fails = set[int]()  # first skills that this robot cannot carry out
        for j, i in wanted:
            if i in fails:
                self._tries[j, i] += 1
                continue
            before = self._player.steps
            found = self._play_pair(robot, j, i) if i >= 0 else None
            if i >= 0 and found is None:
                fails.add(i)
            elif j not in alone:
                alone[j] = self._play_alone(robot, j)
            if found is not None:
                self._compare((j, i), alone[j], found.counts)
            shown.count(self._player.steps - before, 1)
            if requested():
                return

    def _play_alone(self, robot: Robot, j: int) -> bool:
        """Play a skill from a fresh start; return whether it was done."""
        (found,) = self._player.play(robot, [PlannedCall(j, self._steps[j])])
        self._count[j, -1] += 1
        self._tries[j, -1] += 1
        self._add(robot, START, 0, found)
        return found.counts

    def _play_pair(self, robot: Robot, j: int, i: int) -> Outcome | None:
        """Play a skill after another one; return its call, None where that one was not done."""
        first = PlannedCall(i, self._cut(robot, i), follows=False)
        found = self._player.play(robot, [first, PlannedCall(j, self._steps[j])])
        self._tries[j, i] += 1
        name = self._names[i]
        entered = len(found) == 2  # else it was not done, or ended the episode
        failed, tries = self.no_entry.get(name, (0, 0))
        self.no_entry[name] = failed + (not entered), tries + 1
        if not entered:
            return None
        self._count[j, i] += 1
        self._add(robot, name, found[0].steps, found[1])
        return found[1]

    def _compare(self, cell: Cell, alone: bool, after: bool) -> None:
        """Count a robot that a pair has lost or won; measure further where it is many."""
        self._lost[cell] += int(alone) - int(after)
        if self._count[cell] == self._calls and abs(self._lost[cell]) >= DIFFERS:
            self._targets[cell] = max(MOST, self._calls)

    def _cut(self, robot: Robot, i: int) -> int:
        """Return the steps after which the first skill is cut: on a robot always the same."""
        if self._aims[i].done is not None or self._aims[i].by_success:
            return self._steps[i]
        low, high = self._cuts[i]
        return int((Seeds(robot.seed) / "cut" / i).numpy().integers(low, high + 1))

    def _add(self, robot: Robot, after: str, cut: int, found: Outcome) -> None:
        self.entries.append(
            Entry(
                robot.number,
                robot.seed,
                after,
                self._names[found.skill],
                cut,
                found.steps,
                found.counts,
                found.done,
                found.refused,
                robot.settings,
            )
        )


def _robots(variation: Variation, seeds: Seeds) -> Iterator[Robot]:
    """Yield robots without end."""
    for number in count():
        own = seeds / number
        yield Robot(number, own.integer(), variation.draw((own / "settings").numpy()))


def _skill_set(spec: EnvSpec, skills: Any) -> SkillSet:
    """Return skills with their policies, fitted to an environment."""
    if (ready := skills_below(skills)) is not None:
        found = ready
    else:
        declared = _declared(skills)
        names = [skill.name for skill in declared]
        hierarchy = Hierarchy(spec, declared, selector=lambda obs: names[:1] * len(obs))
        roles = roles_of(hierarchy)
        policies = ready_policies(roles)
        for path in roles.outermost.skills:
            if path not in policies:
                raise DeclarationError(
                    f"skill {path!r} has no policy: handovers() plays ready skills alone; train it "
                    "first, and give run.policy"
                )
        found = roles.outermost.skill_set(policies)
    for skill in found.skills:
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


def _check_repeats(player: ChainPlayer, robot: Robot, steps: int) -> None:
    """Raise an EnvError where the same robot does otherwise when it is played again."""
    once, again = (player.play(robot, [PlannedCall(0, steps)])[0] for _ in range(2))
    if once.steps != again.steps or not np.array_equal(once.last, again.last):
        raise EnvError(
            f"reset(seed={robot.seed}) and the same skill came to another end when they were "
            "played again, so an entry cannot be compared with a fresh start of the same robot: "
            "let the environment draw all that is random from self.np_random, which reset(seed=) "
            "seeds"
        )
