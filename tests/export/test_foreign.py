"""Networks from elsewhere act in an export as they act here, for every kind of action."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from random_networks import NESTED, compare, one_by_one
from skills.mapped_models import ACTION, SPACE, observations, one

import skillweave as sw
from skillweave import from_onnx, from_torch
from skillweave.api.player import Player
from skillweave.errors import PolicyError
from skillweave.export.foreign import as_file
from skillweave.export.runner import Runner
from skillweave.export.write import write_export
from skillweave.policies.actor import Actor
from skillweave.policies.codec import read_folder

pytest.importorskip("onnxscript")
pytest.importorskip("stable_baselines3")
torch.set_num_threads(1)
OBS = gym.spaces.Box(-3, 3, (4,), np.float64)
SPACES: dict[str, tuple[gym.Space[Any], int]] = {  # and how many numbers the network returns
    "Discrete": (gym.spaces.Discrete(3, start=-1), 3),
    "MultiDiscrete": (gym.spaces.MultiDiscrete([[2, 3]]), 5),
    "MultiBinary": (gym.spaces.MultiBinary(2), 2),
    "Box": (gym.spaces.Box(-1, 1, (2, 1), np.float32), 2),
}


def linear(path: Path, outputs: int, opset: int, whole: bool = False) -> Path:
    """An ONNX file: numbers, or the place of the largest of them."""
    import onnx
    from onnx import TensorProto, helper

    rng = np.random.default_rng(outputs)
    weight = onnx.numpy_helper.from_array(rng.normal(size=(4, outputs)).astype(np.float32), "w")
    nodes = [helper.make_node("MatMul", ["x", "w"], ["y"])]
    found = helper.make_tensor_value_info("y", TensorProto.FLOAT, ["n", outputs])
    if whole:
        nodes.append(helper.make_node("ArgMax", ["y"], ["z"], axis=1, keepdims=0))
        found = helper.make_tensor_value_info("z", TensorProto.INT64, ["n"])
    given = helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 4])
    graph = helper.make_graph(nodes, "linear", [given], [found], [weight])
    opsets = [helper.make_opsetid("", opset)]
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=8), path)
    return path


def exported(policy: Any, folder: Path, parts: Any = ()) -> None:
    write_export(folder, policy, "toy")
    compare(policy, folder, one_by_one(policy.observation_space, 30), parts)


@pytest.mark.parametrize("opset", [11, 17])
@pytest.mark.parametrize("kind", [*SPACES, "whole"])
def test_a_file_acts_as_here(kind: str, opset: int, tmp_path: Path) -> None:
    whole = kind == "whole"
    space, outputs = (gym.spaces.Discrete(3), 3) if whole else SPACES[kind]
    file = linear(tmp_path / "net.onnx", outputs, opset, whole)
    parts = {"Discrete": (3,), "MultiDiscrete": (2, 3)}.get(kind, ())
    exported(from_onnx(file).bind(OBS, space, "it"), tmp_path / "out", parts)


class Drawn(np.random.Generator):
    """A random generator whose next draw is set."""

    def __init__(self) -> None:
        super().__init__(np.random.PCG64(0))
        self.next = np.zeros(0)

    def gumbel(self, size: Any) -> Any:  # type: ignore[override]
        assert self.next.shape == size
        return self.next

    logistic = gumbel


@pytest.mark.parametrize("kind", ["Discrete", "MultiBinary"])
def test_logits_of_a_file_are_sampled_with_the_noise_given(kind: str, tmp_path: Path) -> None:
    space, outputs = SPACES[kind]
    policy = from_onnx(linear(tmp_path / "net.onnx", outputs, 17)).bind(OBS, space, "it")
    write_export(tmp_path / "out", policy, "toy")
    noise = Drawn()
    runner = Actor(read_folder(tmp_path / "out")[0], deterministic=False, seed=noise)
    for best in range(outputs):
        noise.next = np.full((1, outputs), -1.0)
        noise.next[0, best] = 1.0
        wanted = best - 1 if kind == "Discrete" else np.eye(outputs, dtype=np.int8)[best]
        assert np.all(runner.act(np.zeros(4)) == wanted)


class Sees(torch.nn.Module):
    """Reads parts of a nested observation."""

    def __init__(self) -> None:
        super().__init__()
        self.head = torch.nn.Linear(3, 5)

    def forward(self, obs: Any) -> torch.Tensor:
        brightness = obs["image"].mean((1, 2, 3))[:, None] / 255.0
        return self.head(torch.cat([brightness, obs["inner"][1]], 1)) * 5.0


@pytest.mark.slow
def test_a_module_acts_as_here(tmp_path: Path) -> None:
    torch.manual_seed(0)
    space = SPACES["MultiDiscrete"][0]
    policy = from_torch(Sees()).bind(NESTED, space, "it")
    exported(policy, tmp_path, (2, 3))


# On a nested observation, and of Stable-Baselines3


class Parts(torch.nn.Module):
    """Reads two parts of the whole observation."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layer = torch.nn.Linear(8, 5)

    def forward(self, obs: Any) -> torch.Tensor:
        return self.layer(torch.cat([obs["gyro"], obs["arm"]["joints"]], dim=1))


