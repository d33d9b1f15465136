"""What environments return is looked at: a wrong answer is told with its number and its step."""

import gymnasium as gym
import numpy as np
import pytest

from skillweave.envs.checked import CheckedEnv, Watch, time_limit
from skillweave.envs.engine import RawStep
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import EnvError

BOX = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
GOOD = np.zeros(2, np.float32), 1.0, False, False, {}


class Scripted(gym.Env):
    """Returns what it is told to: for the first two steps what is right, then ``answer``."""

    observation_space = BOX
    action_space = gym.spaces.Discrete(2)
    answer = GOOD

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return GOOD[0], {}

    def step(self, action):
        self.t += 1
        return GOOD if self.t < 3 else self.answer


def but(**changes):
    names = "obs", "reward", "terminated", "truncated", "info"
    return tuple({**dict(zip(names, GOOD, strict=True)), **changes}.values())


def scripted(answer, **attributes):
    return type("Scripted", (Scripted,), {"answer": answer, **attributes})


def third_step(env):
    engine = make_engine(EnvSpec(env), 2)
    try:
        engine.reset(0)
        for _ in range(3):
            raw = engine.step(np.zeros(2, np.int64))
    finally:
        engine.close()
    return raw


WRONG = {
    "nothing": (None, "step.. returned a NoneType"),
    "a complex reward": (but(reward=1 + 2j), r"reward is \(1\+2j\); it must be a number"),
    "a NaN as reward": (but(reward=np.nan), "its reward is nan; it must be finite"),
    "a reward too large to square": (
        but(reward=-2e15),
        r"-2000000000000000.0; it must be .*at most 1e\+15",
    ),
    "terminated: NaN": (but(terminated=np.nan), "terminated is nan; it must be True or False"),
    "truncated: object": (but(truncated=np.array([None])), "truncated is array"),
    "info: a list": (but(info=[]), r"info is \[\]"),
    "a NaN seen": (but(obs=np.float32([0, np.nan])), "1 of 2 numbers that are not finite.*nan"),
    "another shape": (
        but(obs=np.zeros(3, np.float32)),
        r"an array \(3,\) of float32",
    ),
    "a text seen": (but(obs="here"), "observation is 'here'"),
    "ragged": (but(obs=[[0], [1, 2]]), "observation is"),
    "complex": (but(obs=np.zeros(2, complex)), "of complex128"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_answer_is_told_with_the_environment_and_the_step(case):
    answer, says = WRONG[case]
    with pytest.raises(EnvError, match=f"(?s)Scripted: environment 0, step 3 .*{says}"):
        third_step(scripted(answer))


@pytest.mark.parametrize(
    "answer",
    [
        but(reward=np.float64(2), terminated=np.bool_(False)),
        but(reward=np.array([2.0]), terminated=0),
        but(reward=2, truncated=0.0),
        but(reward=np.array(2, np.float16), obs=np.zeros(2)),
        but(reward=True, obs=[0, 0]),
        but(obs=np.float32([9, -9])),  # beyond the bounds, as LunarLander's are
    ],
)
def test_what_means_the_same_is_accepted(answer):
    raw = third_step(scripted(answer))
    assert raw.reward.tolist() == [float(np.reshape(answer[1], ()))] * 2
    assert not raw.terminated.any()
    assert raw.next_obs.dtype == np.float32


@pytest.mark.parametrize(
    ("space", "good", "bad"),
    [
        (gym.spaces.Discrete(3, start=1), 3, 0),
        (gym.spaces.Discrete(3), np.int64(2), 3),
        (gym.spaces.MultiDiscrete([2, 3]), np.array([1, 2]), np.array([2, 0])),
        (gym.spaces.MultiBinary(2), np.array([0, 1], np.int8), np.array([0, 2], np.int8)),
        (gym.spaces.Box(0, 255, (2,), np.uint8), np.uint8([0, 255]), np.array([0, 256])),
        (gym.spaces.Box(0, 255, (2,), np.uint8), np.uint8([1, 2]), np.array([0.5, 1.0])),
        (gym.spaces.Dict(a=BOX), {"a": GOOD[0]}, {"b": GOOD[0]}),
        (gym.spaces.Tuple((BOX, BOX)), (GOOD[0], GOOD[0]), (GOOD[0],)),
    ],
)
def test_an_observation_is_of_its_space(space, good, bad):
    def env(obs):
        return scripted(but(obs=obs), observation_space=space, reset=lambda s, **_: (good, {}))

    class Right(env(good)):
        def step(self, action):
            return but(obs=good)

    assert len(third_step(Right).reward) == 2

    class Wrong(Right):
        def step(self, action):
            return but(obs=bad)

    says = r"environment 0, step 1.*(observation_space|lacks the part '[a1]')"
    with pytest.raises(EnvError, match=says):
        third_step(Wrong)


def test_an_error_of_an_environment_is_told_with_its_line_and_is_its_cause():
    class Falls(Scripted):
        def step(self, action):
            return 1 / (action - action)

    with pytest.raises(EnvError, match=r"environment 0, step 1.*ZeroDivisionError.*test_chec"):
        third_step(Falls)
    with pytest.raises(EnvError) as raised:
        third_step(Falls)
    assert isinstance(raised.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize(
    ("reset", "says"),
    [
        (lambda *_, **__: GOOD[0], "reset.. returned a ndarray; Gymnasium needs obs, info"),
        (lambda *_, **__: (np.zeros(1), {}), r"observation is array\(\[0.\]\), which is not"),
        (lambda *_, **__: (np.full(2, np.nan, np.float32), {}), "2 of 2 numbers that are not"),
        (lambda *_, **__: (GOOD[0], None), "info is None"),
        (lambda self: (GOOD[0], {}), r"reset\(\) raised TypeError.*seed"),
    ],
)
def test_the_first_observation_is_looked_at_too(reset, says):
    with pytest.raises(EnvError, match=f"environment 0, step 0 .*{says}"):
        third_step(scripted(GOOD, reset=reset))


def pole(*wrappers, **settings):
    return EnvSpec("CartPole-v1", settings, wrappers)


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        (EnvSpec(lambda: None), "made None, which is no environment"),
        (EnvSpec(lambda: 1 / 0), "could not be made: ZeroDivisionError"),
        (EnvSpec(scripted(GOOD, action_space=3)), "action_space is 3; it must be a Gymnasium sp"),
        (EnvSpec(lambda shared=Scripted(): shared), "the same environment each time"),  # noqa: B008
        (pole(wings=2), r"CartPole-v1.*could not be made: TypeError"),
        (pole(lambda env: 1 / 0), r"CartPole-v1.*could not be made: ZeroDivision"),
        (pole(lambda env: None), "CartPole-v1 made None"),
    ],
)
def test_what_makes_no_environment_is_told(spec, says):
    with pytest.raises(EnvError, match=says):
        make_engine(spec, 2)


def raw(obs, reward=(0.0, 0.0)):
    never = np.zeros(len(obs), bool)
    return RawStep(obs, np.array(reward, np.float32), never, never, {})


def test_the_watch_counts_the_steps_of_each_environment():
    watch = Watch("X", BOX, 3)
    fine, bad = np.zeros((2, 2), np.float32), np.float32([[0, 0], [np.nan, 0]])
    watch.check_reset(np.zeros((3, 2), np.float32), np.arange(3))
    for _ in range(4):
        watch.check_step(raw(fine), np.array([0, 2]))
    watch.check_reset(fine[:1], np.array([0]))
    for row, step in ((2, 5), (0, 1)):
        with pytest.raises(EnvError, match=f"X: environment {row}, step {step} "):
            watch.check_step(raw(bad), np.array([1, row]))


def test_the_watch_sees_the_numbers_in_the_parts_of_an_observation():
    space = gym.spaces.Dict(a=gym.spaces.Discrete(2), b=gym.spaces.Dict(c=BOX))
    engine = make_engine(EnvSpec(nested := scripted(GOOD, observation_space=space)), 1)
    nested.reset = lambda self, **_: ({"a": 0, "b": {"c": np.float32([1, np.inf])}}, {})
    with pytest.raises(EnvError, match=r"observation \(b\.c\) has 1 of 2.*inf"):
        engine.reset(0)
    engine.close()


def test_large_numbers_are_numbers_but_a_reward_must_not_be_too_large_to_be_squared():
    watch = Watch("X", BOX, 2)
    huge = np.full((2, 2), 3e38, np.float32)  # their squares are infinite
    watch.check_reset(huge, np.arange(2))
    watch.check_step(raw(huge, (1e15, -1e15)), np.arange(2))
    # Before, training ended with a NaN and the advice to lower the learning rate.
    with pytest.raises(EnvError, match=r"X: environment 1, step 2.*at most 1e\+15 in size"):
        watch.check_step(raw(huge, (0.0, 2e15)), np.arange(2))


def test_envpool_is_watched_too(monkeypatch):
    pytest.importorskip("envpool")
    engine = make_engine(EnvSpec("CartPole-v1", engine="envpool"), 2, threads=1)
    engine.reset(0)
    step = engine._pools[0].step

    def broken(action, ids):
        obs, *rest = step(action, ids)
        obs[1] = np.nan
        return obs, *rest

    class Pool:
        pass

    pool = Pool()
    pool.step = broken
    monkeypatch.setattr(engine, "_pools", [pool])
    with pytest.raises(EnvError, match=r"CartPole-v1: environment 1, step 1.*4 of 4"):
        engine.step(np.zeros(2, np.int64))


def test_the_time_limit_is_found_below_other_wrappers():
    assert time_limit(EnvSpec("CartPole-v1").make()) == 500
    assert time_limit(EnvSpec(Scripted).make()) is None
    assert time_limit(CheckedEnv(gym.wrappers.TimeLimit(Scripted(), 7), "x")) == 7
