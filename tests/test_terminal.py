"""What leaves for a terminal: control characters escaped; a closed or full stream ends nothing."""

from __future__ import annotations

import ast
import io
import json
import os
import pty
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

import skillweave
from skillweave import Agent, EnvSpec, Hierarchy, SkillweaveError
from skillweave._internal.terminal import one_line, printable
from skillweave.cli import main
from skillweave.runs.files import read_json, write_json
from tests.small_runs import ON, Left, policies

STEPS = 96
EVIL = "CartPole-v1\x1b]52;c;ZXZpbA==\x07\x9b2J\u202e"
RAW = ("\x1b", "\x07", "\x9b", "\u202e", "\r")


class Warns(gym.Wrapper):
    def reset(self, **options: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn("the motor is hot", UserWarning, stacklevel=1)
        return super().reset(**options)


def warm() -> gym.Env:
    return Warns(gym.make("CartPole-v1"))


# How fast it steps is not measured: the number of processes changes what is learnt.
WARM = EnvSpec(warm, workers=1)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    return Agent(WARM, ON, STEPS).train(tmp_path_factory.mktemp("r") / "run", quiet=True).path


# Closed, full and missing streams


def streams(kind: str) -> Any:
    """A standard error that takes nothing."""
    if kind == "full":
        return open("/dev/full", "w")
    if kind == "none":
        return None
    if kind == "closed":
        stream = io.TextIOWrapper(io.BytesIO())
        stream.close()
        return stream
    read, write = os.pipe()
    os.close(read)
    return open(write, "w")  # its reader went away


KINDS = [
    pytest.param(
        "full",
        marks=pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no such device"),
    ),
    "none",
    "closed",
    "reader gone",
]


@pytest.mark.parametrize("kind", KINDS)
def test_training_goes_on_without_standard_error(kind, tmp_path, monkeypatch, reference, capsys):
    stream = streams(kind)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", stream)
        trained = Agent(WARM, ON, STEPS).train(tmp_path / "run")
        trained.evaluate(2)
        assert sys.stderr is stream
        if stream is not None and not stream.closed:
            stream.close()  # raises nothing: nothing waits in it
    assert policies(trained.path) == policies(reference)
    assert capsys.readouterr().out == ""  # progress is no result


def test_bars_on_a_terminal_that_goes_away(tmp_path, monkeypatch, reference):
    outer, inner = pty.openpty()
    for name in ("CI", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    seen = []

    def leave(event: Any) -> None:
        if not seen:
            seen.append(os.read(outer, 100))
            os.close(outer)

    with open(inner, "w") as terminal, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", terminal)
        trained = Agent(WARM, ON, STEPS).train(tmp_path / "run", callback=leave)
        assert seen != []
    assert policies(trained.path) == policies(reference)


@pytest.mark.parametrize("kind", KINDS)
def test_commands_with_a_standard_output_that_takes_nothing(kind, monkeypatch, capsys):
    stream = streams(kind)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stream)
        code = main(["list"])
        if stream is not None:
            stream.close()
    says = capsys.readouterr().err
    if kind == "full":
        assert (code, says) == (
            1,
            "error: could not write to standard output: No space left on device\n",
        )
    else:
        assert (code, says) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "code", "says"),
    [
        ("--help | head -c 1", 0, ""),
        ("list | head -c 1", 0, ""),
        ("info lunar-lander --json | head -c 1", 0, ""),
        ("list 2>&-", 0, ""),
        ("list >&-", 0, ""),
        ("list > /dev/full", 1, "error: could not write to standard output: No space"),
        ("info nothing-there 2>/dev/full", 1, ""),
    ],
)
def test_commands_in_pipes_end_quietly(line, code, says):
    command = f"set -o pipefail; {sys.executable} -m skillweave {line}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.returncode == code
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


