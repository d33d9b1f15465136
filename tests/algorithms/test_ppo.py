from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from torch import nn
from toys import Echo, learn, members_of, random_critic, rollout_of, training

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.config import (
    PPO,
)
from skillweave.algorithms.ppo import PPOAlgorithm, State
from skillweave.algorithms.schedules import Linear
from skillweave.networks.config import RNN, Network
from skillweave.ops.moments import normalize
from skillweave.ops.returns import gae

T, B = 8, 6
OBS = Box(-np.inf, np.inf, (3,), np.float32)
CONFIG = PPO(
    num_envs=B, n_steps=T, batch_size=16, update_epochs=3, network=Network((16,)),
    learning_rate_schedule="constant", normalize_obs=False,
)  # fmt: skip


def make(action=None, members=1, **settings) -> tuple[PPOAlgorithm, State]:
    """An algorithm, and members whose critics say something; at first they say 0."""
    algorithm = PPOAlgorithm(replace(CONFIG, **settings), OBS, action or Discrete(4))
    state = algorithm.init([Seeds(m) for m in range(members)])
    random_critic(algorithm, state)
    return algorithm, state


def rngs(*seeds: int | Seeds) -> list[torch.Generator]:
    return [(s if isinstance(s, Seeds) else Seeds(s)).torch() for s in seeds]


def updated(
    algorithm: PPOAlgorithm, state: State, updates: int = 3, members=range(1), **kwargs
) -> State:
    """Several updates on data that depends on the member's number alone."""
    for u in range(updates):
        whole = rollout_of(
            algorithm, algorithm.init([Seeds(m) for m in range(3)]), seed=u, **kwargs
        )
        mine = members_of(whole, slice(members.start, members.stop))
        mine.progress = u / updates
        state, _ = algorithm.update(state, mine, rngs(*(Seeds(9) / m / u for m in members)))
    return state


VARIANTS = {
    "plain": {},
    "continuous": {"action": Box(-1, 1, (2,))},
    "value clipping": {"clip_value": 0.2},
    "normalised observations": {"normalize_obs": True},
    "early stop": {"target_kl": 0.003, "learning_rate": 1e-2},
    "rate by kl": {"target_kl": 0.01, "learning_rate_schedule": "kl"},
    "linear rate": {"learning_rate_schedule": "linear"},
    "small advantages": {"min_advantage_std": 10.0},
    "raw": {"normalize_returns": False, "normalize_advantage": False},
    "critic of its own": {"critic": Network((8, 8), "relu", layer_norm=True)},
    "minibatches of unequal size": {"batch_size": 13},
}


@pytest.mark.fast_cases(3)
@pytest.mark.parametrize("variant", [*VARIANTS, "masked"])
def test_a_stack_of_three_learns_what_three_single_members_learn(variant):
    masked, settings = variant == "masked", VARIANTS.get(variant, {})

    def with_own_settings(state: State) -> State:
        state.learning_rate *= torch.tensor([1.0, 0.5, 2.0])
        state.clip_coef *= torch.tensor([1.0, 0.5, 2.0])
        state.ent_coef *= torch.tensor([1.0, 10.0, 0.0])
        state.vf_coef *= torch.tensor([1.0, 0.2, 2.0])
        state.gae_lambda *= torch.tensor([1.0, 0.5, 0.0])
        state.max_grad_norm *= torch.tensor([1.0, 0.1, 10.0])
        return state

    algorithm, state = make(members=3, **settings)
    start = with_own_settings(state)
    singles = [members_of(start, slice(m, m + 1)) for m in range(3)]
    stack = updated(algorithm, start, members=range(3), masked=masked)
    for m, single in enumerate(singles):
        single = updated(algorithm, single, members=range(m, m + 1), masked=masked)
        for f in fields(State):
            whole, one = getattr(stack, f.name)[m], getattr(single, f.name)[0]
            torch.testing.assert_close(
                whole, one, rtol=1e-3, atol=1e-5, msg=lambda x, f=f: f"{f.name}: {x}"
            )
    assert not torch.allclose(stack.params[0], stack.params[1], atol=1e-2)


