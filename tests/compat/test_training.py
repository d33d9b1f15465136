"""Training functions, environments, replay and evolution by AgileRL's names."""

from __future__ import annotations

import sys
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave.compat.agilerl.components.replay_buffer import (
    MultiStepReplayBuffer,
    PrioritizedReplayBuffer,
    ReplayBuffer,
)
from skillweave.compat.agilerl.hpo.mutation import Mutations
from skillweave.compat.agilerl.hpo.tournament import TournamentSelection
from skillweave.compat.agilerl.training.train_off_policy import train_off_policy
from skillweave.compat.agilerl.training.train_on_policy import train_on_policy
from skillweave.compat.agilerl.utils.utils import (
    create_population,
    initialPopulation,
    makeSkillVectEnvs,
    makeVectEnvs,
)
from skillweave.compat.agilerl.wrappers.learning import Skill
from skillweave.errors import MissingExtra, SkillweaveError

MLP = {"arch": "mlp", "hidden_size": [16, 16]}
HP = {
    "DISCRETE_ACTIONS": True, "BATCH_SIZE": 16, "LR": 1e-3, "GAMMA": 0.99, "GAE_LAMBDA": 0.95,
    "ACTION_STD_INIT": 0.6, "CLIP_COEF": 0.2, "ENT_COEF": 0.01, "VF_COEF": 0.5,
    "MAX_GRAD_NORM": 0.5, "TARGET_KL": None, "UPDATE_EPOCHS": 2, "LEARN_STEP": 4, "TAU": 0.01,
    "DOUBLE": True, "LR_ACTOR": 1e-4, "LR_CRITIC": 1e-3, "POLICY_FREQ": 2, "MAX_ACTION": 2.0,
    "MIN_ACTION": -2.0, "BETA": 0.4, "PRIOR_EPS": 1e-6, "NUM_ATOMS": 11, "V_MIN": 0.0,
    "V_MAX": 100.0, "N_STEP": 3,
}  # fmt: skip
FIELDS = ["state", "action", "reward", "next_state", "done"]


def population(algo: str, size: int = 1, env: Any = None):
    env = env or makeVectEnvs("CartPole-v1")
    space = env.single_action_space
    actions = int(space.n) if isinstance(space, gym.spaces.Discrete) else space.shape[0]
    state_dim = env.single_observation_space.shape
    return initialPopulation(algo, state_dim, actions, False, MLP, HP, population_size=size)


class Balance(Skill):
    """Counts, and resets the environment itself, as the tutorial's skills do."""

    def __init__(self, env):
        super().__init__(env)
        self.steps = 0

    def skill_reward(self, observation, reward, terminated, truncated, info):
        self.steps += 1
        if self.steps % 7 == 0:
            self.env.reset()
            return observation, 10.0, True, 0, info
        return observation, 2.0, terminated, truncated, info


def test_an_ended_environment_starts_anew_in_the_same_step():
    env = makeSkillVectEnvs("CartPole-v1", Balance, num_envs=2)
    env.reset(seed=0)
    rewards, ends, seen = [], [], []
    for _ in range(14):
        obs, reward, ended, _, info = env.step([0, 0])
        rewards.append(reward[0])
        ends.append(ended[0])
        seen.append((obs[0], info.get("final_obs")))
    assert [i for i, e in enumerate(ends) if e] == [6, 13]
    assert rewards[6] == 10.0
    assert set(rewards) == {2.0, 10.0}
    assert np.abs(seen[6][0]).max() < 0.06  # the new episode's first
    assert np.abs(seen[6][1][0]).max() > 0.06
    env.close()


def test_ppo_trains_and_is_tested_every_few_episodes(capsys):
    env = makeVectEnvs("CartPole-v1", num_envs=2)
    pop = population("PPO", 2)
    found, fitnesses = train_on_policy(
        env, "CartPole-v1", "PPO", pop, n_episodes=5, max_steps=20, evo_epochs=2, evo_loop=2,
        target=None,
    )  # fmt: skip
    assert np.shape(fitnesses) == (2, 2)
    assert [a.index for a in found] == [0, 1]
    assert [len(a.scores) for a in found] == [5, 5]
    assert [a.steps for a in found] == [[40, 80, 100]] * 2
    assert all(0 < score <= 20 for a in found for score in a.scores)
    assert capsys.readouterr().out.count("fitness") == 4


