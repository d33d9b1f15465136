"""Observations of parts, and every kind of action, through engines, skills and options."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from toys import alone_in, calling_in

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.config import PPO
from skillweave.envs.engine import checksums
from skillweave.envs.envpool_engine import EnvPoolEngine
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.experience.acting import Acting, Request
from skillweave.hierarchy.options_env import OptionsEnv
from skillweave.networks.config import CNN, Network
from skillweave.skills import Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet
from skillweave.spaces import obs_dtype, pack, unpack

ACTIONS = [
    Discrete(3, start=-1),
    MultiDiscrete([2, 3], start=[1, 0]),
    MultiDiscrete([[2, 3], [2, 2]], dtype=np.int8),
    MultiBinary(3),
    MultiBinary([2, 2]),
    Box(-1, 1, (2,)),
    Box(-2, 2, (), np.float64),
    Box(np.float32([0, -np.inf]), np.float32([1, np.inf])),
]
PLACES = Dict(
    [
        ("position", Box(-np.inf, np.inf, (2,), np.float32)),
        ("inside", Tuple((Discrete(20), Box(0, 255, (4, 4, 3), np.uint8)))),
    ]
)


class Places(gym.Env):
    """Walks by what its action sums to; odd episodes terminate, even ones are truncated."""

    def __init__(self, action_space=ACTIONS[0], space=PLACES) -> None:
        self.action_space, self.observation_space = action_space, space
        self.episode = 0

    def _obs(self):
        inside = self.t, np.full((4, 4, 3), self.t, np.uint8)
        value = {"position": self.position.copy(), "inside": inside}
        return value if self.observation_space is PLACES else (inside[0], self.position.copy())

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.episode = 0, self.episode + 1
        self.position = self.np_random.normal(size=2).astype(np.float32)
        return self._obs(), {}

    def step(self, action):
        single = isinstance(self.action_space, Discrete)
        assert isinstance(action, int | np.integer if single else np.ndarray), type(action)
        assert self.action_space.contains(action)
        self.t += 1
        self.position += np.float32([0.1 * np.sum(action), 0.5])
        ended = self.t == 2 + self.episode % 3
        info = {"t": self.t}
        return self._obs(), self.t / 2, ended and self.episode % 2 == 1, ended, info


def matches(obs, row, single) -> bool:
    """Whether a row of a batch is one environment's observation."""
    return np.array_equal(obs[row], pack(PLACES, single))


@pytest.fixture
def engine():
    """Makes engines, and closes them in the end."""
    made = []

    def make(name="sync", env=Places, num_envs=3):
        made.append(make_engine(EnvSpec(env, engine=name), num_envs))
        return made[-1]

    yield make
    for e in made:
        e.close()


@pytest.mark.parametrize("actions", ACTIONS, ids=str)
def test_an_engine_is_single_environments_side_by_side(engine, actions):
    e = engine("sync", lambda: Places(actions))
    actions.seed(0)
    e.reset(0)
    seeds, singles = [5, 6, 7], [Places(actions) for _ in range(3)]
    for single in singles:
        single.reset()  # the engine's second episode begins too
    obs = e.reset_some(np.arange(3), seeds)
    firsts = [s.reset(seed=seed)[0] for s, seed in zip(singles, seeds, strict=True)]
    assert obs.dtype == obs_dtype(PLACES)
    assert all(matches(obs, i, first) for i, first in enumerate(firsts))
    for ids in ([0, 1, 2], [2, 0], None):
        rows = np.arange(3) if ids is None else np.array(ids)
        chosen = np.stack([np.asarray(actions.sample()) for _ in rows])
        raw = e.step(chosen, None if ids is None else rows)
        for at, i in enumerate(rows):
            action = int(chosen[at]) if isinstance(actions, Discrete) else np.asarray(chosen[at])
            after, reward, terminated, _, info = singles[i].step(action)
            assert matches(raw.next_obs, at, after)
            assert (raw.reward[at], raw.terminated[at]) == (reward, terminated)
            assert raw.info["t"][at] == info["t"]


def test_steps_do_not_write_to_observations_of_before(engine):
    e = engine()
    first = e.reset(0)
    kept = first.copy()
    second = e.step(np.zeros(3, np.int64)).next_obs
    assert np.array_equal(first, kept)
    assert not np.array_equal(first, second)


def test_checksums_are_of_the_parts_and_not_of_the_bytes_between_them():
    # Whoever copies rows copies these bytes or not: a run that goes on would begin all anew.
    inner = Dict(on=Box(-1, 1, (1,), np.float32), far=Box(-1, 1, (2,), np.float64))
    dtype = obs_dtype(Dict(near=Box(-1, 1, (1,), np.float32), inner=inner))
    zeros, ones = (np.full(dtype.itemsize * 3, byte, np.uint8).view(dtype) for byte in (0, 255))
    for rows, same in ((ones, zeros), (ones["inner"], zeros["inner"])):
        for name in {"near", "on", "far"} & set(rows.dtype.names):
            rows[name] = same[name]
    assert zeros.tobytes() != ones.tobytes()
    np.testing.assert_array_equal(checksums(zeros), checksums(ones))
    for change in ("near", "on", "far"):
        other = zeros.copy()
        part = other if change == "near" else other["inner"]
        part[change][1] += 1
        assert (checksums(other) != checksums(zeros)).tolist() == [False, True, False]


