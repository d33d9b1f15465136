"""One mutation at a time: what moves, what stays, and what is written of it."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave import DQN, PPO, SAC, TD3, Network
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import CNN
from skillweave.algorithms.batches import Sample
from skillweave.algorithms.parameters import LARGEST
from skillweave.errors import DeclarationError
from skillweave.evolution import Evolution, Mutations, Range
from skillweave.evolution.config import KINDS
from skillweave.evolution.mutation import (
    check_mutations,
    difference,
    mutate,
    random_config,
    with_settings,
)
from skillweave.evolution.stacks import Member, join

OBS = gym.spaces.Box(-1.0, 1.0, (5,), np.float32)
CHOICE, FORCE = gym.spaces.Discrete(3), gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
SMALL = Network((8, 6), "relu")
CASES: dict[str, tuple[Any, Any]] = {
    "ppo": (PPO(network=SMALL), CHOICE),
    "dqn": (DQN(network=SMALL), CHOICE),
    "rainbow": (DQN.rainbow(network=SMALL), CHOICE),
    "td3": (TD3(network=SMALL), FORCE),
    "sac": (SAC(network=SMALL, critic=Network((7,), "relu")), FORCE),
}


def only(kind: str, **settings: Any) -> Mutations:
    """Mutations of one kind alone."""
    return Mutations(**{k: float(k == kind) for k in KINDS}, **settings)


def member(name: str) -> tuple[Member, Any]:
    config, action_space = CASES[name]
    made, spaces = Member(4, config, None, 17), (OBS, action_space)
    made.state = made.algorithm(spaces).init([Seeds(3)])
    return made, spaces


def same_tensors(a: Member, b: Member, but: tuple[str, ...] = ()) -> bool:
    return all(
        torch.equal(getattr(a.state, f.name), getattr(b.state, f.name))
        for f in fields(a.state)
        if f.name not in but
    )


@pytest.mark.parametrize("name", CASES)
def test_none_is_a_copy_that_shares_no_memory(name):
    parent, spaces = member(name)
    child = mutate(parent, only("none"), spaces, np.random.default_rng(0))
    assert child.config == parent.config
    assert same_tensors(parent, child)
    assert (child.origin.parent, child.origin.mutation, child.origin.changes) == (4, "none", {})
    assert child.steps == 17
    child.state.params.add_(1.0)
    assert not same_tensors(parent, child)


@pytest.mark.parametrize("name", CASES)
def test_a_setting_moves_in_settings_and_state_and_is_written_down(name):
    parent, spaces = member(name)
    by, seen = only("hyperparameters"), set()
    for seed in range(90):
        child = mutate(parent, by, spaces, np.random.default_rng(seed))
        ((moved, (old, new)),) = child.origin.changes.items()
        assert old == getattr(parent.config, moved)
        assert new == getattr(child.config, moved) != old
        assert float(getattr(child.state, moved)) == pytest.approx(new)
        assert same_tensors(parent, child, but=(moved,))
        seen.add((moved, new > old))
    names = by.ranges_of(parent.config)
    assert seen == {(k, up) for k in names for up in (True, False)}


def test_whole_numbers_grow_as_well_as_shrink_and_stay_within_their_range():
    config = PPO(num_envs=4, n_steps=8, batch_size=16, update_epochs=2)
    by = only("hyperparameters", ranges={"update_epochs": Range(1, 5)}, step=0.01)
    made, spaces = Member(0, config, None), (OBS, CHOICE)
    made.state = made.algorithm(spaces).init([Seeds(0)])
    seen, rng = set(), np.random.default_rng(0)
    for _ in range(80):
        made = mutate(made, by, spaces, rng)
        assert type(made.config.update_epochs) is int
        seen.add(made.config.update_epochs)
    assert seen == {1, 2, 3, 4, 5}


def test_a_move_that_does_not_fit_the_other_settings_is_not_made():
    config = PPO(num_envs=16, n_steps=32, batch_size=512)  # the rollout: it cannot grow
    made, spaces = Member(0, config, None), (OBS, CHOICE)
    made.state = made.algorithm(spaces).init([Seeds(0)])
    by = only("hyperparameters", ranges={"batch_size": Range(16, 4096)})
    for seed in range(10):
        child = mutate(made, by, spaces, np.random.default_rng(seed))
        assert child.config.batch_size < 512


@pytest.mark.parametrize("name", CASES)
def test_noise_falls_on_a_share_of_what_acts_and_alike_on_its_slow_copy(name):
    parent, spaces = member(name)
    by = only("parameters", share=0.25, strength=0.5)
    child = mutate(parent, by, spaces, np.random.default_rng(1))
    algorithm = parent.algorithm(spaces)
    moved = (child.state.params - parent.state.params)[:, : algorithm.acting.size]
    weights = algorithm.acting.views(moved)[
        "actor.1.weight" if "actor.1.weight" in algorithm.acting.shapes else "q.0.weight"
    ]
    assert 0.05 < float((weights != 0).float().mean()) < 0.5
    rest = (child.state.params - parent.state.params)[:, algorithm.acting.size :]
    assert not rest.any()
    if hasattr(parent.state, "target"):
        assert torch.equal(child.state.target - parent.state.target != 0, moved != 0)
    critics = [f.name for f in fields(parent.state) if f.name.startswith("critic")]
    assert all(torch.equal(getattr(parent.state, k), getattr(child.state, k)) for k in critics)


@pytest.mark.parametrize("name", CASES)
def test_another_activation_is_that_of_all_networks(name):
    parent, spaces = member(name)
    by = only("activation", activations=("relu", "elu"))
    child = mutate(parent, by, spaces, np.random.default_rng(1))
    assert child.config.network.activation == "elu"
    assert getattr(child.config, "critic", None) in (None, Network((7,), "elu"))
    assert same_tensors(parent, child)
    stays = only("activation", activations=("relu",))
    assert mutate(parent, stays, spaces, np.random.default_rng(1)).origin.mutation == "none"


@pytest.mark.parametrize("name", CASES)
def test_an_architecture_is_changed_and_written_down(name):
    parent, spaces = member(name)
    by = only("architecture", units=(4, 32))
    child = mutate(parent, by, spaces, np.random.default_rng(0))
    old, new = child.origin.changes["network.hidden"]
    assert (old, new) == ((8, 6), child.config.network.hidden)
    assert child.state.params.shape[1] == child.algorithm(spaces).layout.size


def test_random_settings_cover_their_ranges_and_fit_together():
    config = replace(CASES["ppo"][0], batch_size=64)
    by = Mutations(
        ranges={"learning_rate": Range(1e-4, 1e-2), "batch_size": Range(16, 4096),
                "n_steps": Range(8, 128)},
        units=(16, 64), layers=(1, 3),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    drawn = [random_config(config, by, rng) for _ in range(300)]
    rates = np.log10([c.learning_rate for c in drawn])
    assert rates.min() == pytest.approx(-4, abs=0.05)
    assert rates.max() == pytest.approx(-2, abs=0.05)
    assert np.mean(rates) == pytest.approx(-3, abs=0.1)
    assert {len(c.network.hidden) for c in drawn} == {1, 2, 3}
    widths = {w for c in drawn for w in c.network.hidden}
    assert min(widths) >= 16
    assert max(widths) <= 64
    assert {c.network.activation for c in drawn} == set(by.activations)


@pytest.mark.parametrize(
    ("config", "evolution", "said"),
    [
        (PPO(), Evolution(mutations=Mutations(ranges={})), "stage x: .*ranges is empty"),
        (
            PPO(network=Network(layer_norm=True)),
            Evolution(),
            r"stage x: Mutations\.architecture is 0.2, but network has layer_norm",
        ),
    ],
)
def test_mutations_that_an_agent_does_not_have_are_refused(config, evolution, said):
    with pytest.raises(DeclarationError, match=said):
        check_mutations(config, evolution, "stage x: ")


# SAC's temperature


FIXED = replace(CASES["sac"][0], learn_ent_coef=False, ent_coef=0.05)


def test_a_mutated_temperature_is_the_one_that_is_learnt_by():
    made, spaces = Member(0, FIXED, None), (OBS, FORCE)
    made.state = made.algorithm(spaces).init([Seeds(3)])
    by = only("hyperparameters", ranges={"ent_coef": Range(1e-3, 0.5)})
    child = mutate(made, by, spaces, np.random.default_rng(0))
    assert child.config.ent_coef != 0.05
    algorithm, state = join([made, child], spaces)  # they share a stack
    rows = torch.zeros(2, 4, 5)
    sample = Sample(
        rows, torch.zeros(2, 4, 2), torch.zeros(2, 4), torch.zeros(2, 4), rows, None, None, None,
        np.zeros((2, 4), int),
    )  # fmt: skip
    _, report = algorithm.update(state, sample, [Seeds(m).torch() for m in range(2)])
    assert report.metrics["ent_coef"].tolist() == pytest.approx([0.05, child.config.ent_coef])


def test_a_temperature_that_is_learnt_does_not_mutate():
    learnt = replace(FIXED, learn_ent_coef=True)
    assert "ent_coef" in Mutations().ranges_of(FIXED)
    assert "ent_coef" not in Mutations().ranges_of(learnt)
    by = Evolution(mutations=Mutations(ranges={"ent_coef": Range(1e-3, 0.5)}))
    check_mutations(FIXED, by, "")
    with pytest.raises(DeclarationError, match=r"ent_coef.*learn_ent_coef"):
        check_mutations(learnt, by, "stage x: ")


def test_a_limit_of_gradients_may_be_none_and_may_be_set():
    made, _ = member("sac")
    assert made.state.max_grad_norm.tolist() == [LARGEST]
    assert with_settings(made, max_grad_norm=2.0).state.max_grad_norm.tolist() == [2.0]
    back = with_settings(with_settings(made, max_grad_norm=2.0), max_grad_norm=None)
    assert back.state.max_grad_norm.tolist() == [LARGEST]


def test_a_change_of_a_convolution_is_recorded_by_its_parts() -> None:
    before = PPO(network=Network(cnn=CNN()))
    after = replace(before, network=replace(before.network, cnn=CNN(channels=(32, 64, 48))))
    assert difference(before, after) == {"network.cnn.channels": ((32, 64, 64), (32, 64, 48))}
