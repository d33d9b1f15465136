"""Critics of a policy that was given learn alone until their values settle."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import skillweave as sw
from skillweave.training.replay_learner import LOOK, CriticsFirst


def steps_until_over(values) -> int:
    first = CriticsFirst(10 * LOOK)
    for count, value in enumerate(values, 1):
        first = CriticsFirst.of(first.tensor())  # as a checkpoint has it
        first.see(value)
        if first.left <= 0:
            return count
    raise AssertionError("it never ends")


def test_they_learn_alone_until_their_values_settle_or_their_share_is_spent() -> None:
    falling = (-1.0 - k // LOOK for k in range(100 * LOOK))  # each look finds another value
    assert steps_until_over(falling) == 10 * LOOK
    settled = (-min(3.0, 1.0 + k // LOOK) for k in range(100 * LOOK))  # the fourth look: still -3
    assert steps_until_over(settled) == 4 * LOOK


@pytest.mark.parametrize("kind", [sw.SAC, sw.TD3])
def test_an_actor_that_was_given_waits_for_its_critics(kind, tmp_path) -> None:
    config = kind(num_envs=2, learning_starts=64, batch_size=16, network=sw.Network((16,)))
    first = sw.train_agent("Pendulum-v1", config, 300, tmp_path / "a", seed=0, quiet=True)
    how = {"start_from": first, "seed": 1, "quiet": True}
    stopped = {"callback": stop_at(100), "checkpoint_every": 50}
    short = sw.train_agent("Pendulum-v1", config, 800, tmp_path / "b", **stopped, **how)
    again = sw.train_agent("Pendulum-v1", config, 800, tmp_path / "c", **how)
    before, waits, moves = (run.policy.weights for run in (first, short, again))
    actor = [name for name in before if name.startswith("actor.")]
    assert actor
    assert all(torch.equal(before[name], waits[name]) for name in actor)
    assert any(not torch.equal(before[name], moves[name]) for name in actor)
    for name in ("obs_mean", "obs_var"):
        np.testing.assert_array_equal(before[name].numpy(), moves[name].numpy())


def stop_at(steps):
    return lambda event: event.steps < steps
