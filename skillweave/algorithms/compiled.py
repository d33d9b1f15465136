"""Gradient steps compiled into one program: small networks spend most time on calling operations.

As in LeanRL (Meta 2024); the backward pass and Adam are compiled, too.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch

from skillweave.errors import DeclarationError, TrainingError

PROGRAMS = 64
"""The most programs of one gradient step: by size, rows with gaps, and reference policy."""
PAYS_AFTER = 20_000
"""Gradient steps that "auto" takes as they are. They last about as long as it takes to compile one,
so no training takes more than about twice the time that the better way would have taken."""


class Compiled:
    """A function that its first call compiles; its arguments' shapes must not change much.

    Args:
        function: tensor operations, which may differentiate within; nothing else.
        config: settings whose ``compile`` is True or "auto". With "auto" it is compiled after
            ``PAYS_AFTER`` calls, and runs as it is where it cannot be compiled.
        sizes_vary: a size that changes causes one more compilation, for any size there.

    Raises:
        DeclarationError: this torch cannot compile a gradient step.
        TrainingError: in a call: no C++ compiler is installed, or the function cannot be compiled.
    """

    def __init__(
        self, function: Callable[..., Any], config: Any, *, sizes_vary: bool = False
    ) -> None:
        from torch._dynamo import config as dynamo

        self._function = function
        self._sizes_vary = sizes_vary
        self._setting = f"{type(config).__name__}.compile"
        self._auto = config.compile == "auto"
        self._program: Callable[..., Any] | None = None
        self._waits = PAYS_AFTER if self._auto else 0
        """Calls until it is compiled."""
        if hasattr(dynamo, "trace_autograd_ops"):
            return
        if not self._auto:
            raise DeclarationError(
                f"{self._setting}: torch {torch.__version__} cannot compile a gradient step; "
                "install torch 2.13 or newer, or leave it at False"
            )
        self._program = function

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to send to another process, which compiles again."""
        plain = self._program is self._function  # it could not be compiled in this process
        return vars(self) | {"_program": self._function if plain else None}

    def __call__(self, *args: Any) -> Any:
        """Call the function, compiled if possible."""
        from torch._dynamo import config as dynamo, exc

        if self._program is self._function:
            return self._function(*args)
        if self._waits:
            self._waits -= 1
            return self._function(*args)
        if self._program is None:
            # One algorithm's programs do not count against another's limit.
            options: Any = {"fullgraph": True, "isolate_recompiles": True}
            dynamic = None if self._sizes_vary else False
            self._program = torch.compile(self._function, dynamic=dynamic, **options)
        # Without trace_autograd_ops dynamo refuses torch.autograd.grad. Other code is unaffected.
        with dynamo.patch(trace_autograd_ops=True, recompile_limit=PROGRAMS):
            try:
                return self._program(*args)
            except (exc.TorchDynamoException, exc.FailOnRecompileLimitHit) as error:
                reason = str(error).strip().splitlines()[0]
                problem = f"{self._setting}: the gradient step could not be compiled ({reason})"
                if not self._auto:
                    advice = f"{_advice(error)}leave it at False"
                    raise TrainingError(f"{problem}; {advice}") from error
        warnings.warn(f"{problem}. Gradient steps are not compiled", stacklevel=2)
        self._program = self._function
        return self._function(*args)  # nothing is changed yet: compiling comes before the step


def _advice(error: Exception) -> str:
    """Return advice on a failed compilation of gradient steps, or nothing."""
    from torch._dynamo import exc

    if isinstance(error, exc.BackendCompilerFailed):
        return "install a C++ compiler (g++ or clang), or "
    if isinstance(error, exc.Unsupported | exc.UserError):
        return "use an encoder that torch.compile can read, or "
    return ""
