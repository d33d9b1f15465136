"""Repair of a handover: a skill learns on from where another one ends, and is measured again."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from skillweave._internal.paths import level_of, name_of
from skillweave.calls.handover import Handover, before_each, calls_done, shown_rate
from skillweave.calls.log import CallLog, join
from skillweave.calls.predicates import Held, as_event
from skillweave.calls.record import RandomChoice, with_returns
from skillweave.envs.make import EnvSpec
from skillweave.experience.search import NAMED_SHARE, Starts
from skillweave.hierarchy.added_stages import AddedStage
from skillweave.hierarchy.assembly import parts_of, policy_at
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.roles import Roles
from skillweave.policies.core import Array, Memory, Step, Turn
from skillweave.runs.comparison import Comparison
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import Matrix, StageEntry
from skillweave.skills import Skill
from skillweave.skills.goals import goals_of
from skillweave.skills.own_part import OwnPart
from skillweave.skills.skill_set import SkillSet
from skillweave.training.learning_task import LearningTask, skill_task
from skillweave.training.stage import Policies, Stage
from skillweave.training.trainer import Course

START_CALLS = 1
"""The most calls at random before the other episodes of a repair, if the hierarchy has any."""
MOST_STEPS = 500_000
"""The most steps of one measurement."""
CHUNK = 10_000
"""The fewest steps that are recorded at once."""
LARGEST_CHUNK = 200_000
"""The most steps that are recorded at once, as they are kept in memory."""
FEWEST = 10
"""Calls of a pair below which two measurements of it cannot differ clearly."""
ENOUGH_STEPS = 200_000
"""Steps after which a pair is given up that would not have ``FEWEST`` calls in ``MOST_STEPS``."""
REHEARSED_SHARE = 0.75
"""Share of the calls that begin after the other skill, where the skill rehearses the rest."""
LONG_CALL = 1_000
"""Steps of a call without a limit that count for its bonus."""
SEED = 7_000
"""Seeds of measurements start here: people use smaller ones."""


@dataclass(frozen=True)
class Repair:
    """The result of a repair.

    Attributes:
        skill: the path of the repaired skill.
        after: the path of the skill after which it was repaired.
        before: the handover matrix with the earlier weights.
        later: with the repaired ones.
        kept: True if the run has the repaired weights, False if the earlier ones.
        blame: the reason of the failure, before the repair.
        sentence: the result in a sentence.
    """

    skill: str
    after: str
    before: Handover
    later: Handover
    kept: bool
    blame: str
    sentence: str

    def __str__(self) -> str:
        """Return the reason, both matrices and the result."""
        return f"{self.blame}\nbefore\n{self.before}\nafter\n{self.later}\n{self.sentence}"


def repair_stage(roles: Roles, entry: StageEntry, done: Mapping[str, Any] | None) -> Stage:
    """Return the stage of a run's entry in which a skill is repaired.

    Args:
        done: as for ``handover``.
    """
    repair = entry.repair
    assert repair is not None
    path = repair.skill
    level = roles.levels[level_of(path)]
    role = roles[path]
    calls = level.apart.start_calls
    config = role.config
    assert config is not None

    def learning_task(policies: Policies) -> LearningTask:
        """Return the task of the repaired skill, which starts where the other one ends."""
        others = {p: policy_at(roles, policies, p) for p in level.skills if p != path}
        whole = level.skill_set({p: policy_at(roles, policies, p) for p in level.skills})
        limit = whole.limit(list(level.skills).index(path))
        assert role.skill is not None
        holds = event_of(role.skill, done)
        bonus = repair.bonus
        gamma = float(config.gamma)
        learning = role
        if holds is not None and bonus:
            # As much as if a call that ends by the event went on, and the event held.
            rest = bonus * float(np.sum(gamma ** np.arange(limit or LONG_CALL)))
            learning = replace(role, skill=eager(role.skill, holds, bonus, rest))
        starts = Starts(
            level.skill_set(others),
            0 if calls is None else START_CALLS,
            level.apart.search_steps,
            after=(name_of(repair.after),),
            named_share=NAMED_SHARE if repair.rehearsal is None else REHEARSED_SHARE,
        )
        # Calls are what counts, and steps beyond their limit would take steps from the starts.
        return skill_task(learning, level.reflexes, starts, limit)

    return Stage(
        entry.name,
        "skill",
        config,
        entry.budget,
        learning_task,
        level=level.path,
        learner=path,
    )


def event_of(skill: Skill, done: Mapping[str, Any] | None) -> Callable[[Step], Array] | None:
    """Return a function of steps: where the repaired skill's event holds; None: it has no event.

    Of ``held(...)``, where the predicate inside holds: so each of its steps counts.
    """
    if skill.name in (done or {}):
        event = as_event((done or {})[skill.name], f"done of {skill.name!r}")
        return event.predicate.holds if isinstance(event, Held) else event.holds
    return skill.success if skill.defines("success") else None


def eager(skill: Skill, holds: Callable[[Step], Array], bonus: float, rest: float) -> Skill:
    """Return a skill under repair, also paid while its event holds, so that it gets there fast.

    Its own reward may be content with a call that comes too late.

    Args:
        holds: the event, of a step.
        bonus: reward of each step in which it holds.
        rest: reward of one in which it holds and the call ends by it.
    """

    def reward(self: Skill, step: Step) -> Array:
        """Return the skill's reward with a bonus where the event of the repair holds."""
        own = skill.reward(step) if skill.defines("reward") else step.reward
        over = np.asarray(step.terminated, bool)
        if skill.defines("termination"):
            over = over | np.asarray(skill.termination(step), bool)
        paid: Array = own + np.asarray(holds(step), bool) * np.where(over, rest, bonus)
        return paid

    twin = copy.copy(skill)
    attributes = {"name": skill.name, "reward": reward}
    twin.__class__ = type(type(skill).__name__, (type(skill),), attributes)
    return twin


