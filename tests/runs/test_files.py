"""Files are whole or not there; what is damaged is named; nothing is ever unpickled."""

from __future__ import annotations

import ast
import errno
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch

import skillweave
from skillweave.errors import RunError
from skillweave.runs import files
from skillweave.runs.files import (
    SCHEMA,
    read_json,
    read_tensors,
    write_bytes,
    write_json,
    write_tensors,
)

LIBRARY = Path(skillweave.__file__).parent
TENSORS = {
    "weight": torch.arange(6, dtype=torch.float32).reshape(2, 3) / 7,
    "count": torch.tensor([3], dtype=torch.int64),
    "flag": torch.tensor([True, False]),
    "double": torch.tensor(1.0 / 3.0, dtype=torch.float64),
    "none": torch.empty(0, 4),
}


def full(*_: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A file with something in it, alone in its directory."""
    path = tmp_path / "run.json"
    write_bytes(path, b"as it was")
    return path


# Writing


def test_a_file_is_replaced_and_nothing_else_stays_behind(saved: Path) -> None:
    write_bytes(saved, b"anew")
    assert saved.read_bytes() == b"anew"
    assert [p.name for p in saved.parent.iterdir()] == [saved.name]
    below = saved.parent / "a" / "b" / "c.json"
    write_bytes(below, b"x")
    assert below.read_bytes() == b"x"


class Filling:
    """A file on a disk that fills up in the middle of a write."""

    def __init__(self, handle: int, mode: str) -> None:
        self.file = open(handle, mode)  # noqa: SIM115  # it is closed in __exit__

    def __enter__(self) -> Filling:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def write(self, data: bytes) -> None:
        self.file.write(data[: len(data) // 2])
        full()


def stop(*_: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("call", "fails"),
    [("fsync", full), ("replace", full), ("fdopen", Filling), ("fsync", stop)],
)
def test_a_full_disk_or_ctrl_c_leaves_the_old_file_and_no_temporary_file(
    saved: Path, monkeypatch: pytest.MonkeyPatch, call: str, fails: Any
) -> None:
    monkeypatch.setattr(files.os, call, fails)
    with pytest.raises((RunError, KeyboardInterrupt)) as caught:
        write_bytes(saved, b"anew")
    monkeypatch.undo()
    assert saved.read_bytes() == b"as it was"
    assert [p.name for p in saved.parent.iterdir()] == [saved.name], "a temporary file stays behind"
    assert caught.type is (KeyboardInterrupt if fails is stop else RunError)
    if fails is not stop:
        for words in (str(saved), "No space left", "intact"):
            assert words in str(caught.value)


def test_a_directory_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a directory")
    with pytest.raises(RunError, match="could not write") as caught:
        write_bytes(tmp_path / "file" / "run.json", b"x")
    assert str(tmp_path / "file" / "run.json") in str(caught.value)


WRITER = """
import sys
from pathlib import Path
limit, folder = sys.argv[1], Path(sys.argv[2])
from skillweave.runs.files import write_bytes, write_tensors
from skillweave.errors import SkillweaveError
import torch
write_bytes(folder / "run.json", b"as it was")
if limit == "rlimit":
    import resource
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
for write in (
    lambda: write_bytes(folder / "run.json", b"x" * 1_000_000),
    lambda: write_tensors(folder / "run.json", {"x": torch.zeros(250_000)}, {}),
):
    try:
        write()
    except SkillweaveError as error:
        print(error)
    else:
        sys.exit("there was room")
print(sorted(p.name for p in folder.iterdir()), (folder / "run.json").read_bytes())
"""


def _unshare() -> str | None:
    """How to get a mount namespace of one's own, where that is permitted."""
    if shutil.which("unshare") is None:
        return None
    probe = "mount -t tmpfs -o size=64k tmpfs /mnt"
    done = subprocess.run(["unshare", "-rm", "sh", "-c", probe], capture_output=True)
    return "unshare" if done.returncode == 0 else None


@pytest.mark.slow
@pytest.mark.parametrize("limit", ["tmpfs", "rlimit"])
def test_a_disk_that_is_really_full_leaves_the_old_file(tmp_path: Path, limit: str) -> None:
    folder = tmp_path / "disk"
    folder.mkdir()
    command = [sys.executable, "-c", WRITER, limit, str(folder)]
    if limit == "tmpfs":
        if _unshare() is None:
            pytest.skip("no small file system can be mounted here")
        mount = 'mount -t tmpfs -o size=64k tmpfs "$0" && exec "$@"'
        command = ["unshare", "-rm", "sh", "-c", mount, str(folder), *command]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    first, second, last = done.stdout.splitlines()
    why = "No space left on device" if limit == "tmpfs" else "File too large"
    for line in (first, second):
        assert line.startswith(f"could not write {folder / 'run.json'}: {why}")
        assert "intact" in line
    assert last == "['run.json'] b'as it was'"


# JSON


def test_json_comes_back_as_it_went_and_is_told_by_its_checksum_if_altered(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    data = {"name": "é", "list": [1, 2.5, None, True], "nested": {"a": {}}, "steps": 12}
    write_json(path, data | {"sizes": (1, 2)})
    assert read_json(path) == {"schema": SCHEMA, **data, "sizes": [1, 2]}
    path.write_text(path.read_text().replace("12", "13"))
    with pytest.raises(RunError, match=r"checksum.*edited by hand"):
        read_json(path)


DAMAGED_JSON = {
    "empty": b"",
    "cut off": b'{"schema": 1, "seed": 0, "pha',
    "not UTF-8": b'{"schema": 1, "x": "\xff\xfe"}',
    "a list": b"[1, 2]",
    "no schema": b'{"seed": 0}',
}


@pytest.mark.parametrize("content", DAMAGED_JSON.values(), ids=DAMAGED_JSON.keys())
def test_damaged_json_is_an_error_that_names_the_file(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "run.json"
    path.write_bytes(content)
    with pytest.raises(RunError) as caught:
        read_json(path)
    assert str(path) in str(caught.value)


def test_missing_files_and_pipes_are_named_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x")
    for read in (read_json, read_tensors):
        for name, says in (("x", "a pipe or a device"), ("nothing", "does not exist")):
            with pytest.raises(RunError, match=says) as caught:
                read(tmp_path / name)
            assert str(tmp_path / name) in str(caught.value)


def test_a_newer_schema_says_what_to_upgrade(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text(json.dumps({"schema": SCHEMA + 1}))
    with pytest.raises(RunError, match=f"schema {SCHEMA + 1}.*Upgrade"):
        read_json(tmp_path / "x.json")
    write_tensors(tmp_path / "x.safetensors", TENSORS, {"schema": SCHEMA + 1})
    with pytest.raises(RunError, match=f"schema {SCHEMA + 1}.*Upgrade"):
        read_tensors(tmp_path / "x.safetensors")


def test_what_json_cannot_hold_is_an_error_that_names_the_file(tmp_path: Path) -> None:
    for value in (float("nan"), object()):
        with pytest.raises(RunError) as caught:
            write_json(tmp_path / "run.json", {"value": value})
        assert str(tmp_path / "run.json") in str(caught.value)
        assert not any(tmp_path.iterdir())


# Tensors


@pytest.fixture
def tensors(tmp_path: Path) -> Path:
    path = tmp_path / "policy.safetensors"
    write_tensors(path, TENSORS, {"stage": "landing", "steps": 12})
    return path


def test_tensors_and_header_come_back_bit_for_bit(tensors: Path) -> None:
    found, header = read_tensors(tensors)
    assert header.pop("sha256")
    assert header == {"schema": SCHEMA, "stage": "landing", "steps": 12}
    assert found.keys() == TENSORS.keys()
    for name, value in TENSORS.items():
        assert found[name].dtype == value.dtype
        assert found[name].shape == value.shape
        assert found[name].numpy().tobytes() == value.numpy().tobytes()
        # Matrix products of tensors that start elsewhere than at a multiple of 64 bytes differ in
        # their last bit, so a run resumed from such tensors does not end with the same weights.
        assert found[name].data_ptr() % 64 == 0
    again = tensors.with_name("again.safetensors")
    write_tensors(again, dict(reversed(TENSORS.items())), {"steps": 12, "stage": "landing"})
    assert again.read_bytes() == tensors.read_bytes()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.complex64, torch.float8_e5m2])
def test_tensors_of_any_type_have_a_checksum(tmp_path: Path, dtype: torch.dtype) -> None:
    path = tmp_path / "x.safetensors"
    given = torch.arange(6.0).reshape(2, 3).to(dtype)
    sha256 = write_tensors(path, {"x": given, "scalar": given[0, 0].clone()}, {})
    found, header = read_tensors(path)
    assert header["sha256"] == sha256
    assert torch.equal(found["x"].view(torch.uint8), given.view(torch.uint8))


def test_a_file_cut_off_anywhere_is_an_error_that_names_it(tensors: Path) -> None:
    whole = tensors.read_bytes()
    for size in range(len(whole)):
        tensors.write_bytes(whole[:size])
        with pytest.raises(RunError) as caught:
            read_tensors(tensors)
        assert str(tensors) in str(caught.value)


@pytest.mark.parametrize("flip", [0x01, 0x80])
def test_a_file_altered_in_any_byte_is_an_error_that_names_it(tensors: Path, flip: int) -> None:
    whole = tensors.read_bytes()
    for place in range(len(whole)):
        altered = bytearray(whole)
        altered[place] ^= flip
        tensors.write_bytes(altered)
        with pytest.raises(RunError) as caught:
            read_tensors(tensors)
        assert str(tensors) in str(caught.value)
    assert "checksum" in str(caught.value), "the last byte is of a weight"


FOREIGN: dict[str, dict[str, str] | None] = {
    "no metadata": None,
    "other metadata": {"format": "pt"},
    "a header that is no object": {"skillweave": "[1]", "sha256": ""},
    "a header that is no JSON": {"skillweave": "{", "sha256": ""},
    "a header that is nested deep": {"skillweave": "[" * 3000 + "]" * 3000},
    "a header with NaN": {"skillweave": '{"schema": 1, "x": NaN}'},
    "no schema": {"skillweave": "{}", "sha256": ""},
    "no checksum": {"skillweave": '{"schema": 1}'},
}


@pytest.mark.parametrize("metadata", FOREIGN.values(), ids=FOREIGN.keys())
def test_a_foreign_safetensors_file_is_an_error_that_names_it(
    tmp_path: Path, metadata: dict[str, str] | None
) -> None:
    path = tmp_path / "foreign.safetensors"
    path.write_bytes(safetensors.torch.save({"x": torch.zeros(2)}, metadata))
    with pytest.raises(RunError) as caught:
        read_tensors(path)
    assert str(path) in str(caught.value)


# No pickle

PICKLES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
LOADERS = {
    ("torch", "load"),
    ("torch", "save"),
    ("np", "load"),
    ("np", "save"),
    ("numpy", "load"),
    ("numpy", "save"),
}
BUILTINS = {"eval", "exec", "compile"}


def pickles(source: str) -> list[str]:
    """Every place in a module's source that pickles, or runs text as code."""
    found = []
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
            if (node.module or "") in {"torch", "numpy"}:
                names += [a.name for a in node.names if (node.module, a.name) in LOADERS]
                found += [f"{node.lineno}: {n}" for n in names[1:]]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if (node.value.id, node.attr) in LOADERS:
                found.append(f"{node.lineno}: {node.value.id}.{node.attr}")
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            if node.func.id in BUILTINS:
                found.append(f"{node.lineno}: {node.func.id}()")
            if node.func.id in {"__import__"}:
                names = [str(getattr(a, "value", "")) for a in node.args]
        elif isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            found.append(f"{node.lineno}: allow_pickle")
        elif isinstance(node, ast.Constant) and node.value in PICKLES:
            found.append(f"{node.lineno}: {node.value!r}")
        found += [f"{node.lineno}: {n}" for n in names if n.split(".")[0] in PICKLES]
    return found


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "def f():\n    from dill import loads",
        "import torch\ntorch.load('x')",
        "from torch import save",
        "import numpy as np\nnp.load('x', allow_pickle=True)",
        "eval('1')",
        "import importlib\nimportlib.import_module('pickle')",
    ],
)
def test_the_search_for_pickle_finds_it(source: str) -> None:
    assert pickles(source)


