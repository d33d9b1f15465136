"""Mapped policies as data: they refuse what contradicts itself."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from skills.mapped_models import onnx_model, weights

from skillweave.policies.acting_errors import PolicyError
from skillweave.policies.core import Turn, World
from skillweave.policies.mapped import (
    Affine,
    Function,
    Input,
    Mapped,
    OnnxFile,
    Outputs,
    Take,
)
from skillweave.policies.spaces import Space
from skillweave.types import Array


def box(*shape: int) -> Space:
    return Space("Box", "float32", shape, np.array(-1.0), np.array(1.0))


def choice(n: int) -> Space:
    return Space("Discrete", "int64", (), np.array(0), np.array(n - 1))


def zeros(x: Array, *more) -> Array:
    return np.zeros((len(x), 2), np.float32)


SEEN = Take("observation", (3,))
GOAL = Take("goal", (1,))
FUNCTION = Function(zeros)
BOTH = Space("Dict", parts={"a": box(2), "b": choice(2)})


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Take("function", (2,)), "Take.function is None"),
        (lambda: Take("goal", (2,), function=zeros), "Take.source is 'goal'"),
        (lambda: Take("observation", (3,), places=(0, 3)), r"Take.places is \(0, 3\).* 0 to 2"),
        (lambda: Take("observation", (3,), places=()), "Take.places is "),
        (lambda: Take("observation", (2,), choices=((3, 0),)), "Take.choices is .*Take.shape"),
        (lambda: Take("observation", (), choices=((3, 0),), whole=True), "Take.whole is true"),
        (lambda: Take("goal", (2,), low=np.zeros(3)), r"Take.low has the shape \(3,\)"),
        (lambda: Take("last_action", (2, 2)), r"Take.shape is \(2, 2\)"),
        (lambda: Input((SEEN,), (4,)), r"Input.shape is \(4,\), but Input.takes gives 3"),
        (lambda: Input((SEEN,), (3,), (Affine(np.zeros(2)),)), "Affine.offset has the shape"),
        (lambda: Outputs(box(3), (0, 0), rest=np.zeros(3)), "Outputs.to is .*each one once"),
        (lambda: Outputs(box(3), (0,)), "Outputs.rest must give"),
        (lambda: Outputs(box(3), (0,), rest=np.zeros(2)), "Outputs.rest has the shape"),
        (lambda: Outputs(box(2), (0, 1), np.zeros(3)), "Outputs.scale has the shape"),
        (lambda: Outputs(box(2), (0, 1), clip=(1.0, 0.0)), "Outputs.clip is "),
        (lambda: Outputs(BOTH, (0,)), "Outputs.to needs actions of a Box or a Discrete"),
        (lambda: Outputs(BOTH, logits=True), "is a network, whose one output"),
        (lambda: Function(zeros, ((2, 3),)), "Function.state is .*None once"),
        (lambda: Function(zeros, single_state=True), "Function.single_state"),
        (lambda: Function(zeros, ((None, 1),), takes_goal="goal"), "Function.takes_goal"),
        (lambda: Mapped(FUNCTION, Outputs(box(2)), every=0), "Mapped.every is 0; .*100,000"),
        (lambda: Mapped(FUNCTION, Outputs(box(2)), chunk=100_001), "Mapped.chunk is 100001"),
        (lambda: Mapped(FUNCTION, Outputs(BOTH), chunk=2), "policy: chunk needs actions of one"),
        (lambda: Mapped(FUNCTION, Outputs(box(2)), {"": Input((GOAL,), (1,))}), "no Mapped.goal"),
        (
            lambda: Mapped(FUNCTION, Outputs(box(2)), {"": Input((GOAL,), (1,))}, goal=np.zeros(2)),
            "Mapped.inputs and Mapped.goal have goals of",
        ),
        (
            lambda: Mapped(
                FUNCTION, Outputs(choice(2)), {"": Input((Take("last_action", (2,)),), (2,))}
            ),
            "takes the last action, which is 0 numbers",
        ),
        (
            lambda: Mapped(Function(zeros, takes_goal="goal"), Outputs(box(2))),
            "Function.takes_goal needs Mapped.goal_space",
        ),
    ],
)
def test_what_contradicts_itself_is_refused(make, says):
    with pytest.raises(PolicyError, match=says):
        make()


def test_what_does_not_fit_the_spaces_is_refused():
    made = Mapped(FUNCTION, Outputs(box(2)), {"": Input((SEEN,), (3,))})
    made.check(box(3), box(2), None, "policy")
    for sees, acts, says in (
        (box(4), box(2), r"policy.inputs\[''\] takes the observation of shape \(3,\)"),
        (BOTH, box(2), "takes the observation"),
        (box(3), box(1), "policy.outputs.space is Box"),
    ):
        with pytest.raises(PolicyError, match=says):
            made.check(sees, acts, None, "policy")
    aims = Mapped(FUNCTION, Outputs(box(2)), {"": Input((GOAL,), (1,))}, goal_space=box(1))
    with pytest.raises(PolicyError, match=r"policy.goal_space is .*goals are of None"):
        aims.check(box(3), box(2), None, "policy")


@pytest.fixture
def content(tmp_path) -> bytes:
    pytest.importorskip("onnxruntime")
    nodes = [("MatMul", ["obs", "w"], ["s"]), ("Add", ["s", "h"], ["after"])]
    shapes = {"obs": ["n", 3], "h": ["n", 2]}, {"after": ["n", 2], "s": ["n", 2]}
    return onnx_model(tmp_path / "x.onnx", nodes, *shapes, {"w": weights(3, 2)}).read_bytes()


def test_an_onnx_file_that_its_fields_do_not_fit_is_refused(content):
    right = {"output": "after", "inputs": ("obs",), "state": (("h", "after"),)}
    file = OnnxFile(content, **right)
    assert (file.expected, file.states) == ({"obs": (3,)}, [((2,), np.float32)])
    for change, says in (
        ({"output": "action"}, r"no output 'action' \(output\); it has: after, s"),
        ({"inputs": ("camera",)}, r"no input 'camera' \(inputs\); it has: obs, h"),
        ({"state": (("c", "after"),)}, r"no input 'c' \(state\)"),
        ({"state": (("h", "h.after"),)}, r"no output 'h.after' \(state\)"),
        ({"inputs": ()}, "OnnxFile.inputs is empty"),
    ):
        with pytest.raises(PolicyError, match=says):
            OnnxFile(content, **(right | change))
    with pytest.raises(PolicyError, match="cannot be run by onnxruntime"):
        OnnxFile(b"junk", **right)
    with pytest.raises(PolicyError, match="has weights in other files"):
        OnnxFile(content + b"\x3a\x04\x2a\x02\x6a\x00", **right)  # a weight's external_data
    four = Input((Take("observation", (4,)),), (4,))
    with pytest.raises(PolicyError, match=r"Mapped.inputs has .*but the model takes"):
        Mapped(file, Outputs(box(2)), {"": four})
    with pytest.raises(PolicyError, match=r"policy.model takes"):
        Mapped(file, Outputs(box(2))).check(box(4), box(2), None, "policy")
    again = pickle.loads(pickle.dumps(file))
    assert again.session is None
    obs, state, turn = np.ones((2, 3), np.float32), (np.ones((2, 2), np.float32),), Turn(World())
    found, other = (x.call({"": obs}, state, turn) for x in (file, again))
    np.testing.assert_array_equal(found[0], other[0])
