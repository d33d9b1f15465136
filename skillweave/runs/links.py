"""Checks for links inside a run, through which training would change files outside of it.

A run may come from another person. Training appends to its files, shortens and deletes some;
through a link it would change the user's other files. The directory of the run itself may be
reached through a link.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from skillweave.errors import RunError
from skillweave.runs.files import write_bytes

ABOVE = 2
"""Folders above a file that may be its run: ``<run>/policies/<file>``."""
TRACKERS = ("wandb",)
"""Folders of trackers that make links to other files of the same folder."""


def check_no_links(run: Path) -> None:
    """Raise a RunError where a run holds a link, a pipe or a device.

    Args:
        run: its directory, which may be reached through a link.
    """
    for entry in _entries(run):
        if entry.is_symlink():
            if not _stays_in_tracker(run, Path(entry.path)):
                raise RunError(
                    f"{entry.path} is a link to {_target(entry.path)}, and nothing is written into "
                    "a run with links, because that would change files outside of it. Put a copy "
                    "in its place, or delete it"
                )
        elif not entry.is_file() and not entry.is_dir():
            raise RunError(
                f"{entry.path} is a pipe or a device, and nothing is written into a run with such "
                "files. Delete it"
            )


def check_no_links_around(folder: Path) -> None:
    """Raise a RunError where a folder is in a run that holds a link, or is one."""
    folder = folder.absolute()
    for place in (folder, *folder.parents[:ABOVE]):
        if os.path.lexists(place / "run.json"):
            check_no_links(place)
            return


def own_copy(path: Path) -> None:
    """Replace a file with further names (hard links) by a separate copy.

    ``cp -al`` makes such copies of a run. A line appended to one would appear in all.
    """
    with suppress(FileNotFoundError):
        if os.stat(path).st_nlink > 1:
            write_bytes(path, path.read_bytes(), make_directories=False)


def _entries(folder: Path) -> Iterator[os.DirEntry[str]]:
    """Yield all entries below a folder; links are not followed."""
    waiting = [str(folder)]
    while waiting:
        try:
            with os.scandir(waiting.pop()) as scanned:
                entries = sorted(scanned, key=lambda entry: entry.name)
        except OSError as error:
            raise RunError(f"could not read {error.filename}: {error.strerror}") from error
        for entry in entries:
            yield entry
            if entry.is_dir(follow_symlinks=False):
                waiting.append(entry.path)


def _stays_in_tracker(run: Path, link: Path) -> bool:
    """Return whether a link is in a tracker's folder, and leads to something there."""
    folder = run / link.relative_to(run).parts[0]
    if folder.name not in TRACKERS or folder == link:
        return False
    return link.resolve().is_relative_to(folder.resolve())


def _target(link: str) -> str:
    try:
        return os.readlink(link)
    except OSError:
        return "another place"
