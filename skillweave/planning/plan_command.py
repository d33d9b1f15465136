"""``skillweave plan``: plan a mission on a run's recorded calls."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from skillweave._internal.terminal import say
from skillweave.cli.output import Result
from skillweave.cli.targets import lacking_words, load_target, load_with_code
from skillweave.errors import DeclarationError
from skillweave.planning.commands import PlanCommand
from skillweave.planning.mission import as_task
from skillweave.planning.planned_run import mission_words


def plan(command: PlanCommand) -> Result:
    """Carry out ``skillweave plan``: plan a mission on a run's recorded calls."""
    path = Path(command.target)
    if path.is_dir() and not command.pretrained:
        run = load_with_code(path, command.recipe)
    else:
        run = load_target(command)
    # Errors come before the recording.
    as_task(command.mission, mission_words(run.hierarchy, {}))
    if words := lacking_words(run):
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
