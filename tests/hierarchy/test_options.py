"""OptionsEnv is an ordinary Gymnasium vector, and its errors; tests/calls has its calls."""

import functools
import inspect

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from reference_calls import EPISODE, POSITION, TAG, Counter, Die, Left, Right, T, Walk, Zigzag
from toys import network_of, skills_of

from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import SkillError, SkillweaveError
from skillweave.hierarchy.options_env import OptionsEnv
from skillweave.skills.skill_set import SkillSet

torch.set_num_threads(1)
N = 5
SPACES = Walk.observation_space, Walk.action_space
ALL = (Left, Right, Zigzag, Counter)


skill_set = functools.partial(skills_of, call_steps=4)


@pytest.fixture
def options():
    """Makes OptionsEnvs of Gymnasium environments, and closes them in the end."""
    opened = []

    def make(skills, env=Walk, gamma=0.97, num_envs=N, engine="sync", **spec):
        made = make_engine(EnvSpec(env, engine=engine, **spec), num_envs, threads=1)
        opened.append(OptionsEnv(made, skills, gamma))
        return opened[-1]

    yield make
    for env in opened:
        env.close()


@pytest.fixture
def walks():
    """A maker of Walks that keeps them, to be looked into."""

    def make() -> Walk:
        make.made.append(Walk())
        return make.made[-1]

    make.made = []
    return make


def test_a_call_that_nothing_ends_is_told_and_not_waited_for(options, monkeypatch):
    monkeypatch.setattr("skillweave.hierarchy.options_env.LONGEST_EPISODE", 2)

    class Eternal(Left):
        max_steps = None

        def termination(self, step):
            return np.zeros(len(step.reward), bool)

    def endless():
        env = Walk()
        env.step = lambda action: (*Walk.step(env, action)[:2], False, False, {})
        return env

    env = options(skill_set(Eternal, call_steps=None), env=endless, num_envs=2)
    env.reset(seed=0)
    with pytest.raises(SkillError, match="skill 'eternal' has run for 2 steps in environ"):
        env.step(np.zeros(2, np.int64))


# Initiation sets -----------------------------------------------------------------------------


def test_choosing_a_skill_that_may_not_start_names_it_and_the_environment(options):
    env = options(skill_set(Left, Right, Zigzag, call_steps=6))
    _, info = env.reset(seed=0)
    while info["action_mask"].all():
        *_, info = env.step(np.where(info["action_mask"][:, 1], 1, 2))
    row = int(np.flatnonzero(~info["action_mask"][:, 1])[0])
    with pytest.raises(SkillweaveError, match=rf"'right' may not start in environment {row}\b"):
        env.step(np.ones(N, int))


@pytest.mark.parametrize("bad", [4, 17, -1])
def test_an_action_that_is_no_skill_is_named(options, bad):
    env = options(skill_set(*ALL))
    env.reset(seed=0)
    choice = np.zeros(N, int)
    choice[2] = bad
    with pytest.raises(SkillweaveError, match=rf"action {bad} .*there are 4"):
        env.step(choice)


# Stochastic skills ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["scripted", "network"])
def test_skills_that_sample_are_reproduced_by_the_seed(options, walks, kind):
    skills = (Die(), Zigzag())
    policies = (Die.policy if kind == "scripted" else network_of(*SPACES), Zigzag.policy)

    def play(seed: int, greedy: bool) -> list:
        env = options(SkillSet(skills, policies, call_steps=4, greedy=greedy), walks)
        env.reset(seed=seed)
        for t in range(12):
            env.step((np.arange(N) + t) % 2)
        return [w.log for w in walks.made[-N:]]

    sampled = play(0, greedy=False)
    assert sampled == play(0, greedy=False)
    assert sampled != play(1, greedy=False)
    assert sampled != play(0, greedy=True)
    if kind == "scripted":
        draws = [a for log in sampled for _, _, a in log]
        assert min(np.bincount(draws, minlength=3)) > len(draws) / 6, "the die is loaded"


def test_skills_go_on_sampling_anew_from_call_to_call(options, walks):
    env = options(skill_set(Die, call_steps=3, greedy=False), walks, num_envs=1)
    env.reset(seed=0)
    for _ in range(40):
        env.step(np.zeros(1, int))
    actions = [a for _, _, a in walks.made[-1].log]
    assert len({tuple(actions[i : i + 3]) for i in range(0, 90, 3)}) > 10


