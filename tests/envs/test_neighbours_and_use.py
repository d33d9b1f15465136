"""Environments that change each other, or keep something between episodes, are noticed once."""

import itertools
import time

import gymnasium as gym
import numpy as np
import pytest
from small_runs import ON

import skillweave as sw
from skillweave._internal.notices import collected_notices
from skillweave.envs.make import make_engine
from skillweave.envs.repeats import FIRST_STEPS, LAST_STEPS

WORLD = {"place": np.zeros(1)}
"""A client of a simulator that all environments of the process use."""


class Alone(gym.Env):
    """Walks on a line."""

    observation_space = gym.spaces.Box(-99, 99, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    length = 9

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        self.begin()
        return self.see(), {}

    def step(self, action):
        self.t += 1
        self.go(1 if action else -1)
        return self.see(), self.pay(), False, self.t >= self.length, {}

    def begin(self):
        self.place = self.np_random.uniform(-1, 1)

    def go(self, by):
        self.place += by

    def pay(self):
        return float(self.place)

    def see(self):
        return np.array([self.place], np.float32)


class Global(Alone):
    def begin(self):
        WORLD["place"] = self.np_random.uniform(-1, 1, 1)

    def go(self, by):
        WORLD["place"] = WORLD["place"] + by

    def pay(self):
        return float(WORLD["place"][0])

    def see(self):
        return WORLD["place"].astype(np.float32)


class OfClass(Alone):
    """Counts its steps in the class, and shows them."""

    count = 0

    def begin(self):
        super().begin()
        OfClass.count = 0

    def go(self, by):
        OfClass.count += 1
        self.place = OfClass.count


class Visited(Alone):
    """Pays for new places, which it keeps in a list of the class."""

    seen: list[int] = []  # noqa: RUF012

    def begin(self):
        self.place = 0
        self.seen.clear()

    def pay(self):
        new = self.place not in self.seen
        self.seen.append(self.place)
        return float(new)


class OneGenerator(Alone):
    def begin(self):
        super().begin()
        OneGenerator.rng = np.random.default_rng(0)

    def go(self, by):
        self.place += OneGenerator.rng.normal()


class Simulator:
    places: dict[int, float] = {}  # noqa: RUF012

    def __init__(self):
        self.places[0] = 0.0


class Client(Alone):
    """Uses the default client in place of its own."""

    sim = Simulator()

    def begin(self):
        self.sim.places[0] = 0.0

    def go(self, by):
        self.sim.places[0] += by
        self.place = self.sim.places[0]

    def see(self):
        return np.array([self.sim.places[0]], np.float32)


class Own(Global):
    """A world of its own, though its class has one."""

    def begin(self):
        self.world = dict(WORLD)
        self.place = self.np_random.uniform(-1, 1)

    go, pay, see = Alone.go, Alone.pay, Alone.see


class Cached(Alone):
    """Shares what it has computed, which changes nothing but the time."""

    known: dict[int, float] = {}  # noqa: RUF012

    def go(self, by):
        self.place += self.known.setdefault(by, float(by))


class Draws(Alone):
    def go(self, by):
        self.place += np.random.normal()  # noqa: NPY002


class Clock(Alone):
    def see(self):
        return np.array([time.monotonic() % 10], np.float32)


class Ticks(Alone):
    """A clock that is the same for a while."""

    def see(self):
        return np.array([self.place + int(time.monotonic() * 200) % 2], np.float32)


class Numbered(Alone):
    """Has a number of its own."""

    numbers = itertools.count()

    def __init__(self):
        self.number = next(self.numbers)

    def see(self):
        return np.array([self.place + self.number], np.float32)


class Short(Alone):
    length = 1


class Counter(Alone):
    """Gets harder with its steps."""

    hard = 100

    def __init__(self):
        self.total = 0

    def go(self, by):
        self.total += 1
        self.place += by * (2 if self.total > self.hard else 1)


class Soon(Counter):
    hard = 20


class Levels(Alone):
    """Gets harder with its episodes."""

    length = 3

    def __init__(self):
        self.level = 0

    def begin(self):
        super().begin()
        self.level = min(self.level + 0.5, 5)

    def pay(self):
        return int(self.level > 4)


class Lazy(Alone):
    """Makes its world at the first reset, always the same."""

    world = None

    def begin(self):
        super().begin()
        if self.world is None:
            self.world = np.arange(3)


class Random(Alone):
    """Is another one each time it is made."""

    def __init__(self):
        self.width = np.random.default_rng().uniform()

    def go(self, by):
        self.place += by * self.width


class Seen(Alone):
    """Tells in its info alone how many episodes it has played."""

    episodes = 0

    def begin(self):
        super().begin()
        self.episodes += 1

    def step(self, action):
        *step, _ = super().step(action)
        return *step, {"episode": self.episodes}


SHARED, KEPT = "its environments change each other", "acts otherwise than a new one"
STRAY = {Draws: "draws from", Clock: "two resets", Ticks: "two resets"}
FINE = (Alone, Own, Cached, Draws, Clock, Ticks, Numbered, Short, Lazy, Random, Seen)


def said_of(spec):
    with collected_notices() as notices:
        engine = make_engine(spec, 2)
        engine.trains = True
        engine.reset(0)
        for t in range(300):
            raw = engine.step(np.full(2, t % 2))
            if len(over := np.flatnonzero(raw.terminated | raw.truncated)):
                engine.reset_some(over)
        engine.finish()
        engine.close()
        return notices.take()


@pytest.mark.parametrize("env", [Global, OfClass, Visited, OneGenerator, Client])
def test_environments_that_share_a_world_are_said_to(env):
    said = said_of(sw.EnvSpec(env))
    assert len([s for s in said if SHARED in s]) == 1


@pytest.mark.parametrize("env", [Counter, Soon, Levels])
def test_what_an_environment_keeps_from_episode_to_episode_is_said(env):
    said = said_of(sw.EnvSpec(env))
    assert [s for s in said if "two resets" not in s and KEPT not in s] == []
    assert len([s for s in said if KEPT in s]) == 1


@pytest.mark.parametrize("env", FINE)
def test_others_are_not_blamed(env):
    said = said_of(sw.EnvSpec(env))
    assert [s for s in said if SHARED in s or KEPT in s] == []
    assert all(env in STRAY and STRAY[env] in s for s in said)
    assert len(said) == (env in STRAY) or env is Ticks


@pytest.mark.parametrize("env", [Global, Counter])
@pytest.mark.parametrize("workers", [1, 2])
def test_a_training_says_it_once(env, workers, tmp_path, capsys):
    small = sw.PPO(num_envs=4, n_steps=128, batch_size=64, update_epochs=1)
    spec = sw.EnvSpec(env, workers=workers)
    sw.train_agent(spec, small, 512, tmp_path / "run", seed=0)
    said = capsys.readouterr().err
    assert (said.count(SHARED), said.count(KEPT)) == ((1, 0) if env is Global else (0, 1))
    sw.train_agent(
        sw.EnvSpec(env, workers=workers, check_seed=False), small, 512, tmp_path / "quiet"
    )
    said = capsys.readouterr().err
    assert SHARED not in said
    assert KEPT not in said


def test_no_step_of_a_check_is_counted_or_changes_what_is_learnt(tmp_path):
    def weights(check):
        spec = sw.EnvSpec("CartPole-v1", engine="sync", workers=1, check_seed=check)
        run = sw.train_agent(spec, ON, 256, tmp_path / str(check), seed=3, quiet=True)
        return run.policy.weights, run.info()["stages"][0]["steps"]

    (one, steps), (other, other_steps) = weights(True), weights(False)
    assert steps == other_steps
    assert all((one[name] == other[name]).all() for name in one)


def test_the_checks_are_short_and_make_one_environment_at_a_time():
    count = {"open": 0, "most": 0, "steps": 0, "resets": 0}

    class One(Alone):
        def __init__(self):
            count["open"] += 1
            count["most"] = max(count["most"], count["open"])

        def begin(self):
            super().begin()
            count["resets"] += 1

        def go(self, by):
            super().go(by)
            count["steps"] += 1

        def close(self):
            count["open"] -= 1

    with collected_notices():
        engine = make_engine(sw.EnvSpec(One), 1)
        engine.trains = True
        engine.reset(0)
        assert (count["steps"], count["resets"]) == (2 * FIRST_STEPS, 3)
        engine.finish()
        assert count["steps"] == 2 * FIRST_STEPS + 3 * LAST_STEPS
        engine.close()
    assert (count["most"], count["open"]) == (1, 0)
