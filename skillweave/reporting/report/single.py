"""The report of one run."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from skillweave._internal.paths import AGENT
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.envs.make import EnvSpec
from skillweave.envs.obs_names import ObsNames
from skillweave.errors import SkillweaveError
from skillweave.planning.columns import ENDS
from skillweave.planning.handover import wilson
from skillweave.planning.run_log import load_calls
from skillweave.reporting.lineage import read_lineage, setting_title, short_value
from skillweave.reporting.palette import RGB, color_of, hex_of
from skillweave.reporting.progress import EpisodeProgress
from skillweave.reporting.report import charts, facts
from skillweave.reporting.report.calls import (
    chosen_episodes,
    decision_data,
    episode_data,
    names_misfit,
    rounded,
    seen,
)
from skillweave.reporting.report.curves import (
    Curves,
    metrics_of,
    reached_steps,
    read_curves,
    thinned,
)
from skillweave.reporting.report.facts import (
    WHY,
    WORDS,
    about,
    number,
    percent,
    scale_of,
    span,
    transition_rows,
    transitions,
)
from skillweave.reporting.report.film import Film, episode_shot, make_film
from skillweave.reporting.report.goals import goal_pictures
from skillweave.reporting.report.handover import handover_section
from skillweave.reporting.report.page import Section, library, write_page
from skillweave.reporting.report.verdict import is_binary, no_verdict, solved, verdict
from skillweave.runs.directory import RunDirectory
from skillweave.runs.hub import must_be_own
from skillweave.schema import AtLeastOne, Count, fitted
from skillweave.skills import Skill
from skillweave.skills.base import RecordedSkill
from skillweave.training.evaluation import Evaluation, episode_seeds, evaluate
from skillweave.training.evaluation_file import SavedEvaluation, load_evaluation
from skillweave.training.play import Played as PlayedStep
from skillweave.training.played_calls import PlayedCalls, PlayedEpisodes
from skillweave.training.skill_report import levels_of, skill_rows
from skillweave.types import Policy

EPISODES = 20
"""Episodes that a report plays by default."""
FILMED = 3
"""Episodes that a report films by default."""


@dataclass(frozen=True)
class Played:
    """Episodes that were played for a report."""

    score: Evaluation
    log: PlayedEpisodes
    colors: dict[str, RGB]
    """Of each of the log's labels."""
    section: Section
    with_goals: dict[str, Skill]
    """The skills with goals, by path."""


@global_generators(Seeds(0) / "report")
def play_episodes(
    policy: Policy,
    spec: EnvSpec,
    episodes: int,
    filmed: int,
    seed: int,
    deterministic: bool,
    num_envs: int | None,
    quiet: bool = True,
) -> Played:
    """Play episodes with seeds that training never used, and film some of them."""
    spaces = policy.observation_space, policy.action_space
    calls = PlayedCalls(policy, spaces, own_rewards=True, inside=False)
    with EpisodeProgress(episodes, quiet=quiet, name="report") as progress:

        def watch(played: PlayedStep) -> None:
            calls.add(played)
            progress.watch(played)

        score = evaluate(
            policy,
            spec,
            episodes=episodes,
            seed=seed,
            deterministic=deterministic,
            num_envs=num_envs,
            watch=watch,
        )
    seeds = episode_seeds(seed, episodes)
    log = PlayedEpisodes(calls, seeds)
    film = None
    missing = []
    if filmed:
        try:
            chosen = chosen_episodes(log.episodes, filmed)
            film = make_film(spec, {i: episode_shot(log.episodes[i]) for i in chosen}, quiet=quiet)
        except SkillweaveError as error:
            missing.append(f"There is no film: {_sentence(error)}")
    wanted = [skill.color for skill in log.skills] or [None] * len(log.labels)
    colors = {k: color_of(i, wanted[i]) for i, k in enumerate(log.labels)}
    with_goals = {k: skill for k, skill in calls.skills().items() if skill.goal_space is not None}
    section = _section(log, film, spec.observation_names(), colors, missing)
    if with_goals:
        pictures = goal_pictures(calls.logs(seeds), with_goals, "in the played episodes")
        section.context["goals"] += pictures
    return Played(score, log, colors, section, with_goals)