def plain_network(algorithm: PPOAlgorithm, state: State, prefix: str) -> nn.Sequential:
    views = algorithm.layout.views(state.params)
    layers = []
    for i in range(2):
        weight = views[f"{prefix}.{i}.weight"][0]
        layers += [nn.Linear(*weight.shape), nn.Tanh()]
        layers[-2].weight.data = weight.T.clone()
        layers[-2].bias.data = views[f"{prefix}.{i}.bias"][0, 0].clone()
    return nn.Sequential(*layers[:-1])


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize(
    ("space", "masked"), [(Discrete(4), False), (Discrete(4), True), (Box(-1, 1, (2,)), False)]
)
def test_an_update_equals_ppo_written_plainly_with_torchs_modules_and_optimiser(
    space, masked, late
):
    settings = {"batch_size": T * B, "normalize_returns": False, "ent_coef": 0.1, "clip_coef": 0.01}
    algorithm, state = make(space, **settings)
    cfg = algorithm.config
    data = tr = rollout_of(algorithm, state, masked=masked)
    acted, _ = algorithm.head.stats(data.dist_params, data.log_std, tr.mask, tr.action)
    if late:  # what learns is no longer what acted
        state = algorithm.init([Seeds(7)])
        random_critic(algorithm, state)
        algorithm.layout.views(state.params)["actor.1.weight"].mul_(100.0)
    actor, critic = (plain_network(algorithm, state, k) for k in ("actor", "critic"))
    log_std = nn.Parameter(torch.full((2,), cfg.action_std_init).log())
    parameters = [*actor.parameters(), *critic.parameters()]
    parameters += [] if algorithm.head.discrete else [log_std]
    adam = torch.optim.Adam(parameters, cfg.learning_rate, eps=cfg.adam_eps)

    def policy() -> torch.distributions.Distribution:
        head = actor(tr.obs)
        if algorithm.head.discrete:
            head = head.masked_fill(~tr.mask, -1e9) if masked else head
            return torch.distributions.Categorical(logits=head)
        return torch.distributions.Independent(torch.distributions.Normal(head, log_std.exp()), 1)

    with torch.no_grad():
        old, value = policy().log_prob(tr.action), critic(tr.obs)[..., 0]
        weight = (old - acted).exp()
        assert ((weight - 1.0).abs() > 0.1).any() == late
        raw = gae(
            tr.reward, tr.discount, value, critic(tr.next_obs)[..., 0], tr.last, state.gae_lambda
        )
        target, advantage = raw + value, normalize(raw)
    for _ in range(cfg.update_epochs):
        ratio = (policy().log_prob(tr.action) - old).exp()
        gain = torch.min(
            ratio * advantage, ratio.clamp(1 - cfg.clip_coef, 1 + cfg.clip_coef) * advantage
        )
        error = 0.5 * (critic(tr.obs)[..., 0] - target).square()
        loss = (-weight * gain + cfg.vf_coef * error - cfg.ent_coef * policy().entropy()).mean()
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, cfg.max_grad_norm)
        adam.step()
    state, report = algorithm.update(state, data, rngs(0))
    for prefix, network in (("actor", actor), ("critic", critic)):
        stacked = plain_network(algorithm, state, prefix)
        for a, b in zip(stacked.parameters(), network.parameters(), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5)
    if not algorithm.head.discrete:
        got = algorithm.layout.views(state.params)["actor.log_std"][0, 0]
        torch.testing.assert_close(got, log_std.data, rtol=1e-4, atol=1e-6)
    assert report.metrics["samples"].tolist() == [T * B]


