"""The user's own code on its way to processes and machines that do not have its files."""

from __future__ import annotations

import pickle
import site
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle
import gymnasium as gym

from skillweave._internal.messages import error_text
from skillweave.algorithms.config import add_registration, own_registrations
from skillweave.errors import DeclarationError

_FOLDERS: list[str] = []
"""Folders of recipes, whose files these may import."""


def add_folder(folder: Path) -> None:
    """Let a recipe's ``folder`` be imported from: here, and in workers it is sent to.

    A folder that was added first keeps its place before later ones.
    """
    name = str(folder.resolve())
    if name in _FOLDERS:
        return
    sys.path.insert(sum(known in sys.path for known in _FOLDERS), name)
    _FOLDERS.append(name)


def packed(thing: Any, who: str) -> bytes:
    """Pickle a thing with the user's code that it needs: recipes, scripts, and registrations.

    What is installed is only named, so it must be installed where this is unpacked.

    Args:
        who: its name in messages.

    Raises:
        DeclarationError: something in it belongs to this process, such as an open file.
    """
    with _own_code():
        try:
            known = dict(gym.registry), own_registrations(), tuple(_FOLDERS)
            found: bytes = cloudpickle.dumps((*known, thing))
        except Exception as error:
            raise DeclarationError(
                f"{who} cannot be sent to another process: {error_text(error)}. Make what cannot "
                "be sent where it is used: in the function that makes the environment, or in a "
                "method"
            ) from error
    return found


def unpacked(data: bytes) -> Any:
    """Return the object that ``packed`` made bytes of, for a worker or from one."""
    registered, algorithms, folders, thing = pickle.loads(data)
    for folder in folders:
        add_folder(Path(folder))
    gym.registry.update(registered)  # an id that Gymnasium knows may mean another environment
    for algorithm in algorithms:
        add_registration(algorithm)
    return thing


@contextmanager
def _own_code() -> Iterator[None]:
    """Pickle the user's modules by their content for a block, as workers lack their files."""
    known = cloudpickle.list_registry_pickle_by_value()
    # Each once: where a process was spawned, the user's script stands there by two names.
    modules = {id(m): m for m in list(sys.modules.values())}.values()  # not all have a hash
    found = [m for m in modules if is_own_code(m) and m.__name__ not in known]
    for module in found:
        cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        for module in found:
            cloudpickle.unregister_pickle_by_value(module)


_INSTALLED = tuple(
    Path(path).resolve()
    for path in (
        *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
        *site.getsitepackages(),
        site.getusersitepackages(),
    )
    if path
)
_PACKAGES = {"site-packages", "dist-packages"}  # of another environment, or of the system


def is_own_code(module: ModuleType) -> bool:
    """Return whether workers must be sent a module: it is the user's, installed nowhere else."""
    name, file = getattr(module, "__name__", "__main__"), getattr(module, "__file__", None)
    if not isinstance(file, str) or name == "__main__" or sys.modules.get(name) is not module:
        return False
    top = name.partition(".")[0]
    if top == "skillweave":
        return False
    # One that was loaded from its file, as recipes are, is not found by its name elsewhere,
    # wherever it lies.
    return not _is_installed(file) or not _is_found(top, tuple(sys.path))


@cache  # a sweep asks it of thousands of modules for each of its runs
def _is_found(name: str, path: tuple[str, ...]) -> bool:
    """Return whether a module of this name is found in ``path``."""
    return PathFinder.find_spec(name, path) is not None


@cache
def _is_installed(file: str) -> bool:
    """Return whether a file is of an installed package, so workers need not be sent it."""
    path = Path(file).resolve()
    if _PACKAGES & set(path.parts):
        return True
    return any(path.is_relative_to(place) for place in _INSTALLED)
