"""``from_onnx(learn=True)``: a skill learns on from a file through its mapping, and goes home."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from skills.mapped_models import onnx_model
from toys import World

import skillweave as sw
from skillweave.errors import DeclarationError, PolicyError, RunError
from skillweave.policies.mapped import Outputs
from skillweave.policies.parts import Slice
from skillweave.policies.spaces import space_of
from skillweave.skills.learnable import GoalColumns, Layers
from skillweave.skills.onnx_layers import read_network, rewritten

onnx = pytest.importorskip("onnx")
ort = pytest.importorskip("onnxruntime")

RNG = np.random.default_rng(1)
MEAN = np.float32([0.5, -1.0, 2.0])
STD = np.float32([0.5, 2.0, 4.0])
W0 = RNG.normal(size=(3, 8)).astype(np.float32)
B0 = RNG.normal(size=8).astype(np.float32)
W1 = RNG.normal(size=(8, 6)).astype(np.float32)
B1 = RNG.normal(size=6).astype(np.float32)
W2 = RNG.normal(size=(6, 2)).astype(np.float32)
B2 = RNG.normal(size=2).astype(np.float32)
ACTIVE: dict[str, Any] = {
    "relu": lambda x: np.maximum(x, 0),
    "tanh": np.tanh,
    "elu": lambda x: np.where(x > 0, x, np.expm1(x)),
    "silu": lambda x: x / (1 + np.exp(-x)),
}


def layer(before: str, i: int, form: str, out: str) -> tuple[list[Any], dict[str, Any]]:
    """The nodes of a linear layer in one of its forms, and its constants."""
    weight, bias = (W0, W1, W2)[i], (B0, B1, B2)[i]
    w, b = f"w{i}", f"b{i}"
    if form == "MatMul":
        nodes = [("MatMul", [before, w], [f"p{i}"]), ("Add", [b, f"p{i}"], [out])]
        return nodes, {w: weight, b: bias}
    if form == "turned":  # as torch's exporter writes a weight that it does not fold
        nodes = [
            ("Transpose", [w], [f"t{i}"], {"perm": [1, 0]}),
            ("MatMul", [before, f"t{i}"], [f"p{i}"]),
            ("Add", [f"p{i}", b], [out]),
        ]
        return nodes, {w: weight.T.copy(), b: bias}
    if form == "scaled":
        nodes = [("Gemm", [before, w, b], [out], {"alpha": 0.5, "beta": 2.0})]
        return nodes, {w: 2 * weight, b: bias / 2}
    turned = form == "transB"
    nodes = [("Gemm", [before, w, b], [out], {"transB": int(turned)})]
    return nodes, {w: weight.T.copy() if turned else weight, b: bias}


def activation(kind: str, x: str, y: str) -> list[Any]:
    """The nodes of a nonlinearity."""
    if kind == "silu":
        return [("Sigmoid", [x], [f"{y}.s"]), ("Mul", [x, f"{y}.s"], [y])]
    if kind == "gelu":
        return [
            ("Div", [x, "root"], [f"{y}.d"]),
            ("Erf", [f"{y}.d"], [f"{y}.e"]),
            ("Add", [f"{y}.e", "one"], [f"{y}.a"]),
            ("Mul", [x, f"{y}.a"], [f"{y}.m"]),
            ("Mul", [f"{y}.m", "half"], [y]),
        ]
    return [({"relu": "Relu", "tanh": "Tanh", "elu": "Elu"}[kind], [x], [y])]


def model_file(path: Path, kind: str, form: str, norm: str = "", end: str = "") -> Path:
    """Write a network of three layers; ``norm`` before it, ``end`` after it."""
    constants: dict[str, Any] = {}
    nodes: list[Any] = [("Identity", ["my obs:0"], ["x"])]
    if norm:
        nodes.append(("Sub", ["x", "mean"], ["c"]))
        nodes.append((norm, ["c", "std"], ["n"]))
        constants = {"mean": MEAN, "std": STD if norm == "Div" else 1 / STD}
    if kind == "gelu":
        numbers = {"root": np.sqrt(2), "one": 1, "half": 0.5}
        constants |= {k: np.array(v, np.float32) for k, v in numbers.items()}
    flow = "n" if norm else "x"
    for i in range(3):
        out = "action" if i == 2 and not end else f"h{i}"
        made, given = layer(flow, i, form, out)
        nodes += made
        constants |= given
        if i < 2:
            nodes += activation(kind, out, f"a{i}")
        flow = f"a{i}"
    if end == "tanh":
        nodes.append(("Tanh", ["h2"], ["action"]))
    if end == "split":
        nodes.append(("Split", ["h2"], ["mean action", "raw"], {"axis": -1}))
        nodes.append(("Tanh", ["mean action"], ["action"]))
    table = np.arange(12, dtype=np.float32).reshape(4, 3)
    constants["table"] = table
    nodes += [
        ("Cast", ["time_step"], ["row"], {"to": 7}),
        ("Gather", ["table", "row"], ["reference"], {"axis": 0}),
    ]
    size = 1 if end == "split" else 2
    file = onnx_model(
        path,
        nodes,
        {"my obs:0": [1, 3], "time_step": [1]},
        {"reference": [1, 3], "action": [1, size]},
        constants,
    )
    model = onnx.load(file)
    model.metadata_props.add(key="joint_names", value="knee,hip")
    onnx.save(model, file)
    return file


def run_model(path: Path | bytes, x: Any, step: float = 2.0) -> list[Any]:
    """Return the outputs of a file for rows x (n, 3), one at a time, by onnxruntime alone."""
    session = ort.InferenceSession(path if isinstance(path, bytes) else str(path))
    step_of = np.array([step], np.float32)
    names = {i.name for i in session.get_inputs()}
    rows = [
        session.run(
            None, {k: v for k, v in (("my obs:0", row[None]), ("time_step", step_of)) if k in names}
        )
        for row in np.asarray(x, np.float32)
    ]
    return [np.concatenate(column) for column in zip(*rows, strict=True)]


def by_hand(layers: Layers, x: Any, offset: Any, scale: Any) -> Any:
    """Return the outputs of layers in plain NumPy."""
    x = (x - offset) * scale
    for i, (weight, bias) in enumerate(zip(layers.weights, layers.biases, strict=True)):
        if i:
            if layers.activation == "gelu":
                from math import erf

                x = 0.5 * x * (1 + np.vectorize(erf)(x / np.sqrt(2)))
            else:
                x = ACTIVE[layers.activation](x)
        x = x @ weight + bias
    return x


X = RNG.normal(size=(20, 3)) * 2
FORMS = [
    ("relu", "Gemm", "", ""),
    ("relu", "transB", "Sub", ""),
    ("elu", "transB", "Div", ""),
    ("tanh", "MatMul", "Mul", ""),
    ("tanh", "Gemm", "Div", "tanh"),
    ("silu", "Gemm", "Mul", "split"),
    ("silu", "turned", "", "tanh"),
    ("gelu", "scaled", "Div", ""),
]


@pytest.mark.parametrize(("kind", "form", "norm", "end"), FORMS)
def test_a_file_becomes_a_network_and_a_file(tmp_path, kind, form, norm, end):
    file = model_file(tmp_path / "m.onnx", kind, form, norm, end)
    data = file.read_bytes()
    found = read_network(data, "action", "m.onnx")
    assert (found.input, found.shape, found.squashes) == ("my obs:0", (3,), bool(end))
    assert found.layers.activation == kind
    wanted = by_hand(found.layers, X, found.offset, found.scale)
    wanted = np.tanh(wanted) if end else wanted
    reference, action = run_model(file, X)
    np.testing.assert_allclose(action, wanted, atol=1e-5, rtol=1e-5)
    assert rewritten(data, "action", found.layers, "m.onnx") == data or form == "scaled"
    # Other weights, as if they were learnt.
    learnt = replace(
        found.layers,
        weights=tuple(w + 0.1 * RNG.normal(size=w.shape) for w in found.layers.weights),
        biases=tuple(b + 0.1 for b in found.layers.biases),
    )
    again = rewritten(data, "action", learnt, "m.onnx")
    wanted = by_hand(learnt, X, found.offset, found.scale)
    wanted = np.tanh(wanted) if end else wanted
    other_reference, other = run_model(again, X)
    np.testing.assert_allclose(other, wanted, atol=1e-5, rtol=1e-5)
    np.testing.assert_array_equal(other_reference, reference)
    before, after = onnx.load_from_string(data), onnx.load_from_string(again)
    assert [x.key for x in after.metadata_props] == ["joint_names"]
    for part in ("input", "output", "node"):
        assert list(getattr(before.graph, part)) == list(getattr(after.graph, part))
    assert [x.name for x in before.graph.initializer] == [x.name for x in after.graph.initializer]
    assert list(before.opset_import) == list(after.opset_import)
    if end == "split":  # the deviations that the file does not use stay
        arrays = {x.name: onnx.numpy_helper.to_array(x) for x in after.graph.initializer}
        np.testing.assert_array_equal(arrays["w2"][:, 1], W2[:, 1])


def test_weights_in_nodes_without_a_bias_and_shared_ones(tmp_path):
    square = RNG.normal(size=(2, 2)).astype(np.float32)
    path = onnx_model(
        tmp_path / "m.onnx",
        [
            ("Constant", [], ["w0"], {"value": onnx.numpy_helper.from_array(W0[:, :2])}),
            ("MatMul", ["my obs:0", "w0"], ["h"]),
            ("Relu", ["h"], ["a"]),
            ("MatMul", ["a", "square"], ["action"]),
            ("MatMul", ["a", "square"], ["other"]),
        ],
        {"my obs:0": [1, 3]},
        {"action": [1, 2], "other": [1, 2]},
        {"square": square},
    )
    data = path.read_bytes()
    found = read_network(data, "action", "m.onnx")
    assert [b.tolist() for b in found.layers.biases] == [[0, 0], [0, 0]]
    learnt = replace(
        found.layers,
        weights=(found.layers.weights[0], 2.0 * square),
        biases=(np.zeros(2), np.array([0.5, -1.0])),
    )
    action, other = run_model(rewritten(data, "action", learnt, "m.onnx"), X)
    hidden = np.maximum(X @ W0[:, :2], 0)
    np.testing.assert_allclose(action, hidden @ (2 * square) + [0.5, -1.0], atol=1e-5)
    np.testing.assert_allclose(other, hidden @ square, atol=1e-5)  # it shared the weight


def test_the_columns_of_a_goal_by_hand():
    layers = Layers((np.array([[1.0], [2.0], [3.0]]),), (np.array([10.0]),), "relu")
    places = np.array([1])
    fixed = GoalColumns(places, np.ones(1), np.zeros(1), np.array([5.0]))
    folded = fixed.fold(layers)
    assert folded.weights[0].tolist() == [[1.0], [3.0]]
    assert folded.biases[0].tolist() == [20.0]  # 10 + 5 * 2
    free = GoalColumns(places, np.array([4.0]), np.array([-1.0]))
    joint = free.fold(layers)
    assert joint.weights[0].tolist() == [[1.0], [3.0], [8.0]]  # the goal is last, times 4
    assert joint.biases[0].tolist() == [8.0]  # 10 - 1 * 2
    for one, there in ((fixed, folded), (free, joint)):
        home = one.unfold(there, layers)
        assert home.weights[0].tolist() == layers.weights[0].tolist()
        assert home.biases[0].tolist() == [10.0]


def test_outputs_are_written_as_actions_and_read_back_by_hand():
    space = space_of(gym.spaces.Box(-1.0, 2.0, (2,), np.float32))
    acts = {"scale": np.array([0.5, -2.0]), "offset": np.array([0.1, 1.0]), "clip": (-3.0, 0.4)}
    outputs = Outputs(space, to=(0, 1), **acts)
    whole = space_of(gym.spaces.Box(-np.inf, np.inf, (2,), np.float32))
    part = Slice(space, whole, axes=1, outputs=outputs)
    # 0.4 * 0.5 + 0.1, and 0.4 * -2 + 1; -3 * 0.5 + 0.1 is below -1, and -1 * -2 + 1 above 2
    written = part.write(np.float32([[5.0, 5.0], [-9.0, -1.0]]), None)
    np.testing.assert_allclose(written, [[0.3, 0.2], [-1.0, 2.0]], atol=1e-6)
    np.testing.assert_allclose(part.read(np.float32([[0.2, 0.6]])), [[0.2, 0.2]], atol=1e-6)
    with pytest.raises(PolicyError, match=r"Part\.outputs"):
        Slice(space, space_of(gym.spaces.Box(-1, 1, (3,))), axes=1, outputs=outputs)


# Skills ---------------------------------------------------------------------------------------

SPACE = gym.spaces.Dict(
    {
        "joints": gym.spaces.Box(-4, 4, (4,), np.float32),
        "gyro": gym.spaces.Box(-np.inf, np.inf, (2,), np.float32),
    }
)
PUSH = gym.spaces.Box(np.float32([-1.0, -0.2]), np.float32([2.0, 0.3]))
HOME = (0.1, 0.9, -1.8, 0.3)
GOALS = gym.spaces.Box(-1, 1, (2,), np.float32)
SMALL = sw.PPO(num_envs=2, n_steps=8, batch_size=16, update_epochs=2, learning_rate=1e-2)
STILL = replace(SMALL, learning_rate=1e-12)
FILES = {"plain": ("elu", ""), "tanh": ("silu", "tanh")}
SEES = (
    "gyro",
    sw.Goal(scale=(2.0, 0.5), offset=0.25, low=-1.0, high=1.0),
    sw.Part("joints", slice(0, 3), offset=HOME[:3], scale=0.5, clip=(-1, 1)),
    sw.Part("joints", held=(1, 3), held_at=0.7),
    lambda obs: obs["gyro"][:, :1] - obs["joints"][:, :1],
)
ACTS = sw.Acts(scale=(0.5, -0.3), offset=(0.2, 0.1), clip=(-0.9, 0.8))


def robot_file(path: Path, kind: str, end: str, size: int = 12, actions: int = 2) -> Path:
    """A file with a normalisation and one hidden layer, for the robot's mapping."""
    rng = np.random.default_rng(3)
    constants = {
        "mean": rng.normal(size=(1, size)),
        "std": rng.uniform(0.5, 2.0, size),
        "w0": rng.normal(size=(size, 8)) / 2,
        "b0": rng.normal(size=8),
        "w1": rng.normal(size=(8, actions)) / 2,
        "b1": rng.normal(size=actions),
    }
    last = "h1" if end else "action"
    nodes = [
        ("Sub", ["obs", "mean"], ["c"]),
        ("Div", ["c", "std"], ["n"]),
        ("Gemm", ["n", "w0", "b0"], ["h0"]),
        *activation(kind, "h0", "a0"),
        ("Gemm", ["a0", "w1", "b1"], [last]),
        *([("Tanh", ["h1"], ["action"])] if end else []),
    ]
    single = {k: v.astype(np.float32) for k, v in constants.items()}
    return onnx_model(path, nodes, {"obs": [1, size]}, {"action": [1, actions]}, single)


