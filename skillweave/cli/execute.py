"""Carries out each command of the command line."""

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from skillweave import recipes
from skillweave.api import Run
from skillweave.cli import commands
from skillweave.cli.evolve import parse_evolve
from skillweave.cli.overrides import apply_overrides, list_settings
from skillweave.cli.run_lines import run_lines
from skillweave.cli.sweep import sweep
from skillweave.cli.targets import declared_by_run, target
from skillweave.collecting.cluster import Ray
from skillweave.compat.agilerl_files import convert
from skillweave.reporting.plots import plot_run
from skillweave.reporting.report.compare import write_comparison
from skillweave.reporting.report.single import write_report
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_tensors
from skillweave.training.evaluation import Evaluation
from skillweave.training.evaluation_file import load_evaluation, save_evaluation
from skillweave.types import SkillweaveError


def run(command: commands.Command) -> int:
    """Carry a command out and print its result."""
    return HANDLERS[type(command)](command) or 0


def _train(command: commands.Train) -> None:
    if command.evaluate < 0:
        raise SkillweaveError(f"evaluate is {command.evaluate}; it must be at least 0")
    hierarchy = recipes.load(command.recipe)
    apply_overrides(hierarchy, command.set)
    hierarchy.scale(command.scale)
    cluster = None if command.ray is None else Ray(command.collectors, command.ray or None)
    if command.collectors is not None:
        hierarchy.env = replace(hierarchy.spec, workers=command.collectors)
    evolve = parse_evolve(command.evolve, hierarchy, command.flat)
    name = Path(command.recipe).stem + ("-flat" if command.flat else "")
    path = command.out or _free(Path("runs") / f"{name}-s{command.seed}")
    try:
        trained = hierarchy.train(
            path,
            seed=command.seed,
            flat=command.flat,
            quiet=command.quiet,
            track=command.track,
            evolve=evolve,
            cluster=cluster,
        )
    except KeyboardInterrupt:
        raise _interrupted(path, command.ray) from None
    _tell_trained(command, trained, command.evaluate, command.render)


def _resume(command: commands.Resume) -> None:
    declared = declared_by_run(command.run, command.recipe, "resume_needs_recipe")
    cluster = None if command.ray is None else Ray(address=command.ray or None)
    try:
        trained = declared.resume(command.run, quiet=command.quiet, cluster=cluster)
    except KeyboardInterrupt:
        raise _interrupted(command.run, command.ray) from None
    _tell_trained(command, trained, command.evaluate)


def _sweep(command: commands.Sweep) -> int:
    result, text = sweep(command)
    _tell(command, result, text)
    return 1 if result["failed"] else 0


def _evaluate(command: commands.Evaluate) -> None:
    found = target(command)
    score = found.evaluate(
        command.episodes,
        seed=command.seed,
        deterministic=command.deterministic,
        skill=command.skill,
    )
    result = {"target": command.target, "env": found.declaration.spec.name, "seed": command.seed}
    result |= {"deterministic": command.deterministic, "skill": command.skill}
    if command.skill is None and Path(command.target).is_dir() and not command.pretrained:
        _save(found, score, command.seed, command.deterministic)
    _tell(command, result | score.to_json(), score.for_people())


def _render(command: commands.Render) -> None:
    found = target(command)
    path = command.out or Path(f"{Path(command.target).name.removesuffix('.safetensors')}.gif")
    result = found.render(
        path,
        episodes=command.episodes,
        seed=command.seed,
        deterministic=command.deterministic,
        skill=command.skill,
    )
    returns = ", ".join(f"{e['return']:.0f}" for e in result["episodes"])
    _tell(command, result, f"{result['path']}: {result['frames']} frames, return {returns}")


def _plot(command: commands.Plot) -> None:
    paths = [str(path) for path in plot_run(RunDirectory.open(command.run), command.out)]
    _tell(command, {"paths": paths}, "\n".join(paths))


def _report(command: commands.Report) -> None:
    run, why_not, trained = RunDirectory.open(command.run), None, None
    told = run.manifest.get("recipe")
    # Code of our own is as good as told: with it, the skills' rewards and successes are known.
    recipe = command.recipe or (told if told in recipes.names() else None)
    if run.finished:
        try:
            trained = declared_by_run(command.run, recipe).load(command.run)
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
    )
    _tell_page(command, page)


def _compare(command: commands.Compare) -> None:
    runs = [RunDirectory.open(path) for path in command.runs]
    _tell_page(command, write_comparison(runs, command.out))


def _tell_page(command: commands.Output, told: dict[str, Any]) -> None:
    lines = [f"{told['path']}: {told['bytes'] / 1e6:.1f} MB, written in {told['seconds']:.1f} s"]
    lines += [f"missing: {line}" for line in told["missing"]]
    _tell(command, told, "\n".join(lines))


def _list(command: commands.List) -> None:
    shipped = []
    for name in recipes.names():
        weights = (recipes.source(name).with_suffix(".safetensors")).exists()
        doc = ast.get_docstring(ast.parse(recipes.source(name).read_text())) or ""
        shipped.append({"name": name, "about": doc.splitlines()[0], "pretrained": weights})
    runs = [_run_line(p.parent) for p in sorted(Path("runs").glob("*/run.json"))]
    lines = ["recipes:"]
    for r in shipped:
        lines.append(f"  {r['name']:<22} {r['about']}{' [weights]' if r['pretrained'] else ''}")
    if runs:
        lines.append("runs:")
        lines += [f"  {r['path']:<30} {r['kind']} on {r['env']}: {r['status']}" for r in runs]
    _tell(command, {"recipes": shipped, "runs": runs}, "\n".join(lines))


