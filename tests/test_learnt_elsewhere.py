"""What was learnt elsewhere acts as a skill; no training pretends to continue it."""

import copy
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch

import skillweave as sw
from skillweave.errors import DeclarationError

SMALL = sw.PPO(num_envs=2, n_steps=8)


def right(obs):
    return np.ones(len(obs), np.int64)


def module():
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 2))


def declare(*skills):
    return sw.Hierarchy("CartPole-v1", skills, algorithm=SMALL, selector=SMALL, steps=32)


def cloned(policy=right, **settings):
    return type("Cloned", (sw.Skill,), {"policy": policy, **settings})()


def with_later(skill, **settings):
    for name, value in settings.items():
        setattr(skill, name, value)
    return skill


class Ready(sw.Skill):
    policy = right


REFUSED = {
    "algorithm": (lambda: cloned(algorithm=SMALL), "algorithm"),
    "steps": (lambda: cloned(steps=100), "steps"),
    "task_weight": (lambda: cloned(task_weight=0.5), "task_weight"),
    "target_return": (lambda: cloned(target_return=10.0), "target_return"),
    "a module": (lambda: cloned(module(), steps=100), "steps"),
    "a policy": (lambda: cloned(sw.from_function(right), steps=100), "steps"),
    "several": (
        lambda: cloned(algorithm=SMALL, steps=9, target_success=0.5, success=Ready.termination),
        "algorithm and steps and target_success",
    ),
    "a subclass": (lambda: type("Further", (Ready,), {"algorithm": SMALL})(), "algorithm"),
    "set later": (lambda: with_later(Ready(), steps=100), "steps"),
    "policy first": (
        lambda: with_later(sw.Skill(), name="x", policy=right, algorithm=SMALL),
        r"algorithm would be ignored: leave out algorithm \(or .*skill\.algorithm = None\)",
    ),
    "policy last": (
        lambda: with_later(sw.Skill(), name="x", algorithm=SMALL, policy=right),
        r"algorithm would be ignored: leave out algorithm \(or .*skill\.algorithm = None\)",
    ),
}


@pytest.mark.parametrize(("make", "says"), REFUSED.values(), ids=REFUSED)
def test_a_skill_with_a_policy_takes_no_settings_of_training(make, says):
    with pytest.raises(DeclarationError, match=f"' has a policy.* its {says}"):
        declare(make())


class Trains(sw.Skill):
    algorithm = SMALL
    steps = 16

    def reward(self, step):
        return step.reward


def test_a_policy_that_comes_later_takes_the_place_of_a_training():
    class Later(Trains):
        policy = right

    freed = with_later(sw.Skill(), name="x", policy=right, algorithm=SMALL)
    freed.algorithm = None
    for skill in (Later(), with_later(Trains(), policy=right), freed):
        declared = declare(skill)
        assert [stage.kind for stage in declared.stages()] == ["selector"]
        declared.scale(0.5)
        declared.validate()


class Model:
    """As a model of Stable-Baselines3."""

    policy = module()
    observation_space = None

    def predict(self, obs):
        return right(obs)


ELSEWHERE = {
    "zip": ("models/best.zip", r"policy = sw.from_sb3\('models/best.zip', \"ppo\", trust=True\)"),
    "onnx": ("models/best.onnx", r"policy = sw.from_onnx\('models/best.onnx'\)"),
    "pt": ("models/best.pt", "policy = the torch module with these weights"),
    "weights": ("models/best.safetensors", "start from the run that it was written from"),
    "model": (Model(), r"policy = sw.from_sb3\(model\)"),
    "module": (module(), r"policy = module; to train .*learn=True.*Network\(encoder=function\)"),
    "function": (right, "policy = this one"),
}


@pytest.mark.parametrize(("value", "way"), ELSEWHERE.values(), ids=ELSEWHERE)
@pytest.mark.parametrize("named", [False, True])
def test_start_from_shows_the_way_of_what_is_no_run(tmp_path, value, way, named):
    start, argument = ({"agent": value}, r"start_from\['agent'\]") if named else (value, "start_")
    with pytest.raises(DeclarationError, match=f"{argument}.*only from what a run.*{way}"):
        sw.train_agent("CartPole-v1", SMALL, 16, tmp_path / "run", start_from=start, quiet=True)
    assert not (tmp_path / "run").exists()


def test_a_file_may_lack_its_ending_and_a_run_may_be_called_anything(tmp_path):
    (tmp_path / "best.zip").write_bytes(b"")
    with pytest.raises(DeclarationError, match=r"best.zip', \"ppo\""):
        sw.train_agent("CartPole-v1", SMALL, 16, start_from=tmp_path / "best", quiet=True)
    there = tmp_path / "first.zip"
    run = sw.train_agent("CartPole-v1", SMALL, 16, there, quiet=True)
    sw.train_agent("CartPole-v1", SMALL, 16, tmp_path / "run", start_from=there, quiet=True)
    with pytest.raises(DeclarationError, match=r"'moves' has a policy.* its steps would be"):
        declare(run.as_skill("moves", steps=10))


LEARNT = module()


def body(space):
    """Return what stands before the last layer, as start_from's message proposes."""
    return copy.deepcopy(LEARNT[:-1])


def test_a_module_learns_on_as_an_encoder(tmp_path):
    how = sw.PPO(num_envs=2, n_steps=8, network=sw.Network((), encoder=body), normalize_obs=False)
    run = sw.train_agent("CartPole-v1", how, 16, tmp_path / "run", quiet=True)
    weights = run.policy.weights
    name = next(k for k in weights if k.startswith("actor.encoder") and weights[k].ndim == 2)
    moved = (weights[name] - LEARNT[0].weight).abs().max()
    assert 0 < moved < 0.1


@pytest.mark.slow
def test_a_zip_of_stable_baselines_acts_as_proposed(tmp_path, monkeypatch):
    sb3 = pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    model = sb3.PPO("MlpPolicy", "CartPole-v1", n_steps=64)
    model.save("best.zip")
    with pytest.raises(sw.SkillweaveError) as error:
        sw.train_agent("CartPole-v1", SMALL, 16, "run", start_from="best.zip", quiet=True)
    proposal = str(error.value).partition("skill of a hierarchy: ")[2].partition("; to train")[0]
    space = {"sw": sw}
    exec(proposal.replace("): policy", "):\n    policy"), space)
    run = declare(space["Ready"]()).train("run", quiet=True)
    assert run.evaluate(1, quiet=True).mean > 0


@pytest.mark.parametrize("part", [np.s_[:, 4:], np.s_[:, :3:-1]], ids=["part", "in reverse"])
def test_a_run_may_act_in_a_policy_of_ones_own(part, tmp_path):
    """What a skill's ``policy`` is given cannot be written to; a run takes any part of it."""
    arm = sw.train_agent("CartPole-v1", SMALL, 64, tmp_path / "arm", quiet=True)

    class Twice(gym.ObservationWrapper):
        def __init__(self, env):
            super().__init__(env)
            self.observation_space = gym.spaces.Box(-np.inf, np.inf, (8,), np.float32)

        def observation(self, obs):
            return np.concatenate([obs, obs])

    class Arm(sw.Skill):
        def policy(self, obs):
            return arm.policy.act(arm.policy.start(len(obs)), obs[part])[0]

    spec = sw.EnvSpec("CartPole-v1", wrappers=(Twice,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sw.Hierarchy(spec, [Arm()], steps=64, selector=SMALL).train(tmp_path / "run", quiet=True)