def test_envpool_takes_no_observations_of_parts():
    pytest.importorskip("envpool")
    env = gym.make("CartPole-v1")
    assert EnvPoolEngine.supports("CartPole-v1", env)
    assert not EnvPoolEngine.supports(
        "CartPole-v1", gym.wrappers.TransformObservation(env, lambda x: {"a": x}, PLACES)
    )


@pytest.mark.parametrize("actions", ACTIONS, ids=str)
def test_a_skill_starts_after_random_actions_of_any_kind_and_reads_parts(engine, actions):
    class Onwards(Skill):
        def initiation(self, obs):
            return obs["inside"]["0"] >= 1

        def reward(self, step):
            return step.next_obs["position"][:, 1] - step.obs["position"][:, 1]

    made = engine(env=lambda: Places(actions))
    acting, params = learner(made.action_space)
    collector = alone_in(made, acting, Onwards())
    collector.start(Seeds(0))
    experience = collector.collect(Request(20, (params,), np.array([0.9]), Seeds(1))).batches[""]
    assert experience["obs"].dtype == experience["next_obs"].dtype == obs_dtype(PLACES)
    valid = experience["valid"]
    assert (valid == (experience["obs"]["inside"]["0"] >= 1)).all()
    forwards = experience["next_obs"]["position"][..., 1] - experience["obs"]["position"][..., 1]
    np.testing.assert_allclose(experience["reward"][valid], forwards[valid], atol=1e-5)
    np.testing.assert_allclose(experience["reward"][valid], 0.5, atol=1e-5)
    assert 10 < valid.sum() < 60


def learner(actions):
    """One that acts in Places, and its parameters."""
    network = Network((4,), cnn=CNN("plain", (2,), (2,), (2,)))
    config = PPO(num_envs=3, n_steps=20, batch_size=20, network=network)
    algorithm = make_algorithm(config, PLACES, actions)
    return Acting([(algorithm, 1)], 3), algorithm.acting_params(algorithm.init([Seeds(0)]), 0.0)


class Ahead(Skill):
    """May start everywhere but at time 4, at which an episode has ended."""

    def initiation(self, obs):
        return obs["inside"]["0"] < 4


class Rest(Skill):
    """May start at times 0 and 1."""

    max_steps = 1

    def initiation(self, obs):
        return obs["inside"]["0"] <= 1


@pytest.fixture
def options(engine):
    """An OptionsEnv of Places: skills of which none may start at time 4."""
    made = engine()

    def still(obs):
        return np.zeros(len(obs["position"]), np.int64)

    policy = ScriptedPolicy(still, made.observation_space, made.action_space)
    return OptionsEnv(made, SkillSet((Ahead(), Rest()), (policy, policy), call_steps=1), 0.9)


def test_options_are_an_ordinary_vector_with_the_masks_of_true_successors(options):
    obs, info = options.reset(seed=0)
    assert options.observation_space.contains(obs)
    ends, seen = 0, set()
    for _ in range(40):
        action = info["action_mask"].argmax(axis=1)
        obs, reward, terminated, truncated, info = options.step(action)
        assert options.observation_space.contains(obs)
        assert info["next_obs"].dtype == obs_dtype(PLACES)
        ended = terminated | truncated
        for i in np.flatnonzero(ended):
            assert PLACES.contains(info["final_obs"][i])
            assert matches(info["next_obs"], i, info["final_obs"][i])
            assert obs["inside"][0][i] == 0
        successors = unpack(PLACES, info["next_obs"])
        assert np.array_equal(successors["position"][~ended], obs["position"][~ended])
        ends += ended.sum()
        assert reward.dtype == np.float32
        mask, time = info["next_action_mask"], info["next_obs"]["inside"]["0"]
        assert (mask.shape, mask.dtype) == ((3, 2), bool)
        assert np.array_equal(mask[~ended], info["action_mask"][~ended])
        assert mask[terminated].all()
        for i in np.flatnonzero(truncated & ~terminated):
            stuck = time[i] == 4
            assert mask[i].tolist() == [True, bool(stuck or time[i] <= 1)]
            seen.add(bool(stuck))
    assert ends > 10
    assert seen == {True, False}


def test_decisions_are_packed_arrays_with_both_masks(options):
    acting, params = learner(Discrete(2))
    collector = calling_in(options.engine, acting, options.skills)
    collector.start(Seeds(0))
    stuck = 0
    for i in range(3):
        asked = Request(15, (params,), np.array([0.9]), Seeds(i))
        experience = collector.collect(asked).batches[""]
        assert experience["obs"].dtype == experience["next_obs"].dtype == obs_dtype(PLACES)
        assert experience.get("valid") is None, "all calls are of one step"
        time, after = experience["obs"]["inside"]["0"], experience["next_obs"]["inside"]["0"]
        assert np.array_equal(after, time + 1)
        assert np.array_equal(experience["mask"], np.stack([time < 4, time <= 1], -1))
        found = np.stack([after < 4, after <= 1], -1)
        found[experience["terminated"] | ~found.any(-1)] = True
        assert np.array_equal(experience["next_mask"], found)
        stuck += (experience["truncated"] & (after == 4)).sum()
        goes_on = ~experience.ended[:-1]
        assert np.array_equal(experience["next_obs"][:-1][goes_on], experience["obs"][1:][goes_on])
    assert stuck
