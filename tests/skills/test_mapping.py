"""Mappings as data: what they accept, what they refuse, and what a run records of them."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete
from skills.mapped_models import ACTION, SPACE, fit, observations, onnx_model, weights

import skillweave as sw
from skillweave.errors import DeclarationError, PolicyError, RunError
from skillweave.schema import as_json
from skillweave.skills.foreign_policy import Source, as_recorded, source_of
from skillweave.skills.goals import Goals
from skillweave.skills.mapping import PolicyMapping
from skillweave.spaces import obs_codec, obs_dtype, to_tensor
from skillweave.types import Array


def seen(sees, space=SPACE, obs=None, **more) -> Array:
    """The input that a policy with this ``sees`` gets."""
    found = []

    def look(x: Array) -> Array:
        found.append(x)
        return np.zeros((len(x), 5))

    policy = sw.from_function(look, sees=sees, **more).bind(space, ACTION, "it")
    policy.act(policy.start(2), observations(2, 1)[0] if obs is None else obs)
    return found[0]


# What a policy sees


def test_places_count_as_those_of_a_network_do():
    obs = observations(2, 1)[0]
    flat = obs_codec(SPACE).split(to_tensor(obs))[0].numpy()  # as networks see it
    np.testing.assert_allclose(seen((11, 0, 8, 9, 58)), flat[:, [11, 0, 8, 9, 58]])
    np.testing.assert_allclose(seen((slice(2, 12), 0)), flat[:, [*range(2, 12), 0]])
    np.testing.assert_allclose(seen(sw.Part()), flat)
    np.testing.assert_allclose(seen(sw.Part("arm")), flat[:, :8])
    np.testing.assert_allclose(seen(sw.Part("arm", (7, 0))), flat[:, [7, 0]])
    pairs = tuple(float(i) for i in range(9))
    scaled = sw.Part(places=slice(2, 11), scale=pairs, offset=pairs)
    np.testing.assert_allclose(seen((scaled, 0))[:, :9], (flat[:, 2:11] - pairs) * pairs, rtol=1e-5)


def test_keys_name_parts_and_choices_may_stay_numbers():
    obs = observations(2, 1)[0]
    np.testing.assert_array_equal(seen("state"), obs["state"])  # one word is enough
    np.testing.assert_array_equal(seen(("state", "gyro"))[:, 48:], obs["gyro"])
    grip = seen((sw.Part("arm.grip", one_hot=False), "gyro"))[:, 0]
    np.testing.assert_array_equal(grip, obs["arm"]["grip"])
    pair = Dict({"a": MultiDiscrete([2, 3], start=[1, 0])})
    packed = np.array([([2, 1],), ([1, 2],)], [("a", np.int64, (2,))])
    assert seen("a", pair, packed).tolist() == [[0, 1, 0, 1, 0], [1, 0, 0, 0, 1]]


def test_an_image_alone_keeps_its_shape():
    space = Dict({"camera": Box(0, 255, (20, 20, 3), np.uint8), "speed": Box(-1, 1, (2,))})
    obs = np.zeros(2, [("camera", np.uint8, (20, 20, 3)), ("speed", np.float32, (2,))])
    obs["camera"][:] = np.random.default_rng(0).integers(0, 255, (2, 20, 20, 3))
    np.testing.assert_array_equal(seen("camera", space, obs), obs["camera"])
    scaled = seen(sw.Part("camera", scale=1 / 255), space, obs)
    np.testing.assert_allclose(scaled, obs["camera"] / 255)
    assert seen(sw.Part(), space, obs).shape == (2, 2)  # as of a network: without images
    films = Dict({"eyes": Dict({"l": space["camera"], "r": space["camera"]})})
    with pytest.raises(PolicyError, match="'eyes', which has images alone: name one of them"):
        sw.from_function(zeros, sees="eyes").bind(films, ACTION, "it")


def test_a_goal_that_is_given_to_act_replaces_the_fixed_one():
    found = []

    def look(x: Array) -> Array:
        found.append(x[:, :2].tolist())
        return np.zeros((len(x), 5))

    policy = fit(sw.from_function(look, sees=(sw.Goal(scale=2), "gyro"), goal=(1, 2)))
    obs = observations(2, 1)[0]
    policy.act({}, obs)
    policy.act({}, obs, goal=np.array([[3, 4], [5, 6]]))
    assert found[-2:] == [[[2, 4], [2, 4]], [[6, 8], [10, 12]]]


def test_goals_and_computed_numbers_keep_their_number():
    width = 2

    def grows(obs: Array) -> Array:
        return np.zeros((len(obs), width))

    policy = fit(sw.from_function(zeros, sees=("gyro", sw.Goal()), goal=(1, 2)))
    with pytest.raises(PolicyError, match=r"the goal has shape \(2, 3\), but \(2,\) was"):
        policy.act({}, observations(2, 1)[0], goal=np.zeros((2, 3)))
    for how in ({"sees": ("gyro", grows)}, {"sees": sw.Goal(), "goal": grows}):
        width = 2
        policy = fit(sw.from_function(zeros, **how))
        width = 3
        with pytest.raises(PolicyError, match=r"returned numbers of shape \(3,\).*\(2,\) at first"):
            policy.act({}, observations(2, 1)[0])
    with pytest.raises(PolicyError, match="returned a NaN or an infinity"):
        fit(sw.from_function(lambda x: zeros(x) * np.nan, acts=sw.Acts(clip=(-1, 1))))


def test_what_is_remembered_is_no_array_of_the_users():
    arrays = {n: (np.zeros((n, 1)), np.zeros((n, 5))) for n in range(1, 9)}

    def counts(x: Array, state: Array):
        kept, out = arrays[len(x)]  # the same arrays at each call
        kept[:] = state + 1
        out[:] = kept / 100 + x[:, 3:] / 10
        return out, kept

    policy = sw.from_function(counts, sees=("gyro", sw.LastAction()), state=(None, 1))
    policy = policy.bind(SPACE, ACTION, "it")
    memory, obs = policy.start(2), observations(2, 1)[0]
    _, first = policy.act(memory, obs)
    _, second = policy.act(first, obs)
    assert first["state.0"].tolist() == [[1], [1]]
    assert second["state.0"].tolist() == [[2], [2]]
    assert first["last"].max() < second["last"].max()

    def changes(x: Array, state: Array):
        state += 1
        return zeros(x), state

    with pytest.raises(PolicyError, match=r"changes\(\) raised ValueError.*read-only"):
        fit(sw.from_function(changes, state=(None, 1)))


def test_a_module_that_takes_the_goal_of_its_skill_is_copied_too():
    module = torch.nn.Linear(5, 5)
    skill = type("Go", (sw.Skill,), {"goal_space": Box(-1, 1, (2,))})()
    policy = sw.from_torch(module, sees=("gyro", sw.Goal()))
    bound = policy.bind_with_goals(SPACE, ACTION, "it", Goals(skill))
    obs = np.zeros(2, obs_dtype(bound.observation_space))
    before = bound.act(bound.start(2), obs)[0]
    with torch.no_grad():
        module.bias.add_(1.0)
    np.testing.assert_array_equal(bound.act(bound.start(2), obs)[0], before)


def test_a_program_of_torch_export_acts_with_a_batch_or_without(tmp_path):
    class Two(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.w = torch.nn.Parameter(torch.from_numpy(weights(3, 5)))

        def forward(self, obs: torch.Tensor, command: torch.Tensor) -> torch.Tensor:
            return obs @ self.w + command[:, :1]

    module, rows = Two(), torch.export.Dim("rows")
    given = torch.zeros(2, 3), torch.zeros(2, 1)
    free = torch.export.export(module, given, dynamic_shapes=({0: rows}, {0: rows}))
    single = torch.export.export(module, (torch.zeros(1, 3), torch.zeros(1, 1)))
    for name, program in (("free", free), ("single", single)):
        torch.export.save(program, tmp_path / f"{name}.pt2")
        policy = fit(
            sw.from_torch(
                tmp_path / f"{name}.pt2",
                trust=True,
                sees={"command": sw.Goal(), "obs": "gyro"},
                goal=0.5,
            )
        )
        obs = observations(3, 1)[0]
        wanted = np.clip(obs["gyro"] @ weights(3, 5) + 0.5, -2, 2)
        np.testing.assert_allclose(policy.act({}, obs)[0], wanted, atol=1e-6)
        again = pickle.loads(pickle.dumps(policy))  # as it is sent to another process
        np.testing.assert_array_equal(again.act({}, obs)[0], policy.act({}, obs)[0])


@pytest.mark.parametrize("kwargs", [{}, {"trust": 1}])
def test_files_that_can_run_code_are_not_opened_without_trust(kwargs, tmp_path):
    with pytest.raises(PolicyError, match=r"x.pt was not opened.*trust=True"):
        sw.from_torch(tmp_path / "x.pt", **kwargs)
    pytest.importorskip("stable_baselines3")
    with pytest.raises(PolicyError, match=r"normal.pkl was not opened.*trust=True"):
        sw.from_sb3(a_model(), normalize=tmp_path / "normal.pkl", **kwargs)


def test_statistics_of_another_model_are_refused(tmp_path):
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    other = VecNormalize(make_vec_env("Pendulum-v1"))
    other.save(str(tmp_path / "other.pkl"))
    (tmp_path / "junk.pkl").write_bytes(b"junk")
    for name in ("other", "junk"):
        with pytest.raises(PolicyError, match=rf"{name}.pkl could not be opened as the VecNormal"):
            sw.from_sb3(a_model(), normalize=tmp_path / f"{name}.pkl", trust=True)
    with pytest.raises(RunError, match=r"none.pkl does not exist"):
        sw.from_sb3(a_model(), normalize=tmp_path / "none.pkl", trust=True)
    with pytest.raises(DeclarationError, match="normalize is 3; it must be the VecNormalize"):
        sw.from_sb3(a_model(), normalize=3)
    with pytest.raises(DeclarationError, match="statistics of observations Box"):
        sw.from_sb3(a_model(), normalize=other)


def test_statistics_that_a_model_has_are_used_and_a_file_beside_its_zip_is_named(tmp_path, recwarn):
    pytest.importorskip("stable_baselines3")
    import stable_baselines3 as sb3
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    vec = VecNormalize(make_vec_env("Pendulum-v1"), norm_reward=False)
    vec.obs_rms.mean[:], vec.obs_rms.var[:], vec.obs_rms.count = (1, 2, 3), (4, 5, 6), 100.0
    model = sb3.A2C("MlpPolicy", vec, device="cpu")
    spaces = model.observation_space, model.action_space
    obs = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    for more, seen in (({}, vec.normalize_obs(obs)), ({"normalize": False}, obs)):
        acted = fit(sw.from_sb3(model, **more), *spaces).act({}, obs)[0]
        wanted = model.predict(seen, deterministic=True)[0]
        np.testing.assert_allclose(acted, wanted, atol=1e-5)
    vec.norm_obs = False
    assert sw.from_sb3(model, learn=True).scaling is None
    model.save(tmp_path / "a.zip")
    vec.save(str(tmp_path / "my_VecNormalize.pkl"))
    for more, notices in (({}, 1), ({"normalize": False}, 0)):
        recwarn.clear()
        sw.from_sb3(tmp_path / "a.zip", "a2c", trust=True, **more)
        assert sum("my_VecNormalize.pkl" in str(each.message) for each in recwarn) == notices


def a_model():
    import stable_baselines3 as sb3

    return sb3.A2C("MlpPolicy", "CartPole-v1", device="cpu")


def test_weights_alone_are_no_module(tmp_path):
    for name, content in (("s.pt", torch.nn.Linear(2, 2).state_dict()), ("m.pt", torch.nn.ReLU())):
        torch.save(content, tmp_path / name)
        with pytest.raises(PolicyError, match=rf"{name} holds neither.*from_torch\(module\)"):
            sw.from_torch(tmp_path / name, trust=True)
    (tmp_path / "x.pt").write_bytes(b"nothing")
    with pytest.raises(PolicyError, match=r"x.pt holds neither"):
        sw.from_torch(tmp_path / "x.pt", trust=True)


# What is refused


def zeros(x: Array) -> Array:
    return np.zeros((len(x), 5))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sees": ()}, r"from_function\(\): sees is empty"),
        ({"sees": ("gyro", 1.5)}, r"sees\[1\] is 1.5; it must be the key"),
        ({"sees": ("gyro", sw.Goal)}, r"sees\[1\] is the class Goal; write Goal\(\)"),
        ({"sees": {"": "gyro"}}, "the names of the policy's inputs"),
        ({"sees": (0, -1)}, r"Part.places is .*counted from 0"),
        ({"acts": [[0], [1, 2]]}, r"Acts.to is \[\[0\], \[1, 2\]\]; .*counted from 0"),
        ({"sees": "gyro", "goal": 1.0}, r"does not take it: write Goal\(\)"),
        (
            {"sees": sw.Goal(high=0.5), "goal": 1.0},
            r"goal is \(1.0,\), out of the range.*Goal.high",
        ),
        ({"sees": sw.Goal(), "goal": "north"}, "goal is 'north'; it must be finite numbers"),
        ({"every": 0}, "every is 0; it must be at least 1 and at most"),
        ({"chunk": True}, "chunk is True"),
        ({"state": (1, 64)}, "state is .*None as the axis of the environments"),
        ({"acts": 1.5}, r"acts is 1.5; it must be Acts\(\.\.\.\)"),
        ({"acts": (0, 0)}, "each place of an action can be written once"),
    ],
)
def test_arguments_that_no_environment_could_fit(arguments, message):
    with pytest.raises(DeclarationError, match=message):
        sw.from_function(zeros, **arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"sees": ("gyro", "gyroo")},
            r"sees\[1\] reads 'gyroo', which the observation does not ha",
        ),
        (
            {"sees": sw.Part("gyro", slice(0, 4))},
            r"sees.places is slice\(0, 4.*there are 3 numbers",
        ),
        ({"sees": (60,)}, "there are 59 numbers, at places 0 to 58"),
        ({"sees": sw.Part("gyro", scale=(1, 2))}, "sees.scale has 2 numbers, but it scales 3"),
        ({"sees": ("gyro", sw.Goal())}, r"sees\[1\] is Goal\(\), but there is no goal: give goal="),
        ({"sees": ("gyro", lambda obs: 3)}, r"sees\[1\], a function, returned"),
        ({"acts": sw.Acts(to=(0, 5))}, r"acts.to is \(0, 5\), a part of the action that does not "),
        ({"acts": sw.Acts(to=(0, 1))}, r"acts writes 2 of 5 numbers.*rest=0.0"),
        ({"acts": sw.Acts(rest=0.0)}, "acts has rest, but its outputs are all numbers"),
        ({"acts": sw.Acts(to=(0, 1), rest=(1, 2))}, "acts.rest has 2 numbers, but it scales 3"),
        ({"acts": sw.Acts(scale=(1, 2))}, "acts.scale has 2 numbers"),
        ({"acts": sw.Acts(to=(0, 1), rest=0.0)}, r"returned float64 of shape \(2, 5\).*\(2, 2\)"),
        ({"chunk": 8}, r"returned shape \(2, 5\), but chunk=8 needs \(n, 8, ...\)"),
        ({"state": (None, 3)}, "returned a ndarray; with a state it must return two values"),
    ],
)
def test_what_does_not_fit_the_environment_names_skill_and_field(arguments, message):
    def act(x: Array, *state) -> Array:
        return np.zeros((len(x), 5))

    if "acts" in arguments and arguments["acts"].to == (0, 1) and arguments["acts"].rest == (1, 2):
        message = "acts.rest has 2 numbers"
    with pytest.raises(PolicyError, match=rf"skill 'walk': function act\(\).*{message}"):
        fit(sw.from_function(act, **arguments))


def test_mappings_that_actions_of_a_kind_do_not_have():
    def choose(x: Array) -> Array:
        return np.zeros(len(x), int)

    for policy, space, message in (
        (sw.from_function(choose, acts=sw.Acts(scale=2)), Discrete(3), "choices of Discrete"),
        (sw.from_function(choose, acts=(0, 1)), MultiDiscrete([2, 2]), "needs actions of a Box or"),
        (
            sw.from_function(choose, acts=(3,)),
            Discrete(3),
            r"acts.to is \(3,\), a part .*not exist",
        ),
        (sw.from_function(choose, sees=sw.LastAction()), Discrete(3), r"LastAction\(\), which nee"),
    ):
        with pytest.raises(PolicyError, match=message):
            fit(policy, SPACE, space)
    with pytest.raises(PolicyError, match="the observation is no Dict"):
        fit(sw.from_function(choose, sees="gyro"), Box(-1, 1, (3,)), Discrete(2))


def test_inputs_that_stay_unset_are_named(tmp_path):
    pytest.importorskip("onnxruntime")
    one = onnx_model(
        tmp_path / "one.onnx",
        [("MatMul", ["obs", "w"], ["a"])],
        {"obs": ["n", 48]},
        {"a": ["n", 5]},
        {"w": weights(48, 5)},
    )
    with pytest.raises(PolicyError, match=r"'walk': .*one.onnx takes observations of shape \(48\)"):
        fit(sw.from_onnx(one), Box(-1, 1, (45,)))
    with pytest.raises(
        PolicyError, match=r"45 numbers \(state 45\), but the policy takes 48: 3 st"
    ):
        fit(sw.from_onnx(one, sees=sw.Part("state", slice(0, 45))))
    with pytest.raises(PolicyError, match=r"51 numbers \(state 48, gyro 3\), .* takes 48"):
        fit(sw.from_onnx(one, sees=("state", "gyro")))
    fit(sw.from_onnx(one, sees="state"))
    two = onnx_model(
        tmp_path / "two.onnx",
        [("MatMul", ["obs", "w"], ["b"]), ("Add", ["b", "more"], ["a"])],
        {"obs": ["n", 48], "more": ["n", 5]},
        {"a": ["n", 5]},
        {"w": weights(48, 5)},
    )
    with pytest.raises(PolicyError, match=r"two.onnx takes obs .*more.*sees=\{'obs': ..., ...\}"):
        sw.from_onnx(two)
    with pytest.raises(PolicyError, match="sees does not set the input 'more'; the policy takes"):
        fit(sw.from_onnx(two, sees={"obs": "state"}))
    with pytest.raises(
        PolicyError, match=r"an input 'mor', which the policy does not take.*'more'"
    ):
        fit(sw.from_onnx(two, sees={"obs": "state", "mor": "arm.joints", "more": "arm.joints"}))
    with pytest.raises(PolicyError, match=r"has no output 'after' \(state\); it has: a"):
        sw.from_onnx(two, sees="state", state={"more": "after"})
    with pytest.raises(DeclarationError, match="name the inputs and outputs of the file"):
        sw.from_onnx(two, sees="state", state=(None, 5))


# What is recorded


def ramp(obs: Array) -> Array:
    return obs["gyro"] * 2


def test_a_mapping_is_read_back_from_json():
    mapping = sw.from_function(
        zeros,
        sees={
            "a": (sw.Part("state", slice(None, -3, 2), scale=[1, 2], clip=(-1, 1)), "gyro", 3),
            "b": (sw.Goal(low=-1, high=(1, 2)), sw.LastAction(offset=2), ramp),
        },
        goal=ramp,
        acts=sw.Acts(to=(3, 1), scale=2, rest=(1, 2, 3)),
        every=3,
        chunk=4,
        state=(2, None, 3),
    ).mapping
    data = json.loads(json.dumps(mapping.to_json()))
    assert PolicyMapping.from_json(data, mapping.functions()) == mapping
    assert PolicyMapping.from_json({}) == PolicyMapping()
    with pytest.raises(DeclarationError, match=r"needs the function .*ramp.*give it in code"):
        PolicyMapping.from_json(data)
    one, two = (lambda obs, k=k: obs["gyro"] * k for k in (1.0, 2.0))  # of one name
    mapping = sw.from_function(zeros, sees=(one, two, one, sw.Goal()), goal=two).mapping
    assert len(mapping.functions()) == 2
    data = json.loads(json.dumps(mapping.to_json()))
    assert PolicyMapping.from_json(data, mapping.functions()) == mapping


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("sees", [], "sees is .*it must be a dict"),
        ("sees", {"": [{"source": "camera"}]}, r"sees\[''\]\[0\] is .*its field source must be"),
        ("sees", {"": [{"source": "goal", "low": "x"}]}, r"sees\[''\]\[0\]: Goal.low is 'x'"),
        ("acts", {"to": [0, -1]}, r"acts: Acts.to is \[0, -1\]"),
        ("every", 0, "every is 0"),
        ("state", 3, "state is 3"),
        ("goal", [None], "goal is "),
    ],
)
def test_fields_of_a_file_are_checked(field, value, message):
    with pytest.raises(DeclarationError, match=message):
        PolicyMapping.from_json({field: value})


def test_what_a_run_has_recorded_is_what_acts_whatever_the_recipe_maps_now():
    module = torch.nn.Linear(3, 5)
    then = fit(sw.from_torch(module, sees=sw.Part("gyro", scale=2.0)))
    now = fit(sw.from_torch(module, sees=sw.Part("gyro", scale=3.0), every=2))
    recorded = Source(**json.loads(json.dumps(as_json(source_of(then)))))
    assert recorded.mapping is not None
    assert recorded.mapping["sees"][""][0]["scale"] == 2.0
    obs = observations(3, 1)[0]
    with pytest.warns(UserWarning, match=r"otherwise now \(sees\[0\].scale, every\); the recorded"):
        restored = as_recorded(now, recorded, lambda: None, "runs/x: skill 'walk'")
    np.testing.assert_array_equal(
        restored.act(restored.start(3), obs)[0], then.act(then.start(3), obs)[0]
    )
    plain = fit(sw.from_torch(torch.nn.Linear(3, 5)), Box(-1, 1, (3,), np.float32))
    assert source_of(plain).mapping is None
    recorded.mapping["sees"][""][0] = {"source": "function", "function": "gone:f"}
    with pytest.raises(RunError, match=r"runs/x: skill 'walk': its policy had another mapping"):
        as_recorded(now, recorded, lambda: None, "runs/x: skill 'walk'")