def commanded(obs):
    """A goal that follows from the observation, partly out of range."""
    return obs["gyro"] * 2


def skills_of(policy: Any, goal_space: Any = None, **fields: Any) -> sw.Skill:
    """A skill with a policy."""
    if goal_space is not None:
        fields["reward"] = lambda self, step: step.reward + step.goal[:, 0]
    return type("Walk", (sw.Skill,), {"policy": policy, "goal_space": goal_space, **fields})()


class Stand(sw.Skill):
    policy = staticmethod(lambda obs: np.zeros((len(obs["gyro"]), 2), np.float32))


def robot(*skills: sw.Skill, space: Any = SPACE, action: Any = PUSH) -> sw.Hierarchy:
    """A hierarchy of noise, in which the walk learns apart."""
    env = sw.EnvSpec(lambda: World(space, action), engine="sync", workers=1)
    calls = [skill.name for skill in skills if skill.goal_space is None]
    selector = (lambda obs: calls[:1] * len(obs)) if calls else None
    selector = selector or (lambda obs: (["walk"] * len(obs), np.zeros((len(obs), 2), np.float32)))
    return sw.Hierarchy(
        env, skills, selector=selector, learn="apart", call_steps=5, algorithm=SMALL, steps=32
    )


def player_of(run, goal=None):
    """The walk alone."""
    return run.player(skill="walk", goal=goal)


