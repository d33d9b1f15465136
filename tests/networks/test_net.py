"""Whole networks: values of actions, dueling and noisy; and networks with a memory."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, Tuple
from torch.nn import functional as F
from toys import drawn

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.algorithms.config import (
    DQN,
    PPO,
    SAC,
    TD3,
    config_from_json,
    config_to_json,
)
from skillweave.algorithms.registry import make_algorithm
from skillweave.errors import DeclarationError
from skillweave.networks.config import CNN, RNN, Network
from skillweave.networks.net import Net, seen_places
from skillweave.networks.qnet import QNet
from skillweave.networks.stacked import Layout
from skillweave.spaces import obs_codec

P, B, A = 2, 4, 3
OBS = obs_codec(Box(-1, 1, (5,)))


def made(net, *args) -> tuple[Layout, torch.Tensor]:
    layout, flat = drawn(net, P, *args)
    flat += 0.1 * torch.randn(flat.shape, generator=torch.Generator().manual_seed(9))
    return layout, flat


def inputs() -> dict[str, torch.Tensor]:
    return {"vector": torch.randn(P, B, 5, generator=torch.Generator().manual_seed(3))}


def linear(views, name: str, m: int, x: torch.Tensor) -> torch.Tensor:
    return F.linear(x, views[f"{name}.weight"][m].T, views[f"{name}.bias"][m, 0])


@pytest.mark.parametrize("atoms", [1, 7])
def test_dueling_streams_are_joined_by_the_formula(atoms):
    net = QNet(OBS, Network((8, 6), "relu"), A, atoms=atoms, dueling=True)
    layout, flat = made(net)
    views = layout.views(flat)
    q = net(views, inputs())
    assert q.shape == (P, B, A, atoms)
    for m in range(P):
        x = linear(views, "q.0", m, inputs()["vector"][m]).relu()
        value, advantage = (
            linear(views, f"{name}.1", m, linear(views, f"{name}.0", m, x).relu())
            for name in ("value", "advantage")
        )
        advantage = advantage.view(B, A, atoms)
        expected = value[:, None] + advantage - advantage.sum(1, keepdim=True) / A
        torch.testing.assert_close(q[m], expected)
    assert views["value.1.bias"].shape == (P, 1, atoms)


@pytest.mark.parametrize("hidden", [(), (8,)])
def test_dueling_needs_no_trunk(hidden):
    net = QNet(OBS, Network(hidden), A, dueling=True)
    layout, flat = made(net)
    q, views = net(layout.views(flat), inputs()), layout.views(flat)
    assert q.shape == (P, B, A, 1)
    views["value.0.bias" if not hidden else "value.1.bias"] += 1.0
    torch.testing.assert_close(net(views, inputs()), q + 1.0)


def noisy_net() -> tuple[QNet, Layout, torch.Tensor]:
    net = QNet(OBS, Network((8,), "relu"), A, noisy=True)
    return net, *made(net)


def test_noisy_weights_are_means_and_scaled_factorised_noise():
    net, layout, flat = noisy_net()
    views = layout.views(flat)
    assert net.noise_size == (5 + 8) + (8 + A)
    noise = torch.randn(P, net.noise_size, generator=torch.Generator().manual_seed(4))
    found = net.perturbed(views, noise)

    def f(x: float) -> float:
        return (1 if x > 0 else -1) * abs(x) ** 0.5

    for m in range(P):
        at = 0
        for layer, (n_in, n_out) in (("q.0", (5, 8)), ("q.1", (8, A))):
            own = [f(x) for x in noise[m, at : at + n_in + n_out].tolist()]
            at += n_in + n_out
            weight, bias = views[f"{layer}.weight"][m], views[f"{layer}.bias"][m, 0]
            spread = views[f"{layer}.weight_sigma"][m], views[f"{layer}.bias_sigma"][m, 0]
            eps = torch.tensor(own[:n_in])[:, None] * torch.tensor(own[n_in:])[None]
            torch.testing.assert_close(found[f"{layer}.weight"][m], weight + spread[0] * eps)
            torch.testing.assert_close(
                found[f"{layer}.bias"][m, 0], bias + spread[1] * torch.tensor(own[n_in:])
            )

    still = net.perturbed(views, torch.zeros(P, net.noise_size))  # the means act
    assert torch.equal(net(still, inputs()), net(views, inputs()))
    plain = {k: v for k, v in views.items() if "sigma" not in k}
    assert torch.equal(net(plain, inputs()), net(views, inputs()))


def test_noisy_weights_start_as_published_and_learn_their_deviation():
    net = QNet(OBS, Network((8,), "relu"), A, noisy=True)
    layout = Layout(net.shapes)
    flat = torch.zeros(P, layout.size)
    net.init_(layout.views(flat), [torch.Generator().manual_seed(m) for m in range(P)])
    views = layout.views(flat)
    for layer, n_in in (("q.0", 5), ("q.1", 8)):
        for kind in ("weight", "bias"):
            mean = views[f"{layer}.{kind}"]
            assert mean.abs().max() <= n_in**-0.5
            assert mean.std() > 0.3 * n_in**-0.5
            assert torch.allclose(views[f"{layer}.{kind}_sigma"], torch.tensor(0.5 * n_in**-0.5))
    leaves = layout.leaves(flat)
    noise = torch.randn(P, net.noise_size, generator=torch.Generator().manual_seed(4))
    net(net.perturbed(leaves, noise), inputs()).sum().backward()
    assert all(leaf.grad.any() for leaf in leaves.values())


def test_a_network_with_memory_computes_steps_as_a_sequence():
    net = Net("net", OBS, Network((8,), rnn=RNN("lstm", 6)), 2)
    layout, flat = made(net, 1.0)
    views, steps = layout.views(flat), 5
    g = torch.Generator().manual_seed(3)
    x = {"vector": torch.randn(P, steps, B, 5, generator=g)}
    memory = torch.randn(P, B, net.memory_size, generator=g)
    start = torch.rand(P, steps, B, generator=g) < 0.3
    out, after = net.sequence(views, x, memory, start)
    assert (out.shape, after.shape) == ((P, steps, B, 2), (P, steps, B, 12))
    for t in range(steps):
        memory = memory.masked_fill(start[:, t, :, None], 0.0)
        now, memory = net.step(views, {"vector": x["vector"][:, t]}, memory)
        torch.testing.assert_close(now, out[:, t])
        torch.testing.assert_close(memory, after[:, t])
        for m in range(P):
            torch.testing.assert_close(now[m], linear(views, "net.head", m, memory[m, :, :6]))


ALGORITHMS = {
    "ppo": (PPO(network=Network((8,), sees=(3, 1))), Discrete(3)),
    "recurrent ppo": (PPO(network=Network((8,), rnn=RNN("gru", 6), sees=(3, 1))), Discrete(3)),
    "dqn": (DQN(network=Network((8,), sees=(3, 1))), Discrete(3)),
    "td3": (TD3(network=Network((8,), sees=(3, 1))), Box(-1, 1, (2,))),
    "sac": (SAC(network=Network((8,), sees=(3, 1))), Box(-1, 1, (2,))),
}


def test_a_network_is_given_the_numbers_that_it_sees_in_their_order():
    net = Net("pi", OBS, Network((8,), sees=(3, 1)), A)
    layout, flat = made(net, 1.0)
    views, x = layout.views(flat), inputs()["vector"]
    small = Net("pi", obs_codec(Box(-1, 1, (2,))), Network((8,)), A)
    assert net.shapes == small.shapes
    assert torch.equal(net(views, {"vector": x}), small(views, {"vector": x[..., [3, 1]]}))


@pytest.mark.parametrize("kind", ALGORITHMS)
def test_what_is_not_seen_changes_no_action(kind):
    config, actions = ALGORITHMS[kind]
    algorithm = make_algorithm(config, Box(-1, 1, (5,)), actions)
    state = algorithm.init([Seeds(0)])
    state.params.normal_(generator=torch.Generator().manual_seed(1))
    policy = AgentPolicy.of(algorithm, state)
    rng = np.random.default_rng(0)
    obs = rng.uniform(-1, 1, (64, 5)).astype(np.float32)
    other = obs.copy()
    other[:, [0, 2, 4]] = rng.uniform(-1, 1, (64, 3))
    before, _ = policy.act(policy.start(64), obs)
    after, _ = policy.act(policy.start(64), other)
    np.testing.assert_array_equal(before, after)
    other[:, 3] = -obs[:, 3]
    assert (policy.act(policy.start(64), other)[0] != before).any()


ROBOT = Dict(
    {
        "arm": Dict({"grip": Discrete(3), "joints": Box(-1, 1, (2, 2))}),
        "camera": Box(0, 255, (12, 12, 3), np.uint8),
        "speed": Box(-1, 1, (2,)),
    }
)
"""Grip 0 to 2, joints 3 to 6, speed 7 and 8 of the flat vector."""


@pytest.mark.parametrize(
    ("sees", "places"),
    [
        ("speed", (7, 8)),
        (("speed", "arm.grip"), (7, 8, 0, 1, 2)),
        (("arm", 8), (0, 1, 2, 3, 4, 5, 6, 8)),
        (slice(1, 4), (1, 2, 3)),
        (range(8, 2, -3), (8, 5)),
        (np.array([4, 1]), (4, 1)),
        ([2, "speed"], (2, 7, 8)),
        (5, (5,)),
    ],
)
def test_a_network_sees_places_slices_and_keys(sees, places):
    network = Network((8,), sees=sees)
    assert seen_places(network, obs_codec(ROBOT)) == places
    assert network == Network((8,), sees=network.sees)
    config = PPO(network=network)
    assert config_from_json(json.loads(json.dumps(config_to_json(config)))) == config
    net = Net("pi", obs_codec(ROBOT), network, A)
    by_place = Net("pi", obs_codec(ROBOT), Network((8,), sees=places), A)
    layout, flat = made(net, 1.0)
    x = {"vector": torch.randn(P, 7, 9), "image.0": torch.zeros(P, 7, 3, 12, 12, dtype=torch.uint8)}
    assert torch.equal(net(layout.views(flat), x), by_place(layout.views(flat), x))


def test_parts_of_a_tuple_have_their_places_as_keys():
    space = Tuple((Box(-1, 1, (2,)), Discrete(3)))
    assert seen_places(Network(sees=("1", 0)), obs_codec(space)) == (2, 3, 4, 0)


@pytest.mark.parametrize(
    ("sees", "space", "says"),
    [
        (
            "leg",
            ROBOT,
            r"names 'leg', a part of the observation that does not exist.*arm\.joints.*speed",
        ),
        ("arm.joint", ROBOT, r"names 'arm.joint', a part .*does not exist.*'?arm\.joints"),
        ("camera", ROBOT, "names 'camera', an image, and images are always seen: leave it out"),
        (("arm", 3), ROBOT, "names a number twice"),
        ((9,), ROBOT, r"names the number 9 of an observation, but it has 9 \(0 to 8\)"),
        ("speed", Box(-1, 1, (3,)), r"names 'speed'.*does not exist; it has no parts"),
        ((3, 1), Box(0, 255, (12, 12, 3), np.uint8), "3 .* has no number beside its images"),
    ],
)
def test_parts_that_are_not_there_are_named(sees, space, says):
    with pytest.raises(DeclarationError, match=says):
        make_algorithm(PPO(network=Network(sees=sees)), space, Discrete(2))


def test_images_are_seen_beside_the_numbers():
    both = Dict({"camera": Box(0, 255, (12, 12, 3), np.uint8), "speed": Box(-1, 1, (5,))})
    cnn = CNN("plain", (4,), (3,), (2,))
    shapes = Net("pi", obs_codec(both), Network((8,), cnn=cnn, sees=(2,)), A).shapes
    alone = Net("pi", obs_codec(both["camera"]), Network((8,), cnn=cnn), A).shapes
    assert shapes["pi.0.weight"][0] == alone["pi.0.weight"][0] + 1
