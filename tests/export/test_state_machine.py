"""What an export of a hierarchy holds; ``test_read`` lets exports act."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from playing import alike, runner_of
from reference_calls import POSITION, TAG, Counter, Left, Right, T, Walk, Zigzag, scripted, shy
from test_networks import agent
from toys import skills_of

from skillweave import PPO, Automaton, Network, Reflex
from skillweave.algorithms import RNN
from skillweave.algorithms.config import SkillCritic
from skillweave.api.player import Player
from skillweave.errors import PolicyError
from skillweave.export import compile
from skillweave.export.graphs import agent_graph
from skillweave.export.runner import Runner
from skillweave.export.write import write_export
from skillweave.hierarchy.policy import HierarchyPolicy, with_interruption
from skillweave.skills import Skill, from_onnx, from_torch, ready_selector
from skillweave.skills.skill_set import SkillSet
from skillweave.types import Array, Step

pytest.importorskip("onnxscript")
torch.set_num_threads(1)


@cache
def traced_before(policy: Any, sampled: bool) -> Any:
    return agent_graph(policy, sampled, "a network of these tests")


@pytest.fixture(autouse=True)
def traced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tracing takes a second, and these policies share their networks."""
    monkeypatch.setattr(compile, "agent_graph", lambda p, sampled, _: traced_before(p, sampled))


