"""What an export of a hierarchy holds; ``test_read`` lets exports act."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from playing import runner_of
from random_hierarchies import (
    ACTIONS,
    AUTOMATON,
    OBS,
    Careful,
    Free,
    played,
    ready,
    skill_set,
    traced_once,
    trained,
)
from reference_calls import Counter, Left, Right, T, Zigzag, shy

from skillweave import Reflex
from skillweave.api.player import Player
from skillweave.errors import PolicyError
from skillweave.export.runner import Runner
from skillweave.export.write import write_export
from skillweave.skills import Skill, from_onnx, from_torch

pytest.importorskip("onnxscript")
torch.set_num_threads(1)
_ = traced_once  # of all tests here, too


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
