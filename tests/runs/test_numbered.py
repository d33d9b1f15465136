"""Directories of runs: numbered ones, ones that are replaced, and ones that are left alone."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from small_runs import (
    ON,
    Left,
    StopAt,
    Stopped,
    interrupt_at_checkpoint,
    interrupted,
    new_run,
    plain_recipe,
)

import skillweave as sw
from skillweave import Agent, EnvSpec, Hierarchy
from skillweave.cli.main import main
from skillweave.errors import RunError, SkillweaveError
from skillweave.hierarchy import training
from skillweave.runs.directory import RunDirectory
from skillweave.runs.lock import Lock
from skillweave.runs.numbered import make_numbered, safe_name

CARTPOLE = EnvSpec("CartPole-v1", engine="sync", workers=1)


def declare(steps: int = 64, name: str = "hierarchy") -> Hierarchy:
    return Hierarchy(CARTPOLE, [Left()], algorithm=ON, selector=ON, steps=steps, name=name)


def train(path: str = "run", **how: Any) -> sw.Run:
    return declare().train(path, quiet=True, **how)


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


# Numbered directories


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("CartPole-v1", "CartPole-v1"),
        ("ALE/Pong-v5", "ALE-Pong-v5"),
        ("my.module:Own-v0", "my.module-Own-v0"),
        ("../up", "up"),
        ("<lambda>", "lambda"),
        ("...", "run"),
    ],
)
def test_any_name_becomes_a_folder(text: str, name: str) -> None:
    assert safe_name(text) == name


def test_numbers_go_on_after_the_largest_and_other_files_do_not_count() -> None:
    for name in ("a-2", "a-10", "a-b-20", "b-30", "a-x"):
        (Path("runs") / name).mkdir(parents=True)
    assert make_numbered("a", Path()) == Path("runs/a-11")
    assert make_numbered("a", Path()) == Path("runs/a-12")
    assert make_numbered("c", Path()) == Path("runs/c-1")


def _several(_: int) -> list[str]:
    return [str(make_numbered("same", Path())) for _ in range(20)]


def test_processes_that_start_at_once_get_directories_of_their_own() -> None:
    with ProcessPoolExecutor(2) as pool:
        found = [path for paths in pool.map(_several, range(2)) for path in paths]
    assert len(set(found)) == 40


def test_train_without_a_directory_makes_one_and_prints_it(capfd) -> None:
    here = Path("runs").absolute()
    first = declare().train()
    assert first.path == here / "CartPole-v1-1"
    assert "run: runs/CartPole-v1-1" in capfd.readouterr().err
    assert declare(name="walker").train(quiet=True).path == here / "walker-1"
    assert declare().train(flat=True, quiet=True).path == here / "CartPole-v1-flat-1"
    assert sw.train_agent(CARTPOLE, ON, 64, quiet=True).path == here / "CartPole-v1-2"
    plain = Agent(lambda: gym.make("CartPole-v1"), ON, 64)
    assert plain.train(quiet=True).path == here / "lambda-1"


# Runs that are replaced


def dead_run(path: Path) -> None:
    """A run that was stopped before its first checkpoint."""
    run = new_run(declare(steps=2_000), path)
    with pytest.raises(Stopped):
        training.train(declare(), run, (StopAt(2),))
    run.close()
    assert (path / "metrics.jsonl").stat().st_size


def test_a_run_that_has_learnt_nothing_is_replaced() -> None:
    Path("run").mkdir()
    Lock(Path("run")).release()  # what a process left before its manifest
    assert train().path.is_dir()
    dead_run(Path("dead"))
    (Path("dead") / ".policy.x.tmp").write_bytes(b"half")
    before = RunDirectory.open("dead").manifest.id
    run = train("dead", seed=5)
    assert run.info()["id"] != before
    assert run.info()["seed"] == 5
    assert not (run.path / ".policy.x.tmp").exists()
    (first, *_) = (json.loads(x) for x in (run.path / "metrics.jsonl").read_text().splitlines())
    assert first["update"] == 1


@pytest.mark.parametrize(
    "name", ["notes.txt", "policies/mine.onnx", "films/a.gif", "report.html", "a link"]
)
def test_a_file_that_is_not_ours_keeps_all_as_it_is(name: str) -> None:
    dead_run(Path("run"))
    file = Path("elsewhere/weights.safetensors") if name == "a link" else Path("run") / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("years of work")
    says = r"run holds .*nothing there is replaced"
    if name == "a link":
        (Path("run") / "starts").symlink_to(file.parent.absolute())
        says = "run/starts is a link to"
    before = {p: p.read_bytes() for p in Path().rglob("*") if p.is_file()}
    with pytest.raises(RunError, match=says):
        train()
    assert {p: p.read_bytes() for p in Path().rglob("*") if p.is_file()} == before


@pytest.mark.parametrize("content", ["", "years of work"])
def test_a_lock_of_another_program_is_left_alone(content: str) -> None:
    Path("run").mkdir()
    Path("run/other.lock").write_text(content)
    with pytest.raises(RunError, match="not an empty directory"):
        train()
    assert [p.name for p in Path("run").iterdir()] == ["other.lock"]


HOLD = """
import sys, time
from skillweave.runs.directory import RunDirectory
run = RunDirectory.open("run")
run.begin()
print("held", flush=True)
time.sleep(60)
"""


def test_a_living_process_keeps_its_run_and_is_named() -> None:
    dead_run(Path("run"))
    before = Path("run/run.json").read_bytes()
    with subprocess.Popen(
        [sys.executable, "-c", HOLD], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        for resume in (False, True):
            with pytest.raises(RunError, match=f"trained by process {process.pid};"):
                train(resume=resume)
        process.kill()
    assert Path("run/run.json").read_bytes() == before
    assert train().path.is_dir()


def test_a_system_without_locks_replaces_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    dead_run(Path("run"))
    monkeypatch.setattr("skillweave.runs.lock.fcntl", None)
    with pytest.raises(RunError, match="has no locks that show whether a process uses it"):
        train()


# Runs that are overwritten


def entries(path: str) -> dict[str, bytes]:
    """By file below a folder, its content; of files with times, nothing."""
    files = {p.relative_to(path): p for p in Path(path).rglob("*") if p.is_file()}
    return {
        str(k): p.read_bytes() if p.parent.name == "policies" else b"" for k, p in files.items()
    }


@pytest.mark.parametrize("plain", [False, True])
def test_a_run_is_overwritten_where_that_is_asked(plain: bool) -> None:
    def again(path: str, **how: Any) -> None:
        if plain:
            sw.train_agent(CARTPOLE, ON, 64, path, quiet=True, **how)
        else:
            train(path, **how)

    old = train()
    old.evaluate(2, save=True)
    old.log_calls(100)
    own = {"notes.txt": b"", "policies/mine.onnx": b"years of work"}
    for name, content in own.items():
        Path("run", name).write_bytes(content)
    with pytest.raises(RunError, match="overwrite=True"):
        again("run", seed=1)
    for path in ("run", "other"):
        again(path, seed=1, overwrite=True)
    assert entries("run") == entries("other") | own


def test_an_unfinished_run_is_overwritten_and_a_run_may_start_from_itself() -> None:
    with interrupted(1):
        declare(640).train("run", checkpoint_every=64, quiet=True)
    Path("plain.py").write_text(plain_recipe(64))
    assert main(["train", "plain.py", "-o", "run", "--overwrite", "--evaluate", "0"]) == 0
    with pytest.warns(UserWarning, match="the reward of skill 'left' has changed"):
        run = train(overwrite=True, start_from="run")
    assert sw.load(run.path, declare()).info()["seed"] == 0


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"run_dir": "locked", "resume": True}, "leave out one"),
        ({}, "name its directory"),
        ({"run_dir": "."}, "not an empty directory"),
        ({"run_dir": "locked"}, "is being trained"),
    ],
)
def test_other_directories_are_not_overwritten(how: dict[str, Any], says: str) -> None:
    dead_run(Path("locked"))
    before, lock = entries("."), Lock(Path("locked"))
    with pytest.raises(SkillweaveError, match=says):
        declare().train(overwrite=True, quiet=True, **how)
    lock.release()
    assert entries(".") == before


# What is said of runs that are kept


def test_a_resumable_run_is_kept_and_the_line_is_said() -> None:
    with interrupted(1) as stop:
        declare(640).train("my run", seed=3, checkpoint_every=64, quiet=True)
    line = 'hierarchy.train("my run", seed=3, resume=True)'
    assert str(stop.value).endswith(f"Continue: {line}")
    with pytest.raises(RunError, match=re.escape(f"Continue it: {line}")):
        declare(640).train("my run", quiet=True)
    with pytest.raises(RunError, match=r"is not finished.*saved at 64 steps"):
        sw.load("my run", declare())
    assert eval(line, {"hierarchy": declare(640)}).info()["stages"][0]["status"] == "done"


def test_a_finished_run_is_kept_and_the_lines_are_said() -> None:
    sw.train_agent("CartPole-v1", ON, 64, "run", quiet=True)
    with pytest.raises(RunError) as caught:
        sw.train_agent("CartPole-v1", ON, 64, "run", quiet=True)
    assert 'sw.load("run")' in str(caught.value)
    assert 'train_agent(env, algorithm, steps, "run", resume=True)' in str(caught.value)
    with pytest.raises(RunError, match=r'agent\.train\("run", resume=True\)'):
        Agent("CartPole-v1", ON, 64).train("run", quiet=True)
    train("flat", flat=True)
    with pytest.raises(RunError, match=r'hierarchy\.train\("flat", resume=True, flat=True'):
        train("flat", flat=True)


# The command line


def test_the_command_line_keeps_the_same_rule(capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("plain.py").write_text(plain_recipe(64))
    train = ["train", "plain.py", "--evaluate", "0", "--quiet"]
    for number in (1, 2):
        assert main(train) == 0
        path = f"runs/plain-{number}"
        out = capsys.readouterr().out
        assert f"run     {path}\n" in out
        for name in ("evaluate", "render", "report"):
            assert f"skillweave {name} {path}\n" in out
    assert main([*train, "--out", "runs/plain-1"]) == 1
    assert "skillweave resume runs/plain-1 --recipe plain.py" in capsys.readouterr().err
    with monkeypatch.context() as patched:
        interrupt_at_checkpoint(patched, 1)
        more = ["--set", "steps=640", "--set", "train.checkpoint_every=64", "--out", "x"]
        assert main([*train, *more]) == 130
    assert "Continue: skillweave resume x --recipe plain.py\n" in capsys.readouterr().err
    dead_run(Path("dead"))
    assert main([*train, "--out", "dead"]) == 0


def test_no_handle_stays_open_and_the_caller_is_forgotten() -> None:
    opened = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else 0
    main(["train", "nowhere.py"])
    train()
    for _ in range(2):
        with pytest.raises(RunError, match=r"hierarchy\.train\("):
            train()
    if opened:
        assert len(os.listdir("/proc/self/fd")) <= opened + 1
