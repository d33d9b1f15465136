"""Whether something fits into the machine's memory, before it is made."""

from __future__ import annotations

import os
import re
from pathlib import Path

from skillweave.types import SkillweaveError


def check_memory(count: int, each: int, what: str, lower: str) -> None:
    """Raise a SkillweaveError where ``count`` times ``each`` bytes do not fit.

    ``what`` begins the message, and ``lower`` names the settings that make it smaller.
    """
    free = free_memory()
    if free is not None and count * each > free:
        raise SkillweaveError(
            f"{what} needs {count * each / 2**30:.1f} GiB, but {free / 2**30:.1f} GiB are free: "
            f"lower {lower} (at most about {free // each:,})"
        )


def free_memory() -> int | None:
    """Bytes that the machine can still give at most, or None where it does not say."""
    meminfo = Path("/proc/meminfo")
    text = meminfo.read_text() if meminfo.exists() else ""
    if found := re.search(r"MemAvailable: *(\d+) kB", text):
        return int(found[1]) * 1024
    if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):  # macOS: all that it has
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None
