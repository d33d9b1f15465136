"""Checks of free memory before a large allocation."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

from skillweave.errors import TrainingError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

PROCESSES = Path("/proc")
GROUPS = Path("/sys/fs/cgroup")
"""Folders of Linux with the memory of processes, and with the limits of control groups."""
FILES = {
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    2: ("memory.max", "memory.current", "inactive_file"),
}
"""By version of control groups, the files of limit and use, and the entry of dropped files."""


def check_memory(count: int, each: int, what: str, lower: str) -> None:
    """Raise a TrainingError where ``count`` times ``each`` bytes do not fit.

    ``what`` begins the message, and ``lower`` names the settings that make it smaller.
    """
    free = free_memory()
    if free is not None and count * each > free:
        raise TrainingError(
            f"{what} needs {count * each / 2**30:.1f} GiB, but {free / 2**30:.1f} GiB are free: "
            f"lower {lower} (at most about {free // each:,})"
        )


def free_memory() -> int | None:
    """Return the bytes that this process can still get, or None where the system reports none.

    In a container, or in a job of a cluster, that is often less than the machine has.
    """
    limits = [free for free in (_of_machine(), *_of_groups(), _of_process()) if free is not None]
    return min(limits, default=None)


def _of_machine() -> int | None:
    """Return the bytes that the machine can still give."""
    if match := re.search(r"MemAvailable: *(\d+) kB", _text(PROCESSES / "meminfo")):
        return int(match[1]) * 1024
    if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):  # macOS: all its memory
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _of_groups() -> Iterator[int]:
    """Yield the bytes that each control group of this process can still give (cgroups 1, 2)."""
    for line in _text(PROCESSES / "self" / "cgroup").splitlines():
        _, kinds, name = line.split(":", 2)
        if kinds and "memory" not in kinds.split(","):
            continue
        root = GROUPS / "memory" if kinds else GROUPS
        group = root / name.lstrip("/")
        # A container may see its own group as the root, under the name that it has outside.
        while group.is_relative_to(root):
            free = _of_group(group, FILES[1 if kinds else 2])
            if free is not None:
                yield free
            group = group.parent


def _of_group(group: Path, names: tuple[str, str, str]) -> int | None:
    """Return the memory that a group has left: its limit less its use without droppable files."""
    limit, used = (_text(group / name).strip() for name in names[:2])
    if not limit.isdecimal() or not used.isdecimal():  # "max": no limit
        return None
    files = re.search(rf"^{names[2]} (\d+)$", _text(group / "memory.stat"), re.MULTILINE)
    return max(int(limit) - int(used) + (int(files[1]) if files else 0), 0)


def _of_process() -> int | None:
    """Return the bytes that ``ulimit -v`` leaves."""
    pages = _text(PROCESSES / "self" / "statm").split()
    if resource is None or not pages:
        return None
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    if most == resource.RLIM_INFINITY:
        return None
    return max(most - int(pages[0]) * os.sysconf("SC_PAGE_SIZE"), 0)


def _text(file: Path) -> str:
    """Return the system's text on free memory in a file; "" where it does not exist."""
    try:
        return file.read_text("utf-8")
    except (OSError, ValueError):
        return ""
