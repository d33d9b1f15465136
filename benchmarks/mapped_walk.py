"""An exported policy of a robot: its runner, beside NumPy and onnxruntime by hand.

    python -m benchmarks.mapped_walk [--network policy.onnx] [--repeats 30]

The walk is of a robot with 29 joints: its network has 96 inputs (turning, gravity, a command, the
joints' places and speeds, the last action) and 29 outputs. Without ``--network`` its weights are
random. Microseconds of the processor for an action, in turn; both act alike.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import skillweave as sw
from benchmarks.common import median, report
from skillweave.types import Array

JOINTS = 29
HOME = np.linspace(-0.3, 0.3, JOINTS).astype(np.float32)
COMMAND = np.array([0.5, 0.0, 0.0], np.float32)
STEPS = 200


def numbers(n: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, (n,))


class Robot(gym.Env[Any, Any]):
    """The spaces of the robot; it does not move."""

    observation_space = gym.spaces.Dict(
        gyro=numbers(3), gravity=numbers(3), joint_pos=numbers(JOINTS), joint_vel=numbers(JOINTS)
    )
    action_space = numbers(JOINTS)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {}


def random_network(file: Path) -> Path:
    """Write a network of the usual size, with random weights."""
    import torch
    from torch import nn

    torch.manual_seed(0)
    widths = (96, 512, 256, 128, JOINTS)
    layers: list[nn.Module] = []
    for a, b in itertools.pairwise(widths):
        layers += [nn.Linear(a, b), nn.ELU()]
    network = nn.Sequential(*layers[:-1])
    torch.onnx.export(network, (torch.zeros(1, 96),), file, dynamo=False, input_names=["obs"])
    return file


def by_hand(file: Path, seen: list[Any]) -> Callable[[], list[Array]]:
    """Return a function that acts with NumPy and onnxruntime alone."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(file), options)
    name = session.get_inputs()[0].name

    def act() -> list[Array]:
        last = np.zeros(JOINTS, np.float32)
        actions = []
        for obs in seen:
            joints = obs["joint_pos"] - HOME, obs["joint_vel"] * np.float32(0.05)
            x = np.concatenate([obs["gyro"], obs["gravity"], COMMAND, *joints, last])
            last = session.run(None, {name: x[None]})[0][0]
            actions.append(last * np.float32(0.25) + HOME)
        return actions

    return act


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--network", type=Path)
    parser.add_argument("--repeats", type=int, default=30)
    given = parser.parse_args()
    rng = np.random.default_rng(0)
    spaces: Any = Robot.observation_space
    seen = [
        {name: rng.normal(size=space.shape).astype(np.float32) for name, space in spaces.items()}
        for _ in range(STEPS)
    ]
    with tempfile.TemporaryDirectory() as folder:
        file = given.network or random_network(Path(folder) / "walk.onnx")
        walk = sw.from_onnx(
            file,
            sees=(
                "gyro",
                "gravity",
                sw.Goal(),
                sw.Part("joint_pos", offset=HOME),
                sw.Part("joint_vel", scale=0.05),
                sw.LastAction(),
            ),
            goal=COMMAND,
            acts=sw.Acts(scale=0.25, offset=HOME),
        )
        sw.save_policy(walk, Path(folder) / "walk", Robot)
        from skillweave.export.runner import Runner

        runner = Runner(Path(folder) / "walk")

        def run() -> list[Array]:
            runner.reset()
            return [runner.act(obs) for obs in seen]

        acts: dict[str, Any] = {"by_hand": by_hand(file, seen), "runner": run}
        np.testing.assert_allclose(acts["runner"](), acts["by_hand"](), atol=1e-4)
        took: dict[str, list[float]] = {name: [] for name in acts}
        for _ in range(given.repeats):
            for name, act in acts.items():
                began = time.process_time()
                act()
                took[name].append(1e6 * (time.process_time() - began) / STEPS)
    micros = {name: median(times) for name, times in took.items()}
    ratio = micros["runner"] / micros["by_hand"]
    report("mapped_walk", {"microseconds": micros, "ratio": ratio})


if __name__ == "__main__":
    main()