@pytest.mark.slow
def test_training_makes_better():
    torch.manual_seed(1)
    env = makeVectEnvs("CartPole-v1", num_envs=4)
    pop = initialPopulation("PPO", (4,), 2, False, MLP, HP | {"LR": 5e-3, "UPDATE_EPOCHS": 6})
    env.reset(seed=1)
    train_on_policy(
        env, "CartPole-v1", "PPO", pop, n_episodes=20, max_steps=100, evo_epochs=100, verbose=False
    )
    assert np.mean(pop[0].scores[-5:]) > 2.0 * pop[0].scores[0]


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("algo", ["DQN", "Rainbow DQN", "DDPG", "TD3"])
def test_off_policy_algorithms_train(algo):
    torch.manual_seed(0)
    discrete = "DQN" in algo
    env = makeVectEnvs("CartPole-v1" if discrete else "Pendulum-v1", num_envs=2)
    pop, how = population(algo, 2, env), {}
    memory = ReplayBuffer(2, 1000, FIELDS)
    if algo == "Rainbow DQN":
        memory = PrioritizedReplayBuffer(2, 1000, FIELDS, num_envs=2)
        more = MultiStepReplayBuffer(2, 1000, FIELDS, num_envs=2, n_step=3, gamma=0.99)
        how = {"per": True, "n_step": True, "noisy": True, "n_step_memory": more}
    before = pop[0].member.state.params.clone()
    found, fitnesses = train_off_policy(
        env, "x", algo, pop, memory, n_episodes=2, max_steps=30, evo_epochs=2, target=None,
        verbose=False, **how,
    )  # fmt: skip
    assert np.shape(fitnesses) == (1, 2)
    assert len(memory) > 100
    assert not torch.equal(before, found[0].member.state.params)


@pytest.mark.slow
def test_populations_evolve(tmp_path):
    torch.manual_seed(0)
    env = makeVectEnvs("CartPole-v1")
    tournament = TournamentSelection(2, True, 3, 1)
    mutation = Mutations(
        "PPO", 0.1, 0.3, 0.5, 0.3, 0.2, 0.3, ["lr", "batch_size", "learn_step"], 0.1, rand_seed=1
    )
    pop, _ = train_on_policy(
        env, "CartPole-v1", "PPO", population("PPO", 3), n_episodes=4, max_steps=15,
        evo_epochs=1, target=None, tournament=tournament, mutation=mutation, verbose=False,
        save_elite=True, elite_path=str(tmp_path / "elite.pt"), checkpoint=2,
        checkpoint_path=str(tmp_path / "at.pt"),
    )  # fmt: skip
    assert len({a.index for a in pop}) == 3
    assert max(a.index for a in pop) > 2
    assert {a.mut for a in pop} <= {"None", "arch", "param", "act", "lr", "bs"}
    names = {p.name for p in tmp_path.iterdir()}
    assert names == {"elite.pt", *(f"at_{i}_{n}.pt" for i in range(3) for n in (2, 4))}


def test_every_kind_of_mutation_is_said_and_the_elite_can_be_spared():
    torch.manual_seed(0)
    said = set()
    for kind in range(5):
        chances = [float(i == kind) for i in range(5)]
        none, arch, param, act, hp = chances
        selection = ["lr", "batch_size", "learn_step"]
        mutation = Mutations("DQN", none, arch, 0.5, param, act, hp, selection, 0.1, rand_seed=kind)
        pop = mutation.mutation(population("DQN", 8))
        said |= {a.mut for a in pop}
        assert len({a.mut for a in pop} - {"lr", "bs", "ls"}) == (kind != 4)
    assert said == {"None", "arch", "param", "act", "lr", "bs", "ls"}
    spared = Mutations("DQN", 0, 1, 0.5, 0, 0, 0, [], 0.1, mutate_elite=False)
    assert [a.mut for a in spared.mutation(population("DQN", 3))] == ["None", "arch", "arch"]


def test_a_tournament_prefers_the_fit():
    pop = population("DQN", 4)
    for i, agent in enumerate(pop):
        agent.fitness = [float(i)]
        agent.steps = [i]
    elite, heirs = TournamentSelection(3, True, 6, 1).select(pop)
    assert (elite.index, heirs[0].index, heirs[0].steps) == (3, 3, [3])
    assert [h.index for h in heirs[1:]] == [4, 5, 6, 7, 8]
    assert np.mean([h.fitness[0] for h in heirs]) > 1.5


