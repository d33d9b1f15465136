"""Learning and acting on another device: a fake THERE device, on which nothing is computed.

It refuses operations that mix devices, and every question for a value: those make a host wait.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode
from torch.utils._pytree import tree_map

from skillweave import DQN, PPO, SAC, TD3, Network
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import SelfImitationPPO, rollouts
from skillweave.algorithms.base import state_to
from skillweave.algorithms.batches import Reference, Rollout, Sample
from skillweave.algorithms.registry import make_algorithm
from skillweave.errors import DeclarationError
from skillweave.networks.config import CNN, RNN
from skillweave.ops.device import Constant, all_false, on_host, resolve_device
from skillweave.training.learner import RolloutLearner, Stack, keep_to_guide

P, T, B = 2, 4, 3
SMALL = {"network": Network((8,)), "normalize_obs": True}
SEEN = Box(-1.0, 1.0, (2,), np.float32)
MIXED = Dict(vector=SEEN, image=Box(0, 255, (8, 8, 1), np.uint8))
LINE, CHOICE, FORCE = Discrete(3), MultiDiscrete([2, 3]), Box(-1.0, 1.0, (2,), np.float32)
THERE = torch.device("meta")

ON = {
    "discrete": (PPO(**SMALL), SEEN, LINE),
    "several": (PPO(**SMALL), SEEN, CHOICE),
    "continuous": (PPO(**SMALL, clip_value=0.2), SEEN, FORCE),
    "by kl": (PPO(**SMALL, learning_rate_schedule="kl", target_kl=0.01), SEEN, LINE),
    "early stop": (PPO(**SMALL, target_kl=0.01), SEEN, LINE),
    "self-imitation": (SelfImitationPPO(**SMALL, imitation_rows=8), SEEN, CHOICE),
    "gru": (PPO(network=Network((8,), rnn=RNN("gru", 4))), SEEN, LINE),
    "images": (PPO(network=Network((8,), cnn=CNN("plain", (4,), (3,), (3,)))), MIXED, LINE),
}
OFF = {
    "dqn": (DQN(**SMALL), LINE),
    "rainbow": (DQN.rainbow(**SMALL), LINE),
    "td3": (TD3(**SMALL, policy_delay=1), FORCE),
    "sac": (SAC(**SMALL, normalize_rewards=True), FORCE),
    "sac, discrete": (SAC(**SMALL), LINE),
    "sac, n steps": (SAC(**SMALL, n_step=3), FORCE),
}


def moved(x, mode: FakeTensorMode, device: torch.device = THERE):
    """Tensors within ``x`` as fake ones on a device."""

    def move(v):
        return mode.from_tensor(v).to(device) if isinstance(v, torch.Tensor) else v

    if hasattr(x, "__dataclass_fields__"):
        return replace(x, **{k: move(getattr(x, k)) for k in x.__dataclass_fields__})
    return tree_map(move, x)


def devices(x) -> set[str]:
    return {v.device.type for v in vars(x).values() if isinstance(v, torch.Tensor)}


def rows(algorithm, lead: tuple[int, ...]) -> torch.Tensor:
    return torch.zeros(
        *lead,
        *algorithm.obs.item,
        dtype=torch.uint8 if len(algorithm.obs.images) else torch.float32,
    )


def actions(algorithm, lead: tuple[int, ...]) -> torch.Tensor:
    space = algorithm.action_space
    return torch.zeros(*lead, *space.shape, dtype=torch.int64 if algorithm.codec.discrete else None)


def rollout(algorithm, **more) -> Rollout:
    lead, width = (P, T, B), algorithm.head.width
    return Rollout(
        rows(algorithm, lead), actions(algorithm, lead), torch.zeros(lead), torch.zeros(lead),
        rows(algorithm, lead), torch.zeros(lead, dtype=torch.bool),
        dist_params=torch.zeros(*lead, width), **more,
    )  # fmt: skip


def on_device(algorithm, mode: FakeTensorMode):
    """Fresh members whose numbers, but for those that Python decides by, are on the device."""
    state = algorithm.init([Seeds(m) for m in range(P)])
    fake = {k: v if k in state.HOST else mode.from_tensor(v) for k, v in vars(state).items()}
    state = state_to(type(state)(**fake), THERE)
    assert devices(state) == {"meta", "cpu"} if state.HOST else {"meta"}
    return state


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", ON)
def test_ppo_learns_and_acts_where_its_state_is(name, monkeypatch):
    config, seen, space = ON[name]
    algorithm = make_algorithm(replace(config, batch_size=6, update_epochs=2), seen, space)
    # Only here may a host wait; the number of ends of a rollout, say.
    monkeypatch.setattr(rollouts, "on_host", lambda *counts: [3 for _ in counts])
    lead, width, numbers = (P, T, B), algorithm.head.width, not algorithm.codec.discrete
    memory = torch.zeros(P, B, algorithm.memory_size) if algorithm.memory_size else None
    no = torch.zeros(lead, dtype=torch.bool)
    batch = rollout(
        algorithm, mask=None if numbers else torch.ones(*lead, width, dtype=torch.bool),
        log_std=torch.zeros(P, 1, 1, width) if numbers else None,
        recurrent_state=memory, episode_start=None if memory is None else no, overridden=no,
    )  # fmt: skip
    rng = [Seeds(m).torch() for m in range(P)]
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        state, batch = on_device(algorithm, mode), moved(batch, mode)
        near = algorithm.acting_params(state, device=THERE)
        batch.reference = Reference(near, mode.from_tensor(torch.ones(P)).to(THERE))
        assert algorithm.value(state, batch.obs[:, 0]).device == THERE
        state, report = algorithm.update(state, batch, rng)
        assert devices(state) == {"meta"}
        assert {v.device.type for v in report.metrics.values()} == {"meta"}
        assert_acts(algorithm, state, mode, batch.obs[:, 0], memory)


def test_a_selector_near_its_guide_learns_where_its_state_is_and_is_kept_on_the_cpu(monkeypatch):
    config, seen, space = ON["discrete"]
    algorithm = make_algorithm(replace(config, batch_size=6, update_epochs=2), seen, space)
    monkeypatch.setattr(rollouts, "on_host", lambda *counts: [3 for _ in counts])
    batch = rollout(algorithm, guide=torch.zeros(P, T, B, algorithm.head.width))
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        learner = RolloutLearner(Stack(algorithm, on_device(algorithm, mode)), Seeds(0))
        keep_to_guide(learner, 0.1)
        assert learner.reference is not None
        batch = moved(batch, mode)
        batch.reference = learner.reference
        monkeypatch.setattr(learner._store, "rollout", lambda *about: batch)
        learner.learn(0, 0, 0.0)
        learner._requested = algorithm.acting_params(learner.stacks[0].state, 0.0), 0.0
        assert learner.reference.coef.device == THERE
        assert learner.kept()["reference_coef"].device.type == "cpu"


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("name", OFF)
def test_algorithms_of_replay_learn_and_act_where_their_state_is(name):
    config, space = OFF[name]
    algorithm = make_algorithm(config, SEEN, space)
    lead, n = (P, B), config.n_step if isinstance(config, SAC) else 1
    free = torch.ones(P, B, 3, dtype=torch.bool) if space is LINE else None
    batch = Sample(
        rows(algorithm, lead), actions(algorithm, lead), torch.zeros(lead), torch.zeros(lead),
        rows(algorithm, lead), free, free, torch.ones(lead), np.zeros(lead, np.int64),
        between_obs=rows(algorithm, (P, B, n - 1)) if n > 1 else None,
        between_discount=torch.zeros(P, B, n - 1) if n > 1 else None,
    )  # fmt: skip
    rng = [Seeds(m).torch() for m in range(P)]
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        state, batch = on_device(algorithm, mode), moved(batch, mode)
        assert algorithm.value(state, batch.obs, batch.mask).device == THERE
        noise = [x.to(THERE) for x in algorithm.learning_noise(rng, B, True)]
        metrics, error = algorithm.learn(state, batch, algorithm.rate(state, 0.1), noise, True)
        assert {k for k, v in vars(state).items() if v.device.type == "cpu"} == {"updates"}
        assert {v.device.type for v in (*metrics.values(), error)} == {"meta"}
        assert_acts(algorithm, state, mode, batch.obs, None)


def assert_acts(algorithm, state, mode, obs, memory):
    """It acts on the device of what it is given; unless told otherwise that is the CPU."""
    noise = algorithm.noise([Seeds(m).torch() for m in range(P)], 1, B)[0]
    for device in (torch.device("cpu"), THERE):
        where = {} if device.type == "cpu" else {"device": device}
        params = algorithm.acting_params(state, 0.5, **where)
        given = tree_map(lambda x, d=device: None if x is None else x.to(d), noise)
        before = None if memory is None else moved(memory, mode, device)
        for chance in (given, None):
            found = algorithm.act(params, obs.to(device), None, chance, before)
            assert {x.device for x in found if x is not None} == {device}


def test_what_an_update_draws_is_moved_to_the_batch():
    algorithm = make_algorithm(SAC(**SMALL), SEEN, FORCE)
    state, seen = algorithm.init([Seeds(0)]), []
    algorithm.learn = lambda state, batch, rate, noise, due: seen.extend(noise) or ({}, None)
    zeros = torch.zeros(1, B, device="meta")
    batch = Sample(zeros, zeros, zeros, zeros, zeros, None, None, None, np.zeros((1, B), int))
    algorithm.update(state_to(state, "meta"), batch, [Seeds(0).torch()])
    assert [x.device.type for x in seen] == ["meta", "meta"]


def test_a_question_for_a_value_would_be_noticed():
    with FakeTensorMode(), pytest.raises(DataDependentOutputException):
        bool(torch.ones(2, device="meta").any())


# Names and helpers


def test_a_device_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert resolve_device("cpu") == resolve_device("auto") == torch.device("cpu")
    with pytest.raises(DeclarationError, match=r"'cuda'.* finds no CUDA device here; use 'cpu'"):
        resolve_device("cuda")
    with pytest.raises(DeclarationError, match="'tpu'; it must be one of cpu, cuda, auto"):
        resolve_device("tpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert resolve_device("cuda") == resolve_device("auto") == torch.device("cuda")
    assert resolve_device("cpu") == torch.device("cpu")


def test_a_constant_has_one_copy_on_each_device_and_the_cpu_alone_knows_whether_nothing_is_left():
    constant = Constant(torch.tensor([1.0, 2.0]))
    assert constant.on(torch.device("cpu")).tolist() == [1.0, 2.0]
    copy = constant.on(THERE)
    assert copy.device.type == "meta"
    assert constant.on(THERE) is copy
    nothing = torch.zeros(2, dtype=torch.bool)
    assert all_false(nothing)
    assert not all_false(torch.tensor([False, True]))
    assert not all_false(nothing.to("meta"))
    assert on_host(torch.tensor(3), torch.tensor(5)) == [3, 5]


def test_weights_are_read_to_the_cpu_and_a_state_moves_but_for_what_python_decides_by():
    algorithm = make_algorithm(TD3(**SMALL), SEEN, FORCE)
    state = algorithm.init([Seeds(0)])
    gone = state_to(state, "meta")
    assert gone.updates is state.updates
    assert {v.device.type for k, v in vars(gone).items() if k != "updates"} == {"meta"}
    assert state_to(state, "cpu").params is state.params  # no copy where there is no need
    weights = algorithm.weights(state)
    state.params.add_(1.0)
    named = algorithm.layout.views(state.params)
    assert all(torch.equal(named[k][0], v + 1.0) for k, v in weights.items() if k in named)
