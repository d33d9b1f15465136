from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from skillweave.envs.skill_env import SkillEnv
from skillweave.training.collector import Collector
from skillweave.training.on_policy import Tick, train_on_policy
from toys import (
    Allowance,
    BoxIdentity,
    Broken,
    Calls,
    Clockwork,
    Countdown,
    Identity,
    Masked,
    SeedsOfMember,
    Toy,
)

from skillweave.algorithms.config import PPO
from skillweave.algorithms.ppo import PPOAlgorithm, State
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.networks.config import Network
from skillweave.seeding import Seeds
from skillweave.types import SkillweaveError, unprefixed

CONFIG = PPO(
    num_envs=16, n_steps=16, batch_size=64, learning_rate=5e-3, gamma=0.9, ent_coef=0.0,
    network=Network((32,)),
)  # fmt: skip


def start(env: Toy, config: PPO = CONFIG, members: int = 1) -> tuple[PPOAlgorithm, State]:
    algorithm = PPOAlgorithm(config, env.observation_space, env.action_space)
    return algorithm, algorithm.init([Seeds(m) for m in range(members)])


def train(
    env: Toy, updates: int, config: PPO = CONFIG, seed: int = 0, **kwargs
) -> tuple[PPOAlgorithm, State]:
    """Train for so many updates where an action lasts one step."""
    algorithm, state = start(env, config)
    budget = updates * config.n_steps * env.num_envs
    collector = Collector(env)
    return algorithm, train_on_policy(algorithm, collector, state, Seeds(seed), budget, **kwargs)


def greedy(algorithm: PPOAlgorithm, state: State, obs: np.ndarray, mask=None) -> np.ndarray:
    rows, allowed = (
        torch.from_numpy(obs)[None],
        None if mask is None else torch.from_numpy(mask)[None],
    )
    action, *_ = algorithm.act(algorithm.acting_params(state), rows, allowed, None)
    return algorithm.to_env(action[0].numpy())


@pytest.mark.parametrize("overlap", [True, False])
def test_ppo_learns_that_the_action_must_equal_the_observation(overlap):
    algorithm, state = train(Identity(16), 40, replace(CONFIG, overlap=overlap))
    assert greedy(algorithm, state, np.arange(4)).tolist() == [0, 1, 2, 3]
    head = algorithm.act(algorithm.acting_params(state), torch.arange(4)[None], None, None)[1]
    assert head.softmax(-1)[0].diagonal().min() > 0.9


@pytest.mark.parametrize("overlap", [True, False])
def test_ppo_learns_that_a_continuous_action_must_equal_the_observation(overlap):
    algorithm, state = train(BoxIdentity(16), 80, replace(CONFIG, overlap=overlap))
    obs = np.linspace(-0.9, 0.9, 7, dtype=np.float32)[:, None]
    assert np.abs(greedy(algorithm, state, obs) - obs).max() < 0.2
    assert algorithm.acting_params(state).views["actor.log_std"].exp().item() < 0.3


def test_a_forbidden_action_is_never_taken_and_the_best_of_the_others_is_learnt():
    env = Masked(16)
    algorithm, state = train(env, 30)
    assert env.taken_though_forbidden == 0
    obs = np.arange(3)
    mask = np.arange(3) != obs[:, None]
    assert greedy(algorithm, state, obs, mask).tolist() == [2, 2, 1]


def test_a_time_limit_is_bootstrapped():
    algorithm, state = train(Allowance(16), 60)
    assert algorithm.value(state, torch.zeros(1, 1, 1)).item() == pytest.approx(
        1 / (1 - 0.9), rel=0.05
    )


@pytest.mark.parametrize("normalize_returns", [True, False])
def test_a_termination_is_not_bootstrapped(normalize_returns):
    config = replace(CONFIG, normalize_returns=normalize_returns)
    algorithm, state = train(Countdown(16), 60, config)
    finite = [sum(0.9**i for i in range(5 - t)) for t in range(5)]
    values = algorithm.value(state, torch.arange(5)[None])[0]
    assert values.tolist() == pytest.approx(finite, rel=0.05)


def test_rewards_of_any_size_are_learnt_in_their_own_units():
    class Rich(Countdown):
        def play(self, action):
            next_obs, reward, *rest = super().play(action)
            return next_obs, 1e4 * reward, *rest

    algorithm, state = train(Rich(16), 60)
    finite = [1e4 * sum(0.9**i for i in range(5 - t)) for t in range(5)]
    assert algorithm.value(state, torch.arange(5)[None])[0].tolist() == pytest.approx(
        finite, rel=0.05
    )


