"""The suite of keys and doors: budgets, and what F2 counts."""

import numpy as np

from benchmarks.pay.keys_and_doors import cells, suite


def test_each_task_has_less_than_two_million_steps_and_flat_agents_as_many():
    first, *others = suite().steps()
    assert others == [750_000] * 6
    assert suite().steps_flat() == [first, *others]


def test_cells_are_all_that_is_in_view():
    obs = np.arange(2 * 147).reshape(2, 7, 7, 3)
    assert cells(obs).shape == (2, 147)
    assert len(np.unique(cells(np.concatenate([obs, obs])), axis=0)) == 2
