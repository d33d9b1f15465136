"""Reports of a policy's skills in an evaluation (steps, calls, ends, rewards), and text on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from skillweave._internal.messages import aligned
from skillweave._internal.paths import join, level_of
from skillweave.calls.columns import (
    ENDS,
    began_late,
    limits_of_choices,
    time_limit_of,
    whole_steps,
)
from skillweave.calls.handover import FEW, LEAST, Handover, pair_counts
from skillweave.calls.recorder import Recorder
from skillweave.policies.core import Array, CallEnd
from skillweave.schema import Check, Count
from skillweave.skills import is_trained
from skillweave.skills.base import RecordedSkill
from skillweave.skills.learnable import learn_on
from skillweave.training.played_calls import PlayedCalls

Ended = Annotated[
    dict[str, Count],
    Check(
        f"numbers of calls by {', '.join(ENDS.values())}, or empty",
        lambda x: not x or set(x) == set(ENDS.values()),
    ),
]
"""Numbers of calls by their end; empty: unknown."""


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
    ended: Ended
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
    at_once: Count = field(default=0, compare=False)
    """Calls that ended by themselves after one step."""
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
    began_late: Count = field(default=0, compare=False)
    """Calls that began too late to run their whole length before the episode's time limit: they do
    not count in ``success_rate``."""
    began_late_succeeded: Count = field(default=0, compare=False)
    """Those of them that succeeded."""

    @property
    def cannot_last(self) -> bool:
        """True if each call ended by itself after one step, and that did not do its work.

        A move of one step that succeeds, or that was given and has no ``success``, is right.
        """
        works = self.succeeded or (self.succeeded is None and not self.learns)
        every = self.at_once == self.calls >= FEW and self.own_with_episode < self.calls
        return every and not works

    @property
    def counted(self) -> int:
        """The calls that began early enough to run their whole length."""
        return self.calls - self.began_late

    @property
    def length_mean(self) -> float | None:
        """Mean steps of a call; None: no calls."""
        return self.steps / self.calls if self.calls else None

    @property
    def success_rate(self) -> float | None:
        """Share of ``counted`` that succeeded; None: no calls, or the skill defines no success."""
        if self.succeeded is None or not self.counted:
            return None
        return (self.succeeded - self.began_late_succeeded) / self.counted

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
    """Return an evaluation's report on each skill, by its path; those below a skill follow it.

    Args:
        calls: with the skills' own rewards.
    """
    found: dict[str, SkillReport] = {}
    recorders = calls.recorders()
    limit = _time_limit(recorders[""].rows())
    for recorder in recorders.values():
        found |= _level_reports(calls, recorder, limit)
    return {name: found[name] for path in calls.skills() if (name := join(calls.prefix, path))}


def _level_reports(
    calls: PlayedCalls, recorder: Recorder, time_limit: int
) -> dict[str, SkillReport]:
    """Return an evaluation's reports on the skills of one level, by their paths."""
    rows, skill, before = _with_before(recorder)
    skills = recorder.skills.skills
    alone = calls.alone is not None and not recorder.path
    names = _paths(calls, recorder)
    own = rows["end_reason"] == CallEnd.OWN
    over = rows["terminated"] | rows["truncated"]
    judged, pays = (np.array([s.defines(m) for s in skills]) for m in ("success", "reward"))
    won = rows["succeeded"] & judged[skill]
    last = np.roll(rows, 1)
    again = (before == skill + 1) & np.roll(own, 1)
    again &= last["age"] + last["steps"] == rows["age"]
    late = _began_late(recorder, rows, time_limit)
    hasty = own & ~over & (rows["steps"] <= 2) & pays[skill] & (rows["last_reward"] < 0) & ~won
    which = {
        "calls": np.ones(len(rows), bool),
        "first": before == 0,
        "idle": own & again & (rows["steps"] == 1),
        "at_once": own & (rows["steps"] == 1),
        "late": rows["late"],
        "hasty": hasty & (not alone),
        "own_with_episode": own & over,
        "succeeded": won,
        "began_late": late,
        "began_late_succeeded": late & won,
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
    """Return an evaluation's sentences on skills that succeed less after one skill than elsewhere.

    Skills without ``success`` are left out.
    """
    sentences = []
    recorders = calls.recorders()
    limit = _time_limit(recorders[""].rows())
    for recorder in recorders.values():
        rows, skill, before = _with_before(recorder)
        names = _paths(calls, recorder)
        won = rows["succeeded"]
        judged = np.array([s.defines("success") for s in recorder.skills.skills])
        follows = judged[skill] & ((before == 0) | np.roll(won, 1))
        late = _began_late(recorder, rows, limit)
        pairs = pair_counts(before, skill, won, len(names), follows & ~late)
        none = np.zeros_like(pairs[0])
        sentences += Handover(names, *pairs, none, time_limit=limit).weak_sentences(LEAST)
    return sentences


def _time_limit(rows: Array) -> int:
    """Return the steps after which a time limit ended episodes, by the outermost calls; 0: none."""
    cut = rows["truncated"] & ~rows["terminated"]
    return time_limit_of(rows["age"] + rows["steps"], cut)


def _began_late(recorder: Recorder, rows: Array, time_limit: int) -> Array:
    """Return the evaluated calls of a level that began too late to count, (C,) bool."""
    complete = (rows["end_reason"] == CallEnd.OWN) | rows["terminated"]
    was_cut = (rows["end_reason"] == CallEnd.EPISODE) & rows["truncated"] & ~rows["terminated"]
    limits = limits_of_choices(recorder.skills, recorder.limits)
    whole = whole_steps(rows["choice"], rows["steps"], complete, was_cut, limits)
    return began_late(rows["age"], whole[rows["choice"]], time_limit)


def _with_before(recorder: Recorder) -> tuple[Array, Array, Array]:
    """Return the evaluated calls of a level by episode, each with its skill and the one before.

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
    """Return an evaluation's reports on skills, grouped by the path of their hierarchy."""
    levels: dict[str, dict[str, SkillReport]] = {}
    for name, report in skills.items():
        levels.setdefault(level_of(name), {})[name] = report
    return levels


def all_steps(skills: Mapping[str, SkillReport]) -> int:
    """Return the environment steps in all skills' reports, each step counted once."""
    top = [name for name in skills if level_of(name) not in skills]
    return sum(skills[name].steps for name in top)


TITLES = ("skill", "share", "calls", "length", *ENDS.values(), "success", "return")
"""Titles of a table of skills, whose rows ``cells_of`` returns."""


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}"


