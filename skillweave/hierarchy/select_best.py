"""Choice of the hierarchy that a run ends with: episodes of all candidates are compared.

The episodes are played by the engine of training, in one process: in a pool, where it has one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from skillweave._internal.paths import join, level_of, levels_to
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.hierarchy.assembly import assembled
from skillweave.hierarchy.roles import Level, Roles
from skillweave.hierarchy.schedule import open_choices
from skillweave.runs.comparison import SAMPLING, Candidate, Comparison
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import StageEntry
from skillweave.training.episodes import standard_error
from skillweave.training.evaluation import Evaluation, evaluate
from skillweave.training.skill_report import stuck_selector, useless_skills
from skillweave.training.stage import TOGETHER, Policies
from skillweave.training.trainer import Course

SEEDS = 1_000
"""Seeds of these episodes start here: people use smaller ones."""
MOST = 100
"""Most episodes of each candidate."""
LEAST = 20
"""Fewest episodes of each candidate, where ``SHORT_SHARE`` allows them."""
FEWEST = 5
"""Episodes of each candidate below which a comparison says nothing, so none is played."""
SHARE = 0.1
"""Share of the stage's steps that the episodes of a candidate may take."""
SHORT_SHARE = 0.05
"""Share of the stage's steps that a candidate's episodes may take where ``SHARE`` is too little
for ``LEAST``; there are at most five candidates."""
CLEARLY = 2.0
"""Standard errors by which a sampling selector must be better than a greedy one to replace it, as
users expect a greedy one; and training episodes better than all, so that it is said."""


def select_best(
    roles: Roles,
    level: Level,
    course: Course,
    before: Policies,
    after: Policies,
) -> Policies:
    """Return the best of the policies before and after a level has learnt together.

    The run records the choice.
    """
    run = course.run
    entry = run.stage(join(level.path, TOGETHER))
    if entry.kept is None and entry.needs_comparison:
        episodes = _episodes(entry)
        if not episodes:
            entry.kept = Comparison("skills_sample")  # as they did while they learnt
            run.save()
            return after
        course.tell(
            entry,
            f"playing {episodes} episodes of each kind, to decide whether skills and selector "
            "should be greedy",
        )
        scores = _scores(roles, level, run, before, after, episodes)
        means: dict[str, Any] = {name: score.mean for name, score in scores.items()}
        best = _best(scores)
        if best == "before" and entry.starts:
            # The run ends with what it was given, whose copies are not kept.
            run.save_policies(entry.name, _of_stage(entry, before, after))
        kept: Candidate = "given" if best == "before" and entry.starts else best
        entry.kept = Comparison(kept, episodes=episodes, **means)
        played = sum(sum(score.lengths) for score in scores.values())
        entry.evaluation_steps = (entry.evaluation_steps or 0) + played
        run.save()
        course.tell(entry, str(entry.kept))
        skills = scores[best].skills
        learns = level.ready_selector is None
        hints = _exploration(entry, scores) if learns else []
        for hint in hints or useless_skills(skills, episodes, selector_learns=learns):
            for listener in course.listeners:
                listener.message(hint)
        run.drop_used(entry)
        if kept == "given":
            return before
    return before if entry.undone else after


def _of_stage(entry: StageEntry, before: Policies, after: Policies) -> dict[str, AgentPolicy]:
    """Return the policies of a stage's learners before it; a critic may be of after it alone."""
    policies = {name: before.get(name, after[name]) for name in entry.learns}
    return {name: policy for name, policy in policies.items() if isinstance(policy, AgentPolicy)}


def _episodes(entry: StageEntry) -> int:
    """Return in how many episodes each candidate hierarchy is compared: fewer if long, or 0."""
    steps = entry.steps or 0
    length = entry.final.get("length") or steps / entry.num_envs
    episodes = round(SHARE * steps / length)
    if episodes < LEAST:
        episodes = min(LEAST, int(SHORT_SHARE * steps / length))
    return min(episodes, MOST) if episodes >= FEWEST else 0