def _section(
    log: PlayedEpisodes,
    film: Film | None,
    named: ObsNames | None,
    colors: Mapping[str, RGB],
    missing: list[str],
) -> Section:
    """Return the words and data of episodes; ``missing`` gets what is not in them."""
    if any(isinstance(skill, RecordedSkill) for skill in log.skills):
        missing.append(
            "Of the calls, neither the skills' own rewards nor their successes are known, as the "
            "run was loaded without the code of its skills: --recipe FILE.py gives it."
        )
    if misfit := names_misfit(log.episodes[0].calls["start"][:1], named):
        missing.append(misfit)
    shown, left_out = episode_data(log, film, named)
    missing += left_out
    legend = [(k, hex_of(color), charts.ink_on(color)) for k, color in colors.items()]
    labels, hues, inks = (list(column) for column in zip(*legend, strict=True))
    context = {
        "legend": legend,
        "episodes": len(log.episodes),
        "filmed": 0 if film is None else len(film.first),
        "film": film,
        "has_skills": log.labels != (AGENT,),
        "goals": [],
    }
    data: dict[str, Any] = {"labels": labels, "colors": hues, "inks": inks, "episodes": shown}
    data["judged"] = log.judged
    data["seen"], _ = seen(log.episodes[0].calls[:1], named)
    if film is not None:
        data["film"] = {"fps": film.fps, "every": film.every}
    if context["has_skills"]:
        decisions = decision_data(log, named)
        used = sorted({*decisions["calls"]["skill"]}) if decisions["rows"] else []
        goals = any(decisions["calls"]["goal"])
        spec = charts.choices([labels[i] for i in used], [hues[i] for i in used], goals=goals)
        data["decisions"] = decisions | {"spec": spec}
    return Section(context, data, missing)


def write_report(
    run: RunDirectory,
    path: Path,
    policy: Policy | None = None,
    spec: EnvSpec | None = None,
    *,
    why_not: str | None = None,
    episodes: int = EPISODES,
    filmed: int = FILMED,
    seed: int = 0,
    deterministic: bool = True,
    quiet: bool = True,
) -> dict[str, Any]:
    """Write a run's report: one HTML file.

    Args:
        policy, spec: what was trained, and on what; None: no episodes are played.
        why_not: the reason why there is no policy, where the run itself is finished.
        episodes: to play, with seeds that training never used.
        filmed: number of these in the film, from the worst to the best.
        seed: picks the episodes, as in ``evaluate``.
        deterministic: act greedily, else sample.
        quiet: no progress.

    Returns:
        ``path``, ``bytes``, ``seconds``, ``verdict``: a sentence on what the policy does, and
        ``missing``: sentences on what is not in it.

    Raises:
        RunError: the run is damaged, or the file cannot be written.
        MissingExtra: the extra 'report' is not installed.
    """
    began = time.perf_counter()
    episodes = fitted(AtLeastOne, episodes, "episodes")
    seed = fitted(Count, seed, "seed")
    filmed = fitted(Count, filmed, "films")
    library()  # a missing extra is reported before anything is played
    must_be_own(path.parent)
    all_curves = read_curves(run)
    reached = reached_steps(all_curves)
    missing = facts.missing_stages(run, reached)
    missing += [why_not] if why_not and run.finished else []
    played, sections = None, []
    if policy is not None and spec is not None:
        try:
            played = play_episodes(
                policy, spec, episodes, filmed, seed, deterministic, run.num_envs, quiet
            )
            missing += played.section.missing
            sections.append(played.section)
        except SkillweaveError as error:
            missing.append(f"There are no episodes and no film: {_sentence(error)}")
    if not all_curves and run.manifest.stages:
        missing.append("There are no learning curves: no metrics were written yet.")
    colors = _colors(run, played)
    try:
        log = load_calls(run)
    except SkillweaveError as error:
        log = None
        missing.append(f"There is no handover: {_sentence(error)}")
    if log is not None and len(log):
        with_goals = {} if played is None else played.with_goals
        sections.append(handover_section(log, spec, colors, with_goals, filmed=filmed > 0))
        missing += sections[-1].missing
        if played is not None:
            pictures = goal_pictures({"": log}, with_goals, "of the run’s log")
            played.section.context["goals"] += pictures
    data: dict[str, Any] = {"curves": _curves(all_curves, colors)}
    data["why"] = {end: WHY[name] for end, name in ENDS.items()}
    context = _words(run, missing, reached) | _scores(run, played, seed, deterministic)
    context |= _lineages(run, data, colors)
    context |= {"curves": [c.label for c in all_curves], "metrics": metrics_of(all_curves)}
    context |= {"episodes": 0, "has_skills": False, "handover": None, "goals": []}
    for section in sections:
        context |= section.context
        data |= section.data
    data["charts"] = {f"goals-{i}": picture["spec"] for i, picture in enumerate(context["goals"])}
    data["binary"] = context["binary"]
    page = write_page(path, "report.html", context, data)
    page |= {"seconds": round(time.perf_counter() - began, 2)}
    return page | {"verdict": context["verdict"], "missing": missing}


def _sentence(error: SkillweaveError) -> str:
    return f"{str(error).rstrip('.')}."


def _colors(run: RunDirectory, played: Played | None) -> dict[str, str]:
    """Return colours by name: skills as in timelines, then the other agents that learnt."""
    names = [skill.name for skill in run.manifest.skills]
    colors = {name: color_of(i) for i, name in enumerate(names)}
    colors |= {} if played is None else played.colors
    for entry in run.manifest.stages:
        for name in (entry.name, *entry.learns, *entry.algorithms):
            colors.setdefault(name, color_of(len(colors)))
    return {name: hex_of(color) for name, color in colors.items()}


