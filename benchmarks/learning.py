"""Issue 3, figures 1 to 6: what each algorithm learns, with settings that are the same for all seeds.

    python -m benchmarks.learning [dqn sac td3 ppo image recurrent] [--seeds 0 1 2 3 4]

Scores are 100 greedy episodes of Gymnasium's environment with seeds that training never saw.
Two seeds are trained side by side (``--processes``), so the seconds are those of a busy machine.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.common import median, report, table
from skillweave import DQN, PPO, RNN, SAC, TD3, EnvSpec, Network, evaluate, train_agent


@dataclass(frozen=True)
class Figure:
    """A claim: an agent on an environment, and what is asked of it."""

    env: EnvSpec
    algorithm: Any
    steps: int
    asked: float
    reference: str
    judge: EnvSpec | None = None  # where it is scored, if not in `env`
    episodes: int = 100


def small(*hidden: int) -> Network:
    return Network(hidden, "relu")


class NoVelocities(gym.ObservationWrapper[Any, Any, Any]):
    """CartPole of which only the positions are seen."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        space: Any = env.observation_space
        self.observation_space = gym.spaces.Box(space.low[::2], space.high[::2])

    def observation(self, observation: Any) -> Any:
        return observation[::2]


def atari(game: str, *, training: bool, render_mode: str | None = None) -> gym.Env[Any, Any]:
    """The usual 84×84 grey frames, four at a time; in training lives end episodes, rewards are ±1."""
    import ale_py
    from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation, TransformReward

    gym.register_envs(ale_py)
    env = gym.make(f"ALE/{game}-v5", frameskip=1, repeat_action_probability=0.0)
    env = AtariPreprocessing(env, terminal_on_life_loss=training)
    env = FrameStackObservation(env, 4)
    return TransformReward(env, np.sign) if training else env


DISCRETE, CONTINUOUS = EnvSpec("LunarLander-v3"), EnvSpec("LunarLanderContinuous-v3")
BLIND = EnvSpec("CartPole-v1", wrappers=(NoVelocities,))
