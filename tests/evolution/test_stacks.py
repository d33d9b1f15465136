"""Members of several widths in one stack learn what they learn alone."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave import DQN, PPO, SAC, TD3, Network
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import RNN, SelfImitationPPO
from skillweave.algorithms.batches import Rollout, Sample
from skillweave.evolution.stacks import Member, crop, join, pad, split, stack_key
from skillweave.networks.stacked import Layout

OBS = gym.spaces.Box(-1.0, 1.0, (5,), np.float32)
CHOICE, FORCE = gym.spaces.Discrete(3), gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
WIDTHS = [(8, 6), (3, 6), (5, 11), (8, 6)]
REPLAY: dict[str, Any] = {"num_envs": 2, "batch_size": 16, "buffer_size": 100}
CASES = {
    "ppo": (PPO(num_envs=2, n_steps=8, batch_size=16, update_epochs=2), CHOICE),
    "ppo, force": (PPO(num_envs=2, n_steps=8, batch_size=16, normalize_obs=True), FORCE),
    "self-imitation": (
        SelfImitationPPO(num_envs=2, n_steps=8, batch_size=16, imitation_rows=20),
        CHOICE,
    ),
    "dqn": (DQN(**REPLAY), CHOICE),
    "rainbow": (DQN.rainbow(**REPLAY), CHOICE),
    "td3": (TD3(**REPLAY), FORCE),
    "sac": (SAC(**REPLAY), FORCE),
    "sac of choices": (SAC(**REPLAY), CHOICE),
}


def members(config: Any, spaces: Any, activation: str = "relu") -> list[Member]:
    made = []
    for i, hidden in enumerate(WIDTHS):
        own = replace(config, network=Network(hidden, activation), learning_rate=1e-3 * (i + 1))
        member = Member(i, own, None)
        member.state = member.algorithm(spaces).init([Seeds(7) / i])
        made.append(member)
    return made


def draw(shape: Any, seed: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def learn(algorithm: Any, state: Any, action_space: Any, rows: list[int], updates: int) -> None:
    """Updates of the members ``rows`` on data that depends on the member alone."""
    discrete = action_space is CHOICE
    for u in range(updates):
        if isinstance(algorithm.config, PPO):

            def each(shape: Any, key: int, u: int = u) -> torch.Tensor:
                return torch.stack([draw((8, 2, *shape), 97 * u + 13 * r + key) for r in rows])

            action = each((), 1).abs().long() % 3 if discrete else each((2,), 1)
            obs, next_obs, last = each((5,), 2), each((5,), 4), each((), 5) > 1.0
            last[:, -1] = True  # what follows is the next row, except at ends
            next_obs[:, :-1] = torch.where(last[:, :-1, :, None], next_obs[:, :-1], obs[:, 1:])
            discount = torch.full((len(rows), 8, 2), 0.9)
            log_std = None if discrete else torch.zeros(len(rows), 1, 1, 2)
            head = each((3 if discrete else 2,), 6)
            rollout = Rollout(
                obs,
                action,
                each((), 3),
                discount,
                next_obs,
                last,
                dist_params=head,
                log_std=log_std,
            )
            algorithm.update(state, rollout, [(Seeds(u) / r).torch() for r in rows])
            continue

        def batch(shape: Any, key: int, u: int = u) -> torch.Tensor:
            return torch.stack([draw((16, *shape), 97 * u + 13 * r + key) for r in rows])

        action = batch((), 1).abs().long() % 3 if discrete else batch((2,), 1).tanh()
        sample = Sample(
            batch((5,), 2), action, batch((), 3), torch.full((len(rows), 16), 0.9), batch((5,), 4),
            None, None, None, np.zeros((len(rows), 16), np.int64),
        )  # fmt: skip
        algorithm.update(state, sample, [(Seeds(u) / r).torch() for r in rows])


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize(
    ("name", "activation"), [("ppo", "tanh"), ("dqn", "silu"), *((name, "relu") for name in CASES)]
)
def test_a_stack_of_several_widths_learns_what_each_member_learns_alone(name, activation):
    config, action_space = CASES[name]
    spaces = (OBS, action_space)
    together, alone = (members(config, spaces, activation) for _ in range(2))
    if config == CASES["rainbow"][0]:  # a wider layer draws other noise
        together, alone = together[::3], alone[::3]
    algorithm, state = join(together, spaces)
    rows = [m.number for m in together]
    learn(algorithm, state, action_space, rows, 10)
    split(algorithm, state, together, spaces)
    for member, single in zip(together, alone, strict=True):
        learn(single.algorithm(spaces), single.state, action_space, [single.number], 10)
        for f in fields(member.state):
            mine, its = getattr(member.state, f.name), getattr(single.state, f.name)
            assert torch.allclose(mine, its, rtol=1e-4, atol=1e-5), f.name


@pytest.mark.parametrize("name", [k for k in CASES if k != "rainbow"])
def test_what_is_padded_stays_exactly_zero(name):
    config, action_space = CASES[name]
    spaces = (OBS, action_space)
    made = members(config, spaces)
    algorithm, state = join(made, spaces)
    learn(algorithm, state, action_space, [m.number for m in made], 5)
    for field, wide in algorithm.layouts().items():
        for i, member in enumerate(made):
            flat = getattr(state, field)[i : i + 1]
            own = member.algorithm(spaces).layouts()[field]
            assert torch.equal(pad(crop(flat, wide, own), own, wide), flat), field


def test_padding_and_cropping_are_each_others_inverse():
    own, wide = Layout({"a": (2, 3), "b": (1, 3)}), Layout({"a": (4, 3), "b": (1, 5)})
    flat = torch.arange(18.0).view(2, 9)
    padded = pad(flat, own, wide)
    assert wide.views(padded)["a"][1].tolist() == [[9, 10, 11], [12, 13, 14], [0] * 3, [0] * 3]
    assert wide.views(padded)["b"][0].tolist() == [[6, 7, 8, 0, 0]]
    assert torch.equal(crop(padded, wide, own), flat)


def test_what_shapes_the_computation_keeps_members_apart_and_nothing_else():
    settings = ("learning_rate", "gamma")
    base = PPO(network=Network((8, 6), "relu"))

    def same(**changes: Any) -> bool:
        return stack_key(replace(base, **changes), settings) == stack_key(base, settings)

    assert same(learning_rate=1e-2, gamma=0.5)
    assert same(network=Network((3, 99), "relu"))
    assert not same(network=Network((8, 6, 6), "relu"))
    assert not same(network=Network((8, 6), "tanh"))
    assert not same(network=Network((8, 6), "relu", rnn=RNN()))
    assert not same(batch_size=512)
    assert not same(update_epochs=9)
    normed = replace(base, network=Network((8, 6), "relu", layer_norm=True))
    wider = replace(base, network=Network((9, 6), "relu", layer_norm=True))
    assert stack_key(normed, settings) != stack_key(wider, settings)
