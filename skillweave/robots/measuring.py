"""``sw.handovers``: which of several ready skills can follow which, measured by playing them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from skillweave._internal.arguments import checked_names
from skillweave._internal.interrupts import deferred, requested
from skillweave._internal.notices import notice
from skillweave.calls.handover import START
from skillweave.errors import DeclarationError
from skillweave.policies.core import Step
from skillweave.reporting.progress import EpisodeProgress
from skillweave.robots.chains import ChainPlayer, OpenRobot, Outcome, PlannedCall, Robot
from skillweave.robots.learning_on import learn_on
from skillweave.robots.measured import Entry, HandoverTable
from skillweave.robots.remedies import Remedies, find_remedies
from skillweave.robots.trial import RobotTrial, check_repeats, make_trial
from skillweave.schema import AtLeastOne, fitted
from skillweave.skills.skill_set import skills_below

MORE = 40
"""Further entries of a pair that differs from fresh starts in the first ones."""
DIFFERS = 3
"""A pair is measured further where it has lost so many robots more than it has won."""
PATIENCE = 3
"""Tries for each wanted entry: the first skill may fail before."""

REPAIRED = 2_000_000
"""The number of the first robot on which repaired skills are measured."""
Cell = tuple[int, int]
"""A skill's place, and before it that of the skill before; −1: a fresh start."""


@dataclass(frozen=True, eq=False)
class MeasuredHandovers(HandoverTable):
    """Counts of each skill after each other one, and ways to make them better.

    Attributes:
        trial: the skills and robots; None: it was not measured here.
        run: of ``repair``, with the repaired policy, ``run.policy``; None: nothing was repaired.
    """

    trial: Any = field(default=None, repr=False)
    run: Any = field(default=None, repr=False)

    @checked_names
    def remedies(
        self,
        after: str,
        skill: str,
        *,
        robots: int = 40,
        instead: Mapping[str, Any] | None = None,
        quiet: bool = False,
    ) -> Remedies:
        """Try remedies for a pair: choose one on some robots, and report it on others.

        Tried are cross-fades and ramps over an eighth and a quarter of a call, a first skill that
        is cut so much later, and each other skill in between, all on the same new robots, beside
        the pair without a remedy. The best three of those that win at least three robots more than
        they lose are played on as many robots again. Of these the best is chosen, or a gentler one
        that is at most two robots behind it. What it does is told of further robots; where it is in
        force after other skills, too, also for these pairs.
        Ctrl-C ends it with what was tried.

        Args:
            after: the name of the skill before.
            skill: of the one that fails after it.
            robots: those of the choice; as many others are for the report.
            instead: further remedies by name: policies in place of the second skill's, such as one
                that enters its motion a second earlier.
            quiet: no progress.

        Raises:
            DeclarationError: there is no such skill, or these handovers were not measured here.
        """
        self.pair(after, skill)
        robots = fitted(AtLeastOne, robots, "robots")
        if self.trial is None:
            raise DeclarationError("remedies() needs the skills: call handovers() here first")
        named = fitted(Mapping[str, Any], instead or {}, "instead")
        return find_remedies(self.trial, after, skill, robots, named, quiet=quiet)

    @checked_names
    def repair(
        self,
        skill: str,
        *,
        after: str,
        reward: Callable[[Step], Any],
        scale: Any = 0.5,
        steps: int = 60_000,
        calls: int = 60,
        run_dir: str | Path | None = None,
        seed: int = 0,
        quiet: bool = False,
    ) -> MeasuredHandovers:
        """Let a skill learn a correction in calls that follow another one, and measure all again.

        A ``Residual`` of its policy learns by ``Run.repair``, on robots that vary as these do. It
        is kept if the pair is clearly better and no other pair clearly worse. The handovers that
        are returned are of other robots; their ``run`` has the repaired policy.

        Args:
            skill: the name of the skill that fails.
            after: of the one after which it does.
            reward: a function of a ``Step`` that returns (n,) numbers: what it is to maximise.
            scale: the largest correction, as of ``Residual``.
            steps: of training.
            calls: of the pair, before and after; see ``Run.repair``.
            run_dir: a new directory; None: the next numbers in ``runs/``.
            seed: of all that is random.
            quiet: no progress.

        Raises:
            DeclarationError: an argument is wrong, these handovers were not measured here, or the
                pair needs no repair.
        """
        self.pair(after, skill)
        if self.trial is None:
            raise DeclarationError("repair() needs the skills: call handovers() here first")
        steps, calls = fitted(AtLeastOne, steps, "steps"), fitted(AtLeastOne, calls, "calls")
        how = steps, calls, run_dir, seed
        run = learn_on(self.trial, skill, after, reward, scale, *how, quiet=quiet)
        again = replace(self.trial, skills=skills_below(run.policy))
        return replace(measure(again, self.calls, quiet=quiet, first=REPAIRED), run=run)


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
    anyway. Pairs that differ in the first entries are played on 40 more robots.
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
    trial = make_trial(env, skills, steps, stays, done, follows, vary, cut, seed)
    return measure(trial, calls, quiet=quiet)


