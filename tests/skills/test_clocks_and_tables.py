"""Clocks, tables, histories and ``call`` by hand; a module's state in its buffers; bad input."""

from __future__ import annotations

import copy
import json
import pickle
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete

import skillweave as sw
from skillweave.errors import DeclarationError, PolicyError, RunError
from skillweave.policies.core import Turn, World
from skillweave.policies.timed import Clock, Past, Rows
from skillweave.skills.mapping import PolicyMapping, Scaling, mapping_of
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.types import Array

SPACE = Dict({"a": Box(-9, 9, (2,), np.float32), "b": Box(-9, 9, (1,), np.float32)})
ACTION = Box(-9, 9, (2,), np.float32)


def obs_of(*rows: tuple[float, float, float]) -> Array:
    found = np.zeros(len(rows), [("a", np.float32, (2,)), ("b", np.float32, (1,))])
    for i, (x, y, z) in enumerate(rows):
        found["a"][i], found["b"][i] = (x, y), z
    return found


def inputs(policy: Any, *steps: tuple[float, float, float]) -> list[list[float]]:
    """What a policy is shown in the steps of one environment."""
    shown: list[list[float]] = []
    bound = policy.bind(SPACE, ACTION, "it")
    acting, memory = bound.in_place, None
    model = acting.model
    call = model.call

    def look(given: dict[str, Array], state: Any, turn: Any) -> Any:
        shown.append(np.float64(given[""]).reshape(-1).tolist())
        return call(given, state, turn)

    model.call = look
    memory = acting.start(1)
    for step in steps:
        turn = Turn(World(np.random.default_rng(0)), None, None)
        acting.act(memory, np.array([0]), obs_of(step), turn)
    return shown


def still(x: Array) -> Array:
    return np.tile([1.0, -2.0], (len(x), 1))


ONE, TWO, THREE = (1.0, 10.0, 0.1), (2.0, 20.0, 0.2), (3.0, 30.0, 0.3)


@pytest.mark.parametrize(
    ("sees", "expected"),
    [
        ((sw.Part("a", 0, history=3),), [[1, 1, 1], [1, 1, 2], [1, 2, 3]]),
        ((sw.Part("a", 0, history=2, order="newest"),), [[1, 1], [2, 1], [3, 2]]),
        # Zeros are what the policy is shown, not what is scaled.
        (
            (sw.Part("a", 0, history=2, fill="zeros", offset=5.0, scale=2.0),),
            [[0, -8], [-8, -6], [-6, -4]],
        ),
        (
            (sw.Part("a", history=2), sw.Part("a", 0)),
            [[1, 10, 1, 10, 1], [1, 10, 2, 20, 2], [2, 20, 3, 30, 3]],
        ),
        # By step: all parts of the older inference, then those of the newer one.
        (
            (
                sw.Part("a", 0, history=2, layout="step"),
                sw.LastAction(history=2, layout="step", fill="zeros"),
            ),
            [[1, 0, 0, 1, 0, 0], [1, 0, 0, 2, 1, -2], [2, 1, -2, 3, 1, -2]],
        ),
        ((sw.LastAction(history=2),), [[0, 0, 0, 0], [0, 0, 1, -2], [1, -2, 1, -2]]),
        ((sw.Goal(history=2, scale=0.5),), [[2, 2], [2, 2], [2, 2]]),
        ((sw.Elapsed(),), [[0], [1], [2]]),
        ((sw.Elapsed(first=(1, 2), period=3, scale=10.0),), [[10, 20], [20, 0], [0, 10]]),
        ((sw.Elapsed(clip=(0, 1)),), [[0], [1], [1]]),
        ((sw.Table([[5.0, 6.0], [7.0, 8.0]], 1, scale=0.5),), [[3], [4], [4]]),
        ((sw.Table([5.0, 7.0, 9.0], rate=0.5),), [[5], [6], [7]]),
        ((sw.Table([5.0, 7.0, 9.0], start=-1),), [[5], [5], [7]]),
    ],
)
@pytest.mark.filterwarnings("ignore:.*its table was over")
def test_numbers_by_hand(sees: Any, expected: list[list[float]]) -> None:
    goal = 4.0 if isinstance(sees[0], sw.Goal) else None
    policy = sw.from_function(still, sees=sees, goal=goal)
    found = inputs(policy, ONE, TWO, THREE)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_waves_are_of_the_part_of_the_period_that_has_passed() -> None:
    found = inputs(
        sw.from_function(
            still, sees=(sw.Elapsed(period=4, wave="sin"), sw.Elapsed(period=4, wave="cos"))
        ),
        ONE, ONE, ONE,
    )  # fmt: skip
    np.testing.assert_allclose(found, [[0, 1], [1, 0], [0, -1]], atol=1e-12)


