"""Carry out each command of the command line: apart from parsing, as it imports torch."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from skillweave import recipes
from skillweave.api.hub import pull_run, push_run
from skillweave.cli import commands
from skillweave.cli.demo import demo
from skillweave.cli.overrides import list_settings
from skillweave.cli.sweep import sweep
from skillweave.cli.targets import free, load_run, target
from skillweave.cli.telling import run_words, save_score, tell
from skillweave.cli.training import resume, train
from skillweave.collecting.lengths import calls_from_json
from skillweave.compat.agilerl_files import convert
from skillweave.errors import DeclarationError, RunError, SkillweaveError
from skillweave.reporting.curves_figure import plot_curves
from skillweave.reporting.plots import plot_run
from skillweave.reporting.report.compare import write_comparison
from skillweave.reporting.report.single import write_report
from skillweave.runs.directory import RunDirectory
from skillweave.runs.hub import check_name, hub
from skillweave.runs.kept import best_words, kept_words
from skillweave.runs.several import open_runs
from skillweave.terminal import one_line
from skillweave.training.evaluation_file import SavedEvaluation, load_evaluation


def run(command: commands.Command) -> int:
    """Carry a command out and print its result."""
    match command:
        case commands.Demo():
            demo(command)
        case commands.Train():
            train(command)
        case commands.Resume():
            resume(command)
        case commands.Sweep():
            return _sweep(command)
        case commands.Evaluate():
            _evaluate(command)
        case commands.Render():
            _render(command)
        case commands.Plot():
            _plot(command)
        case commands.Report():
            _report(command)
        case commands.Compare():
            _compare(command)
        case commands.List():
            _list(command)
        case commands.Info():
            _info(command)
        case commands.Weights():
            _weights(command)
        case commands.Export():
            _export(command)
        case commands.Push():
            tell(command, *_push(command))
        case commands.Pull():
            tell(command, *_pull(command))
        case commands.ImportAgilerl():
            _import_agilerl(command)
    return 0


def _sweep(command: commands.Sweep) -> int:
    result, text = sweep(command)
    tell(command, result, text)
    return 1 if result["failed"] else 0


def _evaluate(command: commands.Evaluate) -> None:
    trained = target(command)
    score = trained.evaluate(
        command.episodes,
        seed=command.seed,
        deterministic=command.deterministic,
        skill=command.skill,
        num_envs=command.num_envs,
        quiet=command.quiet,
    )
    result = {"target": command.target, "env": trained.declaration.spec.name, "seed": command.seed}
    result |= {"deterministic": command.deterministic, "skill": command.skill}
    if command.skill is None and Path(command.target).is_dir() and not command.pretrained:
        save_score(trained, score, command.seed, command.deterministic)
    tell(command, result | score.to_json(), score.for_people())


def _render(command: commands.Render) -> None:
    trained = target(command)
    path = command.out or Path(f"{Path(command.target).name.removesuffix('.safetensors')}.gif")
    result = trained.render(
        path,
        episodes=command.episodes,
        seed=command.seed,
        deterministic=command.deterministic,
        skill=command.skill,
        quiet=command.quiet,
    )
    returns = ", ".join(f"{e['return']:.0f}" for e in result["episodes"])
    tell(command, result, f"{result['path']}: {result['frames']} frames, return {returns}")


def _plot(command: commands.Plot) -> None:
    runs = open_runs(command.runs)
    of_several = (command.metric, command.agent, *command.label)
    if len(runs) == 1 and all(word is None for word in of_several) and command.band == "iqr":
        paths = [str(path) for path in plot_run(runs[0], command.out)]
        tell(command, {"paths": paths}, "\n".join(paths))
        return
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
    tell(command, result, "\n".join([*map(str, figure.paths), figure.caption]))


def _report(command: commands.Report) -> None:
    run = RunDirectory.open(command.run)
    why_not = None
    trained = None
    named = run.manifest.get("recipe")
    # A shipped recipe's code is trusted: with it, the skills' rewards and successes are known.
    recipe = command.recipe or (named if named in recipes.names() else None)
    if run.finished:
        try:
            trained = load_run(command.run, recipe)
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
    _report_page(command, page)


def _compare(command: commands.Compare) -> None:
    _report_page(command, write_comparison(open_runs(command.runs), command.out))


def _report_page(command: commands.Output, page: dict[str, Any]) -> None:
    lines = [page["verdict"].replace("`", "")] if "verdict" in page else []
    lines += [f"{page['path']}: {page['bytes'] / 1e6:.1f} MB, written in {page['seconds']:.1f} s"]
    lines += [f"missing: {line}" for line in page["missing"]]
    tell(command, page, "\n".join(lines))


def _list(command: commands.List) -> None:
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
    tell(command, {"recipes": shipped, "runs": runs}, "\n".join(lines))


def _info(command: commands.Info) -> None:
    if not (Path(command.target) / "run.json").exists() and not Path(command.target).is_dir():
        settings = list_settings(recipes.load(command.target))
        text = "\n".join(f"{k}={v}" for k, v in settings.items())
        tell(command, {"recipe": command.target, "settings": _plain(settings)}, text)
        return
    run = RunDirectory.open(command.target)
    m = run.manifest
    saved = load_evaluation(run)
    sampled = load_evaluation(run, deterministic=False)
    scores = {} if saved is None else {"evaluation": saved.to_json()}
    scores |= {} if sampled is None else {"evaluation_sampled": sampled.to_json()}
    tell(command, m | scores, "\n".join(run_lines(m, [saved, sampled], command.target)))


def _weights(command: commands.Weights) -> None:
    trained = load_run(command.run, command.recipe)
    path = trained.save_weights(command.out)
    tell(command, {"path": str(path), "bytes": path.stat().st_size}, f"wrote {path}")


def _export(command: commands.Export) -> None:
    if not command.onnx:
        raise DeclarationError("choose an export format: --onnx")
    name = Path(command.target).name.removesuffix(".safetensors")
    export = target(command).export(command.out or Path(f"{name}-onnx"))
    result = {"path": str(export.path), "files": list(export.files), "code": export.code}
    tell(command, result, str(export))


def _import_agilerl(command: commands.ImportAgilerl) -> None:
    if not command.trust:
        raise DeclarationError(
            f"{command.file} would be read as a pickle, and pickles can run code. This one is read "
            "by an unpickler that admits only tensors, numbers and plain containers; if you trust "
            "where it comes from nevertheless, say so: --trust"
        )
    out = command.out or command.file.with_suffix(".safetensors")
    algo = convert(command.file, out)
    text = f"wrote {out}: a {algo} agent, for {algo}.load of skillweave.compat.agilerl"
    tell(command, {"path": str(out), "algorithm": algo}, text)


def _run_line(path: Path) -> dict[str, Any]:
    try:
        run = RunDirectory.open(path)
    except RunError as error:
        return {"path": str(path), "kind": "run", "env": "?", "status": str(error)}
    status = "finished" if run.finished else "unfinished"
    return {"path": str(path), "status": status} | {
        k: run.manifest[k] for k in ("kind", "env", "seed")
    }


def _plain(settings: dict[str, Any]) -> dict[str, Any]:
    return {k: list(v) if isinstance(v, tuple) else v for k, v in settings.items()}


def run_lines(
    m: Mapping[str, Any], saved: Sequence[SavedEvaluation | None], target: object
) -> list[str]:
    """Return a run's manifest and its saved evaluations, as lines."""
    env, created = one_line(m["env"]), one_line(m["created"])
    lines = [f"{m['kind']} on {env}, seed {m['seed']}, made {created}"]
    calls = f", call_steps {calls_from_json(m)}" if m["kind"] == "hierarchy" else ""
    calls += f", ready selector: {m['selector']['kind']}" if "selector" in m else ""
    calls += f", guide: {m['guide']['kind']}" if "guide" in m else ""
    lines += [f"  recipe: {one_line(m.get('recipe') or '(declared in Python)')}{calls}"]
    lines += [
        f"  {'stage':<14} {'status':<9} {'steps':>10} {'seconds':>8} {'steps/s':>8} {'return':>8}"
    ]
    for p in m["stages"]:
        final = p.get("final", {}).get("return")
        lines.append(
            f"  {p['name']:<14} {p['status']:<9} {p.get('steps', 0):>10,} "
            f"{p.get('seconds', 0):>8.1f} {p.get('steps_per_second', 0):>8,.0f} "
            f"{'' if final is None else f'{final:.1f}':>8}"
        )
        for name, start in p.get("starts", {}).items():
            run = "" if start["run"] is None else f" {start['run']}"
            lines.append(f"    {name} starts from run{run}, after {start['steps']:,} steps there")
        if continued := p.get("continued"):
            lines.append(f"    continued after {', '.join(f'{k:,}' for k in continued)} steps")
        if reached := p.get("reached"):
            lines.append(
                f"    target reached after {reached['steps']:,} of {p['budget']:,} steps: "
                f"{p['target']['of']} {reached['value']:g}"
            )
        if stopped := p.get("stopped"):
            lines.append(
                f"    a callback ended it after {stopped['steps']:,} of {p['budget']:,} steps"
            )
        if best := p.get("best"):
            lines.append(f"    {best_words(best)}")
        if winner := p.get("winner"):
            lines.append(
                f"    winner: member {winner['member']} of generation {winner['generation'] + 1}, "
                f"fitness {winner['fitness']:.1f} (skillweave plot {target})"
            )
        if kept := p.get("kept"):
            lines.append(f"    {kept_words(kept)}")
    lines += ["  " + ", ".join(one_line(f"{k} {v}") for k, v in m["versions"].items())]
    for score in saved:
        if score is not None:
            how = "greedy" if score.deterministic else "sampled"
            lines.append(f"  evaluated {one_line(score.made)}, seed {score.seed}, {how}:")
            lines += [f"    {line}" for line in score.evaluation.for_people().splitlines()]
    return lines


def _push(command: commands.Push) -> tuple[dict[str, Any], str]:
    """Put a run on the hub; return the result as JSON and for people."""
    _no_bars()
    pushed = push_run(command.run, command.name, command.private)
    lines = [f"{pushed['url']}: {len(pushed['files'])} files", *pushed["missing"]]
    lines.append(f"load it: skillweave.from_hub({command.name!r})")
    return pushed, "\n".join(lines)


def _pull(command: commands.Pull) -> tuple[dict[str, Any], str]:
    """Copy a run from the hub; return its new place as JSON and for people."""
    _no_bars()
    name = PurePosixPath(check_name(command.name)).name
    path = pull_run(command.name, command.out or free(Path("runs") / name), command.revision)
    return {"path": str(path)}, "\n".join(run_words(RunDirectory.open(path)))


def _no_bars() -> None:
    """Keep the hub's library from drawing a bar for each file."""
    hub()  # a missing extra is reported
    importlib.import_module("huggingface_hub.utils").disable_progress_bars()