def _number(value: float | None, scale: float | None = None) -> str:
    return "-" if value is None else f"{value:,.1f}"


Words = tuple[Callable[[float | None], str], Callable[..., str], str]
"""Functions that write a share, and a number to the scale of those beside it; and words after the
share of calls that ended by themselves in the episode's last step."""
IN_TEXT: Words = (_percent, _number, "last step")


def skill_rows(skills: Mapping[str, SkillReport], words: Words = IN_TEXT) -> list[dict[str, Any]]:
    """Return a row of a table of skills for each skill, in words but for ``share``."""
    percent, number, _ = words
    total = all_steps(skills)
    longest = max([10, *(report.length_mean or 0 for report in skills.values())])
    return [
        {
            "name": name,
            "share": (share := report.steps / total if total else 0.0),
            "percent": percent(share),
            "calls": f"{report.calls:,}",
            "length": number(report.length_mean, longest),
            "ends": end_cells(report.ended, report.own_with_episode, report.calls, words),
            "success": percent(report.success_rate),
            "return": number(report.return_mean),
        }
        for name, report in skills.items()
    ]


def end_cells(
    reasons: Mapping[str, int], own_with_episode: int, calls: int, words: Words
) -> list[str]:
    """Return cells of a table of skills in evaluations and reports: how calls ended."""
    percent, _, last = words
    cells = [percent(reasons[why] / calls if reasons and calls else None) for why in ENDS.values()]
    if own_with_episode:
        cells[0] += f" ({percent(own_with_episode / calls)} {last})"
    return cells


def cells_of(row: Mapping[str, Any]) -> list[str]:
    """Return the cells of a row of ``skill_rows``, in the order of ``TITLES``."""
    parts = (row["name"], row["percent"], row["calls"], row["length"])
    return [*parts, *row["ends"], row["success"], row["return"]]


def skill_table(skills: Mapping[str, SkillReport]) -> str:
    """Return the reports as an aligned table for people, a line for each skill."""
    return aligned([TITLES, *map(cells_of, skill_rows(skills))], left=1)


def call_line(name: str, report: SkillReport, episodes: int) -> str:
    """Return an evaluation's words on the calls of a skill that acts alone.

    Args:
        episodes: that were played; the skill begins once in each, if it may.
    """
    if not report.calls:
        return f"{name} could start nowhere by its initiation()"
    results = []
    if report.return_mean is not None:
        results.append(f"{report.return_mean:,.1f} by its own reward")
    if report.success_rate is not None:
        results.append(f"{report.success_rate:.0%} succeed")
    called = f"{name} alone: {report.calls:,} calls of {report.length_mean:,.0f} steps"
    if never := episodes - report.calls:
        results.append(
            f"in {never:,} of {episodes:,} episodes it never began, as its initiation() was False"
        )
    return ", ".join([called, *results])


def hints(skills: Mapping[str, SkillReport]) -> list[str]:
    """Return a sentence on each probable mistake."""
    instant = [instant_calls(name, one) for name, one in skills.items() if one.cannot_last]
    return [*instant, *idle_calls(skills), *late_calls(skills), *hasty_calls(skills)]


def instant_calls(name: str, report: SkillReport) -> str:
    """Return an evaluation's sentence on a skill that ``cannot_last``."""
    return (
        f"Every call of {name!r} ({report.calls:,}) ended after one step: its termination() is "
        "true there. If that is so everywhere, its condition is wrong, and no call can do more."
    )


