import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from skillweave.buffers.priorities import EPSILON, FAN_OUT, Priorities, SumTrees


def filled(values) -> SumTrees:
    values = np.asarray(values, np.float32)
    trees = SumTrees(*values.shape)
    tree, leaf = np.indices(values.shape).reshape(2, -1)
    trees.put(tree, leaf, values.reshape(-1))
    return trees


def test_fractions_of_the_mass_find_leaves_and_their_values():
    trees = filled([[1, 0, 2, 1], [0, 0, 0, 5]])
    leaf, value = trees.find(np.array([[0.0, 0.25, 0.74, 0.75], [0.0, 0.5, 0.9, 0.99]]))
    assert leaf.tolist() == [[0, 2, 2, 3], [3, 3, 3, 3]]
    assert value.tolist() == [[1, 2, 2, 1], [5, 5, 5, 5]]


@given(
    seed=st.integers(0, 2**32 - 1),
    trees=st.integers(1, 3),
    size=st.sampled_from([1, FAN_OUT, FAN_OUT + 1, 700, FAN_OUT**2 + 3, 5000]),
    dense=st.sampled_from([0.01, 0.5, 1.0]),
)
@settings(max_examples=40, deadline=None)
def test_leaves_are_found_where_the_running_sum_says_and_never_a_zero(seed, trees, size, dense):
    rng = np.random.default_rng(seed)
    values = rng.integers(1, 100, (trees, size)) * (rng.random((trees, size)) < dense)
    values[:, rng.integers(size)] = 7
    tree = filled(rng.random((trees, size)))  # written over
    tree.put(*np.indices(values.shape).reshape(2, -1), values.reshape(-1))
    fraction = rng.random((trees, 50))
    leaf, found = tree.find(fraction)
    running = values.cumsum(1)
    for p in range(trees):
        assert np.array_equal(
            leaf[p], np.searchsorted(running[p], fraction[p] * running[p, -1], side="right")
        )
        assert np.array_equal(found[p], values[p, leaf[p]])
    uneven = filled(values * rng.random((trees, size)) ** 9)
    for fraction in (0.0, 1.0 - 1e-16, 1.0):
        assert (uneven.find(np.full((trees, 1), fraction))[1] > 0).all()


def test_the_last_of_repeated_leaves_counts_up_to_the_root():
    trees = filled([[1.0] * 100])
    trees.put(np.zeros(3, int), np.array([50, 50, 50]), np.array([9.0, 1e6, 99.0]))
    leaf, _ = trees.find(np.array([[49.5, 50.5, 148.5, 149.5]]) / 198)
    assert leaf.tolist() == [[49, 50, 50, 51]]


def test_rebuilding_gives_exactly_the_sums_of_putting():
    rng = np.random.default_rng(0)
    put, written = SumTrees(2, 3000), SumTrees(2, 3000)
    for _ in range(20):
        put.put(rng.integers(2, size=500), rng.integers(3000, size=500), rng.random(500))
    written.leaves[:] = put.leaves
    written.rebuild()
    fraction = rng.random((2, 5000))
    for a, b in zip(put.find(fraction), written.find(fraction), strict=True):
        assert np.array_equal(a, b)
    for a, b in zip(put._levels, written._levels, strict=True):
        assert np.array_equal(a, b)


def test_a_million_leaves_are_few_bytes():
    assert SumTrees(1, 1_000_000).nbytes < 4.4e6


def test_draws_are_stratified():
    priorities = Priorities(1, 100, 1.0)
    priorities.set_new(np.zeros(100, int), np.arange(100), np.ones(100, bool))
    slot, weight = priorities.draw(np.random.default_rng(0).random((1, 100)), 0.4)
    assert slot.tolist() == [list(range(100))]
    assert (weight == 1).all()


def test_weights_by_hand():
    priorities = Priorities(1, 2, 1.0)
    priorities.update(np.zeros(2, int), np.array([0, 1]), np.array([1.0, 3.0], np.float32))
    # P = 1/4, 3/4 and N = 2: (1/2)^-b and (3/2)^-b, over the first
    slot, weight = priorities.draw(np.array([[0.1, 0.9]]), 0.5)
    assert slot.tolist() == [[0, 1]]
    assert weight[0].tolist() == pytest.approx([1.0, (1 / 3) ** 0.5])
    assert weight.dtype == np.float32


def test_no_priority_is_zero():
    priorities = Priorities(1, 2, 1.0)
    priorities.update(np.zeros(2, int), np.array([0, 1]), np.zeros(2, np.float32))
    assert priorities.written(2)["priority"].tolist() == [pytest.approx([EPSILON, EPSILON])]


def test_new_slots_get_their_members_highest_priority_and_others_none():
    priorities = Priorities(2, 3, 0.5)
    priorities.update(np.array([1]), np.array([2]), np.array([9.0], np.float32))
    member, slot = np.array([0, 0, 0, 1, 1]), np.array([0, 1, 0, 0, 2])
    priorities.set_new(member, slot, np.array([False, True, True, True, False]))
    # the last of slots named twice counts; 9^0.5 of member 1
    assert priorities.written(3)["priority"].tolist() == [[1, 1, 0], [3, 0, 0]]