def test_continuous_sampling_has_the_initial_deviation():
    algorithm, state = make(Box(-1, 1, (2,)), action_std_init=0.3)
    noise = algorithm.noise([Seeds(0).torch()], 1, 50_000)[0]
    action, head, _ = algorithm.act(
        algorithm.acting_params(state), torch.ones(1, 50_000, 3), None, noise
    )
    torch.testing.assert_close(action[0].std(0), torch.full((2,), 0.3), rtol=0.02, atol=0)
    torch.testing.assert_close(action[0].mean(0), head[0, 0], rtol=0, atol=0.01)


@pytest.mark.parametrize("space", [Discrete(4), Box(-1, 1, (2,))])
@pytest.mark.parametrize("normalize_advantage", [True, False])
def test_without_an_entropy_bonus_a_fresh_policy_does_not_move_until_something_is_paid(
    space, normalize_advantage
):
    algorithm, _ = make(space, ent_coef=0.0, normalize_advantage=normalize_advantage)
    state = algorithm.init([Seeds(0)])
    before = state.params.clone()
    for i in range(3):
        data = replace(rollout_of(algorithm, state, i), reward=torch.zeros(1, T, B))
        state, _ = algorithm.update(state, data, rngs(i))
    assert torch.equal(state.params, before)
    state, _ = algorithm.update(state, rollout_of(algorithm, state, 3), rngs(3))
    assert not torch.equal(state.params, before)


def test_a_minibatch_is_an_eighth_of_the_rollout_unless_its_size_is_given():
    assert PPO(num_envs=32, n_steps=64).minibatch == 256
    assert PPO(num_envs=2, n_steps=8).minibatch == 64
    assert PPO(num_envs=32, n_steps=64, batch_size=100).minibatch == 100


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("action_std", ["parameter", "state"])
def test_where_nothing_is_paid_the_entropy_bonus_does_not_widen_the_deviation_for_ever(action_std):
    algorithm, state = make(
        Box(-1, 1, (2,)), ent_coef=0.1, learning_rate=0.02, action_std=action_std
    )
    for i in range(60):
        data = replace(rollout_of(algorithm, state, i), reward=torch.zeros(1, T, B))
        state, _ = algorithm.update(state, data, rngs(i))
    head = algorithm.act(algorithm.acting_params(state), torch.full((1, 1, 3), 2.0), None, None)[1]
    log_std = algorithm.layout.views(state.params).get("actor.log_std")
    deviation = algorithm.head.moments(head, log_std)[1].exp()
    assert (deviation > 0.8).all()
    assert (deviation < 1.5).all()


@pytest.mark.parametrize("normalize_obs", [False, True])
def test_an_actor_is_a_copy_that_learning_does_not_change(normalize_obs):
    algorithm, state = make(normalize_obs=normalize_obs)
    actor, obs = algorithm.acting_params(state), torch.randn(1, 5, 3)
    before = algorithm.act(actor, obs, None, None)[1].clone()
    algorithm.update(state, rollout_of(algorithm, state), rngs(0))
    assert torch.equal(algorithm.act(actor, obs, None, None)[1], before)
    assert not torch.equal(
        algorithm.act(algorithm.acting_params(state), obs, None, None)[1], before
    )


