"""The user's own code on its way to other machines, which do not have its files."""

from __future__ import annotations

import pickle
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle
import gymnasium as gym

from skillweave.algorithms.config import add_registration, own_registrations
from skillweave.messages import told
from skillweave.types import SkillweaveError


def packed(thing: Any, who: str) -> bytes:
    """Anything with the code that it needs: recipes, scripts, and what they registered.

    What is installed is only named, so it must be installed where this is unpacked.

    Args:
        who: what messages call it.

    Raises:
        SkillweaveError: something in it belongs to this process, such as an open file.
    """
    with _own_code():
        try:
            found: bytes = cloudpickle.dumps((_registered(), own_registrations(), thing))
        except Exception as error:
            raise SkillweaveError(
                f"{who} cannot be sent to another process: {told(error)}. Make what cannot be sent "
                "where it is used: in the function that makes the environment, or in a method"
            ) from error
    return found


def unpacked(data: bytes) -> Any:
    """The inverse of ``packed``."""
    registered, algorithms, thing = pickle.loads(data)
    for spec in registered:
        gym.registry.setdefault(spec.id, spec)
    for algorithm in algorithms:
        add_registration(algorithm)
    return thing


def _registered() -> list[Any]:
    """The environments that Gymnasium would not know by itself."""
    own = "gymnasium."
    return [s for s in gym.registry.values() if not str(s.entry_point).startswith(own)]


@contextmanager
def _own_code() -> Iterator[None]:
    """Pickle modules by their content where they are not installed."""
    known = cloudpickle.list_registry_pickle_by_value()
    found = [m for m in list(sys.modules.values()) if _is_own(m) and m.__name__ not in known]
    for module in found:
        cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        for module in found:
            cloudpickle.unregister_pickle_by_value(module)


_INSTALLED = tuple(
    Path(path).resolve()
    for name in ("stdlib", "platstdlib", "purelib", "platlib")
    if (path := sysconfig.get_path(name))
)


def _is_own(module: ModuleType) -> bool:
    name, file = getattr(module, "__name__", "__main__"), getattr(module, "__file__", None)
    if not isinstance(file, str) or name == "__main__" or sys.modules.get(name) is not module:
        return False
    if name.partition(".")[0] == "skillweave":
        return False
    path = Path(file).resolve()
    return not any(path.is_relative_to(place) for place in _INSTALLED)
