"""``sw.inputs``: the wrong part of a mapping is named, and none of the right one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from robots.walker import HOME, ORDER, Walker, policy_of, right, trained_on, write

import skillweave as sw
from skillweave.errors import DeclarationError
from skillweave.toys.balancer import Balancer

pytest.importorskip("onnxruntime")
ACTS = sw.Acts(offset=HOME)
LEFT = sw.Acts(to=(0, 1), rest=0.0)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("walker") / "walk.onnx"
    write(path)
    return path


def mapped(file: Path, acts: sw.Acts = ACTS, order: Any = ORDER, **changed: Any) -> Any:
    parts = right() | changed
    return sw.from_onnx(file, sees=tuple(parts[name] for name in order), acts=acts)


def test_of_the_right_mapping_nothing_is_named(file: Path) -> None:
    sheet = sw.inputs(mapped(file), Walker)
    assert sheet.far == ()
    assert sheet.steps == 100
    assert [part.name for part in sheet.parts] == [*ORDER]
    mean, deviation = trained_on()
    joints = sheet.parts[2]
    assert joints.mean == pytest.approx(mean[6:10], abs=1e-6)
    assert joints.deviation == pytest.approx(deviation[6:10], abs=1e-6)
    assert abs(joints.reset).max() < 0.1
    assert (joints.low < joints.high).all()
    assert "far off" not in str(sheet)
    assert "carries no mean" not in str(sheet)


LEGS = [2, 3, 0, 1]
TURNED = [1, 2, 0]
WRONG: dict[str, tuple[set[str], dict[str, Any]]] = {
    "two parts swapped": ({"gyro", "gravity"}, {"gyro": "gravity", "gravity": "gyro"}),
    "a sign": ({"gravity"}, {"gravity": sw.Part("gravity", scale=-1.0)}),
    "an offset left out": ({"joints"}, {"joints": "joints"}),
    "scale 0.05": ({"speeds"}, {"speeds": sw.Part("speeds", scale=0.05)}),
    "scale 0.2": ({"speeds"}, {"speeds": sw.Part("speeds", scale=0.2)}),
    "scale 10": ({"joints"}, {"joints": sw.Part("joints", offset=HOME, scale=10.0)}),
    "legs swapped": (
        {"joints", "speeds"},
        {"joints": sw.Part("joints", LEGS, offset=HOME[LEGS]), "speeds": sw.Part("speeds", LEGS)},
    ),
    "order of joints": (
        {"joints"}, {"joints": sw.Part("joints", [1, 3, 0, 2], offset=HOME[[1, 3, 0, 2]])},
    ),
    "gyro in another frame": ({"gyro"}, {"gyro": sw.Part("gyro", TURNED)}),
    "a sign of the gyro": ({"gyro"}, {"gyro": sw.Part("gyro", scale=-1.0)}),
    "a sign of the speeds": ({"speeds"}, {"speeds": sw.Part("speeds", scale=-1.0)}),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_the_wrong_part_is_named(case: str, file: Path) -> None:
    wrong, changed = WRONG[case]
    sheet = sw.inputs(mapped(file, **changed), Walker)
    assert sheet.far
    assert {part.name.partition("[")[0] for part in sheet.far} <= wrong, sheet.sentences()


def test_means_are_read_of_other_forms_too(file: Path, tmp_path: Path) -> None:
    other = tmp_path / "times.onnx"
    write(other, divides=False)
    read = [mapped(path).normalized()[""] for path in (file, other)]
    for one, two in zip(*read, strict=True):
        assert one == pytest.approx(two, rel=1e-4)
    import torch

    class Normalizer(torch.nn.Module):
        """As rsl_rl has it."""

        def __init__(self) -> None:
            super().__init__()
            mean, deviation = trained_on()
            self.register_buffer("_mean", torch.tensor(mean)[None].float())
            self.register_buffer("_std", torch.tensor(deviation)[None].float())
            self.eps = 0.01

        def forward(self, x: Any) -> Any:
            return (x - self._mean) / (self._std + self.eps)

    module = torch.nn.Sequential(Normalizer(), torch.nn.Linear(14, 4))
    found = sw.from_torch(module, sees=tuple(right().values())).normalized()[""]
    assert found[0] == pytest.approx(read[0][0], abs=1e-5)
    assert found[1] == pytest.approx(read[0][1] + 0.01, abs=1e-5)


def test_without_a_mean_values_are_shown_and_the_order_is_still_looked_at(tmp_path: Path) -> None:
    plain = tmp_path / "plain.onnx"
    write(plain, carries=False)
    sheet = sw.inputs(mapped(plain), Walker)
    assert sheet.far == ()
    assert "carries no mean" in str(sheet)
    swapped = mapped(plain, **WRONG["legs swapped"][1])
    far = {part.name for part in sw.inputs(swapped, Walker).far}
    assert far == {"joints[2, 3, 0, ...]", "speeds[2, 3, 0, ...]"}
    half = sw.from_function(lambda x: x, sees=(sw.Part("joints", slice(1, 3)),), acts=LEFT)
    assert [part.name for part in sw.inputs(half, Walker).parts] == ["joints[1:3]"]
    function = sw.from_function(policy_of, sees=tuple(right().values()), acts=ACTS)
    assert sw.inputs(function, Walker).far == ()


def test_outputs_at_the_limits_are_named(file: Path) -> None:
    sheet = sw.inputs(mapped(file, sw.Acts(scale=20.0, offset=HOME)), Walker)
    assert sheet.outputs is not None
    assert (sheet.outputs.at_limit > 0.2).any()
    assert "at its limit" in str(sheet)


def test_it_is_written_as_json_by_the_command(
    file: Path, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from skillweave.cli import main

    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(
        "import skillweave as sw\n"
        "from robots.walker import HOME, Walker as env, right\n"
        f"walk = sw.from_onnx({str(file)!r}, sees=tuple(right().values()),\n"
        "    acts=sw.Acts(offset=HOME))\n"
        "skills = {'walk': walk}\n"
    )
    assert main(["inputs", "mine.py", "--json", "--episodes", "2"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["policies"]["walk"]["far"] == []
    assert len(content["policies"]["walk"]["parts"]) == 4
    Path("none.py").write_text("skills = {}")
    assert main(["inputs", "none.py"]) == 1
    assert "env" in capsys.readouterr().err
    sheet = sw.inputs(mapped(file), Walker, episodes=1)
    assert "<table>" in sheet._repr_html_()


class Drone(gym.Env[Any, Any]):
    """Roll, pitch and thrust move it along y, x and z; a body that turns, and a goal."""

    observation_space = gym.spaces.Dict(
        {k: gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
         for k in ("pos", "vel", "gyro", "gravity")}
    )  # fmt: skip
    action_space = gym.spaces.Box(-1, 1, (3,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.pos, self.vel = self.np_random.uniform(-1, 1, (2, 3))
        self.gyro = self.np_random.uniform(-0.3, 0.3, 3)
        self.gravity = np.array([0.0, 0.0, -1.0])
        return self._obs(), {}

    def _obs(self) -> Any:
        names = ("pos", "vel", "gyro", "gravity")
        return {k: np.asarray(getattr(self, k), np.float32) for k in names}

    def step(self, action: Any) -> Any:
        self.vel = self.vel + 0.1 * np.float64(action)[[1, 0, 2]] - 0.02 * self.vel
        self.pos = self.pos + 0.1 * self.vel
        self.gyro = 0.98 * self.gyro + 0.1 * np.cross(self.gravity, [0.0, 0.0, -1.0])
        self.gravity = self.gravity + 0.1 * np.cross(self.gravity, self.gyro)
        self.gravity = self.gravity / np.linalg.norm(self.gravity)
        return self._obs(), 0.0, False, False, {}


def test_a_place_is_no_joint_and_a_speed_no_gyro() -> None:
    def steer(x: Any) -> Any:
        return -0.5 * (x[:, [1, 0, 2]] + x[:, [4, 3, 5]])

    drone = sw.from_function(steer, sees=("pos", "vel", "gyro", "gravity"))
    assert sw.inputs(drone, Drone).far == ()
    reach = sw.from_function(lambda x: np.clip(0.3 * x, -1, 1), sees=("gyro",))
    assert sw.inputs(reach, Drone).far == ()


def test_a_command_a_phase_and_wide_starts_are_not_far(tmp_path: Path) -> None:
    class Paced(Walker):
        observation_space = gym.spaces.Dict(
            Walker.observation_space.spaces
            | {k: gym.spaces.Box(-9, 9, (1,), np.float32) for k in ("command", "phase", "place")}
        )
        drawn = False

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            rng = np.random.default_rng(seed)
            self.t = int(rng.integers(50)) if self.drawn else 0
            self.place = rng.uniform(-1, 1, 1)
            self.command = rng.uniform(-1, 1, 1) if self.drawn else np.ones(1)
            return super().reset(seed=seed)

        def _obs(self) -> Any:
            found = super()._obs() | {"phase": np.float32([self.t / 50 % 1.0])}
            return found | {k: np.float32(getattr(self, k)) for k in ("command", "place")}

        def step(self, action: Any) -> Any:
            self.t += 1
            self.place = 0.98 * self.place
            return super().step(action)

    names = (*ORDER, "command", "phase", "place")

    def all_of(obs: Any) -> Any:
        return np.concatenate([np.float64(obs[k]) - (HOME if k == "joints" else 0) for k in names])

    class Drawn(Paced):
        drawn = True

    rows = []
    for episode in range(20):
        env = Drawn()
        obs, _ = env.reset(seed=episode)
        for _ in range(60):
            rows.append(all_of(obs))
            obs, *_ = env.step(HOME + policy_of(rows[-1][None, :14])[0])
    path = tmp_path / "paced.onnx"
    write(path, also=(np.mean(rows, axis=0)[14:], np.std(rows, axis=0)[14:]))
    parts = right() | {k: k for k in names[4:]}
    policy = sw.from_onnx(path, sees=tuple(parts[k] for k in names), acts=ACTS)
    for seed in range(4):
        assert sw.inputs(policy, Paced, seed=seed).far == ()


def test_dicts_and_choices_of_a_part_are_looked_at_too() -> None:
    whole = sw.from_function(lambda obs: np.zeros((len(obs["gyro"]), 4)))
    with pytest.raises(DeclarationError, match="sees="):
        sw.inputs(whole, Walker)
    chosen = sw.from_function(
        lambda x: np.zeros(len(x), np.int64),
        sees=(sw.Part(places=(0, 1)),),
        acts=sw.Acts(to=(1, 0)),
    )
    assert sw.inputs(chosen, "CartPole-v1", steps=5, episodes=2).outputs is None

    class Named(Walker):
        action_space = gym.spaces.Dict({"legs": Walker.action_space})

        def step(self, action: Any) -> Any:
            return super().step(action["legs"])

    named = sw.from_function(lambda x: {"legs": np.tile(HOME, (len(x), 1))}, sees=("joints",))
    assert sw.inputs(named, Named, steps=5, episodes=2).outputs is None


def test_choices_whole_observations_and_mistakes(file: Path) -> None:
    balance = sw.from_function(lambda obs: (obs[:, 2] > 0).astype(np.int64))
    sheet = sw.inputs(balance, "CartPole-v1", steps=20, episodes=2)
    assert sheet.outputs is None
    assert [part.numbers for part in sheet.parts] == [4]
    with pytest.raises(DeclarationError, match="from_onnx"):
        sw.inputs(sw.PPO(), "CartPole-v1")
    with pytest.raises(DeclarationError, match="episodes"):
        sw.inputs(balance, "CartPole-v1", episodes=0)


def test_of_a_history_what_is_now_is_compared() -> None:
    """Each part has its numbers of this inference, wherever these stand in the input."""
    how: dict[str, Any] = {"history": 3}
    sees = (sw.Part("tilt", **how), sw.Part("gyro", order="newest", **how), "speed")
    policy = sw.from_function(lambda x: np.zeros((len(x), 2)), sees=sees)
    found = {part.name: part for part in sw.inputs(policy, Balancer, steps=10).parts}
    alone = sw.from_function(lambda x: np.zeros((len(x), 2)), sees=("tilt", "gyro", "speed"))
    for part in sw.inputs(alone, Balancer, steps=10).parts:
        assert found[part.name].low.tolist() == part.low.tolist()
        assert found[part.name].high.tolist() == part.high.tolist()


def test_a_clock_and_a_table_are_not_far_off(tmp_path: Path) -> None:
    """In a hundred steps a motion may stand still: that says nothing about the mapping."""
    onnx = pytest.importorskip("onnx")
    helper, real = onnx.helper, onnx.TensorProto.FLOAT
    mean, spread = np.float32([0, 0, 0, 500, 0.7]), np.float32([0.1, 0.3, 0.4, 10, 0.7])
    nodes = [
        helper.make_node("Sub", ["obs", "mean"], ["a"]),
        helper.make_node("Div", ["a", "spread"], ["b"]),
        helper.make_node("MatMul", ["b", "weights"], ["actions"]),
    ]
    known = {"mean": mean, "spread": spread, "weights": np.zeros((5, 2), np.float32)}
    stored = [onnx.numpy_helper.from_array(x, name) for name, x in known.items()]
    graph = helper.make_graph(
        nodes, "walk", [helper.make_tensor_value_info("obs", real, [1, 5])],
        [helper.make_tensor_value_info("actions", real, [1, 2])], stored,
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, str(tmp_path / "walk.onnx"))
    sees = ("tilt", "gyro", "speed", sw.Elapsed(), sw.Table(np.zeros(200)))
    sheet = sw.inputs(sw.from_onnx(tmp_path / "walk.onnx", sees=sees), Balancer)
    assert [part.why for part in sheet.parts if part.name in ("Elapsed()", "Table()")] == ["", ""]
