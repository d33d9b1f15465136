import numpy as np
import pytest
import torch
from hypothesis import assume, given, strategies as st

from skillweave._internal.seeding import Seeds

paths = st.lists(st.one_of(st.text(max_size=8), st.integers(0, 2**20)), max_size=4)


def at(root, path) -> Seeds:
    node = Seeds(root)
    for name in path:
        node = node / name
    return node


def draws(node: Seeds):
    uniform = torch.rand(4, generator=node.torch())
    return [*node.numpy().random(4), *uniform.tolist(), node.integer(), *node.integers(3)]


@given(st.integers(0, 2**64), paths)
def test_the_same_path_gives_the_same_streams(root, path):
    assert draws(at(root, path)) == draws(at(root, path))


@given(st.integers(0, 2**64), paths, paths)
def test_different_paths_give_different_streams(root, one, other):
    assume(one != other)
    first, second = at(root, one), at(root, other)
    assert not np.array_equal(first.numpy().random(4), second.numpy().random(4))
    assert not torch.equal(
        torch.rand(4, generator=first.torch()), torch.rand(4, generator=second.torch())
    )


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (Seeds(1) / "landing", Seeds(2) / "landing"),
        (Seeds(7) / 5, Seeds(7) / "5"),  # a number is not the text that spells it
        (Seeds(7) / "a" / "b", Seeds(7) / "b" / "a"),
    ],
)
def test_other_roots_names_and_orders_give_other_streams(one, other):
    assert draws(one) != draws(other)


@given(st.integers(0, 2**64), paths)
def test_integers_fit_in_31_bits_and_differ(root, path):
    node = at(root, path)
    found = [node.integer(), *node.integers(500)]
    assert all(0 <= s < 2**31 for s in found)
    assert len(set(found)) >= 500


def test_no_global_generator_is_touched():
    np_state, torch_state = np.random.get_state()[1].copy(), torch.random.get_rng_state()  # noqa: NPY002
    draws(Seeds(3) / "x")
    assert np.array_equal(np.random.get_state()[1], np_state)  # noqa: NPY002
    assert torch.equal(torch.random.get_rng_state(), torch_state)


def test_streams_are_the_same_in_every_version():
    """A saved run resumes only if these never change; so they are written down."""
    node = Seeds(7) / "landing" / 17
    assert node.integer() == 2105931619
    assert node.numpy().integers(2**31, size=2).tolist() == [1592081194, 723317168]