def observations(n: int = 30) -> list[Any]:
    SPACE.seed(5)
    return [SPACE.sample() for _ in range(n)]


CASES = {
    "fixed": ({"goal": (0.5, -0.3)}, None, None),
    "function": ({"goal": commanded}, None, None),
    "of calls": ({}, GOALS, np.float32([0.5, -0.3])),
}


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("case", CASES)
def test_it_begins_as_the_file_and_goes_home_as_it_acts(tmp_path, file, case):
    given, goal_space, goal = CASES[case]
    path = robot_file(tmp_path / "walk.onnx", *FILES[file])
    how = {"sees": SEES, "acts": ACTS, "observation_space": SPACE, "action_space": PUSH, **given}
    if file == "tanh":  # nothing is cut inside of [-1, 1] where a clip is left out
        how["acts"] = replace(ACTS, clip=None)
    ready = robot(skills_of(sw.from_onnx(path, **how), goal_space)).train(
        tmp_path / "ready", quiet=True
    )
    wanted, obs = player_of(ready, goal), observations()

    def learn(algorithm, name):
        walk = skills_of(sw.from_onnx(path, learn=True, **how), goal_space, algorithm=algorithm)
        return robot(walk).train(tmp_path / name, seed=1, quiet=True)

    begun = player_of(learn(STILL, "still"), goal)
    first = np.stack([wanted.act(x) for x in obs])
    np.testing.assert_allclose([begun.act(x) for x in obs], first, atol=1e-5, rtol=1e-5)
    run = learn(SMALL, "run")
    acts = player_of(run, goal)
    learnt = np.stack([acts.act(x) for x in obs])
    assert np.abs(learnt - first).max() > 1e-3
    again = run.save_onnx("walk", tmp_path / "walk-2.onnx")
    home = robot(skills_of(sw.from_onnx(again, **how), goal_space)).train(
        tmp_path / "home", quiet=True
    )
    player = player_of(home, goal)
    np.testing.assert_allclose([player.act(x) for x in obs], learnt, atol=1e-5, rtol=1e-5)
    loaded = robot(*run.hierarchy.skills).load(tmp_path / "run")
    assert loaded.save_onnx("walk", tmp_path / "3.onnx").read_bytes() == again.read_bytes()


