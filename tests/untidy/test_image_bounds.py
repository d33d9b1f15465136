"""Images whose values do not fit their bounds are said once, as networks scale by the bounds."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from timed import Timed

import skillweave as sw

SMALL = sw.PPO(num_envs=2, n_steps=64, batch_size=64, update_epochs=1, network=sw.Network((4,)))


class Camera(Timed):
    """Shows random pictures whose values lie between two numbers."""

    length = 40

    def __init__(self, bounds, values, dtype=np.float32, part=False):
        self.values, self.dtype, self.part = values, dtype, part
        image = gym.spaces.Box(*bounds, (8, 8, 3), dtype)
        speed = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = gym.spaces.Dict(eye=image, speed=speed) if part else image

    def show(self):
        image = self.np_random.uniform(*self.values, (8, 8, 3)).astype(self.dtype)
        return {"eye": image, "speed": np.zeros(2, np.float32)} if self.part else image


def train(*how, quiet=False, workers=1, **more):
    def camera():
        return Camera(*how, **more)

    spec = sw.EnvSpec(camera, engine="sync", workers=workers)
    return sw.train_agent(spec, SMALL, 256, quiet=quiet, eval_every=128, eval_episodes=2)


SAID = {  # bounds, values, and what is said
    "bytes where 1 is the largest": ((0, 1), (0, 255), "from 0 to 1, but values of 200 and more"),
    "signed where 0 is the least": ((0, 1), (-1, 1), "from 0 to 1, but values of -0.9 and less"),
    "bytes where -1 is the least": ((-1, 1), (0, 255), "from -1 to 1, but values of 200 and more"),
    "floats where 255 is the largest": ((0, 255), (0, 1), "had values from 0 to 1 alone"),
    "signed floats where 255 is": ((0, 255), (-1, 1), "had values from -1 to 1 alone"),
    "divided twice": ((0, 1), (0, 1 / 255), "its first 64 observations had values from 0 to 0.004"),
}
MORE = {"whole numbers": ((0, 255), (0, 2), "had values from 0 to 1 alone")}


@pytest.mark.parametrize("case", [*SAID, *MORE])
def test_values_that_do_not_fit_the_bounds_are_said_once(case, capsys):
    bounds, values, says = (SAID | MORE)[case]
    train(bounds, values, dtype=np.uint8 if case in MORE else np.float32)
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("camera: the observation is an image with bounds") == 1
    assert says in said
    assert "Let observation_space have the bounds" in said


def test_a_part_of_an_observation_is_named_and_processes_say_it_once(capsys):
    train((0, 1), (0, 255), workers=2, part=True)
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("camera: the observation (eye) is an image with bounds") == 1


def test_an_evaluation_says_it_as_a_warning():
    policy = sw.from_function(lambda obs: np.zeros(len(obs), int))
    with pytest.warns(UserWarning, match="is an image with bounds from 0 to 1, but values of"):
        sw.evaluate(policy, lambda: Camera((0, 1), (0, 255)), episodes=2)


FITS = {
    "exactly": ((0, 1), (0, 1)),
    "a little beyond": ((0, 1), (-0.1, 1.2)),
    "a third of it": ((0, 255), (0, 80)),
    "one value": ((0, 255), (0, 0)),
}


@pytest.mark.parametrize(("bounds", "values"), FITS.values(), ids=FITS)
def test_values_that_fit_are_silent(bounds, values):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(bounds, values, quiet=True)