class PairChoice(RandomChoice):
    """A selector that measures a repair: it calls one skill after each other, one often before it.

    Args:
        skills: names.
        lengths: the number of lengths of each, at least 1.
        skill: the name of the skill that is called after each other one in half of the decisions.
        after: the name of the skill that is called twice as often as the others.
    """

    def __init__(self, skills: tuple[str, ...], lengths: int, skill: str, after: str) -> None:
        super().__init__(len(skills) * lengths)
        self._lengths = lengths
        self._skill = skills.index(skill)
        weights = np.where(np.array(skills) == after, 2.0, 1.0)
        weights[self._skill] = 0.0
        self._again = np.maximum(weights, 1e-6).repeat(lengths)
        weights[self._skill] = weights.sum()
        self._weights = weights.repeat(lengths)

    def start(self, n: int) -> Memory:
        """Return the skills that were called last, (n,) int64; −1: none."""
        return {"last": np.full(n, -1)}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return choices (k,)."""
        assert turn.world.rng is not None
        again = memory["last"][rows] == self._skill
        weights = np.where(again[:, None], self._again, self._weights)
        # The largest of u^(1/w) is choice i with probability w_i / Σw (Efraimidis & Spirakis 2006).
        score = np.log(turn.world.rng.random(weights.shape)) / weights
        best = score if turn.mask is None else np.where(turn.mask, score, -np.inf)
        choice = np.asarray(best.argmax(1))
        memory["last"][rows] = choice // self._lengths
        return choice


@dataclass(frozen=True)
class Measured:
    """A measurement of handovers before or after a repair."""

    matrix: Handover
    log: CallLog
    """The calls of the skill, each with the call before it."""
    may_start: bool
    """The skill may start at some end of a call of the other one."""
    gain: float
    """The skill's own reward per step in calls that were done, less that in those that failed; 0
    where it is not more, or one of these kinds is missing."""
    shortage: str
    """A sentence on calls that are missing; empty: there were as many as were to be measured."""


def measure(
    spec: EnvSpec,
    skills: SkillSet,
    skill: str,
    after: str,
    done: Mapping[str, Any] | None,
    calls: int,
    num_envs: int,
    tell: Callable[[str], None] = lambda _: None,
) -> Measured:
    """Measure a handover for a repair: let skills act until one followed the other often.

    Args:
        skills: of one level; ``skill`` and ``after`` are names there.
        calls: calls of the pair; fewer where ``MOST_STEPS`` do not suffice, or where after
            ``ENOUGH_STEPS`` not even ``FEWEST`` are to be expected.
        done: as for ``handover``.
        tell: receives a sentence about what is done now.
    """
    names = tuple(s.name for s in skills.skills)
    number, first = names.index(skill), names.index(after)
    matrix = None
    parts = list[CallLog]()
    steps = 0
    may_start = False
    rates: dict[bool, list[float]] = {True: [], False: []}
    tried = succeeded = 0  # calls of the other skill
    size = CHUNK
    tell(f"measuring: calls of {skill} after {after}, at least {calls}")
    while True:
        choose = PairChoice(names, skills.each, skill, after)
        seed = SEED + len(parts)
        log, returns = with_returns(spec, skills, size, choose, num_envs, seed)
        steps += log.steps
        found = log.handover(done)
        matrix = found if matrix is None else _sum(matrix, found)
        may = log.may_follow[log.skill == first][:, number * log.each]
        may_start |= bool(may.any())
        of_skill = log.skill == number
        won = calls_done(log, done)
        whole = (log.skill == first) & ~log.began_late
        tried = tried + int(whole.sum())
        succeeded = succeeded + int((whole & won).sum())
        for was_done, each in rates.items():
            some = of_skill & (won == was_done) & ~log.began_late
            each.extend((returns[some] / log.tau[some]).tolist())
        following = log.followed_by
        first_calls = np.flatnonzero(following >= 0)
        first_calls = first_calls[of_skill[following[first_calls]]]
        parts.append(log.take(np.union1d(np.flatnonzero(of_skill), first_calls)))
        seen = int(matrix.of(skill, after)[1])
        few = seen * MOST_STEPS < min(calls, FEWEST) * steps
        if seen >= calls or steps >= MOST_STEPS or (few and steps >= ENOUGH_STEPS):
            shortage = ""
            if seen < calls:
                shortage = (
                    f"Measuring stopped after {steps:,} steps: {calls:,} calls of {skill} after "
                    f"{after} were wanted, and there were {seen:,}; {after} was done in "
                    f"{succeeded:,} of {tried:,} calls."
                )
                tell(shortage)
            gain = np.mean(rates[True]) - np.mean(rates[False]) if all(rates.values()) else 0.0
            return Measured(matrix, join(parts), may_start, max(0.0, float(gain)), shortage)
        needed = steps * (calls / max(seen, 1) - 1) * 1.1
        size = int(np.clip(needed, CHUNK, min(MOST_STEPS - steps, LARGEST_CHUNK)))


def _sum(one: Handover, other: Handover) -> Handover:
    """Return the sum of two handover matrices that are measured for a repair."""
    added = ("calls", "done", "began_late", "steps", "cut_else")
    counts = {k: getattr(one, k) + getattr(other, k) for k in added}
    limit = max(one.time_limit, other.time_limit)
    assert one.needed is not None
    assert other.needed is not None
    return replace(one, **counts, time_limit=limit, needed=np.maximum(one.needed, other.needed))


def rehearsed_obs(
    log: CallLog,
    skill: Skill,
    part: OwnPart | None,
    after: str,
    done: Mapping[str, Any] | None,
) -> Array | None:
    """Return the observations in which a skill keeps what it does while it is repaired, (n, …).

    They are those inside its calls that were done; not after the skill after which it is repaired,
    as there it is to change. None: there are none.

    Args:
        log: its calls, each with the call before it.
        skill: the skill.
        part: its own part of observations; None: it sees all.
        after: the name of the other skill.
        done: as for ``handover``.
    """
    won = calls_done(log, done)
    before = before_each(log, won)
    calls = won & (log.skill == log.number(skill.name)) & (before != log.number(after) + 1)
    steps = calls[log.owner]
    if not steps.any():
        return None
    obs: Array = log.before[steps]
    obs = obs if part is None else part.part.see(obs)
    goals = goals_of(skill)
    if goals is None:
        return obs
    return goals.join(obs, goals.space.of_numbers(log.goals[skill.name])[log.owner[steps]])


def matrix_to_json(matrix: Handover) -> Matrix:
    """Return a handover matrix as a repair's entry in ``run.json`` records it."""
    calls, done, late = (x.tolist() for x in (matrix.calls, matrix.done, matrix.began_late))
    needed = None if matrix.needed is None else matrix.needed.tolist()
    by_itself = list(matrix.by_itself)
    limit = matrix.time_limit
    return Matrix(list(matrix.skills), calls, done, late, by_itself, limit, needed)