@pytest.mark.parametrize(
    ("allowed", "value"),
    [((True, False), 1 / (1 - 0.9)), ((False, True), 3 / (1 - 0.9**10))],
)
def test_the_value_of_calls_discounts_by_their_length(allowed, value):
    env = Calls(16, allowed)
    algorithm, state = start(env)
    budget = 60 * 16 * 16 * (1 if allowed[0] else 10)
    state = train_on_policy(algorithm, Collector(env), state, Seeds(0), budget)
    assert algorithm.value(state, torch.zeros(1, 1, 1)).item() == pytest.approx(value, rel=0.05)


@pytest.mark.parametrize("overlap", [True, False])
def test_a_short_call_is_preferred_over_a_long_one_that_pays_more_but_less_a_step(overlap):
    env = Calls(16)  # without γ^τ the long call would look three times as good
    algorithm, state = start(env, replace(CONFIG, overlap=overlap))
    state = train_on_policy(algorithm, Collector(env), state, Seeds(0), 40_000)
    assert greedy(algorithm, state, np.zeros((1, 1), np.float32)).tolist() == [0]
    assert algorithm.value(state, torch.zeros(1, 1, 1)).item() == pytest.approx(10.0, rel=0.1)


def test_a_budget_counts_the_steps_of_calls_and_not_the_calls():
    env, ticks = Calls(16, (False, True)), []
    algorithm, state = start(env)
    train_on_policy(algorithm, Collector(env), state, Seeds(0), 5000, on_tick=ticks.append)
    assert ticks[-1].steps == 5120


@pytest.mark.parametrize("overlap", [True, False])
def test_a_stack_of_three_trains_like_three_single_members(overlap):
    config = replace(CONFIG, num_envs=4, batch_size=16, overlap=overlap)
    updates = 5
    env = Clockwork(range(12))
    algorithm, state = start(env, config, members=3)
    stack = train_on_policy(
        algorithm, Collector(env), state, Seeds(5), updates * 12 * 16, cut_every=2 * 12 * 16
    )
    for m in range(3):
        env = Clockwork(range(4 * m, 4 * m + 4))
        single = algorithm.init([Seeds(m)])
        seeds = SeedsOfMember(Seeds(5), m)
        single = train_on_policy(
            algorithm, Collector(env), single, seeds, updates * 4 * 16, cut_every=2 * 4 * 16
        )
        assert single.count.tolist() == [updates * 16]
        torch.testing.assert_close(stack.params[m], single.params[0], rtol=1e-3, atol=1e-4)
    assert (stack.params[0] - stack.params[1]).abs().max() > 0.1


@pytest.mark.parametrize("overlap", [True, False])
def test_the_same_seed_gives_the_same_weights_bit_for_bit_and_another_does_not(overlap):
    def weights(seed: int) -> torch.Tensor:
        return train(Identity(16), 6, replace(CONFIG, overlap=overlap), seed)[1].params

    assert torch.equal(weights(1), weights(1))
    assert not torch.equal(weights(1), weights(2))


class Spy(PPOAlgorithm):
    """Notes, at each update, how many updates old the policy is that collected the data."""

    def __init__(self, *args) -> None:
        super().__init__(*args)
        self.versions, self.lags = [], []

    def update(self, state, batch, rng):
        self.versions.append(self.acting_params(state))
        obs, head = batch.obs.flatten(1, 2), batch.head.flatten(1, 2)
        with torch.no_grad():
            heads = [self.act(a, obs, None, None)[1] for a in self.versions]
            acted = [torch.allclose(h, head) for h in heads]
        self.lags.append(acted[::-1].index(True))
        return super().update(state, batch, rng)


@pytest.mark.parametrize(("overlap", "lags"), [(True, [0, 1, 1, 0, 1, 1]), (False, [0] * 6)])
def test_data_is_one_update_old_with_overlap_but_fresh_after_a_cut(overlap, lags):
    env = Identity(16)
    spy = Spy(replace(CONFIG, overlap=overlap), env.observation_space, env.action_space)
    state = spy.init([Seeds(0)])
    train_on_policy(spy, Collector(env), state, Seeds(0), 6 * 256, cut_every=3 * 256)
    assert spy.lags == lags


@pytest.mark.filterwarnings("ignore:.*precision lowered")  # see tests/envs/test_engine.py
@pytest.mark.parametrize("engine", ["envpool", "sync"])
def test_cartpole_is_learnt_with_every_engine(engine):
    if engine == "envpool":
        pytest.importorskip("envpool")
    env = SkillEnv(make_engine(EnvSpec("CartPole-v1", engine=engine), 16, threads=1))
    ticks: list[Tick] = []
    try:
        train(env, 50, replace(CONFIG, gamma=0.98), on_tick=ticks.append)
    finally:
        env.close()
    early, late = (t.metrics["return"] for t in (ticks[3], ticks[-1]))
    assert early < 40
    assert late > 60


