"""The suites of the protocol: budgets, and what F2 counts."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import lengths
from benchmarks.pay import keys_and_doors, lander_missions, mazes, shuttle
from benchmarks.pay.suite import Seldom
from skillweave import Lengths, Step
from skillweave.envs.make import make_engine
from skillweave.recipes import _cheetah as cheetah


def test_flat_agents_have_as_many_steps_as_the_hierarchy():
    for suite, most, further in (
        (keys_and_doors.suite(), 5_500_000, [750_000] * 6),
        (mazes.suite(), 1_000_000, [200_000] * 4),
    ):
        first, *others = suite.steps()
        assert first <= most
        assert others == further
        assert suite.steps_flat() == [first, *others]
    # On the tour they have all that the hierarchy takes for it.
    missions = lander_missions.suite()
    own, flat = (
        dict(zip([t.name for t in missions.tasks], s, strict=True))
        for s in (missions.steps(), missions.steps_flat())
    )
    assert flat.pop("tour") == own["any"] + own.pop("tour")
    assert flat == own
    assert [t.name for t in missions.headlines] == ["any", "tour"]


def run_to(metres, speed, leg):
    """An observation of the half-cheetah this far beyond the point that it runs to."""
    obs = np.zeros((1, cheetah.LEG.stop), np.float32)
    obs[0, cheetah.X] = cheetah.to_log(np.array([metres]))[0]
    obs[0, cheetah.SPEED], obs[0, cheetah.LEG.start + leg] = speed, 1.0
    return obs


def test_cells_tell_places_apart():
    view = np.arange(2 * 147).reshape(2, 7, 7, 3)
    assert keys_and_doors.cells(view).shape == (2, 147)
    assert len(np.unique(keys_and_doors.cells(np.concatenate([view, view])), axis=0)) == 2
    lander = np.zeros((3, 21), np.float32)
    lander[1, 0], lander[2, 8] = 0.3, 1.0  # elsewhere; on another mission
    assert lander_missions.cells(lander).shape == (3, 16)
    assert len(np.unique(lander_missions.cells(lander), axis=0)) == 3
    ball = np.zeros((4, 6), np.float32)  # a metre wide, for ball and goal
    ball[1, 0], ball[2, 5], ball[3, 2] = 1.5, -0.5, 9.0
    found = [[0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 0, 0]]
    assert mazes.cells(ball).tolist() == found
    # A metre, two metres a second, and a leg.
    runs = [run_to(0.5, 0.5, 0), run_to(-0.5, 3.0, 1), run_to(5.5, -0.5, 2)]
    assert shuttle.cells(np.concatenate(runs)).tolist() == [[0, 0, 0], [-1, 1, 1], [5, -1, 2]]


def test_the_bonus_is_paid_where_the_task_has_a_pool_too():
    pytest.importorskip("envpool")
    task = lander_missions.suite().tasks[0]
    engine = make_engine(task.env, 2)
    obs, no, one = engine.reset(0), np.zeros(2, bool), np.ones(2, np.int64)
    raw = engine.step(np.zeros(2, np.int64))
    step = Step(obs, one, raw.next_obs, raw.reward, no, no, no, one, {})
    # Both landers are one cell's first and second visitor, or each is the first of its own.
    paid = np.sort(Seldom(lander_missions.cells, 7.0).reward(step) - raw.reward)
    assert paid.max() == pytest.approx(7.0)
    assert paid.min() in (pytest.approx(7.0), pytest.approx(7.0 / np.sqrt(2.0)))


def test_the_table_of_lengths_has_medians_and_seeds():
    # The selector is told no length where it chooses it.
    assert lengths.settings("10") == {"call_steps": 10}
    chosen = lengths.settings("chosen")
    assert chosen == {"call_steps": Lengths(5, 10, 25, 50), "interrupt": True}
    rows = lengths.table({"5": [0.5, 0.2, 0.4], "chosen": [1.0]}).splitlines()
    assert rows[1].split() == ["5", "0.40", "0.50", "0.20", "0.40"]
    assert rows[2].split() == ["chosen", "1.00", "1.00"]
