"""The same seed gives the same weights, however many threads torch has outside."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from small_runs import Balance, Left
from toys import Echo, learn

from skillweave import Apart, Hierarchy, TrainDefaults
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.config import DQN, PPO, SAC, TD3
from skillweave.evolution import Evolution
from skillweave.networks.config import CNN, RNN, Network
from skillweave.ops.threads import torch_threads

COUNTS = (1, 2, 4)
WIDE = Network((64, 64))
SEEN = Dict(vector=Box(-1.0, 1.0, (8,), np.float32), image=Box(0, 255, (36, 36, 3), np.uint8))
INITIAL = {
    "PPO": PPO(network=WIDE),
    "PPO, LSTM": PPO(network=replace(WIDE, rnn=RNN("lstm", 64))),
    "PPO, IMPALA": PPO(network=replace(WIDE, cnn=CNN.impala())),
    "DQN": DQN(network=WIDE),
    "Rainbow": DQN.rainbow(network=WIDE),
    "TD3": TD3(network=WIDE),
    "SAC": SAC(network=WIDE),
}


@pytest.fixture(autouse=True)
def one_thread_afterwards() -> Iterator[None]:
    yield
    torch.set_num_threads(1)


def of_each_count(make):
    """What is made with each number of threads, which the caller has again afterwards."""
    found = []
    for count in COUNTS:
        torch.set_num_threads(count)
        found.append(make(count))
        assert torch.get_num_threads() == count
    return found


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("name", INITIAL)
def test_initial_weights_do_not_depend_on_the_number_of_threads(name):
    config = INITIAL[name]
    acts = Discrete(4) if isinstance(config, PPO | DQN) else Box(-1.0, 1.0, (2,), np.float32)
    algorithm = make_algorithm(config, SEEN, acts)
    first, *others = of_each_count(lambda _: vars(algorithm.init([Seeds(0), Seeds(1)])))
    for other in others:
        assert all(torch.equal(value, other[k]) for k, value in first.items())


BUFFERED = {"num_envs": 8, "learning_starts": 64, "batch_size": 64, "network": WIDE}
LEARNERS = {
    "PPO": (PPO(num_envs=8, n_steps=16, batch_size=64, network=WIDE), "Discrete"),
    "DQN": (DQN(**BUFFERED, train_freq=1), "Discrete"),
    "SAC": (SAC(**BUFFERED), "Box"),
}


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", LEARNERS)
def test_training_does_not_depend_on_the_number_of_threads(name):
    config, asks = LEARNERS[name]
    first, *others = of_each_count(lambda _: learn(config, Echo(8, "vector", asks), 192)[1].params)
    assert all(torch.equal(first, other) for other in others)


def trained(path: Path) -> dict[str, bytes]:
    """Every policy's file of a small hierarchy, one skill of which is evolved."""
    algorithm = PPO(num_envs=4, n_steps=16, batch_size=32, network=WIDE)
    hierarchy = Hierarchy(
        "CartPole-v1",
        [Left(), Balance()],
        call_steps=4,
        algorithm=algorithm,
        selector=algorithm,
        apart=Apart(skill_steps=256, selector_steps=512),
        train_defaults=TrainDefaults(eval_every=128, eval_episodes=2),
        learn="apart",
    )
    search = Evolution(population=2, generations=2, episodes=2)
    hierarchy.train(path, quiet=True, evolve={"left": search})
    files = path.glob("policies/*.safetensors")  # final states hold times
    found = {f.name: f.read_bytes() for f in files}
    assert len(found) == 3
    return found


@pytest.mark.slow
def test_a_hierarchy_does_not_depend_on_the_number_of_threads(tmp_path):
    found = of_each_count(lambda count: trained(tmp_path / str(count)))
    assert found[0] == found[1] == found[2]


def test_threads_are_given_back_after_an_error():
    torch.set_num_threads(2)
    with contextlib.suppress(KeyError), torch_threads(1):
        assert torch.get_num_threads() == 1
        raise KeyError
    assert torch.get_num_threads() == 2
