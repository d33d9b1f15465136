"""AgileRL 0.1's module paths and names on Skillweave; docs/from-agilerl.md has the differences."""

import functools
import warnings
from typing import Any

import gymnasium as gym

from skillweave.compat.wandb_runs import stay_offline


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
