"""Six policies from elsewhere, each with another mapping, and their sources called by hand.

The environment is a robot with a Dict observation and five numbers as its action.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete
from toys import World

import skillweave as sw
from skillweave.skills.foreign_policy import fitted
from skillweave.types import Array

SPACE = Dict(
    {
        "gyro": Box(-np.inf, np.inf, (3,), np.float32),
        "arm": Dict({"joints": Box(-4, 4, (5,), np.float64), "grip": Discrete(3)}),
        "state": Box(-np.inf, np.inf, (48,), np.float32),
    }
)
ACTION = Box(-2.0, 2.0, (5,), np.float32)
HOME = np.array([0.1, 0.9, -1.8, 0.3, 0.0])


def observations(n: int, steps: int, seed: int = 0) -> list[Array]:
    """Observations (n,) of a few steps, packed."""
    from skillweave.spaces import obs_dtype

    rng = np.random.default_rng(seed)
    found = []
    for _ in range(steps):
        obs = np.zeros(n, obs_dtype(SPACE))
        obs["gyro"], obs["state"] = rng.normal(size=(n, 3)), rng.normal(size=(n, 48))
        obs["arm"]["joints"] = rng.uniform(-2, 2, (n, 5))
        obs["arm"]["grip"] = rng.integers(0, 3, n)
        found.append(obs)
    return found


def fit(policy, space=SPACE, action=ACTION):
    """Return the policy, bound to the robot's spaces or others."""
    return fitted(policy, space, action, "skill 'walk'", "Robot-v0")


def one(obs: Array, i: int) -> dict[str, Any]:
    """An observation as an environment returns it."""
    return {
        "gyro": obs["gyro"][i],
        "state": obs["state"][i],
        "arm": {"joints": obs["arm"]["joints"][i], "grip": obs["arm"]["grip"][i]},
    }


class Source:
    """A policy called by hand, in one environment: ``act(obs)`` of an observation as a dict."""

    def act(self, obs) -> Array:
        raise NotImplementedError


@dataclass
class Case:
    """A policy with its mapping, and its source."""

    policy: Any
    source: Any
    """A function without arguments that makes a new ``Source``."""


def weights(*shape: int) -> Array:
    return (np.random.default_rng(sum(shape)).normal(size=shape) * 0.3).astype(np.float32)