def test_a_run_needs_no_code_and_no_file_where_its_mapping_is_data(tmp_path):
    path = robot_file(tmp_path / "walk.onnx", "elu", "", 8)
    sees = (sw.Goal(), "gyro", sw.Part("joints", offset=HOME))
    walk = sw.from_onnx(path, sees=sees, goal=(0.5, 0.1), acts=ACTS, learn=True)
    declared = robot(skills_of(walk), Stand())
    run = declared.train(tmp_path / "run", quiet=True)
    content = run.info()
    entry = content["skills"][0]
    assert entry["policy"]["kind"] == "onnx"
    assert entry["learns_on"]["mapping"]["goal"] == [0.5, 0.1]
    assert not entry.get("ready")
    path.unlink()  # the run has a copy
    first = run.save_onnx("walk", tmp_path / "a.onnx").read_bytes()
    weights = run.save_weights(tmp_path / "w.safetensors")
    from_weights = declared.load_weights(weights)
    obs = observations(3)
    acts, others = player_of(run), player_of(from_weights)
    np.testing.assert_array_equal([acts.act(x) for x in obs], [others.act(x) for x in obs])
    with pytest.raises(RunError, match="load the run's directory"):
        from_weights.save_onnx("walk", tmp_path / "b.onnx")
    copy = tmp_path / "run" / "policies" / "walk.onnx"
    copy.write_bytes(first)
    with pytest.raises(RunError, match="damaged"):
        run.save_onnx("walk", tmp_path / "b.onnx")
    copy.unlink()
    with pytest.raises(RunError, match="missing"):
        run.save_onnx("walk", tmp_path / "b.onnx")
    with pytest.raises(DeclarationError, match=r"run\.export"):
        run.save_onnx("stand", tmp_path / "b.onnx")
    with pytest.raises(DeclarationError, match="wlak"):
        run.save_onnx("wlak", tmp_path / "b.onnx")


