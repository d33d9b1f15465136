"""The page of a run on the hub: a model card, written from the run's files."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

from skillweave.calls.run_log import handover_of
from skillweave.reporting.curves import reached_steps, read_curves
from skillweave.reporting.facts import WHY, WORDS, facts, plain, stage_rows
from skillweave.runs.directory import RunDirectory
from skillweave.runs.hub import public
from skillweave.runs.manifest import settings_of
from skillweave.training.evaluation_file import SavedEvaluation, load_evaluation
from skillweave.training.skill_report import cells_of, skill_rows


def write_card(
    run: RunDirectory, name: str, *, films: Sequence[str], figures: Sequence[str]
) -> str:
    """Return the card as Markdown, with a header that the hub reads.

    Args:
        name: ``owner/name`` on the hub.
        films, figures: files that lie there beside the card.

    Raises:
        RunError: a file of the run is damaged.
    """
    run, saved = RunDirectory(run.path, public(run.manifest)), load_evaluation(run)
    parts = [
        _header(run, name, saved),
        f"# {PurePosixPath(name).name}",
        _about(run),
        *(_shown(path) for path in films),
        _use(run, name),
        _measured(saved),
        *_handed_over(run),
        _training(run),
        *(_shown(path) for path in figures),
        _folded("All settings", ("setting", "value"), settings_of(run.manifest)),
        _folded("Versions", ("of", "version"), run.manifest.versions),
    ]
    return "\n\n".join(parts) + "\n"


def _header(run: RunDirectory, name: str, saved: SavedEvaluation | None) -> str:
    """Return the YAML that the hub reads; every value is written as JSON, which is YAML too."""
    env = run.manifest.env
    kind = "hierarchical-" if run.manifest.hierarchy else ""
    header: dict[str, Any] = {
        "library_name": "skillweave",
        "pipeline_tag": "reinforcement-learning",
        "tags": [f"{kind}reinforcement-learning", "skillweave", env],
    }
    if saved is not None:
        score = saved.evaluation
        value = f"{score.mean:.2f} +/- {score.to_json()['std']:.2f}"
        task = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
        metric = {"type": "mean_reward", "name": "mean_reward", "value": value, "verified": False}
        result = {"task": task, "dataset": {"name": env, "type": env}, "metrics": [metric]}
        header["model-index"] = [{"name": PurePosixPath(name).name, "results": [result]}]
    lines = [f"{key}: {json.dumps(value)}" for key, value in header.items()]
    return "\n".join(["---", *lines, "---"])


def _about(run: RunDirectory) -> str:
    what = "hierarchy of skills" if run.manifest.hierarchy else "plain agent"
    _, _, *rows = _table(("", ""), facts(run))
    return "\n".join([f"A {what}, trained with Skillweave.", "", "| | |", "|---|---|", *rows])


def _shown(path: str) -> str:
    """Return a picture in the card, or a link where pages show no such picture."""
    link = f"[{text(PurePosixPath(path).stem)}](./{quote(path)})"
    return link if path.endswith(".mp4") else f"!{link}"


def _use(run: RunDirectory, name: str) -> str:
    """Return the section of a model card on the use of the run."""
    code = run.manifest.needs_recipe
    given = ", hierarchy" if code else ""
    lines = ["## Use", ""]
    if code:
        lines += [
            "It needs the Python code in which its hierarchy was declared, which is not here: pass "
            "that `hierarchy`, unless it is a recipe that Skillweave ships.",
            "",
        ]
    lines += [
        "```python",
        "import skillweave as sw",
        "",
        f'run = sw.from_hub("{name}"{given})',
        "print(run.evaluate(episodes=10))",
        "```",
        "",
        "It needs Skillweave with its extra `hub`. The files are safetensors and JSON: no code "
        "comes with them.",
    ]
    skills = run.manifest.skills
    ready = (s for s in skills if s.learns_on is None and s.policy is not None)
    if stays := [s for s in ready if s.policy is not None and s.policy.kind == "onnx"]:
        names = ", ".join(text(s.name) for s in stays)
        lines += ["", f"Not here: the ONNX files of {names}, which the hierarchy must bring."]
    return "\n".join(lines)


def _measured(saved: SavedEvaluation | None) -> str:
    """Return the score of the whole policy, and the figures of each skill."""
    if saved is None:
        return "## Measured\n\nIt was not evaluated."
    score = saved.evaluation
    how = "greedy" if saved.deterministic else "sampled"
    whole = str(score).partition("; skills:")[0]
    lines = ["## Measured", "", f"Return {text(whole)} ({how}, seed {saved.seed})."]
    if score.skills:
        ends = (f"ends {w}" for w in WHY.values())
        head = ("skill", "of all steps", "calls", "steps of a call", *ends, "success")
        head = (*head, "own return of a call")
        rows = map(cells_of, skill_rows(score.skills, WORDS))
        lines += ["", "What each skill did:", "", *_table(head, rows)]
    return "\n".join(lines)


def _handed_over(run: RunDirectory) -> list[str]:
    """Return the card's section on the run's log of calls, if that is of the run's skills."""
    matrix = handover_of(run)
    if matrix is None or isinstance(matrix, str):
        return []
    lines = [
        "## Handover",
        "",
        "The share of each skill's calls that are done, by the skill before.",
        text(matrix.meaning),
        "",
        *_table(("after", *matrix.skills), matrix.rows()),
        *(f"\n{text(sentence)}" for sentence in matrix.weakest()),
    ]
    return ["\n".join(lines)]


def _training(run: RunDirectory) -> str:
    """Return the section of a model card on the stages of training."""
    keys = ("name", "algorithm", "steps", "seconds", "return", "notes")
    head = ("stage", "algorithm", "steps", "seconds", "return at its end", "")
    stages = stage_rows(run, reached_steps(read_curves(run)))
    rows = ([row[key] for key in keys] for row in stages)
    return "\n".join(["## Training", "", *_table(head, rows)])


def _folded(title: str, head: tuple[str, str], rows: Mapping[str, Any]) -> str:
    """Return a table of the card that is folded until a reader opens it."""
    shown = _table(head, ([k, plain(v)] for k, v in rows.items()))
    return "\n".join([f"<details><summary>{title}</summary>", "", *shown, "", "</details>"])


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table of the card."""
    lines = ["| " + " | ".join(map(text, cells)) + " |" for cells in (head, *rows)]
    return [lines[0], "|" + " --- |" * len(head), *lines[1:]]


def text(value: str) -> str:
    """Return a value in Markdown as it is: nothing in it is read as Markdown or HTML."""
    plain_text = re.sub(r"([\\`*_{}\[\]()#|~!$])", r"\\\1", " ".join(value.split()))
    return html.escape(plain_text, quote=False)
