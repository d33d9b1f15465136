"""DQN's numbers by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from toys import Toy, learn, transitions

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Sample
from skillweave.algorithms.config import DQN
from skillweave.algorithms.dqn import DQNAlgorithm, State
from skillweave.networks.config import Network

P, B, A = 2, 7, 3
LINEAR = DQN(num_envs=2, network=Network(()), loss="mse", learning_rate=1e-2)


def make(config: DQN = LINEAR, members: int = P, **settings) -> tuple[DQNAlgorithm, State]:
    algorithm = DQNAlgorithm(replace(config, **settings), Box(-1, 1, (2,)), Discrete(A))
    state = algorithm.init([Seeds(m) for m in range(members)])
    g = torch.Generator().manual_seed(1)
    state.target = state.params + 0.5 * torch.randn(state.params.shape, generator=g)
    return algorithm, state


def sample(members: int = P, masked: bool = False, weighted: bool = False) -> Sample:
    return transitions(Discrete(A), (members, B), 2, masked=masked, weighted=weighted)


def linear(algorithm: DQNAlgorithm, flat: torch.Tensor, member: int, obs: torch.Tensor):
    views = algorithm.layout.views(flat)
    return obs @ views["q.0.weight"][member] + views["q.0.bias"][member, 0]


def loss(algorithm: DQNAlgorithm, state: State, s: Sample) -> tuple[torch.Tensor, ...]:
    with torch.no_grad():
        return algorithm.loss(algorithm.layout.views(state.params), state, s, [None] * 3)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("double", [False, True])
def test_the_target_by_hand(double, masked):
    # The sample's own discount counts, and it is 0 at an end.
    algorithm, state = make(double=double)
    s = sample(masked=masked)
    _, error, mean = loss(algorithm, state, s)
    differ = 0
    for m in range(P):
        for b in range(B):
            slow = linear(algorithm, state.target, m, s.next_obs[m, b])
            fast = linear(algorithm, state.params, m, s.next_obs[m, b])
            allowed = [a for a in range(A) if not masked or s.next_mask[m, b, a]]
            judge = fast if double else slow
            best = max(allowed, key=lambda a, judge=judge: judge[a].item())
            differ += best != int(slow.argmax())
            target = s.reward[m, b] + s.discount[m, b] * slow[best]
            q = linear(algorithm, state.params, m, s.obs[m, b])[s.action[m, b]]
            assert error[m, b].item() == pytest.approx(abs(q - target).item(), rel=1e-4)
    assert (differ > 0) == (double or masked)
    every = [linear(algorithm, state.params, m, s.obs[m]) for m in range(P)]
    q = torch.stack(every).gather(-1, s.action[..., None])
    torch.testing.assert_close(mean, q.mean((1, 2)))


@pytest.mark.parametrize("kind", ["mse", "huber"])
@pytest.mark.parametrize("weighted", [False, True])
def test_the_loss_is_the_mean_of_what_errors_cost_times_their_weights(weighted, kind):
    algorithm, state = make(loss=kind)
    s = sample(weighted=weighted)
    total, error, _ = loss(algorithm, state, s)
    huber = torch.where(error < 1, 0.5 * error**2, error - 0.5)
    each = 0.5 * error**2 if kind == "mse" else huber
    assert (error > 1).any()
    weight = s.weight if weighted else torch.ones(P, B)
    torch.testing.assert_close(total, (each * weight).mean(1))


def test_the_reward_is_divided_by_the_deviation_of_returns():
    algorithm, state = make(normalize_rewards=True)
    state.return_var = torch.tensor([[4.0], [100.0]])
    plain, same = make()
    s = sample()
    scaled = replace(s, reward=s.reward / torch.tensor([[2.0], [10.0]]))
    torch.testing.assert_close(loss(algorithm, state, s)[1], loss(plain, same, scaled)[1])


@pytest.mark.parametrize("masked", [False, True])
def test_the_distributions_target_is_the_projection_of_the_best_actions(masked):
    algorithm, state = make(distributional=True, n_atoms=5, v_min=-2.0, v_max=2.0, double=True)
    s = sample(masked=masked)
    total, error, mean = loss(algorithm, state, s)
    atoms, costs, means = [-2.0, -1.0, 0.0, 1.0, 2.0], torch.zeros(P, B), torch.zeros(P, B)
    for m in range(P):
        for b in range(B):
            fast = linear(algorithm, state.params, m, s.next_obs[m, b]).view(A, 5).softmax(-1)
            slow = linear(algorithm, state.target, m, s.next_obs[m, b]).view(A, 5).softmax(-1)
            worth = fast @ torch.tensor(atoms)
            allowed = [a for a in range(A) if not masked or s.next_mask[m, b, a]]
            p, target = slow[max(allowed, key=lambda a, w=worth: w[a].item())], [0.0] * 5
            for j in range(5):
                moved = s.reward[m, b].item() + s.discount[m, b].item() * atoms[j]
                at = min(2.0, max(-2.0, moved)) + 2.0
                low = min(int(at), 3)
                target[low] += p[j].item() * (low + 1 - at)
                target[low + 1] += p[j].item() * (at - low)
            logits = linear(algorithm, state.params, m, s.obs[m, b]).view(A, 5)[s.action[m, b]]
            costs[m, b] = -(torch.tensor(target) * logits.log_softmax(-1)).sum()
            means[m, b] = logits.softmax(-1) @ torch.tensor(atoms)
    torch.testing.assert_close(error, costs)
    torch.testing.assert_close(total, costs.mean(1))
    torch.testing.assert_close(mean, means.mean(1))


def test_an_update_is_a_step_of_adam_and_the_target_follows():
    algorithm, state = make(members=1, tau=0.25)
    s = sample(1)
    before, slow = state.params.clone(), state.target.clone()
    leaf = before.clone().requires_grad_()
    algorithm.loss(algorithm.layout.views(leaf), state, s, [None] * 3)[0].sum().backward()
    _, report = algorithm.update(state, s, [Seeds(0).torch()])
    # Adam's first step: the rate times the sign of the gradient, but for ε.
    step = 1e-2 * leaf.grad / (leaf.grad.abs() + algorithm.config.adam_eps)
    torch.testing.assert_close(state.params, before - step)
    torch.testing.assert_close(state.target, slow + 0.25 * (state.params - slow))
    assert report.metrics["grad_norm"].item() == pytest.approx(leaf.grad.norm().item(), rel=1e-4)


def test_the_target_is_updated_now_and_then():
    algorithm, state = make(target_update_interval=3, tau=1.0)
    slow, changed = state.target.clone(), []
    for _ in range(6):
        algorithm.update(state, sample(), [Seeds(m).torch() for m in range(P)])
        changed.append(not torch.equal(state.target, slow))
        slow = state.target.clone()
    assert changed == [False, False, True] * 2
    assert torch.equal(state.target, state.params)


@pytest.mark.parametrize(("progress", "epsilon"), [(0.0, 0.8), (0.1, 0.5), (0.2, 0.2), (1.0, 0.2)])
def test_the_share_of_random_actions_falls_and_stays(progress, epsilon):
    algorithm, state = make(
        exploration_fraction=0.2, exploration_initial_eps=0.8, exploration_final_eps=0.2
    )
    actor = algorithm.acting_params(state, progress)
    assert actor.extra["epsilon"].flatten().tolist() == pytest.approx([epsilon] * P)
    obs, n = torch.ones(P, 20_000, 2), 20_000
    noise = algorithm.noise([Seeds(m).torch() for m in range(P)], 1, n)[0]
    action, q, _ = algorithm.act(actor, obs, None, noise)
    greedy = (action == q.argmax(-1)).float().mean(1)
    assert greedy.tolist() == pytest.approx([1 - epsilon * (A - 1) / A] * P, abs=0.02)


def test_noisy_weights_explore_and_nothing_else_does():
    algorithm, state = make(noisy=True, network=Network((16,)))
    actor, obs = algorithm.acting_params(state), torch.randn(P, 5, 2)
    assert not actor.extra["epsilon"].any()
    noises = algorithm.noise([Seeds(m).torch() for m in range(P)], 30, 5)
    values = torch.stack([algorithm.act(actor, obs, None, n)[1] for n in noises])
    assert values.std(0).min() > 1e-3
    for noise, q in zip(noises, values, strict=True):
        action, _, _ = algorithm.act(actor, obs, None, noise)
        assert torch.equal(action, q.argmax(-1))
    means, _, _ = algorithm.act(actor, obs, None, None)
    assert torch.equal(means, algorithm.act(actor, obs, None, (noises[0][0], None))[0])


def test_rainbow_has_every_extension_and_settings_override():
    config = DQN.rainbow(n_step=5)
    assert (config.n_step, config.adam_eps) == (5, 1.5e-4)
    for name in ("double", "dueling", "noisy", "distributional", "prioritized"):
        assert getattr(config, name) is True


# The atoms


class Pays(Toy):
    """Each action pays thousands, the second the most."""

    def play(self, action):
        still = np.zeros((self.num_envs, 1), np.float32)
        return still, 4000.0 + 2000.0 * action, self.never, self.never


def test_atoms_without_bounds_of_their_own_fit_the_returns_seen():
    config = DQN(
        distributional=True, num_envs=8, learning_starts=64, buffer_size=1000, batch_size=32,
        learning_rate=0.1, tau=0.3, gamma=0.5, network=Network(()), update_ratio=0.25,
    )  # fmt: skip
    algorithm, state = learn(config, Pays(8), 1200)
    scale = (state.return_var + state.return_mean.square()).sqrt()
    _, q, _ = algorithm.act(algorithm.acting_params(state), torch.zeros(1, 1, 1), None, None)
    # Of the best policy 6000 / (1 − γ); the other action loses 2000 of it.
    assert (q * scale).flatten().tolist() == pytest.approx([10_000, 12_000], rel=0.05)


def test_the_units_of_atoms_by_hand():
    algorithm, state = make(distributional=True, n_atoms=5)
    assert algorithm.atoms.on(torch.device("cpu")).tolist() == [-10, -5, 0, 5, 10]
    assert algorithm.scales_rewards
    state.return_mean[:], state.return_var[:] = 3.0, 16.0
    s = sample()
    torch.testing.assert_close(algorithm.rewards(state, s), s.reward / 5.0)
    given, state = make(distributional=True, n_atoms=5, v_min=-2.0, v_max=2.0)
    assert not given.scales_rewards
    assert torch.equal(given.rewards(state, s), s.reward)
