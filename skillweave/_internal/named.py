"""Functions of the user that settings hold, and the names by which files record them.

Settings are data: ``run.json`` stores ``module:function`` for a function. The function itself comes
from the declaration. This module does not import torch.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from skillweave._internal.messages import short
from skillweave.errors import DeclarationError

_PLAIN = (bool, int, float, str, type(None))
_RECIPE = "skillweave_recipe_"
_KNOWN: dict[str, Named] = {}


class Named(str):
    """The name of a user's function, together with the function; equal to the plain name."""

    function: Callable[..., Any]

    def __call__(self, *args: Any) -> Any:
        """Call the function."""
        return self.function(*args)

    def __reduce__(self) -> Any:
        """Register the function where it is unpickled, so that files that name it can be read."""
        return _known, (str(self), self.function)

    def __deepcopy__(self, memo: Any) -> Named:
        return self


def named(value: Any, where: str) -> Any:
    """Convert a function to ``Named``, and a text to the known function of this name.

    Args:
        value: a function, a class, or a text; a text without a known function does not change.
        where: the setting, for messages: ``Network.encoder``.

    Raises:
        DeclarationError: the function has no name that identifies it.
    """
    if isinstance(value, Named):
        return value
    if isinstance(value, str):
        return find(value) or value
    return _known(_name_of(value, where), value)


def find(name: str) -> Named | None:
    """Return the known function of the user for the ``name`` in a file; None: none fits.

    The module may have another name now: a recipe is a script, a module or a file to load.
    """
    if name in _KNOWN:
        return _KNOWN[name]
    module, _, function = name.partition(":")
    same = [k for k in _KNOWN.values() if k.partition(":")[2] == function]
    if len(same) > 1:
        last = module.rpartition(".")[2]
        same = [k for k in same if k.partition(":")[0].rpartition(".")[2] == last]
    return same[0] if len(same) == 1 else None


def known_names() -> str:
    """Return the names of all known functions, for a message."""
    return ", ".join(_KNOWN) or "none"


def _known(name: str, function: Callable[..., Any]) -> Named:
    """Register a user's function under its name in files, in place of an earlier one."""
    known = Named(name)
    known.function = function
    _KNOWN[name] = known
    return known


def _name_of(function: Any, where: str) -> str:
    """Return the name by which files record a user's function, with its bound arguments."""
    values: dict[str, Any] = {}
    inner = function
    if isinstance(function, functools.partial):
        if function.args:
            raise DeclarationError(
                f"{where} is a partial with positional arguments; name them: "
                "functools.partial(function, width=64)"
            )
        inner = function.func
        values = dict(function.keywords)
    module = getattr(inner, "__module__", None)
    name = getattr(inner, "__qualname__", None)
    bound = getattr(inner, "__self__", None)
    of_object = bound is not None and not inspect.isclass(bound) and not inspect.ismodule(bound)
    if not callable(inner) or of_object or not isinstance(name, str) or not isinstance(module, str):
        raise DeclarationError(
            f"{where} is {short(function)}; it must be a function or a class, so that a run can "
            "record its name: wrap it in a function (def)"
        )
    if inspect.isfunction(inner):
        values = {**inspect.getclosurevars(inner).nonlocals, **values}
        if "<lambda>" in name:
            name += f"#{_digest(inner)}"
    if any(not isinstance(value, _PLAIN) for value in values.values()):
        odd = next(k for k, v in values.items() if not isinstance(v, _PLAIN))
        raise DeclarationError(
            f"{where}: {name} takes {odd} from outside, which is {short(values[odd])}; a run can "
            "record numbers and texts only: make it in the function, or at the top of the module"
        )
    settings = ", ".join(f"{k}={v!r}" for k, v in sorted(values.items()))
    return f"{_module_of(module)}:{name}" + (f"({settings})" if settings else "")


def _module_of(name: str) -> str:
    """Return a module's name, the same for a script, a recipe and an import of one file."""
    file = getattr(sys.modules.get(name), "__file__", None)
    if name == "__main__" and isinstance(file, str):
        return Path(file).stem
    return name.removeprefix(_RECIPE)


def _digest(function: Any) -> str:
    """Return a checksum of a lambda's code, which distinguishes the lambdas of a module."""
    code = function.__code__
    constants = [repr(c) for c in code.co_consts if not inspect.iscode(c)]
    parts = code.co_code, constants, code.co_names
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:8]


__all__ = ["Named", "find", "known_names", "named"]