def test_environments_in_processes_teach_the_same_as_in_this_one():
    found = []
    for engine in ("sync", "async"):
        env = SkillEnv(make_engine(EnvSpec("CartPole-v1", engine=engine), 4, threads=1))
        try:
            found.append(train(env, 3)[1].params)
        finally:
            env.close()
    assert torch.equal(*found)


class Stop(Exception):
    pass


@pytest.mark.parametrize("overlap", [True, False])
def test_a_run_resumed_at_a_clean_cut_ends_with_the_very_same_weights(overlap):
    config = replace(CONFIG, overlap=overlap)
    once, rollout = {"cut_every": 3 * 256}, 256
    whole = train(Identity(16), 10, config, **once)[1]
    saved: list[tuple[Tick, State]] = []

    def stop_at_second_cut(tick: Tick) -> None:
        if tick.cut:
            copied = {f.name: getattr(tick.state, f.name).clone() for f in fields(State)}
            saved.append((tick, State(**copied)))
        if len(saved) == 2:
            raise Stop

    with pytest.raises(Stop):
        train(Identity(16), 10, config, on_tick=stop_at_second_cut, **once)
    tick, state = saved[-1]
    assert (tick.update, tick.steps) == (6, 6 * rollout)
    env = Identity(16)
    algorithm, _ = start(env, config)
    collector = Collector(env)
    collector.restore(unprefixed("collector", tick.extra), Seeds(0))
    at = {"update": tick.update, "steps": tick.steps}
    resumed = train_on_policy(algorithm, collector, state, Seeds(0), 10 * rollout, **at, **once)
    for f in fields(State):
        assert torch.equal(getattr(resumed, f.name), getattr(whole, f.name)), f.name


@pytest.mark.parametrize("overlap", [True, False])
def test_every_update_is_reported_once_and_in_order(overlap):
    ticks: list[Tick] = []
    train(Identity(16), 5, replace(CONFIG, overlap=overlap), cut_every=512, on_tick=ticks.append)
    assert [t.update for t in ticks] == [1, 2, 3, 4, 5]
    assert [t.steps for t in ticks] == [256, 512, 768, 1024, 1280]
    assert [t.cut for t in ticks] == [False, True, False, True, True]
    assert all(t.metrics["samples"] == 256 for t in ticks)


def test_reported_returns_and_lengths_are_those_of_whole_episodes():
    ticks: list[Tick] = []
    train(Countdown(16), 2, on_tick=ticks.append)
    assert ticks[-1].metrics["return"] == 5.0
    assert ticks[-1].metrics["length"] == 5.0


def test_a_cut_ends_no_episode():
    ticks: list[Tick] = []
    # rollouts of 3 steps, each cut, and episodes of 5
    config = replace(CONFIG, n_steps=3, batch_size=48)
    train(Countdown(16), 5, config, cut_every=3 * 16, on_tick=ticks.append)
    assert [t.cut for t in ticks] == [True] * 5
    assert ["return" in t.metrics for t in ticks] == [False, True, True, True, True]
    assert {t.metrics["length"] for t in ticks[1:]} == {5.0}


def test_a_rollout_is_full_when_its_environment_steps_are_made():
    env, ticks = Calls(16, (False, True)), []  # calls of 10 steps, where a rollout has 16
    algorithm, state = start(env)
    train_on_policy(algorithm, Collector(env), state, Seeds(0), 3 * 320, on_tick=ticks.append)
    assert [t.steps for t in ticks] == [320, 640, 960]
    assert [t.metrics["samples"] for t in ticks] == [32, 32, 32]


def test_learning_that_diverges_is_an_error_that_says_what_where_and_when():
    with pytest.raises(
        SkillweaveError, match=r"of member 0 is nan at update 0: training has diverged"
    ):
        train(Broken(16), 3)


def test_the_callback_may_stop_the_run_and_threads_are_given_back():
    torch.set_num_threads(1)

    def stop(tick: Tick) -> None:
        raise Stop

    with pytest.raises(Stop):
        train(Identity(16), 5, replace(CONFIG, threads=2), on_tick=stop)
    assert torch.get_num_threads() == 1


def test_a_checkpoint_of_other_environments_is_refused():
    one, other = Collector(Identity(16)), Collector(Identity(16))
    one.start(Seeds(0))
    state = one.state() | {"carried.sums": torch.zeros(3)}
    with pytest.raises(SkillweaveError, match=r"'sums' of open episodes is float32 \(3,\)"):
        other.restore(state, Seeds(0))