def measure(trial: RobotTrial, calls: int, *, quiet: bool, first: int = 0) -> MeasuredHandovers:
    """Return the handovers of a trial; see ``handovers``.

    Args:
        first: the number of the first robot.
    """
    robots = trial.robots(first)
    robot = next(robots)
    with OpenRobot(trial.spec) as where:
        player = trial.player(where)
        check_repeats(trial, player, robot)
        plan = _Plan(trial, player, calls)
        started = time.monotonic()
        stopped = False
        try:
            with deferred("after this call"):
                plan.measure(where, robot, robots, quiet=quiet)
        except KeyboardInterrupt:
            stopped = True
            notice("handovers() was stopped: the table has what was measured until then")
        seconds = time.monotonic() - started
        return MeasuredHandovers(
            trial.names,
            tuple(plan.entries),
            calls,
            trial.steps,
            str(trial.variation),
            tuple(plan.no_entry.items()),
            where.steps,
            seconds,
            stopped,
            trial,
        )


class _Plan:
    """Which calls are played on which robot, and what came out."""

    def __init__(self, trial: RobotTrial, player: ChainPlayer, calls: int) -> None:
        self.entries: list[Entry] = []
        self.no_entry: dict[str, tuple[int, int]] = {}
        """By the name of a first skill: tries after which no other could enter, and all."""
        self._trial = trial
        self._player = player
        self._names = trial.names
        self._calls = calls
        places = range(len(trial.names))
        self._cells: list[Cell] = [(j, i) for j in places for i in (-1, *places) if i != j]
        self._count = dict.fromkeys(self._cells, 0)
        self._tries = dict.fromkeys(self._cells, 0)
        self._lost = dict.fromkeys(self._cells, 0)
        """Robots that the pair lost, less those that it won."""
        self._targets = dict.fromkeys(self._cells, calls)

    def measure(
        self, where: OpenRobot, first: Robot, more: Iterator[Robot], *, quiet: bool
    ) -> None:
        """Play until each cell has its entries, or is tried too often."""
        robot = first
        with EpisodeProgress(1, quiet=quiet, name="handovers", unit="calls") as shown:
            while (wanted := self._wanted()) and not requested():
                shown.episodes = sum(self._targets.values())
                self._on_robot(where, robot, wanted, shown)
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

    def _on_robot(
        self, where: OpenRobot, robot: Robot, wanted: Sequence[Cell], shown: EpisodeProgress
    ) -> None:
        """Play the wanted cells on one robot, with the fresh starts that they are paired with."""
        alone = dict[int, bool]()  # of the skills that were played from a fresh start
        fails = set[int]()  # first skills that this robot cannot carry out
        for j, i in wanted:
            if i in fails:
                self._tries[j, i] += 1
                continue
            before = where.steps
            counted = len(self.entries)
            found = self._play_pair(robot, j, i) if i >= 0 else None
            if i >= 0 and found is None:
                fails.add(i)
            elif j not in alone:
                alone[j] = self._play_alone(robot, j)
            if found is not None:
                self._compare((j, i), alone[j], found.counts)
            shown.count(where.steps - before, len(self.entries) - counted)
            if requested():
                return

    def _play_alone(self, robot: Robot, j: int) -> bool:
        """Play a skill from a fresh start; return whether it was done."""
        (found,) = self._player.play(robot, [PlannedCall(j, self._trial.steps[j])])
        self._count[j, -1] += 1
        self._tries[j, -1] += 1
        self._add(robot, START, 0, found)
        return found.counts

    def _play_pair(self, robot: Robot, j: int, i: int) -> Outcome | None:
        """Play a skill after another one; return its call, None where that one was not done."""
        first = PlannedCall(i, self._trial.cut(robot, i), follows=False)
        found = self._player.play(robot, [first, PlannedCall(j, self._trial.steps[j])])
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
            self._targets[cell] = self._calls + MORE

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