def test_a_run_is_loaded_without_its_code(tmp_path):
    path = robot_file(tmp_path / "walk.onnx", "elu", "tanh", 3, 1)
    policy = sw.from_onnx(path, sees=sw.Part(scale=0.1), acts=sw.Acts(scale=0.7), learn=True)
    walk = skills_of(policy)
    rest = type("Rest", (sw.Skill,), {})()
    declared = sw.Hierarchy(
        "Pendulum-v1", [walk, rest], steps=64, call_steps=4, algorithm=SMALL, selector=SMALL
    )
    run = declared.train(tmp_path / "run", quiet=True)
    path.unlink()
    loaded = sw.load(tmp_path / "run")
    obs = [np.float32([np.cos(a), np.sin(a), a]) for a in range(5)]
    acts, others = player_of(run), player_of(loaded)
    np.testing.assert_array_equal([acts.act(x) for x in obs], [others.act(x) for x in obs])
    files = [x.save_onnx("walk", tmp_path / f"{i}.onnx") for i, x in enumerate((run, loaded))]
    assert files[0].read_bytes() == files[1].read_bytes()
    session = ort.InferenceSession(str(files[0]))
    for x in obs:
        (action,) = session.run(None, {"obs": 0.1 * x[None]})
        np.testing.assert_allclose(others.act(x), 0.7 * action[0], atol=1e-5)


