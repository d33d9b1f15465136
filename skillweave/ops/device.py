"""Devices of tensors: the CPU, or an accelerator that works while Python continues.

Generators stay on the CPU, so that a seed gives the same numbers on every device.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Literal

import torch
from torch import Tensor

from skillweave.errors import DeclarationError
from skillweave.schema import fitted

FLOAT: dict[str, Any] = {"dtype": torch.float32, "device": "cpu"}
INT: dict[str, Any] = {"dtype": torch.int64, "device": "cpu"}
BOOL: dict[str, Any] = {"dtype": torch.bool, "device": "cpu"}
"""Types of new tensors: the user may have changed PyTorch's (``torch.set_default_dtype``)."""
DeviceName = Literal["cpu", "cuda", "auto"]
"""Valid device names of settings."""


def resolve_device(name: str) -> torch.device:
    """Return the device of this name; "auto" is a GPU where there is one, else the CPU.

    Raises:
        DeclarationError: the name is unknown, or PyTorch finds no such device.
    """
    fitted(DeviceName, name, "device")
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise DeclarationError(
            f"device is 'cuda', but torch {torch.__version__} finds no CUDA device here; "
            "use 'cpu', or 'auto', which uses a GPU only if one is available"
        )
    return torch.device("cuda" if available and name != "cpu" else "cpu")


class Constant:
    """A tensor that never changes, with a copy on each device that used it."""

    def __init__(self, value: Tensor) -> None:
        self._value = value
        self._copies: dict[torch.device, Tensor] = {}

    def on(self, device: torch.device) -> Tensor:
        """Return the tensor on this device."""
        if device == self._value.device:
            return self._value
        if device not in self._copies:
            self._copies[device] = self._value.to(device)
        return self._copies[device]


def on_host(*numbers: Tensor) -> list[int]:
    """Return whole numbers of tensors (), on which shapes of later tensors depend.

    The host waits for the device here, and nowhere else in an update.
    """
    return [int(n) for n in torch.stack(numbers).tolist()]


def all_false(flags: Tensor) -> bool:
    """Return whether all flags are False; on an accelerator return False, without waiting."""
    return flags.device.type == "cpu" and not bool(flags.any())


@contextmanager
def normal_tensors() -> Iterator[None]:
    """Leave ``torch.inference_mode``, whose tensors cannot learn, and ``torch.autocast``.

    The user may have set these modes around the whole training; they apply to one thread. Out of
    inference mode, gradients are disabled.
    """
    with ExitStack() as stack:
        for device in ("cpu", "cuda"):
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        if torch.is_inference_mode_enabled():
            stack.enter_context(torch.inference_mode(False))
            stack.enter_context(torch.no_grad())
        yield


@contextmanager
def usual_defaults() -> Iterator[None]:
    """Restore PyTorch's initial defaults within the block, for code that relies on them."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        with torch.device("cpu"), torch.inference_mode(False), torch.enable_grad():
            yield
    finally:
        torch.set_default_dtype(before)
