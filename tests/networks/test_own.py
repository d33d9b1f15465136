"""Encoders that are modules of the user: what they compute, learn, save, and what is refused."""

from __future__ import annotations

import functools
import pickle
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Tuple
from small_runs import ON, Left, assert_same, stopped_again, stopped_run
from torch import nn
from toys import Echo, drawn, learn

import skillweave as sw
from skillweave import DQN, PPO, SAC, TD3, Hierarchy, Network, SkillweaveError
from skillweave._internal import named as naming
from skillweave._internal.named import Named, named
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import RNN
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm
from skillweave.algorithms.config import config_from_json, config_to_json
from skillweave.errors import DeclarationError, RunError
from skillweave.evolution import Evolution, Mutations
from skillweave.networks.encoders import make_encoder
from skillweave.networks.own import ModuleEncoder
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import read_manifest
from skillweave.spaces import obs_codec, to_tensor
from skillweave.spaces.packing import pack
from skillweave.workers.shipping import packed, unpacked

P, B = 3, 5


class Features(nn.Module):
    """Two layers and a gain, for observations of any shape."""

    def __init__(self, space: gym.Space[Any], width: int = 16) -> None:
        super().__init__()
        numbers = int(np.prod(space.shape))
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(numbers, width), nn.Tanh())
        self.gain = nn.Parameter(torch.tensor(1.0))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self.layers(obs) * self.gain


class Camera(nn.Module):
    """A convolution."""

    def __init__(self, space: gym.Space[Any]) -> None:
        super().__init__()
        assert space.dtype == np.float32
        self.conv = nn.Conv2d(space.shape[0], 4, 3, stride=2)
        self.flat = nn.Sequential(nn.ReLU(), nn.Flatten())

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        assert obs.dtype == torch.float32
        return self.flat(self.conv(obs))


class Parts(nn.Module):
    """Reads a dict with an image and a tuple in it."""

    def __init__(self, space: gym.Space[Any]) -> None:
        super().__init__()
        self.camera = Camera(space["camera"])
        self.body = nn.Linear(space["body"][0].shape[0], 3)
        self.tied = self.body
        self.leg = space["body"][1].shape

    def forward(self, obs: Any) -> torch.Tensor:
        body, matrix = obs["body"]
        assert matrix.shape[1:] == self.leg == (2, 2)
        return torch.cat([self.camera(obs["camera"]), self.tied(body), matrix.flatten(1)], 1)


PARTS = Dict(
    [
        ("camera", Box(0, 255, (9, 8, 3), np.uint8)),
        ("body", Tuple([MultiDiscrete([2, 3]), Box(-1.0, 1.0, (2, 2))])),
    ]
)


def encoder_of(factory: Any, space: gym.Space[Any]) -> ModuleEncoder:
    found = make_encoder(named(factory, "Network.encoder"), obs_codec(space))
    assert isinstance(found, ModuleEncoder)
    return found


def inputs_of(space: gym.Space[Any], members: int = P) -> dict[str, torch.Tensor]:
    obs, space_ = obs_codec(space), space
    space_.seed(0)
    batch = gym.vector.utils.batch_space(space_, members * B)
    batch.seed(0)
    rows = to_tensor(pack(space_, batch.sample()))
    vector, images = obs.split(rows.unflatten(0, (members, B)))
    return {"vector": vector} | {f"image.{i}": x for i, x in enumerate(images)}


def given(space: gym.Space[Any], inputs: dict[str, torch.Tensor], m: int) -> Any:
    """What forward is to get of a member, written down by hand."""
    if isinstance(space, Dict):
        vector = inputs["vector"][m]
        body = vector[:, :5], vector[:, 5:9].reshape(B, 2, 2)
        return {"camera": inputs["image.0"][m].float() / 255.0, "body": body}
    if space.shape == (9, 8, 3):
        return inputs["image.0"][m].float() / 255.0
    return inputs["vector"][m].reshape(B, *(space.shape or (3,)))


@pytest.mark.parametrize("members", [1, P])
@pytest.mark.parametrize(
    ("factory", "space"),
    [
        (Features, Box(-1.0, 1.0, (4,))),
        (Features, Box(-1.0, 1.0, (2, 3))),
        (Features, Discrete(3)),
        (Camera, Box(0, 255, (9, 8, 3), np.uint8)),
        (Parts, PARTS),
    ],
    ids=["vector", "matrix", "choices", "image", "parts"],
)
def test_each_member_computes_what_the_module_does_and_has_its_gradient(factory, space, members):
    encoder = encoder_of(factory, space)
    layout, flat = drawn(encoder, members)
    inputs, leaves = inputs_of(space, members), layout.leaves(flat)
    found = encoder(leaves, inputs)
    assert found.shape == (members, B, encoder.size)
    gradient = layout.gradient(found.square().sum((1, 2)), leaves)
    for m in range(members):
        module = factory(encoder.space)
        values = {k: v[m] for k, v in layout.views(flat).items()}
        shapes = {k: p.shape for k, p in module.named_parameters()}
        assert list(shapes) == list(values)
        module.load_state_dict({k: values[k].view(s) for k, s in shapes.items()}, strict=False)
        want = module(given(space, inputs, m))
        torch.testing.assert_close(found[m], want)
        want.square().sum().backward()
        theirs = torch.cat([p.grad.flatten() for p in module.parameters()])
        torch.testing.assert_close(gradient[m], theirs, rtol=1e-4, atol=1e-5)


