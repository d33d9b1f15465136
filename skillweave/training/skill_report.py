"""Reports of a policy's skills in an evaluation: their steps, calls, ends and rewards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from skillweave.collecting.judge import Outcome, judge, seen_by
from skillweave.collecting.skill_set import SkillSet, skills_below
from skillweave.paths import level_of
from skillweave.planning.handover import Handover
from skillweave.policies.core import CallEnd, end_with_episode, part_of
from skillweave.policies.parts import OWN_GOAL
from skillweave.settings import Count
from skillweave.skills import Skill, asked, is_trained
from skillweave.skills.base import RecordedSkill
from skillweave.skills.goals import goals_of
from skillweave.training.play import Played
from skillweave.types import Array, Policy

ENDS = {end: end.name.lower() for end in list(CallEnd)[1:]}
"""Names of the ends of calls in reports."""


@dataclass(frozen=True)
class SkillReport:
    """Counts and sums of one skill over all episodes of an evaluation.

    A skill that is a hierarchy has a report, and each of its own skills has one, under its path. A
    call in it goes on where the hierarchy is called again at once; where another skill follows, it
    has ended by the limit. Fields that need the skills' declarations are unknown for a policy that
    is no hierarchy; rewards and successes are unknown for a run that was loaded without its code.
    """

    steps: Count
    """Environment steps of the skill."""
    calls: Count
    """Number of calls."""
    ended: dict[str, Count]
    """Calls by their end: ``own``, ``limit``, ``interrupted``, ``episode`` (the episode ended, or
    the evaluation's step limit cut it). They add up to ``calls``; empty: unknown."""
    succeeded: Count | None
    """Calls with ``success`` true in the last step; None: the skill does not define it."""
    return_sum: float | None
    """Sum of its own reward over its steps, not discounted; of the environment's reward where the
    skill defines none. None: unknown."""
    first: Count = field(default=0, compare=False)
    """Calls at the start of an episode."""
    followed: dict[str, Count] = field(default_factory=dict, compare=False)
    """Its calls by the skill called next; the others were the last of an episode. Empty:
    unknown."""
    idle: Count = field(default=0, compare=False)
    """Calls that ended by themselves after one step, right after a call of it with such an end."""
    late: Count = field(default=0, compare=False)
    """Calls that went on to their limit after they had succeeded, of a skill with neither
    an end nor a length of its own."""
    hasty: Count = field(default=0, compare=False)
    """Calls that ended by themselves within two steps, before the episode's end, without success,
    of a skill whose own reward was below 0 in the last of them."""
    own_with_episode: Count = field(default=0, compare=False)
    """Calls that ended by themselves in the episode's last step; ``ended`` has them as ``own``."""
    learns: bool = field(default=True, compare=False)
    """It was trained; False: its policy was given, so no reward changes what it does."""
    has_goals: bool = field(default=False, compare=False)
    """Its calls have goals, which initiation() does not see."""

    @property
    def length_mean(self) -> float | None:
        """Mean steps of a call; None: no calls."""
        return self.steps / self.calls if self.calls else None

    @property
    def success_rate(self) -> float | None:
        """Share of its calls that succeeded; None: no calls, or the skill defines no success."""
        return None if self.succeeded is None or not self.calls else self.succeeded / self.calls

    @property
    def return_mean(self) -> float | None:
        """Mean sum of its own reward over a call; None: no calls, or unknown."""
        return None if self.return_sum is None or not self.calls else self.return_sum / self.calls

    def to_json(self, total: int) -> dict[str, Any]:
        """Return the report as plain JSON; ``total`` are the steps of all skills."""
        return {
            "share": self.steps / total if total else 0.0,
            "steps": self.steps,
            "calls": self.calls,
            "length_mean": self.length_mean,
            "ended": dict(self.ended),
            "success_rate": self.success_rate,
            "return_mean": self.return_mean,
        }


@dataclass(frozen=True)
class StepOutcome:
    """Outcome of one step in each acting environment, judged by the running skills."""

    why: Array  # (k,) int8, ``CallEnd`` of the running call
    reward: Array  # (k,) by the running skill; by the environment where it defines none
    succeeded: Array  # (k,) bool, the call is over with ``success`` true
    has_succeeded: Array  # (k,) bool, ``success`` is true; for endless skills at every step


def judge_step(skills: SkillSet, played: Played) -> StepOutcome:
    """Judge a step of a hierarchy by the running skills."""
    assert played.acting is not None
    assert played.elapsed is not None
    assert played.why is not None
    acting = played.acting
    why = played.why.copy()
    why[(why == CallEnd.RUNNING) & played.over] = CallEnd.EPISODE
    over = why != CallEnd.RUNNING
    reward = played.reward.copy()
    success = np.zeros(len(acting), bool)
    for i, skill in enumerate(skills.skills):
        if skill.defines("reward") and len(rows := np.flatnonzero(acting == i)):
            reward[rows] = _outcome(skill, played, played.elapsed, rows, i).reward
        due = (acting == i) & (over | is_endless(skills, i))
        if skill.defines("success") and len(rows := np.flatnonzero(due)):
            success[rows] = _outcome(skill, played, played.elapsed, rows, i).success
    return StepOutcome(why, reward, success & over, success)


def is_endless(skills: SkillSet, i: int) -> bool:
    """Return True if skill ``i`` is no hierarchy and has neither an end nor a length of its own."""
    skill = skills.skills[i]
    if skill.max_steps is not None or skill.call_steps is not None or skill.defines("termination"):
        return False
    return skills_below(skills.policies[i]) is None


class SkillTally:
    """Counter of steps, calls and rewards of a policy's skills, as episodes are played.

    Args:
        policy: with the skills; a hierarchy's are counted at every level.
        episodes: the number of episodes.
        path: of its skills: empty, or ``inner/`` for example.
    """

    def __init__(self, policy: Policy, episodes: int, path: str = "") -> None:
        self.labels = policy.labels
        self._path = path
        skill_set = getattr(policy, "skills", None)
        self.skills = skill_set if isinstance(skill_set, SkillSet) else None
        count = len(self.labels)
        self._steps = np.zeros(count, np.int64)
        self._calls = np.zeros(count, np.int64)
        self._ended = np.zeros((count, len(CallEnd)), np.int64)
        self._succeeded = np.zeros(count, np.int64)
        self._late = np.zeros(count, np.int64)
        self._hasty = np.zeros(count, np.int64)
        self._own_with_episode = np.zeros(count, np.int64)
        self._endless = np.array(
            [self.skills is not None and is_endless(self.skills, i) for i in range(count)], bool
        )
        declared = () if self.skills is None else self.skills.skills
        self._pays = np.array([skill.defines("reward") for skill in declared], bool)
        self._judged = np.array([skill.defines("success") for skill in declared], bool)
        self._has_succeeded = np.zeros(episodes, bool)  # by episode, the call at its last step
        # By skill before (the first row: none) and skill after.
        self._next = np.zeros((1 + count, count), np.int64)
        self._before = np.zeros(episodes, np.int64)
        # Calls and successes by what was done before; by episode, that of the running call: the row
        # of ``_next``, or −1 where the call before was not done.
        self._handed = np.zeros((2, 1 + count, count), np.int64)
        self._after = np.zeros(episodes, np.int64)
        self._won = np.ones(episodes, bool)
        # One sum for each episode, so the result does not depend on which are played together.
        self._returns = np.zeros((episodes, count))
        policies = () if self.skills is None else self.skills.policies
        self._below = {
            i: SkillTally(inner, episodes, f"{path}{self.labels[i]}/")
            for i, inner in enumerate(policies)
            if skills_below(inner) is not None
        }
        self._running = np.full(episodes, -1)  # by episode, the skill whose call may go on
        self._idle = np.zeros(count, np.int64)
        self._done = np.full(episodes, -1)  # by episode, the skill that has just ended by itself

    def add(self, played: Played) -> None:
        """Count one step of each environment."""
        acting, count = played.acting, len(self.labels)
        if acting is None:
            return
        self._steps += np.bincount(acting, minlength=count)
        called = acting[played.call_start]
        episode = played.episode[played.call_start]
        self._calls += np.bincount(called, minlength=count)
        np.add.at(self._next, (self._before[episode], called), 1)
        self._after[episode] = np.where(self._won[episode], self._before[episode], -1)
        self._before[episode] = 1 + called
        reward = played.reward
        if self.skills is not None:
            outcome = judge_step(self.skills, played)
            assert played.elapsed is not None
            self._running[played.episode] = np.where(outcome.why == CallEnd.RUNNING, acting, -1)
            reward = outcome.reward
            ended = np.flatnonzero(outcome.why != CallEnd.RUNNING)
            np.add.at(self._ended, (acting[ended], outcome.why[ended]), 1)
            self._handover(played, outcome, ended)
            done = outcome.why == CallEnd.OWN
            self._own_with_episode += np.bincount(acting[done & played.over], minlength=count)
            again = self._done[played.episode] == acting
            self._idle += np.bincount(acting[done & again], minlength=count)
            self._done[played.episode] = np.where(done, acting, -1)
            np.add.at(self._succeeded, acting[ended], outcome.succeeded[ended])
            assert played.call_start is not None
            before = (
                self._has_succeeded[played.episode] & ~played.call_start & self._endless[acting]
            )
            late = before & outcome.succeeded & (outcome.why == CallEnd.LIMIT)
            self._late += np.bincount(acting[late], minlength=count)
            hasty = done & ~played.over & (played.elapsed <= 2) & self._pays[acting] & (reward < 0)
            self._hasty += np.bincount(acting[hasty & ~outcome.succeeded], minlength=count)
            self._has_succeeded[played.episode] = outcome.has_succeeded
        self._returns[played.episode, acting] += reward
        for i, tally in self._below.items():
            tally.cut(played.episode[acting != i])
            rows = np.flatnonzero(acting == i)
            if len(rows):
                tally.add(played_below(played, i, rows))

    def _handover(self, played: Played, outcome: StepOutcome, ended: Array) -> None:
        """Count the calls that have ``ended`` (m,), by what was done before."""
        assert played.acting is not None
        acting, episode = played.acting[ended], played.episode[ended]
        won = np.where(
            self._judged[acting], outcome.succeeded[ended], outcome.why[ended] == CallEnd.OWN
        )
        cut = (outcome.why[ended] == CallEnd.EPISODE) & ~played.step.terminated[ended] & ~won
        counts = self._judged[acting] & ~cut & (self._after[episode] >= 0)
        place = self._after[episode[counts]], acting[counts]
        np.add.at(self._handed[0], place, 1)
        np.add.at(self._handed[1], place, won[counts])
        self._won[episode] = won

    def handover(self) -> list[str]:
        """Return sentences on skills that succeed much less often after one skill than elsewhere.

        Skills without ``success`` are left out.
        """
        names = tuple(self._path + name for name in self.labels)
        nothing = np.zeros(len(names), np.int64)
        sentences = (
            Handover(names, self._handed[0], self._handed[1], nothing).weakest() if names else []
        )
        return [*sentences, *(s for below in self._below.values() for s in below.handover())]

    def cut(self, episodes: Array) -> None:
        """End calls that might have gone on in ``episodes`` (k,), as another skill acts there."""
        over = episodes[self._running[episodes] >= 0]
        if len(over):
            np.add.at(self._ended[:, CallEnd.LIMIT], self._running[over], 1)
            self._running[over] = -1
        self._done[episodes] = -1
        for tally in self._below.values():
            tally.cut(episodes)

    def reports(self) -> dict[str, SkillReport]:
        """Return the report of each skill, by its path."""
        returns = self._returns.sum(axis=0)
        reports: dict[str, SkillReport] = {}
        paths = [self._path + name for name in self.labels]
        for i, name in enumerate(paths):
            reports[name] = SkillReport(
                steps=int(self._steps[i]),
                calls=int(self._calls[i]),
                ended=self._ends(i),
                succeeded=self._successes(i),
                return_sum=float(returns[i]) if self._has_reward(i) else None,
                first=int(self._next[0, i]),
                followed=dict(zip(paths, self._next[1 + i].tolist(), strict=True)),
                idle=int(self._idle[i]),
                late=int(self._late[i]),
                hasty=int(self._hasty[i]),
                own_with_episode=int(self._own_with_episode[i]),
                learns=self.skills is None or is_trained(self.skills.skills[i]),
                has_goals=self.skills is not None and self.skills.skills[i].goal_space is not None,
            )
            if i in self._below:
                reports |= self._below[i].reports()
        return reports

    def _has_reward(self, i: int) -> bool:
        """Return True if the reward of skill ``i`` is known."""
        return self.skills is not None and not isinstance(self.skills.skills[i], RecordedSkill)

    def _ends(self, i: int) -> dict[str, int]:
        if self.skills is None:
            return {}
        return {name: int(self._ended[i, why]) for why, name in ENDS.items()}

    def _successes(self, i: int) -> int | None:
        if self.skills is None or not self.skills.skills[i].defines("success"):
            return None
        return int(self._succeeded[i])


class CallTally:
    """Counter for one skill that acts alone: one call in each episode.

    The call starts where the skill may start, usually at the episode's start, and ends by its
    ``termination``, at its ``max_steps``, or with the episode. The skill acts on after it, but only
    the call counts: a skill that is called again where its work is done would succeed each time.

    Args:
        skill: the skill.
        path: its name in reports.
        policy: its policy; a hierarchy's own skills are counted, too.
        episodes: the number of episodes.
    """

    def __init__(self, skill: Skill, path: str, policy: Policy, episodes: int) -> None:
        self._skill = skill
        self._path = path
        inner = skills_below(policy) is not None
        self._below = SkillTally(policy, episodes, f"{path}/") if inner else None
        self._running = np.zeros(episodes, bool)
        self._done = np.zeros(episodes, bool)
        self._elapsed = np.zeros(episodes, np.int64)
        self._returns = np.zeros(episodes)
        self._goals_of = goals_of(skill)
        self.goals: Array | None = None
        """(episodes, …) the goal of each; None: the skill has none."""
        if self._goals_of is not None:
            self.goals = self._goals_of.start(episodes)
        self.reached: Array | None = None
        """(episodes,) bool: the call in each has succeeded; None: the skill defines no success."""
        if skill.defines("success"):
            self.reached = np.zeros(episodes, bool)
        self._ended = dict.fromkeys(ENDS.values(), 0)
        self._own_with_episode = 0

    def add(self, played: Played) -> None:
        """Count one step of each environment."""
        if self.goals is not None:
            self.goals[played.episode] = played.memory[OWN_GOAL][played.rows]
        waiting = np.flatnonzero(~self._running[played.episode] & ~self._done[played.episode])
        if len(waiting):
            obs = played.step.obs[waiting]
            ids = played.rows[waiting]
            may = asked(self._skill, "initiation", obs, ids)
            self._running[played.episode[waiting[may]]] = True
        rows = np.flatnonzero(self._running[played.episode])
        if not len(rows):
            return
        episode = played.episode[rows]
        self._elapsed[episode] += 1
        elapsed, limit = self._elapsed[episode], self._skill.max_steps
        outcome = _outcome(self._skill, played, self._elapsed[played.episode], rows)
        defined = self._skill.defines("reward")
        self._returns[episode] += outcome.reward if defined else played.reward[rows]
        why = np.full(len(rows), CallEnd.RUNNING)
        if limit is not None:
            why[elapsed >= limit] = CallEnd.LIMIT
        why[outcome.stops] = CallEnd.OWN
        end_with_episode(why, (played.over & ~played.cut)[rows])
        why[played.cut[rows] & (why == CallEnd.RUNNING)] = CallEnd.EPISODE
        over = np.flatnonzero(why != CallEnd.RUNNING)
        if self._below is not None:
            self._below.add(rows_of(played, rows))
            self._below.cut(episode[over])
        if not len(over):
            return
        for reason, name in ENDS.items():
            self._ended[name] += int((why == reason).sum())
        self._own_with_episode += int(((why == CallEnd.OWN) & played.over[rows]).sum())
        if self.reached is not None:
            ended_rows = rows[over]
            last = _outcome(self._skill, played, self._elapsed[played.episode], ended_rows)
            assert last.success is not None
            self.reached[episode[over]] = last.success
        self._running[episode[over]] = False
        self._done[episode[over]] = True

    def reports(self) -> dict[str, SkillReport]:
        """Return the skill's report and, for a hierarchy, the reports of its skills, by path."""
        calls = int(self._done.sum())
        has_reward = not isinstance(self._skill, RecordedSkill)
        report = SkillReport(
            steps=int(self._elapsed.sum()),
            calls=calls,
            ended=dict(self._ended),
            succeeded=None if self.reached is None else int(self.reached.sum()),
            return_sum=float(self._returns.sum()) if has_reward else None,
            first=calls,
            own_with_episode=self._own_with_episode,
        )
        below = {} if self._below is None else self._below.reports()
        return {self._path: report} | below

    def handover(self) -> list[str]:
        """Return the sentences of a hierarchy's own skills."""
        return [] if self._below is None else self._below.handover()


def tally_of(policy: Policy, episodes: int) -> tuple[str | None, SkillTally | CallTally]:
    """Return the path of the skill that acts alone, or None, and a tally of its calls."""
    skill = getattr(policy, "skill", None)
    if not isinstance(skill, Skill):
        return None, SkillTally(policy, episodes)
    alone: Any = policy
    return alone.path, CallTally(skill, alone.path, alone.policy, episodes)


def rows_of(played: Played, rows: Array) -> Played:
    """Return a step of ``rows`` (m,) of the acting environments."""
    if len(rows) == len(played.rows):
        return played
    values = {f.name: getattr(played, f.name) for f in fields(played)}
    step = part_of(played.step, played.step.elapsed[rows], rows)
    arrays = {k: v[rows] for k, v in values.items() if isinstance(v, np.ndarray)}
    return Played(**values | arrays | {"step": step})


def played_below(played: Played, i: int, rows: Array) -> Played:
    """Return a step of ``rows`` (m,) inside the hierarchy that is skill ``i``."""
    assert played.elapsed is not None
    part, memory = rows_of(played, rows), played.memory[str(i)]
    elapsed = memory["elapsed"][part.rows]
    return replace(
        part,
        step=part_of(part.step, played.elapsed[rows]),
        memory=memory,
        acting=memory["skill"][part.rows],
        call_start=elapsed == 1,
        elapsed=elapsed,
        why=memory["end"][part.rows],
    )


def levels_of(skills: Mapping[str, SkillReport]) -> dict[str, dict[str, SkillReport]]:
    """Return the reports grouped by the path of their hierarchy; "": the outermost."""
    levels: dict[str, dict[str, SkillReport]] = {}
    for name, report in skills.items():
        levels.setdefault(level_of(name), {})[name] = report
    return levels


def all_steps(skills: Mapping[str, SkillReport]) -> int:
    """Return the environment steps of all skills, each step counted once."""
    top = [name for name in skills if level_of(name) not in skills]
    return sum(skills[name].steps for name in top)


def _outcome(
    skill: Skill, played: Played, elapsed: Array, rows: Array, i: int | None = None
) -> Outcome:
    """Judge a step of ``rows`` (m,) of the acting environments; ``elapsed`` is of all.

    Args:
        i: the skill's place in its hierarchy; None: it acts alone.
    """
    goal = None
    if skill.goal_space is not None:
        goals = played.memory[OWN_GOAL] if i is None else played.memory["goal"][str(i)]
        goal = goals[played.rows[rows]]
    step = seen_by(skill, played.step, elapsed[rows], rows, goal)
    return judge(skill, step, played.rows[rows])
