from dataclasses import dataclass, fields, replace
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from skillweave.buffers import memory
from skillweave.buffers.replay import ReplayBuffer
from skillweave.experience import Sample
from skillweave.spaces import obs_dtype
from skillweave.types import SkillweaveError, VecStep

SPACE = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
GAMMA = torch.tensor([0.9, 0.5, 0.99])
A = 3


def generators(members: int, seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng([seed, p]) for p in range(members)]


def same(a: Sample, b: Sample) -> bool:
    def equal(x, y) -> bool:
        return y is None if x is None else np.array_equal(x, y)

    return all(equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(Sample))


# One column by hand: observations are the time, the true successor of an ended step is t + 0.5


def line(rewards, ends="", capacity=100, steps=None, **kwargs) -> ReplayBuffer:
    """``ends`` has a letter a step: t terminated, l time limit, b both, . goes on; c is a cut."""
    buffer = ReplayBuffer(capacity, 1, 1, SPACE, (), np.int64, mask_size=A, **kwargs)
    for t, reward in enumerate(rewards):
        end = ends[t] if t < len(ends) else "."
        terminated, truncated = np.array([end in "tb"]), np.array([end in "lb"])
        true = t + (0.5 if end in "tlb" else 1.0)
        buffer.add(
            np.full((1, 2), t, np.float32),
            None,
            np.array([t % A]),
            VecStep(
                np.full((1, 2), true, np.float32),
                np.full((1, 2), t + 1, np.float32),
                np.array([reward], np.float32),
                terminated,
                truncated,
                np.array([1 if steps is None else steps[t]]),
                None,
                {},
            ),
        )
        if end == "c":
            buffer.cut(np.arange(1))
    return buffer


def by_time(buffer: ReplayBuffer, gamma: float = 0.5) -> dict[int, tuple[float, float, float]]:
    """Time to reward, discount and next_obs, of everything that can be sampled."""
    s = buffer.sample(1000, torch.tensor([gamma]), generators(1))
    rows = zip(s.obs[0, :, 0], s.reward[0], s.discount[0], s.next_obs[0, :, 0], strict=True)
    return {int(t): (float(r), float(d), float(n)) for t, r, d, n in rows}


def test_one_step():
    buffer = line([1, 2, 4, 8], ".tl.")
    assert len(buffer) == 4
    assert by_time(buffer) == {
        0: (1, 0.5, 1), 1: (2, 0, 1.5), 2: (4, 0.5, 2.5), 3: (8, 0.5, 4)
    }  # fmt: skip


def test_n_steps_stop_at_ends_cuts_and_the_newest_step():
    assert by_time(line([1, 2, 4, 8], n_step=3)) == {
        0: (1 + 2 / 2 + 4 / 4, 0.125, 3),
        1: (2 + 4 / 2 + 8 / 4, 0.125, 4),
        2: (4 + 8 / 2, 0.25, 4),
        3: (8, 0.5, 4),
    }
    for end, factor, successor in ("t", 0, 1.5), ("b", 0, 1.5), ("l", 1, 1.5), ("c", 1, 2):
        found = by_time(line([1, 2, 4, 8], f".{end}", n_step=3))
        assert found[0] == (2, 0.25 * factor, successor)
        assert found[1] == (2, 0.5 * factor, successor)
        assert found[2] == (8, 0.25, 4)


def test_calls_discount_by_their_length():
    buffer = line([1, 2, 4], steps=[1, 3, 2], n_step=2)
    assert by_time(buffer) == {0: (2, 1 / 16, 2), 1: (2.5, 1 / 32, 3), 2: (4, 0.25, 3)}


def test_overwritten_steps_are_gone():
    buffer = line(range(10), "l.....l", capacity=4)
    assert len(buffer) == 4
    assert by_time(buffer) == {
        6: (6, 0.5, 6.5), 7: (7, 0.5, 8), 8: (8, 0.5, 9), 9: (9, 0.5, 10)
    }  # fmt: skip


