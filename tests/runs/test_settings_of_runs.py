"""Fields of ``run.json`` are settings, which a resumed run compares, or results."""

from __future__ import annotations

import copy
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import pytest
from small_runs import ON, Left, Push, level_entry, small_manifest, stage_entry

import skillweave as sw
from skillweave.hierarchy import training
from skillweave.runs.manifest import (
    NO_SETTING,
    LevelEntry,
    Manifest,
    SkillEntry,
    StageEntry,
    read_manifest,
    settings_of,
)
from skillweave.schema import annotations_of, as_json


def marked(kind: type) -> set[str]:
    """The fields of a class that are no settings."""
    return {name for name, hint in annotations_of(kind).items() if NO_SETTING in get_args(hint)}


def plain() -> Manifest:
    skill = SkillEntry("left", 15, hierarchy=level_entry())
    return small_manifest(stage_entry("left"), hierarchy=level_entry(), skills=[skill])


def changed(name: str, entry: Any) -> Any:
    """Return a copy with another value of a field."""
    other = copy.copy(entry)
    object.__setattr__(other, name, "another value")
    return other


@pytest.mark.parametrize("name", [f.name for f in fields(Manifest)])
def test_each_field_of_a_manifest_is_a_setting_or_marked(name):
    if name in ("env_kwargs", "hierarchy", "skills", "stages"):  # they hold settings
        assert name not in marked(Manifest)
        return
    same = settings_of(changed(name, plain())) == settings_of(plain())
    assert same == (name in marked(Manifest))


@pytest.mark.parametrize(
    ("kind", "name"), [(k, f.name) for k in (StageEntry, SkillEntry) for f in fields(k)]
)
def test_each_field_of_an_entry_is_a_setting_or_marked(kind, name):
    one = plain()
    entries: list[Any] = one.stages if kind is StageEntry else one.skills
    other = {"starts": {"left": 0}, "hierarchy": None}
    entries[0] = changed(name, entries[0])
    if name in other:
        object.__setattr__(entries[0], name, other[name])
    if name == "name":  # all settings of the entry get another name
        assert sorted(map(str, settings_of(one).values())) == sorted(
            map(str, settings_of(plain()).values())
        )
    elif name == "starts":  # that it starts from another run counts, and not from which
        assert settings_of(one)["left.starts.left"] == "another run"
    else:
        assert (settings_of(one) == settings_of(plain())) == (name in marked(kind))


@pytest.mark.parametrize("name", [f.name for f in fields(LevelEntry)])
def test_each_field_of_a_level_is_a_setting_but_code_that_is_compared_by_itself(name):
    one = plain()
    assert one.hierarchy is not None
    one.hierarchy = changed(name, one.hierarchy)
    assert (settings_of(one) == settings_of(plain())) == (name in ("selector", "guide"))


def test_what_training_writes_is_no_setting(tmp_path: Path):
    """A field that training writes, and that has no mark, makes a resumed run differ."""
    declared = sw.Hierarchy(
        sw.EnvSpec("CartPole-v1", engine="sync", workers=1),
        [Left(), Push()],
        steps=256,
        learn="apart, then together",
        algorithm=ON,
        selector=ON,
    )
    run = declared.train(
        tmp_path / "run", seed=5, quiet=True, eval_every=64, eval_episodes=1, keep="best"
    )
    how = sw.TrainDefaults(eval_every=64, eval_episodes=1, keep="best")
    before = training.manifest(declared, seed=6, how=how)
    after = read_manifest(run.path)
    assert settings_of(after) == settings_of(before)
    written = set().union(*(as_json(stage) for stage in after.stages))
    written -= set().union(*(as_json(stage) for stage in before.stages))
    assert {"best", "steps", "seconds", "final", "policies", "sha256", "kept"} <= written
    assert written <= marked(StageEntry)
