"""Reports of a policy's skills in an evaluation: their steps, calls, ends and rewards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skillweave.paths import join, level_of
from skillweave.planning.columns import ENDS
from skillweave.planning.handover import Handover, pair_counts
from skillweave.planning.recorder import Recorder
from skillweave.policies.core import CallEnd
from skillweave.schema import Count
from skillweave.skills import is_trained
from skillweave.skills.base import RecordedSkill
from skillweave.training.played_calls import PlayedCalls
from skillweave.types import Array


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


def skill_reports(calls: PlayedCalls) -> dict[str, SkillReport]:
    """Return the report of each skill, by its path; those below a skill follow it.

    Args:
        calls: with the skills' own rewards.
    """
    found: dict[str, SkillReport] = {}
    for recorder in calls.recorders().values():
        reports = _level_reports(calls, recorder)
        place = [*found].index(join(calls.prefix, recorder.path)) + 1 if recorder.path else 0
        items = [*found.items()]
        found = dict([*items[:place], *reports.items(), *items[place:]])
    return found


def _level_reports(calls: PlayedCalls, recorder: Recorder) -> dict[str, SkillReport]:
    """Return the reports of the skills of one level, by their paths."""
    rows, skill, before = _with_before(recorder)
    skills, alone = recorder.skills.skills, calls.alone is not None and not recorder.path
    names = _paths(calls, recorder)
    own, over = rows["end_reason"] == CallEnd.OWN, rows["terminated"] | rows["truncated"]
    judged, pays = (np.array([s.defines(m) for s in skills]) for m in ("success", "reward"))
    won = rows["succeeded"] & judged[skill]
    last = np.roll(rows, 1)
    again = (before == skill + 1) & np.roll(own, 1)
    again &= last["age"] + last["steps"] == rows["age"]
    hasty = own & ~over & (rows["steps"] <= 2) & pays[skill] & (rows["last_reward"] < 0) & ~won
    which = {
        "calls": np.ones(len(rows), bool),
        "first": before == 0,
        "idle": own & again & (rows["steps"] == 1),
        "late": rows["late"],
        "hasty": hasty & (not alone),
        "own_with_episode": own & over,
        "succeeded": won,
        **{name: rows["end_reason"] == why for why, name in ENDS.items()},
    }
    counts = {k: np.bincount(skill[of], minlength=len(skills)).tolist() for k, of in which.items()}
    steps, returns = (
        np.bincount(skill, rows[name], minlength=len(skills)) for name in ("steps", "own_return")
    )
    steps = steps if calls.declared else calls.steps
    followed = pair_counts(before, skill, won, len(skills))[0][1:].tolist()
    reports = {}
    for i, (name, one) in enumerate(zip(names, skills, strict=True)):
        of = {key: count[i] for key, count in counts.items()}
        ended = {end: of.pop(end) for end in ENDS.values()}
        reports[name] = SkillReport(
            **of | {"succeeded": of["succeeded"] if judged[i] else None},
            steps=int(steps[i]),
            ended=ended if calls.declared else {},
            return_sum=None if isinstance(one, RecordedSkill) else float(returns[i]),
            followed={} if alone else dict(zip(names, followed[i], strict=True)),
            learns=alone or not calls.declared or is_trained(one),
            has_goals=not alone and one.goal_space is not None,
        )
    return reports


def weak_handovers(calls: PlayedCalls) -> list[str]:
    """Return sentences on skills that succeed much less often after one skill than elsewhere.

    Skills without ``success`` are left out.
    """
    sentences = []
    for recorder in calls.recorders().values():
        rows, skill, before = _with_before(recorder)
        names, won = _paths(calls, recorder), rows["succeeded"]
        cut = (rows["end_reason"] == CallEnd.EPISODE) & ~rows["terminated"] & ~won
        judged = np.array([s.defines("success") for s in recorder.skills.skills])
        counts = judged[skill] & ~cut & ((before == 0) | np.roll(won, 1))
        pairs = pair_counts(before[counts], skill[counts], won[counts], len(names))
        sentences += Handover(names, *pairs, np.zeros(len(names), np.int64)).weakest()
    return sentences


def _with_before(recorder: Recorder) -> tuple[Array, Array, Array]:
    """Return the calls of a level by episode, and the skill of each and of the one before.

    The latter is a row of a ``Handover``, (C,): 0 where the episode starts.
    """
    rows = recorder.rows()
    rows = rows[np.lexsort((rows["order"], rows["episode"]))]
    skill = recorder.skills.skill_of(rows["choice"])
    goes_on = rows["episode"] == np.roll(rows["episode"], 1)
    goes_on[:1] = False
    return rows, skill, np.where(goes_on, np.roll(skill, 1) + 1, 0)


def _paths(calls: PlayedCalls, recorder: Recorder) -> tuple[str, ...]:
    """Return the paths of the skills of a level."""
    return tuple(join(calls.prefix, recorder.path, s.name) for s in recorder.skills.skills)


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