def test_observations_are_normalised_by_all_that_were_seen():
    algorithm, state = make(normalize_obs=True)
    data = [rollout_of(algorithm, state, seed=s) for s in range(2)]
    for d in data:
        algorithm.update(state, d, rngs(0))
    seen = torch.cat([d.obs.flatten(0, 2) for d in data])
    torch.testing.assert_close(state.obs_mean[0], seen.mean(0), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(state.obs_var[0], seen.var(0, unbiased=False), rtol=1e-4, atol=1e-4)


def test_a_member_that_oversteps_the_kl_stops_and_the_others_go_on():
    algorithm, state = make(members=2, target_kl=1e-4, update_epochs=10)
    state.learning_rate = torch.tensor([0.01, 1e-7])
    _, report = algorithm.update(state, rollout_of(algorithm, state), rngs(0, 1))
    assert 0 < state.count[0] < 30
    assert state.count[1] == 30
    # Metrics are means over the steps it took; it is still almost uniform.
    assert report.metrics["entropy"].tolist() == pytest.approx([np.log(4)] * 2, rel=0.05)


@pytest.mark.parametrize("settings", [{}, {"normalize_obs": True}])
def test_an_update_from_an_old_policy_is_never_empty(settings):
    algorithm, state = make(target_kl=1e-5, learning_rate=0.05, **settings)
    stale = rollout_of(algorithm, state)
    for done in range(1, 4):  # by the second, the policy is another than acted
        before = state.params.clone()
        _, report = algorithm.update(state, stale, rngs(0))
        assert state.count.item() == done  # the second step would overstep
        assert not torch.equal(state.params, before)
        assert report.metrics["kl"].item() > 1e-5


def test_kl_counts_from_the_first_policy_of_an_update():
    algorithm, state = make(batch_size=T * B, update_epochs=2, learning_rate=0.05)
    data = rollout_of(algorithm, state)
    algorithm.layout.views(state.params)["actor.1.bias"] += torch.tensor([0.5, 0.0, -0.5, 0.0])
    tr, heads = data, []
    for epochs in range(2):  # the policies before the first and the second gradient step
        one, same = make(batch_size=T * B, update_epochs=1, learning_rate=0.05)
        same.params.copy_(state.params)
        if epochs:
            one.update(same, data, rngs(0))
        heads.append(one.act(one.acting_params(same), tr.obs.flatten(1, 2), None, None)[1])
    taken = tr.action.flatten(1, 2)
    first, second = (algorithm.head.stats(h, None, None, taken)[0] for h in heads)
    acted = algorithm.head.stats(data.dist_params, None, None, tr.action)[0].flatten(1, 2)
    ratio = (second - first).exp()
    expected = ((first - acted).exp() * (ratio - 1.0 - ratio.log())).mean() / 2  # the first is 0
    _, report = algorithm.update(state, data, rngs(0))
    assert expected > 1e-4
    assert report.metrics["kl"].item() == pytest.approx(expected.item(), rel=1e-2)


class Weighed(PPOAlgorithm):
    """Keeps the weights of all samples."""

    def loss(self, views, state, batch, now):
        self.found = [*getattr(self, "found", []), batch.importance]
        return super().loss(views, state, batch, now)


SPACES = pytest.mark.parametrize("asks", ["Discrete", "MultiDiscrete", "Box"])
MEMORIES = pytest.mark.parametrize("rnn", [None, RNN("lstm", 8)])


@SPACES
@MEMORIES
@pytest.mark.parametrize("overlap", [False, True])
def test_weights_are_one_unless_what_acted_is_old(asks, rnn, overlap):
    env, config = Echo(B, "vector", asks), replace(CONFIG, network=Network((16,), rnn=rnn))
    config = replace(config, overlap=overlap, learning_rate=1e-2, batch_size=T * B)
    algorithm = Weighed(config, env.observation_space, env.action_space)
    training(algorithm, env).run(4 * T * B)
    off = [(w - 1.0).abs().max().item() for w in algorithm.found[:: config.update_epochs]]
    assert len(off) == 4
    assert [x > 1e-3 for x in off] == [False, overlap, overlap, overlap]


@pytest.mark.fast_cases(5)
@SPACES
@MEMORIES
@pytest.mark.parametrize(("columns", "steps"), [(1, 1), (1, 5), (4, 1), (4, 4)])
def test_a_rollout_of_any_size_is_learnt_from(columns, steps, asks, rnn):
    # A selector's rollout holds as many decisions as fit into its steps: few, or one.
    config = PPO(
        num_envs=columns, n_steps=steps, normalize_obs=True, network=Network((16,), rnn=rnn)
    )
    ticks = []
    _, state = learn(
        config, Echo(columns, "vector", asks), 3 * columns * steps, on_tick=ticks.append
    )
    assert state.count.item() == 3 * config.update_epochs  # all of it is one minibatch
    assert torch.isfinite(state.params).all()
    assert [t.metrics["samples"] for t in ticks] == [columns * steps] * 3


def test_the_kl_schedule_speeds_a_timid_member_up_and_slows_a_bold_one_down():
    two = {"update_epochs": 1, "batch_size": T * B // 2}
    algorithm, state = make(
        members=2, learning_rate_schedule="kl", learning_rate=1e-3, target_kl=1e-3, **two
    )
    state.learning_rate = torch.tensor([2e-5, 9e-3])
    algorithm.update(state, rollout_of(algorithm, state), rngs(0, 1))
    # Only the second minibatch tells what the first one has done.
    torch.testing.assert_close(state.learning_rate, torch.tensor([3e-5, 6e-3]))


def test_the_kl_schedule_stays_below_ten_times_its_first_rate_and_stops_a_bold_update():
    algorithm, state = make(
        learning_rate_schedule="kl", learning_rate=2e-5, target_kl=0.1, update_epochs=20
    )
    rollout = rollout_of(algorithm, state)
    algorithm.update(state, rollout, rngs(0))
    torch.testing.assert_close(state.learning_rate, torch.tensor([2e-4]))
    algorithm, state = make(
        learning_rate_schedule="kl", learning_rate=1e-2, target_kl=1e-6, update_epochs=20
    )
    algorithm.update(state, rollout, rngs(0))
    assert state.count.item() < 20 * 3  # 4e-6 is reached long before


def test_a_critic_that_learns_alone_leaves_the_policy_and_its_rate_as_they_are():
    algorithm, state = make(
        learning_rate_schedule="kl", learning_rate=1e-4, target_kl=0.01, ent_coef=0.1
    )
    before = algorithm.weights(state)
    rollout = rollout_of(algorithm, state)
    rollout.critic_alone = True
    algorithm.update(state, rollout, rngs(0))
    after = algorithm.weights(state)
    same = {name for name in before if torch.equal(before[name], after[name])}
    assert same == {name for name in before if name.startswith("actor.")}
    torch.testing.assert_close(state.learning_rate, torch.tensor([1e-4]))


@pytest.mark.parametrize("keeps", [False, True])
def test_statistics_of_a_policy_that_was_given_stay(keeps):
    algorithm, state = make(normalize_obs=True)
    mean = state.obs_mean.clone()
    rollout = rollout_of(algorithm, state)
    rollout.keeps_scaling = keeps
    algorithm.update(state, rollout, rngs(0))
    assert torch.equal(state.obs_mean, mean) is keeps
    assert (state.obs_high > state.obs_low).all()


def test_settings_to_learn_on_are_small_steps_unless_they_were_set():
    usual = PPO().learning_on(continuous=True)
    assert (usual.learning_rate, usual.learning_rate_schedule, usual.target_kl) == (
        1e-4,
        "kl",
        0.01,
    )
    assert usual.ent_coef == 0.0
    assert PPO().learning_on(continuous=False).ent_coef == PPO().ent_coef
    assert PPO(target_kl=0.02).learning_on(continuous=True).target_kl == 0.02
    for own in (PPO(learning_rate=3e-4, ent_coef=0.001), PPO(learning_rate=Linear(3e-3, 0))):
        kept = own.learning_on(continuous=False)
        assert kept == own


def test_a_terminal_observation_that_is_not_finite_does_no_harm():
    algorithm, state = make()
    data = rollout_of(algorithm, state)
    ends = data.discount == 0
    assert ends.any()
    data.next_obs[ends] = float("nan")
    algorithm.update(state, data, rngs(0))
    assert torch.isfinite(state.params).all()
