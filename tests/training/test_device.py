"""A stage learns on the device that its settings name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from skillweave import DQN, PPO, SAC, Network, SkillweaveError, train_agent
from skillweave.evolution import Evolution
from skillweave.runs.files import read_tensors

NET = Network((8,))
REPLAY: dict[str, Any] = {
    "num_envs": 4, "learning_starts": 40, "batch_size": 8, "update_ratio": 0.1, "network": NET,
    "normalize_obs": True, "normalize_rewards": True,
}  # fmt: skip
LEARNERS = {
    "ppo": (PPO(num_envs=4, n_steps=16, batch_size=32, network=NET), "CartPole-v1"),
    "ppo of forces": (PPO(num_envs=4, n_steps=16, batch_size=32, network=NET), "Pendulum-v1"),
    "dqn": (DQN(**REPLAY), "CartPole-v1"),
    "sac": (SAC(**REPLAY), "Pendulum-v1"),
}
EVOLVE = [None, Evolution(population=2, generations=2, episodes=1)]
gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")


@pytest.mark.parametrize("name", LEARNERS)
@pytest.mark.parametrize("evolve", EVOLVE)
def test_a_device_that_is_not_there_is_told_before_anything_is_written(
    name: str, evolve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    config, env = LEARNERS[name]
    config = replace(config, device="cuda")
    with pytest.raises(SkillweaveError, match=r"stage 'agent': .*no CUDA device here; use 'cpu'"):
        train_agent(
            env, config, 256, tmp_path / "run", quiet=True, evolve=evolve, checkpoint_every=200
        )
    assert not (tmp_path / "run").exists()


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("name", LEARNERS)
@pytest.mark.parametrize("evolve", EVOLVE)
def test_auto_is_the_cpu_where_there_is_nothing_else(
    name: str, evolve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    found = []
    for device in ("cpu", "auto"):
        config, env = LEARNERS[name]
        config, path = replace(config, device=device), tmp_path / device
        train_agent(env, config, 256, path, quiet=True, evolve=evolve, checkpoint_every=200)
        found.append(read_tensors(path / "policies" / "agent.safetensors")[0])
    assert all(torch.equal(value, found[1][key]) for key, value in found[0].items())


@gpu
@pytest.mark.parametrize("name", LEARNERS)
@pytest.mark.parametrize("evolve", EVOLVE)
def test_on_a_gpu_it_learns_and_its_policy_is_read_without_one(
    name: str, evolve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, env = LEARNERS[name]
    config = replace(config, device="cuda")
    run = train_agent(
        env, config, 512, tmp_path / "run", quiet=True, evolve=evolve, checkpoint_every=200
    )
    assert all(v.device.type == "cpu" and v.isfinite().all() for v in run.policy.weights.values())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert len(run.evaluate(2).returns) == 2
