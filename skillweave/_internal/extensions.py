"""What the core fetches by name from extensions: one table, and an error where one is missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from skillweave.errors import make_error

FETCHED = {
    "explore": "skillweave.planning.explorer:Explorer",
}
"""By name: the module of the extension, and the function or class in it."""


def fetch(name: str) -> Any:
    """Return what an extension has under a name.

    Raises:
        MissingExtra: the extension is not installed.
    """
    module, _, attribute = FETCHED[name].partition(":")
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
