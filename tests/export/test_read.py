"""Policies in folders act the same where they are loaded; what is damaged is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from hub_server import go_to, serve
from playing import loaded_of, runner_of
from random_hierarchies import (
    HIERARCHIES,
    played,
    traced_once,
)
from random_networks import NESTED, agent, compare
from skills.foreign_models import onnx_file
from skills.mapped_models import ACTION, CASES, SPACE, observations, one, onnx_model, weights

import skillweave as sw
from skillweave import PPO, Network
from skillweave.algorithms import RNN
from skillweave.errors import DeclarationError, PolicyError, RunError, SkillweaveError
from skillweave.export.runner import Runner
from skillweave.export.write import write_export
from skillweave.skills.foreign_policy import made_up
from skillweave.types import Policy

pytest.importorskip("onnxscript")
pytest.importorskip("stable_baselines3")
torch.set_num_threads(1)
_ = traced_once  # of all tests here, too


def acts_alike(one: Policy, other: Policy, batches: Any) -> None:
    """Let both act with memories of their own; some environments start again."""
    memory, memories = one.start(len(batches[0])), other.start(len(batches[0]))
    rng, found = np.random.default_rng(0), []
    for obs in batches:
        action, memory = one.act(memory, obs)
        actions, memories = other.act(memories, obs)
        np.testing.assert_allclose(actions, action, atol=1e-5)
        found.append(np.round(action, 3))
        rows = np.flatnonzero(rng.random(len(obs)) < 0.2)
        for policy, kept in ((one, memory), (other, memories)):
            for k, v in policy.start(len(rows)).items():
                kept[k][rows] = v
    assert len(np.unique(found)) > 1


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("name", CASES)
def test_a_saved_policy_acts_the_same_where_it_is_loaded(name: str, tmp_path: Path) -> None:
    policy = CASES[name](tmp_path).policy.bind(SPACE, ACTION, "it")
    export = sw.save_policy(policy, tmp_path / "out", license="MIT", origin="made here")
    for file in tmp_path.glob("*.*"):
        file.unlink()  # the folder is enough
    loaded = loaded_of(export)
    assert loaded.observation_space == SPACE
    assert loaded.action_space == ACTION
    acts_alike(policy, loaded, observations(3, 20, seed=5))
    seen = [one(obs, 0) for obs in observations(1, 40, seed=4)]
    told = compare(policy, tmp_path / "out", seen, code=export.functions, rtol=1e-7)
    assert len(np.unique(np.round(told, 3))) > 3
    content = json.loads((tmp_path / "out/policy.json").read_text())
    assert (content["license"], content["origin"]) == ("MIT", "made here")
    again = sw.save_policy(loaded, tmp_path / "again")
    copied = loaded_of(again)
    acts_alike(policy, copied, observations(3, 10, seed=6))


AGENTS: dict[str, Any] = {
    "ppo": (PPO(network=Network((8,))), NESTED, gym.spaces.Discrete(4)),
    "lstm": (
        PPO(network=Network((8,), rnn=RNN("lstm", 4))),
        gym.spaces.Box(-1, 1, (3,), np.float64),
        gym.spaces.MultiDiscrete([2, 3]),
    ),
    "box": (PPO(network=Network((8,))), gym.spaces.MultiBinary(3), gym.spaces.Box(-2, 3, (2,))),
}


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", AGENTS)
def test_an_export_of_a_trained_agent_is_loaded(name: str, tmp_path: Path) -> None:
    config, space, action = AGENTS[name]
    policy = agent(config, space, action)
    write_export(tmp_path, policy, "toy")
    loaded = sw.load_policy(tmp_path)
    acts_alike(policy, loaded, [made_up(space, 6)[i : i + 3] for i in (0, 1, 2, 3)])


def test_a_policy_without_spaces_gets_those_of_an_environment(tmp_path: Path) -> None:
    policy = sw.from_onnx(onnx_file(tmp_path / "lean.onnx"))
    with pytest.raises(PolicyError, match=r"lean.onnx has no spaces yet: give the environment"):
        sw.save_policy(policy, tmp_path)
    export = sw.save_policy(policy, tmp_path, "CartPole-v1")
    assert export.files[:3] == ("agent.onnx", "policy.json", "runner.py")
    loaded = sw.load_policy(tmp_path / "policy.json")
    assert sw.evaluate(loaded, "CartPole-v1", episodes=2).mean > 0
    with pytest.raises(SkillweaveError, match=r"save_policy\(\): .*takes observations of shape"):
        sw.save_policy(policy, tmp_path, "Pendulum-v1")


def test_a_goal_may_be_replaced(tmp_path: Path) -> None:
    net = onnx_model(
        tmp_path / "net.onnx",
        [("MatMul", ["obs", "w"], ["a"])],
        {"obs": ["n", 5]},
        {"a": ["n", 5]},
        {"w": weights(5, 5)},
    )
    policy = sw.from_onnx(net, sees=(sw.Goal(low=-1, high=1), "gyro"), goal=(0.5, 0))
    policy = policy.bind(SPACE, ACTION, "it")
    sw.save_policy(policy, tmp_path)
    obs = observations(2, 1)[0]
    other: Any = sw.load_policy(tmp_path, goal=(1, -1))
    wanted = policy.act({}, obs, goal=np.array([[1.0, -1.0]] * 2))[0]
    np.testing.assert_allclose(other.act({}, obs)[0], wanted, atol=1e-6)
    with pytest.raises(SkillweaveError, match=r"load_policy\(\): .*goal is .*out of the range"):
        sw.load_policy(tmp_path, goal=(2, 0))
    sw.save_policy(sw.from_onnx(onnx_file(tmp_path / "x.onnx")), tmp_path / "no", "CartPole-v1")
    with pytest.raises(DeclarationError, match=r"load_policy\(\): .*no: goal is given, 1, but"):
        sw.load_policy(tmp_path / "no", goal=1)


# Hierarchies


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("name", HIERARCHIES)
def test_an_export_of_a_hierarchy_acts_the_same(name: str, tmp_path: Path) -> None:
    policy = HIERARCHIES[name]()
    export = write_export(tmp_path / "out", policy, "walk")
    loaded = loaded_of(export)
    told = played([policy, loaded], runner_of(export))
    skills, actions, decisions = map(set, zip(*told, strict=True))
    assert len(skills) > 1 or name == "function"  # so that choices are compared
    assert len(actions) > 1
    assert len(told) > 2
    assert decisions == {True, False}  # and calls of several steps
    again = write_export(tmp_path / "again", loaded, "walk")
    copied = loaded_of(again)
    played([policy, copied], n=2)


# What is damaged, or does not fit


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    onnx_model(
        tmp_path / "net.onnx",
        [("MatMul", ["obs", "w"], ["a"]), ("Tanh", ["h"], ["h_out"])],
        {"obs": ["n", 4], "h": ["n", 2]},
        {"a": ["n", 5], "h_out": ["n", 2]},
        {"w": weights(4, 5)},
    )
    policy = sw.from_onnx(
        tmp_path / "net.onnx",
        sees=("gyro", sw.Goal(low=-1, high=1)),
        goal=0.5,
        acts=sw.Acts(scale=2.0),
        state={"h": "h_out"},
        every=2,
    )
    sw.save_policy(policy.bind(SPACE, ACTION, "it"), tmp_path / "saved")
    assert sw.load_policy(tmp_path / "saved")
    return tmp_path / "saved"


def mapped(content: Any) -> Any:
    """What ``policy.json`` has of the policy from elsewhere."""
    return content["policy"]["policy"]


def take(content: Any) -> Any:
    """What it has of the first part of its input."""
    return mapped(content)["inputs"][""]["takes"][0]


def changed(folder: Path, change: Callable[[Any], Any]) -> None:
    path = folder / "policy.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x.update(format=2), "has format 2, but this version reads 3: export .* again"),
        (lambda x: x.pop("license"), "no field 'license'"),
        (lambda x: x["files"].update({"agent.onnx": "0" * 64}), "agent.onnx has another checksum"),
        (lambda x: x["files"].update({"../net.onnx": "0" * 64}), "no file of the folder"),
        (lambda x: x["files"].clear(), "model.content is 'agent.onnx', which files does not list"),
        (lambda x: x.update(policy=mapped(x)), "policy is 'Mapped'; it must be .*Deployed"),
        (lambda x: mapped(x).update(type="Magic"), "policy.policy is 'Magic'; .* one of .*Mapped"),
        (lambda x: mapped(x)["model"].pop("content"), "policy.model has no field 'content'"),
        (lambda x: mapped(x)["model"].update(output="b"), "model has no output 'b'"),
        (lambda x: mapped(x).update(every=0), r"policy: Mapped.every is 0; it must be 1 to"),
        (lambda x: mapped(x).update(every=2**70), "policy.every is .* a whole number"),
        (lambda x: mapped(x).update(chunk=4), r"chunk=4 needs \(n, 4, ...\)"),
        (lambda x: mapped(x).update(chunk=10**8), "chunk is 100000000; it must be 1 to 100,000"),
        (lambda x: mapped(x).update(goal={"array": 1e999, "dtype": "float64"}), "damaged|number"),
        (
            lambda x: mapped(x).update(goal={"array": ["a"], "dtype": "float64"}),
            "goal.array is 'a'",
        ),
        (lambda x: mapped(x).update(goal={"array": [1], "dtype": "O"}), "goal is no array"),
        (lambda x: mapped(x).update(goal={"array": [0.0] * 65, "dtype": "float64"}), "at most 64"),
        (lambda x: mapped(x).update(goal={"array": [0.0, 1.0], "dtype": "f8"}), "have goals of"),
        (lambda x: mapped(x).update(goal={"stored": "goal"}), "arrays.npz does not list"),
        (lambda x: mapped(x)["outputs"].update(scale=None, to=[0, 9]), "outputs: Outputs.to is"),
        (
            lambda x: take(x).update(source=[]),
            r"takes\[0\].source is \[\]; .* one of 'observation'",
        ),
        (lambda x: take(x).update(fields=["gyr"]), r"takes gyr of shape .* observations are of"),
        (
            lambda x: mapped(x)["inputs"][""]["takes"].pop(0),
            "shape is .4,., but .* gives 1 numbers",
        ),
        (lambda x: mapped(x)["model"]["state"].clear(), "model.*'h'|takes"),
        (lambda x: x["policy"]["sees"].update(kind="Ball"), "policy.sees.kind is 'Ball'"),
        (lambda x: x["policy"]["sees"].update(kind="Box"), "policy.sees: a space is a Box of"),
        (lambda x: x["policy"]["acts"].update(shape=[4]), r"outputs.space is Box.*not Box"),
        (lambda x: x["policy"]["acts"].update(shape=[10**9]), "at most 100,000,000 numbers"),
        (lambda x: mapped(x).update(evry=3), "policy.'evry' is unknown: is 'every' meant"),
        (lambda x: take(x).update(plces=3), r"takes\[0\].'plces' is unknown: is 'places' meant"),
        (lambda x: x["code"].update(f="a function"), "needs Python code.*'f': a function"),
    ],
)
def test_a_manifest_that_does_not_fit_names_file_and_field(
    change: Any, message: str, saved: Path
) -> None:
    changed(saved, change)
    with pytest.raises((RunError, PolicyError), match=rf"saved.*{message}"):
        sw.load_policy(saved)


def test_files_that_are_missing_or_damaged_are_named(saved: Path) -> None:
    content = (saved / "agent.onnx").read_bytes()
    (saved / "agent.onnx").write_bytes(content[:-1])
    with pytest.raises(RunError, match=r"agent.onnx has another checksum than .*policy.json"):
        sw.load_policy(saved)
    (saved / "agent.onnx").unlink()
    with pytest.raises(RunError, match=r"agent.onnx does not exist"):
        sw.load_policy(saved)
    (saved / "policy.json").write_text("{")
    with pytest.raises(RunError, match=r"policy.json is damaged"):
        sw.load_policy(saved)
    with pytest.raises(RunError, match=r"nothing/at/all does not exist"):
        sw.load_policy("nothing/at/all")


def test_an_observation_that_does_not_fit_names_its_part_to_the_runner(saved: Path) -> None:
    runner, obs = Runner(saved), SPACE.sample()
    gyro = obs["gyro"]
    for wrong, says in (
        ({k: v for k, v in obs.items() if k != "gyro"}, "obs has no part 'gyro'"),
        (obs | {"gyro": gyro[None]}, r"obs\['gyro'\] has shape \(1, 3\), not \(3,\)"),
        (obs | {"gyro": 0.5}, r"has shape \(\), not \(3,\)"),
        (obs | {"gyro": gyro * np.nan}, r"NaN in obs\['gyro'\]"),
        (obs | {"gyro": gyro + 1j}, r"obs\['gyro'\] is complex\d+, not numbers"),
        (obs | {"gyro": [None] * 3}, r"obs\['gyro'\] is object, not numbers"),
        (gyro, "obs is an array of shape .* not a Dict of"),
    ):
        with pytest.raises(DeclarationError, match=says):
            runner.act(wrong)
    assert runner.act(obs).shape == ACTION.shape


def test_what_is_no_folder_of_a_policy_says_what_it_is(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(RunError, match=r"net.onnx is a file; .*from_onnx"):
        sw.load_policy(saved.parent / "net.onnx")
    assert sw.load_policy(saved / "policy.json")
    env = sw.EnvSpec("CartPole-v1", engine="sync", workers=1)
    run = sw.train_agent(env, sw.PPO(num_envs=2, n_steps=8), 16, saved / "run")
    with pytest.raises(RunError, match=r"run is a run, not an exported policy: sw.load\('.*run'"):
        sw.load_policy(run.path)
    pytest.importorskip("huggingface_hub")
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(RunError, match=r"no folder policies/reach, and it cannot be loaded from "):
        sw.load_policy("policies/reach")


def test_a_policy_of_the_hub_is_loaded_without_what_is_not_data(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("huggingface_hub")
    files = {p.name: p.read_bytes() for p in saved.iterdir() if p.is_file()}
    with serve() as hub:
        go_to(hub.url, tmp_path / "cache", monkeypatch)
        hub.make("ada/walk", files | {"train.py": b"mine"})
        hub.make("ada/else", {"README.md": b"nothing"})
        loaded = sw.load_policy("ada/walk")
        acts_alike(sw.load_policy(saved), loaded, observations(2, 4))
        names = {p.name for p in (tmp_path / "cache").rglob("*")}
        assert "agent.onnx" in names
        assert not names & {"train.py", "runner.py"}
        with pytest.raises(RunError, match=r"ada/else holds no policy.*policy.json"):
            sw.load_policy("ada/else")
