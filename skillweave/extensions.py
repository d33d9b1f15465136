"""Where extensions enter: what the core fetches by name, from its own extensions and from others'.

The core imports no extension. It fetches what it needs by name, when it needs it, from a module
that may not be there. Other packages add names by entry points of the group
``skillweave.extensions``, which have a kind in front: ``command.count = "toy.commands:COUNT"``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import Any

from skillweave._internal.messages import short, suggest
from skillweave._internal.notices import notice
from skillweave.errors import DeclarationError, make_error

GROUP = "skillweave.extensions"
"""The group of entry points by which other packages add names."""
SHIPPED: Mapping[str, Mapping[str, str]] = {
    "function": {
        "begin": "skillweave.data.beginning:begin",
        "explore": "skillweave.planning.explorer:Explorer",
        "plan": "skillweave.planning.planned_run:plan",
        "repair": "skillweave.repair.repairing:repair",
        "repairs": "skillweave.repair.repair_stage:repairs_of",
        "report": "skillweave.html_report.single:write_report",
        "segment": "skillweave.data.segmenting:segment",
    },
    "command": {
        "demo": "skillweave.demo.commands:DEMO",
        "handover": "skillweave.robots.commands:HANDOVER",
        "inputs": "skillweave.robots.commands:INPUTS",
        "plan": "skillweave.planning.commands:PLAN",
        "report": "skillweave.html_report.commands:REPORT",
        "compare": "skillweave.html_report.commands:COMPARE",
        "import-agilerl": "skillweave.compat.commands:IMPORT_AGILERL",
    },
    "reader": {"onnx": "skillweave.skills.onnx_file:from_onnx"},
    "section": {"cuts": "skillweave.data.cuts_section:section"},
    "stage": {"repair": "skillweave.repair.repair_stage:REPAIR"},
}
"""By kind and name: the module, and what it defines.

``function``: what methods of ``Run`` call, or a user by ``fetch``. ``command``: a dataclass without
torch, and "module:function". ``reader``: a function that makes a policy of a file with this suffix.
``section``: of the HTML report. ``stage``: kinds of stages that follow a hierarchy's own, which
other packages do not add, as runs record them.
"""
OPEN = ("function", "command", "reader", "section")
"""The kinds to which other packages add names."""


def fetch(name: str) -> Any:
    """Return a function of an extension, by its name.

    Args:
        name: of the core's own ones ``plan``, ``repair`` and others, which ``Run`` has as methods;
            or of another package: ``fetch("count")(run)``.

    Raises:
        DeclarationError: no extension has this name; a similar one is given.
        MissingExtra: the extension is not installed.
    """
    return fetch_from("function", name)


def fetch_from(kind: str, name: str) -> Any:
    """Return what an extension has under a name of a kind; see ``fetch``."""
    names = names_of(kind)
    if name not in names:
        raise DeclarationError(
            f"no installed extension has the {kind} {short(name)}{suggest(name, names)}"
        )
    return resolve(names[name], name)


def names_of(kind: str) -> dict[str, str]:
    """Return the names of a kind, each with ``module:attribute``: the own ones come first."""
    return dict(SHIPPED[kind]) | _of_others().get(kind, {})


def resolve(place: str, name: str = "") -> Any:
    """Return what ``module:attribute`` is.

    Args:
        place: of the module and of what it defines.
        name: for a message; empty: the module's.

    Raises:
        MissingExtra: the module is of an extension that is not installed.
    """
    module, _, attribute = place.partition(":")
    try:
        return getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        extension = ".".join(str(error.name).split(".")[:2])
        if not extension.startswith("skillweave.") or find_spec(extension) is not None:
            raise  # another package, or a mistake in the extension
        raise make_error(
            "MissingExtra",
            f"{name or module!r} needs {extension}, which is not installed here: install "
            "Skillweave whole, pip install --force-reinstall skillweave",
        ) from error


@cache
def _of_others() -> dict[str, dict[str, str]]:
    """Return the names that other packages add, by kind; a notice says which ones cannot be."""
    found: dict[str, dict[str, str]] = {kind: {} for kind in OPEN}
    for point in entry_points(group=GROUP):
        kind, _, name = point.name.partition(".")
        package = "a package" if point.dist is None else f"the package {point.dist.name!r}"
        if kind not in OPEN or not name:
            notice(
                f"{package} adds the extension {short(point.name)}, whose kind is unknown; it must "
                f"be one of {', '.join(f'{k}.NAME' for k in OPEN)}, so it is left out"
            )
        elif name in SHIPPED[kind] or name in found[kind]:
            notice(f"{package} adds the {kind} {name!r}, which is there already: it is left out")
        else:
            found[kind][name] = point.value
    return found