def test_the_replay_buffer_gives_back_what_went_in_in_the_old_form():
    buffer = ReplayBuffer(2, 100, FIELDS)
    for i in range(10):
        now, after = np.full((2, 3), i, np.float32), np.full((2, 3), i + 1, np.float32)
        done = np.array([i == 4, False])
        buffer.save2memory(
            now, np.array([i % 2, 1]), np.array([i, -1.0]), after, done, is_vectorised=True
        )
    assert (len(buffer), buffer.counter) == (20, 20)
    obs, action, reward, after, done, idxs = buffer.sample(64, return_idx=True)
    assert [tuple(x.shape) for x in (obs, action, reward, after, done)] == [
        (64, 3), (64, 1), (64, 1), (64, 3), (64, 1),
    ]  # fmt: skip
    assert {x.dtype for x in (obs, action, reward, after, done)} == {torch.float32}
    assert torch.equal(after, obs + 1)
    first = reward >= 0.0
    assert torch.equal(reward[first], obs[:, :1][first])
    assert torch.equal(done[first], (obs[:, :1][first] == 4.0).float())
    assert not done[~first].any()
    again = buffer.sample_from_indices(idxs)
    assert all(
        torch.equal(a, b) for a, b in zip(again, (obs, action, reward, after, done), strict=True)
    )
    single = ReplayBuffer(2, 10, FIELDS)
    single.save2memory(np.zeros(3), 1, 0.5, np.ones(3), True)
    assert [float(x.sum()) for x in single.sample(1)] == [0.0, 1.0, 0.5, 3.0, 1.0]


def walked(buffer: Any, start: float, steps: int) -> None:
    """Add steps of one environment that counts on from ``start``, and pays 1 in each."""
    for i in range(steps):
        now = np.full((1, 1), start + i)
        buffer.save2memoryVectEnvs(now, np.zeros(1, int), np.ones(1), now + 1, np.array([False]))


def test_n_step_rewards_do_not_reach_over_a_reset_that_nobody_mentioned():
    buffer = MultiStepReplayBuffer(2, 100, FIELDS, num_envs=1, n_step=3, gamma=0.5)
    walked(buffer, 0.0, 4)
    walked(buffer, 100.0, 4)
    *_, drawn = buffer.sample(200, return_idx=True)
    obs, _, reward, after, _ = buffer.sample_from_indices(np.unique(drawn))
    assert reward[:, 0].tolist() == [1.75, 1.75, 1.5, 1.0] * 2
    assert (after - obs)[:, 0].tolist() == [3.0, 3.0, 2.0, 1.0] * 2


def test_priorities_say_what_is_sampled():
    buffer = PrioritizedReplayBuffer(2, 100, FIELDS, num_envs=1)
    walked(buffer, 0.0, 50)
    *_, weights, idxs = buffer.sample(50, 1.0)
    buffer.update_priorities(idxs, np.where(idxs == 7, 100.0, 1e-6))
    *_, weights, idxs = buffer.sample(64, 1.0)
    assert (idxs == 7).mean() > 0.5
    assert weights.shape == (64,)


def test_images_may_come_with_their_channels_last():
    class Picture(gym.Env):
        observation_space = gym.spaces.Box(0, 255, (24, 24, 3), np.uint8)
        action_space = gym.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

        def step(self, action):
            return self.observation_space.sample(), 1.0, False, False, {}

    cnn = {"arch": "cnn", "channel_size": [4], "kernel_size": [4], "stride_size": [4]}
    net = {**cnn, "hidden_size": [8], "normalize": True}
    pop = create_population("PPO", (3, 24, 24), 2, False, net, HP)
    _, fitnesses = train_on_policy(
        Picture(), "picture", "PPO", pop, swap_channels=True, n_episodes=1, max_steps=6,
        evo_epochs=1, verbose=False,
    )  # fmt: skip
    assert fitnesses == [[6.0]]


def test_lunar_lander_v2_is_v3_with_one_warning():
    pytest.importorskip("Box2D")
    from skillweave.compat import agilerl

    agilerl._warn.cache_clear()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("default")
        warnings.filterwarnings("ignore", ".*LunarLander.*-v2 is out of date", DeprecationWarning)
        envs = [makeVectEnvs("LunarLander-v2"), gym.make("LunarLander-v2")]
    assert len([w for w in said if "LunarLander" in str(w.message)]) == 1
    assert envs[1].spec.max_episode_steps == 1000
    assert type(envs[1].unwrapped) is type(gym.make("LunarLander-v3").unwrapped)


def test_tracking_without_wandb_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    env = makeVectEnvs("CartPole-v1")
    with pytest.raises(MissingExtra, match=r"skillweave\[wandb\]"):
        train_on_policy(env, "CartPole-v1", "PPO", population("PPO"), wb=True)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: makeVectEnvs("CartPole-v7"), "CartPole"),
        (lambda: initialPopulation("MADDPG", (4,), 2, False, MLP, HP), "no algorithm 'MADDPG'"),
        (lambda: initialPopulation("PPO", (4,), 2, False, MLP, {}), "DISCRETE_ACTIONS"),
        (lambda: train_on_policy(makeVectEnvs("CartPole-v1"), "x", "PPO", []), "pop"),
        (
            lambda: train_on_policy(gym.make_vec("CartPole-v1", 1), "x", "PPO", [1]),
            "makeVectEnvs",
        ),
    ],
)
def test_what_cannot_be_is_said(make, says):
    with pytest.raises(SkillweaveError, match=says):
        make()
