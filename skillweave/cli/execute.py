"""Carry out each command of the command line."""

from __future__ import annotations

import ast
import importlib
import json
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path, PurePosixPath
from typing import Any

from skillweave._internal import shipped
from skillweave._internal.messages import as_path
from skillweave._internal.notices import notice
from skillweave._internal.terminal import one_line, say
from skillweave.api import Hierarchy, info_json
from skillweave.api.loading import load_from
from skillweave.api.push_pull import pull_run, push_run
from skillweave.api.recipe_file import hierarchy_in
from skillweave.calls.handover import Handover
from skillweave.calls.run_log import handover_json, handover_of
from skillweave.cli import commands
from skillweave.cli.output import Result, run_words, save_score
from skillweave.cli.overrides import list_settings
from skillweave.cli.targets import lacking_words, load_target, load_with_code
from skillweave.errors import DeclarationError, RunError
from skillweave.extensions import resolve
from skillweave.hierarchy.recorded import calls_of
from skillweave.reporting.curves_figure import plot_curves
from skillweave.reporting.plots import plot_run
from skillweave.runs.directory import RunDirectory
from skillweave.runs.hub import check_name, hub
from skillweave.runs.manifest import Manifest
from skillweave.runs.several import open_runs
from skillweave.training.evaluation_file import SavedEvaluation, load_evaluations


def run(command: commands.Output) -> Result:
    """Carry a command of the command line out, and return its result."""
    for field in fields(command):
        value = getattr(command, field.name)
        for word in value if isinstance(value, tuple) else (value,):
            if isinstance(word, Path) or (word and field.name in ("recipe", "target")):
                as_path(word, field.name)
    ways = dict(commands.all_commands().values())
    way: Callable[[Any], Result] = resolve(ways[type(command)])
    return way(command)


def evaluate(command: commands.EvaluateCommand) -> Result:
    """Carry out ``skillweave evaluate``."""
    trained = load_target(command)
    score = trained.evaluate(
        command.episodes,
        seed=command.seed,
        deterministic=command.deterministic,
        skill=command.skill,
        goal=_goal(command),
        num_envs=command.num_envs,
        quiet=command.quiet,
    )
    result = {"target": command.target, "env": trained.declaration.spec.name, "seed": command.seed}
    result |= {"deterministic": command.deterministic, "skill": command.skill}
    result |= {} if command.goal is None else {"goal": _goal(command)}
    if command.skill is None and Path(command.target).is_dir() and not command.pretrained:
        save_score(trained, score, command.seed, command.deterministic)
    return result | score.to_json(), score.for_people()


def _goal(command: commands.Watched) -> Any:
    """Return the goal of a command's ``--goal``; None: it is not given."""
    try:
        return None if command.goal is None else json.loads(command.goal)
    except ValueError as error:
        raise DeclarationError(
            f"--goal {command.goal} is no JSON ({error}); write a list for a vector, "
            '--goal "[0.5, 0.8]", or a number'
        ) from error


def render(command: commands.RenderCommand) -> Result:
    """Carry out ``skillweave render``."""
    trained = load_target(command)
    path = command.out or Path(f"{Path(command.target).name.removesuffix('.safetensors')}.gif")
    result = trained.render(
        path,
        episodes=command.episodes,
        seed=command.seed,
        deterministic=command.deterministic,
        skill=command.skill,
        goal=_goal(command),
        quiet=command.quiet,
    )
    returns = ", ".join(f"{e['return']:.0f}" for e in result["episodes"])
    return result, f"{result['path']}: {result['frames']} frames, return {returns}"


def log(command: commands.LogCommand) -> Result:
    """Carry out ``skillweave log``: record calls of a run's skills."""
    run = load_with_code(command.run, command.recipe)
    if words := lacking_words(run):
        notice(words)
    if not command.quiet:
        say(f"recording {command.steps:,} steps")
    log = run.log_calls(
        command.steps,
        choose=command.choose,
        seed=command.seed,
        info=command.info,
    )
    calls = run.calls
    matrix = calls.handover()
    result = {"run": str(command.run), "recorded": {"calls": len(log), "steps": log.steps}}
    result |= {"calls": len(calls), "steps": calls.steps} | handover_json(matrix)
    text = f"recorded {len(log):,} calls, {log.steps:,} steps; the run has {calls.steps:,} steps"
    return result, "\n".join([text, *_handover_lines(matrix)])


