from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict
from torch import nn
from torch.nn import functional as F
from toys import Echo, drawn, learn

from skillweave.algorithms import register_encoder
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.algorithms.config import DQN, PPO
from skillweave.errors import SkillweaveError
from skillweave.networks import encoders
from skillweave.networks.config import CNN, Network
from skillweave.networks.encoders import ImageEncoder
from skillweave.networks.net import Net
from skillweave.networks.stacked import ACTIVATIONS, Layout
from skillweave.spaces import ObsCodec, obs_codec

P, B = 3, 4
PLAIN = CNN("plain", (5, 7), (3, 2), (2, 1))
IMPALA = CNN.impala((4, 6))


def image_space(height: int = 12, width: int = 10, channels: int = 3) -> Box:
    return Box(0, 255, (height, width, channels), np.uint8)


def plain(views, m: int, x: torch.Tensor, activation) -> torch.Tensor:
    for i, stride in enumerate(PLAIN.strides):
        x = activation(F.conv2d(x, views[f"{i}.weight"][m], views[f"{i}.bias"][m], stride))
    return x.flatten(1)


def impala(views, m: int, x: torch.Tensor, activation) -> torch.Tensor:
    """Espeholt et al. 2018, fig. 3, right."""

    def conv(name: str, x: torch.Tensor) -> torch.Tensor:
        return F.conv2d(x, views[f"{name}.weight"][m], views[f"{name}.bias"][m], padding=1)

    for stage in range(2):
        x = nn.MaxPool2d(3, 2, padding=1)(conv(f"{stage}.in", x))
        for block in range(2):
            y = conv(f"{stage}.{block}.0", activation(x.clone()))
            x = x + conv(f"{stage}.{block}.1", activation(y))
    return activation(x).flatten(1)