def _curves(all_curves: Sequence[Curves], colors: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the curves with their charts, as plain JSON."""
    usual = hex_of(color_of(1))
    return [
        {
            "spec": charts.curve(c.label, colors.get(c.agent, usual)),
            "points": {
                metric: [[x, rounded(y)] for x, y in thinned(points)]
                for metric, points in c.points.items()
            },
        }
        for c in all_curves
    ]


def _words(run: RunDirectory, missing: list[str], reached: Mapping[str, int]) -> dict[str, Any]:
    manifest = run.manifest
    return {
        "title": facts.name_of(run),
        "kind": "plain agent" if manifest.hierarchy is None else "hierarchy",
        "env": manifest.env,
        "facts": facts.facts(run),
        "stages": facts.stage_rows(run, reached),
        "settings": [(k, facts.plain(v)) for k, v in facts.settings(manifest).items()],
        "versions": list(manifest.versions.items()),
        "steps": sum(
            reached.get(entry.name, 0) if entry.steps is None else entry.steps
            for entry in manifest.stages
        ),
        "training_seconds": sum(entry.seconds or 0.0 for entry in manifest.stages),
        "missing": missing,
        "finished": run.finished,
    }


def _scores(
    run: RunDirectory, played: Played | None, seed: int, deterministic: bool
) -> dict[str, Any]:
    """Return the score and the skills' table, of the saved evaluation or the report's episodes."""
    source = "of the run's evaluation"
    saved = load_evaluation(run, deterministic=deterministic)
    if played is not None:
        own = SavedEvaluation("", seed, deterministic, played.score)
        if saved is None or len(saved.evaluation.returns) <= len(played.score.returns):
            saved, source = own, "played for this report"
    if saved is None:
        nothing: dict[str, Any] = dict.fromkeys(("skill_table", "reflexes", "transitions"), ())
        text = no_verdict(run.manifest.stages)
        return nothing | {"verdict": text, "binary": False, "score": None}
    score = saved.evaluation
    docs = (
        {}
        if played is None
        else dict(zip(played.log.labels, map(about, played.log.skills), strict=False))
    )
    how = "greedy" if saved.deterministic else "sampled"
    of = f"{len(score.returns)} episodes {source} ({how}, seed {saved.seed})"
    return {
        "verdict": verdict(score, deterministic),
        "binary": is_binary(score.returns),
        "score": score_words(score) | {"of": of},
        "skill_table": [
            row | {"about": docs.get(row["name"], "")} for row in skill_rows(score.skills, WORDS)
        ],
        "reflexes": score.to_json()["reflexes"],
        "transitions": [
            (path, transition_rows(list(reports), counts))
            for path, reports in levels_of(score.skills).items()
            if (counts := transitions(reports)) is not None
        ],
    }


def score_words(score: Evaluation) -> dict[str, Any]:
    """Return the score as texts; digits fit the scale of the returns."""
    score_json = score.to_json()
    say = partial(number, scale=scale_of(score.returns))
    count = solved(score)
    words: dict[str, Any] = {
        "mean": say(score.mean),
        "interval": None if len(score.returns) == 1 else span(score_json["ci95"], say),
        "iqm": say(score_json["iqm"]),
        "range": span((min(score.returns), max(score.returns)), say),
        "reached": percent(score.solved_fraction),
        "threshold": None if score.threshold is None else f"{score.threshold:g}",
        "length": number(score_json["length_mean"], max(score_json["length_mean"], 10)),
        "cut": score.cut,
        "binary": is_binary(score.returns),
        "solved": None,
    }
    if count is None:
        return words
    interval = span(wilson(count, len(score.returns)))
    return words | {"solved": percent(count / len(score.returns)), "solved_interval": interval}


def _lineages(run: RunDirectory, data: dict[str, Any], colors: Mapping[str, str]) -> dict[str, Any]:
    """Return a section for each stage whose population evolved."""
    sections = []
    data["trees"] = []
    for entry in run.manifest.stages:
        lineage = read_lineage(run, entry.name)
        if lineage is None:
            continue
        color = colors[entry.name]
        paths = charts.setting_paths(lineage, color)
        data["trees"].append(
            {"tree": charts.family_tree(lineage, color), "paths": [spec for _, spec in paths]}
        )
        scale = scale_of(b.fitness for b in lineage.born.values())
        line = [
            (b.generation + 1, b.member, charts.what_changed(b), number(b.fitness, scale))
            for b in lineage.path(lineage.winner)
        ]
        names = [(setting_title(k), short_value(lineage.winner.settings[k])) for k, _ in paths]
        sections.append({"stage": entry.name, "line": line, "settings": names})
    return {"lineages": sections}
