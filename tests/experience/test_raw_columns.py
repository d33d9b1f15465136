"""Raw columns of experience: recorded and stored where an algorithm asks for them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from reference_calls import POSITION, Walk
from toy_acting import Choices, requests
from toys import alone_in

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Batch
from skillweave.algorithms.config import DQN, PPO
from skillweave.algorithms.dqn import DQNAlgorithm
from skillweave.algorithms.policy import make_algorithm
from skillweave.buffers.replay import ReplayStore
from skillweave.buffers.rollout import RolloutStore
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import EnvError
from skillweave.skills import Skill
from skillweave.training.learner import Stack
from skillweave.training.replay_learner import learner_of

N = 5
SPEC = EnvSpec(Walk, engine="sync")
GAMMA = torch.tensor([0.9])


class Forever(Skill):
    """Its own reward; no end of its own."""

    def reward(self, step: Any) -> Any:
        return step.reward + step.next_obs[:, POSITION] - 0.1 * step.action


def rows_of(*raw: str) -> list[Batch]:
    collector = alone_in(make_engine(SPEC, N), Choices(N, 3), Forever())  # type: ignore[arg-type]
    collector.start(Seeds(3))
    asked = (replace(request, record=raw) for request in requests(7))
    return [collector.collect(r).batches[""] for r in itertools.islice(asked, 12)]


def test_a_key_of_info_that_nobody_gives_cannot_be_recorded() -> None:
    with pytest.raises(EnvError, match=r"info\['missing'\] is to be recorded, but no environment"):
        rows_of("info.missing")


def test_a_state_of_a_store_holds_its_raw_columns() -> None:
    raw = ("env_reward",)

    def made() -> ReplayStore:
        space = Walk.observation_space
        return ReplayStore(400, N, 1, space, (), np.int64, mask_size=3, n_step=3, raw=raw)

    store, again = made(), made()
    for batch in rows_of(*raw):
        store.add(batch)
    again.load(store.state())
    first, second = (s.sample(50, GAMMA, [np.random.default_rng(0)]) for s in (store, again))
    torch.testing.assert_close(first.env_reward, second.env_reward)
    torch.testing.assert_close(first.reward, second.reward)


class Watches(DQNAlgorithm):
    """DQN that also gets the environment's own reward."""

    raw = ("env_reward",)


def test_replay_and_rollouts_carry_the_environments_own_reward_where_it_is_asked_for() -> None:
    config = DQN(num_envs=N, buffer_size=200, learning_starts=8, batch_size=4)
    for kind in (Watches, DQNAlgorithm):
        algorithm = kind(config, Walk.observation_space, Walk.action_space)
        learner = learner_of(Stack(algorithm, algorithm.init([Seeds(0)])), N, Seeds(1))
        request = learner.request(0, 0, 0.0)
        assert request.record == kind.raw
        engine = make_engine(SPEC, N)
        collector = alone_in(engine, Choices(N, 3), Forever())  # type: ignore[arg-type]
        collector.start(Seeds(3))
        for one in itertools.islice(requests(9), 4):
            batches = collector.collect(replace(one, record=request.record)).batches
            learner.take(batches)
        store: Any = learner.store  # type: ignore[attr-defined]
        sample = store.sample(30, GAMMA, [np.random.default_rng(0)])
        assert (sample.env_reward is None) == (kind is DQNAlgorithm)
        rollouts = RolloutStore(1)
        rollouts.add(batches[""])
        rollout = rollouts.rollout(GAMMA)
        assert rollout is not None
        assert (rollout.env_reward is None) == (kind is DQNAlgorithm)
        if kind is Watches:
            own = sample.next_obs[0, :, POSITION] - 0.1 * sample.action[0]
            torch.testing.assert_close(sample.env_reward[0], sample.reward[0] - own)
            own = rollout.next_obs[..., POSITION] - 0.1 * rollout.action
            torch.testing.assert_close(rollout.env_reward, rollout.reward - own)


def test_an_algorithm_that_asks_for_nothing_records_nothing() -> None:
    made = make_algorithm(PPO(num_envs=N), Walk.observation_space, Walk.action_space)
    assert made.raw == ()
