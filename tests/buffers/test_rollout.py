import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave.buffers.rollout import RolloutBuffer
from skillweave.types import VecStep

SPACE = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
T, P, B, A = 3, 2, 2, 3


def vec_step(t: int, terminated=(), truncated=(), steps=1) -> VecStep:
    """Observations say (time, column); the true successor of time t is t + 0.5."""
    columns = np.arange(P * B)
    obs = np.stack([np.full(P * B, t + 1.0), columns], 1).astype(np.float32)
    next_obs = obs - np.float32([0.5, 0])
    ends = [np.isin(columns, rows) for rows in (terminated, truncated)]
    return VecStep(
        next_obs, obs, np.float32(10 * t + columns), *ends, np.full(P * B, steps), None, {}
    )


def filled(steps: list[VecStep], masks=None) -> RolloutBuffer:
    buffer = RolloutBuffer(len(steps), P * B, P, SPACE)
    obs = np.stack([np.zeros(P * B), np.arange(P * B)], 1).astype(np.float32)
    for t, step in enumerate(steps):
        action = torch.arange(P * B).view(P, B) + 100 * t
        buffer.add(obs, masks and masks[t], action, action[..., None].expand(P, B, A).float(), step)
        obs = step.obs
    return buffer


GAMMA = torch.tensor([0.9, 0.5])


def test_columns_are_member_after_member():
    transition = filled([vec_step(t) for t in range(T)]).read(GAMMA)
    head = transition.head
    expected = torch.tensor([[[0.0, 1], [10, 11], [20, 21]], [[2, 3], [12, 13], [22, 23]]])
    assert torch.equal(transition.reward, expected)
    assert torch.equal(transition.action, (expected + 90 * (expected // 10)).long())
    assert torch.equal(transition.obs[..., 0], torch.arange(3.0)[None, :, None].expand(P, T, B))
    assert torch.equal(
        transition.obs[..., 1], torch.tensor([[0.0, 1], [2, 3]])[:, None].expand(P, T, B)
    )
    assert torch.equal(transition.next_obs, transition.obs + torch.tensor([0.5, 0]))
    assert torch.equal(head, transition.action[..., None].expand(P, T, B, A).float())
    assert transition.obs_mask is None


def test_each_members_discount_is_its_gamma_to_the_calls_length():
    transition = filled([vec_step(0, steps=1), vec_step(1, steps=3)]).read(GAMMA)
    torch.testing.assert_close(
        transition.discount,
        torch.tensor([[[0.9, 0.9], [0.729, 0.729]], [[0.5, 0.5], [0.125, 0.125]]]),
    )


def test_a_termination_has_discount_zero_and_a_truncation_has_not_and_both_are_last():
    steps = [vec_step(0, terminated=[0]), vec_step(1, truncated=[3]), vec_step(2)]
    transition = filled(steps).read(GAMMA)
    assert transition.discount[0, :, 0].tolist() == pytest.approx([0.0, 0.9, 0.9])
    assert transition.discount[1, :, 1].tolist() == pytest.approx([0.5] * 3)
    assert transition.last[0, :, 0].tolist() == [True, False, True]
    assert transition.last[1, :, 1].tolist() == [False, True, True]


def test_the_end_of_the_rollout_cuts_every_trajectory_but_keeps_its_discount():
    transition = filled([vec_step(t) for t in range(T)]).read(GAMMA)
    assert transition.last[:, -1].all()
    assert not transition.last[:, :-1].any()
    assert (transition.discount > 0).all()


def test_masks_travel_with_their_observations():
    masks = [np.eye(A, dtype=bool)[[0, 1, 2, t]] for t in range(T)]
    transition = filled([vec_step(t) for t in range(T)], masks).read(GAMMA)
    for t in range(T):
        assert torch.equal(transition.obs_mask[:, t].flatten(0, 1), torch.from_numpy(masks[t]))


def test_a_step_without_a_mask_allows_everything_though_others_have_one():
    some = np.eye(A, dtype=bool)[[0, 1, 2, 0]]
    transition = filled([vec_step(t) for t in range(T)], [some, None, some]).read(GAMMA)
    assert transition.obs_mask.shape == (P, T, B, A)
    assert transition.obs_mask[:, 1].all()
    assert torch.equal(transition.obs_mask[:, 2].flatten(0, 1), torch.from_numpy(some))


def test_the_buffer_keeps_copies():
    obs, step = np.zeros((P * B, 2), np.float32), vec_step(0)
    buffer = RolloutBuffer(1, P * B, P, SPACE)
    buffer.add(obs, None, torch.zeros(P, B), torch.zeros(P, B, A), step)
    obs += 99
    step.next_obs += 99
    step.reward += 99
    transition = buffer.read(GAMMA)
    assert transition.obs.max() < 99
    assert transition.next_obs.max() < 99
    assert transition.reward.max() < 99