def test_two_skills_learn_together_and_export(tmp_path):
    pytest.importorskip("onnxscript")
    from skillweave.export.runner import Runner

    path = robot_file(tmp_path / "walk.onnx", "silu", "tanh", 8)
    how = {"sees": (sw.Goal(), "gyro", "joints"), "goal": (0.2, 0.1), "acts": ACTS}
    walk, other = (
        skills_of(sw.from_onnx(path, learn=True, **how), name=n) for n in ("walk", "run")
    )
    hierarchy = sw.Hierarchy(
        sw.EnvSpec(lambda: World(SPACE, PUSH), engine="sync", workers=1),
        [walk, other],
        steps=64,
        call_steps=4,
        algorithm=SMALL,
        selector=SMALL,
    )
    run = hierarchy.train(tmp_path / "run", quiet=True)
    folder = tmp_path / "out"
    run.export(folder)
    runner, player = Runner(folder), run.player()
    for obs in observations():
        np.testing.assert_allclose(runner.act(obs), player.act(obs), atol=1e-6)
    assert run.save_onnx("run", tmp_path / "r.onnx").exists()


def test_a_skill_of_an_inner_hierarchy_goes_home_and_no_other_mapping_loads(tmp_path):
    path = robot_file(tmp_path / "walk.onnx", "elu", "", 8)

    def declared(scale):
        sees = (sw.Part("joints", scale=scale), "joints")
        walk = skills_of(sw.from_onnx(path, sees=sees, learn=True), steps=32)
        env = sw.EnvSpec(lambda: World(SPACE, PUSH), engine="sync", workers=1)
        how = {"learn": "apart", "call_steps": 5, "algorithm": SMALL}
        inner = sw.Hierarchy(env, [walk], selector=lambda obs: ["walk"] * len(obs), **how)
        skills = [inner.as_skill("inner")]
        return sw.Hierarchy(env, skills, selector=lambda obs: ["inner"] * len(obs), **how)

    run = declared(0.5).train(tmp_path / "run", quiet=True)
    again = run.save_onnx("inner/walk", tmp_path / "2.onnx")
    obs = observations(5)
    given = np.stack([np.concatenate([0.5 * x["joints"], x["joints"]]) for x in obs])
    session = ort.InferenceSession(str(again))
    (wanted,) = zip(*(session.run(None, {"obs": row[None]}) for row in given), strict=True)
    player = run.player(skill="inner/walk")
    acts = [player.act(x) for x in obs]
    wanted = np.concatenate(wanted).clip(PUSH.low, PUSH.high)
    np.testing.assert_allclose(acts, wanted, atol=1e-5, rtol=1e-5)
    with pytest.raises(RunError, match="learns_on"):
        declared(0.4).load(tmp_path / "run")


