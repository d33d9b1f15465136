"""Logs of calls, and reports, where skills have goals."""

from __future__ import annotations

import numpy as np
import pytest
from goals.worlds import Rest, declared, go_to, ready, walk

import skillweave as sw
from skillweave.calls import CallLog, join
from skillweave.errors import RunError
from skillweave.repair.repair_stage import rehearsed_obs
from skillweave.skills.goals import goals_of


def two_goals(obs):
    """A selector: to a corner where the point is left, else rest."""
    left = obs[:, 0] < 0
    return np.where(left, "go_to", "rest"), np.full((len(obs), 2), 0.75)


def test_random_calls_have_goals_as_for_practice():
    log = ready().log_calls(600, num_envs=4)
    mine = log.skill == 0
    assert 10 < mine.sum() < len(log)
    goals = log.goals["go_to"]
    assert goals.shape == (len(log), 2)
    assert len(np.unique(goals[mine], axis=0)) == mine.sum()
    assert (np.abs(goals[mine]) <= 1).all()
    near = np.abs(log.end[mine] - goals[mine] % 2).max(1) < 0.15
    np.testing.assert_array_equal(log.succeeded[mine], near)
    assert 0 < near.mean() <= 1


@pytest.mark.parametrize("space", ["number", "dict", "tuple", "bits"])
def test_goals_of_other_kinds(space):
    log = ready(space).log_calls(200, num_envs=2)
    sizes = {"number": 1, "dict": 3, "tuple": 3, "bits": 2}
    assert log.goals["go_to"].shape == (len(log), sizes[space])
    assert log.succeeded[log.skill == 0].any()


def test_a_selector_gives_the_goals(tmp_path):
    run = ready(selector=two_goals)
    log = run.log_calls(300, choose=two_goals, num_envs=2)
    assert (log.goals["go_to"][log.skill == 0] == 0.75).all()
    played = run.evaluate(3, log_calls=True, quiet=True).calls
    assert (played.goals["go_to"][played.skill == 0] == 0.75).all()
    np.testing.assert_array_equal(
        played.succeeded[played.skill == 0],
        np.abs(played.end[played.skill == 0] - 0.75).max(1) < 0.15,
    )
    log.save(tmp_path / "calls.safetensors")
    read = CallLog.load(tmp_path / "calls.safetensors")
    np.testing.assert_array_equal(read.goals["go_to"], log.goals["go_to"])
    both = join([log, read])
    assert len(both.goals["go_to"]) == 2 * len(log)
    assert len(log.of("go_to").goals["go_to"]) == (log.skill == 0).sum()
    with pytest.raises(RunError):
        join([log, ready("bits").log_calls(100, num_envs=2)])


def test_training_logs_goals():
    selector = sw.PPO(num_envs=2, n_steps=16, batch_size=8, update_epochs=1)
    hierarchy = declared([go_to(policy=walk), Rest()], selector=selector)
    run = hierarchy.train(log_calls=400, quiet=True)
    log = run.calls
    mine = log.skill == 0
    near = np.abs(log.end[mine] - log.goals["go_to"][mine] % 2).max(1) < 0.15
    np.testing.assert_array_equal(log.succeeded[mine], near)


@pytest.mark.parametrize("space", ["box", "dict"])
def test_a_skill_with_goals_rehearses_observations_and_goals(space):
    log = ready(space).log_calls(200, num_envs=2)
    skill = go_to(space)
    seen = rehearsed_obs(log, skill, None, "rest", None)
    assert seen is not None
    goals = goals_of(skill)
    assert goals is not None
    assert seen.dtype == goals.join(log.start[:1], goals.start(1)).dtype
    pairs = {
        (*o, *g) for o, g in zip(seen["observation"], goals.space.flat(seen["goal"]), strict=True)
    }
    first = np.flatnonzero((log.skill == 0) & log.succeeded & (log.order == 0))
    assert len(first)
    for call in first:
        assert (*log.start[call], *log.goals["go_to"][call]) in pairs
