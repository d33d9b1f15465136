"""The report of one run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from skillweave._internal.paths import AGENT
from skillweave._internal.policy_protocol import Policy
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.calls.columns import ENDS
from skillweave.calls.handover import wilson
from skillweave.calls.run_log import load_calls
from skillweave.envs.make import EnvSpec
from skillweave.experience.play import PlayedStep as PlayedStep
from skillweave.html_report import charts
from skillweave.html_report.film import episode_shot, make_film
from skillweave.html_report.goal_maps import goal_pictures
from skillweave.html_report.matrix import add_handover
from skillweave.html_report.page import Page, library
from skillweave.html_report.sections import Reported, add_sections
from skillweave.html_report.timelines import (
    chosen_episodes,
    decision_data,
    episode_data,
    names_misfit,
    rounded,
    seen,
)
from skillweave.reporting import facts
from skillweave.reporting.curves import metrics_of, reached_steps, read_curves, thinned
from skillweave.reporting.facts import (
    WHY,
    WORDS,
    about,
    is_binary,
    no_verdict,
    number,
    percent,
    scale_of,
    solved,
    span,
    transition_rows,
    transitions,
    verdict,
)
from skillweave.reporting.lineage import read_lineage, setting_title, short_value
from skillweave.reporting.palette import RGB, color_of, hex_of, is_light
from skillweave.reporting.progress import EpisodeProgress
from skillweave.runs.directory import RunDirectory
from skillweave.runs.hub import must_be_own
from skillweave.runs.manifest import settings_of
from skillweave.schema import AtLeastOne, Count, fitted
from skillweave.skills import Skill
from skillweave.skills.base import RecordedSkill
from skillweave.training.evaluation import Evaluation, episode_seeds, evaluate
from skillweave.training.evaluation_file import SavedEvaluation, load_evaluation
from skillweave.training.played_calls import PlayedCalls, PlayedEpisodes
from skillweave.training.skill_report import levels_of, skill_rows

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
    """The color of each of the log's labels."""
    with_goals: dict[str, Skill]
    """The skills with goals, by path."""


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
        policy, spec: the trained policy and its environment; None: no episodes are played.
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
    page = Page()
    played = None
    log = None
    episodes = fitted(AtLeastOne, episodes, "episodes")
    seed = fitted(Count, seed, "seed")
    filmed = fitted(Count, filmed, "films")
    library()  # a missing extra is reported before anything is played
    must_be_own(path.parent)
    all_curves = read_curves(run)
    reached = reached_steps(all_curves)
    page.missing += facts.missing_stages(run, reached)
    page.missing += [why_not] if why_not and run.finished else []
    absent = dict.fromkeys(("episodes", "film", "handover", "hand_film", "score"))
    page.context |= absent | {"has_skills": False, "goals": []}
    if policy is not None and spec is not None:
        with page.without("are no episodes and no film"):
            played = play_episodes(
                page, policy, spec, episodes, filmed, seed, deterministic, run.num_envs, quiet
            )
    if not all_curves and run.manifest.stages:
        page.missing.append("There are no learning curves: no metrics were written yet.")
    colors = _colors(run, played)
    with page.without("is no handover"):
        log = load_calls(run)
    if log is not None and len(log):
        with_goals = {} if played is None else played.with_goals
        add_handover(page, log, spec, colors, with_goals, filmed=filmed > 0)
        page.context["goals"] += goal_pictures({"": log}, with_goals, "of the run’s log")
    _add_words(page, run, reached)
    _add_scores(page, run, played, seed, deterministic)
    _add_lineages(page, run, colors)
    score = None if played is None else played.score
    add_sections(page, Reported(run, policy, spec, score, log))
    pictures = enumerate(page.context["goals"])
    usual = hex_of(color_of(1))
    page.context["metrics"] = metrics_of(all_curves)
    page.data |= {
        "charts": {f"goals-{i}": picture["spec"] for i, picture in pictures},
        "why": {end: WHY[name] for end, name in ENDS.items()},
        "curves": [
            {
                "label": c.label,
                "spec": charts.curve(c.label, colors.get(c.agent, usual)),
                "points": {
                    metric: [[x, rounded(y)] for x, y in thinned(points)]
                    for metric, points in c.points.items()
                },
            }
            for c in all_curves
        ],
    }
    written = page.write(path, "report.html")
    return written | {"verdict": page.context["verdict"], "missing": page.missing}


@global_generators(Seeds(0) / "report")
def play_episodes(
    page: Page,
    policy: Policy,
    spec: EnvSpec,
    episodes: int,
    filmed: int,
    seed: int,
    deterministic: bool,
    num_envs: int | None,
    quiet: bool = True,
) -> Played:
    """Play episodes with seeds that training never used, film some, and put them into the page."""
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
    wanted = [skill.color for skill in log.skills] or [None] * len(log.labels)
    colors = {k: color_of(i, wanted[i]) for i, k in enumerate(log.labels)}
    with_goals = {k: skill for k, skill in calls.skills().items() if skill.goal_space is not None}
    played = Played(score, log, colors, with_goals)
    _add_episodes(page, played, spec, filmed, quiet)
    page.context["goals"] = goal_pictures(calls.logs(seeds), with_goals, "in the played episodes")
    return played