def test_entry_moves_clocks_tables_and_call_together() -> None:
    def since(obs: Array, call: Any) -> Array:
        assert call.entry == 2
        return np.stack([call.steps, obs["a"][:, 0] - call.start["a"][:, 0]], axis=1)

    policy = sw.from_function(
        still, sees=(since, sw.Elapsed(), sw.Table([0.0, 10.0, 20.0, 30.0])), entry=2
    )
    assert inputs(policy, ONE, THREE) == [[2, 0, 2, 20], [3, 2, 3, 30]]


def test_a_last_scaling_is_of_the_whole_input_with_its_past() -> None:
    scaling = {"": Scaling(offset=(0.0, 1.0), scale=2.0)}
    mapping = mapping_of("it", (sw.Part("a", 0, history=2, fill="zeros"),), scaling=scaling)
    assert inputs(ScriptedPolicy(still, mapping=mapping), ONE, TWO) == [[0, 0], [2, 2]]


def test_a_model_may_take_steps_as_an_axis_of_their_own(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    helper, real = onnx.helper, onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        [helper.make_node("ReduceMean", ["obs"], ["a"], axes=[1], keepdims=0)], "mean",
        [helper.make_tensor_value_info("obs", real, ["n", 3, 2])],
        [helper.make_tensor_value_info("a", real, ["n", 2])],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(tmp_path / "mean.onnx"))
    policy = sw.from_onnx(tmp_path / "mean.onnx", sees=sw.Part("a", history=3, layout="step"))
    bound = policy.bind(SPACE, ACTION, "it")
    memory = bound.start(1)
    for step in (ONE, TWO, THREE):
        action, memory = bound.act(memory, obs_of(step))
    assert action.tolist() == [[2.0, 9.0]]  # 20, clipped at 9


