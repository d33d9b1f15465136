"""A policy plays only where it belongs, and only if its numbers are numbers."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from declaring import plainly

from skillweave import PPO, EnvSpec, Hierarchy, Network, Skill, SkillweaveError
from skillweave.algorithms.agent_policy import state_from
from skillweave.cli import main
from skillweave.compat.agilerl import agent_classes as agilerl
from skillweave.runs.files import read_json, read_tensors, write_json, write_tensors

SMALL = PPO(num_envs=2, n_steps=8, batch_size=16, network=Network((4,)), overlap=False)
NAMES = "left", "right", "stay"


def declare(names: tuple[str, ...] = NAMES) -> Hierarchy:
    skills = [type(name, (Skill,), {"name": name})() for name in names]
    how = {"skill_steps": 32, "selector_steps": 64, "call_steps": 4}
    env = EnvSpec("CartPole-v1", engine="sync", workers=1)
    return Hierarchy(env, skills, algorithm=SMALL, selector=SMALL, **plainly(how))


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("places")
    declare().train(folder / "run", quiet=True).save_weights(folder / "w.safetensors")
    return folder


@pytest.fixture
def run(trained, tmp_path) -> Path:
    shutil.copytree(trained / "run", tmp_path / "run")
    return tmp_path / "run"


def policy(run: Path, stage: str) -> Path:
    return run / "policies" / f"{stage}.safetensors"


def rewrite(run: Path, stage: str, tensors, header):
    """Write a stage's policy, with a checksum that fits."""
    data = read_json(run / "run.json")
    entry = next(entry for entry in data["stages"] if entry["name"] == stage)
    entry["sha256"] = write_tensors(policy(run, stage), tensors, header)
    write_json(run / "run.json", data)


def test_policies_in_the_place_of_others_are_refused(run):
    a, b = policy(run, "left"), policy(run, "right")
    first, second = a.read_bytes(), b.read_bytes()
    a.write_bytes(second)
    b.write_bytes(first)
    with pytest.raises(SkillweaveError, match=r"left\.safetensors holds the policy of .*'right'"):
        declare().load(run)
    with pytest.raises(SkillweaveError, match="holds the policy of stage 'selector' alone"):
        declare(("left", "right")).load_weights(policy(run, "selector"))


def test_a_selector_in_the_place_of_a_skill_is_refused(run):
    """Even where header and checksum were made to fit."""
    for target, source in (("left", "selector"), ("selector", "right")):
        before, manifest = policy(run, target).read_bytes(), (run / "run.json").read_bytes()
        tensors, header = read_tensors(policy(run, source))
        rewrite(run, target, tensors, header | {"stage": target})
        with pytest.raises(SkillweaveError, match=r"in the place of .* has action_space Discrete"):
            declare().load(run)
        policy(run, target).write_bytes(before)
        (run / "run.json").write_bytes(manifest)
    declare().load(run).evaluate(1)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["actor.0.weight", "critic.1.bias"])
def test_weights_that_are_not_finite_are_refused_by_name(run, trained, tmp_path, name, value):
    tensors, header = read_tensors(policy(run, "selector"))
    tensors[name].view(-1)[0] = value
    rewrite(run, "selector", tensors, header)
    with pytest.raises(SkillweaveError, match=f"tensor {name} holds NaN or infinity"):
        declare().load(run)
    tensors, header = read_tensors(trained / "w.safetensors")
    tensors[f"left/{name}"].view(-1)[0] = value
    write_tensors(tmp_path / "w.safetensors", tensors, header)
    with pytest.raises(SkillweaveError, match=rf"\(left\): tensor {name} holds NaN or infinity"):
        declare().load_weights(tmp_path / "w.safetensors")


def test_weights_of_another_type_are_refused_by_name(run):
    tensors, header = read_tensors(policy(run, "left"))
    tensors["actor.0.weight"] = tensors["actor.0.weight"].double()
    rewrite(run, "left", tensors, header)
    says = r"tensor actor\.0\.weight should hold torch\.float32, found torch\.float64"
    with pytest.raises(SkillweaveError, match=says):
        declare().load(run)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"skills": 5}, "skills is 5; it must be a list"),
        ({"hierarchy": "a"}, "hierarchy is 'a'; it must be an object"),
        ({"parts": {"left": 5}}, "parts['left'] is 5; it must be an object"),
        ({"env": ["CartPole-v1"]}, "env is ['CartPole-v1']; it must be a text"),
    ],
)
def test_a_wrong_field_of_a_weights_file_is_named(trained, tmp_path, change, says):
    path = tmp_path / "w.safetensors"
    tensors, header = read_tensors(trained / "w.safetensors")
    write_tensors(path, tensors, header | change)
    h = declare()
    with pytest.raises(SkillweaveError) as caught:
        h.load_weights(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert says in str(caught.value)
    assert h.call_steps == 4


@pytest.mark.parametrize("part", ["observation_space", "action_space", "algorithm"])
@pytest.mark.parametrize("value", [{}, {"type": []}, {"type": "Box", "shape": [10**12]}, None])
def test_a_damaged_part_of_a_policys_header_is_named(trained, tmp_path, part, value):
    path = tmp_path / "w.safetensors"
    tensors, header = read_tensors(trained / "w.safetensors")
    header["parts"]["left"][part] = value
    write_tensors(path, tensors, header)
    with pytest.raises(SkillweaveError) as caught:
        declare().load_weights(path)
    assert str(caught.value).startswith((f"{path} (left)", f"{path}: parts['left'].{part}"))


def test_a_flat_agents_damaged_header_is_told_by_the_command_line(run, tmp_path, capsys):
    tensors, header = read_tensors(policy(run, "left"))
    path = tmp_path / "w.safetensors"
    for change in ({"env": 5, "env_kwargs": {}}, {"env": "CartPole-v1", "env_kwargs": 5}):
        write_tensors(path, tensors, header | change)
        assert main(["evaluate", str(path)]) == 1
        assert "is 5; it must be" in capsys.readouterr().err


def test_an_agents_state_of_another_shape_or_type_or_none_is_refused(tmp_path):
    path = tmp_path / "agent.safetensors"
    agilerl.DQN((3,), 2, False).saveCheckpoint(path)
    tensors, header = read_tensors(path)
    agilerl.DQN.load(path)
    for changed in (tensors["state.mu"][:, :-1].clone(), tensors["state.mu"].double()):
        write_tensors(path, tensors | {"state.mu": changed}, header)
        with pytest.raises(SkillweaveError, match="tensor mu should"):
            agilerl.DQN.load(path)
    state = agilerl.DQN((3,), 2, False).member.state
    given = dict(vars(state))
    assert torch.equal(state_from(given, state, "x").params, state.params)
    del given["params"]
    with pytest.raises(SkillweaveError, match=r"x: tensor params should be .*found nothing"):
        state_from(given, state, "x")