def test_cutting_an_empty_or_a_cut_buffer_does_nothing():
    buffer = ReplayBuffer(10, 1, 1, SPACE, (), np.int64)
    buffer.cut(np.arange(1))
    assert len(buffer) == 0
    buffer = line([1, 2], ".c")
    before = buffer.state()
    buffer.cut(np.arange(1))
    after = buffer.state()
    assert all(torch.equal(after[name], before[name]) for name in before)


# Everything else against a naive buffer that keeps whole transitions


@dataclass
class Kept:
    obs: np.ndarray
    obs_mask: np.ndarray
    action: np.ndarray
    reward: float
    next_obs: np.ndarray
    allowed: np.ndarray
    terminated: bool
    ended: bool
    steps: int
    rewards: np.ndarray | None = None  # of each step, where members with other γ learn from them


@dataclass
class World:
    """Random steps of N columns, added to a buffer and noted one by one."""

    buffer: ReplayBuffer
    num_envs: int
    rng: np.random.Generator
    ending: float
    longest: int
    masked: float
    told: bool = False  # the rewards of each step of a call

    def __post_init__(self) -> None:
        self.history: list[list[Kept]] = []
        self.obs, self.mask = self.draw(), self.draw_mask()

    def draw(self):
        return self.rng.random((self.num_envs, 2), dtype=np.float32)

    def draw_mask(self):
        given = self.rng.random() < self.masked
        return self.rng.random((self.num_envs, A)) < 0.5 if given else None

    def restart(self, columns: np.ndarray) -> None:
        obs, mask = self.draw(), self.draw_mask()
        self.obs = self.obs.copy()
        self.obs[columns] = obs[columns]
        if len(columns) == self.num_envs:
            self.mask = mask
        elif self.mask is not None and mask is not None:
            self.mask = self.mask.copy()
            self.mask[columns] = mask[columns]

    def step(self) -> None:
        n, rng = self.num_envs, self.rng
        terminated, truncated = rng.random((2, n)) < self.ending
        ended = terminated | truncated
        true, mask, allowed = self.draw(), self.draw_mask(), self.draw_mask()
        if allowed is not None:
            allowed[~ended] = True if mask is None else mask[~ended]
        steps, info = rng.integers(1, self.longest + 1, n), {}
        reward = rng.random(n, dtype=np.float32)
        if self.told:
            rewards = rng.random((n, int(steps.max())), dtype=np.float32)
            info["rewards"] = rewards * (np.arange(rewards.shape[1]) < steps[:, None])
            reward = info["rewards"] @ np.float32(0.7) ** np.arange(rewards.shape[1])
        step = VecStep(
            true, np.where(ended[:, None], self.draw(), true), reward,
            terminated, truncated, steps, mask, info, allowed,
        )  # fmt: skip
        action = rng.integers(A, size=n)
        self.buffer.add(self.obs, self.mask, action, step)
        row, everything = [], np.ones(A, bool)
        for i in range(n):
            after = allowed if ended[i] else mask
            row.append(
                Kept(
                    self.obs[i], everything if self.mask is None else self.mask[i], action[i],
                    step.reward[i], true[i],
                    everything if after is None else after[i],
                    terminated[i], ended[i], step.steps[i],
                    info["rewards"][i] if self.told else None,
                )
            )  # fmt: skip
        self.history.append(row)
        self.obs, self.mask = step.obs, mask

    def cut(self) -> None:
        """Some environments begin anew."""
        columns = np.flatnonzero(self.rng.random(self.num_envs) < 0.5)
        self.buffer.cut(columns)
        for i in columns if self.history else ():
            self.history[-1][i] = replace(self.history[-1][i], ended=True)
        self.restart(columns)

    def expected(self, index: int, n_step: int, gamma: float) -> dict:
        t, column = divmod(index, self.num_envs)
        reward, discount = 0.0, 1.0
        between = {"obs": np.zeros((n_step - 1, 2)), "mask": np.ones((n_step - 1, A), bool)}
        counts = np.zeros(n_step - 1)
        for k, kept in enumerate(row[column] for row in self.history[t : t + n_step]):
            if k:
                between["obs"][k - 1], between["mask"][k - 1] = kept.obs, kept.obs_mask
                counts[k - 1] = discount
            own = kept.reward
            if kept.rewards is not None:
                own = sum(gamma**i * r for i, r in enumerate(kept.rewards))
            reward += discount * own
            discount *= gamma**kept.steps
            if kept.ended:
                break
        first = self.history[t][column]
        discount *= not kept.terminated
        return {
            "obs": first.obs, "obs_mask": first.obs_mask, "action": first.action,
            "reward": reward, "discount": discount, "next_obs": kept.next_obs,
            "next_obs_mask": kept.allowed, "between_discount": counts,
            "between_obs": between["obs"], "between_mask": between["mask"],
        }  # fmt: skip


