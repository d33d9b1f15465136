"""``sw.inputs``: the wrong part of a mapping is named, and none of the right one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots.walker import HOME, ORDER, Walker, policy_of, right, trained_on, write

import skillweave as sw
from skillweave.errors import DeclarationError

pytest.importorskip("onnxruntime")
ACTS = sw.Acts(offset=HOME)


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
    assert {part.name for part in sheet.far}
    assert {part.name for part in sheet.far} <= wrong, sheet.sentences()


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
    assert {part.name for part in sw.inputs(swapped, Walker).far} == {"joints", "speeds"}
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


def test_choices_whole_observations_and_mistakes(file: Path) -> None:
    balance = sw.from_function(lambda obs: (obs[:, 2] > 0).astype(np.int64))
    sheet = sw.inputs(balance, "CartPole-v1", steps=20, episodes=2)
    assert sheet.outputs is None
    assert [part.numbers for part in sheet.parts] == [4]
    with pytest.raises(DeclarationError, match="from_onnx"):
        sw.inputs(sw.PPO(), "CartPole-v1")
    with pytest.raises(DeclarationError, match="episodes"):
        sw.inputs(balance, "CartPole-v1", episodes=0)
