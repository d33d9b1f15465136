"""``skillweave report`` and ``skillweave compare``."""

from __future__ import annotations

from typing import Any

from skillweave.api.loading import load_from
from skillweave.cli.output import Result
from skillweave.cli.targets import shipped_recipe
from skillweave.errors import SkillweaveError
from skillweave.html_report.commands import CompareCommand, ReportCommand
from skillweave.html_report.compare import write_comparison
from skillweave.html_report.single import write_report
from skillweave.runs.directory import RunDirectory
from skillweave.runs.several import open_runs


def report(command: ReportCommand) -> Result:
    """Carry out ``skillweave report``: the HTML report of a run."""
    run = RunDirectory.open(command.run)
    why_not = None
    trained = None
    if run.finished:
        try:
            trained = load_from(command.run, recipe=command.recipe or shipped_recipe(run))
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


def compare(command: CompareCommand) -> Result:
    """Carry out ``skillweave compare``: one HTML file about several runs."""
    return _about(write_comparison(open_runs(command.runs), command.out))


def _about(page: dict[str, Any]) -> Result:
    """Return the result of a command that has written an HTML page."""
    lines = [page["verdict"].replace("`", "")] if "verdict" in page else []
    lines += [f"{page['path']}: {page['bytes'] / 1e6:.1f} MB, written in {page['seconds']:.1f} s"]
    lines += [f"missing: {line}" for line in page["missing"]]
    return page, "\n".join(lines)
