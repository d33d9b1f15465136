from dataclasses import fields
from types import SimpleNamespace
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from plain_replay import SPACE, A, World

from skillweave.algorithms.batches import Batch, Sample
from skillweave.buffers import ram
from skillweave.buffers.replay import ReplayStore
from skillweave.errors import SkillweaveError
from skillweave.spaces import action_codec, obs_dtype
from skillweave.training.replay_learner import store_of

GAMMA = torch.tensor([0.9, 0.5, 0.99])
CHOICE = np.zeros(1, np.int64)


def generators(members: int, seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng([seed, p]) for p in range(members)]


def same(a: Sample, b: Sample) -> bool:
    def equal(x, y) -> bool:
        return y is None if x is None else np.array_equal(x, y)

    return all(equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(Sample))


def make(capacity: int, num_envs: int = 1, members: int = 1, **kwargs) -> ReplayStore:
    return ReplayStore(capacity, num_envs, members, SPACE, CHOICE, choices=A, **kwargs)


# One column by hand: observations are the time, the true successor of an ended step is t + 0.5


def line(rewards, ends="", capacity=100, steps=None, at_once=1, **kwargs) -> ReplayStore:
    """``ends`` has a letter a step: t terminated, l time limit, . goes on; c is a cut."""
    store = make(capacity, **kwargs)
    ends = ends.ljust(len(rewards), ".")
    time = np.arange(len(rewards), dtype=np.float32)
    ended = np.array([end in "tl" for end in ends])
    obs, after = (np.repeat(x[:, None, None], 2, 2) for x in (time, time + 1 - 0.5 * ended))
    for t in range(0, len(rewards), at_once):
        part = slice(t, t + at_once)
        store.add(
            Batch(
                obs=obs[part],
                action=(np.arange(len(rewards)) % A)[part, None],
                reward=np.float32(rewards)[part, None],
                steps=np.array(steps or [1] * len(rewards))[part, None],
                terminated=np.array([[end == "t"] for end in ends])[part],
                truncated=np.array([[end == "l"] for end in ends])[part],
                next_obs=after[part],
            )
        )
        if ends[t] == "c":
            store.cut(np.arange(1))
    return store


def by_time(store: ReplayStore, gamma: float = 0.5) -> dict[int, tuple[float, float, float]]:
    """Time to reward, discount and next_obs, of everything that can be sampled."""
    s = store.sample(1000, torch.tensor([gamma]), generators(1))
    rows = zip(s.obs[0, :, 0], s.reward[0], s.discount[0], s.next_obs[0, :, 0], strict=True)
    return {int(t): (float(r), float(d), float(n)) for t, r, d, n in rows}


@pytest.mark.parametrize("at_once", [1, 3, 4])
def test_one_step(at_once):
    store = line([1, 2, 4, 8], ".tl.", at_once=at_once)
    assert len(store) == 4
    assert by_time(store) == {
        0: (1, 0.5, 1), 1: (2, 0, 1.5), 2: (4, 0.5, 2.5), 3: (8, 0.5, 4)
    }  # fmt: skip


def test_n_steps_stop_at_ends_cuts_and_the_newest_step():
    assert by_time(line([1, 2, 4, 8], n_step=3)) == {
        0: (1 + 2 / 2 + 4 / 4, 0.125, 3),
        1: (2 + 4 / 2 + 8 / 4, 0.125, 4),
        2: (4 + 8 / 2, 0.25, 4),
        3: (8, 0.5, 4),
    }
    for end, factor, successor in ("t", 0, 1.5), ("l", 1, 1.5), ("c", 1, 2):
        found = by_time(line([1, 2, 4, 8], f".{end}", n_step=3))
        assert found[0] == (2, 0.25 * factor, successor)
        assert found[1] == (2, 0.5 * factor, successor)
        assert found[2] == (8, 0.25, 4)
    calls = line([1, 2, 4], steps=[1, 3, 2], n_step=2)  # discounted by their length
    assert by_time(calls) == {0: (2, 1 / 16, 2), 1: (2.5, 1 / 32, 3), 2: (4, 0.25, 3)}