# Refusals -------------------------------------------------------------------------------------

LAYER: dict[str, Any] = {"w": np.eye(3, 2, dtype=np.float32), "b": np.zeros(2, np.float32)}
GEMM = ("Gemm", ["x", "w", "b"], ["action"])
KINDS: dict[str, Any] = {
    "ReduceMean": ([("ReduceMean", ["my obs:0"], ["x"], {"axes": [1], "keepdims": 1}), GEMM], {}),
    "operators Slice, Concat": (
        [
            ("Slice", ["my obs:0", "from", "to"], ["s"]),
            ("Concat", ["s", "my obs:0"], ["x"], {"axis": 1}),
            GEMM,
        ],
        {"from": np.array([0, 0]), "to": np.array([1, 1])},
    ),
    "LSTM": ([("LSTM", ["my obs:0", "w", "b"], ["x"], {"hidden_size": 2}), GEMM], {}),
    "in this order": ([("Relu", ["my obs:0"], ["x"]), GEMM], {}),
    "Elu has another form": (
        [("Elu", ["my obs:0"], ["x"], {"alpha": 0.5}), GEMM],
        {},
    ),
    "relu and tanh": (
        [
            ("Gemm", ["my obs:0", "w", "b"], ["a"]),
            ("Relu", ["a"], ["c"]),
            ("MatMul", ["c", "v"], ["d"]),
            ("Tanh", ["d"], ["e"]),
            ("MatMul", ["e", "v"], ["action"]),
        ],
        {"v": np.eye(2, dtype=np.float32)},
    ),
    "inputs my obs:0, time_step, not on one": (
        [("MatMul", ["my obs:0", "time_step"], ["action"])],
        {},
    ),
    "used in another way": (
        [("Gemm", ["my obs:0", "w", "b"], ["a"]), ("Mul", ["a", "a"], ["action"])],
        {},
    ),
    "NaN or infinity": (
        [("Sub", ["my obs:0", "zero"], ["s"]), ("Div", ["s", "zero"], ["x"]), GEMM],
        {"zero": np.zeros(3, np.float32)},
    ),
}


@pytest.mark.parametrize("words", KINDS)
def test_other_networks_are_refused_by_name(tmp_path, words):
    nodes, more = KINDS[words]
    inputs = {"my obs:0": [1, 3], "time_step": [3, 2]}
    path = onnx_model(tmp_path / "m.onnx", nodes, inputs, {"action": [1, 2]}, LAYER | more)
    with pytest.raises(PolicyError, match=words):
        sw.from_onnx(path, learn=True)


