"""The figures of the protocol by hand: interquartile means, intervals, steps until solved."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.pay.statistics import first_solved, interval, mean_of_all, solved_over_steps


def test_the_mean_is_that_of_the_middle_half_of_all_tasks_and_seeds():
    # Of 0 to 7 the middle half is 2, 3, 4, 5.
    assert mean_of_all([[0, 7, 2, 5], [4, 3, 6, 1]]) == pytest.approx(3.5)
    # An outlier does not count.
    assert mean_of_all([[0, 7000, 2, 5], [4, 3, 6, 1]]) == pytest.approx(3.5)


def test_intervals_by_hand():
    assert interval([[3.0] * 5]) == (3.0, 3.0)
    # Seeds are drawn within their task. Half of every sample is 0 and half is 1, whatever is
    # drawn: were they drawn from all, the interval would be wide.
    assert interval([[0.0] * 5, [1.0] * 5]) == (0.5, 0.5)
    low, high = interval([[0.0] * 5 + [1.0] * 5])
    assert low < 0.2
    assert high > 0.8
    # Samples of (0, 4): both 0, one each (2, twice as often), both 4. The quartiles of these
    # 1 : 2 : 1 are between 0 and 2, and between 2 and 4; 90 % of the samples reach the ends.
    assert interval([[0.0, 4.0]], level=0.9) == (0.0, 4.0)
    assert interval([[0.0, 4.0]], level=0.4) == (2.0, 2.0)
    scores = [list(np.random.default_rng(0).normal(size=5))]
    assert interval(scores) == interval(scores)  # whenever it is asked


def test_the_first_score_at_the_bar_counts():
    curve = [(100, 0.2), (200, 0.8), (300, 0.5), (400, 0.9)]
    assert first_solved(curve, 0.8) == 200
    assert first_solved(curve, 0.95) is None


def test_tasks_are_learnt_one_after_another_and_what_is_not_solved_costs_its_budget():
    curves = [[(100, 0.5), (200, 1.0)], [(100, 0.1)], [(50, 1.0), (100, 1.0)]]
    line = solved_over_steps(curves, [1.0, 1.0, 1.0], [300, 100, 100])
    assert line.tolist() == [[0, 0], [200, 1], [350, 2]]
