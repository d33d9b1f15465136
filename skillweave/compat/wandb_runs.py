"""Weights & Biases for training loops that do not write a run directory."""

from __future__ import annotations

import os
import sys
from typing import Any

from skillweave._internal.terminal import say
from skillweave.errors import needs_extra
from skillweave.runs.trackers import wandb_mode

_messages: list[str] = []
"""What has not been printed yet."""


def start_wandb(project: str, name: str, config: dict[str, Any], key: str | None = None) -> Any:
    """Start a Weights & Biases run for a user's training loop; offline without login or key.

    Raises:
        MissingExtra: wandb is not installed.
    """
    with needs_extra("tracking with wandb", "wandb"):
        import wandb
    stay_offline()
    if key is not None:
        wandb.login(key=key)
    mode: Any = None if key is None else "online"
    return wandb.init(project=project, name=name, config=config, mode=mode)


def stay_offline() -> None:
    """Set wandb to offline if the user has no login, so that it does not request one.

    A line on stderr reports it, once, when wandb is imported.
    """
    if "WANDB_MODE" not in os.environ and wandb_mode() == "offline":
        os.environ["WANDB_MODE"] = "offline"
        _messages.append("no login to Weights & Biases, so its runs stay offline")
    if "wandb" in sys.modules and _messages:
        say(f"skillweave: {_messages.pop()}")
