"""The facts that reports, cards and comparisons show: of runs, stages, skills, pairs of skills.

Numbers are as people read them: digits that fit the scale, percents.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from skillweave._internal.paths import level_of
from skillweave.calls.handover import wilson
from skillweave.runs.command_words import command_words
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import LevelEntry, StageEntry
from skillweave.skills import Skill
from skillweave.training.evaluation import Evaluation
from skillweave.training.skill_report import SkillReport, Words, all_steps

DIGITS = 3
"""Significant digits."""
MOST_DECIMALS = 4
NOTHING = "–"


def number(value: float | None, scale: float | None = None) -> str:
    """Return a number for a report, with three significant digits.

    Args:
        scale: the scale of the numbers beside it, which get as many decimals; None: its own.
    """
    if value is None:
        return NOTHING
    size = abs(value) if scale is None else abs(scale)
    if value and (size < 10**-MOST_DECIMALS or abs(value) >= 1e9):
        return f"{value:.{DIGITS - 1}e}".replace("-", "−")
    places = DIGITS - 1 - math.floor(math.log10(size)) if size > 0 else 0
    places = min(max(places, 0), MOST_DECIMALS)
    text = f"{round(value, places) + 0.0:,.{places}f}"
    if scale is None and "." in text:
        text = text.rstrip("0").rstrip(".")
    return text.replace("-", "−")


def scale_of(values: Iterable[float | None]) -> float:
    """Return the largest size among numbers that a report shows beside each other."""
    return max((abs(value) for value in values if value is not None), default=0.0)


def percent(value: float | None) -> str:
    """Return a share for a report as 42 %; 0 % and 100 % are exact."""
    if value is None:
        return NOTHING
    if 0 < value < 0.005:
        return "<1 %"
    if 0.995 <= value < 1:
        return ">99 %"
    return f"{100 * value:.0f} %"


def span(bounds: Iterable[Any], say: Callable[[float], str] = percent) -> str:
    """Return the bounds of an interval in words."""
    return " to ".join(say(float(bound)) for bound in bounds)


# Runs and stages


def name_of(run: RunDirectory) -> str:
    """Return the name of a run's directory."""
    return run.path.resolve().name


def facts(run: RunDirectory) -> list[tuple[str, str]]:
    """Return facts about the training, by name."""
    manifest = run.manifest
    rows = [
        ("Environment", manifest.env),
        ("Made with", plain(manifest.env_kwargs) if manifest.env_kwargs else ""),
        ("Recipe", manifest.recipe or "declared in Python"),
        ("Seed", str(manifest.seed)),
        ("Made", manifest.created.replace("T", " ")),
    ]
    if (level := manifest.hierarchy) is not None:
        rows += [
            ("Skills", ", ".join(manifest.by_path)),
            ("A call lasts", _call_length(level)),
            ("Selector", f"ready: {level.selector.kind}" if level.selector else "trained"),
            ("Learning", level.learn),
            (
                "Calls are cut at",
                "" if level.interrupt is None else f"{level.interrupt} deviations",
            ),
            ("Reflexes", ", ".join(level.reflexes)),
        ]
    return [(name, fact) for name, fact in rows if fact]


def _call_length(level: LevelEntry) -> str:
    """Return words on the length of a level's calls, for reports and cards."""
    if level.call_lengths:
        return f"{plain(level.call_lengths)} steps at most, as the selector chooses"
    most = level.call_steps
    if most is None:
        return "until the skill stops"
    return "1 step" if most == 1 else f"at most {most:,} steps"


def stage_rows(run: RunDirectory, steps: Mapping[str, int]) -> list[dict[str, str]]:
    """Return a row for each stage; ``steps``: by stage, the steps of its last metrics."""
    rows = []
    for entry in run.manifest.stages:
        notes = []
        if entry.continued:
            notes.append(f"continued after {', '.join(f'{k:,}' for k in entry.continued)} steps")
        if entry.extended is not None:
            notes.append(f"up to {entry.extended:,} steps, as it acted seldom")
        if entry.reached is not None:
            notes.append(f"target reached after {entry.reached.steps:,} steps")
        if entry.stopped is not None:
            notes.append(f"a callback ended it after {entry.stopped.steps:,} steps")
        notes += [str(found) for found in (entry.best, entry.kept) if found is not None]
        if (winner := entry.winner) is not None:
            notes.append(f"winner: member {winner.member}, fitness {winner.fitness:.1f}")
        far = f"{steps.get(entry.name, 0):,} of {entry.budget:,}"
        rows.append(
            {
                "name": entry.name,
                "kind": entry.kind,
                "algorithm": entry.algorithm.get("algorithm", "?"),
                "status": entry.status,
                "steps": f"{entry.steps:,}" if entry.done else far,
                "seconds": f"{entry.seconds:,.1f}" if entry.done else "–",
                "speed": "–"
                if entry.steps_per_second is None
                else f"{entry.steps_per_second:,.0f}",
                "return": number(entry.final.get("return")),
                "notes": "; ".join(notes),
            }
        )
    return rows