def _info(command: commands.Info) -> None:
    if not (Path(command.target) / "run.json").exists() and not Path(command.target).is_dir():
        settings = list_settings(recipes.load(command.target))
        text = "\n".join(f"{k}={v}" for k, v in settings.items())
        _tell(command, {"recipe": command.target, "settings": _plain(settings)}, text)
        return
    found = RunDirectory.open(command.target)
    m = found.manifest
    saved = load_evaluation(found)
    told = {} if saved is None else {"evaluation": saved.to_json()}
    _tell(command, m | told, "\n".join(run_lines(m, saved, command.target)))


def _weights(command: commands.Weights) -> None:
    trained = declared_by_run(command.run, command.recipe).load(command.run)
    path = trained.save_weights(command.out)
    _tell(command, {"path": str(path), "bytes": path.stat().st_size}, f"wrote {path}")


def _export(command: commands.Export) -> None:
    if not command.onnx:
        raise SkillweaveError("say as what to export: --onnx")
    name = Path(command.target).name.removesuffix(".safetensors")
    found = target(command).export(command.out or Path(f"{name}-onnx"))
    told = {"path": str(found.path), "files": list(found.files), "code": found.code}
    _tell(command, told, str(found))


def _import_agilerl(command: commands.ImportAgilerl) -> None:
    if not command.trust:
        raise SkillweaveError(
            f"{command.file} would be read as a pickle, and pickles can run code. This one is read "
            "by an unpickler that admits only tensors, numbers and plain containers; if you trust "
            "where it comes from nevertheless, say so: --trust"
        )
    out = command.out or command.file.with_suffix(".safetensors")
    algo = convert(command.file, out)
    text = f"wrote {out}: a {algo} agent, for {algo}.load of skillweave.compat.agilerl"
    _tell(command, {"path": str(out), "algorithm": algo}, text)


def _tell_trained(
    command: commands.Train | commands.Resume, trained: Run, episodes: int, render: bool = False
) -> None:
    manifest = trained.info()
    result: dict[str, Any] = {"run": str(trained.path), "stages": manifest["stages"]}
    seconds = sum(p["seconds"] for p in manifest["stages"])
    steps = sum(p["steps"] for p in manifest["stages"])
    lines = [
        f"trained {steps:,} steps in {seconds:.1f} s ({steps / max(seconds, 1e-9):,.0f} steps/s)"
    ]
    if episodes:
        score = trained.evaluate(episodes)
        result["evaluation"] = score.to_json()
        _save(trained, score)
        lines.append(f"score   {score.for_people()}")
    if render:
        film = trained.render(trained.path / f"{manifest['kind']}.gif")
        result["film"] = film
        lines.append(f"film    {film['path']}")
    lines.append(f"run     {trained.path}  (skillweave info|evaluate|render {trained.path})")
    _tell(command, result, "\n".join(lines))


def _tell(command: commands.Output, data: dict[str, Any], text: str) -> None:
    print(json.dumps(data, default=str) if command.json else text)


def _save(trained: Run, score: Evaluation, seed: int = 0, deterministic: bool = True) -> None:
    """Keep a score in its run for ``info``; one that cannot be written is told all the same."""
    try:
        save_evaluation(RunDirectory.open(trained.path), score, seed, deterministic)
    except SkillweaveError as error:
        print(f"the evaluation is not kept in the run: {error}", file=sys.stderr)


def _interrupted(path: Path, ray: str | None) -> KeyboardInterrupt:
    """The same interrupt, with what is saved and how to go on."""
    if not (path / "run.json").exists():
        return KeyboardInterrupt("nothing was trained yet")
    manifest = RunDirectory.open(path).manifest
    recipe, hint = manifest.get("recipe"), ""
    if manifest.get("resume_needs_recipe", True) and recipe not in recipes.names():
        hint = f" --recipe {recipe or 'FILE.py'}"
    hint += "" if ray is None else f" --ray {ray}".rstrip()
    try:
        at = read_tensors(path / "checkpoint.safetensors")[1]
        saved = f"saved at {at['steps']:,} steps of {at['stage']}"
    except SkillweaveError:
        saved = "saved at the start"
    return KeyboardInterrupt(f"{saved}; go on with: skillweave resume {path}{hint}")


def _run_line(path: Path) -> dict[str, Any]:
    try:
        found = RunDirectory.open(path)
    except SkillweaveError as error:
        return {"path": str(path), "kind": "run", "env": "?", "status": str(error)}
    status = "finished" if found.finished else "unfinished"
    return {"path": str(path), "status": status} | {
        k: found.manifest[k] for k in ("kind", "env", "seed")
    }


def _free(path: Path) -> Path:
    """``path``, or the first of path-2, path-3, … that does not exist."""
    number, candidate = 1, path
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.name}-{number}")
    return candidate


def _plain(settings: dict[str, Any]) -> dict[str, Any]:
    return {k: list(v) if isinstance(v, tuple) else v for k, v in settings.items()}


HANDLERS: dict[type, Callable[[Any], int | None]] = {
    commands.Train: _train,
    commands.Resume: _resume,
    commands.Sweep: _sweep,
    commands.Evaluate: _evaluate,
    commands.Render: _render,
    commands.Plot: _plot,
    commands.Report: _report,
    commands.Compare: _compare,
    commands.List: _list,
    commands.Info: _info,
    commands.Weights: _weights,
    commands.Export: _export,
    commands.ImportAgilerl: _import_agilerl,
}
