"""Which directories a new run may take: an empty one, or one whose run has not learnt anything."""

from __future__ import annotations

import re
import stat
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING

from skillweave.errors import RunError
from skillweave.messages import shown_path
from skillweave.runs.command_words import load_words, resume_words, saved_words
from skillweave.runs.files import TEMPORARY, remove
from skillweave.runs.lock import NAME as LOCK

if TYPE_CHECKING:
    from skillweave.runs.directory import RunDirectory

FILES = ("run.json", "metrics.jsonl", "lineage.jsonl", LOCK, TEMPORARY)
"""What training writes before the first checkpoint."""
FOLDERS = {
    "policies": (TEMPORARY,),
    "starts": ("*.safetensors", TEMPORARY),
    "tensorboard": ("events.out.tfevents.*",),
}
"""Folders of such files. ``policies`` holds copies of ready policies, too."""
LEFT = ("wandb",)
"""Folders that a tracker of the run filled; they stay, as they belong to the tracker."""
LOCK_TEXT = re.compile(rb"(\d+ [^\n]*\n)?")


def check_replaceable(run: RunDirectory) -> None:
    """Raise a RunError where a run has learnt something that a new one would replace."""
    if run.finished:
        raise RunError(
            f"{shown_path(run.path)} holds a finished run, which is never replaced. Load it: "
            f"{load_words(run)}; or give more steps and continue it: {resume_words(run)}; or "
            "choose another directory"
        )
    if run.has_learnt:
        raise RunError(
            f"{shown_path(run.path)} holds an unfinished run, {saved_words(run)}. Continue it: "
            f"{resume_words(run)}; or choose another directory"
        )


def check_ours(path: Path, run: RunDirectory | None = None) -> None:
    """Raise a RunError where a directory holds what training did not write there.

    Args:
        run: the run in it; None: there is none.
    """
    skills = () if run is None else run.manifest.get("skills", ())
    copies = tuple(f"{s['name'].replace('/', '.')}.*" for s in skills)
    if not (path / "run.json").is_file():
        lock = path / LOCK
        ours = lock.is_file() and not lock.is_symlink() and lock.stat().st_size < 300
        if any(path.iterdir()) and not (ours and LOCK_TEXT.fullmatch(lock.read_bytes())):
            raise RunError(f"{path} exists and is not an empty directory; choose another")
    for foreign in _foreign(path, copies):
        raise RunError(
            f"{path} holds {foreign.relative_to(path)}, which is no file of a run that has just "
            "begun, so nothing there is replaced; choose another directory"
        )


def _foreign(path: Path, copies: tuple[str, ...]) -> Iterator[Path]:
    """Yield what is not ours; ``copies`` are names of ready policies' files."""
    for entry in path.iterdir():
        mode = entry.lstat().st_mode
        if stat.S_ISREG(mode):
            if not _fits(entry, FILES):
                yield entry
        elif not stat.S_ISDIR(mode) or entry.name not in (*FOLDERS, *LEFT):
            yield entry
        elif entry.name in FOLDERS:
            patterns = FOLDERS[entry.name] + (copies if entry.name == "policies" else ())
            for inner in entry.rglob("*"):
                mode = inner.lstat().st_mode
                plain = stat.S_ISREG(mode) and _fits(inner, patterns)
                if not plain and not stat.S_ISDIR(mode):
                    yield inner


def clear(path: Path) -> None:
    """Remove what a run wrote that has not learnt anything; ``check_ours`` comes before.

    Raises:
        RunError: it cannot be removed.
    """
    remove(path / "run.json")  # first: without it, nothing else counts
    for entry in list(path.iterdir()):
        if entry.name in FOLDERS:
            for inner in sorted(entry.rglob("*"), reverse=True):
                inner.rmdir() if inner.is_dir() else remove(inner)
            entry.rmdir()
        elif entry.name != LOCK and entry.name not in LEFT:
            remove(entry)


def _fits(path: Path, patterns: tuple[str, ...]) -> bool:
    return any(fnmatch(path.name, pattern) for pattern in patterns)
