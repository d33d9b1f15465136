"""The harness of mutated files: it sees whatever a reader may do wrong, and repeats its cases."""

import os
import random
import shutil
import signal
import socket
import subprocess

import pytest
import torch

from scripts.torture import files
from scripts.torture.files import judge
from scripts.torture.hostile_pickles import programs
from scripts.torture.mutations import Change, change, mutate_tree
from scripts.torture.report import (
    ASKED,
    CODE,
    EQUAL,
    HANG,
    LONG,
    MEMORY,
    NAMELESS,
    OTHERWISE,
    REFUSED,
    TRACEBACK,
    Tally,
    table,
)
from scripts.torture.samples import Sample, agilerl, onnx_file
from skillweave.errors import SkillweaveError
from skillweave.runs.files import write_json, write_tensors

RIGHT = {"actions": [1, 2]}


def use(function):
    return Sample(lambda folder: None, function)


def outcome(function, folder, asks=False):
    return judge(use(function), folder, Change("run.json", "kind", "", asks), RIGHT)


def say(text):
    raise SkillweaveError(text)


def spin():
    while True:
        pass


def hog():
    # Far more than what tests before this one left, and what may be given back meanwhile.
    taken = bytearray(300 << 20)
    taken[:: 1 << 12] = b"x" * len(taken[:: 1 << 12])
    return RIGHT


WRONG = {
    EQUAL: lambda folder: RIGHT,
    OTHERWISE: lambda folder: {"actions": [1, 3]},
    REFUSED: lambda folder: say(f"{folder}/run.json is damaged"),
    NAMELESS: lambda folder: say("it is damaged"),
    LONG: lambda folder: say(f"{folder}/run.json says {'x' * 1000}"),
    TRACEBACK: lambda folder: 1 / 0,
    HANG: lambda folder: spin(),
    MEMORY: lambda folder: hog(),
}


@pytest.mark.parametrize("category", WRONG)
def test_every_kind_of_behaviour_is_told_apart(tmp_path, monkeypatch, category):
    monkeypatch.setattr(files, "SECONDS", 0.2 if category == HANG else 60.0)
    monkeypatch.setattr(files, "MUCH_MEMORY", 20 << 20)
    before = signal.signal(signal.SIGPROF, files._too_slow)
    try:
        found = outcome(lambda folder, changed: WRONG[category](folder), tmp_path)
    finally:
        signal.signal(signal.SIGPROF, before)
    assert found.category == category
    assert found.bad == category.isupper()


def test_what_a_change_asks_for_and_writing_into_its_own_folder_is_not_wrong(tmp_path):
    assert outcome(lambda folder, changed: {}, tmp_path, asks=True).category == ASKED

    def write(folder, changed):
        (folder / "new").mkdir()
        (folder / "new" / "x").write_text("x")
        shutil.rmtree(folder / "new")
        return RIGHT

    assert outcome(write, tmp_path).category == EQUAL


def connect():
    with socket.socket() as client:
        client.connect_ex(("127.0.0.1", 9))


RUNS = {
    "os.system": lambda outside: os.system("true"),
    "subprocess": lambda outside: subprocess.run(["true"], check=False),
    "a file elsewhere": lambda outside: (outside / "x").write_text("x"),
    "a folder elsewhere": lambda outside: (outside / "y").mkdir(),
    "a file removed elsewhere": lambda outside: (outside / "z").unlink(missing_ok=True),
    "the environment": lambda outside: os.environ.__setitem__("TORTURE", "1"),
    "a connection": lambda outside: connect(),
    "code from elsewhere": lambda outside: exec(compile("1", str(outside / "evil.py"), "exec")),
}


@pytest.mark.parametrize("what", RUNS)
def test_code_that_runs_is_seen_even_if_the_reader_then_refuses(tmp_path, what):
    folder, outside = tmp_path / "case", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()

    def misbehave(case, changed):
        RUNS[what](outside)
        say(f"{case} is damaged")

    assert outcome(misbehave, folder).category == CODE