class LongWalk(Walk):
    """Episodes of 30 to 60 steps, whose numbers are of about one size."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.tag, self.length = self.tag % 7, int(self.np_random.integers(30, 60))
        return self._obs(), {}


OBS, ACTIONS = Walk.observation_space, Walk.action_space


@cache
def network(choices: int, rnn: RNN | None = None, seed: int = 0) -> Any:
    config = PPO(network=Network((8,), rnn=rnn), normalize_obs=False)
    return agent(config, OBS, gym.spaces.Discrete(choices), seed=seed)


class Careful(Skill):
    """May start at even positions; stops where its last action led to an odd one."""

    max_steps = 7
    policy = scripted(lambda obs: (obs[:, T].astype(int) // 2 + obs[:, TAG].astype(int)) % 3)

    def initiation(self, obs: Array) -> Array:
        return obs[:, POSITION] % 2 == 0

    def termination(self, step: Step) -> Array:
        return step.timed_out | (step.info["t"] % 5 == 0) | (step.obs[:, T] > step.elapsed + 20)

    def success(self, step: Step) -> Array:
        return step.elapsed > 2


class Remembers(Skill):
    """A recurrent network."""

    call_steps = 2
    policy = network(3, RNN("gru", 4))


class Free(Skill):
    """A network that may start everywhere."""

    policy = network(3, seed=3)


skill_set = functools.partial(skills_of, call_steps=4)


def ready(value: Any, skills: SkillSet) -> HierarchyPolicy:
    selector = ready_selector(value, tuple(s.name for s in skills.skills))
    assert selector is not None
    choices = gym.spaces.Discrete(len(skills.skills))
    return HierarchyPolicy(selector.bind(OBS, choices, "selector"), skills)


def trained(skills: SkillSet, seed: int = 1) -> HierarchyPolicy:
    return HierarchyPolicy(network(skills.choices, seed=seed), skills)


def far(step: Step) -> Array:
    return np.abs(step.next_obs[:, POSITION]) + step.reward * 0 > 2


def nested() -> HierarchyPolicy:
    inner = trained(skill_set(Left, Careful, Zigzag, call_steps=3, reflexes=(shy(),)))

    class Inner(Skill):
        max_steps = 5
        policy = inner

    return trained(skill_set(Inner, Zigzag, call_steps=8), seed=5)


def critic_of(skills: int, **how: Any) -> Any:
    algorithm = SkillCritic(network=Network((8,)), normalize_obs=False, **how)
    return agent(algorithm, OBS, gym.spaces.Discrete(skills), seed=2)


def interrupted(margin: float, **how: Any) -> HierarchyPolicy:
    skills = skill_set(Careful, Left, Free, call_steps=9)
    return trained(with_interruption(skills, critic_of(3, **how), margin))


AUTOMATON = Automaton(
    {"near": ["careful", "left"], "far": "zigzag", "home": ["right", "zigzag"]},
    {("near", "far"): far, ("far", "home"): "failure", ("home", "near"): "success",
     ("home", "far"): "failure"},
)  # fmt: skip
POLICIES: dict[str, Any] = {
    "nested": nested,
    "memories": lambda: trained(skill_set(Remembers, Left, Free), 2),
    "interrupted": lambda: interrupted(0.02, deciding=True),
}


def played(policies: Sequence[Any], *runners: Runner, n: int = 5) -> set[tuple[str, int, bool]]:
    """Play n episodes, in which all act alike; all skills, actions, and whether one decided."""
    players, told = [Player(policy) for policy in policies], set()
    for seed in range(n):
        for action in alike(LongWalk(), *players, *runners, seed=seed):
            (name,) = {p.acts(actor.memory) for p, actor in zip(policies, players, strict=True)}
            (_,) = {int(actor.memory["skill"][0]) for actor in (*players, *runners)}
            told.add((name, int(action), players[0].memory["elapsed"][0] == 0))
    return told


def test_code_that_is_missing_is_named_with_what_it_is(tmp_path: Path) -> None:
    policy = trained(skill_set(Careful, Left, Free, reflexes=(shy(),)))
    export = write_export(tmp_path, policy, "walk")
    needs = {"careful.initiation", "careful.termination", "careful.policy", "left.policy"}
    assert set(export.code) == needs | {"shy.condition"}
    assert "'shy.condition': observations (n, ...) to (n,) bool" in str(export)
    with pytest.raises(PolicyError, match=r"shy\.condition.*observations .* bool"):
        Runner(tmp_path)
    assert set(export.functions) == set(export.code)
    assert runner_of(export).act(np.zeros(4, np.float32)) in range(3)


def test_two_functions_of_one_name_are_told_apart(tmp_path: Path) -> None:
    twice = tuple(Reflex(lambda o, i=i: o[:, T] == i, action=i) for i in range(2))
    export = write_export(tmp_path, trained(skill_set(Free, Free, reflexes=twice)), "walk")
    assert set(export.code) == {"<lambda>.condition", "<lambda>.condition#2"}


def test_what_cannot_be_exported_says_what_to_do(tmp_path: Path) -> None:
    policy = trained(skill_set(Counter, Left))
    with pytest.raises(PolicyError, match=r"policy of 'counter'.*memory.*train the skill"):
        write_export(tmp_path, policy, "walk")
    assert not list(tmp_path.iterdir())


def linear_file(path: Path) -> Path:
    """An ONNX file of float64 logits, as another framework may write it."""
    import onnx
    from onnx import TensorProto, helper

    weight = onnx.numpy_helper.from_array(np.random.default_rng(0).normal(size=(4, 3)), "w")
    given, found = (
        [helper.make_tensor_value_info(name, TensorProto.DOUBLE, ["n", size])]
        for name, size in (("x", 4), ("y", 3))
    )
    graph = helper.make_graph([helper.make_node("MatMul", ["x", "w"], ["y"])], "linear", given,
                              found, [weight])  # fmt: skip
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=9), path)
    return path


def test_networks_from_elsewhere_are_exported_too(tmp_path: Path) -> None:
    from torch import nn

    torch.manual_seed(0)
    module = nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(8, 3)).eval()
    file = linear_file(tmp_path / "net.onnx")

    class Module(Skill):
        policy = from_torch(module).bind(OBS, ACTIONS, "module")

    class File(Skill):
        policy = from_onnx(file).bind(OBS, ACTIONS, "file")

    policy = trained(skill_set(Module, File, Free))
    export = write_export(tmp_path / "out", policy, "walk")
    assert export.code == {}
    assert len({skill for skill, _, _ in played([policy], Runner(tmp_path / "out"))}) > 1
    runner, player = Runner(tmp_path / "out"), Player(policy)
    with_mask = np.array([False, True, True])
    for obs in np.random.default_rng(0).normal(size=(30, 4)).astype(np.float32):
        assert runner.act(obs, mask=with_mask) == player.act(obs, mask=with_mask) != 0


def test_a_selector_that_samples_in_any_case_samples_when_exported(tmp_path: Path) -> None:
    policy = trained(skill_set(Free, Left, greedy_selector=False))
    write_export(tmp_path, policy, "walk")
    told = json.loads((tmp_path / "policy.json").read_text())["policy"]["policy"]
    assert told["selector"]["noise"] == [["gumbel", 2]]
    assert "noise" not in told["skills"][0]["policy"]
    skills = skill_set(Careful, Left, Zigzag, Right, greedy_selector=False)
    export = write_export(tmp_path / "other", ready(AUTOMATON, skills), "walk")
    far_left = np.array([-8.0, 0, 0, 0], np.float32)
    runners = [runner_of(export, seed=seed) for seed in range(20)]
    assert all(runner.act(far_left) in range(3) for runner in runners)
    drawn = {int(runner.memory["skill"][0]) for runner in runners}
    assert len(drawn) == 2  # of the skills of its first state


@pytest.mark.slow
def test_skills_that_sample_draw_as_often_as_their_network_says(tmp_path: Path) -> None:
    policy = trained(skill_set(Free, greedy=False))
    export = write_export(tmp_path, policy, "walk")
    told = json.loads((tmp_path / "policy.json").read_text())
    assert told["policy"]["policy"]["skills"][0]["policy"]["noise"] == [["gumbel", 3]]
    assert export.files[:4] == ("selector.onnx", "free.onnx", "policy.json", "runner.py")
    obs, runner = np.array([1.0, 0.5, 2.0, 0.0], np.float32), Runner(tmp_path, seed=0)
    head = Free.policy.heads(obs[None])[0]
    wanted = np.exp(head - head.max()) / np.exp(head - head.max()).sum()
    drawn = np.bincount([runner.act(obs) for _ in range(2000)], minlength=3) / 2000
    np.testing.assert_allclose(drawn, wanted, atol=4 * np.sqrt(0.25 / 2000))