@pytest.mark.needs("compat")
def test_nothing_in_the_library_pickles_or_runs_text_as_code() -> None:
    modules = sorted(LIBRARY.rglob("*.py"))
    assert len(modules) > 30
    found = {str(p.relative_to(LIBRARY)): pickles(p.read_text()) for p in modules}
    # The one that reads pickles of others: by an unpickler of its own, which admits what cannot act
    # (tests/compat/test_import.py). It imports the module once, and uses nothing else of it.
    assert len(found.pop("compat/pickles.py")) == 1
    source = (LIBRARY / "compat/pickles.py").read_text()
    assert re.findall(r"\bpickle\.\w+", source) == ["pickle.Unpickler"]
    # The one that sends the user's own code to processes of the same user, as multiprocessing does:
    # no file is ever read by it, and only these send and receive (``sweep`` asks it which
    # modules are the user's own, ``recipe_file`` names a recipe's folder, and
    # ``start_methods`` asks what another process would import).
    assert len(found.pop("workers/shipping.py")) == 2
    sender = (LIBRARY / "workers/shipping.py").read_text()
    assert not re.search(r"\bopen\(|\.read|\.load\(", sender)
    users = {str(p.relative_to(LIBRARY)) for p in modules if "workers.shipping" in p.read_text()}
    senders = {
        "cli/sweep.py",
        *(f"workers/{n}.py" for n in ("actors", "processes", "actor_host")),
    }
    others = {"api/recipe_file.py", "cli/sweep.py", "workers/start_methods.py"}
    assert users == senders | others
    # Messages between a run and its own workers, through pipes that only they have.
    assert len(found.pop("workers/channel.py")) == 1
    channel = (LIBRARY / "workers/channel.py").read_text()
    assert not re.search(r"\bopen\(|\.load\(", channel)
    assert {k: v for k, v in found.items() if v} == {}