def test_the_space_describes_what_forward_gets():
    seen: Any = encoder_of(Parts, PARTS).space
    assert list(seen) == ["camera", "body"]
    assert seen["camera"] == Box(0.0, 1.0, (3, 9, 8))
    assert seen["body"] == Tuple([Box(0.0, 1.0, (5,)), Box(-np.inf, np.inf, (2, 2))])
    kinds = encoder_of(Features, Box(0, np.arange(60).reshape(5, 4, 3), dtype=np.int64)).space
    assert (kinds.shape, kinds.high.max()) == ((3, 5, 4), 1.0)


def test_a_members_first_parameters_follow_from_its_generator_alone():
    encoder, before = encoder_of(Features, Box(-1.0, 1.0, (4,))), torch.get_rng_state()
    _, three = drawn(encoder, P)
    torch.manual_seed(99)
    _, one = drawn(encoder_of(Features, Box(-1.0, 1.0, (4,))), 1)
    assert torch.equal(three[:1], one)
    assert not torch.equal(three[0], three[1])
    torch.set_rng_state(before)
    drawn(encoder, P)
    assert torch.equal(torch.get_rng_state(), before)  # the user's own random numbers stay


class Scaled(nn.Module):
    """Has a constant, and a layer whose size comes from what it sees."""

    def __init__(self, space: gym.Space[Any]) -> None:
        super().__init__()
        self.register_buffer("scale", torch.tensor(0.5))
        self.still = nn.Parameter(torch.full((space.shape[0],), 2.0), requires_grad=False)
        self.layer = nn.LazyLinear(6)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self.layer(obs * self.scale * self.still)


def test_constants_are_no_parameters_and_lazy_layers_have_their_size():
    encoder, space = encoder_of(Scaled, Box(-1.0, 1.0, (4,))), Box(-1.0, 1.0, (4,))
    assert encoder.shapes == {"layer.weight": (6, 4), "layer.bias": (6,)}
    layout, flat = drawn(encoder, P)
    views, inputs = layout.views(flat), inputs_of(space)
    want = inputs["vector"] @ views["layer.weight"].mT + views["layer.bias"][:, None]
    torch.testing.assert_close(encoder(views, inputs), want)


def test_several_threads_run_it_with_parameters_of_their_own():
    encoder, space = encoder_of(Features, Box(-1.0, 1.0, (4,))), Box(-1.0, 1.0, (4,))
    layout, flat = drawn(encoder, P)
    inputs = {k: v[:1] for k, v in inputs_of(space).items()}
    views = [layout.views(flat[m : m + 1]) for m in range(P)]
    want = [encoder(v, inputs) for v in views]
    wrong = []

    def work(m: int) -> None:
        wrong.extend(1 for _ in range(300) if not torch.equal(encoder(views[m], inputs), want[m]))

    threads = [threading.Thread(target=work, args=(m,)) for m in range(P)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


# Learning


SMALL: dict[str, Any] = {"learning_rate": 1e-2, "gamma": 0.5, "network": Network([16], "relu")}
OFF: dict[str, Any] = SMALL | {
    "num_envs": 8, "batch_size": 32, "learning_starts": 64, "buffer_size": 999, "tau": 0.05,
}  # fmt: skip
ON_POLICY: dict[str, Any] = {"num_envs": 8, "n_steps": 16, "batch_size": 32}
MEMORY = SMALL | {"network": Network((16,), rnn=RNN("gru", 8))}
LEARNERS: dict[str, Any] = {
    "ppo": (PPO(**ON_POLICY, **SMALL), "Discrete", 2048),
    "recurrent ppo": (PPO(**ON_POLICY, **MEMORY, update_epochs=2), "Discrete", 512),
    "dqn": (DQN(**OFF), "Discrete", 800),
    "rainbow": (DQN.rainbow(**OFF), "Discrete", 300),
    "sac": (SAC(**OFF), "Box", 300),
    "sac of choices": (SAC(**OFF), "Discrete", 300),
    "td3": (TD3(**OFF), "Box", 300),
}
SOLVED = ("ppo", "dqn")
"""Those with a budget in which they learn the task."""


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    ("name", "shows"), [*((name, "vector") for name in LEARNERS), ("ppo", "image, channels last")]
)
def test_it_learns_saves_and_loads_with_every_algorithm(name, shows):
    config, asks, budget = LEARNERS[name]
    factory = Features if shows == "vector" else Camera
    config = replace(config, network=replace(config.network, encoder=factory))
    env = Echo(8, shows, asks)
    algorithm, state = learn(config, env, budget)
    first, learnt = algorithm.init([Seeds(0)]), algorithm.layout.views(state.params)
    before = algorithm.layout.views(first.params)
    encoders = [k for k in learnt if ".encoder." in k]
    assert encoders
    assert not any(torch.equal(learnt[k], before[k]) for k in encoders)
    policy, shown = AgentPolicy.of(algorithm, state), np.arange(4)
    memory = policy.start(4)
    action, _ = policy.act(memory, env.show(shown))
    if name in SOLVED:
        assert env.error(shown, action).mean() == 0.0
    loaded = AgentPolicy.from_file(*policy.to_file(), "agent")
    assert np.array_equal(loaded.act(memory, env.show(shown))[0], action)


