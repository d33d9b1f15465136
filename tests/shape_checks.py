"""Calls of functions whose annotations say shapes are checked while tests run."""

from __future__ import annotations

import functools
import importlib
import inspect
from collections.abc import Callable
from typing import Any

import beartype
import jaxtyping
import torch

from skillweave._internal import shapes


def check_shapes(*modules: str) -> None:
    """Check all calls of the functions of these modules of ``skillweave.ops``.

    Must be called before another module imports functions from them.
    """
    for kind in shapes.__all__:  # annotations are resolved when a function is wrapped
        setattr(shapes, kind, getattr(jaxtyping, kind))
    for name in modules:
        module = importlib.import_module(f"skillweave.ops.{name}")
        for key, value in vars(module).items():
            if inspect.isfunction(value) and value.__module__ == module.__name__:
                setattr(module, key, checked(value))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function``, but a call raises where an array does not fit its annotation.

    Calls with the same shapes and types are checked once: the outcome would be the same.
    """
    wrapped = jaxtyping.jaxtyped(function, typechecker=beartype.beartype)
    passed: set[Any] = set()

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if torch.compiler.is_compiling():  # torch cannot compile the checks
            return function(*args, **kwargs)
        key = (*map(signature, args), *((k, signature(v)) for k, v in kwargs.items()))
        if key in passed:
            return function(*args, **kwargs)
        result = wrapped(*args, **kwargs)
        passed.add(key)
        return result

    return call


def signature(value: Any) -> Any:
    """All that a check of ``value`` depends on."""
    return (value.shape, value.dtype) if isinstance(value, torch.Tensor) else type(value)
