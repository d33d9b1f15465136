"""The suite of lander missions: budgets, and what F2 counts."""

import numpy as np
import pytest

from benchmarks.pay.flat import with_bonus
from benchmarks.pay.lander_missions import cells, suite
from skillweave.envs.make import make_engine


def test_a_flat_agent_has_on_every_task_at_least_what_skills_and_selector_have_on_the_first():
    found = suite()
    first, *others = found.steps()
    assert min(found.steps_flat()) >= first
    assert max(others) <= first / 11


def test_cells_tell_places_and_missions_apart():
    obs = np.zeros((3, 21), np.float32)
    obs[1, 0], obs[2, 8] = 0.3, 1.0
    assert cells(obs).shape == (3, 16)
    assert len(np.unique(cells(obs), axis=0)) == 3


def test_the_bonus_is_paid_where_the_task_has_a_pool_too():
    pytest.importorskip("envpool")
    task = suite().tasks[0]
    spec = with_bonus(task.env, cells, 7.0)
    engine = make_engine(spec, 2)
    engine.reset(0)
    assert engine.step(np.zeros(2, np.int64)).reward.max() >= 7.0