TOO_WIDE = gym.spaces.Box(-2, 2, (2,), np.float32)
GIVEN: dict[str, Any] = {
    "sees and acts, but its policy": ({}, {"sees": "gyro", "acts": (0,)}),
    "takes no goal, but its skill has goals": (
        {"sees": ("joints", "joints")},
        {"goal_space": GOALS},
    ),
    "sees has Goal() 2 times": ({"sees": (sw.Goal(), sw.Goal(), "joints")}, {"goal_space": GOALS}),
    "there is no goal: give goal=": ({"sees": (sw.Goal(), "gyro", "joints")}, {}),
    "nothing but Goal()": ({"sees": sw.Goal(), "goal": (0.0,) * 8}, {}),
    "Goal has a clip": (
        {"sees": (sw.Goal(clip=(-1, 1)), "gyro", "joints")},
        {"goal_space": GOALS},
    ),
    "give goal_space that range": (
        {"sees": (sw.Goal(low=-1, high=1), "gyro", "joints")},
        {"goal_space": TOO_WIDE},
    ),
    "2 stay unset": ({"sees": ("gyro", "joints")}, {}),
    "sees has the inputs 'time_step'": ({"sees": {"time_step": "gyro"}}, {}),
    "let sees= give the parts": ({}, {}),
    "observation_space": ({"observation_space": GOALS, "sees": ("joints", "joints")}, {}),
    "it scales 2": ({"sees": ("joints", "joints"), "acts": sw.Acts(scale=(1, 2, 3))}, {}),
}


@pytest.mark.parametrize("words", GIVEN)
def test_mappings_that_do_not_fit_are_refused_by_name(tmp_path, words):
    path = robot_file(tmp_path / "walk.onnx", "elu", "", 8)
    how, fields = GIVEN[words]
    with pytest.raises(DeclarationError, match=re.escape(words)):
        robot(skills_of(sw.from_onnx(path, learn=True, **how), **fields)).train(
            tmp_path / "run", quiet=True
        )


def test_what_else_a_file_cannot_do(tmp_path):
    path = robot_file(tmp_path / "walk.onnx", "elu", "tanh", 8)
    walk = sw.from_onnx(path, sees=("joints", "joints"), learn=True)
    with pytest.raises(DeclarationError, match="ends in Tanh, which logits"):
        robot(skills_of(walk), action=gym.spaces.Discrete(2)).train(tmp_path / "run", quiet=True)
    with pytest.raises(DeclarationError, match="learns on by PPO"):
        robot(skills_of(walk, algorithm=sw.SAC())).train(tmp_path / "run", quiet=True)
    with pytest.raises(DeclarationError, match="write it as the skill's policy"):
        sw.train_agent(lambda: World(SPACE, PUSH), SMALL, 32, start_from=walk, quiet=True)


def test_nan_in_a_file_and_an_output_without_a_name(tmp_path):
    nan = {**LAYER, "b": np.float32([0, np.nan])}
    nodes = [("Gemm", ["my obs:0", "w", "b"], ["action"])]
    path = onnx_model(tmp_path / "m.onnx", nodes, {"my obs:0": [1, 3]}, {"action": [1, 2]}, nan)
    with pytest.raises(PolicyError, match="NaN"):
        sw.from_onnx(path, learn=True)
    nodes = [("Gemm", ["my obs:0", "w", "b"], [name]) for name in ("left", "right")]
    shapes = {"left": [1, 2], "right": [1, 2]}
    path = onnx_model(tmp_path / "m.onnx", nodes, {"my obs:0": [1, 3]}, shapes, LAYER)
    with pytest.raises(DeclarationError, match="name the one that is the action, output='left'"):
        sw.from_onnx(path, learn=True)
    assert sw.from_onnx(path, output="right", learn=True).file.output == "right"
    with pytest.raises(PolicyError, match="has no output 'rigth'"):
        sw.from_onnx(path, output="rigth", learn=True)
