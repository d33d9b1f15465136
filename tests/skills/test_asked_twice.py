"""Methods of skills are functions of their arguments; one that keeps a state is named."""

from __future__ import annotations

import random

import numpy as np
import pytest

from skillweave.errors import DeclarationError, SkillError
from skillweave.skills import Reflex, Skill, call_method
from skillweave.types import Step


def step(n: int = 4) -> Step:
    obs = np.arange(n, dtype=np.float32)[:, None]
    never = np.zeros(n, bool)
    one = np.ones(n)
    return Step(obs, one, obs + 1, one, never, never, never, one, {})


class Counts(Skill):
    calls = 0

    def reward(self, step):
        self.calls += 1
        return step.reward * self.calls


class Progress(Skill):
    """Pays what the best value so far grows by: nothing, when it sees the same again."""

    best = -np.inf

    def reward(self, step):
        gain = np.maximum(step.next_obs[:, 0] - max(self.best, -1.0), 0.0)
        self.best = max(self.best, float(step.next_obs.max()))
        return gain


class Patient(Skill):
    """Stops at the second time."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def termination(self, step):
        self.seen.append(len(step.reward))
        return np.full(len(step.reward), len(self.seen) > 1)


class Shy(Skill):
    waits = 3

    def initiation(self, obs):
        self.waits -= 1
        return np.full(len(obs), self.waits < 2)


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        (Counts, "reward"),
        (Progress, "reward"),
        (Patient, "termination"),
        (Shy, "initiation"),
    ],
)
def test_a_skill_that_answers_otherwise_when_asked_twice_is_named(kind, method):
    about = step().obs if method == "initiation" else step()
    message = rf"skill '{kind.name}': {method}\(\) answers .* keeps a state of its own.*info"
    with pytest.raises(SkillError, match=message):
        call_method(kind(), method, about)


class Noisy(Skill):
    """Pays random numbers, of every kind of generator."""

    def __init__(self):
        super().__init__()
        self.numbers = np.random.default_rng(0)
        self.python = random.Random(0)

    def reward(self, step):
        n = len(step.reward)
        return (
            self.numbers.random(n)
            + np.random.rand(n)  # noqa: NPY002
            + random.random()
            + self.python.random()
        )


def test_random_rewards_are_no_state():
    skill, twin = Noisy(), Noisy()
    np.random.seed(1)  # noqa: NPY002
    random.seed(1)
    first = call_method(skill, "reward", step())
    after = np.random.rand(), random.random()  # noqa: NPY002
    np.random.seed(1)  # noqa: NPY002
    random.seed(1)
    assert first.tolist() == twin.reward(step()).astype(np.float32).tolist()
    assert after == (np.random.rand(), random.random()), "the checks draw no numbers of their own"  # noqa: NPY002
    assert len(call_method(skill, "reward", step())) == 4


def test_a_reflex_that_keeps_a_state_is_named():
    seen = []

    def second_time(obs):
        seen.append(1)
        return np.full(len(obs), len(seen) > 1)

    with pytest.raises(SkillError, match=r"reflex 'second_time': condition\(\) answers 0, and 1"):
        Reflex(second_time, 0).holds(step().obs)


def test_a_reward_that_is_meant_to_change_says_so():
    class Bonus(Counts):
        reward_changes = True

    class Wrong(Counts):
        reward_changes = "yes"

    assert call_method(Bonus(), "reward", step()).tolist() == [1] * 4
    with pytest.raises(DeclarationError, match="reward_changes is 'yes'; it must be True or False"):
        Wrong().validate()
