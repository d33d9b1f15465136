"""``sw.from_deploy``: Unitree's deploy.yaml as a mapping, and what else such a file may be."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from robots.walker import Walker, policy_of

import skillweave as sw
from skillweave.errors import DeclarationError, PolicyError, RunError

yaml = pytest.importorskip("yaml")
POSE = (0.5, 0.4, -0.9, -0.8)
MAP = (2, 0, 3, 1)
DEPLOY: dict[str, Any] = {
    "joint_ids_map": [*MAP],
    "step_dt": 0.02,
    "stiffness": [100.0, 101.0, 102.0, 103.0],
    "damping": [1.0, 1.1, 1.2, 1.3],
    "default_joint_pos": [*POSE],
    "commands": {"base_velocity": {"ranges": {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.3, 0.3],
                                              "ang_vel_z": [-0.2, 0.2], "heading": None}}},
    "actions": {"JointPositionAction": {"clip": None, "joint_names": [".*"], "scale": [0.25] * 4,
                                        "offset": [*POSE], "joint_ids": None}},
    "observations": {
        "base_ang_vel": {"params": {}, "clip": None, "scale": [0.2] * 3, "history_length": 1},
        "projected_gravity": {"params": {}, "clip": None, "scale": [1.0] * 3, "history_length": 1},
        "velocity_commands": {"params": {"command_name": "base_velocity"}, "clip": None,
                              "scale": [1.0] * 3, "history_length": 1},
        "joint_pos_rel": {"params": {}, "clip": None, "scale": [1.0] * 4, "history_length": 1},
        "joint_vel_rel": {"params": {}, "clip": None, "scale": [0.05] * 4, "history_length": 1},
        "last_action": {"params": {}, "clip": None, "scale": [1.0] * 4, "history_length": 1},
    },
}  # fmt: skip


class Named(Walker):
    joint_names = ("d", "c", "b", "a")


def made(folder: Path, text: str | None = None, **changes: Any) -> Path:
    """Write the file, with fields that are changed, by their dotted names with __ for dots."""
    data = copy.deepcopy(DEPLOY)
    for name, value in changes.items():
        *inner, last = name.split("__")
        here = data
        for part in inner:
            here = here[part]
        here[last] = value
    path = folder / "deploy.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False) if text is None else text)
    return path


def changed(folder: Path, term: str, **settings: Any) -> Path:
    field = DEPLOY["observations"][term] | settings
    return made(folder, **{f"observations__{term}": field})


def right(**settings: Any) -> tuple[Any, ...]:
    """The mapping, written by hand."""
    return (
        sw.Part("gyro", scale=0.2, **settings),
        sw.Part("gravity", **settings),
        sw.Goal(low=(-0.5, -0.3, -0.2), high=(1.0, 0.3, 0.2), **settings),
        sw.Part("joints", MAP, offset=POSE, **settings),
        sw.Part("speeds", MAP, scale=0.05, **settings),
        sw.LastAction(**settings),
    )


def test_it_is_the_mapping_that_one_writes_by_hand(tmp_path: Path) -> None:
    read = sw.from_deploy(made(tmp_path), Walker)
    assert read["sees"] == right()
    assert read["acts"] == sw.Acts(to=MAP, scale=0.25, offset=POSE)
    assert set(read) == {"sees", "acts"}
    # Gains are in the SDK's order, which is the environment's.
    assert read.gains["stiffness"].tolist() == DEPLOY["stiffness"]
    assert read.gains["damping"].tolist() == DEPLOY["damping"]


def test_what_was_read_is_played(tmp_path: Path) -> None:
    read = sw.from_deploy(made(tmp_path), Walker)

    def network(x: Any) -> Any:
        assert x.shape[1] == 21
        places = [0, 1, 2, 3, 4, 5, 9, 10, 11, 12, 13, 14, 15, 16]
        return policy_of(x[:, places])

    policy = sw.from_function(network, **read, goal=(0.5, 0, 0))
    assert sw.evaluate(policy, Walker, episodes=1, max_steps=20, seed=0).lengths == (20,)
    with pytest.raises(DeclarationError, match=r"out of the range .* Goal\.high is \(1\.0"):
        sw.from_function(network, **read, goal=(2.0, 0, 0))


def test_an_identity_leads_to_no_places(tmp_path: Path) -> None:
    read = sw.from_deploy(made(tmp_path, joint_ids_map=[0, 1, 2, 3]), Walker)
    assert read["acts"].to is None
    assert [part.places for part in read["sees"] if isinstance(part, sw.Part)] == [None] * 4


def test_it_prints_where_each_number_is_from(tmp_path: Path) -> None:
    read = sw.from_deploy(changed(tmp_path, "base_ang_vel", history_length=3), Walker)
    text = str(read)
    assert "base_ang_vel: scale = deploy.yaml: observations.base_ang_vel.scale, history = " in text
    assert "offset = deploy.yaml: default_joint_pos" in text
    assert "-0.9 to 0.5" in text
    assert read.sources()["action"]["to"] == "deploy.yaml: joint_ids_map"
    assert any("the order of Unitree's SDK" in one for one in read.unsaid)
    assert any("the history holds" in one for one in read.unsaid)
    assert "<table>" in read._repr_html_()
    # It is edited as a dict is, and then says that the user changed it.
    first, *others = read["sees"]
    read["sees"] = (replace(first, scale=0.3), *others)
    read["acts"] = replace(read["acts"], clip=(-1, 1))
    assert read.sources()["base_ang_vel"]["scale"] == "changed after reading"
    assert read.sources()["base_ang_vel"]["history"].startswith("deploy.yaml")
    assert read.sources()["action"]["clip"] == "changed after reading"
    read["sees"] = ("gyro", "gravity")
    assert "changed after reading" in str(read)


def test_histories(tmp_path: Path) -> None:
    terms = {k: x | {"history_length": 5} for k, x in DEPLOY["observations"].items()}
    assert sw.from_deploy(made(tmp_path, observations=terms), Walker)["sees"] == right(history=5)
    by_step = {"use_gym_history": True} | terms
    read = sw.from_deploy(made(tmp_path, observations=by_step), Walker)
    assert read["sees"] == right(history=5, layout="step")
    names = {"base_ang_vel": sw.Table(np.zeros((2, 3)))}
    with pytest.raises(DeclarationError, match=r"a Table, but deploy\.yaml has a history of 5"):
        sw.from_deploy(made(tmp_path, observations=terms), Walker, names=names)


def test_groups_are_inputs(tmp_path: Path) -> None:
    terms = DEPLOY["observations"]
    groups = {"obs": {k: terms[k] for k in terms if k != "projected_gravity"},
              "down": {"projected_gravity": terms["projected_gravity"]}}  # fmt: skip
    read = sw.from_deploy(made(tmp_path, observations=groups), Walker)
    assert read["sees"]["down"] == (sw.Part("gravity"),)
    assert len(read["sees"]["obs"]) == 5
    where = "deploy.yaml: observations.down.projected_gravity.scale"
    assert read.sources()["projected_gravity"]["scale"] == where


def test_observations_are_clipped_before_they_are_scaled(tmp_path: Path) -> None:
    def clip(**settings: Any) -> Any:
        return sw.from_deploy(changed(tmp_path, "base_ang_vel", **settings), Walker)["sees"][0].clip

    assert clip(clip=[-2.0, 4.0]) == pytest.approx((-0.4, 0.8))
    assert clip(clip=[-2.0, 4.0], scale=[-1.0] * 3) == (-4.0, 2.0)
    with pytest.warns(UserWarning, match=r"leaves out observations\.base_ang_vel\.clip"):
        assert clip(clip=[-2.0, 4.0], scale=[1.0, 2.0, 1.0]) is None
    terms = {"scale_first": True} | DEPLOY["observations"]
    terms["base_ang_vel"] = terms["base_ang_vel"] | {"clip": [-2.0, 4.0]}
    read = sw.from_deploy(made(tmp_path, observations=terms), Walker)
    assert read["sees"][0].clip == (-2.0, 4.0)


def test_actions_are_clipped_after_they_are_scaled(tmp_path: Path) -> None:
    where = "actions__JointPositionAction__clip"
    ranges = [[x - 0.5, x + 1.0] for x in POSE]
    read = sw.from_deploy(made(tmp_path, **{where: ranges}), Walker)
    assert read["acts"].clip == pytest.approx((-2.0, 4.0))
    assert any("the last action is clipped, too" in one for one in read.unsaid)
    with pytest.warns(UserWarning, match=r"JointPositionAction\.clip, as outputs have different"):
        read = sw.from_deploy(made(tmp_path, **{where: [[-1.0, 1.0]] * 4}), Walker)
    assert read["acts"].clip is None
    assert any("JointPositionAction.clip, which is left out" in one for one in read.unsaid)


def test_names_of_joints_lead_to_their_places(tmp_path: Path) -> None:
    read = sw.from_deploy(made(tmp_path), Named, joints=("a", "b", "c", "d"))
    places = (1, 3, 0, 2)  # MAP, from the last joint on
    assert read["acts"].to == places
    assert read["sees"][3].places == places
    assert read.gains["stiffness"].tolist() == [103.0, 102.0, 101.0, 100.0]
    with pytest.raises(PolicyError, match="no names of joints: give it an attribute joint_names"):
        sw.from_deploy(made(tmp_path), Walker, joints=("a", "b", "c", "d"))
    with pytest.raises(PolicyError, match="joints has 'e', but the joints of Named are"):
        sw.from_deploy(made(tmp_path), Named, joints=("a", "b", "c", "e"))
    with pytest.raises(DeclarationError, match=r"joints has 3 names, but deploy\.yaml has 4"):
        sw.from_deploy(made(tmp_path), Named, joints=("a", "b", "c"))
    with pytest.raises(DeclarationError, match="a list of different names"):
        sw.from_deploy(made(tmp_path), Named, joints=("a", "a", "c", "d"))


def test_some_joints_alone(tmp_path: Path) -> None:
    chosen = {"params": {"asset_cfg": {"joint_ids": [1, 3]}}, "scale": [1.0, 1.0]}
    part = sw.from_deploy(changed(tmp_path, "joint_pos_rel", **chosen), Walker)["sees"][3]
    assert part == sw.Part("joints", slice(0, 2), offset=(0.4, -0.8))
    action = {"scale": [0.25] * 2, "offset": [0.4, -0.8], "joint_ids": [1, 3], "clip": None}
    terms = DEPLOY["observations"] | {"last_action": {"scale": [1.0] * 2, "history_length": 1}}
    actions = {"JointPositionAction": action}
    read = sw.from_deploy(made(tmp_path, actions=actions, observations=terms), Walker)
    assert read["acts"] == sw.Acts(to=slice(0, 2), scale=0.25, offset=(0.4, -0.8))
    assert any("who holds the other 2 numbers" in one for one in read.unsaid)


def test_a_clock_of_the_gait(tmp_path: Path) -> None:
    term = {"params": {"period": 0.8}, "scale": [1.0, 1.0], "clip": None, "history_length": 1}
    terms = DEPLOY["observations"] | {"gait_phase": term}
    read = sw.from_deploy(made(tmp_path, observations=terms), Walker)
    clocks = tuple(sw.Elapsed(period=40, wave=wave) for wave in ("sin", "cos"))
    assert read["sees"][-2:] == clocks
    assert any("clock of gait_phase" in one for one in read.unsaid)


# Terms that no environment has, and other names


class Other(Walker):
    """The gyro has another name, and no name is said twice."""

    observation_space = gym.spaces.Dict(
        {
            "imu": gym.spaces.Box(-np.inf, np.inf, (6,), np.float32),
            "joints": gym.spaces.Box(-np.inf, np.inf, (4,), np.float32),
            "speeds": gym.spaces.Box(-np.inf, np.inf, (4,), np.float32),
            "dq": gym.spaces.Box(-np.inf, np.inf, (4,), np.float32),
        }
    )


def test_names_say_what_a_term_is(tmp_path: Path) -> None:
    def down(obs: Any) -> Any:
        return obs["imu"][:, 3:]

    names = {
        "base_ang_vel": sw.Part("imu", slice(0, 3)),
        "projected_gravity": down,
        "joint_vel_rel": sw.Part("speeds", scale=0.1),
    }
    file = made(tmp_path)
    sees = sw.from_deploy(file, Other, names=names)["sees"]
    assert sees[0] == sw.Part("imu", slice(0, 3), scale=0.2)  # the file's scale
    assert sees[1].function is down
    assert sees[4] == sw.Part("speeds", MAP, scale=0.1)  # the user's
    missing = r"'base_ang_vel', 'projected_gravity'; the environment has the keys 'dq' .*"
    with pytest.raises(DeclarationError, match=rf"{missing}write names=\{{'base_ang_vel': \.\.\."):
        sw.from_deploy(file, Other, names={"joint_vel_rel": "dq"})
    with pytest.raises(DeclarationError, match=r"joint_vel_rel may be any of .*speeds"):
        sw.from_deploy(file, Other, names={k: names[k] for k in list(names)[:2]})
    with pytest.raises(PolicyError, match="'imu' gives 6 numbers, but base_ang_vel has 3"):
        sw.from_deploy(file, Other, names=names | {"base_ang_vel": "imu"})
    with pytest.raises(DeclarationError, match="reads 'imi', which the environment does not have"):
        sw.from_deploy(file, Other, names=names | {"base_ang_vel": "imi"})
    with pytest.raises(DeclarationError, match=r"'gyro', which is no term of deploy\.yaml"):
        sw.from_deploy(file, Other, names=names | {"gyro": "imu"})


def test_a_reference_must_be_given(tmp_path: Path) -> None:
    term = {"params": {"command_name": "motion"}, "scale": [1.0] * 8, "history_length": 1}
    anchor = {"params": {"command_name": "motion"}, "scale": [1.0] * 6, "history_length": 1}
    file = made(tmp_path, observations={"motion_command": term, "motion_anchor_ori_b": anchor})
    with pytest.raises(DeclarationError, match=r"sw\.Table\(motion\).*observations and call"):
        sw.from_deploy(file, Walker)
    tables = sw.Table(np.zeros((9, 4))), sw.Table(np.ones((9, 4)))
    names: dict[str, Any] = {"motion_anchor_ori_b": lambda obs, call: np.zeros((len(obs), 6))}
    read = sw.from_deploy(file, Walker, names=names | {"motion_command": tables})
    assert read["sees"][:2] == tables
    with pytest.raises(PolicyError, match=r"Table\(\) gives 4 numbers, but motion_command has 8"):
        sw.from_deploy(file, Walker, names=names | {"motion_command": tables[0]})
    with pytest.raises(PolicyError, match=r"has 12 numbers, but motion_command has 8"):
        sw.from_deploy(file, Walker, names=names | {"motion_command": (*tables, tables[0])})


# Files that are damaged, or others

TEXT = yaml.safe_dump(DEPLOY)
SLICE = "joint_ids: !!python/object/apply:builtins.slice "
BAD = {
    "a tag that runs code": (
        TEXT + "x: !!python/object/apply:os.system [ls]\n", r"x has the tag .*os\.system"),
    "another slice": (
        TEXT.replace("joint_ids: null", SLICE + "[0, 2, null]"), r"Action\.joint_ids has the tag"),
    "a name twice": (TEXT + "step_dt: 0.01\n", "has the name 'step_dt' twice"),
    "no mapping": ("- 1\n- 2\n", "is a mapping of names"),
    "nothing": ("", "is None; a deploy.yaml is"),
    "no YAML": ("a: [1, 2", "is no YAML"),
    "two documents": ("a: 1\n---\nb: 2\n", "is no YAML"),
    "NaN": (TEXT.replace("- 103.0", "- .nan"), r"stiffness\[3\] is nan; it must be a finite"),
    "a text": (TEXT.replace("step_dt: 0.02", "step_dt: fast"), "step_dt is 'fast'"),
    "too deep": ("a: " + "[" * 5000 + "]" * 5000, "is damaged|is no YAML"),
    "too large": ("#" * 2**20 + "\n" + TEXT, "at most 1,048,576"),
    "aliases of aliases": (
        "a0: &a0 [1, 1]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40)),
        "has more than 100,000 values"),
    "LEAPP": ("models: {}\npipeline: {}\n", "so it is a LEAPP file"),
    "rl_sar": ("g1:\n  num_of_dofs: 29\n", "so it is a configuration of rl_sar"),
    "unitree_rl_gym": ("num_obs: 47\ndefault_angles: [0.1]\n", "configuration of unitree_rl_gym"),
    "IO descriptor": ("actions: []\narticulations: {}\n", "so it is an IO descriptor"),
    "MicroDuck": ('{"schema_version": 2, "model_api": 1}', "so it is a manifest of MicroDuck"),
    "a field missing": (TEXT.replace("joint_ids_map", "joint_map"), "joint_ids_map"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_file_that_cannot_be_read_is_refused_by_a_sentence(case: str, tmp_path: Path) -> None:
    text, message = BAD[case]
    with pytest.raises(RunError, match=message) as raised:
        sw.from_deploy(made(tmp_path, text), Walker)
    assert "deploy.yaml" in str(raised.value)


def test_all_joints_are_a_slice_in_isaac_lab(tmp_path: Path) -> None:
    text = TEXT.replace("joint_ids: null", SLICE + "[null, null, null]")
    read = sw.from_deploy(made(tmp_path, text), Walker)
    assert read["acts"].to == MAP


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "a map that is none": ({"joint_ids_map": [0, 0, 1, 2]}, "each of the 4 joints"),
    "a joint that is not there": ({"joint_ids_map": [0, 1, 2, 4]}, "each of the 4 joints"),
    "a pose of three": ({"default_joint_pos": [0.0] * 3}, "default_joint_pos 3"),
    "gains of three": ({"damping": [0.0] * 3}, "damping 3; the first two"),
    "two actions": ({"actions": {"JointPositionAction": {}, "Grip": {}}}, "Action, Grip; one"),
    "a scale of three": ({"actions__JointPositionAction__scale": [1.0] * 3}, "scale has 3 numbers"),
    "terms that are none": ({"observations": {"base_ang_vel": 3}}, "it must have terms"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_fields_that_do_not_add_up_are_named(case: str, tmp_path: Path) -> None:
    changes, message = WRONG[case]
    with pytest.raises(RunError, match=message):
        sw.from_deploy(made(tmp_path, **changes), Walker)


class Five(Walker):
    observation_space = gym.spaces.Dict(
        dict(Walker.observation_space.spaces)
        | {"joints": gym.spaces.Box(-np.inf, np.inf, (5,), np.float32)}
    )


class Three(Walker):
    action_space = gym.spaces.Box(-3, 3, (3,), np.float32)


class Chooses(Walker):
    action_space = gym.spaces.Discrete(3)  # type: ignore[assignment]


def test_an_environment_that_does_not_fit_is_named(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="has 4 joints, but the environment's 'joints' has 5"):
        sw.from_deploy(made(tmp_path), Five)
    with pytest.raises(PolicyError, match="the action of Three has 3 numbers"):
        sw.from_deploy(made(tmp_path), Three)
    with pytest.raises(PolicyError, match="targets of joints need a Box"):
        sw.from_deploy(made(tmp_path), Chooses)
    with pytest.raises(PolicyError, match="'gyro' has 3 numbers: write names"):
        sw.from_deploy(changed(tmp_path, "base_ang_vel", scale=[1.0] * 2), Walker)


def test_joints_are_named_by_mujoco(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    read = sw.from_deploy(made(tmp_path), Hung, joints=("k1", "k0", "k3", "k2"))
    assert read["acts"].to == tuple((1, 0, 3, 2)[i] for i in MAP)


class Hung(Walker):
    """A model with a free joint, which is no joint of the policy."""

    def __init__(self) -> None:
        import mujoco

        legs = "".join(
            f'<body><joint name="k{i}" type="hinge"/><geom size="0.1"/></body>' for i in range(4)
        )
        body = f'<body><freejoint/><geom size="0.1"/>{legs}</body>'
        xml = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
        self.model = mujoco.MjModel.from_xml_string(xml)
