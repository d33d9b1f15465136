"""Policies from elsewhere, each by itself; in a hierarchy: tests/hierarchy/test_foreign_skills."""

import sys
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from skills.foreign_models import WEIGHT, linear, onnx_file, poisoned, sb3_zip
from skills.mapped_models import onnx_model
from toys import World

from skillweave import Acts, evaluate, from_function, from_onnx, from_sb3, from_torch
from skillweave.errors import MissingExtra, PolicyError, RunError, SkillweaveError
from skillweave.skills import Skill, ready_policy
from skillweave.skills.foreign_policy import Foreign, as_recorded, fitted, source_of
from skillweave.skills.onnx_file import OnnxPolicy

OBS, ACTION = gym.make("CartPole-v1").observation_space, Discrete(2)
ROWS = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)


def lean(obs):
    return (obs @ WEIGHT).argmax(1)


def fit(policy, observation_space=OBS, action_space=ACTION):
    return fitted(policy, observation_space, action_space, "skill 'x'", "CartPole-v1")


def acts(policy, obs=ROWS, **how):
    return policy.act({}, obs, **how)[0]


# One line each --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def zip_file(tmp_path_factory):
    pytest.importorskip("stable_baselines3")
    return sb3_zip(tmp_path_factory.mktemp("sb3") / "ppo.zip")


def test_a_function_a_module_and_an_onnx_file_act_alike(tmp_path):
    pytest.importorskip("onnxruntime")
    for policy in (from_function(lean), from_torch(linear()), from_onnx(onnx_file(tmp_path / "x"))):
        found = fit(policy)
        assert (found.observation_space, found.action_space) == (OBS, ACTION)
        assert (policy.observation_space, policy.action_space) == (None, None)
        np.testing.assert_array_equal(acts(found), lean(ROWS))
        assert acts(found).dtype == np.int64


@pytest.mark.parametrize("batch", ["n", None, 1])
@pytest.mark.parametrize("whole", [False, True])
def test_an_onnx_file_takes_any_batch_or_one_at_a_time(tmp_path, batch, whole):
    pytest.importorskip("onnxruntime")
    path = onnx_file(tmp_path / "x.onnx", batch=batch, whole=whole)
    np.testing.assert_array_equal(acts(fit(from_onnx(path))), lean(ROWS))


def test_an_onnx_file_may_keep_its_weights_in_another_and_have_several_outputs(tmp_path):
    pytest.importorskip("onnxruntime")
    path = onnx_file(tmp_path / "x.onnx", apart=True)
    policy = from_onnx(path, output="action")
    (tmp_path / "w.data").unlink()
    np.testing.assert_array_equal(acts(fit(policy)), lean(ROWS))
    copied = fit(policy).restored(policy.content())
    np.testing.assert_array_equal(acts(copied), lean(ROWS))


def test_a_module_gets_the_parts_of_a_dict_by_name():
    class Net(torch.nn.Module):
        def forward(self, obs):
            return obs["speed"]

    space = Dict({"place": Discrete(3), "speed": Box(-1, 1, (2,))})
    obs = np.zeros(3, [("place", np.int64), ("speed", np.float32, (2,))])
    obs["speed"] = [[1, 0], [0, 1], [1, 0]]
    assert acts(fit(from_torch(Net()), space), obs).tolist() == [0, 1, 0]


