"""What the core fetches by name from extensions: one table, and an error where one is missing."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from skillweave.errors import make_error

FETCHED = {
    "explore": "skillweave.planning.explorer:Explorer",
    "plan": "skillweave.planning.planned_run:plan",
    "repair": "skillweave.repair.repairing:repair",
    "repairs": "skillweave.repair.repair_stage:repairs_of",
    "report": "skillweave.html_report.single:write_report",
}
"""What methods fetch, by name: the module of the extension, and the function or class in it."""
COMMANDS = {
    "demo": "skillweave.demo.commands:DEMO",
    "plan": "skillweave.planning.commands:PLAN",
    "report": "skillweave.html_report.commands:REPORT",
    "compare": "skillweave.html_report.commands:COMPARE",
    "import-agilerl": "skillweave.compat.commands:IMPORT_AGILERL",
}
"""Commands, by name: their dataclass, and the function that carries them out."""
STAGES = {"repair": "skillweave.repair.repair_stage:REPAIR"}
"""Kinds of stages that follow a hierarchy's own, by name."""


def fetch(name: str) -> Any:
    """Return what a method fetches from an extension; see ``fetch_from``."""
    return fetch_from(FETCHED, name)


def fetch_from(table: Mapping[str, str], name: str) -> Any:
    """Return what an extension has under a name of a table.

    Raises:
        MissingExtra: the extension is not installed.
    """
    module, _, attribute = table[name].partition(":")
    try:
        return getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # something that the extension needs
        extension = ".".join(module.split(".")[:2])
        raise make_error(
            "MissingExtra",
            f"{name!r} is of {extension}, which is not installed here: install Skillweave whole, "
            "pip install --force-reinstall skillweave",
        ) from error
