"""Folders whose files contradict one another are refused when they are read, not when they act."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from random_hierarchies import Free, Remembers, critic_of, skill_set, traced_once, trained
from skills.foreign_models import onnx_file

import skillweave as sw
from skillweave.errors import PolicyError, RunError
from skillweave.export.write import write_export
from skillweave.hierarchy.policy import with_interruption
from skillweave.skills.onnx_file import OnnxPolicy

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
_ = traced_once  # of all tests here, too


def export(path: Path, **critic: Any) -> Path:
    skills = skill_set(Free, Remembers, call_steps=sw.Lengths(1, 3))
    write_export(path, trained(with_interruption(skills, critic_of(2, **critic), 0.1)), "walk")
    return path


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = export(tmp_path_factory.mktemp("export"), deciding=True)
    assert sw.load_policy(path)
    return path


STATE = {"type": "StateMachine", "who": "it", "skills": ["free", "remembers"], "goals": {}}
REVERSED = ["remembers", "free"]
ONE = {"states": {"a": ["free"]}, "transitions": [], "first": "a"}
WRONG: list[tuple[str, Any]] = [
    ("policy.type", "PartOf"),
    ("policy.skills[0].policy.choices", 9),
    ("policy.skills[0].policy.noise", [["gumbel", 10**8]]),
    ("policy.skills[0].policy.noise", [["cauchy", 1]]),
    ("policy.skills[0].policy.file.file", "critic.onnx"),
    ("policy.skills[1].policy.memory", 10**8),
    ("policy.skills[1].policy.memory", 0),
    ("policy.skills[1].name", "free"),
    ("policy.interruption.worth.policy.file.file", "free.onnx"),
    ("policy.interruption.margin", None),
    ("policy.selector.type", "CallAndReturn"),
    ("policy.selector.file.file", "free.onnx"),
    ("policy.selector", STATE | {"states": {"a": ["fre"]}, "transitions": [], "first": "a"}),
    ("policy.selector", STATE | {"states": {"a": ["free"]}, "transitions": [], "first": "b"}),
    ("policy.selector", STATE | ONE),  # it chooses no lengths
    ("policy.selector", STATE | ONE | {"skills": ["free", "other"]}),
    ("policy.guide", {"type": "ActiveGuide", "selector": STATE | ONE | {"skills": ["free"]}}),
    ("policy.guide", {"type": "ActiveGuide", "selector": STATE | ONE | {"skills": REVERSED}}),
    ("policy.skills[0].limit", 0),
    ("policy.skills[0].max_steps", -1),
    ("policy.fresh_calls", True),
    ("policy.interruption.margin", -0.5),
    ("policy.skills[1].policy.memory", 10**12),
    ("policy.skills[0].policy.noise", [["gumbel", 10**12]]),
    ("policy.skills[0].policy.sees.shape", [10**8]),
    ("policy.skills[0].policy.sees.dtype", "V1000000000000"),
    ("policy.skills[0].policy.acts.high", {"array": 1, "dtype": "V1000000000000"}),
    ("policy.skills[0].policy.acts.high", {"array": 1, "dtype": {"names": [], "itemsize": 9}}),
    ("policy.skills[0].policy.sees.kind", "Discrete"),
    ("policy.skills[0].name", "x" * 5_000_000),
    ("policy.lengths", [3, 1]),
    ("policy.lengths", list(range(1, 200_000))),
    ("policy.lengths", [0]),
    ("policy.skills", []),
    ("sees.dtype", "float64"),
    ("acts.high.array", 3),
]


@pytest.mark.parametrize(("path", "value"), WRONG, ids=[f"{p}={v}"[:60] for p, v in WRONG])
def test_a_manifest_that_contradicts_its_files_is_refused(
    path: str, value: Any, exported: Path, tmp_path: Path
) -> None:
    shutil.copytree(exported, tmp_path / "copy")
    file = tmp_path / "copy/policy.json"
    manifest = json.loads(file.read_text())
    part = manifest["policy"]
    *above, last = [int(key) if key.isdigit() else key for key in re.findall(r"\w+", path)]
    for key in above:
        part = part[key]
    part[last] = value
    file.write_text(json.dumps(manifest))
    with pytest.raises(RunError, match=r"policy\.json: policy\.") as caught:
        sw.load_policy(file)
    assert len(str(caught.value)) < 1500


def test_a_guide_leaves_the_lengths_to_the_selector(exported: Path, tmp_path: Path) -> None:
    shutil.copytree(exported, tmp_path / "copy")
    file = tmp_path / "copy/policy.json"
    manifest = json.loads(file.read_text())
    manifest["policy"]["policy"]["guide"] = {"type": "ActiveGuide", "selector": STATE | ONE}
    file.write_text(json.dumps(manifest))
    assert sw.Player(sw.load_policy(file)).act(np.zeros(4, np.float32)) is not None


def test_a_critic_without_the_value_of_a_new_decision_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"policy\.critic.acts is Box.*\(2,\).*used for .*\(3,\)"):
        sw.load_policy(export(tmp_path))


def places(kind: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the fields that lead to each tensor of an ONNX message, by the format's schema."""
    for field in kind.fields:
        inner = field.message_type
        if inner is not None and inner.name == "TensorProto":
            yield (field.name,)
        elif inner is not None and inner not in above:
            yield from ((field.name, *rest) for rest in places(inner, (*above, inner)))


@pytest.mark.parametrize("place", places(onnx.ModelProto.DESCRIPTOR), ids=".".join)
def test_a_model_that_would_read_another_file_is_refused(place: tuple[str, ...]) -> None:
    model = part = onnx.ModelProto()
    for name in place:
        part = getattr(part, name)
        part = part.add() if hasattr(part, "add") else part
    part.data_location = onnx.TensorProto.EXTERNAL
    part.external_data.add(key="location", value="weights.bin")
    with pytest.raises(PolicyError, match="other files"):
        OnnxPolicy(model.SerializeToString(), Path("model.onnx"))


def test_an_error_of_a_running_model_names_the_policy(tmp_path: Path) -> None:
    policy = sw.from_onnx(onnx_file(tmp_path / "lean.onnx"))
    with pytest.raises(PolicyError, match=r"lean\.onnx fails"):
        policy.bind(*sw.EnvSpec("CartPole-v1").spaces, "it").act({}, np.zeros((1, 9), np.float32))