def test_what_a_call_draws_follows_from_the_seed_and_the_number_of_calls_alone(options, walks):
    env = options(skill_set(Die, Left, call_steps=3, greedy=False), walks, num_envs=1)
    draws = []
    for first in (0, 1):  # the first call draws, or does not; the second draws
        env.reset(seed=4)  # an episode of more than six steps
        walks.made[-1].log.clear()
        for choice in (first, 0):
            env.step(np.array([choice]))
        draws.append([a for _, _, a in walks.made[-1].log][-3:])
    assert draws[0] == draws[1]


# Gymnasium's conventions ---------------------------------------------------------------------


def test_its_spaces_and_reset_mode_are_those_of_a_gymnasium_vector(options):
    env = options(skill_set(*ALL))
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert env.single_observation_space == Walk.observation_space
    assert env.single_action_space == gym.spaces.Discrete(4)
    assert env.action_space == gym.spaces.MultiDiscrete([4] * N)
    assert env.observation_space.shape == (N, 4)
    obs, info = env.reset(seed=0)
    assert isinstance(info, dict)
    assert env.observation_space.contains(obs)
    obs, reward, terminated, truncated, info = env.step(np.zeros(N, int))
    assert env.observation_space.contains(obs)
    assert (reward.shape, reward.dtype) == ((N,), np.float32)
    for flag in (terminated, truncated):
        assert (flag.shape, flag.dtype) == ((N,), np.bool_)
    assert (info["discount"].dtype, info["steps"].dtype) == (np.float32, np.int64)


def test_the_final_observation_is_there_where_an_episode_ended_and_only_there(options):
    env = options(skill_set(Left, Zigzag, call_steps=5))
    env.reset(seed=0)
    ends = 0
    for _ in range(25):
        obs, _, terminated, truncated, info = env.step(np.arange(N) % 2)
        ended = terminated | truncated
        assert ("final_obs" in info) == bool(ended.any())
        if not ended.any():
            continue
        assert info["_final_obs"].tolist() == ended.tolist()
        for i in range(N):
            if ended[i]:
                assert info["final_obs"][i].tolist() == info["next_obs"][i].tolist()
                assert info["final_obs"][i][EPISODE] == obs[i, EPISODE] - 1
                ends += 1
            else:
                assert info["final_obs"][i] is None
                assert info["next_obs"][i].tolist() == obs[i].tolist()
    assert ends > 5


def test_a_seed_reproduces_everything_another_does_not_and_no_seed_goes_on(options):
    env = options(skill_set(*ALL))

    def play(seed):
        found = [env.reset(seed=seed)[0][:, [TAG, T, POSITION]]]
        for _ in range(5):
            obs, reward, *_ = env.step(np.zeros(N, int))
            found += [obs[:, [TAG, T, POSITION]], reward]
        return [x.tolist() for x in found]

    first = play(3)
    assert play(3) == first
    assert play(4) != first
    after = play(3), play(None), play(None)
    assert after[1] != first
    assert after[2] != after[1]
    assert (play(3), play(None), play(None)) == after
    with pytest.raises(SkillweaveError, match="one seed"):
        env.reset(seed=[1] * N)


def test_what_was_returned_is_not_changed_by_later_steps(options):
    env = options(skill_set(*ALL, call_steps=5))
    kept, copies = [], []
    obs, _ = env.reset(seed=0)
    for _ in range(10):
        kept.append(obs)
        copies.append(obs.copy())
        obs, reward, terminated, truncated, info = env.step(np.arange(N) % 2 * 2)
        for x in (reward, terminated, truncated, info["next_obs"], info["steps"], info["discount"]):
            kept.append(x)
            copies.append(x.copy())
    for x, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(x, copy)


def test_gymnasiums_own_vector_wrapper_counts_its_episodes(options):
    env = RecordEpisodeStatistics(options(skill_set(Left, Zigzag, call_steps=2), gamma=1.0))
    if "SAME_STEP" not in inspect.getsource(RecordEpisodeStatistics.step):
        pytest.skip("an older Gymnasium, whose wrapper counts for one mode of resets alone")
    env.reset(seed=0)
    running, counted = np.zeros(N), 0
    for _ in range(30):
        _, reward, terminated, truncated, info = env.step(np.ones(N, int))
        running += reward
        for i in np.flatnonzero(terminated | truncated):
            assert info["episode"]["r"][i] == pytest.approx(running[i], abs=1e-5)
            running[i] = 0
            counted += 1
    assert counted > 10


def test_a_memory_that_no_checkpoint_could_hold_is_refused_by_the_skills_name():
    class Wordy(type(Counter.policy)):
        def start(self, n):
            return {"said": np.array(["nothing"] * n, object)}

    skills = SkillSet((Left(),), (Wordy(),), (), 5)
    with pytest.raises(SkillweaveError, match="skill 'left': its policy remembers 'said' as obj"):
        _ = skills.hierarchy
