"""PyTorch's defaults and modes are the user's: training has the same weights under all of them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave import (
    DQN,
    PPO,
    SAC,
    TD3,
    Agent,
    Apart,
    EnvSpec,
    Hierarchy,
    Network,
    Together,
    load,
)
from skillweave.algorithms import RNN, SelfImitationPPO
from skillweave.evolution import Evolution
from tests.small_runs import Balance, Left, policies

NETWORK = Network((8,), "relu")
ON = {"num_envs": 4, "n_steps": 8, "batch_size": 16, "update_epochs": 2}
OFF = {"num_envs": 4, "batch_size": 8, "learning_starts": 40, "buffer_size": 500}


class Encoder(torch.nn.Module):
    """A network of a user who relies on the defaults."""

    def __init__(self, space: gym.spaces.Box) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(space.shape[0], 6)
        self.register_buffer("scale", torch.full((6,), 0.5))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.layer(obs)) * self.scale


ALGORITHMS: dict[str, tuple[str, Any]] = {
    "PPO": ("CartPole-v1", PPO(network=NETWORK, **ON)),
    "PPO, a Box": ("Pendulum-v1", PPO(network=NETWORK, **ON)),
    "PPO, a memory": ("CartPole-v1", PPO(network=Network((8,), rnn=RNN("lstm", 6)), **ON)),
    "PPO, an encoder": ("CartPole-v1", PPO(network=Network((8,), encoder=Encoder), **ON)),
    "imitation": ("CartPole-v1", SelfImitationPPO(network=NETWORK, **ON)),
    "DQN": ("CartPole-v1", DQN(network=NETWORK, **OFF)),
    "Rainbow": ("CartPole-v1", DQN.rainbow(network=NETWORK, **OFF)),
    "SAC": ("Pendulum-v1", SAC(network=NETWORK, **OFF)),
    "TD3": ("Pendulum-v1", TD3(network=NETWORK, **OFF)),
}


@contextlib.contextmanager
def mode(change: Callable[[Any], object], value: Any, usual: Any) -> Iterator[None]:
    change(value)
    try:
        yield
    finally:
        change(usual)


def doubles(dtype: torch.dtype = torch.float64) -> AbstractContextManager[None]:
    return mode(torch.set_default_dtype, dtype, torch.float32)


def no_gradients() -> AbstractContextManager[None]:
    return mode(torch.set_grad_enabled, False, True)


MODES = {
    "float64": doubles,
    "float16": lambda: doubles(torch.float16),
    # A device that holds no numbers: whatever lands there fails.
    "another device": lambda: mode(torch.set_default_device, "meta", None),
    "gradients off": no_gradients,
    "inference mode": torch.inference_mode,
}


def now() -> tuple[Any, ...]:
    gradients = torch.is_grad_enabled(), torch.is_inference_mode_enabled()
    return torch.get_default_dtype(), *gradients


def used(folder: Path, name: str) -> tuple[Any, ...]:
    """Train, go on, load, evaluate and act: all numbers that come out."""
    env, algorithm = ALGORITHMS[name]
    agent = Agent(env, algorithm, 96)
    agent.train(folder, quiet=True, checkpoint_every=40)
    Agent(env, algorithm, 160).train(folder, resume=True, quiet=True)
    run = load(folder, Agent(env, algorithm, 160))
    obs, _ = gym.make(env).reset(seed=0)
    run.save_weights(folder / "w.safetensors")
    returns = run.evaluate(2, quiet=True, max_steps=50).returns
    sampled = run.evaluate(2, quiet=True, max_steps=50, deterministic=False).returns
    return policies(folder), returns, sampled, np.asarray(run.act(obs)).tolist()


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_learns_the_same_and_leaves_the_mode(name, tmp_path):
    usual = used(tmp_path / "usual", name)
    for mode, entered in MODES.items():
        with entered():
            before = now()
            assert used(tmp_path / mode, name) == usual, mode
            assert now() == before, mode


def tree(**more: Any) -> Hierarchy:
    on = PPO(network=NETWORK, **ON)
    return Hierarchy("CartPole-v1", [Left(), Balance()], algorithm=on, selector=on, **more)


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_hierarchies_and_populations_learn_the_same(mode, tmp_path):
    def all_of(folder: Path) -> list[Any]:
        both = {"apart": Apart(skill_steps=96, selector_steps=96), "together": Together(steps=192)}
        tree(learn="apart, then together", **both).train(folder / "a", quiet=True)
        Agent("CartPole-v1", PPO(network=NETWORK, **ON), 300).train(
            folder / "b", quiet=True, evolve=Evolution(population=3)
        )
        return [policies(folder / name) for name in ("a", "b")]

    usual = all_of(tmp_path / "usual")
    with MODES[mode]():
        assert all_of(tmp_path / "here") == usual


@pytest.mark.parametrize("workers", [1, 2])
def test_an_environment_keeps_the_modes_of_the_user(workers, tmp_path):
    """A simulator in PyTorch computes as it does without this library."""
    seen = set()

    class Simulator(gym.Wrapper):
        def step(self, action):
            seen.add((torch.get_default_dtype(), torch.is_grad_enabled(), torch.ones(1).dtype))
            weight = torch.ones(1, requires_grad=True)
            (weight * 2).numpy()  # refused where gradients are on
            return super().step(action)

    with doubles(), no_gradients():
        spec = EnvSpec(lambda: Simulator(gym.make("CartPole-v1")), workers=workers)
        agent = Agent(spec, PPO(network=NETWORK, **ON), 96)
        agent.train(tmp_path / "run", quiet=True).evaluate(1, quiet=True)
    assert seen == {(torch.float64, False, torch.float64)}


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["float64", "gradients off", "another device"])
def test_an_export_is_the_same(mode, tmp_path):
    run = Agent("CartPole-v1", PPO(network=NETWORK, **ON), 96).train(tmp_path / "run", quiet=True)
    usual = run.export(tmp_path / "usual")
    with MODES[mode]():
        run.export(tmp_path / "here")
    assert usual.files
    for name in usual.files:
        if not name.endswith(".onnx"):
            assert (tmp_path / "here" / name).read_text() == (tmp_path / "usual" / name).read_text()


def test_a_module_of_doubles_is_a_skill(tmp_path):
    class Ready(Left):
        name = "ready"

    with doubles():
        Ready.policy = torch.nn.Linear(4, 2)
        on = PPO(network=NETWORK, **ON)
        tree = Hierarchy("CartPole-v1", [Ready()], call_steps=4, selector=on, steps=96)
        assert tree.train(tmp_path / "run", quiet=True).evaluate(1, quiet=True).lengths