def _scores(
    roles: Roles,
    level: Level,
    run: RunDirectory,
    before: Policies,
    after: Policies,
    episodes: int,
) -> dict[str, Evaluation]:
    """Return the evaluations of all candidates for the hierarchy that a run ends with, by name."""
    entry = run.stage(join(level.path, TOGETHER))
    spec = roles.spec
    seed = SEEDS + run.manifest.seed
    num_envs = entry.num_envs
    max_steps = None
    if not entry.final.get("length"):
        # No episode has ended, so no policy has learnt from longer ones than these.
        max_steps = max(1, (entry.steps or 0) // num_envs)

    def score(decided: Roles, policies: Policies) -> Evaluation:
        """Return the evaluation of one candidate, in the same episodes as the others."""
        policy = assembled(decided, policies, level.path)
        return evaluate(
            policy,
            spec,
            episodes=episodes,
            seed=seed,
            num_envs=num_envs,
            max_steps=max_steps,
            engine=spec.engine,
        )

    def sampling(name: str) -> Evaluation:
        return score(roles.changed(lambda x: _with_sampling(x, *SAMPLING[name])), after)

    skills_open, selector_open = open_choices(roles, level)
    names = ["greedy"]
    if entry.greedy_judged and skills_open:
        names.append("skills_sample")
    if entry.greedy_judged and selector_open:
        # Under a greedy selector that is stuck, no episode shows how skills should act.
        names += ("selector_samples", "both_sample")[: len(names)]
    scores = {name: sampling(name) for name in names}
    if entry.compared:
        scores["before"] = score(resolve_greedy(roles, run), before)
    return scores


def _best(scores: Mapping[str, Evaluation]) -> Candidate:
    """Return the best candidate hierarchy by mean return; sampling only if clearly better."""
    by_mean: list[Any] = sorted(scores, key=lambda name: -scores[name].mean)  # of equals the first
    greedy: Candidate = next(k for k in by_mean if k == "before" or not SAMPLING[k][1])
    first = scores[by_mean[0]]
    other = scores[greedy]
    difference = first.mean - other.mean
    error = standard_error(other.returns)
    return by_mean[0] if _is_clear(difference, first, error) else greedy


def _is_clear(difference: float, score: Evaluation, error: float) -> bool:
    """Return whether a score differs clearly from a mean return with this standard error."""
    return difference > CLEARLY * math.hypot(standard_error(score.returns), error)


def _exploration(entry: StageEntry, scores: Mapping[str, Evaluation]) -> list[str]:
    """Return a sentence if episodes of training beat all candidate hierarchies clearly."""
    final: Any = entry.final
    best = max(scores.values(), key=lambda score: score.mean)
    if "return_error" not in final:  # too few episodes have ended
        return []
    if not _is_clear(final["return"] - best.mean, best, final["return_error"]):
        return []
    own = {name: one for name, one in scores["greedy"].skills.items() if not level_of(name)}
    return [stuck_selector(final["return"], best.mean, own)]


def resolve_greedy(roles: Roles, run: RunDirectory) -> Roles:
    """Return the table with every choice of greedy or sampling set as the run records it."""
    return roles.changed(lambda level: _with_sampling(level, *_sampling(run, level.path)))


def _with_sampling(level: Level, skills: bool, selector: bool) -> Level:
    """Return a level with skills and selector greedy or sampling, where it leaves that open."""
    choice = level.selection
    decided = replace(
        choice,
        greedy_skills=not skills if choice.greedy_skills is None else choice.greedy_skills,
        greedy_selector=not selector if choice.greedy_selector is None else choice.greedy_selector,
    )
    return replace(level, selection=decided)


def _sampling(run: RunDirectory, path: str) -> tuple[bool, bool]:
    """Return two flags, skills and selector sample, by the outermost stage in which all learnt.

    Args:
        path: of a level, which may have learnt together with the levels above it.
    """
    stages = {s.name: s for s in run.manifest.stages}
    for above in levels_to(path):
        entry = stages.get(join(above, TOGETHER))
        if entry is None or not entry.done:
            continue
        if entry.kept is None:
            if entry.needs_comparison:
                continue
            return True, False  # not evaluated: skills act as they did while the selector learnt
        if (choice := entry.kept.kept) not in ("before", "given"):
            return SAMPLING[choice]
    return False, False
