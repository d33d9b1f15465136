"""Compiled gradient steps learn what plain ones learn."""

from __future__ import annotations

import functools
import os
import re
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from typing import Any

import gymnasium as gym
import pytest
import torch
from toys import transitions

from skillweave import DQN, PPO, SAC, TD3, Network, SkillweaveError
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import RNN, SelfImitationPPO, compiled, register_encoder
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.batches import Reference, Rehearsal, Rollout
from skillweave.algorithms.compiled import Compiled
from skillweave.errors import DeclarationError
from skillweave.workers.shipping import packed, unpacked

P, B = 2, 16
OBS = gym.spaces.Box(-1.0, 1.0, (3,))
FORCE, CHOICES = gym.spaces.Box(-1.0, 1.0, (2,)), gym.spaces.Discrete(3)
SMALL = {"network": Network((8,), "relu", layer_norm=True), "normalize_obs": True}
needs_compiler = pytest.mark.skipif(
    not (shutil.which("g++") or shutil.which("clang")), reason="no C++ compiler"
)


@pytest.fixture(autouse=True)
def backend(monkeypatch, request):
    """A C++ compiler takes most of the time: one case of each test goes all the way.

    The others go as far as torch traces the whole step, its backward pass and its changes in place.
    """
    backend = getattr(request, "param", "aot_eager")
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=backend))


def learnt(config, space: gym.Space[Any], data: list[Any]) -> list[tuple[Any, list[Any]]]:
    """The state and the metrics after updates by plain steps, then by compiled ones."""
    found = []
    for compile in (False, True):
        algorithm = make_algorithm(replace(config, compile=compile), OBS, space)
        state, told = algorithm.init([Seeds(m) for m in range(P)]), []
        for u, each in enumerate(data):
            generators = [(Seeds(u) / m).torch() for m in range(P)]
            told.append(algorithm.update(state, each, generators)[1].metrics)
        found.append((state, told))
    return found


def assert_close(state, other, **how: float):
    for f in fields(state):
        one, two = getattr(state, f.name), getattr(other, f.name)
        torch.testing.assert_close(one, two, msg=f.name, **how)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "space", "backend"),
    [
        pytest.param(DQN.rainbow, CHOICES, "inductor", marks=needs_compiler),
        (TD3, FORCE, "aot_eager"),
        (SAC, FORCE, "aot_eager"),
    ],
    ids=["rainbow", "td3", "sac"],
    indirect=["backend"],
)
def test_compiled_steps_equal_plain_ones(kind, space, backend):
    drawn = [transitions(space, (P, B), masked=space is CHOICES, seed=u) for u in range(5)]
    data = [replace(each, progress=0.1) for each in drawn]
    (plain, _), (fused, _) = learnt(kind(**SMALL), space, data)
    assert_close(fused, plain, rtol=1e-4, atol=1e-6)


def rehearsed(width: int, log_std: torch.Tensor | None = None) -> Rehearsal:
    """Observations in which a policy with ``width`` dist_params keeps what it did."""
    g = torch.Generator().manual_seed(7)
    obs, did = (torch.randn(P, 9, n, generator=g) for n in (3, width))
    return Rehearsal(obs, did, log_std)


def small_ppo(**settings) -> tuple[Any, Any]:
    """An algorithm on three actions, and P members."""
    config = PPO(**(SMALL | settings), num_envs=4, n_steps=8, batch_size=16)
    algorithm = make_algorithm(config, OBS, CHOICES)
    return algorithm, algorithm.init([Seeds(m) for m in range(P)])


def near() -> Reference:
    """The policies of fresh members: a learner stays near them."""
    algorithm, state = small_ppo()
    return Reference(algorithm.acting_params(state), torch.ones(P))


def rollout(space: gym.Space[Any], seed: int) -> Rollout:
    """Steps of 8 rows in 4 environments; with gaps, more of them in the second member."""
    g = torch.Generator().manual_seed(seed)
    lead, discrete = (P, 8, 4), isinstance(space, gym.spaces.Discrete)
    last = torch.rand(lead, generator=g) < 0.2
    last[:, -1] = True
    obs, ends = (torch.randn(*lead, 3, generator=g) for _ in range(2))
    mask = torch.ones(*lead, 3, dtype=torch.bool)
    mask[:, ::2, :, 0] = False
    act = torch.randint(1, 3, lead, generator=g) if discrete else torch.randn(*lead, 2, generator=g)
    valid = torch.rand(lead, generator=g) < torch.tensor([0.9, 0.6])[:, None, None]
    return Rollout(
        obs=obs,
        action=act,
        reward=torch.randn(lead, generator=g),
        discount=0.9 * (torch.rand(lead, generator=g) < 0.9),
        next_obs=torch.where(last[..., None], ends, obs.roll(-1, dims=1)),
        last=last,
        dist_params=torch.randn(*lead, 3 if discrete else 2, generator=g),
        log_std=None if discrete else torch.zeros(P, 1, 1, 2),
        mask=mask if discrete else None,
        valid=valid,
        progress=0.1,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "settings", "space", "backend"),
    [
        pytest.param(PPO, {}, CHOICES, "inductor", marks=needs_compiler),
        (PPO, {"learning_rate_schedule": "kl", "target_kl": 0.01}, FORCE, "aot_eager"),
        # After one large step the next would be beyond the limit.
        (PPO, {"target_kl": 1e-4, "learning_rate": 0.1}, CHOICES, "aot_eager"),
        (SelfImitationPPO, {"clip_value": 0.2, "imitation_rows": 64}, FORCE, "aot_eager"),
        (PPO, {"rehearsal": rehearsed(3)}, CHOICES, "aot_eager"),
        (PPO, {"rehearsal": rehearsed(2, torch.zeros(P, 1, 2))}, FORCE, "aot_eager"),
        (PPO, {"reference": near()}, CHOICES, "aot_eager"),
    ],
    ids=["ppo", "kl-rate", "kl-limit", "self-imitation", "rehearsal", "rehearsal-force", "near"],
    indirect=["backend"],
)
def test_compiled_steps_of_rollouts_equal_plain_ones(kind, settings, space, backend):
    more = {k: v for k, v in settings.items() if k in ("rehearsal", "reference")}
    settings = {k: v for k, v in settings.items() if k not in more}
    config = kind(**SMALL, **settings, num_envs=4, n_steps=8, batch_size=16)
    # Each rollout has other numbers of rows.
    data = [replace(rollout(space, u), **more) for u in range(3)]
    (plain, told), (fused, tells) = learnt(config, space, data)
    assert_close(fused, plain, rtol=1e-3, atol=1e-5)
    for own, other in zip(told, tells, strict=True):
        assert own.keys() == other.keys()
        for name in own:
            torch.testing.assert_close(other[name], own[name], rtol=1e-2, atol=1e-4, msg=name)


