from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from skillweave.training.collector import Collector
from skillweave.training.off_policy import make_buffer, train_off_policy
from toys import BoxIdentity, Broken, Calls, Countdown, Echo, Identity, learn

from skillweave.algorithms.config import DQN, SAC, TD3
from skillweave.algorithms.dqn import DQNAlgorithm
from skillweave.algorithms.policy import make_algorithm
from skillweave.networks.config import Network
from skillweave.seeding import Seeds
from skillweave.training.episodes import Tick
from skillweave.types import SkillweaveError, unprefixed

SETTINGS: dict[str, Any] = {
    "num_envs": 4, "batch_size": 8, "learning_starts": 40, "buffer_size": 400, "gamma": 0.9,
    "network": Network((8,)),
}  # fmt: skip
CONFIG = DQN(**SETTINGS)


class Stop(Exception):
    pass


class Spy(DQNAlgorithm):
    """Notes when it learns and acts, and from what."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.log: list[str] = []
        self.samples: list[Any] = []
        self.spent: list[float] = []

    def random_actions(self, *args: Any) -> torch.Tensor:
        self.log.append("random")
        return super().random_actions(*args)

    def act(self, *args: Any, **kwargs: Any) -> Any:
        self.log.append("act")
        return super().act(*args, **kwargs)

    def update(self, state: Any, batch: Any, rng: Any) -> Any:
        self.log.append("learn")
        self.samples.append(batch)
        self.spent.append(batch.progress)
        return super().update(state, batch, rng)


def spied(config: DQN, budget: int, env: Any = None, members: int = 1, **where: Any) -> Spy:
    env = env or Identity(4 * members)
    spy = Spy(config, env.observation_space, env.action_space)
    state = spy.init([Seeds(m) for m in range(members)])
    train_off_policy(spy, Collector(env), state, Seeds(0), budget, **where)
    return spy


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


def test_a_selector_learns_by_its_decisions_and_its_budget_counts_steps():
    ticks: list[Tick] = []
    spy = spied(CONFIG, 1000, Calls(4, (False, True)), on_tick=ticks.append)
    assert ticks[-1].steps == 1000
    assert spy.log.count("random") + spy.log.count("act") == 25
    assert spy.log.count("random") == 1  # learning_starts counts steps, too
    assert spy.log.count("learn") == 96
    assert spy.spent == pytest.approx(np.repeat(np.arange(80, 1001, 40), 4) / 1000)


def test_priorities_come_back_and_their_correction_becomes_whole():
    config = replace(CONFIG, prioritized=True, priority_beta=0.4)
    spy = spied(config, 400)
    assert all(s.weight is not None for s in spy.samples)
    assert any((s.weight < 1).any() for s in spy.samples[4:])
    assert all(s.weight.max() == 1 for s in spy.samples)
    assert all(s.weight is None for s in spied(CONFIG, 100).samples)


def test_an_n_step_sample_counts_its_own_discount():
    spy = spied(replace(CONFIG, n_step=3), 1000, Calls(4, (False, True)))
    found = torch.cat([s.discount.flatten() for s in spy.samples]).unique()
    assert found.tolist() == pytest.approx([0.9**30, 0.9**20, 0.9**10], rel=1e-4)
    full = spy.samples[0].reward[spy.samples[0].discount < 0.9**25]
    assert full.tolist() == pytest.approx([3 * (1 + 0.9**10 + 0.9**20)] * len(full), rel=1e-4)


def test_members_learn_from_their_own_columns_or_share_all():
    def seen(shared: bool) -> list[set[int]]:
        spy = spied(CONFIG, 300, members=3, shared=shared)
        index = np.concatenate([s.index for s in spy.samples], axis=1) % 12
        return [set(row.tolist()) for row in index]

    assert seen(False) == [set(range(4)), set(range(4, 8)), set(range(8, 12))]
    assert seen(True) == [set(range(12))] * 3


def test_reports_come_every_thousand_steps_and_at_cuts_and_the_buffer_at_cuts_but_the_last():
    ticks: list[Tick] = []
    config = replace(CONFIG, update_ratio=0.05)
    learn(config, Countdown(4), 3000, cut_every=1500, on_tick=ticks.append)
    assert [t.steps for t in ticks] == [1000, 1500, 2000, 3000]
    assert [t.update for t in ticks] == [250, 375, 500, 750]
    assert [t.cut for t in ticks] == [False, True, False, True]
    assert [t.extra is not None for t in ticks] == [False, True, False, False]  # none at the end
    assert ticks[-1].metrics["return"] == ticks[-1].metrics["length"] == 5.0
    assert {"loss", "q", "grad_norm", "learning_rate"} <= ticks[-1].metrics.keys()
    ticks.clear()
    once = {"cut_every": 1000, "on_tick": ticks.append}
    learn(replace(config, save_buffer=False), Countdown(4), 2000, **once)
    assert unprefixed("collector", ticks[0].extra)
    assert not unprefixed("buffer", ticks[0].extra)


def test_a_cut_ends_no_episode_and_nothing_is_learnt_as_an_end():
    ticks: list[Tick] = []
    spy = spied(CONFIG, 4 * 7 * 6, Countdown(4), cut_every=4 * 3, on_tick=ticks.append)
    assert {t.metrics["length"] for t in ticks[1:]} == {5.0}
    for s in spy.samples:  # what follows the step t is t + 1, also at a cut
        assert torch.equal(s.next_obs, s.obs + 1)
        assert torch.equal(s.discount == 0.0, s.obs == 4)


FEW = {"tau": 0.05, "learning_rate": 1e-3}
KINDS = {
    "dqn": (DQN(**SETTINGS, **FEW), Identity),
    "rainbow": (DQN.rainbow(**SETTINGS, **FEW), Identity),
    "td3": (TD3(**SETTINGS, **FEW, normalize_obs=True), BoxIdentity),
    "sac": (SAC(**SETTINGS, **FEW, normalize_rewards=True), BoxIdentity),
    "sac of choices": (SAC(**SETTINGS, **FEW, n_step=2), Identity),
}


def copied(state: Any) -> Any:
    return type(state)(**{f.name: getattr(state, f.name).clone() for f in fields(state)})


@pytest.mark.parametrize("name", KINDS)
def test_a_run_resumed_at_a_clean_cut_ends_with_the_very_same_weights(name):
    config, kind = KINDS[name]
    once = {"cut_every": 120}
    _, whole = learn(config, kind(4), 500, **once)
    saved: list[tuple[Tick, Any]] = []

    def stop_at_second_cut(tick: Tick) -> None:
        if tick.cut:
            saved.append((tick, copied(tick.state)))
        if len(saved) == 2:
            raise Stop

    with pytest.raises(Stop):
        learn(config, kind(4), 500, on_tick=stop_at_second_cut, **once)
    tick, state = saved[-1]
    assert (tick.update, tick.steps) == (60, 240)

    def under_way() -> Collector:
        collector = Collector(kind(4))
        collector.restore(unprefixed("collector", tick.extra), Seeds(0))
        return collector

    where = {"saved": unprefixed("buffer", tick.extra), "update": 60, "steps": 240, **once}
    where["collector"] = under_way()
    _, resumed = learn(config, kind(4), 500, state=copied(state), **where)
    for f in fields(state):
        assert torch.equal(getattr(resumed, f.name), getattr(whole, f.name)), f.name
    # The buffer is part of it:
    where |= {"saved": None, "collector": under_way()}
    _, without = learn(config, kind(4), 500, state=copied(state), **where)
    assert not torch.equal(without.params, whole.params)


def test_a_resumed_run_without_its_buffer_fills_it_by_what_it_has_learnt():
    env = Identity(4)
    spy = Spy(replace(CONFIG, save_buffer=False), env.observation_space, env.action_space)
    state = spy.init([Seeds(0)])
    train_off_policy(spy, Collector(env), state, Seeds(0), 400, update=50, steps=200)
    assert "random" not in spy.log
    assert spy.log[:11] == ["act"] * 11  # until there are more than 40 transitions again
    assert spy.log[11:16] == ["learn"] * 4 + ["act"]


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


def test_returns_are_discounted_sums_within_episodes():
    config = replace(CONFIG, normalize_rewards=True, gamma=0.5)
    _, state = learn(config, Countdown(4), 4 * 50)
    returns = [2 * (1 - 0.5**t) for t in range(1, 6)]  # 1, 1.5, … and anew
    assert state.return_mean.item() == pytest.approx(np.mean(returns), rel=1e-4)
    assert state.return_var.item() == pytest.approx(np.var(returns), rel=1e-3)


def test_returns_of_calls_are_discounted_by_their_length():
    config = replace(CONFIG, normalize_rewards=True, gamma=0.9)
    _, state = learn(config, Calls(4, (False, True)), 4 * 10 * 30)
    returns, running = [], 0.0
    for _ in range(30):
        running = 3 + 0.9**10 * running
        returns.append(running)
    assert state.return_mean.item() == pytest.approx(np.mean(returns), rel=1e-4)


def test_learning_that_diverges_is_an_error_that_says_what_where_and_when():
    with pytest.raises(SkillweaveError, match=r"of member 0 is nan at update 25.*has diverged"):
        learn(CONFIG, Broken(4), 100, on_tick=lambda tick: None)


def test_the_callback_may_stop_the_run_and_threads_are_given_back():
    torch.set_num_threads(1)

    def stop(tick: Tick) -> None:
        assert torch.get_num_threads() == 2
        raise Stop

    with pytest.raises(Stop):
        learn(replace(CONFIG, threads=2), Identity(4), 80, on_tick=stop)
    assert torch.get_num_threads() == 1


def test_a_buffer_that_does_not_fit_into_memory_is_refused_before_training():
    config = replace(CONFIG, buffer_size=10**13)
    algorithm = make_algorithm(config, Identity.observation_space, Identity.action_space)
    with pytest.raises(SkillweaveError, match="lower buffer_size"):
        make_buffer(algorithm, Identity(4), 1)
