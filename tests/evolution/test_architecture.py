"""Networks grow without changing what they compute, and shrink to what was most read."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from toys import random_critic

from skillweave import DQN, PPO, SAC, TD3, Network
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import CNN, RNN, SelfImitationPPO
from skillweave.errors import DeclarationError
from skillweave.evolution import Mutations
from skillweave.evolution.architecture import Change, check_architecture, draw_change, rebuilt
from skillweave.evolution.stacks import Member, copy, join, split
from skillweave.ops.optim import adam_

VECTOR = gym.spaces.Box(-1.0, 1.0, (5,), np.float32)
IMAGE = gym.spaces.Box(0, 255, (3, 12, 12), np.uint8)
BOTH = gym.spaces.Dict({"camera": IMAGE, "speed": VECTOR})
CHOICE, FORCE = gym.spaces.Discrete(3), gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
ACTIVATIONS = ["relu", "elu", "silu", "gelu", "tanh"]
GROWTH = {
    "units of the first layer": Change("units", 0, 5),
    "units of the last layer": Change("units", 1, 3),
    "a layer": Change("layer", by=1),
}
KINDS = {
    "ppo": (PPO(), CHOICE),
    "ppo, force": (PPO(), FORCE),
    "ppo, memory": (PPO(network=Network(rnn=RNN("lstm", 6))), CHOICE),
    "self-imitation": (SelfImitationPPO(imitation_rows=20), CHOICE),
    "ppo, sees a part": (PPO(network=Network(sees=(0, 3, 4))), CHOICE),
    "dqn": (DQN(), CHOICE),
    "rainbow": (DQN.rainbow(), CHOICE),
    "td3": (TD3(), FORCE),
    "sac": (SAC(), FORCE),
    "sac, own critic": (SAC(critic=Network((9, 4, 7), "relu")), FORCE),
}


def member(name: str, activation: str, spaces_obs: Any = VECTOR) -> tuple[Member, Any]:
    """A member whose state is all random numbers: moments and slow copies too."""
    config, action_space = KINDS[name]
    network = replace(config.network, hidden=(8, 6), activation=activation)
    config = replace(config, network=network)
    if getattr(config, "critic", None) is not None:
        config = replace(config, critic=replace(config.critic, activation=activation))
    spaces = spaces_obs, action_space
    made = Member(0, config, None)
    algorithm = made.algorithm(spaces)
    made.state = algorithm.init([Seeds(3)])
    generator = torch.Generator().manual_seed(1)
    for field in algorithm.layouts():
        flat = getattr(made.state, field)
        flat.add_(0.3 * torch.randn(flat.shape, generator=generator))
    return made, spaces


def begin_anew(made: Member, spaces: Any) -> None:
    """Fresh weights of the shapes that its settings say, and a critic that says something."""
    algorithm = made.algorithm(spaces)
    made.state = algorithm.init([Seeds(3)])
    random_critic(algorithm, made.state)


def outputs(made: Member, spaces: Any) -> dict[str, torch.Tensor]:
    """What every network of a member computes, slow copies included, by field."""
    algorithm = made.algorithm(spaces)
    generator, found = torch.Generator().manual_seed(2), {}
    size = algorithm.obs.size
    inputs = {"vector": torch.randn(1, 50, size, generator=generator)} if size else {}
    for i, shape in enumerate(algorithm.obs.images):
        pixels = torch.randint(0, 256, (1, 50, *shape), generator=generator)
        inputs[f"image.{i}"] = pixels.to(torch.uint8)
    action = torch.randn(1, 50, 2, generator=generator)
    for family in algorithm.parameter_groups():
        for field in family.weights:
            flat = getattr(made.state, field)
            rows = flat.reshape(-1, flat.shape[-1])
            for row in range(len(rows)):
                views = family.layout.views(rows[row : row + 1])
                for name, net in family.nets:
                    key = f"{field}.{row}.{name}"
                    if getattr(net, "memory_size", 0):
                        zero = torch.zeros(1, 50, net.memory_size)
                        found[key] = net.step(views, inputs, zero)[0]
                    elif field.startswith("critic") and not isinstance(made.config, PPO):
                        found[key] = net(views, inputs, action)
                    else:
                        found[key] = net(views, inputs)
    return found


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("growth", GROWTH)
@pytest.mark.parametrize("name", KINDS)
def test_growth_leaves_every_function_as_it_was(name, growth, activation):
    change = GROWTH[growth]
    if change.kind == "layer" and activation == "tanh":
        pytest.skip("through tanh no layer is the identity: it is never drawn")
    before, spaces = member(name, activation)
    after = rebuilt(before, change, spaces, np.random.default_rng(0))
    assert after.config.network.hidden != before.config.network.hidden
    old, new = outputs(before, spaces), outputs(after, spaces)
    assert old.keys() == new.keys()
    for key, value in old.items():
        scale = max(1.0, float(value.abs().max()))
        assert float((value - new[key]).abs().max()) <= 1e-6 * scale, key
    wider = after.algorithm(spaces).layout.size
    assert wider > before.algorithm(spaces).layout.size


@pytest.mark.parametrize("cnn", [CNN("plain", (4, 6), (3, 3), (1, 2)), CNN.impala((4, 6))])
@pytest.mark.parametrize("space", [IMAGE, BOTH])
@pytest.mark.parametrize("layer", [0, 1])
def test_channels_grow_without_changing_the_function(cnn, space, layer):
    before, spaces = member("ppo", "relu", space)
    before.config = replace(before.config, network=replace(before.config.network, cnn=cnn))
    begin_anew(before, spaces)
    after = rebuilt(before, Change("channels", layer, 3), spaces, np.random.default_rng(0))
    assert after.config.network.cnn.channels[layer] == cnn.channels[layer] + 3
    old, new = outputs(before, spaces), outputs(after, spaces)
    for key, value in old.items():
        assert float((value - new[key]).abs().max()) <= 1e-6, key
    back = rebuilt(after, Change("channels", layer, -3), spaces, np.random.default_rng(0))
    for key, value in outputs(back, spaces).items():  # what nobody reads is taken first
        torch.testing.assert_close(value, old[key], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("space", [IMAGE, BOTH])
def test_kernels_grow_without_changing_the_function_where_they_can(space):
    before, spaces = member("ppo", "relu", space)
    cnn = CNN("plain", (4, 6), (3, 2), (2, 1))  # 12 → 5 → 4 pixels: the first has one to spare
    before.config = replace(before.config, network=replace(before.config.network, cnn=cnn))
    by, drawn = Mutations(channels=(99, 99), units=(99, 99)), set()
    before.config = replace(before.config, network=replace(before.config.network, hidden=(99,)))
    begin_anew(before, spaces)
    rng = np.random.default_rng(0)
    for _ in range(40):
        change = draw_change(before, replace(by, layer_share=0.0), spaces, rng)
        assert change is not None
        drawn.add((change.kind, change.layer, change.by))
    assert ("kernel", 0, 1) in drawn
    assert not {k for k in drawn if k[0] == "kernel"} - {("kernel", 0, 1)}
    after = rebuilt(before, Change("kernel", 0, 1), spaces, rng)
    assert after.config.network.cnn.kernels == (4, 2)
    old, new = outputs(before, spaces), outputs(after, spaces)
    for key, value in old.items():
        assert float((value - new[key]).abs().max()) <= 1e-6, key
    back = rebuilt(after, Change("kernel", 0, -1), spaces, rng)
    for f in fields(before.state):
        assert torch.equal(getattr(before.state, f.name), getattr(back.state, f.name)), f.name


@pytest.mark.parametrize("name", KINDS)
def test_what_survives_keeps_its_moments_and_what_is_new_starts_at_zero(name):
    before, spaces = member(name, "relu")
    after = rebuilt(before, Change("units", 0, 5), spaces, np.random.default_rng(0))
    families = (
        before.algorithm(spaces).parameter_groups(),
        after.algorithm(spaces).parameter_groups(),
    )
    for old, new in zip(*families, strict=True):
        for field in old.moments:
            a, b = getattr(before.state, field), getattr(after.state, field)
            assert float(b.abs().sum()) == pytest.approx(float(a.abs().sum()), rel=1e-5)
            assert int((b != 0).sum()) == int((a != 0).sum())
            assert b.shape[-1] == new.layout.size


@pytest.mark.parametrize("name", KINDS)
def test_units_that_nobody_reads_are_the_first_to_go(name):
    before, spaces = member(name, "relu")
    grown = rebuilt(before, Change("units", 0, 5), spaces, np.random.default_rng(0))
    back = rebuilt(grown, Change("units", 0, -5), spaces, np.random.default_rng(0))
    assert back.config == before.config
    for f in fields(before.state):
        assert torch.equal(getattr(before.state, f.name), getattr(back.state, f.name)), f.name


@pytest.mark.parametrize("name", [k for k in KINDS if "own critic" not in k])
def test_a_layer_taken_away_is_as_if_it_were_linear(name):
    before, spaces = member(name, "relu")
    deeper = rebuilt(before, Change("layer", by=1), spaces, np.random.default_rng(0))
    back = rebuilt(deeper, Change("layer", by=-1), spaces, np.random.default_rng(0))
    old, new = outputs(before, spaces), outputs(back, spaces)
    for key, value in old.items():  # the identity was linear
        torch.testing.assert_close(new[key], value, rtol=1e-4, atol=1e-5)


@pytest.mark.fast_cases(6)
@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("activation", ["relu", "tanh", "silu"])
def test_whatever_is_drawn_stays_within_the_limits_and_can_act(name, activation):
    made, spaces = member(name, activation)
    by = Mutations(units=(4, 24), layers=(2, 4), layer_share=0.5)
    rng, seen = np.random.default_rng(0), set()
    for _ in range(60):
        change = draw_change(made, by, spaces, rng)
        assert change is not None
        seen.add((change.kind, change.by > 0))
        made = rebuilt(made, change, spaces, rng)
        hidden = made.config.network.hidden
        assert 2 <= len(hidden) <= 4
        assert all(4 <= w <= 24 for w in hidden)
        assert all(bool(v.isfinite().all()) for v in outputs(made, spaces).values())
    assert {("units", True), ("units", False)} <= seen
    if activation == "relu" and "own critic" not in name:
        assert {("layer", True), ("layer", False)} <= seen
    assert ("layer", True) not in seen or activation != "tanh"


def test_layer_norm_and_no_layers_are_refused():
    for network in (Network((8,), layer_norm=True), Network(())):
        with pytest.raises(DeclarationError, match=r"Mutations\.architecture"):
            check_architecture(PPO(network=network), Mutations(), "")
    off = Mutations(none=0.4, architecture=0.0)
    check_architecture(PPO(network=Network((8,), layer_norm=True)), off, "")


# Adam


def pushed(algorithm: Any, state: Any, updates: int) -> None:
    """Every parameter's gradient is 1."""
    for f in algorithm.parameter_groups():
        mu, nu = (getattr(state, k) for k in f.moments)
        parts = [x.flatten(1) for x in (getattr(state, f.weights[0]), mu, nu)]
        for _ in range(updates):
            count = getattr(state, f.count)
            adam_(parts[0], torch.ones_like(parts[0]), *parts[1:], count, state.learning_rate)