@given(
    seed=st.integers(0, 2**32 - 1),
    members=st.integers(1, 3),
    width=st.integers(1, 3),
    rows=st.integers(1, 9),
    n_step=st.integers(1, 5),
    ending=st.sampled_from([0.0, 0.2, 0.6, 1.0]),
    longest=st.sampled_from([1, 10]),
    masked=st.sampled_from([0.0, 0.5, 1.0]),
    shared=st.booleans(),
    prioritized=st.booleans(),
    between=st.booleans(),
    told=st.booleans(),
    plan=st.lists(st.sampled_from("aaaaaaacsu"), min_size=1, max_size=40),
)
@settings(max_examples=150, deadline=None)
def test_samples_equal_a_naive_buffers(
    seed, members, width, rows, n_step, ending, longest, masked, shared, prioritized, between,
    told, plan,
):  # fmt: skip
    n, gamma, rng = members * width, GAMMA[:members], np.random.default_rng(seed)

    def make() -> ReplayBuffer:
        return ReplayBuffer(
            rows * n + n - 1, n, members, SPACE, (), np.int64,
            mask_size=A, shared=shared, n_step=n_step, prioritized=prioritized, between=between,
        )  # fmt: skip

    world = World(make(), n, rng, ending, longest, masked, told and shared)
    for what in ["a", *plan, "s"]:
        if what == "a":
            world.step()
        elif what == "c":
            world.cut()
        elif what == "u":
            drawn = world.buffer.sample(4, gamma, generators(members, seed))
            new = torch.from_numpy(rng.random((members, 4), dtype=np.float32))
            world.buffer.update_priorities(drawn.index, new)
        else:
            check(world, gamma, n_step, shared, seed)
            other = make()
            other.load({k: v.clone() for k, v in world.buffer.state().items()})
            same_draws = [b.sample(9, gamma, generators(members)) for b in (world.buffer, other)]
            assert same(*same_draws)
            world.buffer = other  # and goes on in the copy


def check(world: World, gamma: torch.Tensor, n_step: int, shared: bool, seed: int) -> None:
    members, n = len(gamma), world.num_envs
    sample = world.buffer.sample(30, gamma, generators(members, seed))
    oldest = len(world.history) * n - len(world.buffer)
    assert oldest <= sample.index.min()
    assert sample.index.max() < len(world.history) * n
    for p in range(members):
        own = sample.index[p] % n * members // n == p
        assert shared or own.all()
        for b, index in enumerate(sample.index[p]):
            expected = world.expected(int(index), n_step, float(gamma[p]))
            for name, value in expected.items():
                found = getattr(sample, name)
                if found is None:
                    alone = n_step == 1 or not world.buffer._between
                    assert "mask" in name or (alone and "between" in name)
                    assert alone or value.all()
                elif name in ("between_obs", "between_mask"):  # what counts for nothing is any
                    counts = expected["between_discount"] > 0.0
                    np.testing.assert_array_equal(found[p, b][counts], value[counts])
                else:
                    np.testing.assert_allclose(found[p, b], value, rtol=1e-5)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("prioritized", [False, True])
