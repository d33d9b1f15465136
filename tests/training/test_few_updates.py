"""Budgets with few updates: they are named, and a skill that acts seldom gets more steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw


class Draw(gym.Env[Any, Any]):
    """Observations are drawn anew in each step."""

    observation_space = gym.spaces.Box(0, 1, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.steps = 0
        return np.float32([self.np_random.random()]), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return np.float32([self.np_random.random()]), 0.0, False, self.steps >= 100, {}


class Rare(sw.Skill):
    max_steps = 1

    def initiation(self, obs: Any) -> Any:
        return obs[:, 0] > 0.9

    def reward(self, step: sw.Step) -> Any:
        return step.action[:, 0] > 0.3


class Wait(sw.Skill):
    def policy(self, obs: Any) -> Any:
        return np.zeros((len(obs), 1))


def rare(steps: int) -> sw.Hierarchy:
    return sw.Hierarchy(
        sw.EnvSpec(Draw, check_seed=False, workers=1),
        [Rare(), Wait()],
        selector=lambda obs: np.where(obs[:, 0] > 0.9, "rare", "wait"),
        algorithm=sw.PPO(num_envs=4, n_steps=16, network=sw.Network((8,))),
        learn="apart",
        steps=steps,
        call_steps=1,
    )


def test_a_skill_that_acts_seldom_gets_more_steps_and_goes_on_to_the_bit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = rare(960).train(tmp_path / "whole", seed=0, checkpoint_every=64)
    said = capsys.readouterr().err
    assert "it takes up to" in said
    stage = whole.info()["stages"][0]
    assert 960 < stage["steps"] <= 4 * 960 + 64
    assert stage["extended"] <= 4 * 960
    seen: list[Any] = []

    def interrupt(event: Any) -> None:
        seen.append(event)
        if event.steps > 1_200:
            raise KeyboardInterrupt

    how: Any = {"seed": 0, "quiet": True, "checkpoint_every": 64}
    with pytest.raises(KeyboardInterrupt):
        rare(960).train(tmp_path / "stopped", callback=interrupt, **how)
    again = rare(960).train(tmp_path / "stopped", resume=True, **how)
    assert again.info()["stages"][0]["steps"] == stage["steps"]
    weights = [run.policy.skills.policies[0].weights for run in (whole, again)]
    for name, value in weights[0].items():
        np.testing.assert_array_equal(value.numpy(), weights[1][name].numpy())
    more = rare(1_920).train(tmp_path / "stopped", resume=True, seed=0)
    had = stage["extended"]
    assert f"rare continues: {had:,} -> {had + 960:,} steps" in capsys.readouterr().err
    stage = more.info()["stages"][0]
    assert had + 960 <= stage["steps"] < had + 960 + 64
    assert "extended" not in stage


def test_an_agent_with_a_small_budget_is_told_which_number_to_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ppo = sw.PPO(num_envs=4, n_steps=32, network=sw.Network((8,)))
    sw.train_agent("CartPole-v1", ppo, 300, tmp_path / "few", seed=0)
    said = capsys.readouterr().err
    assert "updated 3 times only" in said
    assert "n_steps" in said
    sw.train_agent("CartPole-v1", ppo, 1_400, tmp_path / "enough", seed=0)
    assert "updated" not in capsys.readouterr().err