def test_a_module_acts_as_the_copy_that_was_fitted_and_in_evaluation_mode():
    module = torch.nn.Sequential(linear(), torch.nn.Dropout(0.9))
    policy = fit(from_torch(module))
    assert module.training
    with torch.no_grad():
        module[0].weight[:] = 0.0
    np.testing.assert_array_equal(acts(policy), lean(ROWS))


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("name", ["ppo", "sac", "a2c", "dqn", "td3", "ddpg"])
def test_every_algorithm_of_sb3_acts_as_it_would_itself(tmp_path, name):
    sb3 = pytest.importorskip("stable_baselines3")
    kind, env, how = getattr(sb3, name.upper()), "CartPole-v1", {}
    if name in ("sac", "td3", "ddpg"):
        env, how = "Pendulum-v1", {"buffer_size": 1000}
    path = sb3_zip(tmp_path / "model.zip", name, env, **how)
    model = kind.load(path, device="cpu")
    spaces = model.observation_space, model.action_space
    obs = ROWS[:, : spaces[0].shape[0]]
    want = model.predict(obs, deterministic=True)[0]
    for policy in (from_sb3(path, name, trust=True), from_sb3(str(path), kind, trust=True)):
        np.testing.assert_allclose(acts(fit(policy, *spaces), obs), want, rtol=1e-6)


