"""What is its owner's stays with the owner, on both sides of the hub."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from shared_runs import NAME, files_of, same_actions

import skillweave as sw
from skillweave.api import push_pull as sharing
from skillweave.cli import main
from skillweave.errors import SkillweaveError
from skillweave.reporting.plots import plot_run
from skillweave.runs.directory import RunDirectory

pytest.importorskip("huggingface_hub")


def change(path: Path, **fields):
    """Change fields of a run's ``run.json``, which stays whole."""
    directory = RunDirectory.open(path)
    directory.manifest = replace(directory.manifest, **fields)
    directory.save()


# What goes up


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("place", ["/home/ada/secret/", "C:\\ada\\secret\\", ""])
def test_where_files_lie_and_who_tracks_a_run_does_not_go_up(place, run, hub):
    left, right = run.info()["skills"]
    change(run.path, recipe=f"{place}still.py", track=("tensorboard",))
    here = files_of(run.path)
    run.push(NAME)
    there = hub.files(NAME)
    told = json.loads(there["run.json"])
    assert (told["recipe"], "track" in told) == ("still.py", False)
    assert told["id"] == json.loads(here["run.json"])["id"]
    assert not [name for name, data in there.items() if b"secret" in data]
    assert files_of(run.path) == here
    assert same_actions(sw.from_hub(NAME), run)  # its checksums hold
    # Nor does where a ready policy lies.
    source = {"kind": "onnx", "file": f"{place}hop.onnx", "sha256": "0" * 64}
    change(run.path, skills=[left | {"policy": source}, right])
    run.push(NAME)
    there = hub.files(NAME)
    told = json.loads(there["run.json"])["skills"][0]["policy"]
    assert told == source | {"file": "hop.onnx"}
    assert not [name for name, data in there.items() if b"secret" in data]


# What comes down


@pytest.fixture
def tracked(run, hub):
    """A run on the hub that names a tracker, as older versions pushed them."""
    change(run.path, track=("tensorboard",))
    hub.make(NAME, files_of(run.path))


def test_a_run_that_is_pulled_names_no_tracker(tracked, tmp_path):
    path = sharing.pull_run(NAME, tmp_path / "pulled")
    assert main(["evaluate", str(path), "--episodes", "2"]) == 0
    assert not (path / "tensorboard").exists()
    assert RunDirectory.open(path).manifest.track == ()


WRITES = {
    "evaluation": lambda run: run.evaluate(2, save=True),
    "film": lambda run: run.render(run.path / "film.gif"),
    "report": lambda run: run.report(episodes=1, films=0),
    "report in a folder": lambda run: run.report(run.path / "x/page.html", episodes=1, films=0),
    "plots": lambda run: plot_run(RunDirectory.open(run.path)),
    "training": lambda run: run.hierarchy.resume(run.path, quiet=True),
    "push": lambda run: run.push("ada/copy"),
}


def contents(path: Path) -> dict[str, bytes]:
    return {str(f): f.read_bytes() for f in path.rglob("*") if f.is_file()}


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("what", WRITES)
def test_nothing_is_written_into_the_copy_that_the_hubs_library_keeps(what, tracked, hub):
    loaded = sw.from_hub(NAME)
    before = contents(loaded.path)
    with pytest.raises(SkillweaveError, match=f"skillweave pull {NAME}"):
        WRITES[what](loaded)
    assert contents(loaded.path) == before
    assert list(hub.repos) == [NAME]


def test_nor_by_a_command_that_is_given_its_folder(tracked, capsys):
    path = sw.from_hub(NAME).path
    before = contents(path)
    assert main(["evaluate", str(path), "--episodes", "2"]) == 0
    assert f"not kept in the run: {path}" in capsys.readouterr().err
    assert contents(path) == before


def test_elsewhere_a_run_of_the_hub_writes_what_it_is_asked_to(tracked, tmp_path):
    pytest.importorskip("PIL")
    loaded = sw.from_hub(NAME)
    before = contents(loaded.path)
    loaded.render(tmp_path / "film.gif", max_steps=3)
    loaded.save_weights(tmp_path / "all.safetensors")
    assert {p.name for p in tmp_path.iterdir()} >= {"film.gif", "all.safetensors"}
    assert contents(loaded.path) == before