def matrix_from_json(entry: Matrix) -> Handover:
    """Return the handover matrix of a repair's entry; the inverse of ``matrix_to_json``."""
    columns = (entry.calls, entry.done, entry.began_late)
    calls, done, late = (np.array(x, np.int64) for x in columns)
    needed = None if entry.needed is None else np.array(entry.needed, np.int64)
    by_itself = tuple(entry.by_itself)
    limit = entry.time_limit
    return Handover(tuple(entry.skills), calls, done, late, by_itself, limit, needed)


def judge_repair(roles: Roles, course: Course, entry: StageEntry, later: HierarchyPolicy) -> bool:
    """Measure a repaired skill once, record in the run whether it is kept, and return that.

    Args:
        later: the hierarchy with the repaired weights.
    """
    repair = entry.repair
    assert repair is not None
    if entry.kept is None:
        level = parts_of(roles, later)[level_of(repair.skill)]
        assert isinstance(level, HierarchyPolicy)
        names = name_of(repair.skill), name_of(repair.after)
        tell = partial(course.tell, entry)
        found = measure(
            roles.spec, level.skills, *names, course.done, repair.calls, entry.num_envs, tell
        )
        is_kept, sentence = verdict(matrix_from_json(repair.before), found.matrix, *names)
        repair.later = matrix_to_json(found.matrix)
        sentence += f". {found.shortage}" if found.shortage else ""
        entry.kept = Comparison("repaired" if is_kept else "before", sentence=sentence)
        course.run.save()
        tell(sentence)
    return not entry.undone


