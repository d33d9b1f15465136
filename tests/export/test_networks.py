"""Exported networks act as the trained ones do, whatever the algorithm and the spaces."""

from __future__ import annotations

import ast
import importlib.util
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from random_networks import NESTED, agent, compare, one_by_one, same
from torch import nn
from toys import ASKS, SHOWS

from skillweave import DQN, PPO, SAC, TD3, Network, SkillweaveError
from skillweave.algorithms import CNN, RNN
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.api.player import Player
from skillweave.export.graphs import agent_graph
from skillweave.export.write import write_export
from skillweave.skills.foreign_policy import made_up

pytest.importorskip("onnxscript")
torch.set_num_threads(1)

SMALL = Network((8,), cnn=CNN.small())
REPLAY: dict[str, Any] = {"buffer_size": 100, "network": SMALL, "normalize_obs": True}
BOX64 = gym.spaces.Box(np.array([-2.0, -np.inf]), np.array([1.0, np.inf]), dtype=np.float64)
FEW = gym.spaces.Box(0, np.arange(96, dtype=np.uint8).reshape(6, 8, 2) % 7, dtype=np.uint8)
PLANES = gym.spaces.Box(np.float32(-1), np.arange(1, 106, dtype=np.float32).reshape(3, 5, 7))


class Watching(nn.Module):
    """Reads an image and what stands beside it."""

    def __init__(self, space: Any) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 2, 3)
        self.layer = nn.Linear(18 + space["inner"][0].shape[0], 6)

    def forward(self, obs: Any) -> torch.Tensor:
        image = self.conv(obs["image"]).relu().flatten(1)
        choice, place = obs["inner"]
        seen = torch.cat([image, choice], -1)
        return torch.cat([self.layer(seen).tanh(), place], -1)


CASES: dict[str, tuple[AlgorithmConfig, gym.Space[Any], gym.Space[Any]]] = {
    "ppo, normalised": (PPO(network=SMALL), SHOWS["vector"], ASKS["Discrete"][0]),
    "ppo, elu, layer norm": (
        PPO(network=Network((8, 8), "elu", layer_norm=True)), SHOWS["discrete"], ASKS["Box"][0]
    ),
    "ppo squashed": (PPO(network=SMALL, squash_actions=True), SHOWS["dict"], ASKS["Box"][0]),
    "ppo, a part without bounds": (PPO(network=SMALL), SHOWS["multi-binary"], BOX64),
    "ppo, lstm": (
        PPO(network=Network((8,), rnn=RNN("lstm", 4))), SHOWS["tuple"], ASKS["MultiDiscrete"][0]
    ),
    "ppo, gru": (
        PPO(network=Network((8,), rnn=RNN("gru", 4))), SHOWS["vector"], ASKS["MultiBinary"][0]
    ),
    "ppo, sees a part": (
        PPO(network=Network((8,), sees=(1,))), SHOWS["vector"], ASKS["Discrete"][0]
    ),
    "ppo, sees keys": (
        PPO(network=Network((8,), sees=("inner.1", 0))), NESTED,
        ASKS["Discrete"][0],
    ),
    "ppo, nested": (PPO(network=SMALL), NESTED, ASKS["Discrete"][0]),
    "ppo, cells": (
        PPO(network=Network((8,), encoder="cells")), SHOWS["image, channels last"],
        ASKS["Discrete"][0],
    ),
    "ppo, cells with few kinds": (
        PPO(network=Network((8,), encoder="cells")), FEW, ASKS["Discrete"][0],
    ),
    "ppo, an encoder of the user's own": (
        PPO(network=Network((8,), encoder=Watching)), NESTED, ASKS["Discrete"][0]
    ),
    "ppo, a board with its planes last": (
        PPO(network=Network((8,), planes="last")), PLANES, ASKS["Discrete"][0]
    ),
    "dqn, impala": (
        DQN(**REPLAY | {"network": Network((8,), cnn=CNN.impala((4,)))}),
        SHOWS["image, channels first"], ASKS["Discrete"][0],
    ),
    "rainbow": (DQN.rainbow(**REPLAY), SHOWS["multi-discrete"], ASKS["Discrete"][0]),
    "td3": (TD3(**REPLAY), SHOWS["vector"], ASKS["Box"][0]),
    "sac": (SAC(**REPLAY), SHOWS["vector"], ASKS["Box"][0]),
    "sac, discrete": (SAC(**REPLAY), SHOWS["multi-discrete"], ASKS["Discrete"][0]),
}  # fmt: skip


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_plain_agent_acts_as_here(case: Any, tmp_path: Path) -> None:
    config, obs_space, action_space = case
    policy = agent(config, obs_space, action_space)
    export = write_export(tmp_path, policy, "toy")
    assert export.code == {}
    written = (tmp_path / "agent.onnx").read_bytes()
    assert b"skillweave" not in written  # no paths of the machine that wrote it
    parts = policy.algorithm.codec.parts
    for action in compare(policy, tmp_path, one_by_one(obs_space, 40), parts):
        assert action_space.contains(action)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", ["ppo, normalised", "rainbow", "td3"])
