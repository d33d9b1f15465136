"""Two runs are equal where all but times is, and any other difference is found."""

import json

import pytest
import torch

from scripts.torture.compare import differences
from skillweave.runs.files import write_json, write_tensors


def make_run(path, seconds):
    """What a finished run looks like."""
    path.mkdir()
    lines = [{"stage": "flat", "update": i, "return": 2.0 * i, "seconds": seconds} for i in (1, 2)]
    (path / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in lines))
    stage = {"name": "flat", "seconds": seconds, "metrics_bytes": int(seconds)}
    write_json(path / "run.json", {"seed": 3, "created": str(seconds), "stages": [stage]})
    policy = path / "policies" / "flat.safetensors"
    write_tensors(policy, {"w": torch.arange(3.0)}, {"kind": "agent"})
    return path


@pytest.fixture
def runs(tmp_path):
    return make_run(tmp_path / "run", 1.0), make_run(tmp_path / "whole", 2.0)


def one_bit(run):
    path = run / "policies" / "flat.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


def change_json(run, old, new, name="run.json"):
    text = (run / name).read_text()
    assert old in text
    (run / name).write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("change", "sort", "says"),
    [
        (one_bit, "weights", "flat.safetensors: another weights"),
        (lambda r: change_json(r, "metrics_bytes", "metrics_byte"), "metrics", "run.json"),
        (lambda r: change_json(r, '"return": 4.0', '"return": 4.5', "metrics.jsonl"), "metrics",
         "metrics.jsonl (flat): return, first in line 2"),
        (lambda r: change_json(r, '"update": 1', '"updates": 1', "metrics.jsonl"), "metrics",
         "update, updates, first in line 1"),
        (lambda r: change_json(r, '"seed": 3', '"seed": 4'), "metrics", "run.json.seed"),
        (lambda r: (r / ".run.json.x7").touch(), "files", "too many: .run.json.x7"),
        (lambda r: (r / "lineage.jsonl").write_text("{}\n"), "metrics", "lineage.jsonl: 1 lines"),
    ],
)  # fmt: skip
def test_any_other_difference_is_found(runs, change, sort, says):
    assert differences(*runs) == {}  # they differ in times alone
    change(runs[0])
    found = differences(*runs)
    assert says in " ".join(found[sort])


def test_a_missing_policy_and_a_line_that_stands_twice_are_found(runs):
    (runs[0] / "policies" / "flat.safetensors").unlink()
    lines = (runs[0] / "metrics.jsonl").read_text()
    (runs[0] / "metrics.jsonl").write_text(lines + lines)
    found = differences(*runs)
    assert found["weights"] == ["flat.safetensors is missing"]
    assert found["metrics"] == ["metrics.jsonl: 4 lines, not 2"]
    assert found["files"] == ["missing: policies/flat.safetensors"]
