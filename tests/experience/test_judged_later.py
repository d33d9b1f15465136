"""What is judged while it is collected is the same when it is judged later, from stored rows."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from reference_calls import POSITION, TAG, T, Walk
from test_levels import Down, Up, asked, collector_of
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
from skillweave.errors import EnvError, TrainingError
from skillweave.experience.judge import JudgedBy, judged_by
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


class Limited(Forever):
    """A limit, and a reward for the last step before it."""

    max_steps = 3

    def reward(self, step: Any) -> Any:
        return step.elapsed + 10.0 * step.timed_out


class Stops(Forever):
    """Ends by itself, by what the environment says in info."""

    max_steps = 7

    def termination(self, step: Any) -> Any:
        return (step.info["t"] >= 2) & (step.next_obs[:, POSITION] > 0)

    def reward(self, step: Any) -> Any:
        return 1.0 * step.info["t"] - 5.0 * step.terminated + 2.0 * step.truncated


class Late(Stops):
    """May start only where the tag is even or the time has come, so rows are not all valid."""

    def initiation(self, obs: Any) -> Any:
        return (obs[:, TAG] % 2 == 0) | (obs[:, T] > 1)


class TaskPaid(Skill):
    """The environment's own reward, until a limit."""

    max_steps = 4


class Opposite(Stops):
    """Judges the same steps otherwise: ends elsewhere, and pays the other way round."""

    max_steps = None

    def termination(self, step: Any) -> Any:
        return step.next_obs[:, POSITION] < 0

    def reward(self, step: Any) -> Any:
        return -super().reward(step)


def rows_of(skill: Skill | None, judge: JudgedBy, rows: int) -> list[Batch]:
    engine = make_engine(SPEC, N)
    collector = alone_in(engine, Choices(N, 3), skill)  # type: ignore[arg-type]
    collector.start(Seeds(3))
    asked = (replace(request, record=judge.raw) for request in requests(rows))
    return [collector.collect(r).batches[""] for r in itertools.islice(asked, 12)]


def store_of(n_step: int, judge: JudgedBy | None, raw: tuple[str, ...] = ()) -> ReplayStore:
    space = Walk.observation_space
    how: Any = {"mask_size": 3, "n_step": n_step, "between": True, "relabel": judge, "raw": raw}
    return ReplayStore(400, N, 1, space, (), np.int64, **how)


@pytest.mark.parametrize("n_step", [1, 3])
@pytest.mark.parametrize("kind", [Forever, Limited, Stops, Late, TaskPaid])
def test_rows_judged_when_drawn_are_as_they_were_judged_when_collected(
    kind: Any, n_step: int
) -> None:
    judge = judged_by(kind(), SPEC)
    stored, later = store_of(n_step, None), store_of(n_step, judge)
    for batch in rows_of(kind(), judge, 7):
        stored.add(batch)
        # What it was judged when it was collected must not count.
        later.add(batch.replace(reward=np.full_like(batch["reward"], 99.0)))
    first = stored.sample(300, GAMMA, [np.random.default_rng(0)])
    second = later.sample(300, GAMMA, [np.random.default_rng(0)])
    for name in ("obs", "action", "reward", "discount", "next_obs"):
        torch.testing.assert_close(getattr(second, name), getattr(first, name))
    if n_step > 1:
        torch.testing.assert_close(second.between_discount, first.between_discount)
    ends = {float(x) for x in first.discount.unique()}
    assert 0.0 in ends, "some rows terminated"
    assert len(ends) > 1


def test_rows_of_one_skill_are_judged_by_another() -> None:
    """By hand, slot by slot: the n rows end where the judge says, not where they were collected."""
    judge = judged_by(Opposite(), SPEC)
    store, plain, n = store_of(3, judge), list[Batch](), 3
    for batch in rows_of(None, judge, 7):
        store.add(batch)
        plain.append(batch)
    whole = {k: np.concatenate([b[k] for b in plain]) for k in plain[0]}
    at = {
        (tuple(whole["obs"][t, i]), int(whole["action"][t, i])): (t, i)
        for t, i in np.ndindex(whole["reward"].shape)
    }
    sample = store.sample(200, GAMMA, [np.random.default_rng(1)])
    longer = 0
    for row in range(200):
        obs = sample.obs[0, row].numpy()
        t, i = at[tuple(obs), int(sample.action[0, row])]
        reward, discount = 0.0, 1.0
        for k in range(n):
            u = t + k
            end, cut = whole["env_terminated"][u, i], whole["env_truncated"][u, i]
            own = whole["next_obs"][u, i, POSITION] < 0
            pays = -(1.0 * whole["info.t"][u, i] - 5.0 * end + 2.0 * cut)
            reward, discount = reward + discount * pays, discount * 0.9
            longer += k > 0
            if end or own:
                discount = 0.0
            if end or own or cut or u + 1 == len(whole["reward"]):
                break
        assert sample.reward[0, row].item() == pytest.approx(reward, abs=1e-4)
        assert sample.discount[0, row].item() == pytest.approx(discount, abs=1e-6)
    assert longer > 100


def test_a_key_of_info_that_nobody_gives_cannot_be_recorded() -> None:
    with pytest.raises(EnvError, match=r"info\['missing'\] is to be recorded, but no environment"):
        rows_of(None, JudgedBy(Stops(), ("missing",)), 2)


def test_decisions_with_their_whole_calls_cannot_be_judged_again() -> None:
    judge = JudgedBy(Stops(), ("t",))
    store = store_of(1, judge)
    for batch in rows_of(None, judge, 4):
        batch["steps"][:] = 2
        store.add(batch)
    with pytest.raises(TrainingError, match="several steps cannot be judged again"):
        store.sample(3, GAMMA, [np.random.default_rng(0)])


def test_a_state_of_a_store_holds_its_raw_columns() -> None:
    judge = JudgedBy(Stops(), ("t",))
    store, again = store_of(3, judge), store_of(3, judge)
    for batch in rows_of(Stops(), judge, 7):
        store.add(batch)
    again.load(store.state())
    first, second = (s.sample(50, GAMMA, [np.random.default_rng(0)]) for s in (store, again))
    torch.testing.assert_close(first.reward, second.reward)
    torch.testing.assert_close(first.discount, second.discount)


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


@pytest.mark.parametrize("call_steps", [1, 4])
def test_rows_of_skills_that_learn_below_selectors_are_judged_the_same_later(
    call_steps: int,
) -> None:
    collector = collector_of(Whole, 5, call_steps)
    seen = 0
    for request in itertools.islice(asked(40, collector), 4):
        batches = collector.collect(replace(request, record=JudgedBy(Whole()).raw)).batches
        for path in ("up", "whole/down"):
            leaf = next(s for s in LEAVES if path.endswith(s.name))
            rows, valid = batches[path], batches[path]["valid"]
            again = JudgedBy(leaf)(rows)
            np.testing.assert_array_equal(again["reward"][valid], rows["reward"][valid])
            np.testing.assert_array_equal(again["terminated"][valid], rows["terminated"][valid])
            seen += int(valid.sum())
    assert seen > 300


class Whole(Skill):
    """A hierarchy among the skills."""


LEAVES = (Up(), Down())
