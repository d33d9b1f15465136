"""Episodes of 5,000 steps with default settings: learnt to their ends, resumed bit for bit.

    python -m benchmarks.long_episodes [--steps 700000] [--length 5000]

Only an episode's last step pays, so nothing is learnt where no episode is ever finished.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import torch

from benchmarks.common import report
from skillweave import PPO, Hierarchy, Skill
from skillweave.api import running
from skillweave.reporting.progress import Progress
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_tensors


class Late(gym.Env[Any, Any]):
    """The last step pays 1; the observation is the share of the episode that is over."""

    observation_space = gym.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, length: int) -> None:
        self.length = length

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: int) -> Any:
        self.t += 1
        over = self.t == self.length
        return np.array([self.t / self.length], np.float32), float(over), over, False, {}


class Task(Skill):
    """The environment's own reward."""


class Stop(Exception):
    """Training is to be stopped here."""


class Stopping(Progress):
    """Stops training in the middle."""

    at = 0

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        if steps >= self.at:
            raise Stop


def hierarchy(length: int, steps: int) -> Hierarchy:
    return Hierarchy(lambda: Late(length), [Task()], algorithm=PPO(), steps=steps)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=700_000)
    parser.add_argument("--length", type=int, default=5_000)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        whole, broken = Path(name) / "whole", Path(name) / "broken"
        hierarchy(given.length, given.steps).train(whole, flat=True, quiet=True)
        Stopping.at = int(0.7 * given.steps)
        with patch.object(running, "Progress", Stopping), contextlib.suppress(Stop):
            hierarchy(given.length, given.steps).train(broken, flat=True, quiet=True)
        hierarchy(given.length, given.steps).resume(broken, quiet=True)
        weights = [
            read_tensors(run / "policies" / "agent.safetensors")[0] for run in (whole, broken)
        ]
        lines = [list(RunDirectory.open(run).metrics()) for run in (whole, broken)]
    for line in (*lines[0], *lines[1]):
        line.pop("seconds")
    seen = [line for line in lines[0] if "return" in line]
    report(
        "long-episodes",
        {
            "length": given.length,
            "environments": PPO().num_envs,
            "updates": len(lines[0]),
            "updates_after_an_end": len(seen),
            "return": seen[-1]["return"] if seen else None,
            "weights_equal": all(torch.equal(v, weights[1][k]) for k, v in weights[0].items()),
            "metrics_equal": lines[0] == lines[1],
        },
    )


if __name__ == "__main__":
    main()
