"""A walker of four joints, and a policy whose file has the mean and deviation of its training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import skillweave as sw

HOME = np.array([0.4, -0.8, 0.5, -0.9])
ORDER = ("gyro", "gravity", "joints", "speeds")
SIZES = {"gyro": 3, "gravity": 3, "joints": 4, "speeds": 4}


class Walker(gym.Env[Any, Any]):
    """Joints that follow targets; the body sways as the legs do, and falls when it sways far."""

    observation_space = gym.spaces.Dict(
        {name: gym.spaces.Box(-np.inf, np.inf, (n,), np.float32) for name, n in SIZES.items()}
    )
    action_space = gym.spaces.Box(-3, 3, (4,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.joints = HOME + self.np_random.uniform(-0.1, 0.1, 4)
        self.speeds = self.np_random.uniform(-0.1, 0.1, 4)
        self.gyro = self.np_random.uniform(-0.1, 0.1, 3)
        tilt = self.np_random.uniform(-0.05, 0.05, 2)
        self.gravity = np.array([*tilt, -1.0]) / np.linalg.norm([*tilt, -1.0])
        return self._obs(), {}

    def _obs(self) -> dict[str, Any]:
        return {name: np.asarray(getattr(self, name), np.float32) for name in SIZES}

    def step(self, action: Any) -> Any:
        dt = 0.02
        pull = 120.0 * (np.float64(action) - self.joints) - 14.0 * self.speeds
        self.speeds = self.speeds + dt * pull
        self.joints = self.joints + dt * self.speeds
        legs = self.joints - HOME
        sway = 6.0 * np.array([legs[0] - legs[2], legs[1] - legs[3], 0.5 * legs.sum()])
        # A body that gravity holds upright, as a pendulum hangs.
        upright = 8.0 * np.cross(self.gravity, [0.0, 0.0, -1.0])
        self.gyro = self.gyro + dt * (sway - upright - 3.0 * self.gyro)
        self.gravity = self.gravity + dt * np.cross(self.gravity, self.gyro)
        self.gravity = self.gravity / np.linalg.norm(self.gravity)
        fell = bool(self.gravity[2] > -0.7)
        return self._obs(), 1.0, fell, False, {}


def weights() -> Any:
    """(14, 4): each leg swings against its neighbour, and the body's sway is answered."""
    found = np.zeros((14, 4))
    for k in range(4):
        found[6 + k, k] = 0.9
        found[10 + k, k] = 0.11
        found[6 + (k + 1) % 4, k] = -0.35
    found[0, 0] = found[1, 1] = -0.05
    found[3, 2] = found[4, 3] = 0.2
    return found


def policy_of(x: Any) -> Any:
    """What the network does with inputs (n, 14): targets beside the pose."""
    return np.clip(x @ weights(), -0.6, 0.6)


def right() -> dict[str, Any]:
    return {"gyro": "gyro", "gravity": "gravity", "joints": sw.Part("joints", offset=HOME),
            "speeds": "speeds"}  # fmt: skip


def trained_on() -> tuple[Any, Any]:
    """The mean and deviation of what the policy sees where it explores."""
    rng = np.random.default_rng(0)
    env, rows = Walker(), []
    for episode in range(20):
        obs, _ = env.reset(seed=10_000 + episode)
        for _ in range(100):
            x = np.concatenate([obs[k] - (HOME if k == "joints" else 0) for k in ORDER])
            rows.append(x)
            action = HOME + policy_of(x[None])[0] + rng.normal(0, 0.15, 4)
            obs, _, fell, _, _ = env.step(action.clip(-3, 3))
            if fell:
                break
    return np.mean(rows, axis=0), np.std(rows, axis=0) + 1e-2


def write(
    path: Path, divides: bool = True, carries: bool = True, also: tuple[Any, Any] | None = None
) -> None:
    """Write the policy as an ONNX file, with Sub and Div, or Sub and Mul, in front.

    Args:
        also: the mean and deviation of further inputs, which do nothing.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    mean, deviation = trained_on()
    matrix = weights()
    if also is not None:
        mean, deviation = (
            np.concatenate(pair) for pair in zip((mean, deviation), also, strict=True)
        )
        matrix = np.concatenate([matrix, np.zeros((len(also[0]), 4))])
    scaled = matrix * deviation[:, None] if carries else matrix
    constants = {
        "mean": mean[None], "by": deviation[None] if divides else 1 / deviation[None],
        "w": scaled, "b": mean @ matrix if carries else np.zeros(4),
        "low": np.array(-0.6), "high": np.array(0.6),
    }  # fmt: skip
    nodes = [
        helper.make_node("Sub", ["obs", "mean"], ["centred"]),
        helper.make_node("Div" if divides else "Mul", ["centred", "by"], ["z"]),
        helper.make_node("Gemm", ["z" if carries else "obs", "w", "b"], ["y"]),
        helper.make_node("Clip", ["y", "low", "high"], ["actions"]),
    ]
    graph = helper.make_graph(
        nodes if carries else nodes[2:],
        "walk",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["n", len(mean)])],
        [helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["n", 4])],
        [numpy_helper.from_array(np.float32(x), name) for name, x in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(path))