def test_settings_are_recorded_as_data_and_are_equal_when_read():
    config = PPO(network={"hidden": [8], "encoder": functools.partial(Features, width=5)})
    data = config_to_json(config)
    assert data["network"]["encoder"] == f"{__name__}:Features(width=5)"
    assert type(data["network"]["encoder"]) is str
    again = config_from_json(data)
    assert again == config
    assert hash(again) == hash(config)
    assert isinstance(again.network.encoder, Named)
    algorithm = make_algorithm(again, Box(-1.0, 1.0, (4,)), Discrete(2))
    assert algorithm.layout.shapes["actor.encoder.layers.1.weight"] == (5, 4)


@pytest.mark.slow
def test_it_is_known_where_its_settings_are_unpacked(tmp_path):
    """A process that has none of the user's files acts by it, and reads files that name it."""
    config = replace(ON, network=Network((8,), encoder=Features))
    algorithm = make_algorithm(config, Box(-1.0, 1.0, (4,)), Discrete(2))
    policy = AgentPolicy.of(algorithm, algorithm.init([Seeds(0)]))
    obs = np.ones((2, 4), np.float32)
    (tmp_path / "sent").write_bytes(
        packed((policy, policy.to_file(), obs, policy.act({}, obs)[0]), "it")
    )
    code = (
        "from skillweave.workers.shipping import unpacked\n"
        "from skillweave.algorithms.agent_policy import AgentPolicy\n"
        f"policy, file, obs, want = unpacked(open({str(tmp_path / 'sent')!r}, 'rb').read())\n"
        "again = AgentPolicy.from_file(*file, 'it')\n"
        "print([(p.act({}, obs)[0] == want).all() for p in (policy, again)])\n"
    )
    root = str(Path(sw.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", code], env={"PYTHONPATH": root, "PATH": ""}, cwd=tmp_path,
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.count("True") == 2
    assert isinstance(unpacked(packed(config, "it")).network.encoder, Named)
    assert pickle.loads(cloudpickle.dumps(config)) == config


# Runs


def hierarchy(**how: Any) -> Hierarchy:
    config = replace(ON, network=Network((8,), encoder=Features))
    return Hierarchy("CartPole-v1", [Left()], algorithm=config, selector=config, **how)


def small(**how: Any) -> Hierarchy:
    found = hierarchy(**how)
    found.steps = 800

    return found


@pytest.mark.slow
@pytest.mark.parametrize("learn", ["apart", "together"])
def test_a_stopped_run_ends_as_if_it_had_not_been_stopped(tmp_path, learn):
    small(learn=learn).train(tmp_path / "whole", seed=3, quiet=True)
    run = stopped_run(small(learn=learn), tmp_path / "run", 6)
    stopped_again(small(learn=learn), run.path, 3)
    small(learn=learn).resume(run.path, quiet=True)
    assert_same(run.path, tmp_path / "whole")


def test_a_run_says_that_it_needs_code_and_loads_with_its_declaration(tmp_path, monkeypatch):
    agent = sw.Agent("CartPole-v1", replace(ON, network=Network((8,), encoder=Features)), 200)
    run = agent.train(tmp_path / "run", quiet=True)
    manifest = read_manifest(run.path)
    assert manifest.needs_recipe
    assert manifest.resume_needs_recipe
    assert manifest.stages[0].algorithm["network"]["encoder"] == f"{__name__}:Features"
    obs = np.ones((2, 4), np.float32)
    want = run.policy.act({}, obs)[0]
    assert np.array_equal(agent.load(run.path).policy.act({}, obs)[0], want)
    monkeypatch.setattr(naming, "_KNOWN", {})
    with pytest.raises(RunError, match=r"test_own:Features', a function of your own.*load"):
        RunDirectory.open(run.path).load_policy("agent")


@pytest.mark.slow
def test_a_population_learns_with_it_where_its_architecture_stays(tmp_path):
    config = replace(ON, network=Network((8,), encoder=Features))
    mutations = Mutations(0.2, 0.5, 0.2, 0.0, 0.1)
    evolution = Evolution(population=3, generations=2, mutations=mutations)
    how = {"quiet": True, "evolve": evolution}
    sw.train_agent("CartPole-v1", config, 900, tmp_path / "run", **how)
    with pytest.raises(
        SkillweaveError, match=r"Mutations\.architecture is 0\.2, but network has an encoder of"
    ):
        sw.train_agent("CartPole-v1", config, 900, tmp_path / "not", quiet=True,
                       evolve=replace(evolution, mutations=Mutations()))  # fmt: skip


# What is wrong


def _module(forward: Any, make: Any = None) -> Any:
    """A factory of a module with this forward; ``make`` gives it parts."""

    class Made(nn.Module):
        def __init__(self, space: Any) -> None:
            super().__init__()
            if make is not None:
                make(self)

        def forward(self, obs: torch.Tensor) -> Any:
            return forward(self, obs)

    Made.__qualname__ = "Made"
    return Made


def _norm(module: Any) -> None:
    module.norm = nn.BatchNorm1d(4)


def _stateless(module: Any) -> None:
    module.norm = nn.BatchNorm1d(4, track_running_stats=False)


def _dropout(module: Any) -> None:
    module.drop = nn.Dropout(0.5)


def _random(module: Any) -> None:
    module.register_buffer("mixing", torch.rand(4))


def _double(module: Any) -> None:
    module.w = nn.Parameter(torch.ones(4, dtype=torch.float64))


WRONG: dict[str, Any] = {
    "no module": (lambda space: 3, r"returned 3; it must return a torch\.nn\.Module"),
    "raises": (lambda space: space["camera"], r"raised TypeError: .*test_own\.py, line \d+"),
    "forward raises": (
        _module(lambda self, x: x @ torch.ones(7, 2)),
        r"forward raised RuntimeError.*for observations of shape \(3, 4\)",
    ),
    "no tensor": (_module(lambda self, x: None), "forward returned None; it must return one tenso"),
    "one axis": (_module(lambda self, x: x.sum(1)), r"returned shape \(3,\) for 3.*\(B, F\)"),
    "other rows": (_module(lambda self, x: x.T), r"returned shape \(4, 3\) for 3 observations"),
    "double": (_module(lambda self, x: x.double()), r"torch\.float64; it must return torch\.float"),
    "double parameter": (_module(lambda self, x: x, _double), r"parameter w holds torch\.float64"),
    "nan": (_module(lambda self, x: (x - 100.0).log()), "forward returned NaN or infinity"),
    "batch norm": (_module(lambda self, x: self.norm(x), _norm), r"buffer norm\..*LayerNorm"),
    "batch norm without buffers": (
        _module(lambda self, x: self.norm(x), _stateless), r"forward raised ValueError|depend on",
    ),
    "mixes rows": (_module(lambda self, x: x - x.mean(0)), "depend on the other observations"),
    "dropout": (_module(lambda self, x: self.drop(x), _dropout), r"the same observations \(Drop"),
    "another in evaluation": (
        _module(lambda self, x: x if self.training else 2 * x), "other features in evaluation mode",
    ),
    "a random constant": (_module(lambda self, x: x * self.mixing, _random), "mixing differs"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_with_a_module_is_a_sentence(name):
    factory, says = WRONG[name]
    wrapped = Named(f"test_own:{name.replace(' ', '_')}")
    wrapped.function = factory
    with pytest.raises(DeclarationError, match=says) as error:
        ModuleEncoder(obs_codec(Box(-1.0, 1.0, (4,))), wrapped)
    assert str(error.value).startswith("Network.encoder test_own:")
    assert "\n" not in str(error.value)


def test_what_is_no_factory_is_a_sentence():
    for value, says in (
        (nn.Linear(4, 2), r"Network\.encoder is a Linear, a module; give the class, or a function"),
        (3, r"Network\.encoder is 3; it must be a function f\(observation_space\)"),
        (functools.partial(Features, 4), r"partial with positional arguments; name them"),
        ("no such encoder", "which is not registered"),
    ):
        with pytest.raises(DeclarationError, match=says):
            make_encoder(Network(encoder=value).encoder, obs_codec(Box(-1.0, 1.0, (4,))))
