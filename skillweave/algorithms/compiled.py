"""Gradient steps compiled into one program: a small network's time is mostly calls of operations.

LeanRL (Meta 2024) showed what this brings; here the backward pass and Adam are compiled along.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from skillweave.types import SkillweaveError


def compiled(
    function: Callable[..., Any],
    config: Any,
    *,
    sizes_vary: bool = False,
) -> Callable[..., Any]:
    """``function``, compiled by its first call; its arguments' shapes must not change much.

    Args:
        function: tensor operations, which may differentiate within; nothing else.
        config: whose ``compile`` asks for it: True; or "auto", then it is left as it is where it
            cannot be compiled.
        sizes_vary: where a size changes it is compiled once more, for any size there.

    Raises:
        SkillweaveError: this torch cannot, or (by the first call) finds no C++ compiler.
    """
    from torch._dynamo import config as dynamo
    from torch._dynamo import exc

    setting, auto = f"{type(config).__name__}.compile", config.compile == "auto"
    if not hasattr(dynamo, "trace_autograd_ops"):
        if auto:
            return function
        raise SkillweaveError(
            f"{setting}: torch {torch.__version__} cannot compile a gradient step; install "
            "torch 2.13 or newer, or leave it at False"
        )
    # One algorithm's programs do not count against another's limit.
    how: Any = {
        "fullgraph": True,
        "dynamic": None if sizes_vary else False,
        "isolate_recompiles": True,
    }
    program = torch.compile(function, **how)

    def call(*args: Any) -> Any:
        nonlocal program
        # Without this it refuses torch.autograd.grad; it changes nothing for others.
        with dynamo.patch(trace_autograd_ops=True):
            try:
                return program(*args)
            except exc.BackendCompilerFailed as error:
                if not auto:
                    reason = str(error).splitlines()[0]
                    raise SkillweaveError(
                        f"{setting}: the gradient step could not be compiled ({reason}); install "
                        "a C++ compiler (g++ or clang), or leave it at False"
                    ) from error
        program = function  # nothing has been changed yet: compiling comes before the first step
        return program(*args)

    return call
