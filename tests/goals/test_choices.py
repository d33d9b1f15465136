"""Choices of a skill and its goal: their space, their numbers, and their distribution."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch.distributions import Categorical, Normal

from skillweave.networks.heads import ChoiceHead
from skillweave.skills.goal_spaces import choice_space
from skillweave.spaces import (
    choice_codec,
    numbered_choice_codec,
    obs_dtype,
    same_space,
    space_from_json,
    space_to_json,
)

BOX = gym.spaces.Box(np.float32([-1, 0]), np.float32([3, 2]))
GOALS = {
    "go": BOX,
    "turn": gym.spaces.MultiDiscrete([3, 2]),
    "hold": gym.spaces.Discrete(4, start=5),
}
NAMES = ("stay", "go", "turn", "hold")
SPACE = choice_space(8, GOALS, NAMES)  # each skill with two lengths


def test_the_space_is_read_from_json():
    again = space_from_json(space_to_json(SPACE))
    assert again == SPACE
    assert again.owners == SPACE.owners == {"go": (2, 4), "turn": (4, 6), "hold": (6, 8)}
    assert same_space(again, SPACE)
    assert not same_space(SPACE, choice_space(8, GOALS, ("go", "stay", "turn", "hold")))
    assert choice_space(4, {}, NAMES) == gym.spaces.Discrete(4)


def test_choices_become_numbers_and_back():
    codec = choice_codec(SPACE)
    SPACE.seed(0)
    samples = [SPACE.sample() for _ in range(20)]
    choices = np.zeros(20, obs_dtype(SPACE))
    for i, sample in enumerate(samples):
        choices["skill"][i] = sample["skill"]
        for name, goal in sample["goal"].items():
            choices["goal"][name][i] = goal
    units = codec.from_env(choices)
    assert units.shape == (20, 1 + 2 + 2 + 1)
    again = codec.to_env(units)
    assert np.array_equal(again["skill"], choices["skill"])
    for name in GOALS:
        assert np.allclose(again["goal"][name], choices["goal"][name], atol=1e-6)


def test_each_skill_with_each_discrete_goal_has_a_number():
    goals = {k: v for k, v in GOALS.items() if k != "go"}
    space = choice_space(6, goals, ("stay", "turn", "hold"))
    codec = numbered_choice_codec(space)
    assert codec.size == 2 + 2 * 6 + 2 * 4
    every = codec.to_env(np.arange(codec.size))
    assert np.array_equal(codec.from_env(every), np.arange(codec.size))
    assert np.array_equal(np.bincount(codec.number_of_choice), [1, 1, 6, 6, 4, 4])
    assert set(every["goal"]["hold"][-4:].tolist()) == {5, 6, 7, 8}


@pytest.fixture
def head():
    return ChoiceHead(choice_codec(SPACE))


def parts_of(params):
    """Split parameters by hand: 8 choices, 2 means, 3 + 2 logits, 4 logits."""
    return params.split([8, 2, 3, 2, 4], dim=-1)


def test_log_probability_is_of_the_skill_and_its_goal(head):
    torch.manual_seed(0)
    params, log_std = torch.randn(1, 400, head.width), torch.tensor([[[-0.5, 0.3]]])
    action = head.act(params, log_std, head.noise([torch.Generator().manual_seed(1)], 1, 400)[0])
    assert set(action[..., 0].unique().tolist()) == set(range(8))
    log_prob, entropy = head.stats(params, log_std, None, action)
    skill, mean, first, second, hold = parts_of(params)
    number = action[..., 0].long()
    of_skill, normal = Categorical(logits=skill), Normal(mean, log_std.exp())
    expected, spread = of_skill.log_prob(number), of_skill.entropy()
    of_goal = {
        1: (normal.log_prob(action[..., 1:3]).sum(-1), normal.entropy().sum(-1)),
        2: (
            Categorical(logits=first).log_prob(action[..., 3])
            + Categorical(logits=second).log_prob(action[..., 4]),
            Categorical(logits=first).entropy() + Categorical(logits=second).entropy(),
        ),
        3: (Categorical(logits=hold).log_prob(action[..., 5]), Categorical(logits=hold).entropy()),
    }
    for i, (one, more) in of_goal.items():
        expected = expected + (number // 2 == i) * one
        spread = spread + (number // 2 == i) * more
    assert torch.allclose(log_prob, expected, atol=1e-5)
    assert torch.allclose(entropy, spread, atol=1e-5)


def test_masks_are_of_the_skills(head):
    torch.manual_seed(0)
    params, log_std = torch.randn(1, 50, head.width), torch.zeros(1, 1, 2)
    mask = torch.zeros(1, 50, 8, dtype=torch.bool)
    mask[..., 2:4] = True
    action = torch.zeros(1, 50, 6)
    action[..., 0] = 2
    log_prob, _ = head.stats(params, log_std, mask, action)
    share = Categorical(logits=params[..., 2:4]).log_prob(torch.tensor(0))
    normal = Normal(params[..., 8:10], 1.0).log_prob(torch.zeros(2)).sum(-1)
    assert torch.allclose(log_prob, share + normal, atol=1e-5)


def test_kl_is_that_of_samples(head):
    torch.manual_seed(0)
    p, q = torch.randn(1, 1, head.width), torch.randn(1, 1, head.width)
    stds = torch.tensor([[[-0.3, 0.2]]]), torch.tensor([[[0.1, 0.0]]])
    kl = head.kl(p, stds[0], q, stds[1], None)
    n = 200_000
    noise = head.noise([torch.Generator().manual_seed(2)], 1, n)[0]
    wide = p.expand(1, n, -1)
    action = head.act(wide, stds[0], noise)
    ours, _ = head.stats(wide, stds[0], None, action)
    theirs, _ = head.stats(q.expand(1, n, -1), stds[1], None, action)
    assert float((ours - theirs).mean()) == pytest.approx(float(kl), rel=0.02)
    guide = head.kl(p, stds[0], q[..., :8], None, None)
    assert float(guide) < float(kl)


def test_greedy_choices_are_the_likeliest(head):
    params = torch.zeros(1, 1, head.width)
    params[..., 3], params[..., 8:10] = 1.0, torch.tensor([0.5, -0.5])
    action = head.act(params, torch.zeros(1, 1, 2), None)
    choice = head.to_env(action[0].numpy())
    assert choice["skill"].tolist() == [3]
    assert np.allclose(choice["goal"]["go"], [[2.0, 0.5]])


def test_deviations_by_the_network(head):
    wide = ChoiceHead(choice_codec(SPACE), "state", squash=True)
    assert wide.width == head.width + 2
    assert wide.log_std_size == 0
    assert wide.std_columns == [10, 11]
    params = torch.zeros(1, 3, wide.width)
    noise = wide.noise([torch.Generator().manual_seed(2)], 1, 3)[0]
    action = wide.act(params, None, noise)
    log_prob, entropy = wide.stats(params, None, None, action)
    assert log_prob.shape == entropy.shape == (1, 3)
    goals = wide.to_env(action[0].numpy())["goal"]["go"]
    assert (goals >= BOX.low).all()
    assert (goals <= BOX.high).all()
