"""What a checkpoint says of open calls, by hand."""

import gymnasium as gym
import numpy as np
import pytest

from skillweave.experience.restored import check_numbers, opened
from skillweave.policies.core import CallEnd

SPACE = gym.spaces.Discrete(5, start=1)
SEEN = np.array([1, 4, 5])


def kept(tau, prefix=""):
    return {f"{prefix}tau": np.array(tau), f"{prefix}open": np.array(tau) > 0}


@pytest.mark.parametrize("prefix", ["", "inner/", "inner/deepest/"])
def test_only_where_a_call_is_open_is_an_observation_looked_at(prefix):
    written = {f"{prefix}obs": np.array([2, 0, 3])}  # nothing was written for the second
    found = opened(written, kept([4, 0, 1], prefix), SEEN, SPACE, {})
    assert found[f"{prefix}obs"].tolist() == [2, 0, 3]
    with pytest.raises(ValueError, match="a choice that does not exist"):
        opened(written, kept([4, 1, 1], prefix), SEEN, SPACE, {})


def test_what_a_diverged_member_decided_by_is_nought_and_infinity_is_refused():
    head = np.array([[1, np.nan], [0, 2]], np.float32)
    assert opened({"dist_params": head}, {}, SEEN[:2], SPACE, {})["dist_params"].tolist() == [
        [1, 0],
        [0, 2],
    ]
    head[0, 1] = np.inf
    with pytest.raises(ValueError, match="'dist_params' of open calls is not finite"):
        opened({"dist_params": head}, {}, SEEN[:2], SPACE, {})


@pytest.mark.parametrize(
    ("name", "value", "refused"),
    [
        ("action", 2, False),
        ("action", 3, True),
        ("action", -1, True),
        ("tau", 2**31 - 1, False),
        ("tau", 2**31, True),
        ("tau", -2, True),
        ("calls_left", -1, False),  # it is to be drawn
        ("reward", 1e9, False),
        ("reward", np.nan, True),
        ("player.0.own", np.nan, False),  # a user's
        ("player.guide.own", np.inf, False),
        ("starters.0.own", -(2**40), False),
    ],
)
def test_own_numbers_have_ranges_and_a_users_may_be_anything(name, value, refused):
    own = {"action": np.zeros(2, np.int64), name: np.array([0, value])}
    if not refused:
        check_numbers(own, {"action": range(3)})
        return
    with pytest.raises(ValueError, match=repr(name)):
        check_numbers(own, {"action": range(3)})


@pytest.mark.parametrize("player", ["player", "starters"])
def test_where_a_call_is_open_a_skill_runs(player):
    end = np.int8([CallEnd.RUNNING, CallEnd.OWN])
    both = {f"{player}.end": end, f"{player}.skill": np.array([1, -1])}
    check_numbers(both, {})
    both[f"{player}.end"] = end[::-1]
    with pytest.raises(ValueError, match="no skill runs"):
        check_numbers(both, {})