def test_tables_are_read_from_files(tmp_path: Path) -> None:
    (tmp_path / "named.csv").write_text("x,y\n1,2\n3,4\n")
    (tmp_path / "plain.csv").write_text("1;2\n3;4\n")
    (tmp_path / "tabs.csv").write_text("1\t2\n3\t4\n")
    (tmp_path / "quoted.csv").write_text('"1","2"\n3,4\n')
    (tmp_path / "units.csv").write_text("# made by hand\n,x\n[m],[rad]\n1,2\n3,4\n")
    np.savetxt(tmp_path / "blanks.csv", [[1, 2], [3, 4]], header="x y")
    np.save(tmp_path / "x.npy", np.float32([[1, 2], [3, 4]]))
    for file in tmp_path.iterdir():
        assert sw.Table(file).file.numbers.tolist() == [[1, 2], [3, 4]], file
    (tmp_path / "mixed.csv").write_text(",2\n3,4\n")
    with pytest.raises(DeclarationError, match="its line ',2' has numbers and other words"):
        sw.Table(tmp_path / "mixed.csv")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: sw.Table(p / "none.csv"), "none.csv"),
        (lambda p: sw.Table([[1.0, np.nan]]), "row 0 has nan in column 1"),
        (lambda p: sw.Table(np.zeros((2, 2, 2))), r"shape \(2, 2, 2\); it must be \(rows, col"),
        (lambda p: sw.Table("x"), "x"),
        (lambda p: sw.Table([["a"]]), "no table of numbers"),
        (lambda p: sw.Table([1.0], rate=0), "Table.rate is 0; it must be positive"),
        (lambda p: sw.Elapsed(wave="sin"), "give period"),
        (lambda p: sw.Elapsed(wave="saw", period=3), "Elapsed.wave is 'saw'"),
        (lambda p: sw.Part("a", history=0), "Part.history is 0"),
        (lambda p: sw.Part("a", fill="last"), "Part.fill is 'last'"),
        (lambda p: sw.from_function(still, sees="a", entry=3), "nothing in sees depends on time"),
        (lambda p: sw.from_function(still, sees="a", anew="elapsed"), "anew names 'elapsed'"),
        (lambda p: sw.from_function(still, sees="a", anew="history"), "anew names 'history'"),
        (
            lambda p: sw.from_function(
                still,
                sees=(
                    sw.Part("a", history=2, layout="step"),
                    sw.Part("b", history=3, layout="step"),
                ),
            ),
            "same history",
        ),
        (
            lambda p: sw.from_function(
                still,
                sees=(
                    sw.Part("a", history=2, layout="step"),
                    "b",
                    sw.Part("b", history=2, layout="step"),
                ),
            ),
            "be neighbours",
        ),
        (lambda p: sw.from_function(still, state=("h", "c")), "which has names"),
        (lambda p: sw.from_function(still, state={"h": 1.0}), "which has names"),
        (lambda p: sw.from_function(still, sees=sw.Goal(), goal=lambda obs, call: 0), "takes call"),
        (lambda p: sw.from_function(lambda x, call=None: x), "takes call"),
        (lambda p: sw.Part("a", fill="zeros"), "a history of 1"),
        (lambda p: sw.Goal(order="newest"), "a history of 1"),
        (lambda p: sw.Table([1.0, 2.0], start=2), "Table.start is 2, but the table has 2 rows"),
        (lambda p: sw.Table([[1.0]], 1), r"Table.columns is \(1,\), but the table has 1 col"),
        (lambda p: sw.Table([1.0 + 1j]), "complex"),
        (lambda p: sw.from_function(still, sees=sw.Table), "is the class Table"),
        (lambda p: sw.from_function(still, sees=sw.Elapsed), r"write Elapsed\(\)"),
    ],
)
def test_mistakes_are_named(make: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises((DeclarationError, RunError), match=message):
        make(tmp_path)


@pytest.mark.parametrize(
    ("sees", "message"),
    [
        (sw.Elapsed(), r"Elapsed\(\), which only a policy from elsewhere has"),
        (sw.Table([1.0]), r"Table\(\), which only"),
        (sw.Part("a", history=2), "has history, which only"),
        (lambda obs, call: obs["a"], "takes call, which only"),
    ],
)
def test_a_skill_that_learns_has_no_time_of_its_own(
    sees: Any, message: str, tmp_path: Path
) -> None:
    class Learns(sw.Skill):
        pass

    Learns.sees = (sees,)
    with pytest.raises(DeclarationError, match=message):
        sw.Hierarchy("CartPole-v1", [Learns()], steps=10).train(tmp_path, quiet=True)


def test_what_does_not_fit_is_named() -> None:
    with pytest.raises(PolicyError, match=r"columns is slice.*there are 2 numbers"):
        inputs(sw.from_function(still, sees=sw.Table([[1.0, 2.0]], slice(0, 3))))
    image = Dict({"a": Box(0, 255, (4, 4, 3), np.uint8)})
    with pytest.raises(PolicyError, match="history, but it keeps its shape"):
        sw.from_function(still, sees=sw.Part("a", history=2)).bind(image, ACTION, "it")


def test_a_call_that_is_longer_than_a_table_is_said_once() -> None:
    policy = sw.from_function(still, sees=sw.Table([1.0, 2.0]))
    with pytest.warns(UserWarning, match="its table was over at step 1 of a call that goes on"):
        inputs(policy, ONE, TWO, THREE, THREE)
    inputs(sw.from_function(still, sees=sw.Table([1.0, 2.0])), ONE, TWO)  # as long as it is
    inputs(sw.from_function(still, sees=sw.Table([1.0])), ONE, TWO)  # a constant
    later = sw.from_function(still, sees=sw.Table(np.arange(9.0)), entry=7)
    with pytest.warns(UserWarning, match="over at step 1 of a call"):
        inputs(later, ONE, TWO, THREE)


# Files


def test_a_mapping_with_time_is_read_back_and_another_table_is_named() -> None:
    def aim(obs: Array, call: Any) -> Array:
        return obs["b"] - call.start["b"]

    mapping = sw.from_function(
        still,
        sees=(
            sw.Part("a", history=3, fill="zeros", layout="step", order="newest"),
            sw.Elapsed(period=2.5, first=(0, 1), wave="sin"),
            sw.Table(np.arange(200.0).reshape(50, 4), slice(0, 2), rate=0.5, start=3),
            aim,
        ),
        anew=("elapsed", "history"),
        entry=-2,
    ).mapping
    data = json.loads(json.dumps(mapping.to_json()))
    assert len(json.dumps(data)) < 1000  # without the table
    assert PolicyMapping.from_json(data, mapping.functions(), mapping.tables()) == mapping
    with pytest.raises(DeclarationError, match=r"sees\[''\]\[2\] needs the table 'an array'"):
        PolicyMapping.from_json(data, mapping.functions())


def test_a_run_is_not_played_with_another_table(tmp_path: Path) -> None:
    def hierarchy(first: float) -> sw.Hierarchy:
        class Dances(sw.Skill):
            policy = sw.from_function(
                lambda x: (x[:, 0] > 0).astype(int), sees=sw.Table([first, -1.0, 1.0] * 200)
            )

        return sw.Hierarchy(
            "CartPole-v1", [Dances()], selector=lambda obs: ["dances"] * len(obs), call_steps=9
        )

    hierarchy(1.0).train(tmp_path, quiet=True)
    assert sw.load(tmp_path, hierarchy(1.0)).policy is not None
    with pytest.raises(RunError, match="needs the table 'an array'"):
        sw.load(tmp_path, hierarchy(-1.0))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Past(np.array([0, 1]), np.array([0]), 1),
        lambda: Past(np.array([0]), np.array([3]), 2),
        lambda: Past(np.array([10**7]), np.array([0]), 2),
        lambda: Past(np.array([0.5]), np.array([0]), 2),
        lambda: Past(np.array([0]), np.array([0]), 2, (2,)),
        lambda: Rows(np.zeros(3)),
        lambda: Rows(np.zeros((3, 1)), rate=-1.0),
        lambda: Clock(np.zeros((1, 2))),
        lambda: Clock(np.zeros(1), wave="sin"),
        lambda: Clock(np.zeros(1), period=0.0),
        lambda: Clock(np.zeros(1), period=1e-320),
        lambda: Clock(np.array([np.inf])),
        lambda: Rows(np.zeros((3, 1)), rate=np.inf),
    ],
)
def test_damaged_fields_of_a_file_are_refused(make: Any) -> None:
    with pytest.raises(PolicyError):
        make()