@pytest.mark.parametrize("at_once", [1, 2, 10])
def test_overwritten_steps_are_gone_and_an_end_takes_the_room_of_a_step(at_once):
    store = line(range(10), "l.....l", capacity=4, at_once=at_once)
    assert len(store) == 3
    assert by_time(store) == {7: (7, 0.5, 8), 8: (8, 0.5, 9), 9: (9, 0.5, 10)}
    store = line(range(9), "l......l", capacity=4, at_once=at_once)
    assert by_time(store) == {6: (6, 0.5, 7), 7: (7, 0.5, 7.5), 8: (8, 0.5, 9)}


def test_what_adds_nothing_changes_nothing():
    store = make(10)
    store.cut(np.arange(1))
    assert len(store) == 0
    store = line([1, 2], ".c")
    before = store.state()
    store.cut(np.arange(1))  # again
    nobody = World(store, 1, np.random.default_rng(0), filled=0.0)
    store.add(nobody.collect(3))
    store.add(nobody.collect(0))
    after = store.state()
    assert all(torch.equal(after[name], before[name]) for name in before)


# Everything else against the plainest replay there is


@pytest.mark.slow
@given(
    seed=st.integers(0, 2**32 - 1),
    members=st.integers(1, 3),
    width=st.integers(1, 3),
    rows=st.integers(1, 9),
    n_step=st.integers(1, 5),
    ending=st.sampled_from([0.0, 0.2, 0.6, 1.0]),
    longest=st.sampled_from([1, 10]),
    masked=st.sampled_from([0.0, 0.5, 1.0]),
    filled=st.sampled_from([1.0, 0.6, 0.1]),
    shared=st.booleans(),
    prioritized=st.booleans(),
    between=st.booleans(),
    told=st.booleans(),
    plan=st.lists(st.sampled_from("11111135csu"), min_size=1, max_size=30),
)
@settings(max_examples=150, deadline=None)
def test_samples_equal_a_plain_lists(
    seed, members, width, rows, n_step, ending, longest, masked, filled, shared, prioritized,
    between, told, plan,
):  # fmt: skip
    n, gamma, rng = members * width, GAMMA[:members], np.random.default_rng(seed)

    def made() -> ReplayStore:
        return make(
            rows * n + n - 1, n, members, shared=shared, n_step=n_step, prioritized=prioritized,
            between=between,
        )  # fmt: skip

    world = World(made(), n, rng, ending, longest, masked, filled, told and shared)
    for what in ["1", *plan, "s"]:
        store = world.store
        if what.isdigit():
            world.add(int(what))
            live = world.live(rows + 1)
            assert len(store) == len(live)
            own = {index % n // (n if shared else width) for index in live}
            assert store.ready == (len(own) == (1 if shared else members))
        elif what == "c":
            world.cut()
        elif not store.ready:
            with pytest.raises(AssertionError, match="before add"):
                store.sample(1, gamma, generators(members))
        elif what == "u":
            drawn = store.sample(4, gamma, generators(members, seed))
            new = torch.from_numpy(rng.random((members, 4), dtype=np.float32))
            store.update_priorities(drawn.index, new)
        else:
            check(world, rows + 1, gamma, n_step, shared, seed)
            other = made()
            other.load({k: v.clone() for k, v in store.state().items()})
            same_draws = [b.sample(9, gamma, generators(members)) for b in (store, other)]
            assert same(*same_draws)
            world.store = other  # and goes on in the copy


def check(
    world: World, rows: int, gamma: torch.Tensor, n_step: int, shared: bool, seed: int
) -> None:
    members, n = len(gamma), world.num_envs
    sample = world.store.sample(30, gamma, generators(members, seed), progress=0.5)
    assert sample.progress == 0.5
    assert set(sample.index.ravel().tolist()) <= world.live(rows)
    for p in range(members):
        own = sample.index[p] % n * members // n == p
        assert shared or own.all()
        for b, index in enumerate(sample.index[p]):
            expected = world.expected(int(index), n_step, float(gamma[p]))
            for name, value in expected.items():
                found = getattr(sample, name)
                if found is None:
                    alone = n_step == 1 or not world.store._between
                    assert "mask" in name or (alone and "between" in name)
                    assert alone or value.all()
                elif name in ("between_obs", "between_mask"):  # what counts for nothing is any
                    counts = expected["between_discount"] > 0.0
                    np.testing.assert_array_equal(found[p, b][counts], value[counts])
                else:
                    np.testing.assert_allclose(found[p, b], value, rtol=1e-5)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("prioritized", [False, True])
def test_every_transition_is_drawn_as_often_however_long_columns_and_episodes_are(
    shared, prioritized
):
    """Columns are filled 1 : 3 : 9 : 27, and the fullest has overwritten its oldest."""
    store = make(4 * 16, 4, 2, shared=shared, prioritized=prioritized)
    world = World(store, 4, np.random.default_rng(0), ending=0.3)
    for c, rows in enumerate((1, 3, 9, 27)):
        for _ in range(rows):
            store.add(world.collect(only=c))
    live = world.live(17)
    assert len(store) == len(live)
    drawn = store.sample(12_000, GAMMA[:2], generators(2)).index
    for p in range(2):
        own = sorted(i for i in live if shared or i % 4 // 2 == p)
        values, counts = np.unique(drawn[p], return_counts=True)
        assert values.tolist() == own
        expected = 12_000 / len(own)
        assert ((counts - expected) ** 2 / expected).sum() < 50  # about 25 degrees: p about 0.002


def test_one_filled_column_of_many_is_sampled():
    store = make(512 * 300, 512)
    world = World(store, 512, np.random.default_rng(0), ending=0.0)
    for _ in range(300):
        store.add(world.collect(only=7))
    drawn = store.sample(3000, GAMMA[:1], generators(1)).index
    assert (drawn % 512 == 7).all()
    assert len(np.unique(drawn)) > 295


# Kinds of data


def rows_of(obs, action, after, truncated=None) -> Batch:
    """One row of plain steps."""
    n = len(action)
    no = np.zeros((1, n), bool)
    return Batch(
        obs=obs[None],
        action=action[None],
        reward=np.zeros((1, n), np.float32),
        steps=np.ones((1, n), np.int64),
        terminated=no,
        truncated=no if truncated is None else truncated[None],
        next_obs=after[None],
    )


def test_boxes_of_actions_stay_as_they_are_and_choices_become_int64():
    action, obs = np.random.default_rng(0).random((2, 3), dtype=np.float32), np.zeros((2, 2))
    boxes = ReplayStore(10, 2, 2, SPACE, action[:1])
    boxes.add(rows_of(obs, action, obs))
    sample = boxes.sample(1, GAMMA[:2], generators(2))
    assert torch.equal(sample.action[:, 0], torch.from_numpy(action))
    assert sample.mask is None
    assert sample.next_mask is None
    assert sample.weight is None
    for choices, bytes_each in (256, 1), (257, 2), (40_000, 4):
        store = ReplayStore(10, 2, 2, SPACE, CHOICE, choices=choices)
        store.add(rows_of(obs, np.array([0, choices - 1]), obs))
        sample = store.sample(1, GAMMA[:2], generators(2))
        assert sample.action.dtype == torch.int64
        assert sample.action.tolist() == [[0], [choices - 1]]
        assert store.state()["action"].element_size() == bytes_each


def test_structured_observations_become_bytes():
    space = gym.spaces.Dict(
        {"far": gym.spaces.Box(-1, 1, (2,), np.float64), "near": gym.spaces.Discrete(7)}
    )
    rng, kind = np.random.default_rng(0), obs_dtype(space)
    first, true = (np.zeros(2, kind) for _ in range(2))
    for obs in (first, true):
        obs["far"], obs["near"] = rng.random((2, 2)), rng.integers(7, size=2)
    store, other = (ReplayStore(6, 2, 2, space, CHOICE, choices=A) for _ in range(2))
    store.add(rows_of(first, np.zeros(2), true, np.array([False, True])))
    other.load(store.state())
    for b in store, other:
        sample = b.sample(1, GAMMA[:2], generators(2))
        for found, expected in (sample.obs, first), (sample.next_obs, true):
            assert found.dtype == torch.uint8
            assert np.array_equal(found.numpy().view(kind).reshape(2), expected)


def test_samples_are_on_the_learners_device():
    store = World(make(9, n_step=2, prioritized=True, between=True, device="meta"), 1,
                  np.random.default_rng(0), masked=1.0)  # fmt: skip
    store.add(5)
    sample = store.store.sample(4, GAMMA[:1], generators(1))
    others = ("index", "progress", "env_reward", "critic_alone")
    tensors = [getattr(sample, f.name) for f in fields(Sample) if f.name not in others]
    assert {x.device.type for x in tensors} == {"meta"}
    assert isinstance(sample.index, np.ndarray)


# Going on from a checkpoint


def test_the_store_keeps_copies_and_so_does_its_state():
    store = make(8, 2, prioritized=True)
    world = World(store, 2, np.random.default_rng(0), longest=10, masked=1.0, filled=0.7)
    for _ in range(7):
        e = world.collect(2)
        store.add(e)
        e["obs"][:] += 99
        e["next_obs"][:] += 99
    state, before = store.state(), store.sample(9, GAMMA[:1], generators(1))
    for _ in range(5):
        world.add()
    store.load(state)
    assert same(before, store.sample(9, GAMMA[:1], generators(1)))
    assert before.obs.max() < 99
    assert before.next_obs.max() < 99


@pytest.mark.parametrize("prioritized", [False, True])
def test_a_state_without_masks_and_calls_replaces_one_with_them(prioritized):
    def world(masked, longest, rows):
        store = make(8, 2, shared=True, prioritized=prioritized)
        found = World(store, 2, np.random.default_rng(0), 0.3, longest, masked)
        found.add(rows)
        return found

    plain, rich = world(0.0, 1, 2), world(1.0, 10, 6)
    rich.store.load(plain.store.state())
    draws = [w.store.sample(9, GAMMA[:1], generators(1)) for w in (plain, rich)]
    assert same(*draws)
    assert len(rich.store) == len(plain.store)


def test_a_checkpoint_of_other_settings_is_refused():
    state = line([1, 2, 4], capacity=8).state()
    with pytest.raises(SkillweaveError) as error:
        ReplayStore(8, 1, 1, gym.spaces.Box(-1, 1, (3,)), CHOICE).load(state)
    assert str(error.value) == (
        "the checkpoint's replay buffer does not fit: 'obs' is torch.float32 (4, 2), where "
        "torch.float32 (4, 3) belongs; continue with the settings that it was written with, or "
        "start a new run"
    )
    with pytest.raises(SkillweaveError, match=r"'priority' is missing"):
        make(8, prioritized=True).load(state)
    with pytest.raises(SkillweaveError, match=r"'newest' is torch.int64 \(1,\), where .* \(2,\)"):
        make(8, 2).load(state)


# Size


def test_a_million_lunar_lander_transitions_take_at_most_90_megabytes():
    space = gym.spaces.Box(-1, 1, (8,), np.float32)
    for prioritized in False, True:
        store = ReplayStore(1_000_000, 16, 1, space, CHOICE, choices=4, prioritized=prioritized)
        assert store.nbytes <= (43e6 if prioritized else 39e6)
        e = rows_of(np.zeros((16, 8)), np.zeros(16), np.zeros((16, 8)))
        e["steps"][:] = 2
        store.add(e.replace(mask=np.ones((1, 16, 4), bool)))
        assert store.nbytes <= 90e6  # with masks and calls


def test_more_than_the_memory_is_an_error_that_says_how_much_would_fit():
    space = gym.spaces.Box(0, 255, (4, 84, 84), np.uint8)
    with (
        mock.patch.object(ram, "free_memory", return_value=int(11.2 * 2**30)),
        pytest.raises(SkillweaveError) as error,
    ):
        ReplayStore(1_000_000, 8, 1, space, CHOICE, choices=6)
    assert str(error.value) == (
        "a replay buffer of 1,000,000 transitions of (4, 84, 84) uint8 needs 26.3 GiB, "
        "but 11.2 GiB are free: lower buffer_size (at most about 425,997)"
    )
    free = ram.free_memory()
    assert free is None or 2**20 < free < 2**50


def test_the_room_for_rewards_of_calls_counts_as_well():
    def fits(free: int, **kwargs) -> bool:
        with mock.patch.object(ram, "free_memory", return_value=free):
            try:
                make(1000, **kwargs)
            except SkillweaveError:
                return False
        return True

    each = 8 + 1 + 4 + 1  # obs, action, reward, kind
    assert [fits(1000 * each + k) for k in (-1, 0)] == [False, True]
    assert [fits(1000 * (each + 12) + k, shared=True) for k in (-1, 0)] == [False, True]
    assert [fits(1000 * (each + 4) + k, prioritized=True) for k in (-1, 0)] == [False, True]
    world = World(make(1000, shared=True), 1, np.random.default_rng(0), longest=9, told=True)
    with (
        mock.patch.object(ram, "free_memory", return_value=1500),
        pytest.raises(SkillweaveError, match=r"room for the rewards of .* steps of calls needs"),
    ):
        world.add(500)


@pytest.mark.parametrize(
    ("shared", "members", "most"), [(False, 1, 10), (False, 3, 30), (True, 3, 9)]
)
def test_a_store_is_made_from_an_algorithms_settings(shared, members, most):
    box = action_codec(gym.spaces.Box(-1, 1, (2,)))
    config = SimpleNamespace(
        buffer_size=10, n_step=3, prioritized=True, priority_alpha=0.5, device="cpu"
    )
    algorithm = SimpleNamespace(
        config=config, codec=box, observation_space=SPACE, between=True, raw=()
    )
    store = store_of(algorithm, members, members, shared=shared)
    action = np.zeros((members, 2), np.float32)
    for _ in range(20):
        store.add(rows_of(np.zeros((members, 2)), action, np.zeros((members, 2))))
    assert len(store) == most
    sample = store.sample(5, GAMMA[:members], generators(members))
    assert sample.action.shape == (members, 5, 2)
    assert sample.between_obs.shape == (members, 5, 2, 2)
    assert sample.weight is not None


def test_too_small_and_empty_stores_are_errors():
    with pytest.raises(SkillweaveError, match="buffer_size is 3; it must be at least num_envs, 4"):
        make(3, 4)
    for prioritized in False, True:
        with pytest.raises(AssertionError, match="before add"):
            make(4, 4, prioritized=prioritized).sample(1, GAMMA[:1], generators(1))


# Priorities


def places(store: ReplayStore, batch: int = 20_000, beta: float = 1.0) -> tuple[dict, dict]:
    """How often each transition is drawn, by its time, and its weight."""
    sample = store.sample(batch, GAMMA[:1], generators(1), beta)
    time = sample.obs[0, :, 0].numpy().astype(int)
    values, first, counts = np.unique(time, return_index=True, return_counts=True)
    weights = sample.weight[0].numpy()[first]
    return (
        dict(zip(values.tolist(), (counts / batch).tolist(), strict=True)),
        dict(zip(values.tolist(), weights.tolist(), strict=True)),
    )


def test_frequencies_and_weights_of_priorities():
    store = line([0, 0, 0], capacity=4, prioritized=True, alpha=0.5)
    store.update_priorities(np.array([[0, 1, 2]]), torch.tensor([[1.0, 4, 25]]))
    frequency, weight = places(store, beta=0.5)
    # priority^alpha is 1, 2, 5; the weights are (N·P)^-0.5 over that of the rarest
    assert frequency == pytest.approx({0: 1 / 8, 1: 2 / 8, 2: 5 / 8}, abs=1e-3)
    assert weight == pytest.approx({0: 1, 1: 2**-0.5, 2: 5**-0.5})


def with_a_new_one() -> ReplayStore:
    store = line([0, 0], capacity=4, prioritized=True, alpha=1.0)
    store.update_priorities(np.array([[0, 1]]), torch.tensor([[3.0, 1.0]]))
    store.update_priorities(np.array([[0]]), torch.tensor([[2.0]]))
    store.add(rows_of(np.full((1, 2), 2.0), np.zeros(1), np.zeros((1, 2))))
    return store


def overwritten() -> ReplayStore:
    store = line(range(9), capacity=4, prioritized=True, alpha=1.0)
    store.update_priorities(np.arange(9)[None], torch.tensor([[9.0] * 5 + [1, 2, 3, 4]]))
    return store


def with_ends() -> ReplayStore:
    return line(range(9), ".l.t.l", capacity=6, prioritized=True, alpha=1.0)


@pytest.mark.parametrize(
    ("store", "expected"),
    [
        (with_a_new_one, {0: 2 / 6, 1: 1 / 6, 2: 3 / 6}),  # as likely as the likeliest so far
        (overwritten, {5: 0.1, 6: 0.2, 7: 0.3, 8: 0.4}),
        (with_ends, dict.fromkeys([4, 5, 6, 7, 8], 1 / 5)),
    ],
)
def test_priorities_are_of_what_is_there(store, expected):
    assert places(store())[0] == pytest.approx(expected, abs=1e-3)


def test_members_that_share_transitions_have_priorities_of_their_own():
    store = make(4, 2, 2, shared=True, prioritized=True, alpha=1.0)
    World(store, 2, np.random.default_rng(0), 0.0).add(2)
    new = torch.tensor([[1.0, 1, 1, 7], [7.0, 1, 1, 1]])
    store.update_priorities(np.tile(np.arange(4), (2, 1)), new)
    drawn = store.sample(10_000, GAMMA[:2], generators(2)).index
    alone = store.sample(10_000, GAMMA[1:2], generators(1), first=1).index
    for p, index in enumerate([*drawn, *alone]):
        expected = new[min(p, 1)].numpy() / 10
        assert np.bincount(index) / 10_000 == pytest.approx(expected, abs=1e-3)
    store.inherit(np.array([1, 1]))
    for index in store.sample(10_000, GAMMA[:2], generators(2)).index:
        assert np.bincount(index) / 10_000 == pytest.approx(new[1].numpy() / 10, abs=1e-3)


def test_updating_priorities_of_a_uniform_store_does_nothing():
    store = line([1, 2])
    before = store.sample(9, GAMMA[:1], generators(1))
    store.update_priorities(before.index, before.reward)
    store.inherit(np.zeros(1, int))
    assert same(before, store.sample(9, GAMMA[:1], generators(1)))


# Between, and calls that several learn from


def test_the_observations_between_n_steps_and_what_rewards_there_count():
    store = line([1, 2, 4, 8, 16], "..t..", n_step=3, steps=[1, 2, 1, 1, 1], between=True)
    s = store.sample(1000, torch.tensor([0.5]), generators(1))
    found = {
        int(t): (x[:, 0].tolist(), d.tolist())
        for t, x, d in zip(s.obs[0, :, 0], s.between_obs[0], s.between_discount[0], strict=True)
    }
    assert found[0] == ([1, 2], [0.5, 0.125])  # γ after one step, γ³ after three
    assert found[1][0][0] == 2
    assert found[1][1] == [0.25, 0.0]  # the end
    assert found[2][1] == [0.0, 0.0]
    assert found[3][1] == [0.5, 0.0]  # nothing newer
    parts = list(s.split(10))
    assert parts[1].between_obs.shape == (1, 10, 2, 2)
    assert torch.equal(parts[1].between_discount, s.between_discount[:, 10:20])
    assert line([1, 2], n_step=3).sample(2, GAMMA[:1], generators(1)).between_obs is None
    assert line([1, 2], between=True).sample(2, GAMMA[:1], generators(1)).between_obs is None


def call(rewards: np.ndarray) -> Batch:
    """A call in each of N environments; rewards (N, τ)."""
    zeros = np.zeros((len(rewards), 2), np.float32)
    e = rows_of(zeros, np.zeros(len(rewards)), zeros)
    # Who acted discounted by γ = 0: to them a call paid its first reward alone.
    e["reward"][:], e["steps"][:] = rewards[:, 0], rewards.shape[1]
    return e.replace(rewards=rewards[None])


def shared_calls(capacity: int) -> ReplayStore:
    """Two members; first a step of reward 1 each, then calls of 3 steps that pay 1, 2, 4."""
    store = make(capacity, 2, 2, shared=True)
    for rewards in ([1.0], *[[1.0, 2.0, 4.0]] * 3):
        store.add(call(np.tile(np.float32(rewards), (2, 1))))
    return store


@pytest.mark.parametrize(("capacity", "firsts"), [(8, [1.0]), (4, [])])
def test_every_learner_discounts_within_a_call_by_its_own_gamma(capacity, firsts):
    store = shared_calls(capacity)
    for gammas in ([0.5, 0.1], [0.25, 1.0]):  # a mutation may change them at any time
        s = store.sample(200, torch.tensor(gammas), generators(2))
        for p, g in enumerate(gammas):
            calls = 1 + 2 * g + 4 * g**2
            found = sorted({round(r, 5) for r in s.reward[p].tolist()})
            assert found == pytest.approx(sorted([*firsts, calls]))


def test_rewards_of_calls_that_are_gone_take_no_room_though_a_column_stands_still():
    """One column's call stays for ever, while the other's turn over and over."""
    store = make(4, 2, 2, shared=True)
    store.add(call(np.float32([[1, 2, 4]] * 2)))
    for i in range(200):
        e = call(np.full((2, 1 + i % 7), 0.5, np.float32))
        store.add(e.replace(valid=np.array([[False, True]])))
    assert len(store.state()["rewards"]) <= 64
    s = store.sample(200, torch.tensor([1.0, 0.5]), generators(2))
    first = s.reward[torch.from_numpy(s.index == 0)]
    assert set(first.tolist()) == {7.0, 1 + 2 / 2 + 4 / 4}
