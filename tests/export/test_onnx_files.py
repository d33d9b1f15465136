"""ONNX files that others made: no other file is read, and a trial takes bounded time and memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skillweave.errors import PolicyError
from skillweave.policies import sessions
from skillweave.policies.sessions import check_file_alone, open_session

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
helper = onnx.helper
FLOAT, INT, BOOL = onnx.TensorProto.FLOAT, onnx.TensorProto.INT64, onnx.TensorProto.BOOL


def varint(number: int) -> bytes:
    if number < 128:
        return bytes([number])
    return bytes([number & 127 | 128]) + varint(number >> 7)


def part(field: int, content: bytes) -> bytes:
    return varint(field << 3 | 2) + varint(len(content)) + content


def number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def long_varint(value: int) -> bytes:
    return bytes([value & 127 | 128, value >> 7])


LOCATION = b"\n\x08location" + part(2, b"private.bin")
TENSOR = number(1, 2) + number(2, 1) + part(8, b"W")
ELSEWHERE = {
    "as usual": TENSOR + part(13, LOCATION) + number(14, 1),
    "the value first": TENSOR
    + part(13, part(2, b"private.bin") + b"\n\x08location")
    + number(14, 1),
    "a longer length": TENSOR + part(13, b"\n\x88\x00location" + part(2, b"x")) + number(14, 1),
    "a longer tag": TENSOR + long_varint(13 << 3 | 2) + b"\x00" + number(14, 1),
    "a tag of five bytes": TENSOR + b"\xf0\x80\x80\x80\x10\x01",
    "the place alone": TENSOR + number(14, 1),
    "a place beyond 32 bits": TENSOR + number(14, 2**32 + 1),
    "the entry alone": TENSOR + part(13, LOCATION),
    "first": part(13, LOCATION) + number(14, 1) + TENSOR,
}


def value(name: str, kind: int = FLOAT, shape: Sequence[int] = (1, 2)) -> Any:
    return helper.make_tensor_value_info(name, kind, shape)


def graph(nodes: Sequence[Any], *weights: Any, outputs: Sequence[Any] = ()) -> Any:
    ends = outputs or [value("action")]
    return helper.make_graph(nodes, "g", [value("obs")], ends, list(weights))


def model(inner: Any, functions: Sequence[Any] = ()) -> bytes:
    sets = [helper.make_opsetid("", 17), helper.make_opsetid("own", 1)]
    made = helper.make_model(inner, opset_imports=sets, ir_version=8, functions=functions)
    return bytes(made.SerializeToString())


def constant(name: str, content: Any) -> Any:
    return onnx.numpy_helper.from_array(np.array(content), name)


PLAIN = [helper.make_node("Identity", ["obs"], ["action"])]


@pytest.mark.parametrize("tensor", ELSEWHERE.values(), ids=ELSEWHERE)
@pytest.mark.parametrize("deep", [False, True])
def test_a_weight_in_another_file_is_found_in_any_encoding(tensor: bytes, deep: bool) -> None:
    inner = part(5, tensor)
    for _ in range(300 if deep else 0):  # a graph in an attribute of a node of a graph, ...
        inner = part(1, part(5, part(6, inner)))
    content = model(graph(PLAIN)) + part(7, inner)
    with pytest.raises(PolicyError, match="weights in other files"):
        check_file_alone(content, "it")


def test_weights_that_hold_the_same_bytes_are_no_other_file() -> None:
    text = np.frombuffer(LOCATION * 8, np.uint8).astype(np.float32)
    raw = onnx.TensorProto(name="w", data_type=onnx.TensorProto.UINT8, dims=[len(LOCATION)])
    raw.raw_data = LOCATION
    raw.data_location = onnx.TensorProto.DEFAULT
    check_file_alone(model(graph(PLAIN, constant("t", text), raw)), "it")


DAMAGED = {
    "empty field": b"\x00",
    "junk": b"junk of more than one byte",
    "a length beyond the end": part(7, b"")[:-1] + b"\x7f",
    "a number without end": b"\x08" + b"\xff" * 20,
    "a group": b"\x0b\x0c",
}


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_what_is_no_protobuf_is_said_to_be_damaged(content: bytes) -> None:
    with pytest.raises(PolicyError, match="it cannot be run by onnxruntime: it is no ONNX file"):
        check_file_alone(model(graph(PLAIN)) + content, "it")


def functions(depth: int, last: str = "Identity") -> list[Any]:
    """Functions that each call the next one twice."""
    sets = [helper.make_opsetid("", 17), helper.make_opsetid("own", 1)]
    found = []
    for i in range(depth):
        name, domain = (
            (f"f{i + 1}", "own") if i + 1 < depth else (last, "own" * (last != "Identity"))
        )
        nodes = [
            helper.make_node(name, ["x"], ["y"], domain=domain),
            helper.make_node(name, ["y"], ["z"], domain=domain),
        ]
        found.append(helper.make_function("own", f"f{i}", ["x"], ["z"], nodes, sets))
    return found


def test_functions_that_stand_for_too_many_nodes_are_refused() -> None:
    calls = graph([helper.make_node("f0", ["obs"], ["action"], domain="own")])
    session = open_session(model(calls, functions(6)), "it", trial=True)
    obs = np.ones((1, 2), np.float32)
    np.testing.assert_array_equal(session.run(None, {"obs": obs})[0], obs)
    for some in (functions(60), functions(2, "f0")):
        with pytest.raises(PolicyError, match="functions that call themselves, or stand for more"):
            check_file_alone(model(calls, some), "it")


def test_a_file_of_too_many_fields_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "MOST_FIELDS", 1000)
    check_file_alone(model(graph(PLAIN)), "it")
    with pytest.raises(PolicyError, match="more than 1,000 fields"):
        check_file_alone(model(graph(PLAIN * 1000)), "it")


def looped(times: int) -> bytes:
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go"], ["go.after"]),
            helper.make_node("Add", ["v", "v"], ["v.after"]),
        ],
        "body",
        [value("i", INT, []), value("go", BOOL, []), value("v")],
        [value("go.after", BOOL, []), value("v.after")],
    )
    loop = helper.make_node("Loop", ["times", "yes", "obs"], ["action"], body=body)
    return model(graph([loop], constant("times", times), constant("yes", True)))


def test_a_loop_acts_if_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "LONGEST_TRIAL", 0.5)
    obs = np.ones((1, 2), np.float32)
    trial = open_session(looped(3), "it", trial=True)
    np.testing.assert_array_equal(trial.run(None, {"obs": obs})[0], 8 * obs)
    np.testing.assert_array_equal(open_session(looped(3), "it").run(None, {"obs": obs})[0], 8 * obs)
    with pytest.raises(PolicyError, match=r"acts for more than 0\.5 seconds"):
        open_session(looped(2**62), "it", trial=True).run(None, {"obs": obs})


def test_a_trial_takes_bounded_memory() -> None:
    nodes = [
        helper.make_node("ConstantOfShape", ["size"], ["many"]),
        helper.make_node("ReduceMax", ["many"], ["one"], keepdims=0),
        helper.make_node("Add", ["obs", "one"], ["action"]),
    ]
    obs = np.ones((1, 2), np.float32)
    small = open_session(model(graph(nodes, constant("size", [10**6]))), "it", trial=True)
    np.testing.assert_array_equal(small.run(None, {"obs": obs})[0], obs)
    for _ in range(2):
        large = open_session(model(graph(nodes, constant("size", [10**10]))), "it", trial=True)
        with pytest.raises(PolicyError, match="takes more than 1,073,741,824 bytes"):
            large.run(None, {"obs": obs})


def test_an_ordinary_error_of_a_trial_stays_one() -> None:
    session = open_session(model(graph(PLAIN)), "it", trial=True)
    with pytest.raises(Exception, match="INVALID_ARGUMENT"):
        session.run(None, {"obs": np.ones((1, 3), np.float32)})


def test_weights_beside_a_file_of_the_user_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import skillweave as sw

    made = onnx.load_model_from_string(
        model(
            graph(
                [helper.make_node("MatMul", ["obs", "w"], ["action"])],
                constant("w", np.eye(2, dtype="f4")),
            )
        )
    )
    onnx.save(
        made, tmp_path / "a.onnx", save_as_external_data=True, location="w.bin", size_threshold=0
    )
    monkeypatch.chdir(tmp_path.parent)
    policy = sw.from_onnx(tmp_path / "a.onnx")
    os.unlink(tmp_path / "w.bin")
    obs = np.array([[3.0, 4.0]], np.float32)
    np.testing.assert_array_equal(policy.model.call({"": obs}, (), None)[0], obs)