# A module's state in its buffers


class Counts(torch.nn.Module):
    """A module for one environment at a time, which counts its calls in a buffer."""

    def __init__(self, first: float = 0.0) -> None:
        super().__init__()
        self.register_buffer("count", torch.full((1, 1), first))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        self.count[:] = self.count + x[:, :1]
        return torch.cat([self.count, -self.count], dim=1)


@pytest.fixture
def counts(tmp_path: Path) -> Path:
    file = tmp_path / "counts.pt"
    torch.jit.save(torch.jit.script(Counts()), str(file))
    return file


def test_a_state_in_buffers_is_of_each_environment_and_starts_with_zeros(counts: Path) -> None:
    policy = sw.from_torch(counts, trust=True, sees="a", state="count").bind(SPACE, ACTION, "it")
    policy.try_out()
    memory = policy.start(2)
    action, memory = policy.act(memory, obs_of(ONE, TWO))
    action, memory = policy.act(memory, obs_of(ONE, TWO))
    assert action.tolist() == [[2, -2], [4, -4]]
    action, _ = policy.act(policy.start(1), obs_of(THREE))
    assert action.tolist() == [[3, -3]]


def test_a_state_in_buffers_may_start_with_a_value() -> None:
    how: Any = {"sees": "a"}
    with pytest.warns(UserWarning, match=r"'count' holds \[7.0\], but a state starts with zeros"):
        sw.from_torch(Counts(7.0), state="count", **how)
    for first in (5.0, [5.0]):
        policy = sw.from_torch(Counts(7.0), state={"count": first}, **how)
        bound = policy.bind(SPACE, ACTION, "it")
        assert bound.act(bound.start(1), obs_of(ONE))[0].tolist() == [[6, -6]]
        data = json.loads(json.dumps(bound.mapping.to_json()))
        assert PolicyMapping.from_json(data).to_json() == bound.mapping.to_json()
    with pytest.raises(PolicyError, match=r"first value of 'count' \(state\) has 2 numbers"):
        sw.from_torch(Counts(), state={"count": [1.0, 2.0]}, **how)


def test_a_hidden_buffer_is_named_with_what_to_write(counts: Path) -> None:
    with pytest.raises(PolicyError, match=r"keeps a hidden state, 'count'.*state=\('count',\)"):
        sw.evaluate(sw.from_torch(counts, trust=True, acts=(0,)), "Pendulum-v1", episodes=1)
    with pytest.raises(PolicyError, match=r"has no buffer 'cuont'.*'count'"):
        sw.from_torch(counts, trust=True, state="cuont")


