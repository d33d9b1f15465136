"""The checksum of a sweep's code, kept in a file of the sweep's directory.

A run's identity covers settings, not code. Without this file, an edited recipe would continue the
sweep of the recipe as it was, and one table would mix both.
"""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib.util import resolve_name
from pathlib import Path
from types import ModuleType
from typing import TypedDict

from skillweave import recipes
from skillweave.errors import RunError
from skillweave.policies.files import shown
from skillweave.runs.files import read_json, write_json
from skillweave.schema import fit
from skillweave.workers.shipping import is_own_code

MARK = ".sweep"
"""A file in the sweep's directory; a machine that can read it shares the directory."""


class Mark(TypedDict):
    """Content of the file."""

    recipe: str
    """The recipe, as the user named it."""
    code: str
    """A checksum of its code."""


def must_be_same_code(out: Path, recipe: str) -> None:
    """Write the checksum of the recipe's code into a sweep's directory, or compare with it.

    The recipe must be loaded, so that the modules that it imports are known. It may be mended where
    no run has learnt yet, for example where it failed at its first step.

    Raises:
        RunError: the runs there are trained by other code; or the directory cannot be
            written.
    """
    file = out / MARK
    code = _checksum(code_files(recipes.file_of(recipe)))
    learnt = any(out.glob("*/checkpoint*")) or any(out.glob("*/policies/*"))
    if not learnt or not file.exists():
        write_json(file, Mark(recipe=recipe, code=code), make_directories=False)
        return
    mark: Mark = fit(Mark, read_json(file), str(file))
    if mark["code"] != code:
        raise RunError(
            f"{out} holds runs of the recipe {shown(mark['recipe'], 500)}, which were not trained "
            f"by the code of {recipe} as it is now: it is another recipe, or it was edited since, "
            "or a module of yours that it imports was. One table would mix both. Choose another "
            f"directory (--out), or delete {out}. If what was edited cannot change results, as a "
            f"comment cannot, delete {file} alone"
        )


def code_files(recipe: Path) -> dict[str, Path]:
    """Return a recipe's file, and by their names the user's modules that it imports.

    Of a shipped recipe these are its parts.
    """
    files = {"": recipe}
    due = [(recipe, "")]
    while due:
        file, package = due.pop()
        if file.suffix != ".py":  # compiled
            continue
        for name in _imported(file.read_bytes(), package):
            module = sys.modules.get(name)
            if module is None or name in files or not _is_part(module):
                continue
            files[name] = Path(str(module.__file__))
            due.append((files[name], module.__package__ or ""))
    return files


def _checksum(files: Mapping[str, Path]) -> str:
    """Return a checksum of the names of modules and the contents of their files."""
    sums = {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in files.items()}
    return hashlib.sha256(json.dumps(sums, sort_keys=True).encode()).hexdigest()


def _is_part(module: ModuleType) -> bool:
    return is_own_code(module) or module.__name__.startswith("skillweave.recipes._")


def _imported(source: bytes, package: str) -> Iterator[str]:
    """Yield the modules that a file of a package names, and the packages that they are in."""
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            with suppress(ImportError):  # `from . import x` in a file that is in no package
                base = resolve_name(base, package)
                names = [f"{base}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            yield from (".".join(parts[: i + 1]) for i in range(len(parts)))
