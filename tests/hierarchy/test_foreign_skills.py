"""Foreign skills from declaration to training, loading and evaluation."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from declaring import plainly, skills_with
from gymnasium.spaces import Box, MultiDiscrete
from skills.foreign_models import WEIGHT, linear, onnx_file, sb3_zip
from small_runs import acts
from toys import World

from skillweave import (
    PPO,
    Apart,
    EnvSpec,
    Hierarchy,
    Skill,
    SkillweaveError,
    from_onnx,
    from_sb3,
    from_torch,
)
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.types import Memoryless

SMALL = PPO(num_envs=4, n_steps=16, batch_size=64)


def upright(obs):
    return (obs @ WEIGHT).argmax(1)


def skill(name, policy, **attributes):
    return type(name, (Skill,), {"name": name, "policy": policy, **attributes})()


CARTPOLE = EnvSpec("CartPole-v1", engine="sync", workers=1)


def declare(*skills, env=CARTPOLE, **more):
    return Hierarchy(
        env, skills, selector=SMALL, call_steps=5, apart=Apart(selector_steps=200), **plainly(more)
    )


def all_kinds(folder):
    """A skill of each kind, from files that lie in ``folder``."""
    return [
        skill("function", upright),
        skill("torch", linear()),
        skill("sb3", from_sb3(folder / "ppo.zip", "ppo", trust=True)),
        skill("onnx", from_onnx(folder / "skill.onnx")),
    ]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with files, and a run of skills of each kind."""
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("onnxruntime")
    folder = tmp_path_factory.mktemp("foreign")
    sb3_zip(folder / "ppo.zip")
    onnx_file(folder / "skill.onnx")
    run = declare(*all_kinds(folder)).train(folder / "run", seed=0, quiet=True)
    return folder, run


def test_a_run_names_and_keeps_its_policies(made):
    folder, run = made
    manifest = json.loads((run.path / "run.json").read_text())
    entries = {s["name"]: s["policy"] for s in manifest["skills"]}
    assert {k: v["kind"] for k, v in entries.items()} == {k: k for k in entries}
    assert entries["sb3"]["file"] == str(folder / "ppo.zip")
    kept = {p.name for p in (run.path / "policies").iterdir()}
    assert kept == {"torch.safetensors", "onnx.onnx", "selector.safetensors"}
    assert (run.path / "policies" / "onnx.onnx").read_bytes()
    assert manifest["needs_recipe"]


@pytest.mark.slow
def test_trained_and_loaded_act_the_same_also_from_a_weights_file(made, tmp_path):
    folder, run = made
    loaded = declare(*all_kinds(folder)).load(run.path)
    assert acts(loaded.policy) == acts(run.policy)
    assert loaded.evaluate(5) == run.evaluate(5)
    assert sum(run.evaluate(5).skill_calls.values()) > 5
    torch, onnx = (run.evaluate(3, skill=name) for name in ("torch", "onnx"))
    assert torch.returns == onnx.returns
    assert torch.skills["torch"] == onnx.skills["onnx"]
    path = run.save_weights(tmp_path / "weights.safetensors")
    assert acts(declare(*all_kinds(folder)).load_weights(path).policy) == acts(run.policy)


@pytest.mark.slow
def test_what_a_run_keeps_is_what_acts_whatever_the_recipe_has_now(made, tmp_path):
    folder, run = made
    weights = run.save_weights(tmp_path / "weights.safetensors")
    onnx_file(tmp_path / "other.onnx", -WEIGHT)
    skills = all_kinds(folder)
    skills[1] = skill("torch", linear(-WEIGHT))
    skills[3] = skill("onnx", from_onnx(tmp_path / "other.onnx"))
    for loaded in (declare(*skills).load(run.path), declare(*skills).load_weights(weights)):
        for name in ("torch", "onnx"):
            assert loaded.evaluate(3, skill=name) == run.evaluate(3, skill=name)


def test_a_policy_that_is_only_named_must_be_the_same(made, tmp_path):
    folder, run = made
    weights = run.save_weights(tmp_path / "weights.safetensors")
    skills = all_kinds(folder)
    sb3_zip(tmp_path / "a.zip", "ppo", n_steps=64)
    skills[2] = skill("sb3", from_sb3(tmp_path / "a.zip", "ppo", trust=True))
    for load in (
        lambda: declare(*skills).load(run.path),
        lambda: declare(*skills).resume(run.path),
        lambda: declare(*skills).load_weights(weights),
    ):
        with pytest.raises(SkillweaveError, match=r"'sb3'.*ppo\.zip.*a\.zip.*another checksum"):
            load()


def test_a_policy_of_another_kind_and_one_of_other_shapes_are_refused(made):
    folder, run = made
    skills = all_kinds(folder)
    skills[1] = skill("torch", upright)
    with pytest.raises(SkillweaveError, match=r"'torch'.*kind torch.*now it is function"):
        declare(*skills).load(run.path)
    skills[1] = skill("torch", torch.nn.Linear(4, 2))
    with pytest.raises(SkillweaveError, match=r"skill 'torch'.*the weights.*do not fit"):
        declare(*skills).load(run.path)


def test_a_run_with_a_ready_skill_is_not_loaded_where_it_is_declared_without(tmp_path):
    run = declare(skill("one", upright), skill("two", upright)).train(tmp_path / "run", quiet=True)
    with pytest.raises(SkillweaveError, match=r"run: 'two' did not learn there: declare"):
        declare(skill("one", upright), skill("two", None)).load(run.path)