def _add_episodes(page: Page, played: Played, spec: EnvSpec, filmed: int, quiet: bool) -> None:
    """Put the calls of the episodes into the page, and a film of some of these."""
    log = played.log
    named = spec.observation_names()
    film = None
    if filmed:
        with page.without("is no film"):
            chosen = chosen_episodes(log.episodes, filmed)
            film = make_film(spec, {i: episode_shot(log.episodes[i]) for i in chosen}, quiet=quiet)
    if any(isinstance(skill, RecordedSkill) for skill in log.skills):
        page.missing.append(
            "Of the calls, neither the skills' own rewards nor their successes are known, as the "
            "run was loaded without the code of its skills: --recipe FILE.py gives it."
        )
    if misfit := names_misfit(log.episodes[0].calls["start"][:1], named):
        page.missing.append(misfit)
    shown, left_out = episode_data(log, film, named)
    page.missing += left_out
    labels = list(log.labels)
    hues = [hex_of(color) for color in played.colors.values()]
    page.context |= {
        "episodes": len(log.episodes),
        "filmed": 0 if film is None else len(film.first),
        "film": film,
        "has_skills": log.labels != (AGENT,),
    }
    page.data |= {
        "labels": labels,
        "colors": hues,
        "inks": ["#000" if is_light(color) else "#fff" for color in played.colors.values()],
        "episodes": shown,
        "judged": log.judged,
        "seen": list(seen(log.episodes[0].calls[:1], named)),
    }
    if film is not None:
        page.data["film"] = {"fps": film.fps, "every": film.every}
    if page.context["has_skills"]:
        decisions = decision_data(log, named)
        used = sorted({*decisions["calls"]["skill"]}) if decisions["rows"] else []
        goals = any(decisions["calls"]["goal"])
        spec_ = charts.choices([labels[i] for i in used], [hues[i] for i in used], goals=goals)
        page.data["decisions"] = decisions | {"spec": spec_}


def _colors(run: RunDirectory, played: Played | None) -> dict[str, str]:
    """Return colours by name: skills as in timelines, then the other agents that learnt."""
    names = [skill.name for skill in run.manifest.skills]
    colors = {name: color_of(i) for i, name in enumerate(names)}
    colors |= {} if played is None else played.colors
    for entry in run.manifest.stages:
        for name in (entry.name, *entry.learns, *entry.algorithms):
            colors.setdefault(name, color_of(len(colors)))
    return {name: hex_of(color) for name, color in colors.items()}


def _add_words(page: Page, run: RunDirectory, reached: Mapping[str, int]) -> None:
    """Put facts, stages and settings of the training into the page."""
    manifest = run.manifest
    page.context |= {
        "title": facts.name_of(run),
        "kind": "plain agent" if manifest.hierarchy is None else "hierarchy",
        "facts": facts.facts(run),
        "stages": facts.stage_rows(run, reached),
        "settings": [(k, facts.plain(v)) for k, v in settings_of(manifest).items()],
        "steps": sum(
            reached.get(entry.name, 0) if entry.steps is None else entry.steps
            for entry in manifest.stages
        ),
        "training_seconds": sum(entry.seconds or 0.0 for entry in manifest.stages),
        "run": run,
    }


def _add_scores(
    page: Page, run: RunDirectory, played: Played | None, seed: int, deterministic: bool
) -> None:
    """Put the score and the skills' table into the page.

    They are of the saved evaluation, or of the report's episodes if these are as many.
    """
    source = "of the run's evaluation"
    docs = dict[str, str]()
    saved = load_evaluation(run, deterministic=deterministic)
    if played is not None:
        docs = dict(zip(played.log.labels, map(about, played.log.skills), strict=False))
        if saved is None or len(saved.evaluation.returns) <= len(played.score.returns):
            saved = SavedEvaluation("", seed, deterministic, played.score)
            source = "played for this report"
    page.data["binary"] = saved is not None and is_binary(saved.evaluation.returns)
    if saved is None:
        page.context |= dict.fromkeys(("skill_table", "reflexes", "transitions"), ())
        page.context["verdict"] = no_verdict(run.manifest.stages)
        return
    score = saved.evaluation
    how = "greedy" if saved.deterministic else "sampled"
    of = f"{len(score.returns)} episodes {source} ({how}, seed {saved.seed})"
    page.context |= {
        "verdict": verdict(score, deterministic),
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
    """Return an evaluation's score as texts of a report; digits fit the scale of the returns."""
    score_json = score.to_json()
    n = len(score.returns)
    count = solved(score)
    say = partial(number, scale=scale_of(score.returns))
    one = n == 1 or score.all_alike
    return {
        "mean": say(score.mean),
        "interval": None if one else span(score_json["ci95"], say),
        "no_interval": ("one episode" if n == 1 else "all episodes are alike") + ": no interval",
        "iqm": say(score_json["iqm"]),
        "range": span((min(score.returns), max(score.returns)), say),
        "reached": percent(score.solved_fraction),
        "threshold": None if score.threshold is None else f"{score.threshold:g}",
        "length": number(score_json["length_mean"], max(score_json["length_mean"], 10)),
        "cut": score.cut,
        "binary": is_binary(score.returns),
        "solved": None if count is None else percent(count / n),
        "solved_interval": None if count is None or one else span(wilson(count, n)),
    }


def _add_lineages(page: Page, run: RunDirectory, colors: Mapping[str, str]) -> None:
    """Put a section into the page for each stage whose population evolved."""
    page.context["lineages"], page.data["trees"] = [], []
    for entry in run.manifest.stages:
        lineage = read_lineage(run, entry.name)
        if lineage is None:
            continue
        color = colors[entry.name]
        winner = lineage.winner
        tree = charts.family_tree(lineage, color)
        paths = [charts.setting_path(name, lineage, color) for name in lineage.varied]
        page.data["trees"].append({"tree": tree, "paths": paths})
        scale = scale_of(b.fitness for b in lineage.born.values())
        line = [
            (b.generation + 1, b.member, charts.what_changed(b), number(b.fitness, scale))
            for b in lineage.path(winner)
        ]
        names = [(setting_title(k), short_value(winner.settings[k])) for k in lineage.varied]
        page.context["lineages"].append({"stage": entry.name, "line": line, "settings": names})
