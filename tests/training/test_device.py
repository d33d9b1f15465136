"""A stage learns on the device that its settings name."""

from dataclasses import replace

import pytest
import torch

from skillweave import DQN, PPO, SAC, Network, SkillweaveError, train_agent
from skillweave.evolution import Evolution

NET = Network((8,))
REPLAY = {
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


def train(name, evolve, device, path, steps=256):
    config, env = LEARNERS[name]
    how = {"quiet": True, "evolve": evolve, "checkpoint_every": 200}
    return train_agent(env, replace(config, device=device), steps, path, **how)


each_learner = pytest.mark.parametrize("name", LEARNERS)
with_or_without = pytest.mark.parametrize("evolve", EVOLVE)


@each_learner
@with_or_without
def test_a_device_that_is_not_there_is_told_before_anything_is_written(
    name, evolve, tmp_path, monkeypatch
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SkillweaveError, match=r"stage 'agent': .*no CUDA device here; use 'cpu'"):
        train(name, evolve, "cuda", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.fast_cases(2)
@each_learner
@with_or_without
def test_auto_is_the_cpu_where_there_is_nothing_else(name, evolve, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    runs = [train(name, evolve, device, tmp_path / device) for device in ("cpu", "auto")]
    first, second = (run.policy.weights for run in runs)
    assert all(torch.equal(value, second[key]) for key, value in first.items())


@gpu
@each_learner
@with_or_without
def test_on_a_gpu_it_learns_and_its_policy_is_read_without_one(name, evolve, tmp_path, monkeypatch):
    run = train(name, evolve, "cuda", tmp_path / "run", 512)
    assert all(v.device.type == "cpu" and v.isfinite().all() for v in run.policy.weights.values())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert len(run.evaluate(2).returns) == 2
