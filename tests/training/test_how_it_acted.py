"""What is told of each who learns together with others: how much it acted, and its reward."""

from __future__ import annotations

import numpy as np

from skillweave.experience import Experience
from skillweave.training.woven_learner import how_it_acted
from skillweave.types import Array


def rows(valid: Array | None = None, steps: Array | None = None) -> Experience:
    """Three rows of two columns, with the rewards 0 to 5."""
    shape, never = (3, 2), np.zeros((3, 2), bool)
    obs = np.zeros((*shape, 1), np.float32)
    reward = np.arange(6, dtype=np.float32).reshape(shape)
    steps = np.ones(shape, np.int64) if steps is None else steps
    return Experience(obs, np.zeros(shape), reward, steps, never, never, obs, valid=valid)


def told(name: str, experience: Experience) -> dict[str, float]:
    return {k: float(v) for k, v in how_it_acted(name, experience).items()}


def test_of_a_skill_how_much_it_acted_and_its_own_reward_there() -> None:
    valid = np.array([[True, False], [False, True], [False, False]])
    assert told("inner/left", rows(valid)) == {"usage": np.float32(2 / 6), "reward": 1.5}
    assert told("left", rows(np.zeros((3, 2), bool))) == {"usage": 0.0}


def test_of_a_selector_how_long_its_calls_were() -> None:
    steps = np.array([[1, 5], [9, 9], [9, 9]])
    valid = np.array([[True, True], [False, False], [False, False]])
    assert told("selector", rows(valid, steps)) == {"call_length": 3.0}
    assert told("inner/selector", rows(None, steps)) == {"call_length": 7.0}
    assert told("selector", rows(np.zeros((3, 2), bool), steps)) == {}


def test_of_a_critic_nothing() -> None:
    assert told("skill_critic", rows()) == {}
