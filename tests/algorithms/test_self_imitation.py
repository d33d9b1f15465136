"""PPO with self-imitation: what it keeps, by hand, and what it learns from that."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from skillweave import PPO, Network
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import SelfImitationPPO
from skillweave.algorithms.batches import Rollout
from skillweave.algorithms.registry import make_algorithm

SEEN, THREE = Box(-1.0, 1.0, (2,), np.float32), Discrete(3)
CONFIG = SelfImitationPPO(
    num_envs=2, n_steps=4, batch_size=8, update_epochs=1, network=Network((16,)),
    learning_rate_schedule="constant", normalize_obs=False, normalize_returns=False,
    imitation_rows=5, imitation_steps=2,
)  # fmt: skip


def make(members=1, space=THREE, **settings):
    algorithm = make_algorithm(replace(CONFIG, **settings), SEEN, space)
    return algorithm, algorithm.init([Seeds(m) for m in range(members)])


def rngs(members=1, of=0):
    return [(Seeds(of) / m).torch() for m in range(members)]


def rollout(reward, *, action=1, ends=(), members=1, **more):
    """One column for each list of rewards; ``ends`` are (row, column) that terminate."""
    paid = torch.tensor(reward).T.expand(members, -1, -1)
    lead, g = paid.shape, torch.Generator().manual_seed(1)
    last, discount = torch.zeros(lead, dtype=torch.bool), torch.full(lead, 0.5)
    for row, column in ends:
        last[:, row, column], discount[:, row, column] = True, 0.0
    last[:, -1] = True
    obs = torch.rand(*lead[1:], 2, generator=g).expand(*lead, 2)
    return Rollout(
        obs=obs, next_obs=obs, action=torch.full(lead, action), reward=paid, discount=discount,
        last=last, dist_params=torch.zeros(*lead, 3), **more,
    )  # fmt: skip


def kept_returns(state, member=0):
    return state.kept_return[member][state.kept[member]].tolist()


def test_rows_are_kept_whose_return_exceeds_the_value():
    algorithm, state = make()
    views = algorithm.layout.views(state.params)
    views["critic.1.bias"].fill_(0.4)  # all states are worth 0.4
    # Returns of the first column are 1/8, 1/4, 1/2 and 1; of the other all are less than 0.
    rows = rollout([[0.0, 0.0, 0.0, 1.0], [0.0, -1.0, 0.0, -1.0]], ends=[(3, 0), (3, 1)])
    algorithm.keep(state, rows)
    assert kept_returns(state) == [0.5, 1.0]
    assert torch.equal(state.kept_obs[0, :2], rows.obs[0, 2:, 0])
    assert state.kept_action[0, :2].tolist() == [1, 1]


def test_only_trajectories_that_terminated_count_and_no_rows_of_others_and_of_reflexes():
    algorithm, state = make()
    # The first column ends after two rows, and begins anew; the other is cut after one.
    rows = rollout([[0.0, 1.0, 7.0, 7.0], [8.0, 9.0, 9.0, 9.0]], ends=[(1, 0)])
    rows.last[0, 0, 1] = True
    algorithm.keep(state, rows)
    assert kept_returns(state) == [0.5, 1.0]
    algorithm, state = make()
    ends = [(0, 0), (1, 0), (2, 0)]
    valid = torch.tensor([True, True, False]).view(1, 3, 1)
    reflex = torch.tensor([True, False, False]).view(1, 3, 1)
    algorithm.keep(state, rollout([[1.0, 2.0, 3.0]], ends=ends, valid=valid, overridden=reflex))
    assert kept_returns(state) == [2.0]


def test_the_latest_rows_are_kept_and_the_oldest_go_first():
    algorithm, state = make(imitation_rows=3)
    for first in (1.0, 2.0, 3.0):
        algorithm.keep(state, rollout([[first, first + 0.1]], ends=[(0, 0), (1, 0)]))
    torch.testing.assert_close(state.kept_return[0], torch.tensor([3.0, 3.1, 2.0]))
    algorithm.keep(state, rollout([[0.0, 0.0]], ends=[(1, 0)]))  # nothing good came: nothing goes
    torch.testing.assert_close(state.kept_return[0], torch.tensor([3.0, 3.1, 2.0]))


def test_the_loss_is_that_of_the_paper_written_plainly():
    algorithm, state = make(imitation_coef=0.7, imitation_vf_coef=0.3)
    with torch.no_grad():
        state.params.normal_(generator=torch.Generator().manual_seed(0))
    mask = torch.ones(1, 4, 1, 3, dtype=torch.bool)
    mask[0, 1, 0, 2] = False
    algorithm.keep(state, rollout([[90.0, 80.0, 0.2, 70.0]], ends=[(1, 0), (3, 0)], mask=mask))
    rows = {name: x[:, :3] for name, x in state.rows.items()}
    views = algorithm.layout.views(state.params)
    found = algorithm.imitation_loss(views, state, rows)
    inputs = {"vector": rows["obs"]}
    logits = algorithm.actor_net(views, inputs)[0].masked_fill(~rows["mask"][0], -torch.inf)
    gain = (rows["return"][0] - algorithm.critic_net(views, inputs)[0, :, 0]).clamp(min=0.0)
    log_prob = logits.log_softmax(-1)[torch.arange(3), rows["action"][0]]
    want = 0.7 * -(log_prob * gain.clamp(max=1.0)).mean() + 0.3 * 0.5 * (gain**2).mean()
    torch.testing.assert_close(found, want[None])
    assert not rows["mask"][0].all(), "the row with a mask must be among them"


def test_as_long_as_nothing_terminates_it_is_ppo():
    rows = rollout([[-0.1, 2.0, -0.1, 0.0], [0.0, 1.0, -0.3, -0.1]])
    found = []
    for kind in (SelfImitationPPO, PPO):
        common = {k: v for k, v in vars(CONFIG).items() if not k.startswith("imitation")}
        algorithm = make_algorithm(kind(**common), SEEN, THREE)
        state = algorithm.init([Seeds(0)])
        for i in range(3):
            state, report = algorithm.update(state, rows, rngs(of=i))
        found.append(state.params)
        if kind is SelfImitationPPO:
            assert report.metrics["imitation_rows"].item() == 0.0
    assert torch.equal(*found)


def chance(algorithm, state, obs, action):
    """How probable an action is in observations, (n,)."""
    head = algorithm.actor_net(algorithm.layout.views(state.params), {"vector": obs[None]})
    return head[0].softmax(-1)[:, action]


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("seed", range(3))
def test_what_was_paid_once_is_not_forgotten(seed):
    """One success, then forty updates in which nothing is won and all actions are tried."""
    left = {}
    for coef in (0.0, 1.0):
        algorithm, state = make(
            imitation_rows=64, imitation_coef=coef, ent_coef=0.05, learning_rate=4e-3
        )
        success = rollout([[0.0, 0.0, 0.0, 5.0]], action=2, ends=[(3, 0)])
        state, _ = algorithm.update(state, success, rngs(of=seed))
        for i in range(40):
            empty = rollout([[0.0] * 4, [0.0] * 4])
            empty.action = torch.randint(3, (1, 4, 2), generator=(Seeds(seed) / i).torch())
            state, report = algorithm.update(state, empty, rngs(of=100 * seed + i))
        left[coef] = chance(algorithm, state, success.obs[0, :, 0], 2)[-1].item()
        assert report.metrics["imitation_gain"].isfinite().all()
    assert left[1.0] > 0.9
    assert left[0.0] < 0.6


def test_a_member_that_has_nothing_to_imitate_is_left_alone():
    algorithm, state = make(members=2)
    rows = rollout([[0.0, 0.0, 0.0, 3.0]], members=2, ends=[(3, 0)])
    rows.reward = rows.reward * torch.tensor([1.0, 0.0]).view(2, 1, 1)
    algorithm.keep(state, rows)
    before = state.params.clone()
    metrics = algorithm.imitate(state, state.learning_rate, rngs(2))
    assert metrics["imitation_rows"].tolist() == [4.0, 0.0]
    assert not torch.equal(state.params[0], before[0])
    assert torch.equal(state.params[1], before[1])
    assert state.count.tolist() == [1, 0]


@pytest.mark.parametrize(("batch", "most", "steps"), [(8, 9, 1), (4, 9, 1), (3, 9, 2), (1, 3, 3)])
def test_a_few_rows_are_not_learnt_by_heart(batch, most, steps):
    """Four rows are kept: at most one pass over them follows an update."""
    algorithm, state = make(batch_size=batch, imitation_steps=most)
    algorithm.keep(state, rollout([[0.0, 0.0, 0.0, 3.0]], ends=[(3, 0)]))
    algorithm.imitate(state, state.learning_rate, rngs())
    assert state.count.tolist() == [steps]
