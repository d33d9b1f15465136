"""Carry out each command of the command line."""

from __future__ import annotations

import ast
import importlib
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, fields
from pathlib import Path, PurePosixPath
from typing import Any

from skillweave import recipes
from skillweave._internal.messages import as_path
from skillweave._internal.notices import notice
from skillweave._internal.terminal import one_line, say
from skillweave.api import Agent, Hierarchy, Run, info_json
from skillweave.api.loading import declared_in, load_from
from skillweave.api.planning import lacking_features, mission_words
from skillweave.api.push_pull import pull_run, push_run
from skillweave.api.recipe_file import is_env_id
from skillweave.calls import Handover
from skillweave.calls.run_log import handover_json, handover_of
from skillweave.cli import commands
from skillweave.cli.demo import demo
from skillweave.cli.output import Result, run_words, save_score
from skillweave.cli.overrides import list_settings
from skillweave.cli.sweep import sweep
from skillweave.cli.training_commands import resume, train
from skillweave.errors import DeclarationError, RunError, SkillweaveError
from skillweave.hierarchy.recorded import calls_of
from skillweave.hierarchy.weights import HierarchyHeader, open_weights
from skillweave.planning import Explorer, as_task
from skillweave.reporting.curves_figure import plot_curves
from skillweave.reporting.plots import plot_run
from skillweave.reporting.report.compare import write_comparison
from skillweave.reporting.report.single import write_report
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
    return WAYS[type(command)](command)


def _evaluate(command: commands.EvaluateCommand) -> Result:
    """Carry out ``skillweave evaluate``."""
    trained = _load_target(command)
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


def _render(command: commands.RenderCommand) -> Result:
    """Carry out ``skillweave render``."""
    trained = _load_target(command)
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


def _log(command: commands.LogCommand) -> Result:
    """Carry out ``skillweave log``: record calls of a run's skills."""
    run = _load_with_code(command.run, command.recipe)
    if words := lacking_features(run.hierarchy, run.policy):
        notice(words)
    if not command.quiet:
        say(f"recording {command.steps:,} steps")
    log = run.log_calls(
        command.steps,
        choose=Explorer() if command.choose == "explore" else "random",
        seed=command.seed,
        info=command.info,
    )
    calls = run.calls
    matrix = calls.handover()
    result = {"run": str(command.run), "recorded": {"calls": len(log), "steps": log.steps}}
    result |= {"calls": len(calls), "steps": calls.steps} | handover_json(matrix)
    text = f"recorded {len(log):,} calls, {log.steps:,} steps; the run has {calls.steps:,} steps"
    return result, "\n".join([text, *_handover_lines(matrix)])


def _plan(command: commands.PlanCommand) -> Result:
    """Carry out ``skillweave plan``: plan a mission on a run's recorded calls."""
    path = Path(command.target)
    if path.is_dir() and not command.pretrained:
        run = _load_with_code(path, command.recipe)
    else:
        run = _load_target(command)
    # Errors come before the recording.
    as_task(command.mission, mission_words(run.hierarchy, {}))
    if words := lacking_features(run.hierarchy, run.policy):
        raise DeclarationError(words)
    if not run.has_calls:
        if not command.quiet:
            say(f"there is no log of calls: recording {command.steps:,} steps")
        run.log_calls(command.steps)
    planned = run.plan(command.mission)
    forecast = planned.explain()
    score = planned.evaluate(command.episodes, seed=command.seed, quiet=command.quiet)
    result = {"target": command.target, "mission": command.mission, "seed": command.seed}
    result |= {"plan": asdict(forecast)} | score.to_json()
    text = f"plan: {forecast}\n{score.for_people()}"
    if command.film is not None:
        film = planned.render(command.film, seed=command.seed, quiet=command.quiet)
        result["film"] = film["path"]
        text += f"\n{film['path']}: {film['frames']} frames"
    return result, text


def _plot(command: commands.PlotCommand) -> Result:
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


def _report(command: commands.ReportCommand) -> Result:
    """Carry out ``skillweave report``: the HTML report of a run."""
    run = RunDirectory.open(command.run)
    why_not = None
    trained = None
    if run.finished:
        try:
            trained = load_from(command.run, recipe=command.recipe or _shipped(run))
        except SkillweaveError as error:
            if command.recipe is not None:
                raise
            why_not = f"There are no episodes and no film: {error}."
    page = write_report(
        run,
        command.out or command.run / "report.html",
        None if trained is None else trained.policy,
        None if trained is None else trained.declaration.spec,
        why_not=why_not,
        episodes=command.episodes,
        filmed=command.films,
        seed=command.seed,
        deterministic=command.deterministic,
        quiet=command.quiet,
    )
    return _about(page)


def _compare(command: commands.CompareCommand) -> Result:
    return _about(write_comparison(open_runs(command.runs), command.out))


def _about(page: dict[str, Any]) -> Result:
    """Return the result of a command that has written an HTML page."""
    lines = [page["verdict"].replace("`", "")] if "verdict" in page else []
    lines += [f"{page['path']}: {page['bytes'] / 1e6:.1f} MB, written in {page['seconds']:.1f} s"]
    lines += [f"missing: {line}" for line in page["missing"]]
    return page, "\n".join(lines)


