"""AgileRL 0.1's module paths and names on Skillweave; docs/from-agilerl.md has the differences."""

import functools
import os
import sys
import warnings
from typing import Any

import gymnasium as gym

from skillweave._internal.terminal import say
from skillweave.runs.trackers import wandb_mode

_messages: list[str] = []
"""Messages that have not been printed yet."""


def stay_offline() -> None:
    """Set wandb to offline for AgileRL's scripts, if the user has no login.

    A line on stderr reports it, once, when wandb is imported.
    """
    if "WANDB_MODE" not in os.environ and wandb_mode() == "offline":
        os.environ["WANDB_MODE"] = "offline"
        _messages.append("no login to Weights & Biases, so its runs stay offline")
    if "wandb" in sys.modules and _messages:
        say(f"skillweave: {_messages.pop()}")


def _make(name: str, **kwargs: Any) -> gym.Env[Any, Any]:
    _warn()
    return gym.make(f"{name}-v3", **kwargs).unwrapped


@functools.cache
def _warn() -> None:
    warnings.warn("LunarLander-v2 means -v3: Gymnasium has dropped the former", stacklevel=4)


stay_offline()
# Gymnasium's own warning, at each make, is less exact than ours.
warnings.filterwarnings("ignore", ".*LunarLander.*-v2 is out of date", DeprecationWarning)
for _name in ("LunarLander", "LunarLanderContinuous"):
    if f"{_name}-v2" not in gym.registry and f"{_name}-v3" in gym.registry:
        _limit = gym.spec(f"{_name}-v3").max_episode_steps
        gym.register(f"{_name}-v2", functools.partial(_make, _name), max_episode_steps=_limit)