def test_images_that_sb3_has_turned_fit_the_environment_as_it_is(tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")
    seen = Box(0, 255, (40, 40, 3), np.uint8)
    model = sb3.A2C("CnnPolicy", World(seen, Discrete(3)), device="cpu")
    assert model.observation_space.shape == (3, 40, 40)
    policy = fit(from_sb3(model), seen, Discrete(3))
    assert policy.observation_space == seen
    obs = np.random.default_rng(0).integers(0, 255, (5, 40, 40, 3)).astype(np.uint8)
    np.testing.assert_array_equal(acts(policy, obs), model.predict(obs, deterministic=True)[0])


def test_sampling_follows_the_given_generator_and_leaves_the_global_one_alone(zip_file):
    for policy in (fit(from_sb3(zip_file, "ppo", trust=True)), fit(from_torch(linear(0 * WEIGHT)))):
        before = torch.get_rng_state()
        draws = [
            acts(policy, deterministic=False, rng=np.random.default_rng(s)).tolist()
            for s in (0, 0, 1)
        ]
        assert draws[0] == draws[1] != draws[2]
        assert torch.equal(torch.get_rng_state(), before)


# Trust ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("trust", [{}, {"trust": False}, {"trust": 1}, {"trust": "no"}])
def test_a_zip_is_not_opened_without_trust(tmp_path, trust, monkeypatch):
    pytest.importorskip("stable_baselines3")
    mark = tmp_path / "mark"
    path = poisoned(tmp_path / "evil.zip", mark)
    with pytest.raises(PolicyError, match=r"evil.zip was not opened.*pickle.*trust=True"):
        from_sb3(path, "ppo", **trust)
    assert not mark.exists()
    with monkeypatch.context() as patch:  # refusing needs nothing installed, and reads nothing
        patch.setitem(sys.modules, "stable_baselines3", None)
        (tmp_path / "nothing.zip").touch()
        with pytest.raises(PolicyError, match="trust=True"):
            from_sb3(tmp_path / "nothing.zip", "ppo", **trust)
    from_sb3(path, "ppo", trust=True)  # else the test would not show anything
    assert mark.exists()


GSDE = {
    "PPO": {"n_steps": 64, "policy_kwargs": {"log_std_init": -2.0}},  # few actions are clipped
    "SAC": {"learning_starts": 50},
}


@pytest.mark.parametrize("name", GSDE)
def test_a_model_with_gsde_acts_as_its_predict_and_samples_its_distribution(name):
    sb3 = pytest.importorskip("stable_baselines3")
    how = {"use_sde": True, "device": "cpu", "seed": 0} | GSDE[name]
    model = getattr(sb3, name)("MlpPolicy", "Pendulum-v1", **how).learn(128)
    policy = fit(from_sb3(model), model.observation_space, model.action_space)
    obs = ROWS[:, :3]
    greedy = model.predict(obs, deterministic=True)[0]
    np.testing.assert_allclose(acts(policy, obs), greedy, atol=1e-5)
    if name == "PPO":
        one = obs[:1].repeat(4000, 0)
        drawn = acts(policy, one, deterministic=False, rng=np.random.default_rng(0))
        std = model.policy.get_distribution(torch.tensor(obs[:1])).distribution.stddev.item()
        assert drawn.std() == pytest.approx(std, rel=0.05)


@pytest.mark.parametrize(
    ("space", "outputs", "chosen"),
    [  # shapes by name, of what exporters write
        (Box(-1, 1, (1,)), {"value": 1, "actions": 1}, "actions"),
        (Box(-1, 1, (1,)), {"mu": 1, "log_std": 1, "value": 1}, "mu"),
        (Box(-1, 1, (1,)), {"values": 1, "log_prob": 1, "28": 1}, "28"),
        (Box(-1, 1, (2,)), {"28": 1, "33": 2}, "33"),
        (
            Box(-1, 1, (2,)),
            {
                "continuous_action_output_shape": 2,
                "continuous_actions": 2,
                "deterministic_discrete_actions": 1,
                "deterministic_continuous_actions": 2,
            },
            "deterministic_continuous_actions",
        ),
        (Discrete(2), {"critic": 2, "action": 2, "logits": 2}, "logits"),
        (Discrete(2), {"value": 1, "q_values": 2}, "q_values"),
    ],
)
def test_the_output_of_the_actions_is_known_by_its_name_or_shape(tmp_path, space, outputs, chosen):
    pytest.importorskip("onnxruntime")
    nodes = [("MatMul", ["obs", f"w.{name}"], [name]) for name in outputs]
    constants = {f"w.{name}": np.zeros((4, n), np.float32) for name, n in outputs.items()}
    shapes = {name: ["n", n] for name, n in outputs.items()}
    path = onnx_model(tmp_path / "x.onnx", nodes, {"obs": ["n", 4]}, shapes, constants)
    assert fit(from_onnx(path), OBS, space).output == chosen


def test_outputs_that_nothing_tells_apart_are_named(tmp_path):
    pytest.importorskip("onnxruntime")
    nodes = [("Identity", ["obs"], [name]) for name in "ab"]
    path = tmp_path / "x.onnx"
    onnx_model(path, nodes, {"obs": ["n", 4]}, {"a": ["n", 4], "b": ["n", 4]}, {})
    with pytest.warns(UserWarning, match="a, b"):
        assert fit(from_onnx(path), OBS, OBS).output == "a"
    assert fit(from_onnx(path, output="b"), OBS, OBS).output == "b"


# What does not fit ----------------------------------------------------------------------------


EIGHT, FIVE = Box(-1, 1, (8,)), Discrete(5)
PARTS = Dict({"place": Box(-1, 1, (3,)), "speed": Box(-1, 1, (1,))})


class Pair(torch.nn.Module):
    def forward(self, obs):
        return obs, obs


class Recurrent(torch.nn.Module):
    def forward(self, obs, state):
        return obs, state


def broken(obs):
    return obs["speed"]


WRONG = [  # a policy, where it is tried, and words
    ("zip", (EIGHT, ACTION), (str(OBS), str(EIGHT))),
    ("zip", (OBS, FIVE), ("Discrete(2)", "Discrete(5)", "let acts= say")),
    ("zip", (PARTS, ACTION), ("let sees= give the parts",)),
    ("file", (EIGHT, ACTION), ("shape (4)", str(EIGHT))),
    ("file", (OBS, FIVE), ("(2, 2)", "Discrete(5)")),
    (from_torch(linear()), (EIGHT, ACTION), ("module Linear", str(EIGHT))),
    (from_torch(linear()), (OBS, FIVE), ("Discrete(5)",)),
    (from_torch(linear()), (PARTS, ACTION), ("let sees= give the parts",)),
    (
        from_torch(linear(), sees=("place",)),
        (PARTS, ACTION),
        ("the inputs that sees gives, 3 numbers (place 3)",),
    ),
    (from_torch(Recurrent()), (OBS, ACTION), ("needs state=",)),
    (from_torch(Pair()), (OBS, ACTION), ("module Pair returned a tuple",)),
    (from_function(lean, action_space=Discrete(3)), (OBS, ACTION), ("Discrete(3)",)),
    (from_function(broken), (OBS, ACTION), ("function broken() raised IndexError",)),
    (
        from_function(lambda obs: obs),
        (OBS, ACTION),
        ("function <lambda>() returned shape (2, 4)",),
    ),
]


@pytest.mark.parametrize(("policy", "spaces", "words"), WRONG)
def test_what_does_not_fit_is_named(policy, spaces, words, zip_file, tmp_path):
    pytest.importorskip("onnxruntime")
    if policy == "zip":
        policy = from_sb3(zip_file, "ppo", trust=True)
    elif policy == "file":
        policy = from_onnx(onnx_file(tmp_path / "x.onnx"))
    with pytest.raises(SkillweaveError, match="skill 'x'") as raised:
        fit(policy, *spaces)
    assert all(word in str(raised.value) for word in words)


def test_actions_with_other_bounds_are_said_once_and_acts_settles_it(recwarn):
    sb3 = pytest.importorskip("stable_baselines3")
    model = sb3.A2C("MlpPolicy", "Pendulum-v1", device="cpu")  # actions from -2 to 2
    seen, wide = model.observation_space, Box(-40, 40, (1,))
    for policy in (from_sb3(model), from_sb3(model, sees=slice(0, 3))):
        with pytest.warns(UserWarning, match="clipped") as said:
            fit(policy, seen, wide)
        text = str(said[0].message)
        assert str(model.action_space) in text
        assert str(wide) in text
        assert "acts=Acts(scale=...)" in text
    with pytest.warns(UserWarning, match="clipped"):
        evaluate(from_torch(torch.nn.Linear(3, 1), action_space=wide), "Pendulum-v1", episodes=1)
    recwarn.clear()
    fit(from_sb3(model), seen, Box(-2, 2, (1,), np.float64))
    fit(from_sb3(model), seen, Box(-np.inf, np.inf, (1,)))
    fit(from_sb3(model, acts=Acts(scale=20)), seen, wide)
    fit(from_sb3(model, acts=Acts()), seen, wide)
    assert [str(w.message) for w in recwarn if "clipped" in str(w.message)] == []


def test_wrong_files_are_named(tmp_path):
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("onnxruntime")
    (tmp_path / "junk").write_bytes(b"junk")
    for make, match in [
        (lambda: from_sb3(tmp_path / "junk", "ppo", trust=True), "junk could not be opened.*PPO"),
        (lambda: from_sb3(tmp_path / "none", "ppo", trust=True), "none does not exist"),
        (lambda: from_sb3(tmp_path / "junk", trust=True), "algorithm is None.*ppo, a2c"),
        (lambda: from_sb3(tmp_path / "junk", "ppoo", trust=True), "'ppoo'"),
        (lambda: from_sb3(3), "neither"),
        (lambda: from_torch(torch.nn.Linear), "made of its class"),
        (lambda: from_function(3), "not 3"),
        (lambda: from_onnx(tmp_path / "junk"), "junk is no ONNX model|junk cannot be run"),
        (lambda: from_onnx(tmp_path / "none"), "none does not exist"),
        (lambda: from_onnx(onnx_file(tmp_path / "x", batch=7)), "exactly 7.*dynamic"),
        (lambda: from_onnx(onnx_file(tmp_path / "x"), output="y"), "no output 'y'.*logits, action"),
    ]:
        with pytest.raises(SkillweaveError, match=match):
            make()


def test_a_zip_that_cannot_be_opened_says_what_it_may_be(zip_file, tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")
    with pytest.raises(PolicyError, match="Did another algorithm save it"):
        from_sb3(zip_file, "sac", trust=True)
    with zipfile.ZipFile(zip_file) as old, zipfile.ZipFile(tmp_path / "new.zip", "w") as new:
        for name in old.namelist():
            content = b"9.1.0" if name == "_stable_baselines3_version" else old.read(name)
            new.writestr(name, b"{" if name == "data" else content)
    newer = rf"saved by Stable-Baselines3 9.1.0, and {sb3.__version__} is installed: install"
    with pytest.raises(PolicyError, match=newer):
        from_sb3(tmp_path / "new.zip", "ppo", trust=True)
    (tmp_path / "text.zip").write_text("no zip")
    with pytest.raises(PolicyError, match="It is no zip of Stable-Baselines3"):
        from_sb3(tmp_path / "text.zip", "ppo", trust=True)


@pytest.mark.parametrize(
    ("module", "extra", "make"),
    [
        ("stable_baselines3", "sb3", lambda path: from_sb3(path, "ppo", trust=True)),
        ("onnx", "onnx", from_onnx),
        ("onnxruntime", "onnx", lambda path: from_onnx(onnx_file(path))),
    ],
)
def test_a_missing_extra_is_named(module, extra, make, monkeypatch, tmp_path):
    if module == "onnxruntime":
        pytest.importorskip("onnx")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtra, match=rf"skillweave\[{extra}\]"):
        make(tmp_path / "file")


# What may stand after ``policy =`` ------------------------------------------------------------


def test_functions_methods_and_modules_become_policies():
    class Bare(Skill):
        policy = lean

    class Static(Skill):
        policy = staticmethod(lean)

    class Method(Skill):
        def policy(self, obs):
            assert isinstance(self, Method)
            return lean(obs)

    class Module(Skill):
        policy = linear()

    class Inherited(Bare):
        pass

    set_later = Skill()
    set_later.policy = lean
    with_option = Skill()
    with_option.policy = lambda obs, gain=1: lean(gain * obs)
    for skill in (Bare(), Static(), Method(), Module(), Inherited(), set_later, with_option):
        policy = fit(ready_policy(skill))
        assert isinstance(policy, Foreign)
        np.testing.assert_array_equal(acts(policy), lean(ROWS))
    assert ready_policy(Skill()) is None


# What a run remembers -------------------------------------------------------------------------


def test_sources_say_where_policies_come_from(zip_file, tmp_path):
    pytest.importorskip("onnxruntime")
    file = onnx_file(tmp_path / "x.onnx")
    found = [source_of(p) for p in (from_function(lean), from_torch(linear()), from_onnx(file))]
    assert [s.kind for s in found] == ["function", "torch", "onnx"]
    assert found[0].name.endswith("test_foreign_policy.lean")
    assert found[1].name == "torch.nn.modules.linear.Linear"
    assert found[2].file == str(file)
    zipped = source_of(from_sb3(zip_file, "ppo", trust=True))
    assert (zipped.kind, zipped.name, zipped.file) == ("sb3", "PPO", str(zip_file))
    assert [len(s.sha256 or "") for s in (*found, zipped)] == [0, 64, 64, 64]


def test_a_copy_that_is_damaged_or_missing_is_said():
    then, now = fit(from_torch(linear())), fit(from_torch(linear(2 * WEIGHT)))

    def load(policy, content):
        return as_recorded(policy, source_of(then), lambda: content, "runs/x: skill 'x'")

    assert load(now, then.content()).source() == then.source()
    assert now.source() != then.source()
    with pytest.raises(SkillweaveError, match=r"runs/x: skill 'x': the copy.*damaged"):
        load(now, b"junk")
    with pytest.raises(SkillweaveError, match=r"runs/x.*torch .*Linear.*another checksum"):
        load(now, None)


def test_a_file_of_a_skill_is_read_once_and_its_errors_name_the_skill(tmp_path):
    pytest.importorskip("onnxruntime")
    path = onnx_file(tmp_path / "x.onnx")

    class Lean(Skill):
        policy = str(path)

    skill = Lean()
    first = ready_policy(skill)
    assert isinstance(first, OnnxPolicy)
    assert ready_policy(skill) is first
    Lean.policy = str(tmp_path / "nowhere.onnx")
    with pytest.raises(RunError, match=r"skill 'lean': policy: .*nowhere\.onnx does not exist"):
        ready_policy(Lean())
