"""The encoder of grids against a dense layer on one-hot cells."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave import PPO, Network
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import register_encoder
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.networks.encoders import (
    CELL_FEATURES,
    CELL_KINDS,
    ONE_HOT_AT_ONCE,
    CellsEncoder,
    sum_of_rows,
)
from skillweave.spaces import obs_codec

GRID = gym.spaces.Box(0, 255, (3, 3, 2), np.uint8)


HIGHEST = np.array([[[1, 4]], [[0, 9]], [[2, 99]]])  # more than 15 count as 15
"""Of each value of three cells, in one column."""


@pytest.mark.parametrize("dtype", [np.bool_, np.uint16, np.uint64, np.int8])
def test_numbers_of_any_type_have_kinds(dtype):
    most = 1 if dtype is np.bool_ else 9
    space = gym.spaces.Box(0, most, (3, 3, 2), dtype)
    assert CellsEncoder(obs_codec(space)).shapes["0.weight"] == (18 * (most + 1), CELL_FEATURES)


@pytest.mark.parametrize("dtype", [np.uint8, np.int64, np.float32])
def test_each_value_has_as_many_vectors_as_its_space_has_kinds(dtype):
    """They are those of a table for sixteen kinds of all values, and learn the same."""
    few = gym.spaces.Box(0, HIGHEST.astype(dtype), dtype=dtype)
    many = gym.spaces.Box(0, 99, HIGHEST.shape, dtype)
    encoders = [CellsEncoder(obs_codec(space)) for space in (few, many)]
    kinds = HIGHEST[:, 0].T.flatten().clip(max=15) + 1  # channels first
    assert [e.shapes["0.weight"] for e in encoders] == [
        (kinds.sum(), CELL_FEATURES),
        (6 * CELL_KINDS, CELL_FEATURES),
    ]
    there = np.flatnonzero(np.arange(CELL_KINDS) < kinds[:, None])

    fresh = [{k: torch.ones(2, *v) for k, v in encoder.shapes.items()} for encoder in encoders]
    for encoder, views in zip(encoders, fresh, strict=True):
        encoder.init_(views, [torch.Generator().manual_seed(i) for i in range(2)])
        assert not views["0.bias"].any()
    assert torch.equal(fresh[0]["0.weight"], fresh[1]["0.weight"][:, there])

    image = torch.randint(0, 99, (2, 7, 2, 3, 1), generator=torch.Generator().manual_seed(0))
    image = image.minimum(torch.from_numpy(HIGHEST).permute(2, 0, 1)).to(
        torch.from_numpy(np.empty(0, dtype)).dtype
    )
    for views in fresh:
        for view in views.values():
            view.requires_grad_()
    features = [
        encoder(views, {"image.0": image}) for encoder, views in zip(encoders, fresh, strict=True)
    ]
    torch.testing.assert_close(*features)
    gradients = [
        torch.autograd.grad(found.square().sum(), views["0.weight"])[0]
        for found, views in zip(features, fresh, strict=True)
    ]
    torch.testing.assert_close(gradients[0], gradients[1][:, there])
    assert gradients[1].any()


def test_a_number_above_the_highest_counts_as_the_highest():
    encoder = CellsEncoder(obs_codec(gym.spaces.Box(0, 3, (3, 3, 2), np.uint8)))
    views = {k: torch.randn(1, *shape) for k, shape in encoder.shapes.items()}
    images = [torch.full((1, 1, 2, 3, 3), kind, dtype=torch.uint8) for kind in (3, 4, 255)]
    found = [encoder(views, {"image.0": image}) for image in images]
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


@pytest.mark.parametrize("dtype", [np.int64, np.float32])
def test_kinds_are_the_same_in_other_types_of_numbers(dtype):
    space = gym.spaces.Box(-99, 99, (3, 3, 2), dtype)
    encoder, bytes_ = CellsEncoder(obs_codec(space)), CellsEncoder(obs_codec(GRID))
    rng = torch.Generator().manual_seed(0)
    views = {k: torch.randn(1, *shape, generator=rng) for k, shape in encoder.shapes.items()}
    kinds = torch.randint(-20, 40, (1, 5, 2, 3, 3), generator=rng)
    found = encoder(views, {"image.0": torch.from_numpy(kinds.numpy().astype(dtype))})
    want = bytes_(views, {"image.0": kinds.clamp(min=0).to(torch.uint8)})
    assert torch.equal(found, want)


@pytest.mark.parametrize("at_once", [1, ONE_HOT_AT_ONCE])
@pytest.mark.parametrize("members", [1, 2])
@pytest.mark.parametrize("batch", [1, 3, 4, 5, 13])
def test_features_and_gradients_are_those_of_a_dense_layer_on_one_hot_cells(
    batch, members, at_once, monkeypatch
):
    # In parts of four rows, or in one.
    monkeypatch.setattr("skillweave.networks.encoders.ONE_HOT_AT_ONCE", at_once)
    monkeypatch.setattr("skillweave.networks.encoders.FEWEST_ONE_HOT_ROWS", 4)
    grids = gym.spaces.Tuple([GRID, gym.spaces.Box(0, 255, (5, 4, 3), np.uint8)])
    encoder, rng = CellsEncoder(obs_codec(grids)), torch.Generator().manual_seed(batch)
    images = {
        "image.0": torch.randint(0, 20, (members, batch, 2, 3, 3), generator=rng).to(torch.uint8),
        "image.1": torch.randint(0, 20, (members, batch, 3, 5, 4), generator=rng).to(torch.uint8),
    }
    views = {
        name: torch.randn(members, *shape, generator=rng).requires_grad_()
        for name, shape in encoder.shapes.items()
    }
    dense = []
    for i, image in enumerate(images.values()):
        kinds = image.flatten(2).long().clamp(max=CELL_KINDS - 1)  # 16 and more are one kind
        one_hot = torch.nn.functional.one_hot(kinds, CELL_KINDS).flatten(2).float()
        dense.append(torch.relu(one_hot @ views[f"{i}.weight"] + views[f"{i}.bias"]))
    features, by_hand = encoder(views, images), torch.cat(dense, -1)
    assert features.shape == (members, batch, encoder.size)
    torch.testing.assert_close(features, by_hand, rtol=1e-4, atol=1e-4)
    grad = torch.randn(members, batch, 2 * CELL_FEATURES, generator=rng)
    found, want = (torch.autograd.grad(x, list(views.values()), grad) for x in (features, by_hand))
    for mine, plain in zip(found, want, strict=True):
        torch.testing.assert_close(mine, plain, rtol=1e-4, atol=1e-4)


def test_a_table_that_learns_on_a_cpu_has_the_fast_gradient():
    table = torch.zeros(1, 8, CELL_FEATURES, requires_grad=True)
    total = sum_of_rows(torch.tensor([[[1, 6]]]), table)
    assert type(total.grad_fn).__name__ == "_SumOfRowsBackward"


def test_on_another_device_nothing_stays_behind():
    encoder = CellsEncoder(obs_codec(GRID))
    views = {k: torch.zeros(1, *v, device="meta") for k, v in encoder.shapes.items()}
    image = torch.zeros(1, 5, 2, 3, 3, dtype=torch.uint8, device="meta")
    found = encoder(views, {"image.0": image})
    assert (found.device.type, found.shape) == ("meta", (1, 5, CELL_FEATURES))


def test_numbers_beside_the_grid_are_features_too():
    space = gym.spaces.Dict({"grid": GRID, "direction": gym.spaces.Discrete(4)})
    algorithm = make_algorithm(
        PPO(network=Network(hidden=(8,), encoder="cells")), space, gym.spaces.Discrete(3)
    )
    assert algorithm.actor_net.encoders["actor.encoder"].size == CELL_FEATURES + 4
    assert algorithm.init([Seeds(0), Seeds(1)]).params.isfinite().all()


def test_an_encoder_of_the_same_name_comes_first(monkeypatch):
    monkeypatch.setattr("skillweave.networks.encoders._REGISTERED", {})
    register_encoder("cells", lambda obs: "mine")
    from skillweave.networks.encoders import make_encoder

    assert make_encoder("cells", obs_codec(GRID)) == "mine"
