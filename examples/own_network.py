"""A network of your own: a module that turns observations into features.

``Network(encoder=...)`` takes a function or a class that makes a ``torch.nn.Module`` for an
observation space, as a features extractor of Stable-Baselines3. Hidden layers and a head follow it,
in the actor as in the critic. This one reads a short history of a cart's positions as a signal.
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
from torch import Tensor, nn

import skillweave as sw

FRAMES = 6


class History(gym.ObservationWrapper):
    """Shows where cart and pole were lately, and no speed: (2, FRAMES)."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.observation_space = gym.spaces.Box(-10.0, 10.0, (2, FRAMES))
        self._seen: list[Any] = []

    def reset(self, **how: Any) -> Any:
        self._seen = []
        return super().reset(**how)

    def observation(self, observation: Any) -> Any:
        self._seen = [*self._seen, observation[[0, 2]]][-FRAMES:]
        missing = FRAMES - len(self._seen)
        return np.stack([self._seen[0]] * missing + self._seen, axis=1)


class Signal(nn.Module):
    """Convolutions along time: (B, 2, FRAMES) to features (B, width)."""

    def __init__(self, observation_space: gym.spaces.Box, width: int = 32) -> None:
        super().__init__()
        channels, frames = observation_space.shape
        self.layers = nn.Sequential(
            nn.Conv1d(channels, 16, kernel_size=3),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(16 * (frames - 2), width),
            nn.ReLU(),
        )

    def forward(self, obs: Tensor) -> Tensor:
        features: Tensor = self.layers(obs)
        return features


def make_env() -> gym.Env:
    """Make the cart without its speeds."""
    return History(gym.make("CartPole-v1"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--out", default="runs/own-network")
    args = parser.parse_args()
    network = sw.Network(hidden=(32,), activation="relu", encoder=Signal)
    config = sw.PPO(num_envs=16, n_steps=128, network=network)
    run = sw.train_agent(make_env, config, args.steps, args.out, quiet=True)
    print(f"mean return: {np.mean(run.evaluate(20).returns):.0f} of 500")
