"""Agents by AgileRL's names: what they return, what they learn from, and their checkpoints."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from skillweave.compat.agilerl.algorithms.ddpg import DDPG
from skillweave.compat.agilerl.algorithms.dqn import DQN
from skillweave.compat.agilerl.algorithms.dqn_rainbow import RainbowDQN
from skillweave.compat.agilerl.algorithms.ppo import PPO
from skillweave.compat.agilerl.algorithms.td3 import TD3
from skillweave.errors import RunError, SkillweaveError

OBS = np.random.default_rng(0).normal(size=(5, 8)).astype(np.float32)
KINDS = {
    "ppo": lambda **k: PPO([8], 4, False, True, **k),
    "continuous": lambda **k: PPO((8,), 2, False, False, **k),
    "dqn": lambda **k: DQN((8,), 4, False, **k),
    "rainbow": lambda **k: RainbowDQN((8,), 4, False, **k),
    "ddpg": lambda **k: DDPG((8,), 2, False, max_action=2.0, min_action=-1.0, **k),
    "td3": lambda **k: TD3((8,), 2, False, **k),
}


def record(agent: PPO, steps: int = 30, n: int = 1):
    """What a hand-written loop collects: lists of arrays, and the last observations."""
    rng = np.random.default_rng(1)
    states = [rng.normal(size=(n, 8)).astype(np.float32) for _ in range(steps)]
    actions, log_probs, _, values = zip(*map(agent.getAction, states), strict=True)
    rewards = [rng.normal(size=n) for _ in range(steps)]
    ends = [rng.random(n) < 0.1 for _ in range(steps)]
    return [states, actions, log_probs, rewards, ends, values, states[0]]


def transitions(agent, batch: int = 32):
    rng = np.random.default_rng(2)
    obs, after = (torch.from_numpy(rng.normal(size=(batch, 8))).float() for _ in range(2))
    wide = 1 if agent.discrete_actions else agent.action_dim
    action = rng.integers(0, 4, (batch, 1)) if wide == 1 else rng.uniform(-1, 1, (batch, wide))
    reward, done = (torch.from_numpy(rng.random((batch, 1)) < 0.5).float() for _ in range(2))
    return obs, torch.from_numpy(action).float(), reward, after, done


@pytest.mark.parametrize("n", [None, 1, 5])
def test_ppo_returns_arrays_of_the_old_shapes_and_types(n):
    state = OBS[0] if n is None else OBS[:n]
    found = KINDS["ppo"]().getAction(state)
    assert [x.shape for x in found] == [(n or 1,)] * 4
    assert [x.dtype for x in found] == [np.int64, np.float32, np.float32, np.float32]
    found = KINDS["continuous"]().getAction(state)
    assert [x.shape for x in found] == [(n or 1, 2), (n or 1,), (n or 1,), (n or 1,)]
    assert [x.dtype for x in found] == [np.float32] * 4


@pytest.mark.parametrize("activation", ["Tanh", "ReLU", "ELU", "SiLU", "GELU"])
@pytest.mark.parametrize("layer_norm", [False, True])
def test_acting_in_numpy_says_what_torch_says(activation, layer_norm):
    how = {"mlp_activation": activation, "layer_norm": layer_norm}
    agent = KINDS["ppo"](net_config={"arch": "mlp", "hidden_size": [32, 16], **how})
    for _ in range(2):  # before and after learning
        learner, state, obs = agent.learner, agent.member.state, torch.from_numpy(OBS)[None]
        _, head, _ = learner.act(learner.acting_params(state), obs, None, None)
        action, *found = agent.getAction(OBS)
        want = learner.head.stats(head[0], None, None, torch.from_numpy(action))
        value = learner.value(state, obs)[0].detach()
        np.testing.assert_allclose(found, torch.stack([*want, value]), atol=1e-5)
        agent.learn(record(agent))


def test_actions_are_drawn_with_their_probabilities():
    agent = KINDS["ppo"]()
    views = agent.learner.layout.views(agent.member.state.params)
    views["actor.2.bias"].copy_(torch.tensor([0.0, 1.0, -1.0, 2.0]))
    agent.become(agent.member)
    many = np.repeat(OBS[:1], 20_000, axis=0)
    action, log_prob, _, _ = agent.getAction(many)
    drawn = np.bincount(action, minlength=4) / len(many)
    for i in range(4):
        assert drawn[i] == pytest.approx(np.exp(log_prob[action == i][0]), abs=0.015)


@pytest.mark.parametrize("kind", ["ppo", "continuous"])
def test_learn_takes_the_log_probabilities_as_they_are_given(kind):
    agent = KINDS[kind]()
    steps = record(agent)
    steps[2] = [x - 0.5 for x in steps[2]]  # of other states, as the selector's loop has them
    rollout = agent.rollout(steps)
    head = agent.learner.head
    found, _ = head.stats(rollout.dist_params, rollout.log_std, None, rollout.action)
    np.testing.assert_allclose(found.flatten(), np.concatenate(steps[2]), atol=1e-4)


def test_a_record_becomes_a_rollout_that_ends_where_it_ended():
    agent = KINDS["ppo"](gamma=0.9)
    steps = record(agent, steps=4, n=2)
    steps[4] = [np.array(e) for e in ([0, 0], [1, 0], [0, 0], [0, 0])]
    tr = agent.rollout(steps)
    np.testing.assert_allclose(tr.discount[0, :, 0], [0.9, 0.0, 0.9, 0.9])
    assert tr.last[0].tolist() == [[False, False], [True, False], [False, False], [True, True]]
    np.testing.assert_array_equal(tr.next_obs[0, 0], steps[0][1])
    np.testing.assert_array_equal(tr.next_obs[0, -1], steps[-1])
    np.testing.assert_allclose(tr.reward[0], np.stack(steps[3]), rtol=1e-6)


def test_learn_takes_scalars_of_a_single_environment_too():
    agent = KINDS["ppo"]()
    *columns, after = record(agent)
    assert np.isfinite(agent.learn([*([x[0] for x in column] for column in columns), after[0]]))


def test_the_policy_learns_what_is_rewarded():
    torch.manual_seed(0)
    agent = KINDS["ppo"](lr=3e-3, gamma=0.0)
    for _ in range(15):
        steps = record(agent, steps=64)
        steps[3] = [(action == 2).astype(float) for action in steps[1]]
        agent.learn(steps)
    assert (agent.getAction(np.repeat(OBS, 40, axis=0))[0] == 2).mean() > 0.9


@pytest.mark.parametrize("kind", ["dqn", "rainbow", "ddpg", "td3"])
def test_off_policy_agents_act_within_bounds_and_learn(kind):
    agent = KINDS[kind]()
    action = agent.getAction(OBS)
    if agent.discrete_actions:
        assert (action.shape, action.dtype) == ((5,), np.int64)
        mask = np.array([0, 1, 0, 0])
        assert agent.getAction(OBS, action_mask=mask).tolist() == [1] * 5
    else:
        assert (action.shape, action.dtype) == ((5, 2), np.float32)
        drawn = np.concatenate([agent.getAction(OBS, epsilon=1.0) for _ in range(50)])
        low, high = agent.spaces[1].low[0], agent.spaces[1].high[0]
        assert low <= drawn.min() < low + 0.3 < high - 0.3 < drawn.max() <= high
    batch = transitions(agent)
    losses = [agent.learn(batch) for _ in range(60)]
    critic = [
        x[-1] if isinstance(x, tuple) and x[-1] is not None else np.ravel(x)[0] for x in losses
    ]
    assert np.mean(critic[-5:]) < np.mean(critic[:5])
    if kind in ("ddpg", "td3"):
        assert [x[0] is None for x in losses[:4]] == [True, False, True, False]


def test_rainbow_gives_priorities_and_learns_from_n_steps():
    agent = KINDS["rainbow"]()
    batch = transitions(agent)
    extra = torch.ones(32), np.arange(32)
    loss, idxs, priorities = agent.learn((*batch, *extra, *batch), n_step=True, per=True)
    assert np.isfinite(loss)
    assert idxs is extra[1]
    assert priorities.shape == (32,)
    assert (priorities > 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_checkpoint_is_the_agent_it_was(kind, tmp_path):
    agent = KINDS[kind](index=3, batch_size=16)
    agent.learn(record(agent) if isinstance(agent, PPO) else transitions(agent))
    agent.scores, agent.fitness, agent.steps = [1.0], [np.float64(2.5)], [0, 64]
    agent.saveCheckpoint(tmp_path / "agent.pt")
    found = type(agent).load(str(tmp_path / "agent.pt"))
    assert (found.scores, found.fitness, found.steps, found.index) == ([1.0], [2.5], [0, 64], 3)
    assert found.batch_size == 16
    assert found.member.config == agent.member.config
    for name, value in vars(agent.member.state).items():
        assert torch.equal(value, getattr(found.member.state, name)), name
    clone = agent.clone(7)
    assert (clone.index, clone.scores, agent.index) == (7, [1.0], 3)
    clone.member.state.params.zero_()
    assert agent.member.state.params.any()


def test_a_checkpoint_is_a_native_policy(tmp_path):
    from skillweave.algorithms.agent_policy import AgentHeader, AgentPolicy
    from skillweave.runs.files import read_tensors, record_in

    agent = KINDS["ppo"]()
    agent.saveCheckpoint(tmp_path / "agent.pt")
    tensors, header = read_tensors(tmp_path / "agent.pt")
    policy = AgentPolicy.from_file(tensors, record_in(AgentHeader, header, "agent.pt"), "agent.pt")
    action, _ = policy.act({}, OBS)
    np.testing.assert_array_equal(action, agent.act(OBS, explore=False))


def test_settings_are_those_of_the_native_agent():
    agent = KINDS["ppo"]()
    agent.lr, agent.batch_size = 5e-4, np.int64(32)
    config = agent.member.config
    assert (config.learning_rate, config.batch_size) == (5e-4, 32)
    assert config.min_advantage_std == 0.0  # AgileRL has no such limit
    assert float(agent.member.state.learning_rate[0]) == pytest.approx(5e-4)
    other = KINDS["td3"](lr_actor=1e-4, lr_critic=1e-3, learn_step=5)
    assert (other.lr_critic, other.learn_step) == (1e-3, 5)
    assert other.member.config.actor_rate == pytest.approx(0.1)
    assert other.member.config.action_l2 == 0.0  # AgileRL has no such cost
    other.learn_step = 3
    assert other.learn_step == 3


def test_torchs_seed_decides_about_agents_and_their_actions():
    def actions():
        torch.manual_seed(5)
        agent = KINDS["ppo"]()
        return [agent.getAction(OBS)[0].tolist() for _ in range(5)]

    assert actions() == actions()


def test_images_and_one_hot_states():
    cnn = {"arch": "cnn", "channel_size": [4, 4], "kernel_size": [4, 3], "stride_size": [4, 2]}
    agent = PPO(
        (3, 24, 24), 3, False, True, net_config={**cnn, "hidden_size": [8], "normalize": True}
    )
    images = np.random.default_rng(0).integers(0, 256, (2, 3, 24, 24)).astype(np.float32)
    assert agent.getAction(images)[0].shape == (2,)
    agent = DQN([6], 3, True)
    assert agent.getAction(np.array([2, 5])).shape == (2,)
    assert PPO([6], 3, True, True).getAction(np.array([2, 5]))[3].shape == (2,)
    # A loop of the user's own collects what is learnt from, so no rollout is reserved.
    assert PPO([5_000], 3, True, True).getAction(np.array([2, 4_999]))[3].shape == (2,)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: PPO([8], 4, False, True, net_config={"arch": "mlp"}), "hidden_size"),
        (lambda: PPO([8], 4, False, True, batch_size=0), "batch_size"),
        (lambda: PPO([8], 4, False, True, actor_network=torch.nn.Linear(8, 4)), "actor_network"),
        (lambda: KINDS["ppo"]().getAction(OBS, action=torch.zeros(5)), "learn()"),
    ],
)
def test_what_cannot_be_is_said(make, says):
    with pytest.raises(SkillweaveError, match=says.replace("(", r"\(").replace(")", r"\)")):
        make()


def test_a_checkpoint_of_another_algorithm_or_none_is_refused(tmp_path):
    KINDS["ddpg"]().saveCheckpoint(tmp_path / "ddpg.pt")
    with pytest.raises(RunError, match="DDPG"):
        TD3.load(tmp_path / "ddpg.pt")
    with pytest.raises(RunError, match=r"TD3.*not of PPO"):
        PPO.load(tmp_path / "ddpg.pt")
    with pytest.raises(RunError, match="does not exist"):
        PPO.load(tmp_path / "nothing.pt")
