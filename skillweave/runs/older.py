"""The words of older versions in today's words: the one place that knows them.

Stages were once called phases, and a plain agent's run was of the kind "flat": so in ``run.json``
(``phases``), in the headers of checkpoints and policies, and in the lines of ``metrics.jsonl`` and
``lineage.jsonl`` (``phase``). What is damaged is passed on as it is; the schema finds it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_KINDS = {"flat": "agent", "selector": "selector"}


def header_today(told: dict[str, Any]) -> dict[str, Any]:
    """A file's header, or a line, in today's words."""
    if "phase" not in told or "stage" in told:
        return told
    return {"stage" if key == "phase" else key: value for key, value in told.items()}


def manifest_today(told: Mapping[str, Any]) -> dict[str, Any]:
    """The content of ``run.json`` in today's words."""
    manifest = dict(told)
    if "phases" not in manifest or "stages" in manifest:
        return manifest
    stages = manifest.pop("phases")
    if isinstance(stages, list):
        stages = [_stage(each) if isinstance(each, dict) else each for each in stages]
    if manifest.get("kind") == "flat":
        manifest["kind"] = "agent"
    return manifest | {"stages": stages}


def _stage(entry: dict[str, Any]) -> dict[str, Any]:
    name = entry.get("name")
    kind = _KINDS.get(name, "skill") if isinstance(name, str) else "skill"
    decides = name if kind == "selector" else None
    found = entry | {"kind": kind, "learns": [name], "decides": decides}
    evolution = entry.get("evolution")
    target = evolution.get("target") if isinstance(evolution, dict) else None
    if target is not None:
        found["target"] = {"of": "return", "at_least": target}
    return found
