"""Mapped policies act in an export as they act here: the runner applies the mapping itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from skills.mapped_models import ACTION, CASES, SPACE, observations, one
from test_networks import compare

import skillweave as sw
from skillweave.api.player import Player
from skillweave.errors import PolicyError
from skillweave.export.foreign import as_file
from skillweave.export.runner import Runner
from skillweave.export.write import write_export

pytest.importorskip("onnxscript")
pytest.importorskip("stable_baselines3")
torch.set_num_threads(1)


def exported(policy: Any, folder: Path) -> None:
    export = write_export(folder, policy, "robot")
    seen = [one(obs, 0) for obs in observations(1, 40, seed=4)]
    told = compare(policy, folder, seen, code=export.functions, rtol=1e-7)
    assert len(np.unique(np.round(told, 3))) > 3


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("name", CASES)
def test_the_runner_applies_the_mapping(name: str, tmp_path: Path) -> None:
    policy = CASES[name](tmp_path).policy.bind(SPACE, ACTION, "it")
    exported(policy, tmp_path / "out")


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
    exported(policy, tmp_path / "out")
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
