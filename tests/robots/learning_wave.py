"""A ``Balancer`` whose wave is an ONNX file that falls out of a fast drive, and learns on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from robots.owner import WAVE, driving
from skills.mapped_models import onnx_model

import skillweave as sw
from skillweave.toys.balancer import Balancer

UNITS = 24
"""Hidden units of the file; three of them compute the wave by hand."""
SPREAD = np.float32([0.1, 0.5, 1.0])
"""By what the file divides tilt, gyro and speed."""


def wave_file(path: Path) -> Path:
    """Write the wave as a file with a normalisation, a hidden layer and metadata."""
    rng = np.random.default_rng(0)
    first = rng.normal(0.0, 0.5, (3, UNITS)).astype(np.float32)
    bias = rng.normal(0.0, 0.5, UNITS).astype(np.float32)
    last = np.zeros((UNITS, 2), np.float32)
    first[:, 0], first[:, 1] = WAVE * SPREAD, -WAVE * SPREAD
    bias[:2] = 0.0
    last[:2, 0] = 1.0, -1.0  # relu(x) - relu(-x) = x
    return onnx_model(
        path,
        [
            ("Sub", ["obs", "mean"], ["centred"]),
            ("Div", ["centred", "spread"], ["normal"]),
            ("Gemm", ["normal", "w0", "b0"], ["hidden"], {"transB": 0}),
            ("Relu", ["hidden"], ["active"]),
            ("Gemm", ["active", "w1", "b1"], ["actions"]),
        ],
        {"obs": [1, 3]},
        {"actions": [1, 2]},
        {
            "mean": np.zeros(3, np.float32),
            "spread": SPREAD,
            "w0": first,
            "b0": bias,
            "w1": last,
            "b1": np.float32([0.0, 0.3]),
        },
    )


def upright(obs: Any) -> Any:
    """Whether the robot is upright."""
    return np.abs(obs["tilt"][:, 0]) < 0.5


class Fast(sw.Skill):
    """Drives fast, as its owner made it."""

    max_steps = 60

    def policy(self, obs: Any) -> Any:
        numbers = [obs["tilt"], obs["gyro"], obs["speed"], 0 * obs["speed"] + 1.5]
        return np.clip(driving(np.concatenate(numbers, axis=1)), -1, 1)

    def success(self, step: sw.Step) -> Any:
        return upright(step.next_obs) & ~step.terminated


class Wave(sw.Skill):
    """Holds the arm out, as the file does, and learns on."""

    max_steps = 60
    steps = 2_048
    algorithm = sw.PPO(
        num_envs=16, n_steps=64, learning_rate=3e-3, action_std_init=0.2, ent_coef=0.0, gamma=0.97
    )

    def reward(self, step: sw.Step) -> Any:
        return 1.0 - 4.0 * np.abs(step.next_obs["tilt"][:, 0]) - 10.0 * step.terminated

    def success(self, step: sw.Step) -> Any:
        return upright(step.next_obs) & ~step.terminated


def slippery() -> Balancer:
    """Return the robot on a floor on which the wave stands, but does not stop a fast drive."""
    return Balancer(grip=0.7)


def robot(folder: Path, sees: Any = ("tilt", "gyro", "speed")) -> sw.Hierarchy:
    """Return the robot with both skills; the wave's file is ``wave.onnx`` in a folder."""
    path = folder / "wave.onnx"
    if not path.exists():
        wave_file(path)
    wave = Wave()
    wave.policy = sw.from_onnx(path, sees=sees, acts=sw.Acts(clip=(-1, 1)), learn=True)
    return sw.Hierarchy(
        sw.EnvSpec(slippery, engine="sync", workers=1),
        [Fast(), wave],
        selector=lambda obs: ["wave"] * len(obs),
        learn="apart",
    )
