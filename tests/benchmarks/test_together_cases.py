"""The cases of ``benchmarks.together``: all are declared, and flat agents are what they claim."""

import numpy as np
import pytest

from benchmarks.pay.flat import Flat
from benchmarks.together import CASES, TASKS, one
from examples.bridge import GetAxe, River
from skillweave import Hierarchy, Step


@pytest.mark.parametrize("case", CASES)
def test_every_case_has_the_steps_that_are_asked(case: str) -> None:
    learner = CASES[case](TASKS["bridge"], 10_000)
    steps = learner.total_steps if isinstance(learner, Hierarchy) else learner.steps
    assert 9_990 <= steps <= 10_000


def step_of(before: np.ndarray, after: np.ndarray, reward: float) -> Step:
    no, one = np.zeros(1, bool), np.ones(1, np.int64)
    return Step(before[None], one, after[None], np.array([reward]), no, no, no, one, {})


def test_skill_rewards_are_the_tasks_and_the_weighted_sum_of_the_skills() -> None:
    learner = CASES["skill rewards x 0.1"](TASKS["bridge"], 100)
    assert isinstance(learner, Flat)
    assert learner.learns is not None
    before, _ = River().reset(seed=0)
    after = before.copy()
    after[2] = 1  # the axe
    step = step_of(before, after, reward=0.25)
    # Each of the four skills pays 0.02 for the step, and GetAxe gets 1.
    assert learner.learns.reward(step) == pytest.approx(0.25 + 0.1 * (1.0 - 4 * 0.02))
    assert GetAxe().reward(step) == pytest.approx(0.98)


@pytest.mark.parametrize("case", ["flat", "bonus", "skill rewards x 1.0"])
def test_flat_agents_are_scored_by_the_task(case: str) -> None:
    found = one(case, "bridge", 2_000, "auto", f4=True, seed=0)
    assert found["solved"] <= 0.05
    assert found["usage"] == {}
    assert 2_000 <= found["steps"] <= 3_024
    assert "f4" not in found


def test_skills_are_scored_without_their_selector() -> None:
    found = one("together", "bridge", 4_000, "auto", f4=True, seed=0)
    assert list(found["f4"]) == ["by lot", "get_axe", "chop", "build", "cross"]
    assert found["f4"]["get_axe"] == 0.0
    assert all(0.0 <= share <= 1.0 for share in found["f4"].values())