PROGRAM = """
import contextlib, gymnasium as gym, os, sys
from skillweave import PPO, Agent, Network
def make():
    with contextlib.suppress(OSError):
        os.write(2, b"what a library writes")
    return gym.make("CartPole-v1")
on = PPO(num_envs=4, n_steps=8, batch_size=16, update_epochs=2, network=Network((8,)))
run = Agent(make, on, 96).train(sys.argv[1], checkpoint_every=32)
print(run.evaluate(1, save=True))
"""


@pytest.mark.slow
@pytest.mark.parametrize("how", ["2>&-", "2>&- >&- <&-", ">&- 2>/dev/full"])
def test_what_is_written_to_a_closed_standard_error_gets_into_no_file_of_the_run(how, tmp_path):
    file = tmp_path / "program.py"
    file.write_text(PROGRAM)
    command = f"{sys.executable} {file} {tmp_path / 'run'} {how}"
    assert subprocess.run(["bash", "-c", command], env=environment()).returncode == 0
    for path in (tmp_path / "run").rglob("*"):
        assert path.is_dir() or b"what a library writes" not in path.read_bytes()


def environment(**more: str) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])} | more


# Control characters in what others wrote


@pytest.fixture
def evil(tmp_path):
    """A run of somebody who wrote control characters wherever a text may be."""
    left = type("Stranger", (Left,), {"name": "left"})
    hierarchy = Hierarchy("CartPole-v1", [left()], algorithm=ON, selector=ON, steps=192)
    run = hierarchy.train(tmp_path / "run", quiet=True).path
    data = read_json(run / "run.json")
    del data["schema"]
    data["env"] = EVIL
    data["created"] = "\x1b[2J\rfinished: all good\nrun  /etc"
    data["recipe"] = "\x1b[31mlunar-lander"
    data["versions"] = {"\x1b[8mpython": "3\x1b[8m"}
    data["stages"][0]["final"]["\x1b]0;x\x07"] = 1.0
    write_json(run / "run.json", data)
    return run


QUICK = (
    ["info", "RUN"],
    ["list"],
    ["info", "RUN", "--json"],
    ["evaluate", "RUN", "--skill", "\x1b[2J"],
    ["train", "\x1b[2J.py"],
    ["no\x1b[2Jcommand"],
    ["resume", "RUN", "--traceback"],
)
ALL = (
    *QUICK,
    ["evaluate", "RUN"],
    ["resume", "RUN"],
    ["report", "RUN"],
    ["compare", "RUN"],
    ["export", "RUN", "--onnx"],
    ["weights", "RUN"],
    ["plot", "RUN"],
    ["push", "RUN", "owner/name"],
    ["sweep", "RUN"],
)


@pytest.mark.filterwarnings("ignore:the environment has changed")
@pytest.mark.parametrize("commands", [QUICK, pytest.param(ALL, marks=pytest.mark.slow)])
def test_commands_print_a_strangers_run_escaped(commands, evil, capfd, monkeypatch):
    os.rename(evil, evil.parent / "runs-1")
    (evil.parent / "runs").mkdir()
    os.rename(evil.parent / "runs-1", evil.parent / "runs" / "a\x1b[2J")
    monkeypatch.chdir(evil.parent)
    run = "runs/a\x1b[2J"
    for words in commands:
        words = [run if word == "RUN" else word for word in words]
        main(words)
        out, err = capfd.readouterr()
        assert out + err != ""
        assert not [raw for raw in RAW if raw in out + err], words
    main(["info", run])
    assert "\\nrun  /etc" in capfd.readouterr().out
    main(["info", run, "--json"])
    assert json.loads(capfd.readouterr().out)["env"] == EVIL


def test_controls_are_escaped_in_errors_and_descriptions_and_words_stay():
    assert printable("größer → 5 ± 1\n\tnext") == "größer → 5 ± 1\n\tnext"
    assert printable("\x1b[2J\r\x9b\u202e\x7f") == "\\x1b[2J\\x0d\\x9b\\u202e\\x7f"
    assert one_line("a\nfinished: all good") == "a\\nfinished: all good"
    error = SkillweaveError(f"no environment {EVIL}")
    assert not [raw for raw in RAW if raw in str(error)]
    named = Agent(WARM, ON, STEPS)
    warm.__name__ = warm.__qualname__ = EVIL
    try:
        assert not [raw for raw in RAW if raw in repr(named) + str(named)]
    finally:
        warm.__name__ = warm.__qualname__ = "warm"


