"""``sw.from_metadata`` and ``sw.reference_motion``: what mjlab and BeyondMimic write into ONNX."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots.walker import Walker

import skillweave as sw
from skillweave.errors import DeclarationError, PolicyError, RunError

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
pytestmark = pytest.mark.filterwarnings("ignore:.*rounded to 3 decimals")
WALK = {
    "run_path": "2026-01-01",
    "joint_names": "a,b,c,d",
    "joint_stiffness": "10.125,11.125,12.125,13.125",
    "joint_damping": "1.000",
    "default_joint_pos": "0.100,0.200,0.300,0.400",
    "action_scale": "0.075,0.548,0.075,0.548",
    "command_names": "twist",
    "observation_names": "base_ang_vel,projected_gravity,joint_pos,joint_vel,actions,command",
}
TRACK = WALK | {
    "command_names": "motion",
    "observation_names": "command,motion_anchor_ori_b,base_ang_vel,joint_pos,joint_vel,actions",
    "anchor_body_name": "torso",
}
# It stands still at first, and passes its last row before the end.
MOTION = np.array([[1, 1, 1, 1]] * 3 + [[5, 5, 5, 5], [2, 0, 0, 0], [5, 5, 5, 5]], np.float32)
FASTER = MOTION * 0.5


class Named(Walker):
    joint_names = ("a", "b", "c", "d")


class Turned(Walker):
    joint_names = ("d", "c", "b", "a")


def written(
    path: Path,
    fields: Mapping[str, str] | None = None,
    size: int = 21,
    motion: bool = False,
    angles: Any = None,
) -> Path:
    """Write a file whose actions are the mean of its inputs, and perhaps a motion."""
    from onnx import TensorProto, helper, numpy_helper

    value = helper.make_tensor_value_info
    inputs = [value("obs", TensorProto.FLOAT, [1, size])]
    outputs = [value("actions", TensorProto.FLOAT, [1, 4])]
    weights = np.full((size, 4), 1 / size, np.float32)
    constants = [numpy_helper.from_array(weights, "w")]
    nodes = [helper.make_node("MatMul", ["obs", "w"], ["actions"])]
    if motion:
        inputs.append(value("time_step", TensorProto.FLOAT, [1, 1]))
        constants.append(numpy_helper.from_array(np.float32(len(MOTION) - 1), "last"))
        nodes += [
            helper.make_node("Min", ["time_step", "last"], ["at"]),
            helper.make_node("Cast", ["at"], ["whole"], to=TensorProto.INT64),
            helper.make_node("Squeeze", ["whole"], ["row"]),
        ]
        for name, rows in (
            ("joint_pos", MOTION if angles is None else angles),
            ("joint_vel", FASTER),
        ):
            outputs.append(value(name, TensorProto.FLOAT, [4]))
            constants.append(numpy_helper.from_array(rows, f"{name}_rows"))
            nodes.append(helper.make_node("Gather", [f"{name}_rows", "row"], [name], axis=0))
    graph = helper.make_graph(nodes, "policy", inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, dict(WALK if fields is None else fields))
    onnx.save(model, str(path))
    return path


def test_it_is_the_mapping_that_one_writes_by_hand(tmp_path: Path) -> None:
    file = written(tmp_path / "walk.onnx")
    read = sw.from_metadata(file, Named)
    pose = (0.1, 0.2, 0.3, 0.4)
    joints = sw.Part("joints", offset=pose), sw.Part("speeds")
    last = sw.LastAction(), sw.Goal()
    assert read["sees"] == (sw.Part("gyro"), sw.Part("gravity"), *joints, *last)
    assert read["acts"] == sw.Acts(scale=(0.075, 0.548, 0.075, 0.548), offset=pose)
    assert read.gains["stiffness"].tolist() == [10.125, 11.125, 12.125, 13.125]
    assert read.gains["damping"].tolist() == [1.0] * 4
    assert read.sources()["action"]["scale"] == "walk.onnx: action_scale"
    policy = sw.from_onnx(file, **read, goal=(0.5, 0, 0))
    assert sw.evaluate(policy, Named, episodes=1, max_steps=10, seed=0).lengths == (10,)


def test_joints_are_found_by_name(tmp_path: Path) -> None:
    file = written(tmp_path / "walk.onnx")
    read = sw.from_metadata(file, Turned)
    assert read["acts"].to == (3, 2, 1, 0)
    assert read["sees"][2] == sw.Part("joints", (3, 2, 1, 0), offset=(0.1, 0.2, 0.3, 0.4))
    assert read.gains["stiffness"].tolist() == [13.125, 12.125, 11.125, 10.125]
    same = sw.from_metadata(file, Walker, joints=("d", "c", "b", "a"))
    assert same["acts"] == read["acts"]
    assumed = sw.from_metadata(file, Walker)
    assert assumed["acts"].to is None
    assert any("the file's order (a, b, ..., d)" in one for one in assumed.unsaid)
    with pytest.raises(PolicyError, match=r"has them in the order \['d', 'c', 'b', 'a'\]"):
        sw.from_metadata(file, Turned, joints=("a", "b", "c", "d"))
    with pytest.raises(PolicyError, match="joint_names has 'a' and 1 more, but the joints of"):
        sw.from_metadata(file, Walker, joints=("x", "y", "c", "d"))


def test_three_decimals_are_said_once(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="rounded to 3 decimals") as given:
        sw.from_metadata(written(tmp_path / "walk.onnx"), Named)
    assert len(given) == 1


@pytest.mark.filterwarnings("error")
def test_metadata_of_all_decimals_are_not_called_rounded(tmp_path: Path) -> None:
    file = written(tmp_path / "walk.onnx", WALK | {"action_scale": "0.0745014"})
    assert sw.from_metadata(file, Named)["acts"].scale == 0.0745014


def test_histories(tmp_path: Path) -> None:
    lengths = {"observation_history_lengths": "5,1,1,1,1,1"}
    file = written(tmp_path / "walk.onnx", WALK | lengths, size=33)
    read = sw.from_metadata(file, Named)
    assert read["sees"][0] == sw.Part("gyro", history=5)
    assert read.sources()["base_ang_vel"]["history"].endswith("observation_history_lengths")


def anchor(obs: Any, call: Any) -> Any:
    return np.zeros((len(call.steps), 6))


def test_a_tracked_motion_is_read_from_the_file(tmp_path: Path) -> None:
    file = written(tmp_path / "kick.onnx", TRACK, 29, motion=True)
    with pytest.raises(DeclarationError, match=r"'motion_anchor_ori_b' \(.*observations and call"):
        sw.from_metadata(file, Named)
    read = sw.from_metadata(file, Named, names={"motion_anchor_ori_b": anchor})
    assert read["sees"]["time_step"] == (sw.Elapsed(clip=(0, 5)),)
    table = read["sees"]["obs"][0]
    assert table == sw.Table(np.concatenate([MOTION, FASTER], 1))
    policy = sw.from_onnx(file, output="actions", **read)
    assert sw.evaluate(policy, Named, episodes=1, max_steps=5, seed=0).lengths == (5,)
    assert "kick.onnx: its outputs joint_pos and joint_vel" in str(read)


def test_a_motion_ends_where_its_last_row_stays(tmp_path: Path) -> None:
    file = written(tmp_path / "kick.onnx", TRACK, 29, motion=True)
    assert sw.reference_motion(file, "joint_pos").tolist() == MOTION.tolist()
    jump = MOTION.copy()
    jump[:2] = jump[-1]  # it stands at first as it does at last
    standing = written(tmp_path / "jump.onnx", TRACK, 29, motion=True, angles=jump)
    assert sw.reference_motion(standing, "joint_pos").tolist() == jump.tolist()
    with pytest.raises(PolicyError, match="its output 'actions' depends on obs"):
        sw.reference_motion(file, "actions")
    with pytest.raises(PolicyError, match="has no output 'joints', so no motion"):
        sw.reference_motion(file, "joints")
    with pytest.raises(PolicyError, match="has no input 'time_step', so no motion"):
        sw.reference_motion(written(tmp_path / "walk.onnx"), "actions")
    with pytest.raises(RunError, match="does not exist"):
        sw.reference_motion(tmp_path / "no.onnx", "joint_pos")


BAD: dict[str, tuple[dict[str, str], type[Exception], str]] = {
    "no metadata": ({}, PolicyError, "has no metadata; joint_names is missing"),
    "holosoma": ({"dof_names": "[]", "kp": "[]"}, PolicyError, "holosoma's .* lack the scale"),
    "a field missing": (
        {k: x for k, x in WALK.items() if k != "action_scale"}, PolicyError,
        "action_scale is missing"),
    "NaN": (WALK | {"action_scale": "nan"}, RunError, "action_scale is 'nan'; it must have 4"),
    "three of four": (WALK | {"default_joint_pos": "1,2,3"}, RunError, "it must have 4 finite"),
    "texts": (WALK | {"joint_damping": "a,b,c,d"}, RunError, "joint_damping is 'a,b,c,d'"),
    "a term too many": (
        WALK | {"observation_names": WALK["observation_names"] + ",joint_vel"}, PolicyError,
        "takes 21 numbers, but its terms have 25"),
    "an unknown term": (
        WALK | {"observation_names": "height_scan"}, DeclarationError,
        "the policy sees 'height_scan'; the environment has the keys 'gravity'"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_metadata_that_do_not_fit_are_refused_by_a_sentence(case: str, tmp_path: Path) -> None:
    fields, kind, message = BAD[case]
    with pytest.raises(kind, match=message):
        sw.from_metadata(written(tmp_path / "walk.onnx", fields), Named)


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "no.onnx").write_bytes(b"no model")
    with pytest.raises(PolicyError, match="is no ONNX model"):
        sw.from_metadata(tmp_path / "no.onnx", Named)


def test_training_s_own_numbers_replace_the_rounded_ones(tmp_path: Path) -> None:
    read = sw.from_metadata(written(tmp_path / "walk.onnx"), Named)
    read["acts"] = replace(read["acts"], scale=0.0745)
    assert read.sources()["action"]["scale"] == "changed after reading"
    assert read.sources()["action"]["offset"] == "walk.onnx: default_joint_pos"
