"""How many processes a run takes: measured only where it matters, and never for long."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from small_runs import stage_entry

from skillweave.envs import make
from skillweave.envs.make import EnvSpec, workers_for
from skillweave.errors import EnvError
from skillweave.training.stage import assign_workers


class Clock:
    """The time, which goes on only where an environment says so."""

    now = 0.0


class Slow(gym.Env):
    """Steps and resets take as long as they are told to."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    steps = 0

    def __init__(self, first: float, step: float, reset: float):
        self.first, self.each, self.again = first, step, reset

    def reset(self, *, seed=None, options=None):
        Clock.now += self.again
        return np.zeros(1, np.float32), {}

    def step(self, action):
        Clock.now += self.each if Slow.steps else self.first
        Slow.steps += 1
        return np.zeros(1, np.float32), 0.0, self.again > 0.0, False, {}


@pytest.mark.parametrize(
    ("first", "step", "reset", "workers", "most"),
    [
        (1e-6, 1e-6, 0.0, 1, 250),  # fast
        (1e-3, 1e-3, 0.0, 4, 250),
        (2.0, 1e-6, 0.0, 1, 201),  # only its first step is slow
        (3.0, 3.0, 0.0, 4, 5),
        (1e-6, 1e-6, 3.0, 1, 5),  # slow resets are none of a step's time, but take long, too
    ],
)
def test_a_step_is_timed_by_a_few_steps_if_it_is_slow(
    first, step, reset, workers, most, monkeypatch
):
    monkeypatch.setattr(make, "time", SimpleNamespace(perf_counter=lambda: Clock.now))
    monkeypatch.setattr(make, "cores", lambda: 4)
    Clock.now, Slow.steps = 0.0, 0
    assert workers_for(EnvSpec(lambda: Slow(first, step, reset), engine="sync")) == workers
    assert Slow.steps == most


def test_where_every_stage_evolves_nothing_is_measured():
    def never():
        raise AssertionError("an environment was made")

    entries = [stage_entry(name, evolution={}) for name in ("one", "other")]
    assign_workers(entries, EnvSpec(never, engine="sync"))
    assert [e.workers for e in entries] == [1, 1]


def test_a_measured_number_is_lowered_to_one_that_divides_the_environments(monkeypatch):
    monkeypatch.setattr("skillweave.training.stage.workers_for", lambda spec: 4)
    entries = [stage_entry("one", evolution={}), stage_entry("two"), stage_entry("three")]
    for entry, num_envs in zip(entries, (4, 6, 8), strict=True):
        entry.algorithm["num_envs"] = num_envs
    assign_workers(entries, EnvSpec("CartPole-v1"))
    assert [e.workers for e in entries] == [1, 3, 4]


class Unseen(gym.Env):
    """Knows nothing of films."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self):
        pass


class Shown(Unseen):
    """Opens a window unless it is told not to."""

    def __init__(self, render_mode="human"):
        self.mode = render_mode


def test_a_registered_environment_need_not_know_how_it_is_rendered_and_opens_no_window(
    monkeypatch,
):
    monkeypatch.setattr(gym.envs.registration, "registry", dict(gym.registry))
    gym.register("Unseen-v0", Unseen)
    gym.register("Shown-v0", Shown)
    assert isinstance(EnvSpec("Unseen-v0").make().unwrapped, Unseen)
    with pytest.raises(EnvError, match=r"Unseen-v0.*render_mode"):
        EnvSpec("Unseen-v0").make("rgb_array")
    assert EnvSpec("Shown-v0").make().unwrapped.mode is None


class Bare(gym.Env):
    observation_space = action_space = gym.spaces.Discrete(2)


def test_a_function_that_makes_environments_gets_kwargs_and_a_class_must_take_how_to_draw():
    def short(render_mode=None, longest=500):
        return gym.make("CartPole-v1", render_mode=render_mode, max_episode_steps=longest)

    spec = EnvSpec(short, kwargs={"longest": 7})
    for made in (spec.make(), spec.make(render_mode="rgb_array")):
        assert made.spec.max_episode_steps == 7
        made.close()
    with pytest.raises(EnvError, match=r"short could not be made: TypeError.*'longer'"):
        EnvSpec(short, kwargs={"longer": 7}).make()
    with pytest.raises(EnvError, match=r"short could not be made: TypeError.*'longer'"):
        EnvSpec(short, kwargs={"longer": 7}).make(render_mode="rgb_array")
    short.__qualname__ = "with_render_mode"  # Python names the function in its error
    with pytest.raises(EnvError, match=r"could not be made: TypeError.*'longer'"):
        EnvSpec(short, kwargs={"longer": 7}).make(render_mode="rgb_array")
    with pytest.raises(EnvError, match=r"Bare cannot be rendered: .* must take render_mode"):
        EnvSpec(Bare).make(render_mode="rgb_array")
