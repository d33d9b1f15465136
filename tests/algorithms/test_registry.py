"""Algorithms of users' own: they are registered, learn what the library's own learn, are saved."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest
import torch
from small_runs import Balance, Left
from toys import members_of, own_algorithm as example

from skillweave import SAC, Apart, Hierarchy, Network, train_agent
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import Algorithm, config as table, register_algorithm
from skillweave.algorithms.config import OnPolicy, config_from_json, config_to_json, named_config
from skillweave.algorithms.registry import make_algorithm
from skillweave.errors import DeclarationError, RunError
from skillweave.evolution import Evolution, Mutations

BOX, LINE = gym.spaces.Box(-1, 1, (2,), np.float32), gym.spaces.Discrete(2)


@pytest.fixture(autouse=True)
def known_afterwards(monkeypatch):
    """What a test registers is forgotten after it."""
    monkeypatch.setattr(table, "_REGISTERED", dict(table._REGISTERED))
    sys.modules.pop("own_algorithm", None)


def own(**settings):
    small = {
        "num_envs": 8, "n_steps": 8, "gamma": 0.5, "learning_rate": 2e-2, "normalize_obs": False,
        "network": Network((16,)), "ent_coef": 0.0,
    }  # fmt: skip
    return example().A2C(**small | settings)


# Learning


def test_a_stack_of_it_learns_what_its_members_learn_alone():
    algorithm = make_algorithm(own(), BOX, LINE)
    g = torch.Generator().manual_seed(0)
    lead = (3, 8, 4)
    last = torch.rand(lead, generator=g) < 0.3
    valid = torch.arange(8)[:, None] < torch.randint(1, 9, (3, 1, 4), generator=g)
    last &= valid
    last |= valid & ~torch.nn.functional.pad(valid[:, 1:], (0, 0, 0, 1))
    rollout = example().Rollout(
        torch.randn(*lead, 2, generator=g), torch.zeros(lead, dtype=torch.int64),
        torch.randn(lead, generator=g), torch.full(lead, 0.9), torch.randn(*lead, 2, generator=g),
        last, valid=valid,
    )  # fmt: skip
    stack, _ = algorithm.update(algorithm.init([Seeds(m) for m in range(3)]), rollout, [])
    for m in range(3):
        part = members_of(rollout, slice(m, m + 1))
        alone, _ = algorithm.update(algorithm.init([Seeds(m)]), part, [])
        torch.testing.assert_close(stack.params[m], alone.params[0], rtol=1e-4, atol=1e-6)


# From end to end


def test_it_trains_skills_selectors_and_populations(tmp_path):
    config = own(num_envs=4, n_steps=16)
    hierarchy = Hierarchy(
        "CartPole-v1",
        [Left(), Balance()],
        call_steps=4,
        algorithm=config,
        selector=config,
        apart=Apart(skill_steps=256, selector_steps=256),
        learn="apart",
    )
    changes = Mutations(none=0.3, activation=0.0)
    search = Evolution(population=2, generations=2, episodes=1, mutations=changes)
    evolve = {"left": search, "selector": search}
    run = hierarchy.train(tmp_path / "run", quiet=True, evolve=evolve)
    left, balance, selector = run.info()["stages"]
    assert [s["steps"] >= s["budget"] * 0.9 for s in (left, balance, selector)] == [True] * 3
    assert "winner" in left
    assert "winner" not in balance
    assert "winner" in selector
    assert run.evaluate(2).mean > 0


# Names and files


def test_settings_are_found_by_name_and_survive_json():
    config = own(ent_coef=0.25)
    data = config_to_json(config)
    assert data["algorithm"] == "A2C"
    assert config_from_json(data) == config
    assert named_config("a2c", "here") == example().A2C()
    assert isinstance(make_algorithm(config, BOX, LINE), example().A2CAlgorithm)
    sys.modules.pop("own_algorithm")
    again = example().A2C  # the latest of a name counts
    assert again is not type(config)
    assert type(config_from_json(config_to_json(again()))) is again


def test_an_algorithm_that_nobody_registered_is_an_error_that_says_what_to_do():
    data = config_to_json(own())
    config = own()
    table._REGISTERED.pop("A2C")
    says = r"no algorithm is registered for '?A2C'?; there are: PPO, .*\.register_algorithm"
    with pytest.raises(RunError, match=says):
        config_from_json(data, "run.json", "phases[0].algorithm")
    with pytest.raises(DeclarationError, match=says):
        make_algorithm(config, BOX, LINE)
    with pytest.raises(DeclarationError, match=says):
        train_agent("CartPole-v1", config, 100, "nowhere")


@pytest.mark.parametrize("method", ["fresh_state", "parameter_groups", "act", "value", "update"])
def test_a_method_that_is_missing_is_named(method):
    kind = example().A2CAlgorithm
    lacking = type("Half", (kind,), {method: getattr(Algorithm, method)})
    with pytest.raises(
        DeclarationError, match=rf"Half lacks {method}; see skillweave\.algorithms\.Algorithm"
    ):
        register_algorithm(example().A2C, lacking)
    algorithm = lacking(own(), BOX, LINE)
    given = {"fresh_state": 1, "parameter_groups": 0, "act": 4, "value": 2, "update": 3}[method]
    with pytest.raises(DeclarationError, match=rf"Half has no method '{method}'"):
        getattr(algorithm, method)(*[None] * given)


def changed(**attributes):
    """Return a class like the example's, with other attributes."""
    return type("Changed", (example().A2CAlgorithm,), attributes)


MISTAKES = {
    "no algorithm": (
        lambda: register_algorithm(example().A2C, int),
        r"int is no subclass of skillweave\.algorithms\.Algorithm",
    ),
    "settings of another store": (
        lambda: register_algorithm(example().A2C, changed(store="replay")),
        "must be a frozen dataclass on OffPolicy",
    ),
    "settings of another algorithm": (
        lambda: register_algorithm(SAC, example().A2CAlgorithm),
        "must be a frozen dataclass on OnPolicy",
    ),
    "an unknown store": (
        lambda: register_algorithm(example().A2C, changed(store="drawer")),
        "'drawer'; it must be 'rollout' or 'replay'",
    ),
    "no methods": (
        lambda: register_algorithm(example().A2C, type("Bare", (Algorithm,), {})),
        r"lacks fresh_state, .*, store, action_spaces",
    ),
    "the name of a built-in algorithm": (
        lambda: register_algorithm(
            dataclass(frozen=True)(type("PPO", (OnPolicy,), {})), example().A2CAlgorithm
        ),
        "PPO is an algorithm of this library",
    ),
    "a discrete space": (
        lambda: make_algorithm((own(), named_config("TD3", "here"))[1], BOX, LINE),
        "TD3 cannot .*Discrete.*; PPO, SelfImitationPPO, DQN, CQL, SAC, IQL, A2C",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named(mistake):
    make, message = MISTAKES[mistake]
    with pytest.raises(DeclarationError, match=message):
        make()