# Changes


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A file of every kind."""
    path = tmp_path_factory.mktemp("originals")
    write_json(path / "run.json", {"seed": 3, "skills": [{"name": "x", "max_steps": None}]})
    (path / "metrics.jsonl").write_text('{"return": 1.5}\n{"return": 2.5}\n')
    tensors = {"a": torch.arange(6.0).reshape(2, 3), "count": torch.ones(1, dtype=torch.int32)}
    write_tensors(path / "policies" / "flat.safetensors", tensors, {"kind": "agent"})
    pytest.importorskip("onnx")
    onnx_file(path / "model.onnx")
    agilerl(path)
    return path


def content(folder):
    """Everything below a folder, and what is no plain file by its kind."""
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() and not p.is_symlink() else
        (p.is_dir(), p.is_fifo(), p.is_symlink())
        for p in sorted(folder.rglob("*"))
    }  # fmt: skip


def changed(folder, target, number):
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(folder, target)
    told = change(random.Random(number), target)
    return told, content(target)


@pytest.mark.slow
def test_a_number_gives_the_same_change_again_and_nearly_all_change_something(folder, tmp_path):
    original, same, kinds = content(folder), 0, set()
    for number in range(300):
        told, after = changed(folder, tmp_path / "x", number)
        again, repeated = changed(folder, tmp_path / "x", number)
        assert told == again
        if not told.file.endswith(".pt"):  # a zip knows the time it was made
            assert after == repeated
        same += after == original
        kinds.add(told.kind.split()[1])
    assert same < 30
    assert kinds >= {"bytes", "place", "json", "text", "line", "raw_header", "header", "tensors"}


@pytest.mark.slow
def test_only_named_settings_ask_for_other_behaviour_and_bad_numbers_never(folder, tmp_path):
    for number in range(600):
        told, _ = changed(folder, tmp_path / "x", number)
        if told.file == "run.json":
            assert told.asks == (told.kind.split()[-1] in {"seed", "skills.0.max_steps"}), told
        if told.kind.endswith(("NaN", "infinite")):
            assert not told.asks
        if told.file.endswith(("flat.safetensors", ".jsonl")):
            assert not told.asks


def test_a_tree_is_changed_in_one_place():
    for number in range(200):
        tree = {"a": 1, "b": [2, {"c": None}], "d": {"e": "x"}}
        where, _ = mutate_tree(random.Random(number), tree)
        assert where in {"a", "b", "b.0", "b.1", "b.1.c", "d", "d.e"}


def test_hostile_pickles_are_many_and_each_would_be_one(tmp_path):
    found = dict(programs())
    assert len(found) > 150
    # The unguarded reader does what they say.
    name = next(n for n in found if n.startswith("GLOBAL os.mkdir"))
    code = f"import pickle; pickle.loads({b'%c%c' % (128, 2) + found[name] + b'.'!r})"
    subprocess.run(["python3", "-c", code], cwd=tmp_path, check=True)
    assert (tmp_path / "CODE_RAN").is_dir()


# The report


def test_the_table_counts_and_failures_are_kept(tmp_path):
    tally = Tally("files", "--seed 5")
    tally.add(1, files.Outcome(EQUAL, "x: y"), tmp_path / "kept.jsonl")
    for number in (2, 3):
        said = f'File "/a/skillweave/runs/x.py", line 7, in f\nValueError: {number}'
        tally.add(number, files.Outcome(TRACEBACK, "x: y", said), tmp_path / "kept.jsonl")
    assert tally.bad == 2
    assert len((tmp_path / "kept.jsonl").read_text().splitlines()) == 2
    assert '2 × TRACEBACK: [runs/x.py", line N, in f] ValueError: N' in tally.examples()
    assert "python -m scripts.torture files --seed 5 --case 2" in tally.examples()
    rows = [line.split() for line in table([tally]).splitlines()[1:]]
    assert rows == [
        ["as", "the", "original", "1"], ["TRACEBACK", "2"], ["cases", "3"], ["failures", "2"],
    ]  # fmt: skip


def test_what_a_pickle_changes_of_its_reader_is_found_once_and_mended():
    name, function = next(iter(files.functions().items()))
    function.mine = 1
    function.__defaults__ = (7,)
    assert files.changed_functions() == [name]
    assert files.changed_functions() == []
    assert not hasattr(function, "mine")