def program(folder: Path) -> Any:
    """A program of ``torch.export``."""
    module = torch.nn.Sequential(torch.nn.Linear(3, 5), torch.nn.Tanh())
    torch.export.save(torch.export.export(module, (torch.zeros(1, 3),)), folder / "net.pt2")
    return sw.from_torch(folder / "net.pt2", trust=True, sees="gyro", acts=sw.Acts(scale=1.5))


@pytest.mark.slow
@pytest.mark.parametrize("make", [program, lambda folder: sw.from_torch(Parts())])
def test_a_module_is_exported_as_it_is(make: Any, tmp_path: Path) -> None:
    policy = make(tmp_path).bind(SPACE, ACTION, "it")
    write_export(tmp_path / "out", policy, "robot")
    compare(policy, tmp_path / "out", [one(obs, 0) for obs in observations(1, 40, seed=4)])
    player, loaded = Player(policy), Player(sw.load_policy(tmp_path / "out"))
    for obs in observations(1, 5):
        action = player.act(one(obs, 0))
        np.testing.assert_allclose(loaded.act(one(obs, 0)), action, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "env"),
    [
        ("PPO", "CartPole-v1"),
        ("DQN", "CartPole-v1"),
        ("SAC", "Pendulum-v1"),
        ("TD3", "Pendulum-v1"),
    ],
)
def test_models_of_stable_baselines3_are_exported(kind: str, env: str, tmp_path: Path) -> None:
    import stable_baselines3 as sb3

    less = {} if kind == "PPO" else {"buffer_size": 100}
    model = getattr(sb3, kind)("MlpPolicy", env, seed=0, device="cpu", **less)
    torch.manual_seed(0)
    with torch.no_grad():
        for weight in model.policy.parameters():  # far from zeros, so that actions differ
            weight += torch.randn_like(weight)
    policy = sw.from_sb3(model)
    write_export(tmp_path, policy, env)
    runner, loaded = Runner(tmp_path), Player(sw.load_policy(tmp_path))
    rng, size = np.random.default_rng(0), policy.observation_space.shape
    told = []
    for _ in range(30):
        obs = rng.normal(size=size).astype(np.float32)
        wanted = model.predict(obs, deterministic=True)[0]
        np.testing.assert_allclose(runner.act(obs), wanted, atol=1e-5)
        np.testing.assert_allclose(loaded.act(obs), wanted, atol=1e-5)
        told.append(wanted)
    assert len(np.unique(told)) > 1


def test_what_the_runner_cannot_sample_says_what_to_do() -> None:
    import stable_baselines3 as sb3

    policy = sw.from_sb3(sb3.PPO("MlpPolicy", "CartPole-v1", device="cpu"))
    with pytest.raises(PolicyError, match=r"policy of 'x' samples by .*greedy_skills=True"):
        as_file(policy.in_place, "the policy of 'x'", sampled=True)