def steady(name: str) -> tuple[Member, Any]:
    """A member that has felt gradients of 1 for 100,000 steps."""
    made, spaces = member(name, "relu")
    for f in made.algorithm(spaces).parameter_groups():
        for k, value in zip((*f.moments, f.count), (1, 1, 100_000), strict=True):
            getattr(made.state, k).fill_(value)
    return made, spaces


@pytest.mark.parametrize("growth", GROWTH)
@pytest.mark.parametrize("name", KINDS)
def test_what_is_new_moves_as_far_as_a_fresh_network_would(name, growth):
    before, spaces = steady(name)
    grown = rebuilt(before, GROWTH[growth], spaces, np.random.default_rng(0))
    algorithm, then = grown.algorithm(spaces), copy(grown).state
    pushed(algorithm, grown.state, 50)
    for f in algorithm.parameter_groups():
        moved = getattr(then, f.weights[0]) - getattr(grown.state, f.weights[0])
        each = moved / grown.state.learning_rate
        # A gradient that stays the same moves a parameter by the rate at every step.
        torch.testing.assert_close(each, torch.full_like(each, 50.0), rtol=0.01, atol=0.0)
        count = getattr(grown.state, f.count)
        assert set(count.flatten().tolist()) == {50, 100_050}
        assert count.dtype == torch.int64


@pytest.mark.parametrize("name", KINDS)
def test_in_a_stack_every_parameter_keeps_its_age(name):
    before, spaces = steady(name)
    grown = rebuilt(before, GROWTH["units of the last layer"], spaces, np.random.default_rng(0))
    together = [replace(m, state=copy(m).state) for m in (before, grown)]
    algorithm, state = join(together, spaces)
    pushed(algorithm, state, 5)
    split(algorithm, state, together, spaces)
    for mine, alone in zip(together, (before, grown), strict=True):
        pushed(alone.algorithm(spaces), alone.state, 5)
        for f in fields(alone.state):
            torch.testing.assert_close(getattr(mine.state, f.name), getattr(alone.state, f.name))


def test_ages_that_make_no_difference_any_more_are_one():
    before, spaces = steady("dqn")
    grown = rebuilt(before, GROWTH["a layer"], spaces, np.random.default_rng(0))
    assert grown.state.count.shape == grown.state.params.shape
    grown.state.count += 40_000
    split(*join([grown], spaces), [grown], spaces)
    assert grown.state.count.tolist() == [140_000]