def missing_stages(run: RunDirectory, steps: Mapping[str, int]) -> list[str]:
    """Return a sentence for each unfinished stage; ``steps``: by stage, at its last metrics."""
    sentences = []
    for entry in run.manifest.stages:
        name, budget = entry.name, entry.budget
        if entry.status == "waiting":
            sentences.append(f"The stage {name!r} has not begun.")
        elif entry.status == "training":
            far = f"after {steps[name]:,}" if name in steps else "before the first line of metrics"
            sentences.append(
                f"The stage {name!r} is not finished: it stands {far} of {budget:,} steps."
            )
    if sentences:
        sentences.append(
            "Only a finished run can be played, so there are no episodes and no film. To finish "
            f"it: {command_words('resume', run)}"
        )
    return sentences


def plain(value: Any) -> str:
    """Return a value of a setting as reports show it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(plain(v) for v in value) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{k}={plain(v)}" for k, v in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)


# Skills, and pairs of skills

WHY = {
    "own": "by itself",
    "limit": "at a limit",
    "interrupted": "cut by the selector",
    "episode": "with the episode",
}
"""Ends of calls in the page's words."""
WORDS: Words = (percent, number, "in the last step")
"""Formats and words of the page's table of skills."""


def about(skill: Skill) -> str:
    """Return the first paragraph of a skill's docstring; empty where it has none."""
    for kind in type(skill).__mro__[: type(skill).__mro__.index(Skill)]:
        if text := inspect.cleandoc(kind.__doc__ or ""):
            return " ".join(text.split("\n\n")[0].split()).replace("``", "`")
    return ""


def transitions(reports: Mapping[str, SkillReport]) -> list[list[int]] | None:
    """Return how often each skill followed another: (1 + S, S + 1); None: not known.

    The first row is an episode's start, the last column its end.
    """
    names = list(reports)
    if not names or not all(set(r.followed) == set(names) for r in reports.values()):
        return None
    rows = [[reports[name].first for name in names] + [0]]
    for report in reports.values():
        after = [report.followed[name] for name in names]
        rows.append([*after, report.calls - sum(after)])
    return rows


def transition_rows(
    labels: Sequence[str], counts: Sequence[Sequence[float]]
) -> list[dict[str, Any]]:
    """Return a row for each skill and for an episode's start: counts and shares of successors."""
    rows = []
    for name, row in zip(("start of an episode", *labels), counts, strict=True):
        total = sum(row)
        cells = [{"count": f"{n:,.0f}", "share": n / total if total else 0.0} for n in row]
        rows.append({"name": name, "total": total, "cells": cells})
    return rows


# The verdict: one sentence on a policy, written from an evaluation

FEW = 5
"""With fewer episodes than these a mean has little meaning."""
ALONE = 0.95
"""The share of steps from which on one skill does nearly everything."""
SELDOM = 0.01
"""The share of steps below which a skill does nearly nothing."""
WEAK = 0.5
"""The share of successful calls below which a skill is weak."""


def solved(score: Evaluation) -> int | None:
    """Return how many episodes were solved; None: the task is not of this kind.

    An episode is solved where ``info["success"]`` is true, or, where every
    return is 0 or 1, if its return is 1.
    """
    if score.succeeded is not None:
        return score.succeeded
    if is_binary(score.returns):
        return int(sum(score.returns))
    return None


def solved_share(score: Evaluation) -> float | None:
    """Return the share of episodes that are solved, or else at the environment's threshold."""
    count = solved(score)
    return score.solved_fraction if count is None else count / len(score.returns)


def is_binary(returns: Sequence[float]) -> bool:
    """Return whether every return is 0 or 1."""
    return set(returns) <= {0.0, 1.0}


