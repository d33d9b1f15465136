"""Runs that are shared: what the tests of sharing declare, and how they compare."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from declaring import declare as small

import skillweave as sw

NAME = "ada/cart"
SMALL = sw.PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=1, network=sw.Network((8,)))


class Left(sw.Skill):
    max_steps = 10

    def reward(self, step):
        return -step.next_obs[:, 0]

    def success(self, step):
        return step.next_obs[:, 0] < 0


class Right(sw.Skill):
    max_steps = 10


def declare(*skills: sw.Skill) -> sw.Hierarchy:
    how = {"learn": "apart", "skill_steps": 100, "selector_steps": 100, "checkpoint_every": 10**5}
    return small(*skills, call_steps=5, algorithm=SMALL, selector=SMALL, **how)


def files_of(path: Path) -> dict[str, bytes]:
    """A run's files as they are on the hub."""
    names = ("run.json", "metrics.jsonl", "evaluation.json")
    found = {name: (path / name).read_bytes() for name in names if (path / name).exists()}
    return found | {f"policies/{p.name}": p.read_bytes() for p in (path / "policies").iterdir()}


def same_actions(a: sw.Run, b: sw.Run) -> bool:
    obs = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)
    acts = [run.policy.act(run.policy.start(200), obs)[0] for run in (a, b)]
    return bool((acts[0] == acts[1]).all())
