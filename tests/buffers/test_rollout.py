from dataclasses import fields

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from skillweave.algorithms.batches import Batch, Rollout
from skillweave.buffers.rollout import RolloutStore
from skillweave.errors import RunError
from skillweave.spaces import action_codec, obs_dtype

T, P, B, A, M = 3, 2, 2, 3, 5
GAMMA = torch.tensor([0.9, 0.5])
SPACE, CODEC = gym.spaces.Box(-1, 1, (2,)), action_codec(gym.spaces.Discrete(1000))


def experience(rows=T, terminated=(), truncated=(), steps=1, columns=P * B) -> Batch:
    """Observations say (time, column), rewards 10 · time + column; the successor is t + 0.5.

    ``terminated`` and ``truncated`` are cells (time, column).
    """
    time, column = np.indices((rows, columns))
    obs = np.stack([time, column], -1).astype(np.float32)
    ends = [np.zeros((rows, columns), bool) for _ in range(2)]
    for end, cells in zip(ends, (terminated, truncated), strict=True):
        for cell in cells:
            end[cell] = True
    return Batch(
        obs=obs,
        action=100 * time + column,
        reward=(10 * time + column).astype(np.float32),
        steps=np.broadcast_to(steps, (rows, columns)).copy(),
        terminated=ends[0],
        truncated=ends[1],
        next_obs=obs + np.float32([0.5, 0]),
        dist_params=np.repeat(obs[..., :1] + 7, A, -1),
        recurrent_state=np.repeat(np.float32(column[:1].T), M, 1) if rows else None,
        episode_start=time == 0,
    )


def rollout(*experiences: Batch, quota=0, **kwargs) -> Rollout:
    store = RolloutStore(P, quota)
    for e in experiences:
        store.add(e)
    return store.rollout(GAMMA, **kwargs)


# All cells valid


