"""Observations in float64 whose numbers networks, which compute in float32, cannot take."""

import re

import gymnasium as gym
import numpy as np
import pytest
from timed import SMALL, Timed

import skillweave as sw
from skillweave.errors import EnvError


class Clock(Timed):
    """Shows how late it is, as numbers of some size."""

    def __init__(self, first: float, dtype, parts: bool) -> None:
        most = np.inf if np.dtype(dtype).kind == "f" else np.iinfo(dtype).max
        low = 0 if np.dtype(dtype).kind == "u" else -most
        box = gym.spaces.Box(low, most, (2,), dtype)
        self.observation_space = gym.spaces.Dict(own=box) if parts else box
        self.first, self.dtype, self.parts = first, dtype, parts

    def show(self):
        obs = np.array([self.first + self.t, self.t], self.dtype)
        return {"own": obs} if self.parts else obs


def train(first, dtype, parts, quiet=True):
    spec = sw.EnvSpec(lambda: Clock(first, dtype, parts), workers=1)
    return sw.train_agent(spec, SMALL, 256, quiet=quiet)


@pytest.mark.parametrize("parts", [False, True], ids=["box", "dict"])
def test_numbers_beyond_float32_are_refused(parts):
    with pytest.raises(EnvError, match=r"1 of 2 numbers.*larger than 3.4e\+38.*float32"):
        train(1e300, np.float64, parts)


@pytest.mark.parametrize("parts", [False, True], ids=["box", "dict"])
@pytest.mark.parametrize("dtype", [np.float64, np.int64, np.uint32])
def test_numbers_that_float32_cannot_tell_apart_are_said_once(parts, dtype, capsys):
    seconds = 1.7e9  # since 1970
    train(seconds, dtype, parts, quiet=False)
    said = capsys.readouterr().err
    assert re.search(rf"1,700,000,\d\d\d, in {np.dtype(dtype)}.* 128 apart", said)
    assert said.count("128 apart") == 1