def onnx_model(path: Path, nodes, inputs, outputs, constants: dict[str, Array], **how) -> Path:
    """Write an ONNX file: nodes (operation, inputs, outputs, perhaps attributes), shapes by name.

    Its numbers are real, those of ``ArgMax`` are whole; ``how``: as of ``onnx.save``.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    def values(shapes: dict[str, Any]):
        whole = [node[2][0] for node in nodes if node[0] == "ArgMax"]
        kinds = {k: TensorProto.INT64 if k in whole else TensorProto.FLOAT for k in shapes}
        return [helper.make_tensor_value_info(k, kinds[k], v) for k, v in shapes.items()]

    graph = helper.make_graph(
        [helper.make_node(*node[:3], **dict(*node[3:])) for node in nodes],
        "model",
        values(inputs),
        values(outputs),
        [numpy_helper.from_array(v, k) for k, v in constants.items()],
    )
    opset = helper.make_opsetid("", 17)
    onnx.save(helper.make_model(graph, opset_imports=[opset], ir_version=9), path, **how)
    return path


# ONNX: two inputs, one of them the command; a recurrent state; a part of the action --------------


def onnx_case(folder: Path) -> Case:
    w, u, h, c = weights(11, 3), weights(2, 3), weights(3, 3), weights(4, 4)[:3, :3]
    onnx_model(
        folder / "walk.onnx",
        [
            ("MatMul", ["obs", "w"], ["a"]),
            ("MatMul", ["command", "u"], ["b"]),
            ("MatMul", ["h_in", "h"], ["d"]),
            ("Sum", ["a", "b", "d"], ["s"]),
            ("Tanh", ["s"], ["h_out"]),
            ("MatMul", ["h_out", "c"], ["actions"]),
        ],
        {"obs": ["n", 11], "command": ["n", 2], "h_in": ["n", 3]},
        {"actions": ["n", 3], "h_out": ["n", 3]},
        {"w": w, "u": u, "h": h, "c": c},
    )
    policy = sw.from_onnx(
        folder / "walk.onnx",
        sees={
            "obs": (sw.Part("gyro", scale=0.25), sw.Part("arm.joints", offset=HOME), "arm.grip"),
            "command": sw.Goal(scale=(2.0, 0.5), low=-1.0, high=1.0),
        },
        goal=(1.0, -0.5),
        acts=sw.Acts(to=(4, 0, 2), scale=0.5, offset=(0.1, 0.2, 0.3), clip=(-1, 1), rest=(7, -7)),
        state={"h_in": "h_out"},
    )

    class Walk(Source):
        def __init__(self):
            self.h = np.zeros(3, np.float32)

        def act(self, obs) -> Array:
            joints, grip = obs["arm"]["joints"], np.eye(3)[obs["arm"]["grip"]]
            x = np.concatenate([obs["gyro"] * 0.25, joints - HOME, grip])
            self.h = np.tanh(x @ w + np.array([2.0, -0.25]) @ u + self.h @ h)
            y = np.clip(self.h @ c, -1, 1) * 0.5 + [0.1, 0.2, 0.3]
            return np.array([y[1], 2.0, y[2], -2.0, y[0]])  # the rest, clipped to the bounds

    return Case(policy, Walk)


# TorchScript: slices of one part, the last action, another rate -----------------------------------


class Script(torch.nn.Module):
    """Two inputs' worth of numbers in one."""

    def __init__(self):
        super().__init__()
        self.w = torch.nn.Parameter(torch.from_numpy(weights(50, 5)))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x @ self.w) * 0.3


def script_case(folder: Path) -> Case:
    torch.jit.save(torch.jit.trace(Script(), torch.zeros(1, 50)), folder / "script.pt")
    policy = sw.from_torch(
        folder / "script.pt",
        trust=True,
        sees=(sw.Part("state", slice(3, 48)), sw.LastAction(scale=2.0, clip=(-0.5, 0.5))),
        acts=sw.Acts(scale=1.5),
        every=3,
    )

    class ByHand(Source):
        def __init__(self):
            self.t, self.last = 0, np.zeros(5)

        def act(self, obs) -> Array:
            if self.t % 3 == 0:
                x = np.concatenate([obs["state"][3:], np.clip(2 * self.last, -0.5, 0.5)])
                self.last = (x @ weights(50, 5)) * 0.3
            self.t += 1
            return np.clip(1.5 * self.last, -2, 2)

    return Case(policy, ByHand)


# Stable-Baselines3 with VecNormalize: another order, its own bounds -------------------------------


def sb3_case(folder: Path) -> Case:
    import stable_baselines3 as sb3
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    spaces = Box(-10, 10, (4,), np.float32), Box(-1, 1, (5,), np.float32)
    env = VecNormalize(DummyVecEnv([lambda: World(*spaces)]), clip_obs=1.5)
    model = sb3.PPO("MlpPolicy", env, seed=0, device="cpu", policy_kwargs={"log_std_init": 0})
    env.obs_rms.mean, env.obs_rms.var = np.array([1.0, -2.0, 0.5, 0.1]), np.array([4, 0.1, 1, 2.0])
    model.save(folder / "reach.zip")
    env.save(str(folder / "normal.pkl"))
    policy = sw.from_sb3(
        folder / "reach.zip",
        "ppo",
        trust=True,
        normalize=folder / "normal.pkl",
        sees=(sw.Part("state", (7, 2)), sw.Part("gyro", slice(None, 2), scale=3.0)),
        acts=(1, 0, 2, 4, 3),
    )

    class ByHand(Source):
        def act(self, obs) -> Array:
            x = np.concatenate([obs["state"][[7, 2]], 3.0 * obs["gyro"][:2]])
            return model.predict(env.normalize_obs(x), deterministic=True)[0][[1, 0, 2, 4, 3]]

    return Case(policy, ByHand)


