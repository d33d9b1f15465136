"""What the environment itself paid reaches algorithms that ask for it, beside a skill's reward."""

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
from skillweave.algorithms.config import DQN
from skillweave.algorithms.dqn import DQNAlgorithm
from skillweave.buffers.rollout import RolloutStore
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.skills import Skill
from skillweave.training.learner import Stack
from skillweave.training.replay_learner import store_of
from skillweave.training.stack_learner import learner_of

N = 5
GAMMA = torch.tensor([0.9])


class Forever(Skill):
    """Its own reward; no end of its own."""

    def reward(self, step: Any) -> Any:
        return step.reward + step.next_obs[:, POSITION] - 0.1 * step.action


class Watches(DQNAlgorithm):
    """DQN that also gets the environment's own reward."""

    raw = ("env_reward",)


@pytest.mark.parametrize("kind", [Watches, DQNAlgorithm])
def test_replay_and_rollouts_carry_the_environments_own_reward_where_it_is_asked_for(
    kind: Any,
) -> None:
    config = DQN(num_envs=N, buffer_size=200, learning_starts=8, batch_size=4)
    algorithm = kind(config, Walk.observation_space, Walk.action_space)
    learner: Any = learner_of(Stack(algorithm, algorithm.init([Seeds(0)])), N, Seeds(1))
    request = learner.request(0, 0, 0.0)
    assert request.record == kind.raw
    engine = make_engine(EnvSpec(Walk, engine="sync"), N)
    collector = alone_in(engine, Choices(N, 3), Forever())  # type: ignore[arg-type]
    collector.start(Seeds(3))
    for one in itertools.islice(requests(9), 4):
        batches = collector.collect(replace(one, record=request.record)).batches
        learner.take(batches)
    again = store_of(algorithm, N)
    again.load(learner.store.state())
    rollouts = RolloutStore(1)
    rollouts.add(batches[""])
    draws = [s.sample(30, GAMMA, [np.random.default_rng(0)]) for s in (learner.store, again)]
    for found in (*draws, rollouts.rollout(GAMMA)):
        assert found is not None
        assert (found.env_reward is None) == (kind is DQNAlgorithm)
        if found.env_reward is not None:
            own = found.next_obs[..., POSITION] - 0.1 * found.action
            torch.testing.assert_close(found.env_reward, found.reward - own)