def plot(command: commands.PlotCommand) -> Result:
    """Carry out ``skillweave plot``: figures of one run or of several."""
    runs = open_runs(command.runs)
    of_several = (command.metric, command.agent, *command.label)
    if len(runs) == 1 and all(word is None for word in of_several) and command.band == "iqr":
        paths = [str(path) for path in plot_run(runs[0], command.out)]
        return {"paths": paths}, "\n".join(paths)
    figure = plot_curves(
        command.runs,
        command.out or "curves",
        metric=command.metric,
        agent=command.agent,
        band=command.band,
        labels=command.label or None,
        width=command.width,
    )
    result = {
        "paths": [str(path) for path in figure.paths],
        "caption": figure.caption,
        "metric": figure.metric,
        "lines": {line.label: line.seeds for line in figure.lines},
    }
    return result, "\n".join([*map(str, figure.paths), figure.caption])


def list_all(command: commands.ListCommand) -> Result:
    """Carry out ``skillweave list``: the shipped recipes, and the runs here."""
    found = []
    for name in shipped.names():
        weights = (shipped.source(name).with_suffix(".safetensors")).exists()
        doc = ast.get_docstring(ast.parse(shipped.source(name).read_text("utf-8"))) or ""
        found.append({"name": name, "about": doc.splitlines()[0], "pretrained": weights})
    runs = [_run_line(p.parent) for p in sorted(Path("runs").glob("*/run.json"))]
    lines = ["recipes:"]
    for r in found:
        lines.append(f"  {r['name']:<22} {r['about']}{' [weights]' if r['pretrained'] else ''}")
    if runs:
        lines.append("runs:")
        printable = [{k: one_line(v) for k, v in r.items()} for r in runs]
        lines += [f"  {r['path']:<30} {r['kind']} on {r['env']}: {r['status']}" for r in printable]
    return {"recipes": found, "runs": runs}, "\n".join(lines)


def _run_line(path: Path) -> dict[str, Any]:
    """Return the entry of a run in the output of ``skillweave list``."""
    try:
        run = RunDirectory.open(path)
    except RunError as error:
        return {"path": str(path), "kind": "run", "env": "?", "status": str(error)}
    status = "finished" if run.finished else "unfinished"
    return {"path": str(path), "status": status} | {
        k: getattr(run.manifest, k) for k in ("kind", "env", "seed")
    }


def info(command: commands.InfoCommand) -> Result:
    """Carry out ``skillweave info``: a recipe's settings, or a run's content."""
    if not (Path(command.target) / "run.json").exists() and not Path(command.target).is_dir():
        settings = list_settings(hierarchy_in(command.target, Hierarchy))
        text = "\n".join(f"{k}={v}" for k, v in settings.items())
        return {"recipe": command.target, "settings": settings}, text
    run = RunDirectory.open(command.target)
    manifest = run.manifest
    saved, matrix = load_evaluations(run), handover_of(run)
    lines = [*run_lines(manifest, saved.values(), command.target), *_handover_lines(matrix)]
    return info_json(run, saved, matrix), "\n".join(lines)


def _handover_lines(matrix: Handover | str | None) -> list[str]:
    """Return the matrix of a run's log of calls, as lines of ``skillweave info``."""
    if matrix is None:
        return []
    if isinstance(matrix, str):
        return [f"  log of calls: {one_line(matrix)}"]
    lines = [*str(matrix).splitlines(), *matrix.weakest()]
    title = "  share of calls that are done, by the skill before (calls):"
    return [title, *(f"    {line}" for line in lines)]


