"""Learners from replay: when they learn, from what, and what they keep of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from toys import (
    Calls,
    Countdown,
    Echo,
    Identity,
    Steady,
    learn,
    training,
)

from skillweave._internal.prefixes import unprefixed
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.config import DQN, SAC, TD3
from skillweave.algorithms.dqn import DQNAlgorithm
from skillweave.errors import SkillweaveError
from skillweave.experience.acting import Acting
from skillweave.experience.group import Collectors
from skillweave.networks.config import Network
from skillweave.training.episodes import Episodes
from skillweave.training.learner import Stack, crossed
from skillweave.training.loop import Loop, LoopState
from skillweave.training.replay_learner import ReplayLearner, store_of

SETTINGS = {
    "num_envs": 4, "batch_size": 8, "learning_starts": 40, "buffer_size": 400, "gamma": 0.9,
    "network": Network((8,)),
}  # fmt: skip
CONFIG = DQN(**SETTINGS)


class Spy(DQNAlgorithm):
    """Notes when it learns and acts, and from what."""

    def __init__(self, *args):
        super().__init__(*args)
        self.log = []
        self.samples = []
        self.spent = []

    def random_actions(self, *args) -> torch.Tensor:
        self.log.append("random")
        return super().random_actions(*args)

    def act(self, *args, **kwargs):
        self.log.append("act")
        return super().act(*args, **kwargs)

    def update(self, state, batch, rng):
        self.log.append("learn")
        self.samples.append(batch)
        self.spent.append(batch.progress)
        return super().update(state, batch, rng)


def spied(config: DQN, budget: int, env=None, members: int = 1, shared: bool = False, **how) -> Spy:
    env = env or Identity(4 * members)
    spy = Spy(config, env.observation_space, env.action_space)
    training(spy, env, members=range(members), shared=shared).run(budget, **how)
    return spy


# When


@pytest.mark.parametrize(
    ("settings", "acts", "learns"),
    [
        ({}, 15, 60),
        ({"update_ratio": 0.25}, 15, 15),
        ({"update_ratio": 0.1}, 15, 6),
        ({"update_ratio": 2.0}, 15, 120),
        ({"train_freq": 5}, 15, 60),
        ({"learning_starts": 0}, 25, 100),
        ({"learning_starts": 1000}, 0, 0),
    ],
)
def test_gradient_steps_are_due_by_transitions_after_the_random_ones(settings, acts, learns):
    log = spied(replace(CONFIG, **settings), 100).log
    assert log.count("act") == acts
    assert log.count("random") == 25 - acts
    assert log.count("learn") == learns
    if acts and "learning_starts" not in settings:
        assert log.index("random") == 0
        assert "random" not in log[log.index("learn") :]


def test_gradient_steps_follow_the_round_that_they_are_due_after():
    log = spied(replace(CONFIG, train_freq=5, learning_starts=40), 80).log
    assert log == ["random"] * 10 + (["act"] * 5 + ["learn"] * 20) * 2


@pytest.mark.parametrize("row_steps", [1, 10])
def test_a_selector_learns_by_its_decisions_and_its_budget_counts_steps(row_steps):
    ticks = []
    env = Calls(4, (False, True))
    env.row_steps = row_steps
    spy = spied(CONFIG, 1000, env, on_tick=ticks.append)
    assert ticks[-1].steps == 1000
    assert ticks[-1].update == 250 // row_steps
    assert spy.log.count("random") + spy.log.count("act") == 25
    assert spy.log.count("random") == 1  # learning_starts counts steps, too
    assert spy.log.count("learn") == 96
    assert spy.spent == pytest.approx(np.repeat(np.arange(80, 1001, 40), 4) / 1000)


@pytest.mark.parametrize(("members", "ratio"), [(1, 0.3), (3, 0.3), (3, 1.0)])
def test_no_gradient_step_is_lost_or_made_twice_however_many_members_there_are(members, ratio):
    config = replace(CONFIG, update_ratio=ratio, learning_starts=0, train_freq=3)
    env = Calls(4 * members)  # a call lasts 1 or 10 steps
    spy = Spy(config, env.observation_space, env.action_space)
    found = training(spy, env, members=range(members))
    found.run(600 * members)
    made = float(found.learner.counts()["transitions"][1])
    assert len(found.learner.store) == pytest.approx(made * members)
    assert spy.log.count("learn") == int(made * ratio) > 5


def test_reports_come_every_so_many_steps_wherever_checkpoints_are_written(monkeypatch):
    assert ReplayLearner.report_every == 1000
    monkeypatch.setattr(ReplayLearner, "report_every", 100)
    ticks, saved = [], []
    config = replace(CONFIG, update_ratio=0.05)
    how = {"checkpoint_every": 150, "on_tick": ticks.append, "on_checkpoint": saved.append}
    learn(config, Countdown(4), 300, **how)
    assert [t.steps for t in ticks] == [100, 200, 300]
    assert [t.update for t in ticks] == [25, 50, 75]
    assert len(saved) == 1  # none at the end
    assert unprefixed("learner.store", saved[0].extra)
    assert ticks[-1].metrics["return"] == ticks[-1].metrics["length"] == 5.0
    assert {"loss", "q", "grad_norm", "learning_rate"} <= ticks[-1].metrics.keys()
    saved.clear()
    learn(replace(config, save_buffer=False), Countdown(4), 300, **how)
    assert unprefixed("collector", saved[0].extra)
    assert not unprefixed("learner.store", saved[0].extra)


def test_a_multiple_is_crossed_where_it_is_reached():
    assert [crossed(10, *x) for x in ((0, 9), (9, 10), (10, 19), (11, 20), (5, 35))] == [
        False, True, False, True, True,
    ]  # fmt: skip


# From what


@pytest.mark.slow
def test_priorities_come_back_and_their_correction_becomes_whole():
    config = replace(CONFIG, prioritized=True, priority_beta=0.4)
    spy = spied(config, 400)
    assert all(s.weight is not None for s in spy.samples)
    assert any((s.weight < 1).any() for s in spy.samples[4:])
    assert all(s.weight.max() == 1 for s in spy.samples)
    assert all(s.weight is None for s in spied(CONFIG, 100).samples)


def test_members_learn_from_their_own_columns_or_share_all():
    def seen(shared: bool) -> list[set[int]]:
        spy = spied(CONFIG, 300, members=3, shared=shared)
        index = np.concatenate([s.index for s in spy.samples], axis=1) % 12
        return [set(row.tolist()) for row in index]

    assert seen(False) == [set(range(4)), set(range(4, 8)), set(range(8, 12))]
    assert seen(True) == [set(range(12))] * 3


@pytest.mark.parametrize("n_step", [1, 2])
def test_a_member_learns_from_shared_calls_with_its_own_discount(n_step):
    env, gamma = Steady(12), torch.tensor([0.5, 0.9, 0.99])
    spy = Spy(replace(CONFIG, n_step=n_step), env.observation_space, env.action_space)
    state = spy.init([Seeds(m) for m in range(3)])
    state.gamma[:] = gamma
    training(spy, env, state=state, shared=True).run(2400)
    reward = torch.cat([s.reward for s in spy.samples], 1)
    discount = torch.cat([s.discount for s in spy.samples], 1)
    assert spy.samples[-1].index.shape == (3, 8)
    for m, g in enumerate(gamma.tolist()):
        lasts = {g ** (10 * k): (1 - g ** (10 * k)) / (1 - g) for k in range(1, n_step + 1)}
        for d, r in zip(discount[m].tolist(), reward[m].tolist(), strict=True):
            known = min(lasts, key=lambda x, d=d: abs(x - d))
            assert d == pytest.approx(known, rel=1e-4)
            assert r == pytest.approx(lasts[known], rel=1e-4)


def test_a_checkpoint_ends_no_episode_and_nothing_is_learnt_as_an_end():
    ticks = []
    how = {"checkpoint_every": 4 * 3, "on_checkpoint": lambda saved: None}
    spy = spied(CONFIG, 4 * 7 * 6, Countdown(4), on_tick=ticks.append, **how)
    assert {t.metrics["length"] for t in ticks[1:]} <= {5.0}
    for s in spy.samples:  # what follows the step t is t + 1, also at a cut
        assert torch.equal(s.next_obs, s.obs + 1)
        assert torch.equal(s.discount == 0.0, s.obs == 4)


def test_where_environments_begin_anew_trajectories_and_returns_end():
    config = replace(CONFIG, normalize_rewards=True, gamma=0.5, n_step=2)
    env = Countdown(4)
    algorithm = make_algorithm(config, env.observation_space, env.action_space)
    found = training(algorithm, env)
    found.run(4 * 2)  # in each environment the steps 0 and 1
    found.learner.cut(np.array([1, 3]))
    assert found.learner.counts()["returns"].tolist() == [1.5, 0.0, 1.5, 0.0]
    found.collectors.parts[0]._reset(np.array([1, 3]))
    found.run(4 * 4, at=LoopState(2, 8))
    drawn = found.learner.store.sample(500, found.state.gamma, [np.random.default_rng(0)])
    after = {(int(o), int(n)) for o, n in zip(drawn.obs[0], drawn.next_obs[0], strict=True)}
    assert after == {(0, 2), (1, 3), (2, 4), (3, 4), (1, 2)}


# Going on


def test_a_resumed_run_without_its_store_fills_it_by_what_it_has_learnt():
    env = Identity(4)
    spy = Spy(replace(CONFIG, save_buffer=False), env.observation_space, env.action_space)
    found = training(spy, env, goes_on_at=200)
    found.run(400, at=LoopState(50, 200))
    assert "random" not in spy.log
    assert spy.log[:11] == ["act"] * 11  # until there are more than 40 transitions again
    assert spy.log[11:16] == ["learn"] * 4 + ["act"]


# Scales


@pytest.mark.parametrize("kind", [DQN, SAC, TD3])
def test_observations_and_returns_are_scaled_by_all_that_was_seen(kind):
    config = kind(**SETTINGS, normalize_obs=True, normalize_rewards=True)
    env = Echo(4, "vector", "Box" if kind is TD3 else "Discrete")
    algorithm, state = learn(config, env, 200)
    assert state.obs_count.item() == pytest.approx(200)
    assert state.return_count.item() == pytest.approx(200)
    assert state.obs_mean.abs().max() < 0.3  # signs, about as often −1 as 1
    assert state.obs_var.flatten().tolist() == pytest.approx([1.0, 1.0], abs=0.1)
    rows = torch.from_numpy(env.show(np.arange(4)))[None]
    shown = algorithm.inputs(algorithm.acting_params(state), rows)["vector"]
    expected = (rows - state.obs_mean[:, None]) / (state.obs_var[:, None] + 1e-8).sqrt()
    torch.testing.assert_close(shown, expected)


@pytest.mark.parametrize("row_steps", [1, 25])
def test_returns_of_calls_are_discounted_by_their_length(row_steps):
    config = replace(CONFIG, normalize_rewards=True, gamma=0.9)
    env = Calls(4, (False, True))
    env.row_steps = row_steps
    _, state = learn(config, env, 4 * 10 * 30)
    returns, running = [], 0.0
    for _ in range(30):
        running = 3 + 0.9**10 * running
        returns.append(running)
    assert state.return_mean.item() == pytest.approx(np.mean(returns), rel=1e-4)


def test_members_have_scales_of_their_own_by_their_own_discounts():
    config = replace(CONFIG, normalize_rewards=True)
    env = Countdown(8)
    algorithm = make_algorithm(config, env.observation_space, env.action_space)
    state = algorithm.init([Seeds(0), Seeds(1)])
    state.gamma[:] = torch.tensor([0.0, 0.5])
    found = training(algorithm, env, state=state)
    found.run(8 * 50)
    returns = [2 * (1 - 0.5**t) for t in range(1, 6)]  # within each episode 1, 1.5, …
    assert found.state.return_mean.flatten().tolist() == pytest.approx(
        [1.0, np.mean(returns)], rel=1e-4
    )
    assert found.state.return_var.flatten().tolist() == pytest.approx(
        [0.0, np.var(returns)], rel=1e-3, abs=1e-6
    )


# What cannot be


@pytest.mark.usefixtures("little_memory")
def test_a_store_that_does_not_fit_into_memory_is_refused_before_training():
    config = replace(CONFIG, buffer_size=10**9)
    algorithm = make_algorithm(config, Identity.observation_space, Identity.action_space)
    with pytest.raises(SkillweaveError, match=r"but 1\.0 GiB are free: lower buffer_size"):
        store_of(algorithm, 4)


def test_stacks_side_by_side_share_one_store_and_each_has_its_rows_by_its_own_ratio():
    env = Identity(12)
    stacks, spies = [], []
    for members, ratio in (1, 1.0), (2, 0.5):
        config = replace(CONFIG, update_ratio=ratio)
        spies.append(Spy(config, env.observation_space, env.action_space))
        stacks.append(Stack(spies[-1], spies[-1].init([Seeds(m) for m in range(members)])))

    store = store_of(spies[0], 12, 3, shared=True)
    learner = ReplayLearner(stacks, store, Seeds(0))
    collector = env.collector(Acting([(s.algorithm, s.members) for s in stacks], 12))
    Loop(learner, Collectors([collector], 3), Episodes(), Seeds(0), 300).run()
    # 100 steps of each member, 40 of them at random.
    assert [s.log.count("learn") for s in spies] == [60, 30]
    assert [s.samples[0].reward.shape[0] for s in spies] == [1, 2]
    for spy in spies:
        columns = np.concatenate([s.index for s in spy.samples], axis=1) % 12
        assert [set(row.tolist()) for row in columns] == [set(range(12))] * len(columns)