# A recurrent module: its state is a pair with the environments second -----------------------------


class Recurrent(torch.nn.Module):
    """An LSTM with a head."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(3)
        self.lstm, self.head = torch.nn.LSTM(8, 6, num_layers=2), torch.nn.Linear(6, 5)

    def forward(self, x: torch.Tensor, state):
        y, state = self.lstm(x[None], state)
        return self.head(y[0]) * 4.0, state


def recurrent_case(folder: Path) -> Case:
    module = Recurrent()
    policy = sw.from_torch(module, sees=("gyro", "arm.joints"), state=[(2, None, 6), (2, None, 6)])

    class ByHand(Source):
        def __init__(self):
            self.state = torch.zeros(2, 1, 6), torch.zeros(2, 1, 6)

        def act(self, obs) -> Array:
            x = np.concatenate([obs["gyro"], obs["arm"]["joints"]]).astype(np.float32)
            with torch.no_grad():
                y, self.state = module(torch.from_numpy(x)[None], self.state)
            return np.clip(y[0].numpy(), -2, 2)

    return Case(policy, ByHand)


# A function: a goal that follows the observation, and numbers that it computes --------------------


def away(obs: Array) -> Array:
    """The command: against the turning."""
    return -obs["gyro"]


def length(obs: Array) -> Array:
    return np.linalg.norm(obs["state"], axis=1)


def steer(x: Array) -> Array:
    return np.stack([x[:, 0], x[:, 1], x[:, 2], x[:, 3] / 10, x[:, 0] * x[:, 3]], axis=1)


def function_case(folder: Path) -> Case:
    policy = sw.from_function(
        steer, sees=(sw.Goal(scale=0.5, low=-1, high=1), length), goal=away, every=2
    )

    class ByHand(Source):
        def __init__(self):
            self.t = 0

        def act(self, obs) -> Array:
            if self.t % 2 == 0:
                command = np.clip(-obs["gyro"], -1, 1) * 0.5
                x = np.concatenate([command, [np.linalg.norm(obs["state"])]])
                self.action = np.clip(steer(x[None])[0], -2, 2)
            self.t += 1
            return self.action

    return Case(policy, ByHand)


# A chunked module: four actions of each inference, each for two steps -----------------------------


class Chunked(torch.nn.Module):
    """Six actions from one observation."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(5)
        self.layer = torch.nn.Linear(9, 6 * 2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layer(x).reshape(-1, 6, 2)


def chunked_case(folder: Path) -> Case:
    module = Chunked()
    policy = sw.from_torch(
        module,
        sees=(sw.Part("state", slice(0, 48, 8)), "gyro"),
        acts=sw.Acts(to=slice(3, 5), clip=(-0.5, 0.5), scale=2.0, rest=0.25),
        every=2,
        chunk=4,
    )

    class ByHand(Source):
        def __init__(self):
            self.t = 0

        def act(self, obs) -> Array:
            if self.t % 8 == 0:
                x = np.concatenate([obs["state"][::8], obs["gyro"]])
                with torch.no_grad():
                    self.plan = module(torch.from_numpy(x)[None])[0].numpy()
            y = np.clip(self.plan[self.t % 8 // 2], -0.5, 0.5) * 2
            self.t += 1
            return np.array([0.25, 0.25, 0.25, *y])

    return Case(policy, ByHand)


CASES = {
    "onnx": onnx_case,
    "function": function_case,
    "chunked": chunked_case,
    "recurrent": recurrent_case,
    "TorchScript": script_case,
    "sb3": sb3_case,
}