def run_lines(manifest: Manifest, saved: Iterable[SavedEvaluation], target: object) -> list[str]:
    """Return a run's manifest and saved evaluations, as lines that a command prints."""
    created = one_line(manifest.created)
    level = manifest.hierarchy
    lines = [f"{manifest.kind} on {one_line(manifest.env)}, seed {manifest.seed}, made {created}"]
    calls = ""
    if level is not None:
        calls = f", call_steps {calls_of(level)}"
        calls += f", ready selector: {level.selector.kind}" if level.selector else ""
        calls += f", guide: {level.guide.source.kind}" if level.guide else ""
    lines += [f"  recipe: {one_line(manifest.recipe or '(declared in Python)')}{calls}"]
    lines += [
        f"  {'stage':<14} {'status':<9} {'steps':>10} {'seconds':>8} {'steps/s':>8} {'return':>8}"
    ]
    for stage in manifest.stages:
        final = stage.final.get("return")
        lines.append(
            f"  {stage.name:<14} {stage.status:<9} {stage.steps or 0:>10,} "
            f"{stage.seconds or 0:>8.1f} {stage.steps_per_second or 0:>8,.0f} "
            f"{'' if final is None else f'{final:.1f}':>8}"
        )
        for name, start in stage.starts.items():
            run = "" if start.run is None else f" {start.run}"
            lines.append(f"    {name} starts from run{run}, after {start.steps:,} steps there")
        if stage.continued:
            steps = ", ".join(f"{k:,}" for k in stage.continued)
            lines.append(f"    continued after {steps} steps")
        if stage.extended is not None:
            lines.append(f"    up to {stage.extended:,} steps, as it acted seldom")
        if (reached := stage.reached) is not None and stage.target is not None:
            lines.append(
                f"    target reached after {reached.steps:,} of {stage.budget:,} steps: "
                f"{stage.target.of} {reached.value:g}"
            )
        if stage.stopped is not None:
            lines.append(
                f"    a callback ended it after {stage.stopped.steps:,} of {stage.budget:,} steps"
            )
        if stage.best is not None:
            lines.append(f"    {stage.best}")
        if (winner := stage.winner) is not None:
            lines.append(
                f"    winner: member {winner.member} of generation {winner.generation + 1}, "
                f"fitness {winner.fitness:.1f} (skillweave plot {target})"
            )
        if stage.kept is not None:
            lines.append(f"    {stage.kept}")
    lines += ["  " + ", ".join(one_line(f"{k} {v}") for k, v in manifest.versions.items())]
    for score in saved:
        how = "greedy" if score.deterministic else "sampled"
        lines.append(f"  evaluated {one_line(score.made)}, seed {score.seed}, {how}:")
        lines += [f"    {line}" for line in score.evaluation.for_people().splitlines()]
    return lines


def weights(command: commands.WeightsCommand) -> Result:
    """Carry out ``skillweave weights``: write a run's weights into one file."""
    trained = load_from(command.run, recipe=command.recipe)
    path = trained.save_weights(command.out)
    return {"path": str(path), "bytes": path.stat().st_size}, f"wrote {path}"


def export(command: commands.ExportCommand) -> Result:
    """Carry out ``skillweave export``."""
    if not command.onnx:
        raise DeclarationError("choose an export format: --onnx")
    name = Path(command.target).name.removesuffix(".safetensors")
    export = load_target(command).export(command.out or Path(f"{name}-onnx"))
    result = {"path": str(export.path), "files": list(export.files), "code": export.code}
    return result, str(export)


def push(command: commands.PushCommand) -> Result:
    """Carry out ``skillweave push``: upload a run to the hub."""
    _no_bars()
    pushed = push_run(command.run, command.name, command.private, command.calls)
    lines = [f"{pushed['url']}: {len(pushed['files'])} files", *pushed["missing"]]
    lines.append(f"load it: skillweave.from_hub({command.name!r})")
    return pushed, "\n".join(lines)


def pull(command: commands.PullCommand) -> Result:
    """Carry out ``skillweave pull``: download a run from the hub."""
    _no_bars()
    name = PurePosixPath(check_name(command.name)).name
    path = pull_run(command.name, command.out or _free_path(Path("runs") / name), command.revision)
    return {"path": str(path)}, "\n".join(run_words(RunDirectory.open(path)))


def _free_path(path: Path) -> Path:
    """Return a command's output ``path``, or the first of path-2, path-3 and so on that is free."""
    number = 1
    candidate = path
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.name}-{number}")
    return candidate


def _no_bars() -> None:
    """Keep the hub's library from drawing a bar for each file."""
    hub()  # a missing extra is reported
    importlib.import_module("huggingface_hub.utils").disable_progress_bars()
