"""What a stage adds to PPO: epsilon of discrete actions, the anchor, the task's advantage."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch.distributions import Categorical, Independent, Normal, kl_divergence
from toys import Toy, learn, rollout_of

from skillweave import PPO, Network
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import ppo
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm
from skillweave.algorithms.parameters import epsilon_now
from skillweave.algorithms.ppo import RehearsalRows, Terms
from skillweave.networks.heads import ActionHead
from skillweave.ops.distributions import with_epsilon
from skillweave.spaces import action_codec
from skillweave.training.learner import adapted
from skillweave.training.rehearsal import rehearsal_of

SEEN = gym.spaces.Box(-1, 1, (3,), np.float32)
SMALL = Network(hidden=(8,))


def test_a_floor_is_shared_among_what_is_allowed():
    logits = torch.tensor([[2.0, 0.0, 1.0, 5.0]])
    mask = torch.tensor([[True, True, True, False]])
    found = with_epsilon(logits, mask, torch.tensor([[0.3]])).softmax(-1)
    own = logits[0, :3].softmax(-1)
    torch.testing.assert_close(found[0, :3], 0.7 * own + 0.1)
    assert found[0, 3] < 1e-6


def test_the_floor_falls_over_the_budget():
    config, like = PPO(epsilon=0.5, epsilon_final=0.1), torch.zeros(2)
    assert epsilon_now(config, 0.25, like).flatten().tolist() == pytest.approx([0.4, 0.4])
    fast = replace(config, epsilon_fraction=0.4)
    for progress, share in ((0.0, 0.5), (0.1, 0.4), (0.4, 0.1), (1.0, 0.1)):
        assert epsilon_now(fast, progress, like).flatten().tolist() == pytest.approx([share] * 2)
    at_once = replace(config, epsilon_fraction=0.0)
    assert epsilon_now(at_once, 0.0, like).flatten().tolist() == [0.5, 0.5]
    assert epsilon_now(at_once, 0.01, like).flatten().tolist() == pytest.approx([0.1, 0.1])
    assert epsilon_now(PPO(epsilon=0.5), 0.9, like).flatten().tolist() == [0.5, 0.5]
    assert epsilon_now(PPO(), 0.5, like) is None


def test_who_acts_has_the_floor_and_who_is_greedy_has_not():
    algorithm = make_algorithm(PPO(epsilon=0.8, network=SMALL), SEEN, gym.spaces.Discrete(4))
    state = algorithm.init([Seeds(0)])
    obs = torch.zeros(1, 1, 3)
    _, head, _ = algorithm.act(algorithm.acting_params(state, 0.0), obs, None, None)
    assert head.softmax(-1).min() >= 0.2 - 1e-6
    greedy = algorithm.acting_params_of(algorithm.weights(state))
    assert "epsilon" not in greedy.extra


def test_divergence_of_heads_is_that_of_their_distributions():
    rng = torch.Generator().manual_seed(0)

    def drawn(*shape):
        return torch.randn(shape, generator=rng)

    head = ActionHead(action_codec(gym.spaces.Discrete(5)))
    a, b = drawn(1, 6, 5), drawn(1, 6, 5)
    want = kl_divergence(Categorical(logits=a), Categorical(logits=b))
    torch.testing.assert_close(head.kl(a, None, b, None, None), want)
    mask = torch.tensor([True, True, False, True, False]).expand(1, 6, 5)
    few = kl_divergence(
        Categorical(logits=a[..., [0, 1, 3]]), Categorical(logits=b[..., [0, 1, 3]])
    )
    torch.testing.assert_close(head.kl(a, None, b, None, mask), few)
    parts = ActionHead(action_codec(gym.spaces.MultiDiscrete([2, 3])))
    one = kl_divergence(Categorical(logits=a[..., :2]), Categorical(logits=b[..., :2]))
    two = kl_divergence(Categorical(logits=a[..., 2:]), Categorical(logits=b[..., 2:]))
    torch.testing.assert_close(parts.kl(a, None, b, None, None), one + two)
    box = ActionHead(action_codec(gym.spaces.Box(-1, 1, (5,), np.float32)))
    std, other = drawn(1, 1, 5), drawn(1, 1, 5)
    want = kl_divergence(
        Independent(Normal(a, std.exp()), 1), Independent(Normal(b, other.exp()), 1)
    )
    torch.testing.assert_close(box.kl(a, std, b, other, None), want)


@pytest.mark.parametrize(
    ("space", "earlier", "present", "log_std", "want"),
    [
        # Probabilities 1/4 and 3/4, then 1/2 each: 1/4 ln(1/2) + 3/4 ln(3/2).
        (gym.spaces.Discrete(2), (0.0, np.log(3.0)), (0.0, 0.0), None, 0.1308),
        # Means 1 apart, deviations 1 and 2: ln 2 + (1 + 1) / (2 · 4) − 1/2.
        (gym.spaces.Box(-1, 1, (1,), np.float32), (1.0,), (0.0,), (0.0, np.log(2.0)), 0.4431),
    ],
    ids=["choices", "numbers"],
)
def test_a_rehearsal_costs_the_divergence_from_the_earlier_policy(
    space, earlier, present, log_std, want
):
    algorithm = make_algorithm(PPO(network=SMALL, normalize_obs=False), SEEN, space)
    state = algorithm.init([Seeds(0)])
    views = algorithm.layout.views(state.params)
    views[f"{algorithm.actor_net.head}.weight"].zero_()
    views[f"{algorithm.actor_net.head}.bias"].copy_(torch.tensor(present))
    before, now = (
        (None, None)
        if log_std is None
        else torch.tensor(log_std, dtype=torch.float32).view(2, 1, 1, 1)
    )
    rows = RehearsalRows(
        algorithm.inputs(algorithm.learning_params(state), torch.zeros(1, 5, 3)),
        torch.tensor(earlier, dtype=torch.float32).expand(1, 5, len(earlier)),
        before,
    )
    found = algorithm.rehearsal_kl(views, now, rows)
    torch.testing.assert_close(found, torch.tensor([want]), rtol=0, atol=1e-4)


@pytest.mark.parametrize("space", [gym.spaces.Discrete(4), gym.spaces.Box(-1, 1, (2,), np.float32)])
def test_a_rehearsed_observation_keeps_its_actions_and_others_do_not(space):
    config = PPO(network=SMALL, update_epochs=8, learning_rate=1e-2, batch_size=32)
    algorithm, moved = make_algorithm(config, SEEN, space), []
    for rehearses in (False, True):
        state = algorithm.init([Seeds(0)])
        algorithm.update_obs_stats(state, rollout_of(algorithm, state).obs.flatten(1, 2))
        policy = AgentPolicy.of(algorithm, state)
        seen = torch.randn(32, 3, generator=torch.Generator().manual_seed(9)) + 3.0
        kept = rehearsal_of(policy, seen, torch.device("cpu"))
        for update in range(8):
            rollout = rollout_of(algorithm, state, update, rehearsal=kept if rehearses else None)
            _, report = algorithm.update(state, rollout, [Seeds(update).torch()])
            assert ("rehearsal_kl" in report.metrics) == rehearses
        params = algorithm.learning_params(state)
        now = algorithm.inputs(params, kept.obs)
        rows = RehearsalRows(now, kept.dist_params, kept.log_std)
        moved.append(algorithm.rehearsal_kl(params.views, params.views.get("actor.log_std"), rows))
    assert moved[1] < 0.5 * moved[0]


def test_with_a_floor_samples_are_weighted_and_the_clip_counts_from_the_policy_itself():
    """A mixture that is nearly uniform hardly changes where the policy collapses."""
    config = PPO(epsilon=0.9, network=SMALL, normalize_obs=False)
    algorithm = make_algorithm(config, SEEN, gym.spaces.Discrete(4))
    state = algorithm.init([Seeds(0)])
    rollout = rollout_of(algorithm, state)
    bare = algorithm.acting_params_of(algorithm.weights(state))
    _, own, _ = algorithm.act(bare, rollout.obs.flatten(1, 2), None, None)
    action = rollout.action.flatten(1, 2).long()[..., None]
    chosen = own.softmax(-1).gather(-1, action)[..., 0]
    found, _ = algorithm.samples(state, rollout, Terms.of(config, state, rollout))
    torch.testing.assert_close(found.log_prob, chosen.log())
    torch.testing.assert_close(found.importance, chosen / (0.1 * chosen + 0.9 / 4))


def shares(algorithm, state):
    """The probabilities of actions in the observation 0, without epsilon."""
    params = algorithm.acting_params_of(algorithm.weights(state))
    return algorithm.act(params, torch.zeros(1, 1, 3), None, None)[1].softmax(-1)[0, 0]


def of_two_choices(algorithm, state, seed, paid):
    """Choices in one place: the first ends at once, the second is paid and ends the episode.

    Some choices are made at random, by epsilon.
    """
    rollout = rollout_of(algorithm, state, seed, 16, 4, around=0.0)
    rollout.obs.zero_()
    rollout.next_obs.zero_()
    rollout.reward = paid * rollout.action.float()
    rollout.discount = 0.99 * (rollout.action == 0)
    rollout.last = rollout.action == 1
    rollout.last[:, -1] = True
    return rollout


def collapsed(**settings):
    """An algorithm of two choices, and a state that takes the first one nearly always."""
    config = PPO(
        epsilon=0.3, network=SMALL, normalize_obs=False, learning_rate_schedule="constant",
        update_epochs=10, **settings,
    )  # fmt: skip
    algorithm = make_algorithm(config, SEEN, gym.spaces.Discrete(2))
    state = algorithm.init([Seeds(0)])
    algorithm.layout.views(state.params)[f"{algorithm.actor_net.head}.bias"][..., 0] += 12.0
    return algorithm, state


def test_a_policy_that_has_collapsed_learns_what_exploration_finds(monkeypatch):
    found = []
    for openness in (ppo.OPENNESS, 0.0):
        monkeypatch.setattr(ppo, "OPENNESS", openness)
        algorithm, state = collapsed(learning_rate=1e-2)
        assert shares(algorithm, state)[1] < 1e-5
        for i in range(60):
            rollout = of_two_choices(algorithm, state, i, 1.0)
            state, _ = algorithm.update(state, rollout, [torch.Generator().manual_seed(i)])
        found.append(shares(algorithm, state)[1].item())
    assert found[0] > 0.9
    assert found[1] < 1e-3, "else this shows nothing"


def test_no_choice_vanishes_while_there_is_exploration():
    """The second choice costs; in the end about 0.1·ε/n is left of it."""
    algorithm, state = collapsed(learning_rate=1e-2)
    for i in range(100):
        rollout = of_two_choices(algorithm, state, i, -1.0)
        state, _ = algorithm.update(state, rollout, [torch.Generator().manual_seed(i)])
    assert 0.002 < shares(algorithm, state)[1] < 0.1


def test_values_are_those_of_the_policy_without_its_random_choices():
    """The policy never takes the choice that is paid; its mixture with chance does."""
    algorithm, state = collapsed(learning_rate=1e-9, normalize_returns=False)
    rollout = of_two_choices(algorithm, state, 0, 1.0)
    samples, _ = algorithm.samples(state, rollout, Terms.of(algorithm.config, state, rollout))
    assert rollout.action.any()
    torch.testing.assert_close(samples.target, torch.zeros_like(samples.target), atol=1e-4, rtol=0)
    paid = rollout.action.flatten(1) == 1
    assert (samples.advantage[paid] > 1.0).all(), "normalised, far above the mean"


def test_the_tasks_advantage_counts_beside_the_learners_own():
    config = PPO(network=SMALL, update_epochs=20, learning_rate=1e-2, ent_coef=0.0)
    algorithm = make_algorithm(config, SEEN, gym.spaces.Discrete(2))
    state = algorithm.init([Seeds(0)])
    rollout = rollout_of(algorithm, state)
    before = rollout.dist_params.softmax(-1)[..., 0].mean()
    # For the task, action 0 is always much better; the learner's own reward is chance.
    rollout.advantage = 20.0 * (1.0 - 2.0 * rollout.action)
    state, _ = algorithm.update(state, rollout, [torch.Generator().manual_seed(1)])
    params = algorithm.acting_params(state)
    _, head, _ = algorithm.act(params, rollout.obs.flatten(1, 2), None, None)
    assert head.softmax(-1)[..., 0].mean() > before + 0.1


def test_the_price_of_divergence_follows_the_budget():
    coef, kl = torch.tensor([1.0, 1.0, 1.0]), torch.tensor([0.2, 0.1, 0.01])
    assert adapted(coef, kl, 0.1).tolist() == [2.0, 1.0, 0.5]
    assert adapted(torch.tensor([1e3]), torch.tensor([9.0]), 0.1).tolist() == [1e3]


class Fruitless(Toy):
    """A walk on a plane on which every step costs the same; an episode is cut after 20."""

    observation_space = gym.spaces.Box(-9.0, 9.0, (2,), np.float32)
    action_space = gym.spaces.Discrete(4)
    moves = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)], np.float32)

    def first(self, rows):
        return self.rng.uniform(-4, 4, (len(rows), 2)).astype(np.float32)

    def play(self, action):
        after = np.clip(self.obs + self.moves[action], -9, 9)
        never = np.zeros(self.num_envs, bool)
        return after, np.full(self.num_envs, -0.02), never, self.t >= 20


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_policy_that_can_win_nothing_stays_as_random_as_it_was(seed):
    """All advantages are the critic's errors. Made as large as any, they move the policy."""

    def entropy(**how):
        config = PPO(
            num_envs=16, n_steps=64, gamma=0.9, update_epochs=4,
            learning_rate_schedule="constant", network=Network((64, 64)), **how,
        )  # fmt: skip
        algorithm, state = learn(config, Fruitless(16), 40_000, seed, members=(seed,))
        obs = torch.as_tensor(Fruitless.moves * 2)[None]
        _, head, _ = algorithm.act(algorithm.acting_params(state), obs, None, None)
        return Categorical(logits=head).entropy().mean().item()

    assert entropy() > 0.95 * np.log(4)
    assert entropy(min_advantage_std=0.0) < 0.8 * np.log(4)