def learn(algorithm, state, **changed):
    data = replace(rollout(algorithm.action_space, 0), **changed)
    algorithm.update(state, data, [Seeds(m).torch() for m in range(P)])


@pytest.mark.slow
def test_an_algorithm_that_has_compiled_can_be_sent_to_another_process():
    algorithm, state = small_ppo(compile=True)
    learn(algorithm, state)
    again = unpacked(packed(algorithm, "it"))
    other = again.init([Seeds(m) for m in range(P)])
    learn(again, other)
    torch.testing.assert_close(other.params, state.params)


class Branching:
    """An encoder that looks at numbers, which no compiler can."""

    size = 3

    def __init__(self, obs):
        self.shapes = {}

    def init_(self, views, generators):
        """There is nothing to fill."""

    def __call__(self, views, inputs):
        seen = inputs["vector"]
        return seen if bool(seen.sum() > 0.0) else 2.0 * seen


register_encoder("branching", Branching)


def test_auto_compiles_where_a_training_is_long(monkeypatch):
    monkeypatch.setattr(compiled, "PAYS_AFTER", 2)
    tried, seen = Compiled(torch.sin, PPO(compile="auto")), []
    at_once = Compiled(torch.sin, PPO(compile=True))
    for _ in range(3):
        torch.testing.assert_close(tried(torch.ones(3)), torch.ones(3).sin())
        at_once(torch.ones(3))
        seen.append((tried._program is None, at_once._program is None))
    assert seen == [(True, False), (True, False), (False, False)]


@pytest.mark.slow
def test_what_cannot_be_compiled_goes_on_without_where_it_is_tried(monkeypatch):
    monkeypatch.setattr(compiled, "PAYS_AFTER", 0)
    network, says = Network((8,), encoder="branching"), r"PPO\.compile: the gradient step could not"
    algorithm, state = small_ppo(network=network, compile=True)
    with pytest.raises(SkillweaveError, match=f"{says}.*or leave it at False"):
        learn(algorithm, state)
    algorithm, state = small_ppo(network=network, compile="auto")
    with pytest.warns(UserWarning, match="Gradient steps are not compiled"):
        learn(algorithm, state)
    again = unpacked(packed(algorithm, "it"))  # and it is not tried again elsewhere
    assert again._compiled._program is again._compiled._function
    plain, expected = small_ppo(network=network)
    learn(plain, expected)
    torch.testing.assert_close(state.params, expected.params, rtol=0.0, atol=0.0)


def test_a_memory_is_not_compiled_where_it_is_tried():
    assert PPO(compile="auto", network=Network(rnn=RNN())).compile == "auto"
    with pytest.raises(DeclarationError, match=r"compile is True; it must be False where network"):
        PPO(compile=True, network=Network(rnn=RNN()))


def test_a_torch_that_cannot_says_so(monkeypatch):
    from torch._dynamo import config

    class Old:
        pass

    assert hasattr(config, "trace_autograd_ops")
    monkeypatch.setattr("torch._dynamo.config", Old())
    with pytest.raises(DeclarationError, match=r"DQN\.compile.*2\.13"):
        Compiled(lambda: None, DQN(compile=True))
    assert Compiled(lambda: 3, DQN(compile="auto"))() == 3


@pytest.mark.slow
def test_no_compiler_says_so_but_where_it_is_tried(tmp_path):
    code = """
import torch
from skillweave import PPO, SAC, SkillweaveError
from skillweave.algorithms import compiled
from skillweave.algorithms.compiled import Compiled
compiled.PAYS_AFTER = 0
try:
    Compiled(lambda x: x.sin().cos(), SAC(compile=True))(torch.randn(3))
except SkillweaveError as error:
    print(error)
tried, x = Compiled(lambda x: x.sin().cos(), PPO(compile="auto")), torch.ones(3)
print(*(torch.allclose(tried(x), x.sin().cos()) for _ in range(2)))
"""
    nowhere = {"CXX": "/nowhere/g++", "TORCHINDUCTOR_CACHE_DIR": str(tmp_path)}
    said = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | nowhere, capture_output=True, text=True
    )
    first, second = said.stdout.splitlines()
    assert re.match(r"SAC\.compile: .*install a C\+\+ compiler", first), said
    assert second == "True True", said
