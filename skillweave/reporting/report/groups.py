"""Runs that differ by their seed alone are a group; what groups differ in, in words."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skillweave.reporting.report import facts
from skillweave.runs.directory import RunDirectory
from skillweave.types import SkillweaveError

SAID = 3  # differences in a group's name


@dataclass
class Group:
    """Seeds of one recipe."""

    name: str
    runs: list[RunDirectory]
    settings: dict[str, Any]


def grouped(runs: Sequence[RunDirectory]) -> list[Group]:
    """The groups, in the order of their first runs.

    Raises:
        SkillweaveError: no runs, or two that have the same seed and the same settings.
    """
    if not runs:
        raise SkillweaveError("no runs were given; name at least one run's directory")
    found: dict[str, Group] = {}
    for run in runs:
        own = facts.settings(run)
        key = json.dumps([run.manifest.get("recipe"), own], sort_keys=True, default=str)
        group = found.setdefault(key, Group(_base(run), [], own))
        for other in group.runs:
            if other.manifest["seed"] == run.manifest["seed"]:
                raise SkillweaveError(
                    f"{other.path} and {run.path} have the same settings and the same seed, "
                    f"{run.manifest['seed']}; name one of them"
                )
        group.runs.append(run)
    groups = list(found.values())
    for group in groups:
        same = [g for g in groups if _base(g.runs[0]) == _base(group.runs[0])]
        group.name = ", ".join([_base(group.runs[0]), *_own(group, same)])
    return groups


def differences(groups: Sequence[Group]) -> list[tuple[str, list[str]]]:
    """Settings in which groups differ: the name, and the value of each group."""
    names = list(dict.fromkeys(k for g in groups for k in g.settings))
    table = [(k, [_told(g, k) for g in groups]) for k in names]
    return [(k, values) for k, values in table if len(set(values)) > 1]


def _told(group: Group, name: str) -> str:
    return facts.plain(group.settings[name]) if name in group.settings else "–"


def _base(run: RunDirectory) -> str:
    recipe = run.manifest.get("recipe")
    name = Path(recipe).stem if recipe else run.manifest["env"]
    return f"{name}, plain agent" if recipe and run.manifest["kind"] == "agent" else name


def _own(group: Group, same: Sequence[Group]) -> list[str]:
    """What sets a group apart from those of the same base, at most ``SAID`` settings."""
    if len(same) < 2:
        return []
    names = [k for k, _ in differences(same)]
    said = [f"{k} {_told(group, k)}" for k in names[:SAID]]
    return [*said, "…"] if len(names) > SAID else said
