"""The critic of skills against values worked out by hand."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.batches import Rollout
from skillweave.algorithms.config import SkillCritic
from skillweave.networks.config import Network

SEEN = gym.spaces.Box(0, 1, (3,), np.float32)


def chain():
    """Two columns in three states: skill 0 then 1 then 1, ends with reward 1; skill 1 is cut."""
    at = torch.tensor([[0, 1], [1, 2], [2, 0]])
    after = torch.tensor([[1, 2], [2, 0], [0, 1]])
    eye = torch.eye(3)
    return Rollout(
        obs=eye[at][None], next_obs=eye[after][None],
        action=torch.tensor([[[0, 1], [1, 1], [1, 0]]]),
        reward=torch.tensor([[[0.0, 0.0], [0.0, 0.0], [1.0, 0.5]]]),
        discount=torch.tensor([[[0.5, 0.5], [0.5, 0.5], [0.0, 0.5]]]),
        last=torch.tensor([[[False, False], [False, False], [True, True]]]),
    )  # fmt: skip


def critic(**how):
    config = SkillCritic(
        normalize_obs=False, network=Network(hidden=()), learning_rate=3e-2, batch_size=64, **how
    )
    algorithm = make_algorithm(config, SEEN, gym.spaces.Discrete(2))
    return algorithm, algorithm.init([Seeds(0)])


def test_advantages_are_those_of_the_skill_that_acted():
    algorithm, state = critic(gae_lambda=0.0)
    weight, bias = (
        algorithm.layout.views(state.params)[f"critic.0.{k}"] for k in ("weight", "bias")
    )
    worth = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])  # of state, skill
    weight.copy_(
        worth.view_as(weight) if weight.shape[-2:] == worth.shape else worth.T.view_as(weight)
    )
    bias.zero_()
    found = algorithm.advantage(state, chain())[0]
    one = [0.5 * 4 - 1, 0.5 * 6 - 4, 1.0 - 6]
    # The last row's episode is cut: what follows is worth Q(state 1, skill 0).
    two = [0.5 * 6 - 4, 0.5 * 1 - 6, 0.5 + 0.5 * 3 - 1]
    want = torch.tensor([one, two]).T
    torch.testing.assert_close(found, want, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_it_learns_what_each_skill_is_worth():
    algorithm, state = critic(update_epochs=10, gae_lambda=0.0)
    rollout = chain()
    for i in range(200):
        rollout.progress = i / 200
        state, report = algorithm.update(state, rollout, [torch.Generator().manual_seed(i)])
    params = algorithm.learning_params(state)
    raw = algorithm.net(params.views, algorithm.inputs(params, torch.eye(3)[None]))[0]
    found = raw * (state.return_var + 1e-8).sqrt() + state.return_mean
    # In state 1, skill 1 leads to state 2 and goes on, in both columns; γ is 0.5.
    assert found[1, 1].item() == pytest.approx(0.5 * found[2, 1].item(), abs=0.03)
    # In state 2 it ends with a reward of 1 in one column, and skill 0 follows in the other.
    assert found[2, 1].item() == pytest.approx(0.5 * (1.0 + 0.5 * found[0, 0].item()), abs=0.03)
    assert report.metrics["value_loss"].isfinite().all()
    assert algorithm.value(state, torch.eye(3)[None]).shape == (1, 3)


def test_while_skills_are_tried_they_differ_less_in_worth_so_that_few_calls_are_cut():
    algorithm, state = critic(epsilon=1.0, epsilon_final=0.2)
    obs = torch.eye(3)[None]
    assert not algorithm.act(algorithm.learning_params(state), obs, None, None)[1].any()
    state.params.normal_(generator=torch.Generator().manual_seed(0))  # as if it had learnt
    whole = algorithm.act(algorithm.learning_params(state), obs, None, None)[1]
    assert whole.abs().min() > 0
    for progress, share in ((0.0, 0.0), (0.5, 0.4), (1.0, 1.0)):
        params = algorithm.acting_params(state, progress)
        torch.testing.assert_close(algorithm.act(params, obs, None, None)[1], share * whole)


@pytest.mark.slow
def test_it_learns_what_deciding_is_worth_where_one_decided():
    algorithm, state = critic(deciding=True, update_epochs=10, gae_lambda=0.0)
    # Four columns, each two calls of one step: skill 0 pays 1, and skill 1 pays 0. In state 0 skill
    # 0 is chosen once in four decisions, in state 1 always. Rows in state 2 are no decisions.
    at = torch.tensor([[0, 0, 0, 0], [1, 1, 2, 2]])
    action = torch.tensor([[0, 1, 1, 1], [0, 0, 0, 0]])
    eye, one = torch.eye(3), torch.ones(1, 2, 4)
    rollout = Rollout(
        obs=eye[at][None], next_obs=eye[at][None], action=action[None],
        reward=(action[None] == 0).float(), discount=0.0 * one, last=one.bool(),
        call_start=(at != 2)[None],
    )  # fmt: skip
    for i in range(200):
        rollout.progress = i / 200
        state, _ = algorithm.update(state, rollout, [torch.Generator().manual_seed(i)])
    best, worth, _ = algorithm.act(algorithm.learning_params(state), eye[None], None, None)
    found = worth[0] * (state.return_var + 1e-8).sqrt() + state.return_mean
    assert worth.shape == (1, 3, 3)
    assert found[0].tolist() == pytest.approx([1.0, 0.0, 0.25], abs=0.03)
    assert found[1, [0, 2]].tolist() == pytest.approx([1.0, 1.0], abs=0.03)
    # Where nobody decided nothing was learnt of it; the best is a skill, not to decide.
    assert abs(found[2, 2] - 1.0) > 0.1
    assert best[0, 0] == 0
    assert algorithm.value(state, eye[None])[0, 0].item() == pytest.approx(1.0, abs=0.03)
