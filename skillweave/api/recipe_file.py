"""Read a recipe's Python file, with the files beside it that it imports, and its hierarchy."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib.machinery import PathFinder
from importlib.util import resolve_name
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import gymnasium as gym

from skillweave._internal.messages import as_path, error_text, suggest
from skillweave._internal.shipped import FOLDER, file_of, names
from skillweave._internal.tracebacks import place
from skillweave.api.running import READING
from skillweave.errors import DeclarationError, SkillweaveError, reworded
from skillweave.hierarchy.declaration import Declaration
from skillweave.runs.command_words import python_string
from skillweave.workers.shipping import add_folder

H = TypeVar("H", bound=Declaration)

ENV_ID = re.compile(r"([\w:.-]+/)?[\w:.-]+-v\d+")
"""The form of an environment's id in Gymnasium."""


def hierarchy_in(recipe: str, kind: type[H]) -> H:
    """Return the hierarchy of a shipped recipe, or of a Python file that defines one.

    Args:
        recipe: a shipped recipe's name, or the path of a file.
        kind: ``Hierarchy``.

    Raises:
        DeclarationError: no such recipe (with a similar one) or file, no hierarchy in it, the file
            trains as soon as it is read, or it raises an error.
    """
    path = as_path(file_of(recipe), "recipe")
    if path.suffix == ".py" and path.is_file():
        module = read_recipe_file(path, recipe, shipped=path.parent == FOLDER)
    else:
        raise DeclarationError(_no_recipe(recipe))
    declared = {k: v for k, v in vars(module).items() if isinstance(v, kind)}
    if "hierarchy" not in declared and len(declared) != 1:
        raise DeclarationError(
            f"{recipe} defines {len(declared) or 'no'} Hierarchy; define one, as the variable "
            "'hierarchy'"
        )
    hierarchy: Any = declared.get("hierarchy") or next(iter(declared.values()))
    hierarchy.recipe = recipe
    declaration: H = hierarchy
    return declaration


def _no_recipe(name: str) -> str:
    """Return a sentence on a name that is no recipe and no file."""
    if is_env_id(name):
        return (
            f"{name!r} is an environment, and no recipe: declare skills for it in a Python file of "
            "three lines, 'import skillweave as sw', 'class Move(sw.Skill): max_steps = 20', "
            f"'hierarchy = sw.Hierarchy({python_string(name)}, [Move()], steps=100_000)', and give "
            "that file; or train one agent in Python: "
            f"sw.train_agent({python_string(name)}, sw.PPO(), 100_000)"
        )
    if name.endswith(".py"):
        return f"no file {name!r}, and no recipe of this name{suggest(name, names())}"
    if name.endswith((".yaml", ".yml", ".json", ".toml", ".ini")):
        return (
            f"{name!r} is no recipe: a Python file declares the hierarchy, and --set NAME=VALUE "
            "changes its settings"
        )
    return f"no recipe or Python file {name!r}{suggest(name, names())}"


def is_env_id(name: str) -> bool:
    """Return whether a name is the id of an environment in Gymnasium, or has its form."""
    return name in gym.registry or ENV_ID.fullmatch(name) is not None


def read_recipe_file(path: Path, recipe: str, *, shipped: bool = False) -> ModuleType:
    """Run a recipe's file and return its module; nothing in it may train.

    Args:
        path: the file.
        recipe: the user's name of the file, for messages.
        shipped: it is one of this library's, which imports nothing beside it by its bare name.

    Raises:
        DeclarationError: the file raises an error (the message has its file and line), or imports
            a file beside it whose name another module has.
    """
    if not shipped:
        add_folder(path.parent)
        _check_names(path, recipe)
    spec = importlib.util.spec_from_file_location(_free_name(path), path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    outer = READING.set(recipe)
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[spec.name]
        if isinstance(error, KeyboardInterrupt):
            raise
        text = _sentence(error, recipe)
        if isinstance(error, SkillweaveError):
            raise reworded(error, text) from error
        raise DeclarationError(text) from error
    finally:
        READING.reset(outer)
    return module


def _sentence(error: BaseException, recipe: str) -> str:
    """Return the sentence that reports an error in a recipe's file."""
    if isinstance(error, SystemExit):
        return (
            f"{recipe} ends Python while it is read ({place(error)}). Put what is to run only as a "
            "script inside a block that begins with: if __name__ == '__main__':"
        )
    if not isinstance(error, SkillweaveError):
        return f"{recipe} raised {error_text(error)}"
    if str(error).startswith(recipe):
        return str(error)
    return f"{recipe}: {str(error).removesuffix('.')} ({place(error)})"


def _free_name(path: Path) -> str:
    """Return a module's name for a recipe's file that no other file's module has."""
    name = first = f"skillweave_recipe_{path.stem}"
    number = 1
    while (known := _file_of(sys.modules.get(name))) is not None and known != path.resolve():
        number += 1
        name = f"{first}_{number}"
    return name


def _check_names(path: Path, recipe: str) -> None:
    """Raise a DeclarationError where another module hides a file that a recipe imports.

    Python keeps one module of each name. Without this check, a recipe could get the file of another
    recipe, or a package, in silence.
    """
    for name, beside in _beside(path).items():
        module = sys.modules.get(name)
        if module is None:
            spec = PathFinder.find_spec(name, sys.path)
            known = None if spec is None or spec.origin is None else Path(spec.origin).resolve()
        else:
            known = _file_of(module)
        if known != beside:
            where = "in Python itself" if known is None else str(known)
            raise DeclarationError(
                f"{recipe} imports {name!r}: beside it lies {beside.name}, but Python finds "
                f"another module of this name ({where}). Rename {beside.name}"
            )


def _beside(path: Path) -> dict[str, Path]:
    """Return the files that a recipe imports from its folder, also by one another, by name."""
    folder = path.parent.resolve()
    files: dict[str, Path] = {}
    due = [path]
    while due:
        try:
            found = imported(due.pop().read_bytes())
            names = dict.fromkeys(name.partition(".")[0] for name in found)
        except (SyntaxError, ValueError):
            continue  # importing it raises the same error, with its line
        for name in names:
            for file in (folder / name / "__init__.py", folder / f"{name}.py"):
                if name not in files and name != "skillweave" and file.is_file():
                    files[name] = file.resolve()
                    due.append(file)
    return files


def imported(source: bytes, package: str = "") -> Iterator[str]:
    """Yield the modules that the source of a recipe's file imports, with their packages."""
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


def _file_of(module: ModuleType | None) -> Path | None:
    file = getattr(module, "__file__", None)
    return Path(file).resolve() if isinstance(file, str) else None
