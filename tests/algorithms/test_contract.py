"""What holds for every algorithm, over the spaces that it supports."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from toys import (
    SHOWS,
    Allowance,
    Calls,
    Countdown,
    Echo,
    Masked,
    Recall,
    SeedsOfMember,
    Toy,
    learn,
    own_algorithm,
    training,
)

from skillweave._internal.seeding import Seeds
from skillweave.algorithms import config as table
from skillweave.algorithms.agent_policy import AgentHeader, AgentPolicy, make_algorithm
from skillweave.algorithms.config import (
    CQL,
    DQN,
    IQL,
    PPO,
    SAC,
    TD3,
    AlgorithmConfig,
    OffPolicy,
    OnPolicy,
    SelfImitationPPO,
)
from skillweave.algorithms.ppo import PPOAlgorithm
from skillweave.errors import DeclarationError, RunError
from skillweave.experience.collector import Collector
from skillweave.experience.learners import Alone
from skillweave.networks.config import CNN, RNN, Network
from skillweave.runs.files import read_tensors, record_in, write_tensors

# The table: an algorithm's settings, what it sees, how it acts, how long it learns

SMALL = Network((32,), "relu")
BUFFERED = {
    "num_envs": 8, "batch_size": 32, "learning_starts": 64, "buffer_size": 4000,
    "learning_rate": 5e-3, "gamma": 0.5, "tau": 0.05, "network": SMALL,
    "learning_rate_schedule": "constant", "update_ratio": 1.0,
}  # fmt: skip
ON = PPO(
    num_envs=8, n_steps=16, batch_size=32, update_epochs=4, learning_rate=1e-2, gamma=0.5,
    gae_lambda=0.98, ent_coef=0.0, normalize_obs=False, network=Network((32,)),
)  # fmt: skip
OWN = own_algorithm().A2C(
    num_envs=8, n_steps=8, gamma=0.5, learning_rate=2e-2, normalize_obs=False, ent_coef=0.0,
    network=Network((16,)),
)  # fmt: skip
IMITATING = SelfImitationPPO(**vars(ON), imitation_rows=64, imitation_steps=2)
SQUASHED = replace(ON, squash_actions=True)
STATE_STD = replace(ON, action_std="state", learning_rate=5e-3)
LSTM = replace(ON, network=Network((16,), rnn=RNN("lstm", 8)))
# At 1e-2 it learns, and on some processors, which round otherwise, forgets again.
GRU = replace(ON, learning_rate=5e-3, network=Network((16,), rnn=RNN("gru", 8)))
Q = DQN(**BUFFERED)
RAINBOW = DQN.rainbow(**BUFFERED, v_min=-2.0, v_max=0.0, n_atoms=11)
TWIN, DDPG = TD3(**BUFFERED), TD3.ddpg(**BUFFERED)
# Of many features the action is one among hundreds to a critic, and forces run to their bounds.
SEEING = {
    **BUFFERED, "learning_rate": 1e-3, "learning_starts": 200, "exploration_noise": 0.3,
    "network": Network((32,), "relu", cnn=CNN("plain", (4,), (3,), (3,))),
}  # fmt: skip
SEEING_TWIN = TD3(**SEEING | {"learning_rate": 3e-3})
SEEING_DDPG = TD3.ddpg(**SEEING)
SOFT = SAC(**BUFFERED, ent_coef=0.1)
ALONE = {"online": 1.0, "shared_replay": 0.0}  # these algorithms also learn without data
CAUTIOUS = CQL(**BUFFERED, **ALONE, cql_alpha=0.1)
IMPLICIT = IQL(**BUFFERED, **ALONE, beta=10.0, expectile=0.6)


@dataclass(frozen=True)
class Case:
    config: AlgorithmConfig
    shows: str
    asks: str
    budget: int

    def env(self, columns: int | range = 8) -> Echo:
        return Echo(columns, self.shows, self.asks)

    @cache  # noqa: B019
    def learn(self) -> tuple[Any, Any, Echo]:
        """A trained state, made once."""
        env = self.env()
        return *learn(self.config, env, self.budget), env

    def brief(self) -> AlgorithmConfig:
        """Settings for trainings of a few updates."""
        if isinstance(self.config, PPO):
            return replace(self.config, num_envs=4, n_steps=6, batch_size=12, update_epochs=2)
        if isinstance(self.config, OnPolicy):
            return replace(self.config, num_envs=4, n_steps=3)
        return replace(
            self.config, num_envs=4, learning_starts=16, buffer_size=240, batch_size=8,
            update_ratio=0.75, adam_eps=1e-4,  # else gradients of nearly 0 make steps by rounding
        )  # fmt: skip


TABLE = {
    f"{name}, {shows}, {asks}": Case(config, shows, asks, budget)
    for name, config, shows, asks, budget in [
        ("ppo", ON, "vector", "Discrete", 1024),
        ("ppo", ON, "discrete", "MultiDiscrete", 1024),
        ("ppo", ON, "multi-discrete", "MultiBinary", 1024),
        ("ppo", ON, "dict", "Box", 2560),
        ("ppo", ON, "image, channels last", "Discrete", 1024),
        ("ppo", ON, "image, channels first", "MultiDiscrete", 1024),
        ("ppo squashed", SQUASHED, "multi-binary", "Box", 4096),
        ("ppo with state's deviation", STATE_STD, "tuple", "Box", 4096),
        ("ppo with lstm", LSTM, "vector", "Discrete", 2048),
        ("ppo with gru", replace(GRU, ent_coef=0.02), "dict", "MultiBinary", 6144),
        ("self-imitation", IMITATING, "vector", "Discrete", 1024),
        ("self-imitation", IMITATING, "dict", "Box", 2560),
        ("self-imitation", IMITATING, "image, channels last", "MultiDiscrete", 1024),
        ("own", OWN, "vector", "Discrete", 7680),
        ("own", replace(OWN, learning_rate=5e-3), "tuple", "Box", 25_600),
        ("own", OWN, "image, channels last", "Discrete", 7680),
        ("dqn", Q, "vector", "Discrete", 320),
        ("dqn", Q, "multi-discrete", "Discrete", 320),
        ("dqn", Q, "image, channels first", "Discrete", 320),
        ("dqn", Q, "tuple", "Discrete", 320),
        ("rainbow", RAINBOW, "vector", "Discrete", 400),
        ("rainbow", RAINBOW, "discrete", "Discrete", 400),
        ("rainbow", RAINBOW, "multi-binary", "Discrete", 400),
        ("rainbow", RAINBOW, "image, channels last", "Discrete", 400),
        ("rainbow", RAINBOW, "dict", "Discrete", 400),
        ("td3", TWIN, "vector", "Box", 700),
        ("td3", TWIN, "discrete", "Box", 700),
        ("td3", TWIN, "multi-binary", "Box", 700),
        ("td3", SEEING_TWIN, "image, channels last", "Box", 1100),
        ("td3", SEEING_TWIN, "dict", "Box", 1100),
        ("ddpg", DDPG, "multi-discrete", "Box", 700),
        ("ddpg", SEEING_DDPG, "image, channels first", "Box", 1600),
        ("ddpg", DDPG, "tuple", "Box", 700),
        ("sac", SOFT, "vector", "Box", 600),
        ("sac", SOFT, "multi-discrete", "Box", 400),
        ("sac", SOFT, "image, channels last", "Box", 450),
        ("sac", SOFT, "dict", "Box", 450),
        ("sac", SOFT, "discrete", "Discrete", 400),
        ("sac", SOFT, "multi-binary", "Discrete", 400),
        ("sac", SOFT, "image, channels first", "Discrete", 400),
        ("sac", SOFT, "tuple", "Discrete", 400),
        ("cql", CAUTIOUS, "vector", "Discrete", 320),
        ("cql", CAUTIOUS, "tuple", "Discrete", 320),
        ("iql", IMPLICIT, "vector", "Box", 1600),
        ("iql", IMPLICIT, "multi-binary", "Discrete", 800),
        ("iql", IMPLICIT, "dict", "Discrete", 800),
    ]
}
FIRST = {name.split(",")[0]: name for name in reversed(TABLE)}.values()
"""The first case of each algorithm; the others are slow."""
every_case = pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=name, marks=[] if name in FIRST else pytest.mark.slow)
        for name, case in TABLE.items()
    ],
)


@pytest.mark.parametrize("kind", [PPO, DQN, TD3, SAC])
def test_the_table_has_every_observation_for_every_algorithm(kind):
    cases = [case for case in TABLE.values() if isinstance(case.config, kind)]
    assert {case.shows for case in cases} == set(SHOWS)
    acts = {
        PPO: {"Discrete", "MultiDiscrete", "MultiBinary", "Box"},
        DQN: {"Discrete"}, TD3: {"Box"}, SAC: {"Box", "Discrete"},
    }  # fmt: skip
    assert {case.asks for case in cases} == acts[kind]


# Learning, saving


@pytest.mark.fast_cases(2)
@every_case
def test_it_learns_to_answer_what_it_sees(case):
    algorithm, state, env = case.learn()
    policy, shown = AgentPolicy.of(algorithm, state), np.arange(4)
    action, _ = policy.act(policy.start(4), env.show(shown))
    # By chance 0.25 or more: of choices at most half are right, a Box is 0.5 from its middle.
    assert env.error(shown, action).mean() < 0.1


@pytest.mark.fast_cases(3)
@every_case
def test_a_policy_in_a_file_acts_as_it_did(case, tmp_path):
    algorithm, state, env = case.learn()
    policy = AgentPolicy.of(algorithm, state)
    write_tensors(tmp_path / "agent", *policy.to_file())
    tensors, header = read_tensors(tmp_path / "agent")
    loaded = AgentPolicy.from_file(tensors, record_in(AgentHeader, header, "agent"), "agent")
    assert loaded.observation_space == policy.observation_space
    assert loaded.action_space == policy.action_space
    obs = env.show(np.arange(8) % 4)
    for greedy in (True, False):
        memories = [p.start(8) for p in (policy, loaded)]
        rngs = [np.random.default_rng(3) for _ in range(2)]
        for _ in range(3):
            (mine, memories[0]), (theirs, memories[1]) = (
                p.act(memory, obs, deterministic=greedy, rng=rng)
                for p, memory, rng in zip((policy, loaded), memories, rngs, strict=True)
            )
            assert np.array_equal(mine, theirs)
            assert mine.dtype == env.action_space.dtype
            assert all(env.action_space.contains(a) for a in mine)
            if not algorithm.memory_size:
                assert memories == [{}, {}]


# Seeds and stacks


@pytest.mark.fast_cases(4)
@every_case
def test_the_same_seed_gives_the_same_weights_bit_for_bit_and_another_does_not(case):
    config = case.brief()
    first, again, other = (learn(config, case.env(4), 48, seed)[1] for seed in (1, 1, 2))
    for f in fields(first):
        assert torch.equal(getattr(first, f.name), getattr(again, f.name)), f.name
    assert not torch.equal(first.params, other.params)


@pytest.mark.fast_cases(4)
@every_case
def test_a_stack_of_three_learns_what_three_single_members_learn(case):
    config, budget = case.brief(), 72
    stack = learn(config, case.env(range(12)), 3 * budget, 5, range(3))[1]
    for m in range(3):
        env, seeds = case.env(range(4 * m, 4 * m + 4)), SeedsOfMember(Seeds(5), m)
        single = learn(config, env, budget, seeds, [m])[1]
        assert single.count.item() > 5
        for f in fields(single):
            whole, one = getattr(stack, f.name)[m], getattr(single, f.name)[0]
            torch.testing.assert_close(
                whole, one, rtol=1e-4, atol=1e-5, msg=lambda x, f=f: f"{f.name}: {x}"
            )
    assert (stack.params[0] - stack.params[1]).abs().max() > 1e-2


@pytest.mark.parametrize("kind", [DQN, SAC, TD3])
def test_members_that_share_what_they_did_still_differ(kind):
    env = Echo(12, "vector", "Box" if kind is TD3 else "Discrete")
    _, state = learn(kind(**BUFFERED | {"num_envs": 4}), env, 120, members=range(3), shared=True)
    assert state.params.isfinite().all()
    assert (state.params[0] - state.params[1]).abs().max() > 1e-2


SCALED = {"normalize_obs": True, "normalize_rewards": True}


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("config", [replace(ON, normalize_obs=True), *(
    kind(**BUFFERED, **SCALED) for kind in (DQN, TD3, SAC)
), *(
    kind(**BUFFERED, **SCALED, **ALONE) for kind in (CQL, IQL)
)], ids=lambda c: type(c).__name__)  # fmt: skip
def test_what_is_learnt_keeps_shape_and_type_and_can_be_changed_in_place(config):
    env = Echo(8, "vector", "Box" if isinstance(config, TD3) else "Discrete")
    algorithm, state = learn(config, env, 256)
    fresh = algorithm.init([Seeds(0)])
    for f in fields(fresh):
        before, after = getattr(fresh, f.name), getattr(state, f.name)
        assert (after.shape, after.dtype) == (before.shape, before.dtype), f.name
        after.mul_(1)


# Ends, calls and masks: values by hand, γ = 0.8


GAMMA = 0.8
EXACT = {
    **BUFFERED, "gamma": GAMMA, "tau": 0.1, "learning_rate": 1e-2, "batch_size": 64,
    "network": Network((16,)),
}  # fmt: skip
COLD = {"ent_coef": 1e-4, "learn_ent_coef": False}
VALUED = {
    "ppo": replace(ON, gamma=GAMMA),
    "self-imitation": replace(IMITATING, gamma=GAMMA),
    "own": replace(OWN, gamma=GAMMA),
    "ppo with lstm": replace(LSTM, gamma=GAMMA),
    "dqn": DQN(**EXACT),
    "dqn of three steps": DQN(**EXACT, n_step=3),
    "rainbow": DQN.rainbow(**EXACT, v_min=0.0, v_max=6.0, n_atoms=25),
    "td3": TD3(**EXACT),
    "ddpg": TD3.ddpg(**EXACT),
    "sac of choices": SAC(**EXACT, **COLD),
    "sac of forces": SAC(**EXACT, **COLD),
    "cql": CQL(**EXACT, **ALONE, cql_alpha=1e-3),
    "iql of choices": IQL(**EXACT, **ALONE),
    "iql of forces": IQL(**EXACT, **ALONE),
}
CHOOSERS = [
    name for name in VALUED if name not in ("td3", "ddpg", "sac of forces", "iql of forces")
]


def acted_in(env, name: str):
    """The toy, with forces as actions where the algorithm needs them."""
    if name not in CHOOSERS:
        env.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    return env


def trained(env, name: str, each: int = 1, scale: float = 1.0) -> tuple[Any, Any]:
    """Trained for a number of calls of so many steps."""
    config = VALUED[name]
    calls = {PPO: 4096, SelfImitationPPO: 4096, type(OWN): 16_384}.get(type(config), 900)
    return learn(config, env, int(calls * each * scale))


def values(algorithm, state, obs) -> list[float]:
    """What the policy expects in observations (n, ...)."""
    return algorithm.value(state, torch.as_tensor(np.asarray(obs))[None])[0].tolist()


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", [name for name in VALUED if name != "ddpg"])
def test_a_time_limit_is_bootstrapped(name):
    algorithm, state = trained(acted_in(Allowance(8), name), name)
    # Taken for an end, the limit of 5 steps would leave 1 / (1 − 0.8 · 4/5) = 2.8 on average.
    assert values(algorithm, state, np.zeros((1, 1), np.float32)) == pytest.approx([5.0], rel=0.06)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", [name for name in VALUED if name != "ppo with lstm"])
def test_an_end_is_not_bootstrapped(name):
    algorithm, state = trained(acted_in(Countdown(8), name), name)
    finite = [sum(GAMMA**i for i in range(5 - t)) for t in range(5)]  # 3.4 down to 1, else 5
    assert values(algorithm, state, np.arange(5)) == pytest.approx(finite, rel=0.06)


class TenSteps(Collector):
    """Says of every row that it took ten steps."""

    def _views(self, trace, steps):
        batches = super()._views(trace, steps)
        batches[""]["steps"][:] = 10
        return batches


class LongCalls(Toy):
    """Whatever is done lasts 10 steps and pays 3."""

    def collector(self, acting, shared=False):
        return TenSteps(self, acting, Alone())

    def play(self, action):
        still = np.zeros((self.num_envs, 1), np.float32)
        return still, 3 * self.ones, self.never, self.never


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", [name for name in VALUED if name != "ppo with lstm"])
def test_the_value_of_calls_discounts_by_their_length(name):
    algorithm, state = trained(acted_in(LongCalls(8), name), name)
    expected, wrong = 3 / (1 - GAMMA**10), 3 / (1 - GAMMA)
    found = values(algorithm, state, np.zeros((1, 1), np.float32))
    assert found == pytest.approx([expected], rel=0.06)
    assert found != pytest.approx([wrong], rel=0.5)


SHORT, LONG = 1 / (1 - GAMMA), 3 + GAMMA**10 / (1 - GAMMA)  # 5.0 and 3.54


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", [name for name in CHOOSERS if name != "ppo with lstm"])
def test_a_short_call_is_preferred_over_a_long_one_that_pays_more_but_less_a_step(name):
    algorithm, state = trained(
        Calls(8), name, scale={"sac of choices": 4.0, "rainbow": 2.0}.get(name, 1.5)
    )
    still = np.zeros((1, 1), np.float32)
    policy = AgentPolicy.of(algorithm, state)
    assert policy.act(policy.start(1), still)[0].tolist() == [0]
    assert values(algorithm, state, still) == pytest.approx([SHORT], rel=0.06)
    # Without γ^τ the long call would be worth 3 / (1 − 0.8) = 15, and be chosen.
    rows = torch.zeros(1, 1, 1)
    if name in ("dqn", "dqn of three steps", "sac of choices"):
        actor = algorithm.acting_params(state)
        if name == "sac of choices":
            inputs = algorithm.inputs(actor, rows)
            q = algorithm.critics(algorithm.critics.views(state.critic), inputs).mean(1)
        else:
            q = algorithm.act(actor, rows, None, None)[1]
        assert q.flatten().tolist()[0] == pytest.approx(SHORT, rel=0.06)
        if name != "dqn of three steps":  # off-policy beyond the first step
            assert q.flatten().tolist()[1] == pytest.approx(LONG, rel=0.06)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", CHOOSERS)
def test_a_forbidden_action_is_never_taken(name):
    env, config = Masked(8), VALUED[name]
    if isinstance(config, DQN) and not config.noisy:
        config = replace(config, exploration_final_eps=0.5)
    algorithm, state = learn(config, env, 3072 if isinstance(config, OnPolicy) else 400)
    assert env.taken_though_forbidden == 0
    policy, obs = AgentPolicy.of(algorithm, state), np.arange(300) % 3
    mask = np.arange(3)[None] != obs[:, None]
    best, _ = policy.act(policy.start(300), obs, mask)
    assert best.tolist() == [2, 2, 1] * 100
    for seed in range(20):
        rng = np.random.default_rng(seed)
        some, _ = policy.act(policy.start(300), obs, mask, deterministic=False, rng=rng)
        assert (some != obs).all()


@pytest.mark.parametrize("name", [name for name in CHOOSERS if isinstance(VALUED[name], OffPolicy)])
def test_a_forbidden_action_is_never_drawn_at_random_before_learning(name):
    env = Masked(8)
    algorithm, _ = learn(replace(VALUED[name], learning_starts=4000), env, 2000)
    assert env.taken_though_forbidden == 0
    rngs, mask = [Seeds(0).torch()], torch.tensor([True, False, True]).expand(1, 3000, 3)
    drawn = algorithm.random_actions(rngs, 3000, mask)[0].bincount(minlength=3) / 3000
    assert drawn.tolist() == pytest.approx([0.5, 0.0, 0.5], abs=0.03)


class Endless(Masked):
    """Its episodes never end."""

    def play(self, action):
        next_obs, reward, *_ = super().play(action)
        return next_obs, reward, self.never, self.never


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dqn", "dqn of three steps", "sac of choices"])
def test_a_forbidden_action_is_never_chosen_in_targets(name):
    # A line for each observation: what is never done keeps the value that it is given here.
    config = replace(VALUED[name], network=Network(()), gamma=0.5)
    env = Endless(8)
    algorithm = make_algorithm(config, env.observation_space, env.action_space)
    state = algorithm.init([Seeds(0)])
    tempting = 20.0 * torch.eye(3)
    if "dqn" in name:
        for flat in (state.params, state.target):
            algorithm.layout.views(flat)["q.0.weight"][0] = tempting
    else:
        algorithm.layout.views(state.params)["actor.0.weight"][0] = tempting
        for flat in (state.critic, state.critic_target):
            algorithm.critics.views(flat)["critic.0.weight"][:] = tempting
    _, state = learn(config, env, 1200, state=state)
    inputs = algorithm.inputs(algorithm.acting_params(state), torch.arange(3)[None])
    if "dqn" in name:
        q = algorithm.net(algorithm.layout.views(state.params), inputs)[0, ..., 0]
    else:
        q = algorithm.critics(algorithm.critics.views(state.critic), inputs).mean(1)[0]
    # Paid is the action; afterwards the best allowed pays 2, 2 or 1, at γ = 0.5 worth 5/3.
    allowed = ~torch.eye(3, dtype=torch.bool)
    if name == "dqn of three steps":  # what it does in between is not yet the best
        assert q[allowed].max() < 2 + 5 / 3 + 0.2
    else:
        wanted = torch.arange(3.0).expand(3, 3)[allowed] + 5 / 3
        torch.testing.assert_close(q[allowed], wanted, rtol=0, atol=0.15)
    assert q.diagonal().min() > 10


# Memory


MEMORIES = {"lstm": replace(LSTM, overlap=False), "gru": replace(GRU, overlap=False)}


class Watched(PPOAlgorithm):
    """Keeps every rollout, with the state that it met."""

    def update(self, state, batch, rng):
        self.seen = getattr(self, "seen", [])
        self.seen.append((batch, state.params.clone()))
        return super().update(state, batch, rng)


def watched(config: PPO, updates: int = 3) -> Watched:
    env = Echo(8, "vector", "Discrete")  # its episodes last 3 or 4 steps, a rollout 16
    algorithm = Watched(config, env.observation_space, env.action_space)
    training(algorithm, env).run(updates * 128)
    return algorithm


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", MEMORIES)
def test_learning_begins_at_the_very_probabilities_that_acting_had(kind):
    algorithm = watched(MEMORIES[kind])
    assert len(algorithm.seen) == 3
    for i, (rollout, params) in enumerate(algorithm.seen):
        views, tr, cut = algorithm.layout.views(params), rollout, algorithm.memory_size // 2
        assert rollout.episode_start[:, 1:].any()
        assert bool(rollout.recurrent_state.any()) == (
            i > 0
        )  # what went on from the rollout before
        memory = rollout.recurrent_state[..., :cut]
        inputs = {"vector": tr.obs}
        head, _ = algorithm.actor_net.sequence(views, inputs, memory, rollout.episode_start)
        torch.testing.assert_close(head, rollout.dist_params, rtol=1e-4, atol=1e-6)
        old, _ = algorithm.head.stats(rollout.dist_params, None, None, tr.action)
        new, _ = algorithm.head.stats(head, None, None, tr.action)
        torch.testing.assert_close(new, old, rtol=1e-4, atol=1e-5)
        # A version that forgets where episodes began would not agree:
        never = torch.zeros_like(rollout.episode_start)
        other, _ = algorithm.actor_net.sequence(views, inputs, memory, never)
        assert (other - rollout.dist_params).abs().max() > 1e-4


def test_the_value_after_an_end_remembers_what_led_to_it():
    algorithm = watched(MEMORIES["lstm"], updates=2)
    tr, views = algorithm.seen[1][0], algorithm.layout.views(algorithm.seen[1][1])
    state, cut, net = (
        algorithm.init([Seeds(0)]),
        algorithm.actor_net.memory_size,
        algorithm.critic_net,
    )
    state.params = algorithm.seen[1][1]
    with torch.no_grad():
        own = tr.recurrent_state[..., cut:]
        out, after = net.sequence(views, {"vector": tr.obs}, own, tr.episode_start)
        params = algorithm.learning_params(state)
        value = out[..., 0]
        following = algorithm.next_values(state, params, tr, value, after.flatten(1, 2))
        memory = own
        for t in range(16):
            memory = memory.masked_fill(tr.episode_start[:, t, :, None], 0.0)
            now, memory = net.step(views, {"vector": tr.obs[:, t]}, memory)
            later, _ = net.step(views, {"vector": tr.next_obs[:, t]}, memory)
            torch.testing.assert_close(value[:, t], now[..., 0], rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(following[:, t], later[..., 0], rtol=1e-4, atol=1e-5)
    assert tr.last.sum() > 8


@pytest.mark.slow
def test_a_policy_remembers_until_it_starts_anew():
    algorithm, state, env = TABLE["ppo with lstm, vector, Discrete"].learn()
    policy, obs = AgentPolicy.of(algorithm, state), env.show(np.array([1, 1, 2]))
    fresh = policy.start(3)
    assert fresh["rnn"].shape == (3, algorithm.memory_size) == (3, 32)
    assert not fresh["rnn"].any()
    _, after = policy.act(fresh, obs)
    assert not fresh["rnn"].any()
    assert np.array_equal(after["rnn"][0], after["rnn"][1])
    assert not np.array_equal(after["rnn"][0], after["rnn"][2])
    _, later = policy.act(after, obs)
    assert not np.array_equal(later["rnn"], after["rnn"])
    # Rows are environments': one that starts anew forgets, its neighbours do not.
    after["rnn"][1] = policy.start(1)["rnn"]
    _, mixed = policy.act(after, obs)
    assert np.allclose(mixed["rnn"][[0, 2]], later["rnn"][[0, 2]], atol=1e-6)
    assert np.allclose(mixed["rnn"][1], policy.act(policy.start(3), obs)[1]["rnn"][1], atol=1e-6)


def remembered(config: PPO, budget: int) -> float:
    """How often a trained policy names the sign that it saw three steps before."""
    algorithm, state = learn(config, Recall(16), budget)
    policy, sign = AgentPolicy.of(algorithm, state), np.arange(64) % 2
    memory = policy.start(64)
    for t in range(4):
        shown = np.stack([(2.0 * sign - 1.0) * (t == 0), np.full(64, t == 3)], 1)
        action, memory = policy.act(memory, shown.astype(np.float32))
    return float((action == sign).mean())


RECALLING = {"num_envs": 16, "n_steps": 16, "batch_size": 64, "gamma": 0.9, "overlap": True}


@pytest.mark.slow
@pytest.mark.parametrize("kind", MEMORIES)
def test_what_was_seen_three_steps_before_is_remembered(kind):
    assert remembered(replace(MEMORIES[kind], **RECALLING), 10_240) == 1.0


def test_without_a_memory_it_is_a_guess():
    assert remembered(replace(ON, **RECALLING), 5_120) == 0.5


# What cannot be


KINDS = (PPO, SelfImitationPPO, DQN, CQL, TD3, SAC, IQL)
ABLE = [
    (gym.spaces.Discrete(2), (PPO, SelfImitationPPO, DQN, CQL, SAC, IQL)),
    (gym.spaces.Box(-1.0, 1.0, (2,)), (PPO, SelfImitationPPO, TD3, SAC, IQL)),
    (gym.spaces.MultiDiscrete([2, 2]), (PPO, SelfImitationPPO)),
    (gym.spaces.MultiBinary(3), (PPO, SelfImitationPPO)),
    (gym.spaces.Dict(arm=gym.spaces.Box(-1, 1, (2,)), grip=gym.spaces.Discrete(2)), KINDS[:2]),
    (gym.spaces.Text(3), ()),
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("space", "able"), ABLE, ids=str)
def test_an_algorithm_that_cannot_act_names_those_that_can(kind, space, able, monkeypatch):
    own = {k: table._REGISTERED[k] for k in table.BUILT_IN}  # without the example
    monkeypatch.setattr(table, "_REGISTERED", own)
    obs = gym.spaces.Discrete(2)
    if kind in able:
        make_algorithm(kind(), obs, space)
        return
    names = [k.__name__ for k in KINDS if k in able]
    says = f"{', '.join(names)} can" if names else "no algorithm here can"
    with pytest.raises(DeclarationError) as error:
        make_algorithm(kind(), obs, space)
    assert str(error.value) == f"{kind.__name__} cannot act in {space}; {says}"


def test_a_policy_in_a_file_without_its_weights_says_which(tmp_path):
    algorithm = make_algorithm(DQN(network=SMALL), SHOWS["vector"], gym.spaces.Discrete(3))
    policy = AgentPolicy.of(algorithm, algorithm.init([Seeds(0)]))
    tensors, header = policy.to_file()
    tensors = {k: v for k, v in tensors.items() if k != "q.1.bias"}
    with pytest.raises(RunError, match=r"agent: tensor q\.1\.bias should be \(1, 3\)"):
        AgentPolicy.from_file(tensors, header, "agent")