@pytest.mark.parametrize("activation", ["relu", "tanh", "gelu"])
@pytest.mark.parametrize(("cnn", "reference"), [(PLAIN, plain), (IMPALA, impala)])
def test_a_stack_computes_and_learns_what_plain_torch_networks_do(
    cnn, reference, activation, monkeypatch
):
    # In double precision: sums are in another order, and processors round them otherwise.
    pixels = ObsCodec.pixels
    monkeypatch.setattr(ObsCodec, "pixels", lambda *of: pixels(*of).double())
    obs = obs_codec(image_space())
    encoder = ImageEncoder(obs, 0, cnn, activation)
    layout, flat = drawn(encoder, P)
    g = torch.Generator().manual_seed(9)
    flat += 0.1 * torch.randn(flat.shape, generator=g)
    flat = flat.double()
    image = torch.randint(256, (P, B, 3, 12, 10), generator=g).to(torch.uint8)
    leaves = layout.leaves(flat)
    features = encoder(leaves, {"image.0": image})
    assert features.shape == (P, B, encoder.size)
    mix = torch.randn(features.shape, generator=g)
    grad = layout.gradient((features * mix).sum((1, 2)), leaves)
    for m in range(P):
        own = layout.leaves(flat)
        expected = reference(own, m, (image[m].float() / 255).double(), ACTIVATIONS[activation])
        torch.testing.assert_close(features[m], expected, rtol=1e-4, atol=1e-5)
        alone = layout.gradient((expected * mix[m]).sum(), own)
        torch.testing.assert_close(grad[m], alone[m], rtol=1e-3, atol=1e-5)
        alone = encoder(layout.views(flat[m : m + 1]), {"image.0": image[m : m + 1]})
        torch.testing.assert_close(alone[0], features[m], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("cnn", [PLAIN, IMPALA])
def test_filters_are_orthogonal_and_of_each_members_own(cnn):
    encoder = ImageEncoder(obs_codec(image_space()), 0, cnn, "relu")
    layout, flat = drawn(encoder, P)
    for m in range(P):
        alone = torch.zeros(1, layout.size)
        encoder.init_(layout.views(alone), [torch.Generator().manual_seed(m)])
        assert torch.equal(alone[0], flat[m])
    for name, view in layout.views(flat).items():
        if name.endswith("bias"):
            assert not view.any()
            continue
        for weight in view.flatten(2):
            gram = weight @ weight.T
            torch.testing.assert_close(gram, 2.0 * torch.eye(len(gram)), rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("height", "width", "chosen", "size"),
    [
        (10, 10, CNN.small(), 16 * 8 * 8),
        (35, 84, CNN.small(), 16 * 33 * 82),
        (36, 36, CNN(), 64 * 1 * 1),
        (84, 84, CNN(), 64 * 7 * 7),
    ],
)
def test_the_usual_network_depends_on_the_size(height, width, chosen, size):
    encoder = ImageEncoder(obs_codec(image_space(height, width, 1)), 0, None, "relu")
    assert encoder.cnn == chosen
    assert encoder.size == size


def test_images_and_vectors_of_a_dict_are_joined():
    space = Dict(a=image_space(8, 8), b=image_space(6, 6, 1), c=Box(-1, 1, (3,), np.float32))
    obs = obs_codec(space)
    net = Net("net", obs, Network((), cnn=CNN.small()), 2)
    sizes = [16 * 6 * 6, 16 * 4 * 4]
    assert net.shapes["net.0.weight"] == (3 + sum(sizes), 2)
    layout = Layout(net.shapes)
    flat = torch.zeros(1, layout.size)
    net.init_(layout.views(flat), 1.0, [torch.Generator().manual_seed(0)])
    inputs = {
        "vector": torch.randn(1, B, 3),
        "image.0": torch.randint(256, (1, B, 3, 8, 8)).to(torch.uint8),
        "image.1": torch.randint(256, (1, B, 1, 6, 6)).to(torch.uint8),
    }
    out, views = net(layout.views(flat), inputs), layout.views(flat)
    for changed in inputs:
        others = {k: torch.zeros_like(v) if k == changed else v for k, v in inputs.items()}
        assert (net(views, others) - out).abs().max() > 1e-4


# Custom encoders


class Halves:
    """The means of an image's halves, scaled by a parameter."""

    def __init__(self, obs: ObsCodec) -> None:
        self._obs = obs
        self.size, self.shapes = 2, {"gain.weight": (2, 2), "shift": (2,)}

    def init_(self, views, generators) -> None:
        for member, generator in enumerate(generators):
            views["gain.weight"][member].normal_(generator=generator)
        views["shift"].zero_()

    def __call__(self, views, inputs) -> torch.Tensor:
        x = self._obs.pixels(inputs["image.0"], 0)
        half = x.shape[-1] // 2
        means = torch.stack([x[..., :half].mean((2, 3, 4)), x[..., half:].mean((2, 3, 4))], -1)
        return means @ views["gain.weight"] + views["shift"][:, None]


@pytest.fixture
def _halves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoders, "_REGISTERED", {})
    register_encoder("halves", Halves)


ENDS = {
    "ppo": (PPO(num_envs=8, n_steps=16, batch_size=32, learning_rate=1e-2, gamma=0.5), 3072),
    "dqn": (DQN(num_envs=8, batch_size=32, learning_starts=64, buffer_size=999, gamma=0.5,
                tau=0.05, learning_rate=1e-2), 800),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.usefixtures("_halves")
@pytest.mark.parametrize("name", ENDS)
def test_a_registered_encoder_learns_saves_and_loads(name):
    config, budget = ENDS[name]
    config = replace(config, network=Network((32,), encoder="halves"))
    env = Echo(8, "image, channels last")
    algorithm, state = learn(config, env, budget)
    policy, shown = AgentPolicy.of(algorithm, state), np.arange(4)
    action, _ = policy.act({}, env.show(shown))
    assert env.error(shown, action).mean() == 0.0
    loaded = AgentPolicy.from_file(*policy.to_file(), "agent")
    assert np.array_equal(loaded.act({}, env.show(shown))[0], action)
    assert any(k.endswith("encoder.gain.weight") for k in policy.weights)
    encoders._REGISTERED.clear()
    with pytest.raises(SkillweaveError, match=r"Network\.encoder is 'halves', which is"):
        AgentPolicy.from_file(*policy.to_file(), "agent")


@pytest.mark.usefixtures("_halves")
def test_noisy_weights_leave_a_custom_encoder_alone():
    env = Echo(8, "image, channels last")
    config = DQN.rainbow(num_envs=8, buffer_size=999, network=Network((8,), encoder="halves"))
    learn(config, env, 100)