def test_a_model_of_sb3_in_memory_is_kept_by_its_weights(tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")

    def model(seed):
        return sb3.A2C("MlpPolicy", "CartPole-v1", seed=seed, device="cpu")

    run = declare(skill("one", from_sb3(model(0)))).train(tmp_path / "run", quiet=True)
    assert (run.path / "policies" / "one.safetensors").exists()
    loaded = declare(skill("one", from_sb3(model(1)))).load(run.path)
    assert acts(loaded.policy) == acts(run.policy)


def test_a_run_that_is_resumed_goes_on_with_what_it_has_kept(tmp_path, monkeypatch):
    import skillweave.training.trainer as training

    whole = declare(skill("a", linear())).train(tmp_path / "whole", quiet=True)
    with monkeypatch.context() as patch:
        patch.setattr(training, "train_stage", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            declare(skill("a", linear())).train(tmp_path / "cut", quiet=True)
    resumed = declare(skill("a", linear(-WEIGHT))).resume(tmp_path / "cut", quiet=True)
    assert acts(resumed.policy) == acts(whole.policy)


def test_a_hierarchy_of_foreign_skills_is_a_skill_again(tmp_path):
    inner = declare(skill("a", linear()), skill("b", upright)).train(tmp_path / "in", quiet=True)
    whole = inner.as_skill("inner", max_steps=10)
    run = declare(whole, skill("c", linear(-WEIGHT))).train(tmp_path / "out", quiet=True)
    assert run.info()["skills"][0]["policy"]["kind"] == "policy"
    loaded = declare(whole, skill("c", linear(-WEIGHT))).load(run.path)
    assert acts(loaded.policy) == acts(run.policy)


@pytest.mark.slow
def test_a_hierarchy_as_a_skill_must_be_the_one_that_the_run_was_trained_with(tmp_path):
    def inner(name, seed, policy=upright):
        own = declare(skill("a", linear()), skill("b", policy))
        return own.train(tmp_path / name, seed=seed, quiet=True).as_skill("inner")

    first = inner("in", 0)
    middle = declare(first, skill("c", linear())).train(tmp_path / "middle", quiet=True)
    run = declare(middle.as_skill("whole")).train(tmp_path / "out", quiet=True)
    weights = run.save_weights(tmp_path / "weights.safetensors")
    assert len(run.info()["skills"][0]["policy"]["sha256"]) == 64
    same = Hierarchy.load(declare(first, skill("c", linear())), tmp_path / "middle")
    assert acts(declare(same.as_skill("whole")).load(run.path).policy) == acts(run.policy)
    # Another selector, two levels below; then another torch module, another call length there.
    changed = [inner("seed", 1), inner("in 2", 0, linear(-WEIGHT))]
    changed.append(inner("in 3", 0))
    changed[2].policy.skills = replace(changed[2].policy.skills, call_steps=6)
    for one in changed:
        parts = [one.policy, middle.policy.skills.policies[1]]
        skills = skills_with(declare(one, skill("c", linear())), parts)
        outer = declare(skill("whole", HierarchyPolicy(middle.policy.selector, skills)))
        for read, path in (
            (outer.load, run.path),
            (outer.resume, run.path),
            (outer.load_weights, weights),
        ):
            with pytest.raises(SkillweaveError, match=r"'whole'.*policy.*another checksum"):
                read(path)


def test_a_policy_of_ones_own_class_is_only_named(tmp_path):
    class Own(Memoryless):
        observation_space = Box(-np.inf, np.inf, (4,), np.float32)
        action_space = gym.spaces.Discrete(2)

        def act(self, memory, obs, mask=None, *, deterministic=True, rng=None):
            return upright(obs), memory

    env = gym.make("CartPole-v1")
    Own.observation_space = env.observation_space
    run = declare(skill("own", Own())).train(tmp_path / "run", quiet=True)
    recorded = run.info()["skills"][0]["policy"]
    assert recorded == {"kind": "policy", "name": recorded["name"]}
    assert recorded["name"].endswith("Own")
    declare(skill("own", Own())).load(run.path)


def test_the_flat_baseline_leaves_foreign_skills_alone(tmp_path):
    run = declare(skill("a", linear())).train(tmp_path / "run", flat=True, quiet=True)
    assert {p.name for p in (run.path / "policies").iterdir()} == {"agent.safetensors"}
    declare(skill("a", linear(-WEIGHT))).load(run.path)


def test_what_does_not_fit_is_said_before_anything_is_written(tmp_path):
    for policy in (linear(np.zeros((8, 2))), lambda obs: obs, from_torch(linear(WEIGHT.T[:, :1]))):
        with pytest.raises(SkillweaveError, match="skill 'wrong'"):
            declare(skill("wrong", policy)).train(tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("space", [Box(-0.5, 0.5, (2,), np.float32), MultiDiscrete([2, 3])])
def test_other_actions_than_choices(tmp_path, space):
    width, seen = 2 if isinstance(space, Box) else 5, Box(-1.0, 1.0, (3,), np.float32)
    weight = np.random.default_rng(0).normal(size=(3, width))
    choose = (lambda obs: obs[:, :2]) if isinstance(space, Box) else None
    choose = choose or (lambda obs: (obs[:, :2] > 0).astype(int))
    skills = [skill("net", linear(weight)), skill("function", choose)]
    env = EnvSpec(lambda: World(seen, space), engine="sync", workers=1)
    for greedy in (True, False):
        h = declare(*skills, env=env, greedy_skills=greedy)
        run = h.train(tmp_path / str(greedy), quiet=True)
        assert acts(h.load(run.path).policy, 3)[0][1] == acts(run.policy, 3)[0][1]
        assert run.evaluate(3, skill="net") == h.load(run.path).evaluate(3, skill="net")
