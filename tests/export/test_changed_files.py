"""A changed ``policy.json`` is refused, or acts; reading it never crashes."""

from __future__ import annotations

import json
import random
import traceback
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from random_hierarchies import HIERARCHIES, traced_once

import skillweave as sw
from skillweave.errors import SkillweaveError
from skillweave.export.runner import Runner
from skillweave.export.write import write_export

pytest.importorskip("onnxscript")
_ = traced_once  # of all tests here, too
ODD: list[Any] = [
    None, True, -1, 0, 1, 10**9, 2**63, -0.5, 1e308, "", "x", "../x", [], [[]], [0, 0], {},
    {"type": "CallAndReturn"}, {"type": "Step"}, {"file": "free.onnx"}, {"code": "x"},
    {"array": [1e9], "dtype": "float32"}, {"array": 1, "dtype": "V8"}, {"stored": "x"},
    {"float": "nan"}, {"float": "inf"},
]  # fmt: skip


def places(content: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inside = content.items() if isinstance(content, dict) else ()
    inside = enumerate(content) if isinstance(content, list) else inside
    return [path, *(found for k, x in inside for found in places(x, (*path, k)))]


def changed(content: Any, rng: random.Random) -> Any:
    """A value elsewhere: odd, left out, or that of another place."""
    whole = {"policy": json.loads(json.dumps(content["policy"]))}
    every = [path for path in places(whole) if len(path) > 1]
    *above, last = rng.choice(every)
    part: Any = whole
    for key in above:
        part = part[key]
    if isinstance(part, dict) and rng.random() < 0.2:
        del part[last]
    elif rng.random() < 0.3:
        other: Any = whole
        for key in rng.choice(every):
            other = other[key]
        part[last] = json.loads(json.dumps(other))
    else:
        part[last] = rng.choice(ODD)
    return content | whole


@pytest.mark.parametrize("name", HIERARCHIES)
def test_a_changed_file_is_refused_or_acts(name: str, tmp_path: Path) -> None:
    export = write_export(tmp_path, HIERARCHIES[name](), "walk")
    file, rng, refused = tmp_path / "policy.json", random.Random(name), 0
    content, obs = json.loads(file.read_text()), np.zeros(4, np.float32)
    for _ in range(80):
        file.write_text(json.dumps(changed(content, rng)))
        said = []
        for reads in (Runner, lambda path, code: sw.load_policy(path, code=code)):
            try:
                reads(tmp_path, export.functions)
                said.append("")
            except SkillweaveError as error:
                said.append(str(error))
        assert said[0] == said[1], "both refuse the same"
        refused += bool(said[0])
        if not said[0]:
            fails = ""  # a function that is given something else may fail
            try:
                Runner(tmp_path, export.functions).act(obs)
            except SkillweaveError:
                continue
            except Exception as error:
                fails = traceback.extract_tb(error.__traceback__)[-1].filename
            assert "skillweave" not in fails
    assert refused > 40