def reflex_lines(reflexes: Mapping[str, int], total: int) -> list[str]:
    """Return an evaluation's line on each reflex, with its share of ``total`` steps."""
    return [
        f"reflex {name} acted in {steps:,} of {total:,} steps ({steps / total:.1%})"
        for name, steps in reflexes.items()
    ]


def idle_calls(skills: Mapping[str, SkillReport]) -> list[str]:
    """Return a sentence on each skill with mostly idle calls, while its others take time.

    A skill whose calls all take a step or two, as a move does, is left out; so is one that could
    not be kept from starting: it has goals, or is the only one.
    """
    sentences = []
    levels = [level_of(name) for name in skills]
    for name, report in skills.items():
        others = report.calls - report.idle
        only = levels.count(level_of(name)) == 1
        if report.has_goals or only or report.cannot_last:
            continue
        if report.idle > others and report.steps - report.idle > 2 * others:
            sentences.append(
                f"{report.idle:,} of {report.calls:,} calls of {name!r} ended after one step, "
                "right after a call of it had ended. If its work is done there, let its "
                "initiation() be False there; some other skill must be able to start."
            )
    return sentences


def late_calls(skills: Mapping[str, SkillReport]) -> list[str]:
    """Return an evaluation's sentence on each skill with a quarter of its calls late, or more."""
    return [
        f"{report.late:,} of {report.calls:,} calls of {name!r} went on to their limit after they "
        "had succeeded. If its work is done then, let its termination() be True where success() "
        "is; if it is meant to last, give it max_steps."
        for name, report in skills.items()
        if 4 * report.late >= report.calls > 0
    ]


def hasty_calls(skills: Mapping[str, SkillReport]) -> list[str]:
    """Return an evaluation's sentence on each skill with half of its calls hasty, or more.

    A move of one step with its own cost is included.
    """
    sentences = []
    for name, report in skills.items():
        if 2 * report.hasty >= report.calls > 0:
            failed = "" if report.succeeded is None else ", without success"
            sentences.append(
                f"{report.hasty:,} of {report.calls:,} calls of {name!r} ended by its "
                f"termination() within two steps{failed}, and their last reward was below 0. "
            )
            if report.learns:
                sentences[-1] += (
                    "Where a step costs and an end pays nothing, it is best to end at once: pay "
                    "for success, or let success alone end it."
                )
            else:
                sentences[-1] += "Let success alone end it."
            if not report.has_goals:
                sentences[-1] += (
                    " If it was called where its work was done, let its initiation() be False "
                    "there."
                )
    return sentences


def useless_skills(
    skills: Mapping[str, SkillReport], episodes: int, *, selector_learns: bool
) -> list[str]:
    """Return an evaluation's sentence on each skill without calls, or without successful ones.

    Args:
        episodes: the number of episodes that were played.
        selector_learns: False: it is ready, so no setting changes what it chooses.
    """
    sentences = []
    for name, report in skills.items():
        if not report.calls:
            further = ", give it more steps" if report.learns else ""
            further += (
                ", or raise together.epsilon_final"
                if selector_learns
                else ", or let the selector choose it"
            )
            sentences.append(
                f"Skill {name!r} was never chosen in {episodes} episodes. If the task needs it, "
                f"see that its initiation() is True where the other skills end{further}; else "
                "leave it out."
            )
        elif report.cannot_last:
            sentences.append(instant_calls(name, report))
        elif report.succeeded == 0:
            if not report.learns:
                advice = f"Give it longer calls (call_steps), or let it learn: {learn_on(name)}"
            elif report.has_goals:
                advice = (
                    f"See how many goals of its own it reaches, evaluate(skill={name!r}): if many, "
                    "the goals that were chosen here are out of its reach, or take longer calls "
                    "(call_steps); if few, give it more steps, or a reward that leads there"
                )
            else:
                advice = (
                    "Give it more steps or longer calls (call_steps), or a reward that leads there"
                )
            sentences.append(
                f"None of {report.calls:,} calls of skill {name!r} ended with success() true. "
                f"{advice}."
            )
    return sentences


def stuck_selector(exploring: float, alone: float, skills: Mapping[str, SkillReport]) -> str:
    """Return a sentence on a selector that did clearly better while it explored.

    Args:
        exploring: mean return of the latest training episodes.
        alone: the best mean return without choices at random.
        skills: of episodes with a greedy selector.
    """
    name, report = max(skills.items(), key=lambda item: item[1].calls)
    share = report.calls / max(1, sum(one.calls for one in skills.values()))
    done = "" if report.has_goals else "let its initiation() be False where its work is done, "
    return (
        "The latest training episodes, with some calls chosen at random, had a mean return of "
        f"{exploring:.4g}; without such calls the best is {alone:.4g}. A greedy selector calls "
        f"{name!r} in {share:.0%} of its decisions, for {report.length_mean or 0.0:.1f} steps "
        f"each: {done}let each call cost a little (Selection(deliberation_cost=0.001)), or give "
        "more steps."
    )