def test_progress_of_a_metric_with_a_hostile_name_is_escaped(tmp_path, capsys):
    class Tells(gym.Wrapper):
        def step(self, action):
            *rest, info = super().step(action)
            return (*rest, info | {"d\x1b[2J": 1.0})

    Agent(lambda: Tells(gym.make("CartPole-v1")), ON, STEPS).train(
        tmp_path / "run", log_info=["d\x1b[2J"]
    )
    said = capsys.readouterr().err
    assert "d\\x1b[2J" in said
    assert "\x1b" not in said


# A locale of ASCII


@pytest.mark.slow
def test_a_run_in_a_locale_of_ascii(tmp_path):
    env = environment(LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0", PYTHONIOENCODING="ascii")
    recipe = tmp_path / "größe.py"
    recipe.write_text(
        "from skillweave import *\n"
        "class Links(Skill):\n"
        '    "Geht über die Brücke."\n'
        "    max_steps = 15\n"
        "    def reward(self, step): return -step.next_obs[:, 0]\n"
        "on = PPO(num_envs=4, n_steps=8, batch_size=16, network=Network((8,)))\n"
        "hierarchy = Hierarchy('CartPole-v1', [Links()], algorithm=on, selector=on, steps=200)\n",
        encoding="utf-8",
    )
    run = tmp_path / "läufe" / "eins"
    for words in (
        ["train", str(recipe), "--out", str(run), "--evaluate", "2"],
        ["info", str(run)],
        ["report", str(run), "--films", "0", "--episodes", "2"],
        ["resume", str(run), "--recipe", str(recipe)],
    ):
        done = subprocess.run(
            [sys.executable, "-m", "skillweave", *words], env=env, capture_output=True
        )
        assert done.returncode == 0, done.stderr.decode(errors="replace")
        assert b"Traceback" not in done.stderr


PICTURES = ("html_report/", "reporting/lineage.py", "reporting/curves_figure.py")
PICTURES += ("reporting/displays.py", "reporting/facts.py", "reporting/groups.py")
"""Modules whose texts are drawn, or written to pages and terminals that know all letters."""


def test_texts_that_users_may_print_are_ascii():
    root = Path(skillweave.__file__).parent
    wrong = []
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root).as_posix()
        if name.startswith(PICTURES) or name == "policies/acting_errors.py":
            continue  # the latter escapes such letters
        nodes = list(ast.walk(ast.parse(path.read_text("utf-8"))))
        comments = [x.value for x in nodes if isinstance(x, ast.Expr)]  # docstrings
        wrong += [
            f"{name}:{x.lineno}: {x.value!r}"
            for x in nodes
            if isinstance(x, ast.Constant) and isinstance(x.value, str)
            if not x.value.isascii() and x not in comments
        ]
    assert wrong == []


@pytest.mark.needs("html_report")
def test_results_and_errors_can_be_printed_where_the_encoding_knows_ascii_alone(
    tmp_path, monkeypatch
):
    trained = Hierarchy(WARM, [Left()], algorithm=ON, selector=ON, steps=STEPS).train(
        tmp_path / "run", quiet=True
    )
    score = trained.evaluate(2, quiet=True)
    trained.log_calls(60)
    with pytest.raises(SkillweaveError) as caught:
        trained.evaluate("x" * 1000)
    with open(tmp_path / "out.txt", "w", encoding="ascii") as out:
        for made in (score, score.for_people(), trained, trained.calls, trained.calls.handover()):
            print(made, repr(made), file=out)
        for made in (trained.calls.chain("left", "left"), trained.info(), caught.value):
            print(made, file=out)
        monkeypatch.setattr(sys, "stdout", out)
        assert [main(words) for words in (["list"], ["info", "lunar-lander"])] == [0, 0]
