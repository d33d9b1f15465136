"""An environment is made once for its spaces to be read, however many learn in it."""

from __future__ import annotations

import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave.envs.make import EnvSpec


class Stay(sw.Skill):
    def policy(self, obs: Any) -> Any:
        return np.zeros(len(obs), int)


class Learns(sw.Skill):
    max_steps = 5


PPO = sw.PPO(num_envs=2, n_steps=8, batch_size=16)


@pytest.mark.parametrize("learn", ["together", "apart"])
def test_a_hierarchy_reads_the_spaces_of_its_environment_once(tmp_path: Any, learn: Any) -> None:
    reads = 0

    def make() -> Any:
        nonlocal reads
        frame: Any = sys._getframe()
        names = set()
        while frame is not None:
            names.add(frame.f_code.co_name)
            frame = frame.f_back
        # Engines, their checks and evaluations make the environments that they step.
        reads += not names & {"make_engine", "check_used", "evaluate", "workers_for"}
        return gym.make("CartPole-v1")

    guide = sw.Guide(lambda obs: np.zeros(len(obs), int), restrict=False, target_kl=1.0)
    hierarchy = sw.Hierarchy(
        make, [Stay(), Learns()], steps=64, learn=learn, algorithm=PPO, selector=PPO, guide=guide
    )
    hierarchy.train(tmp_path / "run", quiet=True)
    assert reads == 1
    hierarchy.train(tmp_path / "again", quiet=True)
    assert reads == 2, "an environment may have changed since the run before"


def test_a_spec_keeps_its_spaces_and_sends_them_nowhere() -> None:
    spec = EnvSpec("CartPole-v1")
    assert spec.spaces is spec.spaces
    assert spec == EnvSpec("CartPole-v1")
    assert spec.__getstate__()["_spaces"] is None