REPAIR = AddedStage(make=repair_stage, judge=judge_repair)
"""The kind of stage in which a skill is repaired."""


def verdict(before: Handover, later: Handover, skill: str, after: str) -> tuple[bool, str]:
    """Return whether a repair is kept, and a sentence with the reason.

    It is kept if the pair is clearly better and no other pair clearly worse: their 95 % intervals
    do not touch.
    """
    low, high = before.interval
    low_later, high_later = later.interval
    place = before.before.index(after), before.skills.index(skill)
    pair = f"{skill} after {after}: {_rates(before, later, place)}"
    better = low_later[place] > high[place]
    if not better:
        return False, f"{pair}: not clearly better, so the earlier weights are kept"
    worse = np.argwhere(high_later < low)
    if len(worse):
        lost = ", ".join(
            f"{before.skills[j]} after {before.before[i]}: {_rates(before, later, (i, j))}"
            for i, j in worse
        )
        return False, f"{pair}; but {lost}: clearly worse, so the earlier weights are kept"
    return True, f"{pair}; no other pair is clearly worse, so the repaired weights are kept"


def _rates(before: Handover, later: Handover, place: tuple[int, int]) -> str:
    """Return words on a pair's rate in the handover matrices before and after a repair."""
    one, other = (shown_rate(m.done[place], m.calls[place]) for m in (before, later))
    return f"{one} before, {other} later"


def repairs_of(run: RunDirectory) -> list[Repair]:
    """Return the repairs of a run that are judged, in their order."""
    repairs = []
    for entry in run.manifest.stages:
        repair = entry.repair
        if repair is not None and repair.later is not None:
            repairs.append(
                Repair(
                    repair.skill,
                    repair.after,
                    matrix_from_json(repair.before),
                    matrix_from_json(repair.later),
                    not entry.undone,
                    repair.blame,
                    str(entry.kept),
                )
            )
    return repairs