def _list(command: commands.ListCommand) -> Result:
    """Carry out ``skillweave list``: the shipped recipes, and the runs here."""
    shipped = []
    for name in recipes.names():
        weights = (recipes.source(name).with_suffix(".safetensors")).exists()
        doc = ast.get_docstring(ast.parse(recipes.source(name).read_text("utf-8"))) or ""
        shipped.append({"name": name, "about": doc.splitlines()[0], "pretrained": weights})
    runs = [_run_line(p.parent) for p in sorted(Path("runs").glob("*/run.json"))]
    lines = ["recipes:"]
    for r in shipped:
        lines.append(f"  {r['name']:<22} {r['about']}{' [weights]' if r['pretrained'] else ''}")
    if runs:
        lines.append("runs:")
        printable = [{k: one_line(v) for k, v in r.items()} for r in runs]
        lines += [f"  {r['path']:<30} {r['kind']} on {r['env']}: {r['status']}" for r in printable]
    return {"recipes": shipped, "runs": runs}, "\n".join(lines)


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


def _info(command: commands.InfoCommand) -> Result:
    """Carry out ``skillweave info``: a recipe's settings, or a run's content."""
    if not (Path(command.target) / "run.json").exists() and not Path(command.target).is_dir():
        settings = list_settings(recipes.load(command.target))
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


def _weights(command: commands.WeightsCommand) -> Result:
    trained = load_from(command.run, recipe=command.recipe)
    path = trained.save_weights(command.out)
    return {"path": str(path), "bytes": path.stat().st_size}, f"wrote {path}"


def _export(command: commands.ExportCommand) -> Result:
    """Carry out ``skillweave export``."""
    if not command.onnx:
        raise DeclarationError("choose an export format: --onnx")
    name = Path(command.target).name.removesuffix(".safetensors")
    export = _load_target(command).export(command.out or Path(f"{name}-onnx"))
    result = {"path": str(export.path), "files": list(export.files), "code": export.code}
    return result, str(export)


def _push(command: commands.PushCommand) -> Result:
    """Carry out ``skillweave push``: upload a run to the hub."""
    _no_bars()
    pushed = push_run(command.run, command.name, command.private, command.calls)
    lines = [f"{pushed['url']}: {len(pushed['files'])} files", *pushed["missing"]]
    lines.append(f"load it: skillweave.from_hub({command.name!r})")
    return pushed, "\n".join(lines)


def _pull(command: commands.PullCommand) -> Result:
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


def _import_agilerl(command: commands.ImportAgilerlCommand) -> Result:
    """Carry out ``skillweave import-agilerl``: convert a checkpoint of AgileRL."""
    if not command.trust:
        raise DeclarationError(
            f"{command.file} would be read as a pickle, and pickles can run code. This one is read "
            "by an unpickler that admits only tensors, numbers and plain containers; if you trust "
            "where it comes from nevertheless, say so: --trust"
        )
    # Here: AgileRL's names come with its ids of environments, and its way with wandb.
    from skillweave.compat.agilerl_files import convert

    out = command.out or command.file.with_suffix(".safetensors")
    algo = convert(command.file, out)
    text = f"wrote {out}: a {algo} agent, for {algo}.load of skillweave.compat.agilerl"
    return {"path": str(out), "algorithm": algo}, text


# Policies that commands name


def _load_target(command: commands.Watched | commands.ExportCommand | commands.PlanCommand) -> Run:
    """Return the trained policy that a command names.

    Raises:
        RunError: no such run or weights file, or the policy needs code that was not given.
    """
    path = Path(command.target)
    if command.pretrained:
        return Hierarchy.pretrained(command.target)
    if path.is_dir():
        return load_from(path, recipe=command.recipe)
    if path.suffix == ".safetensors":
        header = open_weights(path)[1]
        named = None
        if isinstance(header, HierarchyHeader):
            named = header.recipe
        elif header.env is not None:
            return Agent.from_weights(path)
        return declared_in(command.recipe or named, command.recipe, str(path)).load_weights(path)
    hint = ""
    if command.target in recipes.names():
        hint = " (add --pretrained for its shipped weights)"
    elif is_env_id(command.target):
        hint = ", but an environment: train a hierarchy on it first (skillweave train FILE.py)"
    raise RunError(f"{command.target} is neither a run nor a weights file{hint}")


def _load_with_code(path: Path, recipe: str | None) -> Run:
    """Load the finished run at ``path`` with the code of its shipped recipe, or of ``recipe``.

    Without it, what it means that a call succeeded is unknown, which a notice says.
    """
    run = load_from(path, recipe=recipe or _shipped(RunDirectory.open(path)))
    if isinstance(run.declaration, Hierarchy) and run.declaration.recorded:
        say(
            "the run is loaded without the code of its skills, so their success() is not known; "
            "give it: --recipe FILE.py"
        )
    return run


def _shipped(run: RunDirectory) -> str | None:
    """Return a run's recipe for a command if it is shipped, so that its code is trusted.

    With it, the skills' rewards and successes are known.
    """
    named = run.manifest.recipe
    return named if named in recipes.names() else None


WAYS: dict[type, Callable[[Any], Result]] = {
    commands.DemoCommand: demo,
    commands.TrainCommand: train,
    commands.ResumeCommand: resume,
    commands.SweepCommand: sweep,
    commands.EvaluateCommand: _evaluate,
    commands.RenderCommand: _render,
    commands.LogCommand: _log,
    commands.PlanCommand: _plan,
    commands.PlotCommand: _plot,
    commands.ReportCommand: _report,
    commands.CompareCommand: _compare,
    commands.ListCommand: _list,
    commands.InfoCommand: _info,
    commands.WeightsCommand: _weights,
    commands.ExportCommand: _export,
    commands.PushCommand: _push,
    commands.PullCommand: _pull,
    commands.ImportAgilerlCommand: _import_agilerl,
}
"""By command, the function that carries it out."""
