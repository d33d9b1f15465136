"""The verdict on a policy: one sentence, written from an evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from skillweave._internal.paths import level_of
from skillweave.planning.handover import wilson
from skillweave.reporting.report.facts import number, percent, scale_of, span
from skillweave.runs.manifest import StageEntry
from skillweave.training.evaluation import Evaluation
from skillweave.training.skill_report import SkillReport, all_steps

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
    n = len(score.returns)
    episodes = "one episode" if n == 1 else f"{n:,} episodes"
    count = solved(score)
    if count is not None:
        if n < FEW:
            return f"Solves {count} of {n} {'episode' if n == 1 else 'episodes'}: too few to judge"
        share = span(wilson(count, n))
        return f"Solves {percent(count / n)} of {episodes}, so probably {share} of all"
    say = partial(number, scale=scale_of(score.returns))
    mean = say(score.mean)
    if n < FEW:
        return f"Mean return {mean} over {episodes}: too few to judge"
    if score.threshold is not None:
        reached = percent(score.solved_fraction) if score.solved_fraction else "none"
        return (
            f"Reaches the environment's threshold of {score.threshold:g} in {reached} of "
            f"{episodes} (mean return {mean})"
        )
    interval = span(score.to_json()["ci95"], say)
    return f"Mean return {mean} over {episodes} (95 % interval {interval})"


def _skills(skills: Mapping[str, SkillReport], total: int) -> list[str]:
    """Return words on the skills that are used, and on one that fails."""
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
    """Return a sentence on a skill that seldom succeeds."""
    if report.calls == 1:
        return f"`{name}` does not succeed in its only call"
    if not report.succeeded:
        return f"`{name}` succeeds in none of its {report.calls:,} calls"
    return f"`{name}` succeeds in only {percent(report.success_rate)} of its {report.calls:,} calls"


def _listed(names: Sequence[str]) -> str:
    """Return names for a sentence."""
    quoted = [f"`{name}`" for name in names]
    return quoted[0] if len(quoted) == 1 else f"{', '.join(quoted[:-1])} and {quoted[-1]}"
