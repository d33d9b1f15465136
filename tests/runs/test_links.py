"""Runs from others may hold links: what they lead to is never written, shortened or deleted."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from skillweave import Agent, SkillweaveError
from skillweave.errors import RunError
from tests.small_runs import ON, Stopped, policies, stop_at

STEPS = 96


def declared(steps: int = STEPS) -> Agent:
    return Agent("CartPole-v1", ON, steps)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, and one that was stopped after a checkpoint."""
    folder = tmp_path_factory.mktemp("runs")
    declared().train(folder / "finished", quiet=True, checkpoint_every=32)
    with pytest.raises(Stopped):
        declared().train(folder / "stopped", quiet=True, checkpoint_every=32, callback=stop_at(64))
    return folder


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A folder of the user's own files."""
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "thesis.txt").write_text("my thesis\n" * 5000)
    (folder / ".draft.tmp").write_text("a draft")
    (folder / "agent.safetensors").write_text("weights")
    return folder


def content(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def link(place: Path, target: Path) -> None:
    """Put a link in the place of what is there."""
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.symlink_to(target)


@pytest.mark.parametrize(
    ("name", "target"),
    [
        ("metrics.jsonl", "thesis.txt"),
        (".lock", "thesis.txt"),
        ("run.json.tmp", "not-there"),
        ("policies", ""),
        ("plots/deeper/notes", "thesis.txt"),
    ],
)
def test_a_run_with_a_link_is_not_trained(runs: Path, tmp_path: Path, mine: Path, name, target):
    run = shutil.copytree(runs / "stopped", tmp_path / "run")
    (run / name).parent.mkdir(parents=True, exist_ok=True)
    link(run / name, mine / target)
    before = content(mine)
    for go_on in (
        lambda: declared().resume(run, quiet=True),
        lambda: declared().train(run, resume=True, quiet=True),
        lambda: declared(2 * STEPS).train(run, resume=True, quiet=True),
        lambda: declared().train(run, quiet=True),
    ):
        with pytest.raises(RunError) as caught:
            go_on()
    if name != "run.json.tmp":
        assert f"{run / name} is a link to {mine / target}".rstrip("/") in str(caught.value) or (
            "holds an unfinished run" in str(caught.value)
        )
    assert content(mine) == before


WRITES: dict[str, Callable[[Path], object]] = {
    "save": lambda run: declared().load(run).evaluate(1, quiet=True, save=True),
    "report": lambda run: declared().load(run).report(quiet=True, films=0, episodes=1),
    "render": lambda run: declared().load(run).render(quiet=True),
    "export": lambda run: declared().load(run).export(run / "onnx"),
    "weights": lambda run: declared().load(run).save_weights(run / "own" / "w.safetensors"),
    "push": lambda run: declared().load(run).push("owner/name"),
    "more steps": lambda run: declared(2 * STEPS).train(run, resume=True, quiet=True),
}


@pytest.mark.parametrize(
    "how", [pytest.param(h, marks=pytest.mark.slow if h == "report" else ()) for h in WRITES]
)
def test_nothing_is_written_into_a_finished_run_with_a_link(runs, tmp_path, mine, how):
    run = shutil.copytree(runs / "finished", tmp_path / "run")
    for name in ("plots", "onnx", "own"):
        link(run / name, mine)
    for name in ("film.gif", "report.html", "evaluation.json"):
        link(run / name, mine / "thesis.txt")
    before = content(mine)
    with pytest.raises(SkillweaveError, match="is a link to"):
        WRITES[how](run)
    assert content(mine) == before


def test_a_run_may_be_reached_through_links(runs, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    (tmp_path / "runs").symlink_to(disk)
    shutil.copytree(runs / "stopped", disk / "run")
    (disk / "latest").symlink_to("run")
    trained = declared().train(tmp_path / "runs" / "latest", resume=True, quiet=True)
    assert policies(trained.path) == policies(runs / "finished")
    trained.evaluate(1, save=True, quiet=True)


def test_a_copy_by_hard_links_leaves_the_original_as_it_is(runs, tmp_path):
    original = shutil.copytree(runs / "stopped", tmp_path / "original")
    before = {p: p.read_bytes() for p in original.rglob("*") if p.is_file()}
    run = shutil.copytree(original, tmp_path / "copy", copy_function=os.link)
    declared().train(run, resume=True, quiet=True)
    assert policies(run) == policies(runs / "finished")
    assert {p: p.read_bytes() for p in original.rglob("*") if p.is_file()} == before


def test_links_of_a_tracker_within_its_own_folder_are_no_links_of_others(runs, tmp_path):
    run = shutil.copytree(runs / "stopped", tmp_path / "run")
    (run / "wandb" / "offline-run-1" / "logs").mkdir(parents=True)
    (run / "wandb" / "latest-run").symlink_to("offline-run-1")
    (run / "wandb" / "debug.log").symlink_to("offline-run-1/logs/debug.log")
    # W&B's own log outside, to which nothing is written later.
    (run / "wandb" / "offline-run-1" / "logs" / "debug-core.log").symlink_to(tmp_path / "core.log")
    declared().train(run, resume=True, quiet=True)
    (run / "wandb" / "latest-run").unlink()
    (run / "wandb" / "latest-run").symlink_to("../..")
    with pytest.raises(RunError, match="latest-run is a link to"):
        declared(2 * STEPS).train(run, resume=True, quiet=True)


@pytest.mark.parametrize(
    "name", ["wandb", "wandb/debug-core.log", "wandb/r/debug-core.log", "wandb/r/logs/other.log"]
)
def test_other_links_in_the_folder_of_a_tracker_are_refused(runs, tmp_path, mine, name):
    run = shutil.copytree(runs / "stopped", tmp_path / "run")
    (run / name).parent.mkdir(parents=True, exist_ok=True)
    (run / name).symlink_to(mine)
    with pytest.raises(RunError, match="is a link to"):
        declared().train(run, resume=True, quiet=True)


@pytest.mark.parametrize("kind", ["pipe", "socket"])
def test_a_pipe_in_a_run_is_refused_instead_of_waited_for(runs, tmp_path, kind, monkeypatch):
    run = shutil.copytree(runs / "stopped", tmp_path / "run")
    (run / "metrics.jsonl").unlink()
    if kind == "pipe":
        os.mkfifo(run / "metrics.jsonl")
    else:
        monkeypatch.chdir(run)  # the name of a socket may not be long
        with socket.socket(socket.AF_UNIX) as end:
            end.bind("metrics.jsonl")
    with pytest.raises(RunError, match=r"metrics\.jsonl is a pipe or a device"):
        declared().resume(run, quiet=True)


def test_files_have_the_mode_that_the_umask_leaves(tmp_path):
    before = os.umask(0o027)
    try:
        declared().train(tmp_path / "run", quiet=True)
    finally:
        os.umask(before)
    files = [p for p in (tmp_path / "run").rglob("*") if p.is_file()]
    assert {oct(p.stat().st_mode & 0o777) for p in files} == {"0o640"}
