"""The report of one run."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skillweave.envs.make import EnvSpec
from skillweave.envs.obs_names import ObsNames
from skillweave.errors import SkillweaveError
from skillweave.messages import whole_number
from skillweave.paths import AGENT, join
from skillweave.planning import CallLog
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
    seen,
)
from skillweave.reporting.report.curves import (
    Curves,
    metrics_of,
    reached_steps,
    read_curves,
    thinned,
)
from skillweave.reporting.report.film import Film, make_film
from skillweave.reporting.report.goals import goal_pictures
from skillweave.reporting.report.handover import Section, handover_section
from skillweave.reporting.report.numbers import number, percent, scale_of
from skillweave.reporting.report.page import library, write_page
from skillweave.reporting.report.skills_table import (
    WHY,
    about,
    reflex_rows,
    skill_rows,
    transition_rows,
    transitions,
)
from skillweave.reporting.report.verdict import is_binary, no_verdict, solved, verdict
from skillweave.runs.directory import RunDirectory
from skillweave.runs.hub import must_be_own
from skillweave.seeding import Seeds, global_generators
from skillweave.skills import Skill
from skillweave.skills.base import RecordedSkill
from skillweave.training.evaluation import Evaluation, episode_seeds, evaluate
from skillweave.training.evaluation_file import load_evaluation
from skillweave.training.play import Played as PlayedStep
from skillweave.training.played_calls import PlayedCalls
from skillweave.training.played_episodes import PlayedEpisodes
from skillweave.training.skill_report import levels_of
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
    film: Film | None
    shown: list[dict[str, Any]]
    """The episodes as plain JSON."""
    missing: list[str]
    """Sentences on what there is not."""
    colors: list[RGB]
    """Of each of the log's labels."""
    docs: list[str]
    """The docstrings of the log's skills."""
    named: ObsNames | None
    """Names of the numbers in an observation."""
    goals: list[dict[str, Any]]
    """The pictures of skills with goals."""
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
    how: dict[str, Any] = {"episodes": episodes, "seed": seed, "num_envs": num_envs}
    how["deterministic"] = deterministic
    with EpisodeProgress(episodes, quiet=quiet, name="report") as progress:

        def watch(played: PlayedStep) -> None:
            calls.add(played)
            progress.watch(played)

        score = evaluate(policy, spec, watch=watch, **how)
    log = PlayedEpisodes(calls, episode_seeds(seed, episodes))
    film = None
    missing = []
    if filmed:
        try:
            chosen = chosen_episodes(log.episodes, filmed)
            film = make_film(spec, log.episodes, chosen, quiet=quiet)
        except SkillweaveError as error:
            missing.append(f"There is no film: {_sentence(error)}")
    if any(isinstance(skill, RecordedSkill) for skill in log.skills):
        missing.append(
            "Of the calls, neither the skills' own rewards nor their successes are known, as the "
            "run was loaded without the code of its skills: --recipe FILE.py gives it."
        )
    skill_colors = [skill.color for skill in log.skills]
    skill_colors += [None] * (len(log.labels) - len(skill_colors))
    colors = [color_of(i, color) for i, color in enumerate(skill_colors)]
    named = spec.observation_names()
    if misfit := names_misfit(log.episodes[0].calls[0].obs[None], named):
        missing.append(misfit)
    shown, left_out = episode_data(log, film, named)
    docs = [about(skill) for skill in log.skills]
    with_goals = {
        join(path, skill.name): skill
        for path, recorder in calls.recorders().items()
        for skill in recorder.skills.skills
        if skill.goal_space is not None
    }
    goals: list[dict[str, Any]] = []
    if with_goals:
        logs = calls.logs(episode_seeds(seed, episodes))
        goals = goal_pictures(logs, with_goals, "in the played episodes")
    missing += left_out
    return Played(score, log, film, shown, missing, colors, docs, named, goals, with_goals)


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
    episodes = whole_number(episodes, "episodes", 1)
    seed = whole_number(seed, "seed", 0)
    filmed = whole_number(filmed, "films", 0)
    library()  # a missing extra is reported before anything is played
    must_be_own(path.parent)
    all_curves = read_curves(run)
    reached = reached_steps(all_curves)
    missing = facts.missing_stages(run, reached)
    missing += [why_not] if why_not and run.finished else []
    played = None
    if policy is not None and spec is not None:
        try:
            played = play_episodes(
                policy, spec, episodes, filmed, seed, deterministic, run.num_envs, quiet
            )
            missing += played.missing
        except SkillweaveError as error:
            missing.append(f"There are no episodes and no film: {_sentence(error)}")
    if not all_curves and run.manifest["stages"]:
        missing.append("There are no learning curves: no metrics were written yet.")
    colors = _colors(run, played)
    log = _log(run, missing)
    with_goals = {} if played is None else played.with_goals
    section: Section | None = None
    if log is not None:
        section = handover_section(log, spec, colors, with_goals, filmed=filmed > 0)
        missing += section.missing
    data = {"curves": curve_data(all_curves, colors), "metrics": metrics_of(all_curves)}
    context = _words(run, missing, reached) | _scores(run, played, seed, deterministic)
    context |= _lineages(run, data, colors)
    context |= {"curves": [c.label for c in all_curves], "metrics": data["metrics"]}
    context |= {"episodes": 0, "filmed": 0, "legend": [], "has_skills": False, "handover": None}
    context["goals"] = []
    hand_film = None
    if section is not None:
        context |= section.context
        data |= section.data
        hand_film = section.film
    if played is not None:
        context |= _skills(played)
        data |= _episodes(played)
        if log is not None:
            context["goals"] += goal_pictures({"": log}, played.with_goals, "of the run’s log")
    data["charts"] = {f"goals-{i}": picture["spec"] for i, picture in enumerate(context["goals"])}
    film = None if played is None else played.film
    data |= {"why": WHY, "binary": context["binary"]}
    page = write_page(path, "report.html", context, data, film, hand_film)
    page |= {"seconds": round(time.perf_counter() - began, 2)}
    return page | {"verdict": context["verdict"], "missing": missing}


