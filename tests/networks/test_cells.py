"""The encoder of grids against a dense layer on one-hot cells."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave import PPO, Network, SkillweaveError, register_encoder
from skillweave.algorithms.policy import make_algorithm
from skillweave.networks.cells import KINDS, WIDTH, CellsEncoder
from skillweave.seeding import Seeds
from skillweave.spaces import obs_codec

GRID = gym.spaces.Box(0, 255, (3, 3, 2), np.uint8)


def test_features_are_those_of_a_dense_layer_on_one_hot_cells():
    encoder, members, batch = CellsEncoder(obs_codec(GRID)), 2, 5
    rng = torch.Generator().manual_seed(0)
    views = {
        name: torch.randn(members, *shape, generator=rng) for name, shape in encoder.shapes.items()
    }
    image = torch.randint(0, 20, (members, batch, 2, 3, 3), generator=rng).to(torch.uint8)
    found = encoder(views, {"image.0": image})
    kinds = image.flatten(2).long().clamp(max=KINDS - 1)  # 16 and more are one kind
    one_hot = torch.nn.functional.one_hot(kinds, KINDS).flatten(2).float()
    want = torch.relu(one_hot @ views["0.weight"] + views["0.bias"])
    assert found.shape == (members, batch, WIDTH) == (members, batch, encoder.size)
    torch.testing.assert_close(found, want, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", [np.int64, np.float32])
def test_kinds_are_the_same_in_other_types_of_numbers(dtype):
    space = gym.spaces.Box(-99, 99, (3, 3, 2), dtype)
    encoder, bytes_ = CellsEncoder(obs_codec(space)), CellsEncoder(obs_codec(GRID))
    rng = torch.Generator().manual_seed(0)
    views = {k: torch.randn(1, *shape, generator=rng) for k, shape in encoder.shapes.items()}
    kinds = torch.randint(-20, 40, (1, 5, 2, 3, 3), generator=rng)
    found = encoder(views, {"image.0": kinds.to(torch.from_numpy(np.zeros(1, dtype)).dtype)})
    want = bytes_(views, {"image.0": kinds.clamp(min=0).to(torch.uint8)})
    assert torch.equal(found, want)


@pytest.mark.parametrize("members", [1, 2])
@pytest.mark.parametrize("batch", [1, 3, 4, 5, 13])
def test_gradients_are_those_of_a_dense_layer_on_one_hot_cells(batch, members, monkeypatch):
    encoder = CellsEncoder(obs_codec(GRID))
    # Four rows at once.
    monkeypatch.setattr("skillweave.networks.cells.AT_ONCE", 4 * members * 18 * KINDS)
    rng = torch.Generator().manual_seed(batch)
    weight = torch.randn(members, *encoder.shapes["0.weight"], generator=rng).requires_grad_()
    bias = torch.randn(members, 1, WIDTH, generator=rng).requires_grad_()
    image = torch.randint(0, 20, (members, batch, 2, 3, 3), generator=rng).to(torch.uint8)
    one_hot = torch.nn.functional.one_hot(image.flatten(2).long().clamp(max=KINDS - 1), KINDS)
    grad = torch.randn(members, batch, WIDTH, generator=rng)
    found, want = (
        torch.autograd.grad(features, (weight, bias), grad)
        for features in (
            encoder({"0.weight": weight, "0.bias": bias}, {"image.0": image}),
            torch.relu(one_hot.flatten(2).float() @ weight + bias),
        )
    )
    for mine, plain in zip(found, want, strict=True):
        torch.testing.assert_close(mine, plain, rtol=1e-4, atol=1e-4)


def test_numbers_beside_the_grid_are_features_too():
    space = gym.spaces.Dict({"grid": GRID, "direction": gym.spaces.Discrete(4)})
    algorithm = make_algorithm(
        PPO(network=Network(hidden=(8,), encoder="cells")), space, gym.spaces.Discrete(3)
    )
    assert algorithm.actor_net.encoders["actor.encoder"].size == WIDTH + 4
    assert algorithm.init([Seeds(0), Seeds(1)]).params.isfinite().all()


def test_observations_without_a_grid_are_refused():
    with pytest.raises(SkillweaveError, match="reads images of whole numbers"):
        CellsEncoder(obs_codec(gym.spaces.Box(-1, 1, (3,), np.float32)))


def test_an_encoder_of_the_same_name_comes_first(monkeypatch):
    monkeypatch.setattr("skillweave.networks.encoders._REGISTERED", {})
    register_encoder("cells", lambda obs: "mine")
    from skillweave.networks.encoders import make_encoder

    assert make_encoder("cells", obs_codec(GRID)) == "mine"
