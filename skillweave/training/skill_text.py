"""Text on the skills of a policy: a table, and hints of mistakes."""

from __future__ import annotations

from collections.abc import Mapping

from skillweave.paths import level_of
from skillweave.planning.columns import ENDS
from skillweave.skills.learnable import learn_on
from skillweave.training.skill_report import SkillReport, all_steps


def skill_rows(skills: Mapping[str, SkillReport]) -> list[list[str]]:
    """Return the reports as a table's cells: the titles, then a row for each skill."""
    total = all_steps(skills)
    head = ["skill", "share", "calls", "length", *ENDS.values()]
    rows = [[*head, "success", "return"]]
    for name, report in skills.items():
        ends = [
            _percent(report.ended[end] / report.calls) if report.ended and report.calls else "–"
            for end in ENDS.values()
        ]
        if report.own_with_episode:
            ends[0] += f" ({_percent(report.own_with_episode / report.calls)} last step)"
        rows.append(
            [
                name,
                _percent(report.steps / total if total else 0.0),
                f"{report.calls:,}",
                _number(report.length_mean),
                *ends,
                _percent(report.success_rate),
                _number(report.return_mean),
            ]
        )
    return rows


def skill_table(skills: Mapping[str, SkillReport]) -> str:
    """Return the reports as an aligned table for people, a line for each skill."""
    rows = skill_rows(skills)
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            [
                row[0].ljust(widths[0]),
                *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True)),
            ]
        )
        for row in rows
    )


def call_line(name: str, report: SkillReport) -> str:
    """Return a part of a sentence on the calls of a skill that acts alone."""
    if not report.calls:
        return f"{name} could start nowhere by its initiation()"
    results = []
    if report.return_mean is not None:
        results.append(f"{report.return_mean:,.1f} by its own reward")
    if report.success_rate is not None:
        results.append(f"{report.success_rate:.0%} succeed")
    called = f"{name} alone: {report.calls:,} calls of {report.length_mean:,.0f} steps"
    return ", ".join([called, *results])


def hints(skills: Mapping[str, SkillReport]) -> list[str]:
    """Return a sentence on each probable mistake."""
    return [*idle_calls(skills), *late_calls(skills), *hasty_calls(skills)]


def reflex_lines(reflexes: Mapping[str, int], total: int) -> list[str]:
    """Return a line for each reflex, with the share of ``total`` steps in which it acted."""
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
        if report.has_goals or levels.count(level_of(name)) == 1:
            continue
        if report.idle > others and report.steps - report.idle > 2 * others:
            sentences.append(
                f"{report.idle:,} of {report.calls:,} calls of {name!r} ended after one step, "
                "right after a call of it had ended. If its work is done there, let its "
                "initiation() be False there; some other skill must be able to start."
            )
    return sentences


def late_calls(skills: Mapping[str, SkillReport]) -> list[str]:
    """Return a sentence on each skill with a quarter of its calls late, or more."""
    return [
        f"{report.late:,} of {report.calls:,} calls of {name!r} went on to their limit after they "
        "had succeeded. If its work is done then, let its termination() be True where success() "
        "is; if it is meant to last, give it max_steps."
        for name, report in skills.items()
        if 4 * report.late >= report.calls > 0
    ]


def hasty_calls(skills: Mapping[str, SkillReport]) -> list[str]:
    """Return a sentence on each skill with half of its calls hasty, or more.

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
    """Return a sentence on each skill that was never called, or whose calls never succeeded.

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
        elif report.succeeded == 0:
            advice = (
                "Give it more steps or longer calls (call_steps), or a reward that leads there"
                if report.learns
                else f"Give it longer calls (call_steps), or let it learn: {learn_on(name)}"
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
        f"each: {done}let each call cost a little (Selection(call_cost=0.001)), or give more steps."
    )


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.0%}"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:,.1f}"
