"""Differences of two finished runs that should be equal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

TIMES = {"seconds", "steps_per_second", "created"}
"""What two equal runs may differ in."""


def differences(run: Path, whole: Path) -> dict[str, list[str]]:
    """Return by sort ("weights", "metrics", "files") a line for each difference; {} if none.

    Weights are the policies' files: every tensor bit for bit, every header. Metrics are the lines
    of metrics.jsonl and lineage.jsonl and what run.json says, all but times. Files: which there
    are.
    """
    found = {
        "weights": _policies(run / "policies", whole / "policies"),
        "metrics": [
            line
            for name in ("metrics.jsonl", "lineage.jsonl")
            for line in _lines(run / name, whole / name)
        ]
        + _manifest(run, whole),
        "files": [f"{sign} {name}" for sign, name in _names(run, whole)],
    }
    return {sort: lines for sort, lines in found.items() if lines}


def tensors_and_header(path: Path) -> tuple[bytes, Any]:
    """Return a safetensors file's tensors as bytes, and its header with sorted keys."""
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    return data[8 + size :], json.dumps(header, sort_keys=True)


def _policies(mine: Path, theirs: Path) -> list[str]:
    found = []
    for path in sorted(theirs.glob("*")):
        if not (mine / path.name).exists():
            found.append(f"{path.name} is missing")
        elif path.suffix != ".safetensors":
            if path.read_bytes() != (mine / path.name).read_bytes():
                found.append(f"{path.name}: other bytes")
        else:
            pairs = zip(tensors_and_header(path), tensors_and_header(mine / path.name), strict=True)
            for what, (a, b) in zip(("weights", "header"), pairs, strict=True):
                if a != b:
                    found.append(f"{path.name}: another {what}")
    return found


def _lines(mine: Path, theirs: Path) -> list[str]:
    a, b = _records(mine), _records(theirs)
    if len(a) != len(b):
        return [f"{mine.name}: {len(a)} lines, not {len(b)}"]
    found: dict[str, int] = {}
    for number, (x, y) in enumerate(zip(a, b, strict=True), 1):
        if other := sorted(k for k in {*x, *y} - TIMES if x.get(k) != y.get(k)):
            found.setdefault(f"{mine.name} ({y.get('stage')}): {', '.join(other)}", number)
    return [f"{what}, first in line {number}" for what, number in found.items()]


def _records(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _manifest(run: Path, whole: Path) -> list[str]:
    def paths(value: Any, at: str = "") -> dict[str, Any]:
        if isinstance(value, dict):
            inner = [(f"{at}.{k}", v) for k, v in value.items() if k not in TIMES]
        elif isinstance(value, list):
            inner = [(f"{at}[{i}]", v) for i, v in enumerate(value)]
        else:
            return {at: value}
        return {k: v for name, part in inner for k, v in paths(part, name).items()}

    mine, theirs = (paths(json.loads((r / "run.json").read_text())) for r in (run, whole))
    missing = object()
    other = {k for k in {*mine, *theirs} if mine.get(k, missing) != theirs.get(k, missing)}
    # Sizes of files whose lines hold times, and the checksum of all of it.
    timed = {k for k in other if k.endswith("metrics_bytes")} | {".sha256"}
    return [f"run.json{k}" for k in sorted(other - timed)]


def _names(run: Path, whole: Path) -> list[tuple[str, str]]:
    mine, theirs = ({str(p.relative_to(r)) for p in r.rglob("*")} for r in (run, whole))
    return [("too many:", n) for n in sorted(mine - theirs)] + [
        ("missing:", n) for n in sorted(theirs - mine)
    ]