def test_columns_are_member_after_member():
    r = rollout(experience(), progress=0.25)
    expected = torch.tensor([[[0.0, 1], [10, 11], [20, 21]], [[2, 3], [12, 13], [22, 23]]])
    assert torch.equal(r.reward, expected)
    assert torch.equal(r.action, (expected + 90 * (expected // 10)).long())
    assert torch.equal(r.obs[..., 0], torch.arange(3.0)[None, :, None].expand(P, T, B))
    assert torch.equal(r.obs[..., 1], torch.tensor([[0.0, 1], [2, 3]])[:, None].expand(P, T, B))
    assert torch.equal(r.next_obs, r.obs + torch.tensor([0.5, 0]))
    assert torch.equal(r.dist_params, (r.obs[..., :1] + 7).expand(P, T, B, A))
    assert torch.equal(r.recurrent_state[..., 0], torch.tensor([[0.0, 1], [2, 3]]))
    assert torch.equal(r.episode_start, r.obs[..., 0] == 0)
    assert r.log_std is None
    assert r.progress == 0.25
    assert r.mask is None
    assert r.valid is None
    rows = [r.obs, r.action, r.reward, r.next_obs, r.last, r.discount, r.dist_params]
    assert all(x[p].is_contiguous() for x in rows for p in range(P))


def test_masks_travel_with_their_observations():
    e = experience()
    e = e.replace(mask=np.random.default_rng(0).random((T, P * B, A)) < 0.5)
    r = rollout(e)
    for t in range(T):
        assert torch.equal(r.mask[:, t].flatten(0, 1), torch.from_numpy(e["mask"][t]))


def test_rows_of_one_member_are_not_copied():
    e = experience()
    store = RolloutStore(1)
    store.add(e)
    r = store.rollout(torch.ones(1))
    for name in ("obs", "action", "reward", "next_obs", "dist_params", "recurrent_state"):
        assert np.shares_memory(getattr(r, name).numpy(), e[name])
    assert not e.ended[-1].any()  # and the experience is as it was


def test_structured_observations_become_bytes():
    space = gym.spaces.Dict({"a": gym.spaces.Box(-1, 1, (2,), np.float64)})
    e, kind = experience(), obs_dtype(space)
    e = e.replace(obs=np.zeros((T, P * B), kind), next_obs=np.zeros((T, P * B), kind))
    e["obs"]["a"] = np.random.default_rng(0).random((T, P * B, 2))
    for valid in None, np.arange(P * B) < 3:
        e = e.replace(valid=None if valid is None else np.broadcast_to(valid, (T, P * B)))
        found = rollout(e).obs
        assert found.shape == (P, T, B, kind.itemsize)
        found = found[1, :, 0].numpy().copy().view(kind).ravel()
        assert np.array_equal(found, e["obs"][:, 2])


def test_rollouts_are_on_the_learners_device():
    store = RolloutStore(P, device="meta")
    e = experience(steps=2)
    e = e.replace(valid=np.eye(P * B, dtype=bool)[:T], mask=np.ones((T, P * B, A), bool))
    store.add(e)
    r = store.rollout(GAMMA)
    tensors = [x for f in fields(Rollout) if isinstance(x := getattr(r, f.name), torch.Tensor)]
    assert len(tensors) == 11
    assert {x.device.type for x in tensors} == {"meta"}


# Gaps


def test_without_valid_rows_there_is_nothing_to_learn_from():
    store = RolloutStore(P)
    assert store.rollout(GAMMA) is None
    e = experience()
    e = e.replace(valid=np.zeros((T, P * B), bool))
    store.add(e)
    store.add(experience(rows=0))
    assert store.rollout(GAMMA) is None
    store.add(experience())
    assert store.rollout(GAMMA).valid is None
    assert store.rollout(GAMMA) is None  # each is learnt from once


def test_valid_rows_come_first_and_the_rectangle_is_as_high_as_the_fullest_column():
    e = experience(4, terminated=[(1, 0), (2, 1)])
    e = e.replace(valid=np.array([[0, 1, 0, 1], [1, 0, 0, 1], [0, 0, 0, 0], [1, 0, 0, 0]], bool))
    r = rollout(e)
    assert r.valid.tolist() == [[[True, True], [True, False]], [[True, False], [True, False]]]
    # Column 2 is empty: it stands behind column 3, as the other member has two.
    # Column 0 has times 1 (terminated) and 3, column 1 time 0, column 3 times 0 and 1.
    assert r.reward[r.valid].tolist() == [10, 1, 30, 3, 13]
    assert r.last.tolist() == [[[True, True], [True, False]], [[False, False], [True, False]]]
    assert r.discount[r.valid].tolist() == pytest.approx([0, 0.9, 0.9, 0.5, 0.5])
    assert r.episode_start[r.valid].tolist() == [False, True, False, True, False]
    assert torch.equal(r.recurrent_state[..., 0], torch.tensor([[0.0, 1], [3, 2]]))


def test_rows_that_are_not_valid_repeat_valid_ones_so_that_nothing_is_out_of_range():
    e = experience(5)
    e = e.replace(valid=np.zeros((5, P * B), bool))
    e["valid"][1:3, 2] = True
    e = e.replace(
        mask=np.repeat(e["valid"][..., None], A, -1)
    )  # elsewhere nothing at all is allowed
    e["obs"][~e["valid"]] = e["reward"][~e["valid"]] = e["dist_params"][~e["valid"]] = np.nan
    r = rollout(e, experience(3))
    assert r.obs.shape == (P, 3, 3, 2)  # the second member has three columns
    assert r.mask.all()
    for x in r.obs, r.reward, r.dist_params, r.discount:
        assert x.isfinite().all()
    assert not r.last[~r.valid].any()


def test_columns_without_a_valid_row_are_left_out():
    e = experience()
    e = e.replace(valid=np.ones((T, P * B), bool))
    e["valid"][:, [0, 3]] = False
    r = rollout(e)
    assert r.valid is None
    assert r.reward.tolist() == [[[1], [11], [21]], [[2], [12], [22]]]
    assert r.recurrent_state[..., 0].tolist() == [[1], [2]]


def test_what_is_not_valid_has_no_nan_of_another_member():
    e = experience()
    e = e.replace(valid=np.ones((T, P * B), bool))
    e["valid"][1:, [1, 3]] = False
    e["dist_params"][:, :B] = np.nan  # the first has diverged
    r = rollout(e)
    assert r.valid.sum((1, 2)).tolist() == [T + 1] * P
    assert r.dist_params[0].isnan().all()
    assert r.dist_params[1].isfinite().all()


# Several experiences, side by side


def test_a_quota_collects_until_every_member_has_enough():
    store = RolloutStore(P, quota=4)
    e = experience(2)
    e = e.replace(
        valid=np.array([[1, 1, 1, 0], [1, 1, 0, 0]], bool)
    )  # 4 rows of the first, 1 of the other
    for _ in range(3):
        store.add(e)
        assert store.rollout(GAMMA) is None
    store.add(e)
    r = store.rollout(GAMMA)
    assert r.valid.sum((1, 2)).tolist() == [16, 4]
    assert store.rollout(GAMMA) is None


def test_experiences_lie_side_by_side_with_their_memory():
    """The second is longer, has steps and a mask, which the first has not."""
    first, second = experience(2), experience(3, terminated=[(0, 0)], steps=2)
    second = second.replace(mask=np.zeros((3, P * B, A), bool))
    second["recurrent_state"][:] += 50
    r = rollout(first, second)
    assert r.valid.tolist() == [[[True] * 4, [True] * 4, [False, False, True, True]]] * P
    assert r.reward[r.valid].tolist() == [
        *[0, 1, 0, 1, 10, 11, 10, 11, 20, 21],
        *[2, 3, 2, 3, 12, 13, 12, 13, 22, 23],
    ]
    assert r.recurrent_state[..., 0].tolist() == [[0, 1, 50, 51], [2, 3, 52, 53]]
    assert r.last[0].tolist() == [[False, False, True, False], [True, True, False, False],
                                  [False, False, True, True]]  # fmt: skip
    assert r.discount[0, 0].tolist() == pytest.approx([0.9, 0.9, 0.0, 0.81])
    assert r.mask[:, :2, :2].all()
    assert not r.mask[:, :, 2:].any()


def test_each_experience_keeps_the_deviation_that_it_was_acted_with():
    store, again = RolloutStore(P), RolloutStore(P)
    first, second = torch.full((P, 1, 1, A), -1.0), torch.full((P, 1, 1, A), 2.0)
    first[1] = -3.0
    e = experience(2)
    e = e.replace(
        valid=np.array([[1, 0, 1, 1], [1, 0, 0, 1]], bool)
    )  # a column of member 0 is empty
    store.add(e, first)
    again.load(store.state(), SPACE, CODEC)
    for each in store, again:
        each.add(experience(3), second)
        r = each.rollout(GAMMA)
        assert r.log_std.shape == (P, 1, 4, A)
        own = r.log_std[..., 0].expand(P, 3, 4)[r.valid].tolist()
        assert own.count(-1.0) == 2
        assert own.count(-3.0) == 3
        assert own.count(2.0) == 6 + 6
    store.add(experience(), second)
    assert torch.equal(store.rollout(GAMMA).log_std, second)


@given(
    seed=st.integers(0, 2**32 - 1),
    shapes=st.lists(st.sampled_from([0, 1, 2, 5, 40]), min_size=1, max_size=4),
    filled=st.sampled_from([1.0, 0.7, 0.2]),
)
@settings(max_examples=60, deadline=None)
def test_every_valid_row_is_there_once_in_its_order_and_cut_at_its_end(seed, shapes, filled):
    rng, gamma = np.random.default_rng(seed), GAMMA.numpy()
    store = RolloutStore(P)
    expected: list[list[list[tuple]]] = [[] for _ in range(P)]  # by member and column, its rows
    for i, rows in enumerate(shapes):
        e = experience(rows, steps=rng.integers(1, 4, (rows, P * B)))
        e["reward"][:] += np.float32(1000 * i)
        e["terminated"][:] = rng.random((rows, P * B)) < 0.3
        e["truncated"][:] = rng.random((rows, P * B)) < 0.1
        e = e.replace(valid=rng.random((rows, P * B)) < filled)
        store.add(e)
        for c in range(P * B) if e["valid"].any() else ():  # else it is not kept
            times = e["valid"][:, c].nonzero()[0]
            discount = gamma[c // B] ** e["steps"][:, c] * ~e["terminated"][:, c]
            ends = e.ended[:, c] | (np.arange(rows) == times.max(initial=-1))
            expected[c // B].append([(e["reward"][t, c], discount[t], ends[t]) for t in times])
    r = store.rollout(GAMMA)
    if r is None:
        assert not any(rows for columns in expected for rows in columns)
        return
    valid = torch.ones_like(r.last) if r.valid is None else r.valid
    filled = [[rows for rows in columns if rows] for columns in expected]
    assert r.reward.shape[2] == max(len(columns) for columns in filled)
    for p in range(P):
        empty = [[]] * (r.reward.shape[2] - len(filled[p]))
        for c, rows in enumerate(filled[p] + empty):
            assert valid[p, :, c].tolist() == [t < len(rows) for t in range(r.reward.shape[1])]
            for t, (reward, discount, last) in enumerate(rows):
                assert r.reward[p, t, c] == reward
                assert r.discount[p, t, c] == pytest.approx(discount)
                assert r.last[p, t, c] == last
    assert not r.last[~valid].any()


def test_a_state_goes_on_exactly_and_is_a_copy():
    store, other = RolloutStore(P, quota=10), RolloutStore(P, quota=10)
    e = experience(2, steps=3)
    e = e.replace(valid=np.array([[1, 0, 1, 1], [1, 1, 0, 1]], bool))
    for _ in range(3):
        store.add(e)
    other.add(experience())  # gives way
    other.load(store.state(), SPACE, CODEC)
    found = []
    for each in store, other:
        assert each.rollout(GAMMA) is None
        each.add(experience(2))
        found.append(each.rollout(GAMMA))
    for name in (f.name for f in fields(Rollout) if f.name not in ("log_std", "mask")):
        assert np.array_equal(*(getattr(r, name) for r in found)), name
    alone = RolloutStore(1)
    alone.add(e)
    state = alone.state()
    e["recurrent_state"][:] += 99
    assert (state["0.recurrent_state"] < 99).all()
    assert RolloutStore(1).state() == {}


@pytest.mark.parametrize(
    ("space", "codec", "name"),
    [
        (gym.spaces.Box(-1, 1, (2,), np.float64), CODEC, "obs"),
        (gym.spaces.Box(-1, 1, (3,)), CODEC, "obs"),
        (SPACE, action_codec(gym.spaces.Box(-1, 1, (2,))), "action"),
    ],
)
def test_rows_of_other_spaces_are_not_loaded(space, codec, name):
    store = RolloutStore(P)
    store.add(experience())
    with pytest.raises(RunError, match=f"rows have {name!r} .* environment has changed"):
        RolloutStore(P).load(store.state(), space, codec)
