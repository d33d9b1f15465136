"""Commands that train: a recipe, its flat agent, and the end of a stopped run."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from skillweave._internal.messages import shown_path
from skillweave._internal.terminal import put_result
from skillweave.api import Hierarchy, Run
from skillweave.api.loading import declared_by
from skillweave.api.recipe_file import hierarchy_in
from skillweave.cli import commands
from skillweave.cli.output import Result, run_words, save_score
from skillweave.cli.overrides import apply_overrides, parse_evolve
from skillweave.errors import DeclarationError, RunError
from skillweave.evolution.config import Evolution
from skillweave.runs.directory import RunDirectory
from skillweave.schema import Count, as_json, fitted
from skillweave.workers.cluster import Ray


def train(command: commands.TrainCommand) -> Result:
    """Train a recipe, and perhaps the flat baseline after it."""
    fitted(Count, command.evaluate, "evaluate")
    if command.versus_flat and command.flat:
        raise DeclarationError("--flat trains the baseline alone: leave out --versus-flat")
    if command.versus_flat and not command.evaluate:
        raise DeclarationError("--versus-flat compares scores: let --evaluate be at least 1")
    flat_out = command.out and command.out.with_name(f"{command.out.name}-flat")
    if (
        command.versus_flat
        and flat_out
        and flat_out.exists()
        and not (command.resume or command.overwrite)
    ):
        raise RunError(f"{flat_out} is there already: the flat agent would be written there")
    if (command.resume or command.overwrite) and command.out is None:
        raise DeclarationError("--resume and --overwrite need a run: name its directory, --out DIR")
    hierarchy = hierarchy_in(command.recipe, Hierarchy)
    apply_overrides(hierarchy, command.set)
    hierarchy.scale(command.scale)
    if command.collectors is not None:
        hierarchy.env = replace(hierarchy.spec, workers=command.collectors)
    evolve = parse_evolve(command.evolve, hierarchy, command.flat)
    trained = _trained(command, hierarchy, command.flat, command.out, evolve)
    result, lines = _summary(command, trained, command.render)
    if command.versus_flat:
        if not command.json:  # now: the flat agent takes as long again
            put_result("\n".join(lines))
        flat = _trained(command, hierarchy, True, flat_out, baseline=True)
        result["flat"], more = _summary(command, flat)
        verdict = _verdict(result["evaluation"], result["flat"]["evaluation"])
        lines = ["", "the flat agent:", *more, "", *verdict]
    return result, "\n".join(lines)


def resume(command: commands.ResumeCommand) -> Result:
    """Finish a run that was stopped."""
    run = RunDirectory.open(command.run)
    declared = declared_by(run, command.recipe, to_train=True)
    cluster = None if command.ray is None else Ray(address=command.ray or None)
    with _interruptible(command.ray):
        trained = declared.resume(command.run, quiet=command.quiet, cluster=cluster)
    result, lines = _summary(command, trained)
    return result, "\n".join(lines)


def _trained(
    command: commands.TrainCommand,
    hierarchy: Hierarchy,
    flat: bool,
    out: Path | None,
    evolve: dict[str, Evolution | None] | None = None,
    baseline: bool = False,
) -> Run:
    """Train a command's hierarchy or its flat agent; a ``baseline`` starts with fresh weights."""
    with _interruptible(command.ray):
        cluster = None if command.ray is None else Ray(command.collectors, command.ray or None)
        return hierarchy.train(
            out,
            resume=command.resume,
            overwrite=command.overwrite,
            seed=command.seed,
            quiet=command.quiet,
            flat=flat,
            track=command.track,
            evolve=evolve,
            cluster=cluster,
            start_from=None if baseline else _start_from(command.start_from),
            keep=command.keep,
            log_info=command.log_info or None,
        )


def _start_from(words: Sequence[str]) -> str | dict[str, str] | None:
    """Return the run that ``--start-from`` means, or several by name.

    Raises:
        DeclarationError: there are several, and one of them has no name, or a name has two.
    """
    if not words:
        return None
    if len(words) == 1 and ("=" not in words[0] or os.path.exists(words[0])):
        return words[0]
    run_of: dict[str, str] = {}
    for word in words:
        name, sign, run = word.partition("=")
        if not sign or not name or not run:
            raise DeclarationError(
                f"--start-from {word}: with several runs, name the learner of each: "
                "--start-from left=RUN --start-from right=RUN"
            )
        if name in run_of:
            raise DeclarationError(f"--start-from names {name} twice; give it one run")
        run_of[name] = run
    return run_of


def _verdict(hierarchy: dict[str, Any], flat: dict[str, Any]) -> list[str]:
    """Return in words for the terminal which evaluation is better, and what that means."""
    # Episodes that are all alike have no interval: they are one.
    (low, high), (flat_low, flat_high) = (
        score["ci95"] or (score["mean"], score["mean"]) for score in (hierarchy, flat)
    )
    both = f"hierarchy {hierarchy['mean']:.1f}, flat agent {flat['mean']:.1f} with as many steps"
    if low > flat_high:
        return [f"{both}: the hierarchy is better."]
    if flat_low > high:
        verdict = "the flat agent is better, as often where the reward alone leads to the goal."
    else:
        verdict = "there is no clear difference."
    return [
        f"{both}: {verdict}",
        "Skills pay where one agent cannot, and where many tasks need the same skills. Try next:",
        "  skillweave train lander-missions",
    ]


def _summary(
    command: commands.TrainCommand | commands.ResumeCommand, trained: Run, render: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Return the results that a training command prints, for programs and for people."""
    run = RunDirectory.open(trained.path)
    stages = run.manifest.stages
    result: dict[str, Any] = {"run": str(shown_path(trained.path)), "stages": as_json(stages)}
    seconds, steps = sum(s.seconds or 0.0 for s in stages), sum(s.steps or 0 for s in stages)
    lines = [
        f"trained {steps:,} steps in {seconds:.1f} s ({steps / max(seconds, 1e-9):,.0f} steps/s)"
    ]
    if command.evaluate:
        score = trained.evaluate(command.evaluate, quiet=command.quiet)
        result["evaluation"] = score.to_json()
        save_score(trained, score)
        lines.append(f"score   {score.for_people()}")
    if render:
        film = trained.render(trained.path / f"{run.manifest.kind}.gif", quiet=command.quiet)
        result["film"] = film
        lines.append(f"film    {film['path']}")
    lines += run_words(run)
    return result, lines


@contextmanager
def _interruptible(ray: str | None) -> Iterator[None]:
    """Train within the block; an interrupt names the command that continues, with ``--ray``."""
    try:
        yield
    except KeyboardInterrupt as error:
        more = "" if ray is None else f" --ray {ray}".rstrip()
        words = f"{error}{more}" if str(error) else "nothing was trained yet"
        raise KeyboardInterrupt(words) from None
