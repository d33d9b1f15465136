"""Calls that end by themselves in the last step of an episode are done wherever they count."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave.types import Array, Step


class TenSteps(gym.Env):
    """Ten steps, then the episode ends: by termination, or by its time limit."""

    observation_space = gym.spaces.Box(-1, 11, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, terminates: bool) -> None:
        self.terminates = terminates

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        over = self.t == 10
        ends = over and self.terminates, over and not self.terminates
        return np.array([self.t], np.float32), float(over), *ends, {}


class First(sw.Skill):
    def policy(self, obs: Array) -> Array:
        return np.zeros(len(obs), int)

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, 0] >= 5


class Last(First):
    def termination(self, step: Step) -> Array:
        return step.next_obs[:, 0] >= 10


@pytest.mark.parametrize("terminates", [True, False])
def test_a_call_that_ends_by_itself_with_the_episode_is_done(
    terminates: bool, tmp_path: Path
) -> None:
    hierarchy = sw.Hierarchy(
        lambda: TenSteps(terminates),
        [First(), Last()],
        call_steps=None,
        selector=lambda obs: np.where(obs[:, 0] < 5, "first", "last"),
    )
    run = hierarchy.train(tmp_path / "run", quiet=True)
    for report in (
        run.evaluate(4, quiet=True).skills["last"],
        run.evaluate(4, skill="last", quiet=True).skills["last"],
    ):
        assert (report.ended["own"], report.ended["episode"], report.own_with_episode) == (4, 0, 4)
    # An evaluation's step limit is an end of the episode, too.
    cut = run.evaluate(4, max_steps=5, quiet=True)
    assert (cut.cut, cut.skills["first"].own_with_episode) == (4, 4)
    log = run.log_calls(1_000)
    last = log.of("last")
    assert (last.terminated if terminates else last.truncated).all()
    assert not last.was_cut.any()
    matrix = log.hand_over()
    assert matrix.of("last", after="first")[0] == matrix.of("last", after="start")[0] == 1.0
    ends = log.call_ends("last")
    assert (ends.reasons["own"], ends.own_with_episode, ends.succeeded) == (len(last),) * 2 + (1.0,)
    assert log.blame("last", "first").fine
