"""Recorded batches are a source like environments: learners learn from them, and resume exactly."""

from __future__ import annotations

import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from reference_calls import Walk
from toy_acting import Choices, requests
from toys import alone_in

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Batch
from skillweave.algorithms.config import DQN
from skillweave.algorithms.policy import make_algorithm
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import RunError
from skillweave.experience.source import Recorded
from skillweave.training.episodes import Episodes
from skillweave.training.learner import Stack
from skillweave.training.loop import Loop
from skillweave.training.replay_learner import learner_of

N = 4
CONFIG = DQN(num_envs=N, buffer_size=2_000, batch_size=16, gamma=0.0, learning_rate=3e-3)


def recorded(rows: int = 100) -> Batch:
    """What random actions did in walks, whose reward follows from what is seen and done."""
    engine = make_engine(EnvSpec(Walk, engine="sync"), N)
    collector = alone_in(engine, Choices(N, 3))  # type: ignore[arg-type]
    collector.start(Seeds(3))
    (request,) = itertools.islice(requests(rows), 1)
    batch = collector.collect(request).batches[""]
    return batch.replace(dist_params=None, reward=(batch["action"] == 2).astype(np.float32))


def learner() -> Any:
    algorithm = make_algorithm(CONFIG, Walk.observation_space, Walk.action_space)
    made: Any = learner_of(Stack(algorithm, algorithm.init([Seeds(0)])), N, Seeds(1))
    made.learn_from_the_start()
    return made


def source(rows: int = 100) -> Recorded:
    return Recorded({"": recorded(rows)}, Walk.observation_space, Walk.action_space)


def test_a_learner_learns_from_recorded_rows_alone_and_a_budget_counts_updates() -> None:
    made, rows = learner(), source()
    at = Loop(made, rows, Episodes(()), Seeds(5), 400, counts="updates").run()
    assert (at.update, at.steps, rows.steps_made) == (400, 0, 0)
    (stack,) = made.stacks
    obs = torch.from_numpy(recorded()["obs"].reshape(1, -1, 4))
    greedy, *_ = stack.algorithm.act(stack.algorithm.acting_params(stack.state), obs, None, None)
    assert (greedy == 2).float().mean() > 0.95, "the action that was paid"


def test_rows_come_in_their_order_and_again_and_trajectories_end_there() -> None:
    rows, batch = source(10), recorded(10)
    found = [rows.collect(request) for request in itertools.islice(requests(4), 5)]
    assert [len(f.batches[""]["obs"]) for f in found] == [4, 4, 2, 4, 4]
    whole = np.concatenate([f.batches[""]["obs"] for f in found[:3]])
    np.testing.assert_array_equal(whole, batch["obs"])
    np.testing.assert_array_equal(found[3].batches[""]["obs"], batch["obs"][:4])
    assert [f.begun_anew.tolist() for f in found] == [[0, 1, 2, 3], [], [], [0, 1, 2, 3], []]


def test_a_state_continues_at_its_row() -> None:
    first, second = source(10), source(10)
    asked = list(itertools.islice(requests(4), 3))
    first.collect(asked[0])
    second.restore(first.state())
    for request in asked[1:]:
        one, two = (s.collect(request).batches[""]["obs"] for s in (first, second))
        np.testing.assert_array_equal(one, two)
    with pytest.raises(RunError, match="at row 12 of 10"):
        second.restore({"row": np.array([12])})


Box, Discrete = gym.spaces.Box, gym.spaces.Discrete


@pytest.mark.parametrize(
    ("observations", "actions", "says"),
    [
        (Box(0, 1, (3,)), Walk.action_space, r"recorded observations are float32 \(4,\), but"),
        (Walk.observation_space, Discrete(2), r"recorded actions are int64 \(\), up to 2, but"),
        (Walk.observation_space, Box(0, 1, (2,)), r"recorded actions .* of Box"),
    ],
)
def test_rows_of_other_spaces_are_refused(observations: Any, actions: Any, says: str) -> None:
    with pytest.raises(RunError, match=says):
        Recorded({"": recorded(10)}, observations, actions)


def test_batches_of_different_lengths_are_refused() -> None:
    batches = {"a": recorded(10), "b": recorded(9)}
    with pytest.raises(RunError, match="all need the same"):
        Recorded(batches, Walk.observation_space)
    with pytest.raises(RunError, match="all need the same"):
        Recorded({}, Walk.observation_space)
