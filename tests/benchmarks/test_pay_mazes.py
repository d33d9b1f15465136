"""The suite of mazes: budgets, and what F2 counts."""

import numpy as np

from benchmarks import lengths
from benchmarks.pay.mazes import cells, suite
from skillweave import Lengths


def test_skills_and_selector_have_a_million_steps_and_each_further_maze_200_000():
    first, *others = suite().steps()
    assert first <= 1_000_000
    assert others == [200_000] * 4
    assert suite().steps_flat()[0] == first


def test_cells_are_a_metre_wide_for_ball_and_goal():
    obs = np.zeros((4, 6), np.float32)
    obs[1, 0], obs[2, 5], obs[3, 2] = 1.5, -0.5, 9.0
    assert cells(obs).tolist() == [[0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 0, 0]]


def test_the_selector_is_told_no_length_where_it_chooses_it():
    assert lengths.settings("10") == {"call_steps": 10}
    chosen = lengths.settings("chosen")
    assert chosen == {"call_steps": Lengths(5, 10, 25, 50), "interrupt": True}


def test_the_table_of_lengths_has_medians_and_seeds():
    rows = lengths.table({"5": [0.5, 0.2, 0.4], "chosen": [1.0]}).splitlines()
    assert rows[1].split() == ["5", "0.40", "0.50", "0.20", "0.40"]
    assert rows[2].split() == ["chosen", "1.00", "1.00"]