def test_every_transition_is_drawn_as_often(shared, prioritized):
    kwargs = {"shared": shared, "prioritized": prioritized}
    buffer = ReplayBuffer(24, 4, 2, SPACE, (), np.int64, mask_size=A, **kwargs)
    world = World(buffer, 4, np.random.default_rng(0), 0.3, 1, 0.0)
    for _ in range(11):
        world.step()
    drawn = buffer.sample(12_000, GAMMA[:2], generators(2)).index
    for p in range(2):
        values, counts = np.unique(drawn[p], return_counts=True)
        own = [i for i in range(20, 44) if shared or i % 4 // 2 == p]
        assert values.tolist() == own
        expected = 12_000 / len(own)
        assert ((counts - expected) ** 2 / expected).sum() < 50  # 23 degrees: p about 0.001


# Kinds of data


def test_boxes_of_actions_stay_as_they_are_and_choices_become_int64():
    action = np.random.default_rng(0).random((2, 3), dtype=np.float32)
    step = VecStep(
        *np.zeros((2, 2, 2), np.float32), np.zeros(2), *np.zeros((2, 2), bool), np.ones(2), None, {}
    )
    boxes = ReplayBuffer(10, 2, 2, SPACE, (3,), np.float32)
    boxes.add(step.obs, None, action, step)
    sample = boxes.sample(1, GAMMA[:2], generators(2))
    assert torch.equal(sample.action[:, 0], torch.from_numpy(action))
    assert sample.next_obs_mask is None
    assert sample.weight is None
    for choices, bytes_each in (256, 1), (257, 2), (40_000, 4):
        buffer = ReplayBuffer(10, 2, 2, SPACE, (), np.int64, mask_size=choices)
        buffer.add(step.obs, None, np.array([0, choices - 1]), step)
        sample = buffer.sample(1, GAMMA[:2], generators(2))
        assert sample.action.dtype == torch.int64
        assert sample.action.tolist() == [[0], [choices - 1]]
        assert buffer.state()["action"].element_size() == bytes_each


def test_structured_observations_become_bytes():
    space = gym.spaces.Dict(
        {"far": gym.spaces.Box(-1, 1, (2,), np.float64), "near": gym.spaces.Discrete(7)}
    )
    rng, kind = np.random.default_rng(0), obs_dtype(space)
    first, true, new = (np.zeros(2, kind) for _ in range(3))
    for obs in (first, true, new):
        obs["far"], obs["near"] = rng.random((2, 2)), rng.integers(7, size=2)
    new[0] = true[0]
    step = VecStep(
        true, new, np.zeros(2), np.zeros(2, bool), np.array([False, True]), np.ones(2), None, {}
    )
    buffer = ReplayBuffer(6, 2, 2, space, (), np.int64, mask_size=A)
    buffer.add(first, None, np.zeros(2), step)
    other = ReplayBuffer(6, 2, 2, space, (), np.int64, mask_size=A)
    other.load(buffer.state())
    for b in buffer, other:
        sample = b.sample(1, GAMMA[:2], generators(2))
        for found, expected in (sample.obs, first), (sample.next_obs, true):
            assert found.dtype == torch.uint8
            assert np.array_equal(found.numpy().view(kind).reshape(2), expected)


def test_the_buffer_keeps_copies_and_so_does_its_state():
    world = World(
        ReplayBuffer(8, 2, 1, SPACE, (), np.int64, mask_size=A, prioritized=True),
        2, np.random.default_rng(0), 0.3, 10, 1.0,
    )  # fmt: skip
    for _ in range(7):
        world.step()
    state, before = world.buffer.state(), world.buffer.sample(9, GAMMA[:1], generators(1))
    for _ in range(5):
        world.step()
        world.obs += 99
    world.buffer.load(state)
    assert same(before, world.buffer.sample(9, GAMMA[:1], generators(1)))
    assert before.obs.max() < 99


def test_a_state_without_masks_and_calls_replaces_one_with_them():
    def world(masked, longest):
        buffer = ReplayBuffer(8, 2, 1, SPACE, (), np.int64, mask_size=A)
        return World(buffer, 2, np.random.default_rng(0), 0.3, longest, masked)

    plain, rich = world(0.0, 1), world(1.0, 10)
    for _ in range(6):
        plain.step()
        rich.step()
    rich.buffer.load(plain.buffer.state())
    draws = [w.buffer.sample(9, GAMMA[:1], generators(1)) for w in (plain, rich)]
    assert same(*draws)


# Size


def test_a_million_lunar_lander_transitions_take_at_most_90_megabytes():
    space = gym.spaces.Box(-1, 1, (8,), np.float32)
    for prioritized in False, True:
        buffer = ReplayBuffer(
            1_000_000, 16, 1, space, (), np.int64, mask_size=4, prioritized=prioritized
        )
        assert buffer.nbytes <= 90e6
        zeros, never = np.zeros((16, 8), np.float32), np.zeros(16, bool)
        step = VecStep(zeros, zeros, np.zeros(16), never, never, np.full(16, 2), None, {})
        step.mask = np.ones((16, 4), bool)
        buffer.add(zeros, step.mask, np.zeros(16), step)
        assert buffer.nbytes <= 90e6  # with masks and calls


def test_side_ring_grows_only_as_far_as_ends_are_kept():
    buffer = ReplayBuffer(256, 1, 1, SPACE, (), np.int64, mask_size=A)
    world = World(buffer, 1, np.random.default_rng(0), 0.1, 1, 0.5)
    sizes = []
    for t in range(1000):
        world.ending = 0.08 if t < 500 else 1.0  # first few ends, of which some are gone
        world.step()
        sizes.append(len(buffer.state()["obs_ends"]))
        if t % 50 == 0:
            check(world, GAMMA[:1], 1, False, t)
    assert sizes[499] == 64
    assert sorted(set(sizes)) == [64, 128, 256]


def test_more_than_the_memory_is_an_error_that_says_how_much_would_fit():
    space = gym.spaces.Box(0, 255, (4, 84, 84), np.uint8)
    with (
        mock.patch.object(memory, "free_memory", return_value=int(11.2 * 2**30)),
        pytest.raises(SkillweaveError) as error,
    ):
        ReplayBuffer(1_000_000, 8, 1, space, (), np.int64, mask_size=6)
    assert str(error.value) == (
        "a replay buffer of 1,000,000 transitions of (4, 84, 84) uint8 needs 26.3 GiB, "
        "but 11.2 GiB are free: lower buffer_size (at most about 425,937)"
    )
    free = memory.free_memory()
    assert free is None or 2**20 < free < 2**50


def test_too_small_and_empty_buffers_are_errors():
    with pytest.raises(SkillweaveError, match="buffer_size is 3; it must be at least num_envs, 4"):
        ReplayBuffer(3, 4, 1, SPACE, (), np.int64)
    with pytest.raises(AssertionError, match="before add"):
        ReplayBuffer(4, 4, 1, SPACE, (), np.int64).sample(1, GAMMA[:1], generators(1))


# Priorities


def places(buffer: ReplayBuffer, batch: int = 20_000, beta: float = 1.0) -> tuple[dict, dict]:
    """How often each transition is drawn, and its weight."""
    sample = buffer.sample(batch, GAMMA[:1], generators(1), beta)
    values, first, counts = np.unique(sample.index, return_index=True, return_counts=True)
    weights = sample.weight[0].numpy()[first]
    return (
        dict(zip(values.tolist(), (counts / batch).tolist(), strict=True)),
        dict(zip(values.tolist(), weights.tolist(), strict=True)),
    )


def test_frequencies_and_weights_of_priorities():
    buffer = line([0, 0, 0], capacity=4, prioritized=True, alpha=0.5)
    buffer.update_priorities(np.array([[0, 1, 2]]), torch.tensor([[1.0, 4, 25]]))
    frequency, weight = places(buffer, beta=0.5)
    # priority^alpha is 1, 2, 5; the weights are (N·P)^-0.5 over that of the rarest
    assert frequency == pytest.approx({0: 1 / 8, 1: 2 / 8, 2: 5 / 8}, abs=1e-3)
    assert weight == pytest.approx({0: 1, 1: 2**-0.5, 2: 5**-0.5})


def test_new_transitions_have_the_highest_priority_so_far():
    buffer = line([0, 0], capacity=4, prioritized=True, alpha=1.0)
    buffer.update_priorities(np.array([[0, 1]]), torch.tensor([[3.0, 1.0]]))
    buffer.update_priorities(np.array([[0]]), torch.tensor([[2.0]]))
    obs, no = np.zeros((1, 2), np.float32), np.zeros(1, bool)
    buffer.add(obs, None, np.zeros(1), VecStep(obs, obs, np.zeros(1), no, no, np.ones(1), None, {}))
    frequency, _ = places(buffer)
    assert frequency == pytest.approx({0: 2 / 6, 1: 1 / 6, 2: 3 / 6}, abs=1e-3)


def test_priorities_of_overwritten_transitions_are_skipped():
    buffer = line(range(9), capacity=4, prioritized=True, alpha=1.0)
    buffer.update_priorities(np.arange(9)[None], torch.tensor([[9.0] * 5 + [1, 2, 3, 4]]))
    frequency, _ = places(buffer)
    assert frequency == pytest.approx({5: 0.1, 6: 0.2, 7: 0.3, 8: 0.4}, abs=1e-3)


def test_members_that_share_transitions_have_priorities_of_their_own():
    buffer = ReplayBuffer(4, 2, 2, SPACE, (), np.int64, shared=True, prioritized=True, alpha=1.0)
    world = World(buffer, 2, np.random.default_rng(0), 0.0, 1, 0.0)
    for _ in range(2):
        world.step()
    new = torch.tensor([[1.0, 1, 1, 7], [7.0, 1, 1, 1]])
    buffer.update_priorities(np.tile(np.arange(4), (2, 1)), new)
    drawn = buffer.sample(10_000, GAMMA[:2], generators(2)).index
    for p in range(2):
        assert np.bincount(drawn[p]) / 10_000 == pytest.approx(new[p].numpy() / 10, abs=1e-3)


def test_updating_priorities_of_a_uniform_buffer_does_nothing():
    buffer = line([1, 2])
    before = buffer.sample(9, GAMMA[:1], generators(1))
    buffer.update_priorities(before.index, before.reward)
    assert same(before, buffer.sample(9, GAMMA[:1], generators(1)))


# Between, and calls that several learn from


def test_the_observations_between_n_steps_and_what_rewards_there_count():
    buffer = line([1, 2, 4, 8, 16], "..t..", n_step=3, steps=[1, 2, 1, 1, 1], between=True)
    s = buffer.sample(1000, torch.tensor([0.5]), generators(1))
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


def shared_calls(capacity: int) -> ReplayBuffer:
    """Two members; first a step of reward 1 each, then calls of 3 steps that pay 1, 2, 4."""
    buffer = ReplayBuffer(capacity, 2, 2, SPACE, (), np.int64, mask_size=A, shared=True)
    obs, never = np.zeros((2, 2), np.float32), np.zeros(2, bool)
    for rewards in ([[1.0]] * 2, *[[[1.0, 2.0, 4.0]] * 2] * 3):
        steps, told = np.full(2, len(rewards[0])), {"rewards": np.array(rewards, np.float32)}
        # Who acted discounted by γ = 0: to them a call paid its first reward alone.
        step = VecStep(obs, obs, np.ones(2, np.float32), never, never, steps, None, told)
        buffer.add(obs, None, np.zeros(2), step)
    return buffer


@pytest.mark.parametrize(("capacity", "firsts"), [(8, [1.0]), (4, [])])
def test_every_learner_discounts_within_a_call_by_its_own_gamma(capacity, firsts):
    buffer = shared_calls(capacity)
    for gammas in ([0.5, 0.1], [0.25, 1.0]):  # a mutation may change them at any time
        s = buffer.sample(200, torch.tensor(gammas), generators(2))
        for p, g in enumerate(gammas):
            calls = 1 + 2 * g + 4 * g**2
            found = sorted({round(r, 5) for r in s.reward[p].tolist()})
            assert found == pytest.approx(sorted([*firsts, calls]))


def test_rewards_of_calls_that_are_gone_take_no_room():
    buffer = shared_calls(4)
    never, obs = np.zeros(2, bool), np.zeros((2, 2), np.float32)
    for i in range(200):
        told = {"rewards": np.full((2, 1 + i % 7), 0.5, np.float32)}
        steps = np.full(2, 1 + i % 7)
        step = VecStep(obs, obs, np.ones(2, np.float32), never, never, steps, None, told)
        buffer.add(obs, None, np.zeros(2), step)
    assert len(buffer.state()["rewards"]) == 64