def verdict(score: Evaluation, deterministic: bool) -> str:
    """Return one sentence with names between backticks."""
    levels = {level_of(name) for name in score.skills}
    leaves = {name: report for name, report in score.skills.items() if name not in levels}
    parts = [_outcome(score), *_skills(leaves, all_steps(score.skills))]
    if score.cut:
        parts.append(f"{score.cut} {'episode' if score.cut == 1 else 'episodes'} never ended")
    text = "; ".join(parts) + "."
    return text if deterministic else f"With sampled actions: {text[0].lower()}{text[1:]}"


def no_verdict(stages: Sequence[StageEntry]) -> str:
    """Return the sentence in place of a verdict where no episode was played."""
    done = sum(entry.done for entry in stages)
    if done < len(stages):
        return f"Training is not finished: {done} of {len(stages)} stages are done."
    return "No episodes were played, so there is no verdict."


def _outcome(score: Evaluation) -> str:
    """Return the share of episodes that are solved, or their return, in words."""
    said = _result(score)
    if score.all_alike:
        said += ", which are the same in every step: they count as one"
    if score.succeeded_once not in (None, score.succeeded):
        said += f"; {percent(score.success_once_rate)} succeed in some step, but not all to the end"
    return said


def _result(score: Evaluation) -> str:
    """Return the share of episodes that are solved at their end, or their return, in words."""
    n = len(score.returns)
    episodes = "one episode" if n == 1 else f"{n:,} episodes"
    count = solved(score)
    if count is not None:
        if score.all_alike:
            return f"Solves {'all' if count else 'none'} of {episodes}"
        if n < FEW:
            return f"Solves {count} of {n} {'episode' if n == 1 else 'episodes'}: too few to judge"
        share = span(wilson(count, n))
        return f"Solves {percent(count / n)} of {episodes}, so probably {share} of all"
    say = partial(number, scale=scale_of(score.returns))
    mean = say(score.mean)
    if n < FEW and not score.all_alike:
        return f"Mean return {mean} over {episodes}: too few to judge"
    if score.threshold is not None:
        reached = percent(score.solved_fraction) if score.solved_fraction else "none"
        return (
            f"Reaches the environment's threshold of {score.threshold:g} in {reached} of "
            f"{episodes} (mean return {mean})"
        )
    if score.all_alike:
        return f"Mean return {mean} over {episodes}"
    interval = span(score.to_json()["ci95"], say)
    return f"Mean return {mean} over {episodes} (95 % interval {interval})"


def _skills(skills: Mapping[str, SkillReport], total: int) -> list[str]:
    """Return words of the verdict on the skills that are used, and on one that fails."""
    if not skills:
        return []
    sentences = []
    never = [name for name, report in skills.items() if not report.calls]
    shares = {name: report.steps / total for name, report in skills.items() if report.calls}
    first = max(shares, key=lambda name: shares[name], default=None)
    seldom = [name for name, share in shares.items() if share < SELDOM]
    if first is not None and len(skills) > 1 and shares[first] >= ALONE:
        sentences.append(f"`{first}` acts in {percent(shares[first])} of the steps")
    if never:
        sentences.append(f"{_listed(never)} {'is' if len(never) == 1 else 'are'} never called")
    elif seldom:
        verb = "acts" if len(seldom) == 1 else "act"
        sentences.append(f"{_listed(seldom)} {verb} in less than 1 % of the steps")
    elif not sentences and len(skills) > 1:
        sentences.append("every skill is used")
    rates = {k: rate for k, report in skills.items() if (rate := report.success_rate) is not None}
    weakest = min(rates, key=lambda name: rates[name], default=None)
    if weakest is not None and rates[weakest] < WEAK:
        sentences.append(_failing(weakest, skills[weakest]))
    return sentences


def _failing(name: str, report: SkillReport) -> str:
    """Return a sentence of the verdict on a skill that seldom succeeds."""
    calls = report.counted
    if report.calls == 1:
        return f"`{name}` does not succeed in its only call"
    if not report.succeeded:
        return f"`{name}` succeeds in none of its {report.calls:,} calls"
    return f"`{name}` succeeds in only {percent(report.success_rate)} of its {calls:,} calls"


def _listed(names: Sequence[str]) -> str:
    """Join names for a sentence of a report."""
    quoted = [f"`{name}`" for name in names]
    return quoted[0] if len(quoted) == 1 else f"{', '.join(quoted[:-1])} and {quoted[-1]}"
