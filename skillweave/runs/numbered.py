"""Numbered directories, for runs without a directory from the user."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from skillweave.errors import RunError

FOLDER = Path("runs")
"""The parent of numbered directories, below the working directory."""
LONGEST = 60
"""The most characters of a name."""


def safe_name(text: str) -> str:
    """Return ``text`` as the name of a folder: ``ALE/Pong-v5`` becomes ``ALE-Pong-v5``."""
    name = re.sub(r"[^\w.-]+", "-", text, flags=re.ASCII)[:LONGEST].strip("-.")
    return name or "run"


def make_numbered(name: str, below: Path) -> Path:
    """Make the directory ``runs/<name>-<n>`` below another one; ``n`` is the next free number.

    Two processes that call it at once get two directories.

    Raises:
        RunError: it cannot be made.
    """
    name = safe_name(name)
    folder = below / FOLDER
    pattern = re.compile(rf"{re.escape(name)}-(\d+)")
    try:
        folder.mkdir(exist_ok=True)
        taken = (pattern.fullmatch(path.name) for path in folder.iterdir())
        number = max((int(match[1]) for match in taken if match), default=0) + 1
        while True:
            path = folder / f"{name}-{number}"
            with suppress(FileExistsError):
                path.mkdir()
                return path
            number += 1
    except OSError as error:
        raise RunError(f"could not make a directory in {folder}: {error.strerror}") from error
