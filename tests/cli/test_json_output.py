"""With ``--json`` standard output has one JSON object, whatever else prints, however it ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from skillweave.cli import main

TALKS = """
import ctypes
import os
import sys
import gymnasium as gym
import skillweave as sw

print("a banner on import")
early = sys.stdout

class Talks(gym.Wrapper):
    def reset(self, **options):
        print("resetting")
        early.write("by a stream that was kept\\n")
        os.write(1, b"from C\\n")
        ctypes.CDLL(None).printf(b"buffered in C\\n")
        os.system("echo from a child")
        return self.env.reset(**options)

def make(render_mode=None):
    return Talks(gym.make("CartPole-v1", render_mode=render_mode))

class Middle(sw.Skill):
    max_steps = 10
    def reward(self, step):
        print("reward")
        if os.environ.get("FAIL") == "error":
            raise ValueError("no reward")
        if os.environ.get("FAIL") == "exit":
            os.kill(os.getpid(), 2)
            os.kill(os.getpid(), 2)
        return 1.0 - abs(step.next_obs[:, 0])

small = sw.PPO(num_envs=2, n_steps=16, batch_size=16, network=sw.Network((4,)))
env = sw.EnvSpec(make, workers=WORKERS)
hierarchy = sw.Hierarchy(env, [Middle()], steps=64, algorithm=small, selector=small)
"""
TRAIN = ["train", "talks.py", "--out", "run", "--evaluate", "2", "--json"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "talks.py").write_text(TALKS.replace("WORKERS", "1"))
    return tmp_path


def call(*words: str, program: str = "-m skillweave", **more: str) -> Any:
    """The end of a command in a process of its own."""
    line = [sys.executable, "-W", "ignore", *program.split(), *words]
    return subprocess.run(line, capture_output=True, text=True, env=os.environ | more, check=False)


def test_what_environments_libraries_and_children_print_goes_to_standard_error(here: Path) -> None:
    done = call(*TRAIN)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["evaluation"]["episodes"] == 2
    for text in ("a banner", "resetting", "kept", "from C", "buffered in C", "a child", "reward"):
        assert text in done.stderr


@pytest.mark.slow
def test_the_workers_of_environments_print_there_too(here: Path) -> None:
    (here / "talks.py").write_text(TALKS.replace("WORKERS", "2"))
    done = call(*TRAIN)
    assert json.loads(done.stdout)["run"] == "run"
    assert "resetting" in done.stderr


@pytest.mark.parametrize(
    ("words", "fail", "code", "says"),
    [
        pytest.param(TRAIN, "error", 1, "no reward", marks=pytest.mark.slow),
        (TRAIN, "exit", 130, ""),
        (["trian", "talks.py", "--json"], "", 2, "is 'train' meant?"),
    ],
)
def test_an_error_is_one_object_too(
    here: Path, words: list[str], fail: str, code: int, says: str
) -> None:
    done = call(*words, FAIL=fail)
    assert done.returncode == code, done.stderr
    assert says in json.loads(done.stdout)["error"]
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["info", "a" * 300], 1, "File name too long"),
        (["train", "talks.py", "--sed", "3"], 2, "arguments are wrong"),
        (["train", "talks.py", "--steps", "3"], 2, "--set steps=N"),
    ],
)
def test_an_error_is_one_object_in_this_process_too(
    here: Path, capfd: pytest.CaptureFixture[str], words: list[str], code: int, says: str
) -> None:
    try:
        ended = main([*words, "--json"])
    except SystemExit as error:
        ended = error.code
    assert ended == code
    out, err = capfd.readouterr()
    assert says in json.loads(out)["error"]
    assert "Traceback" not in err


def test_an_error_that_nobody_expected_is_one_object_and_a_traceback(here: Path) -> None:
    (here / "broken.py").write_text(
        "import sys\n"
        "from skillweave.cli import execute, main\n"
        "def fail(command): raise LookupError('a fault of the library')\n"
        "execute.resolve = lambda name: fail\n"
        "sys.exit(main())\n"
    )
    done = call("list", "--json", program="broken.py")
    assert done.returncode == 1
    assert "a fault of the library" in json.loads(done.stdout)["error"]
    assert "Traceback" in done.stderr


def test_a_program_that_calls_main_keeps_its_own_output(
    here: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    print("before")
    assert main(["list", "--json"]) == 0
    print("between")
    os.write(1, b"by number\n")
    assert main(["info", "nowhere", "--json"]) == 1
    lines = capfd.readouterr().out.splitlines()
    assert [lines[0], lines[2]] == ["before", "between"]
    assert "recipes" in json.loads(lines[1])
    assert "error" in json.loads(lines[-1])
    assert "by number" in lines


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_closed_stream_changes_no_exit_code(here: Path, stream: str) -> None:
    number = {"stdout": 1, "stderr": 2}[stream]
    line = f"{sys.executable} -m skillweave list --json {number}>&-"
    done = subprocess.run(line, shell=True, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stderr == ""
    if stream == "stderr":
        assert "recipes" in json.loads(done.stdout)


def test_numbers_that_json_lacks_are_null(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from skillweave.cli import execute

    def numbers(command: Any) -> Any:
        return {"a": [float("nan"), 1.5], "b": float("inf")}, ""

    monkeypatch.setattr(execute, "resolve", lambda name: numbers)
    assert main(["list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"a": [None, 1.5], "b": None}


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.3, 0.6, 1.0, 1.5])
def test_an_interrupt_while_libraries_are_imported_shows_no_traceback(
    here: Path, seconds: float
) -> None:
    line = [sys.executable, "-m", "skillweave", *TRAIN]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as one:
        time.sleep(seconds)
        one.send_signal(signal.SIGINT)
        out, err = one.communicate()
    assert one.returncode == 130
    assert "Traceback" not in err
    assert "error" in json.loads(out)