def test_a_state_in_buffers_is_not_exported(tmp_path: Path) -> None:
    pytest.importorskip("onnx")

    class One(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("count", torch.zeros(1, 1))

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            self.count[:] = self.count + x[:, :1]
            return self.count.clone()

    class Counted(sw.Skill):
        policy = sw.from_torch(One(), state=("count",), sees=(0,))

    run = sw.Hierarchy(
        "Pendulum-v1", [Counted()], selector=lambda obs: ["counted"] * len(obs), call_steps=5
    ).train(tmp_path / "run", quiet=True)
    with pytest.raises(PolicyError, match="keeps its state in buffers"):
        run.export(tmp_path / "export")


def test_first_values_of_a_state_fit_it(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    helper, real = onnx.helper, onnx.TensorProto.FLOAT
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        [helper.make_node("Add", ["x", "h"], ["y"]), helper.make_node("Identity", ["y"], ["g"])],
        "adds", [value("x", real, [1, 2]), value("h", real, [1, 2])],
        [value("y", real, [1, 2]), value("g", real, [1, 2])],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(tmp_path / "adds.onnx"))
    how: Any = {"sees": {"x": "a"}, "output": "y"}
    policy = sw.from_onnx(tmp_path / "adds.onnx", state={"h": ("g", (3.0, 4.0))}, **how)
    bound = policy.bind(SPACE, ACTION, "it")
    assert bound.act(bound.start(1), obs_of(ONE))[0].tolist() == [[4, 9]]  # clipped at 9
    with pytest.raises(PolicyError, match="first value of 'h' has 3 numbers"):
        sw.from_onnx(tmp_path / "adds.onnx", state={"h": ("g", (1, 2, 3))}, **how)
    for wrong in (("g", "x"), ("g", np.nan), ("g", 1, 2), (1, "g"), 3.0):
        with pytest.raises(DeclarationError, match="state "):
            sw.from_onnx(tmp_path / "adds.onnx", state={"h": wrong}, **how)


def test_a_choice_may_have_a_history() -> None:
    space = Dict({"mode": Discrete(2)})
    policy = sw.from_function(still, sees=sw.Part("mode", history=2)).bind(space, ACTION, "it")
    given: list[Array] = []
    acting = policy.in_place
    memory = acting.start(1)
    for mode in (0, 1):
        obs = np.zeros(1, [("mode", np.int64)])
        obs["mode"] = mode
        turn = Turn(World(np.random.default_rng(0)), None, None)
        acting.act(memory, np.array([0]), obs, turn)
        given.append(memory["past.0"][0].copy())
    assert [x.tolist() for x in given] == [[[1, 0]], [[0, 1]]]


def test_only_what_is_read_later_is_remembered() -> None:
    policy = sw.from_function(still, sees=(sw.Part("b", history=400), "a"))
    memory = policy.bind(SPACE, ACTION, "it").in_place.start(3)
    assert memory["past.0"].shape == (3, 399, 1)


def test_a_number_alone_may_have_a_history() -> None:
    space = Dict({"mode": Discrete(2)})
    how: Any = {"one_hot": False, "history": 3}
    sw.from_function(still, sees=sw.Part("mode", **how)).bind(space, ACTION, "it").try_out()


def test_a_period_ends_although_it_is_rounded() -> None:
    clock = Clock(np.zeros(1), 0.56 / 0.01)  # 56.00000000000001
    assert clock(np.array([55, 56, 57])).ravel().tolist() == [55.0, 0.0, 57 - 0.56 / 0.01]
    assert Clock(np.zeros(1), 0.1)(np.arange(50)).max() < 1e-9
    assert Clock(np.zeros(1), 2.5)(np.array([4])).tolist() == [[1.5]]


def test_a_call_is_not_what_a_partial_function_has_set() -> None:
    def aim(obs: Array, call: int) -> Array:
        return np.full((len(obs), 1), float(call))

    assert inputs(sw.from_function(still, sees=partial(aim, call=4)), ONE) == [[4]]


def test_tables_stay_as_they_are() -> None:
    table = sw.Table([[1.0, 2.0]])
    for copied in (copy.deepcopy(table), pickle.loads(pickle.dumps(table))):
        assert copied == table
        with pytest.raises(ValueError, match="read-only"):
            copied.file.numbers[0] = 9.0