def test_a_sampling_agent_takes_its_noise_as_an_input(name: str) -> None:
    import onnxruntime

    config, obs_space, action_space = CASES[name]
    policy = agent(config, obs_space, action_space)
    graph = agent_graph(policy, True, "it")
    session = onnxruntime.InferenceSession(graph.file)
    algorithm, rng = policy.algorithm, np.random.default_rng(1)
    drawn = {"gumbel": rng.gumbel, "standard_normal": rng.standard_normal, "random": rng.random}
    actions = []
    for row in made_up(obs_space, 30):
        feeds = {"obs": row[None]}
        if graph.choices:
            feeds["mask"] = np.ones((1, graph.choices), bool)
        noise = [drawn[kind](size=(1, n)).astype(np.float32) for kind, n in graph.noise]
        given = [torch.from_numpy(x) for x in noise]
        found = session.run(None, feeds | {f"noise.{i}": x for i, x in enumerate(noise)})[0]
        own: Any = given[0][None] if len(given) == 1 else (given[0][None], given[1])
        obs = torch.from_numpy(row)[None, None]
        wanted = algorithm.act(policy.params, obs, None, own, None)[0]
        assert same(found, algorithm.to_env(wanted[0].numpy()))
        actions.append(str(found))
    assert len(set(actions)) > 1


def test_what_cannot_be_written_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = agent(*CASES["ppo, normalised"])

    def act(*args: Any) -> Any:
        return torch.from_numpy(np.zeros(int(args[1][0].sum().item()))), None, None

    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "onnxscript", None)
        with pytest.raises(SkillweaveError, match=r"skillweave\[onnx\]"):
            agent_graph(policy, False, "it")
    monkeypatch.setattr(policy.algorithm, "act", act)
    with pytest.raises(SkillweaveError, match="the policy of 'land' cannot be written as ONNX"):
        agent_graph(policy, False, "the policy of 'land'")


def test_runners_act_by_the_package_beside_them_and_need_little_else(tmp_path: Path) -> None:
    config, obs, actions = CASES["ppo, normalised"]
    found = []
    for seed in range(2):
        policy, folder = agent(config, obs, actions, seed=seed), tmp_path / str(seed)
        write_export(folder, policy, "toy")
        spec = importlib.util.spec_from_file_location(f"runner_{seed}", folder / "runner.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        runner, player = module.Runner(folder), Player(policy)
        for one in one_by_one(obs, 5):
            assert same(runner.act(one), player.act(one))
        found.append(sys.modules[type(runner).__mro__[1].__module__].__file__)
    assert [str(tmp_path / str(seed)) in path for seed, path in enumerate(found)] == [True, True]
    needs = set()
    for file in (tmp_path / "0").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                needs |= {a.name.split(".")[0] for a in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                needs.add((node.module or "").split(".")[0])
    assert needs - set(sys.stdlib_module_names) == {"numpy", "onnxruntime"}
