"""The loop: what is collected and learnt when, what is told, and going on from a checkpoint."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toys import (
    BoxIdentity,
    Broken,
    Calls,
    Countdown,
    Cut,
    Identity,
    Recall,
    Toy,
    Training,
    goes_on,
    learn,
    training,
)

from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.config import DQN, PPO, SAC, TD3
from skillweave.algorithms.ppo import PPOAlgorithm
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import SkillweaveError, TrainingError
from skillweave.networks.config import RNN, Network
from skillweave.training.episodes import Tick
from skillweave.training.loop import LoopState

CONFIG = PPO(
    num_envs=16, n_steps=16, batch_size=64, update_epochs=4, learning_rate=5e-3, gamma=0.9,
    gae_lambda=0.98, ent_coef=0.0, network=Network((32,)),
)  # fmt: skip
RECURRENT = replace(CONFIG, network=Network((8,), rnn=RNN("gru", 4)))
REPLAY = DQN(
    num_envs=16, batch_size=8, learning_starts=100, buffer_size=400, update_ratio=0.05,
    network=Network((8,)),
)  # fmt: skip


def made(env: Toy, config: PPO = CONFIG) -> Training:
    return training(PPOAlgorithm(config, env.observation_space, env.action_space), env)


def train(env: Toy, updates: int, config: PPO = CONFIG, **kwargs):
    """The algorithm and its state after so many updates."""
    return learn(config, env, updates * config.n_steps * env.num_envs, **kwargs)


# What is learnt; more in tests/algorithms/test_contract.py


@pytest.mark.slow
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


# The lag, and the order of everything


class Spy(PPOAlgorithm):
    """Notes, at each update, how many updates old the policy is that collected the data."""

    def __init__(self, *args):
        super().__init__(*args)
        self.versions, self.lags, self.spent = [], [], []

    def update(self, state, batch, rng):
        self.versions.append(self.acting_params(state))
        obs, head = batch.obs.flatten(1, 2), batch.dist_params.flatten(1, 2)
        with torch.no_grad():
            heads = [self.act(a, obs, None, None)[1] for a in self.versions]
            acted = [torch.allclose(h, head) for h in heads]
        self.lags.append(acted[::-1].index(True))
        self.spent.append(batch.progress)
        return super().update(state, batch, rng)


def spied(updates: int, config: PPO = CONFIG, env: Toy | None = None, **how) -> Spy:
    env = env or Identity(16)
    spy = Spy(config, env.observation_space, env.action_space)
    training(spy, env).run(updates * config.n_steps * env.num_envs, **how)
    return spy


@pytest.mark.parametrize(("overlap", "lags"), [(True, [0] + [1] * 5), (False, [0] * 6)])
@pytest.mark.parametrize("kind", [Identity, BoxIdentity])
def test_data_is_one_update_old_with_overlap_also_after_a_checkpoint(overlap, lags, kind):
    config = replace(CONFIG, overlap=overlap)
    how = {"checkpoint_every": 3 * 256, "on_checkpoint": lambda saved: None}
    assert spied(6, config, kind(16), **how).lags == lags


@pytest.mark.parametrize("overlap", [True, False])
def test_schedules_count_from_where_a_rollout_began(overlap):
    config = replace(CONFIG, overlap=overlap)
    assert spied(4, config).spent == [0.0, 0.25, 0.5, 0.75]
    assert spied(4, config, schedule_steps=8 * 256).spent == [0.0, 0.125, 0.25, 0.375]
    assert spied(4, config, schedule_steps=2 * 256).spent == [0.0, 0.5, 1.0, 1.0]


def lags_of_replay(overlap: bool) -> list[int]:
    """How many updates old the policy is by which each experience is collected, from the 4th on."""
    config = replace(REPLAY, overlap=overlap, learning_starts=16, update_ratio=0.25)
    env = Identity(16)
    algorithm = make_algorithm(config, env.observation_space, env.action_space)
    found = training(algorithm, env)
    learn, collect = found.learner.learn, found.collectors.collect
    versions, used = [found.state.params.clone()], []

    def learnt(*about):
        metrics = learn(*about)
        versions.append(found.state.params.clone())
        return metrics

    def collected(request):
        used.append(algorithm.acting.flatten(request.params[0].views).clone())
        return collect(request)

    found.learner.learn, found.collectors.collect = learnt, collected
    found.run(16 * 9, checkpoint_every=16 * 6, on_checkpoint=lambda saved: None)
    acting = [v[:, : algorithm.acting.size] for v in versions]
    return [
        k - max(i for i, v in enumerate(acting) if torch.equal(v, used[k])) for k in range(3, 9)
    ]


def test_replay_learns_beside_collecting_if_asked_with_a_lag_of_one_update():
    assert lags_of_replay(overlap=False) == [0] * 6
    assert lags_of_replay(overlap=True) == [1] * 6


@pytest.mark.parametrize("overlap", [True, False])
def test_every_update_is_reported_once_and_in_order(overlap):
    ticks = []
    saved = []
    train(
        Identity(16),
        5,
        replace(CONFIG, overlap=overlap),
        checkpoint_every=512,
        on_tick=ticks.append,
        on_checkpoint=lambda s: saved.append((s.at.update, s.at.steps)),
    )
    assert [t.update for t in ticks] == [1, 2, 3, 4, 5]
    assert [t.steps for t in ticks] == [256, 512, 768, 1024, 1280]
    assert [t.since for t in ticks] == [0, 256, 512, 768, 1024]
    assert saved == [(2, 512), (4, 1024)]
    assert all(t.metrics["samples"] == 256 for t in ticks)


@pytest.mark.parametrize("config", [CONFIG, replace(CONFIG, overlap=False), REPLAY])
@pytest.mark.parametrize("env", [Identity, Calls])
@pytest.mark.parametrize("budget", [1, 256, 257, 1500])
def test_training_ends_within_one_rollout_of_its_budget(config, env, budget):
    made_by, ticks = env(16), []
    algorithm = make_algorithm(config, made_by.observation_space, made_by.action_space)
    end = training(algorithm, made_by).run(budget, on_tick=ticks.append)
    rollout = 16 * (config.n_steps if isinstance(config, PPO) else env.row_steps)
    assert budget <= end.steps < budget + rollout
    assert end.steps == made_by.steps_made == ticks[-1].steps
    assert end.update == ticks[-1].update == -(-budget // rollout)


def test_a_budget_that_is_spent_already_changes_nothing():
    found = made(Identity(16))
    before = found.state.params.clone()
    assert found.run(256, at=LoopState(1, 256)) == LoopState(1, 256)
    assert torch.equal(found.state.params, before)


def test_a_rollout_is_full_when_its_environment_steps_are_made():
    ticks = []  # calls of 10 steps, where a rollout has 16: they end at 10; 20, 30; 40
    train(Calls(16, (False, True)), 3, on_tick=ticks.append)
    assert [t.steps for t in ticks] == [256, 512, 768]
    assert [t.metrics["samples"] for t in ticks] == [16, 32, 16]


def test_a_rollout_in_which_no_call_ends_is_told_but_not_learnt_from():
    ticks = []
    config = replace(CONFIG, n_steps=4)
    _, state = train(Calls(16, (False, True)), 5, config, on_tick=ticks.append)
    assert ["samples" in t.metrics for t in ticks] == [False, False, True, False, True]
    assert state.count.item() == 2 * config.update_epochs


# Engines


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*precision lowered")  # see tests/envs/test_engine.py
def test_cartpole_is_learnt_in_a_pool():
    pytest.importorskip("envpool")
    env = make_engine(EnvSpec("CartPole-v1", engine="envpool"), 16, threads=1)
    ticks = []
    try:
        train(env, 50, replace(CONFIG, gamma=0.98), on_tick=ticks.append)
    finally:
        env.close()
    early, late = (t.metrics["return"] for t in (ticks[3], ticks[-1]))
    assert early < 40
    assert late > 60


def test_what_a_lost_worker_did_not_repeat_is_cut_before_rows_of_it_are_kept():
    env = Identity(16)
    algorithm = make_algorithm(REPLAY, env.observation_space, env.action_space)
    found = training(algorithm, env)
    collect, called = found.collectors.collect, []

    def collected(request):
        answer = collect(request)
        lost = np.array([2, 5]) if called.count("collect") == 3 else np.empty(0, np.int64)
        called.append("collect")
        return replace(answer, restarted=lost)

    cut, take = found.learner.cut, found.learner.take
    found.collectors.collect = collected
    found.learner.cut = lambda columns: (called.append(columns.tolist()), cut(columns))
    found.learner.take = lambda experience: (called.append("take"), take(experience))
    found.run(16 * 6)
    assert called == ["collect", "take"] * 3 + ["collect", [2, 5], "take"] + ["collect", "take"] * 2


# Checkpoints


FEW = {
    "num_envs": 4, "batch_size": 8, "learning_starts": 40, "buffer_size": 400, "gamma": 0.9,
    "network": Network((8,)), "tau": 0.05, "learning_rate": 1e-3, "update_ratio": 0.25,
}  # fmt: skip
REMEMBERS = replace(RECURRENT, num_envs=4, batch_size=16, update_epochs=1)
CUTS = {
    "ppo": (CONFIG, Identity),
    "ppo without overlap": (replace(CONFIG, overlap=False), Identity),
    "recurrent ppo": (REMEMBERS, Recall),
    "a selector": (CONFIG, Calls),
    "a recurrent selector": (REMEMBERS, Calls),
    "dqn": (DQN(**FEW), Identity),
    "rainbow": (DQN.rainbow(**FEW), Identity),
    "td3": (TD3(**FEW, normalize_obs=True), BoxIdentity),
    "sac": (SAC(**FEW, normalize_rewards=True), BoxIdentity),
    "sac of choices": (SAC(**FEW, n_step=2), Identity),
    "a selector from replay": (
        DQN(**FEW | {"normalize_rewards": True, "update_ratio": 0.7}),
        Calls,
    ),
}


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("name", CUTS)
def test_a_run_resumed_at_a_checkpoint_ends_with_the_very_same_weights_and_metrics(name):
    config, kind = CUTS[name]
    algorithm = make_algorithm(config, kind.observation_space, kind.action_space)
    rows = config.n_steps if isinstance(config, PPO) else kind.row_steps
    n, rollout = config.num_envs, rows * config.num_envs
    every = 3 * rollout if isinstance(config, PPO) else 120
    whole, saved, resumed = goes_on(algorithm, lambda: kind(n), 4 * every + 20, every)
    assert (saved.at.update, saved.at.steps) == (2 * every // rollout, 2 * every)
    if not isinstance(config, PPO):  # the store is part of it
        without = {k: v for k, v in saved.extra.items() if not k.startswith("learner.store.")}
        assert not torch.equal(resumed(without).state.params, whole.state.params)


def test_a_checkpoint_ends_no_episode():
    ticks = []
    saved = []
    # rollouts of 3 steps, a checkpoint after each but the last, and episodes of 5
    config = replace(CONFIG, n_steps=3, batch_size=48)
    how = {"checkpoint_every": 3 * 16, "on_checkpoint": saved.append}
    train(Countdown(16), 5, config, on_tick=ticks.append, **how)
    assert len(saved) == 4
    assert ["return" in t.metrics for t in ticks] == [False, True, True, True, True]
    assert {(t.metrics["return"], t.metrics["length"]) for t in ticks[1:]} == {(5.0, 5.0)}


def test_a_checkpoint_of_other_environments_is_refused():
    one, other = made(Identity(16)), made(Identity(8), replace(CONFIG, num_envs=8))
    saved = []
    one.run(512, checkpoint_every=1, on_checkpoint=saved.append)
    with pytest.raises(SkillweaveError, match=r"'age' of open episodes is int64 \(16,\)"):
        other.resume(saved[0].extra, LoopState(saved[0].at.update, saved[0].at.steps))


# Divergence and stopping


@pytest.mark.parametrize("on_tick", [None, lambda tick: None])
@pytest.mark.parametrize(
    ("config", "update"), [(CONFIG, 1), (replace(CONFIG, overlap=False), 1), (REPLAY, 63)]
)
def test_learning_that_diverges_is_an_error_that_says_what_where_and_when(config, update, on_tick):
    says = rf"of member 0 is nan at update {update}: training has diverged"
    with pytest.raises(TrainingError, match=says):
        learn(config, Broken(16), 2_000, on_tick=on_tick)


@pytest.mark.parametrize("config", [CONFIG, replace(CONFIG, overlap=False), REPLAY])
def test_nothing_is_asked_for_after_the_last_round(config, monkeypatch):
    env, asked, collected = Identity(16), [], []
    found = training(make_algorithm(config, env.observation_space, env.action_space), env)
    request, collect = found.learner.request, found.collectors.collect
    monkeypatch.setattr(
        found.learner, "request", lambda *about: asked.append(about) or request(*about)
    )
    monkeypatch.setattr(
        found.collectors, "collect", lambda what: collected.append(what) or collect(what)
    )
    end = found.run(3 * 16 * 16, checkpoint_every=16 * 16)
    assert len(asked) == len(collected) == end.update


@pytest.mark.parametrize("config", [CONFIG, replace(REPLAY, num_envs=8)])
def test_a_member_that_diverges_may_be_skipped(config):
    env, ticks = Identity(16), []
    algorithm = make_algorithm(config, env.observation_space, env.action_space)
    found = training(algorithm, env, members=range(2))
    found.state.params[1] = float("nan")
    found.run(2048, skip_diverged=True, on_tick=ticks.append)
    assert found.state.params[0].isfinite().all()
    assert all(np.isfinite(list(t.metrics.values())).all() for t in ticks)
    assert {"policy_loss", "loss"} & ticks[-1].metrics.keys()
    other = training(algorithm, Identity(16), members=range(2))
    other.state.params[1] = float("nan")
    with pytest.raises(SkillweaveError, match="of member 1 is nan"):
        other.run(2048)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("config", [CONFIG, replace(CONFIG, overlap=False), REPLAY])
def test_the_callback_may_stop_the_run_and_threads_are_given_back(config):
    torch.set_num_threads(1)

    def stop(tick: Tick):
        assert torch.get_num_threads() == (1 if config.overlap else 2)
        raise Cut

    with pytest.raises(Cut):
        learn(replace(config, threads=2), Identity(16), 2_000, on_tick=stop)
    assert torch.get_num_threads() == 1