def _log(run: RunDirectory, missing: list[str]) -> CallLog | None:
    """Return the run's log of calls, or None; add what is missing."""
    try:
        log = load_calls(run)
    except SkillweaveError as error:
        missing.append(f"There is no handover: {_sentence(error)}")
        return None
    return log if log is not None and len(log) else None


def _sentence(error: SkillweaveError) -> str:
    return f"{str(error).rstrip('.')}."


def _colors(run: RunDirectory, played: Played | None) -> dict[str, str]:
    """Return colours by name: skills as in timelines, then the other agents that learnt."""
    names = [skill["name"] for skill in run.manifest.get("skills", ())]
    colors = {name: color_of(i) for i, name in enumerate(names)}
    if played is not None:
        colors |= dict(zip(played.log.labels, played.colors, strict=True))
    for entry in run.manifest["stages"]:
        for name in (entry["name"], *entry["learns"], *entry.get("algorithms", ())):
            colors.setdefault(name, color_of(len(colors)))
    return {name: hex_of(color) for name, color in colors.items()}


def curve_data(all_curves: Sequence[Curves], colors: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the curves with their charts, as plain JSON."""
    usual = hex_of(color_of(1))
    return [
        {
            "spec": charts.curve(c.label, colors.get(c.agent, usual)),
            "points": {
                metric: [[x, float(f"{y:.5g}")] for x, y in thinned(points)]
                for metric, points in c.points.items()
            },
        }
        for c in all_curves
    ]


def _words(run: RunDirectory, missing: list[str], reached: Mapping[str, int]) -> dict[str, Any]:
    manifest = run.manifest
    return {
        "title": facts.name_of(run),
        "kind": "hierarchy" if manifest["kind"] == "hierarchy" else "plain agent",
        "env": manifest["env"],
        "facts": facts.facts(run),
        "stages": facts.stage_rows(run, reached),
        "settings": [(k, facts.plain(v)) for k, v in facts.settings(manifest).items()],
        "versions": list(manifest["versions"].items()),
        "steps": sum(e.get("steps", reached.get(e["name"], 0)) for e in manifest["stages"]),
        "training_seconds": sum(entry.get("seconds", 0.0) for entry in manifest["stages"]),
        "missing": missing,
        "finished": run.finished,
    }


def _scores(
    run: RunDirectory, played: Played | None, seed: int, deterministic: bool
) -> dict[str, Any]:
    """Return the score and the skills' table, of the saved evaluation or the report's episodes."""
    saved = load_evaluation(run, deterministic=deterministic)
    score = None if played is None else played.score
    words = _how("played for this report", seed, deterministic)
    if saved is not None and (score is None or len(saved.evaluation.returns) > len(score.returns)):
        score = saved.evaluation
        words = _how("of the run's evaluation", saved.seed, saved.deterministic)
    if score is None:
        text = no_verdict(run.manifest["stages"])
        nothing: dict[str, Any] = {
            "score": None,
            "skill_table": [],
            "reflexes": [],
            "transitions": [],
        }
        return nothing | {"verdict": text, "binary": False}
    docs = {} if played is None else dict(zip(played.log.labels, played.docs, strict=False))
    return {
        "verdict": verdict(score, deterministic),
        "binary": is_binary(score.returns),
        "score": score_words(score) | {"of": f"{len(score.returns)} episodes {words}"},
        "skill_table": [
            row | {"about": docs.get(row["name"], "")} for row in skill_rows(score.skills)
        ],
        "reflexes": reflex_rows(score.reflexes, sum(score.lengths)),
        "transitions": [
            (path, transition_rows(list(reports), counts))
            for path, reports in levels_of(score.skills).items()
            if (counts := transitions(reports)) is not None
        ],
    }


def score_words(score: Evaluation) -> dict[str, Any]:
    """Return the score as texts; digits fit the scale of the returns."""
    score_json = score.to_json()
    scale = scale_of(score.returns)
    low, high = (number(value, scale) for value in score_json["ci95"])
    count = solved(score)
    words: dict[str, Any] = {
        "mean": number(score_json["mean"], scale),
        "interval": None if len(score.returns) == 1 else f"{low} to {high}",
        "iqm": number(score_json["iqm"], scale),
        "range": f"{number(score_json['min'], scale)} to {number(score_json['max'], scale)}",
        "reached": percent(score_json["solved_fraction"]),
        "threshold": None if score.threshold is None else f"{score.threshold:g}",
        "length": number(score_json["length_mean"], max(score_json["length_mean"], 10)),
        "cut": score_json["cut"],
        "binary": is_binary(score.returns),
        "solved": None,
    }
    if count is None:
        return words
    low, high = (percent(float(bound)) for bound in wilson(count, len(score.returns)))
    share = percent(count / len(score.returns))
    return words | {"solved": share, "solved_interval": f"{low} to {high}"}


def _how(whose: str, seed: int, deterministic: bool) -> str:
    return f"{whose} ({'greedy' if deterministic else 'sampled'}, seed {seed})"


def _lineages(run: RunDirectory, data: dict[str, Any], colors: Mapping[str, str]) -> dict[str, Any]:
    """Return a section for each stage whose population evolved."""
    sections = []
    data["trees"] = []
    for entry in run.manifest["stages"]:
        lineage = read_lineage(run, entry["name"])
        if lineage is None:
            continue
        color = colors[entry["name"]]
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
        sections.append({"stage": entry["name"], "line": line, "settings": names})
    return {"lineages": sections}


def _skills(played: Played) -> dict[str, Any]:
    """Return words and tables of the episodes that were played."""
    log = played.log
    named = zip(log.labels, played.colors, strict=True)
    legend = [(k, hex_of(c), charts.ink_on(c)) for k, c in named]
    return {
        "legend": legend,
        "episodes": len(log.episodes),
        "filmed": 0 if played.film is None else len(played.film.first),
        "has_skills": log.labels != (AGENT,),
        "goals": list(played.goals),
    }


def _episodes(played: Played) -> dict[str, Any]:
    """Return the data of the played episodes for the page's script."""
    log = played.log
    colors = [hex_of(c) for c in played.colors]
    data: dict[str, Any] = {
        "labels": list(log.labels),
        "colors": colors,
        "inks": [charts.ink_on(c) for c in played.colors],
        "episodes": played.shown,
    }
    data["seen"], _ = seen(log.episodes[0].calls[:1], played.named)
    if played.film is not None:
        data["film"] = {"fps": played.film.fps, "every": played.film.every}
    if log.labels != (AGENT,):
        decisions = decision_data(log, played.named)
        used = sorted({row[-2] for row in decisions["rows"]})
        names = [log.labels[i] for i in used]
        goals = any(decisions["goals"])
        decisions["spec"] = charts.choices(names, [colors[i] for i in used], goals=goals)
        data["decisions"] = decisions
    return data
