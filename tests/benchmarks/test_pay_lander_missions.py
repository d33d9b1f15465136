"""The suite of lander missions: budgets, and what F2 counts."""

import numpy as np
import pytest

from benchmarks.pay.lander_missions import cells, suite
from benchmarks.pay.suite import Seldom
from skillweave import Step
from skillweave.envs.make import make_engine


def test_flat_agents_have_on_the_tour_all_that_the_hierarchy_takes_for_it():
    found = suite()
    own, flat = (dict(zip([t.name for t in found.tasks], s, strict=True))
                 for s in (found.steps(), found.steps_flat()))  # fmt: skip
    assert flat.pop("tour") == own["any"] + own.pop("tour")
    assert flat == own
    assert [t.name for t in found.headlines] == ["any", "tour"]


def test_cells_tell_places_and_missions_apart():
    obs = np.zeros((3, 21), np.float32)
    obs[1, 0], obs[2, 8] = 0.3, 1.0
    assert cells(obs).shape == (3, 16)
    assert len(np.unique(cells(obs), axis=0)) == 3


def test_the_bonus_is_paid_where_the_task_has_a_pool_too():
    pytest.importorskip("envpool")
    task = suite().tasks[0]
    engine = make_engine(task.env, 2)
    obs, no, one = engine.reset(0), np.zeros(2, bool), np.ones(2, np.int64)
    raw = engine.step(np.zeros(2, np.int64))
    step = Step(obs, one, raw.next_obs, raw.reward, no, no, no, one, {})
    # Both landers are one cell's first and second visitor, or each is the first of its own.
    paid = np.sort(Seldom(cells, 7.0).reward(step) - raw.reward)
    assert paid.max() == pytest.approx(7.0)
    assert paid.min() in (pytest.approx(7.0), pytest.approx(7.0 / np.sqrt(2.0)))
