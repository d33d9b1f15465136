"""Rollouts with gaps: only valid rows are learnt from, as if there were no others."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from toys import members_of, random_critic, rollout_of

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Batch, Rollout
from skillweave.algorithms.config import PPO
from skillweave.algorithms.ppo import PPOAlgorithm, State
from skillweave.algorithms.rollouts import rows_where
from skillweave.buffers.rollout import RolloutStore
from skillweave.networks.config import RNN, Network

T, B, OBS, ACTIONS = 6, 4, 3, 5
CONFIG = PPO(
    num_envs=B, n_steps=T, batch_size=8, update_epochs=2, network=Network((8,)),
    normalize_obs=True, clip_value=0.2,
)  # fmt: skip
RECURRENT = replace(CONFIG, network=Network((8,), rnn=RNN("gru", 4)))
NAN = float("nan")
CELLS = (
    "obs", "action", "reward", "discount", "next_obs", "last", "mask",
    "dist_params", "episode_start",
)  # fmt: skip


def made(config: PPO, members: int) -> tuple[PPOAlgorithm, State]:
    algorithm = PPOAlgorithm(config, Box(-np.inf, np.inf, (OBS,)), Discrete(ACTIONS))
    state = algorithm.init([Seeds(m) for m in range(members)])
    random_critic(algorithm, state)
    return algorithm, state


def full(algorithm: PPOAlgorithm, state: State) -> Rollout:
    """Trajectories that hang together, without gaps."""
    return rollout_of(algorithm, state, 3, T, B, masked=True)


def with_gaps(rollout: Rollout, seed: int = 0, more: int = 5) -> Rollout:
    """The same rows in ``more`` rows more, which hold anything, and an empty column at the end."""
    members, steps, columns = rollout.reward.shape
    rng = np.random.default_rng(seed)
    valid = torch.zeros(members, steps + more, columns + 1, dtype=torch.bool)
    for m, b in np.ndindex(members, columns):
        rows = rng.choice(steps + more, steps, replace=False)
        valid[m, rows, b] = True

    def spread(x: torch.Tensor) -> torch.Tensor:
        anything = NAN if x.is_floating_point() else 1
        shape = (members, steps + more, columns + 1, *x.shape[3:])
        found = torch.full(shape, anything, dtype=x.dtype)
        for m, b in np.ndindex(members, columns):
            found[m, valid[m, :, b], b] = x[m, :, b]
        return found

    values = {name: getattr(rollout, name) for name in CELLS}
    changed = {k: None if v is None else spread(v) for k, v in values.items()}
    changed["last"] &= valid
    if rollout.recurrent_state is not None:
        changed["recurrent_state"] = torch.cat(
            [rollout.recurrent_state, rollout.recurrent_state[:, :1] * NAN], 1
        )
    return replace(rollout, **changed, valid=valid)


def packed(rollout: Rollout) -> Rollout:
    """What a store makes of experience with these rows."""
    members = len(rollout.reward)

    def columns(x: torch.Tensor):
        return x.transpose(0, 1).flatten(1, 2).clone().numpy()

    rows = {k: columns(x) for k in (*CELLS, "valid") if (x := getattr(rollout, k)) is not None}
    last, terminated = rows.pop("last"), rows.pop("discount") == 0.0
    memory = (
        None if rollout.recurrent_state is None else rollout.recurrent_state.flatten(0, 1).numpy()
    )
    store = RolloutStore(members)
    store.add(Batch(
        **rows, terminated=terminated, truncated=last & ~terminated, recurrent_state=memory,
        steps=np.ones(last.shape, np.int64),
    ))  # fmt: skip
    found = store.rollout(torch.full((members,), 0.9))
    assert found is not None
    return found


def learnt(algorithm: PPOAlgorithm, state: State, rollout: Rollout, first: int = 0):
    """State and metrics after an update; members have random streams by their number."""
    if rollout.valid is not None:
        rollout = packed(rollout)
    rng = [Seeds(first + m).torch() for m in range(len(state.params))]
    return algorithm.update(state, rollout, rng)


def assert_alike(one: State, other: State, exactly: bool = False):
    rtol, atol = (0.0, 0.0) if exactly else (1e-4, 1e-5)
    for f in fields(State):
        a, b = getattr(one, f.name), getattr(other, f.name)
        torch.testing.assert_close(a, b, rtol=rtol, atol=atol, msg=lambda x, f=f: f"{f.name}: {x}")


@pytest.mark.parametrize("config", [CONFIG, RECURRENT], ids=["mlp", "gru"])
def test_a_rollout_with_gaps_is_learnt_from_as_the_full_one_with_the_same_rows(config):
    algorithm, state = made(config, 2)
    rollout = full(algorithm, state)
    there, report = learnt(algorithm, members_of(state, slice(0, 2)), rollout)
    here, other = learnt(algorithm, members_of(state, slice(0, 2)), with_gaps(rollout))
    assert not torch.equal(there.params, state.params)
    assert_alike(here, there, exactly=True)
    assert {k: v.tolist() for k, v in other.metrics.items()} == {
        k: v.tolist() for k, v in report.metrics.items()
    }
    assert report.metrics["samples"].tolist() == [T * B] * 2


@pytest.mark.parametrize("config", [CONFIG, RECURRENT], ids=["mlp", "gru"])
def test_columns_of_different_lengths_are_learnt_from_row_by_row(config):
    # Column 0 after column 1, in one column: the same rows, as all of them are one minibatch.
    algorithm, state = made(replace(config, batch_size=T * B, update_epochs=3), 1)
    rollout = full(algorithm, state)
    if rollout.recurrent_state is not None and rollout.episode_start is not None:
        rollout.recurrent_state[:, 0] = 0.0
        rollout.episode_start[:, 0, 0] = True
    ragged = with_gaps(rollout, more=T)
    ragged.valid.zero_()
    ragged.valid[:, :T, 1:B] = ragged.valid[:, T:, 1] = True
    for name in CELLS:
        if getattr(rollout, name) is not None:
            into, rows = getattr(ragged, name), getattr(rollout, name)
            into[:, :T, :B], into[:, T:, 1] = rows, rows[:, :, 0]
    there, _ = learnt(algorithm, members_of(state, slice(0, 1)), rollout)
    here, report = learnt(algorithm, members_of(state, slice(0, 1)), ragged)
    assert report.metrics["samples"].tolist() == [T * B]
    assert_alike(here, there)


def test_networks_without_memory_run_on_valid_rows_alone(monkeypatch):
    algorithm, state = made(CONFIG, 1)
    rollout, seen = with_gaps(full(algorithm, state), more=40), []
    run = type(algorithm.critic_net).__call__

    def counted(net, views, inputs, extra=None):
        seen.append(inputs["vector"].shape[1])
        return run(net, views, inputs, extra)

    monkeypatch.setattr(type(algorithm.critic_net), "__call__", counted)
    learnt(algorithm, state, rollout)
    assert max(seen) == T * B


@pytest.mark.parametrize("config", [CONFIG, RECURRENT], ids=["mlp", "gru"])
def test_members_with_fewer_rows_are_padded_with_rows_that_do_not_count(config):
    algorithm, state = made(replace(config, batch_size=T * B, update_epochs=3), 2)
    rollout = with_gaps(full(algorithm, state))
    rollout.valid[1, :, 2:] = False
    stack, report = learnt(algorithm, members_of(state, slice(0, 2)), rollout)
    assert report.metrics["samples"].tolist() == [T * B, T * 2]
    for m in range(2):
        part = slice(m, m + 1)
        alone, own = learnt(algorithm, members_of(state, part), members_of(rollout, part), m)
        assert_alike(members_of(stack, part), alone)
        for name, value in own.metrics.items():
            torch.testing.assert_close(report.metrics[name][part], value, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("config", [CONFIG, RECURRENT], ids=["mlp", "gru"])
def test_a_member_without_rows_stays_as_it_is(config):
    algorithm, state = made(config, 2)
    rollout, before = with_gaps(full(algorithm, state)), members_of(state, slice(0, 2))
    rollout.valid[0] = False
    after, report = learnt(algorithm, state, rollout)
    for name in ("params", "mu", "nu", "count", "obs_mean", "obs_var", "return_mean"):
        assert torch.equal(getattr(after, name)[0], getattr(before, name)[0]), name
    assert all(v.isfinite().all() for v in report.metrics.values())
    assert not torch.equal(after.params[1], before.params[1])


def test_rows_that_are_true_come_first():
    flags = torch.tensor([[0, 1, 0, 1, 1], [1, 0, 0, 0, 0]], dtype=torch.bool)
    assert rows_where(flags).tolist() == [[1, 3, 4], [0, 1, 2]]
