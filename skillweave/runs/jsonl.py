"""Files of JSON lines: a run appends to them, and a resumed run first shortens them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from skillweave.errors import RunError
from skillweave.policies.untrusted import check_file, load_json, shown
from skillweave.runs.files import LARGEST_JSON, own_copy
from skillweave.schema import as_json, fit


class JsonLines:
    """One file of JSON lines, created with the first line.

    Args:
        path: the file.
        schema: the schema of each line (see ``schema.fit``).
        next_step: returns the command to type when a full disk has space again, for messages.
    """

    def __init__(self, path: Path, schema: Any, next_step: Callable[[], str]) -> None:
        self.path = path
        self._schema = schema
        self._next_step = next_step
        self._file: Any = None

    @property
    def size(self) -> int:
        """Return the size of the file in bytes."""
        return self.path.stat().st_size if self.path.exists() else 0

    def append(self, records: Iterable[Any]) -> None:
        """Append one line per record, a dataclass or a dict.

        Raises:
            RunError: the disk is full or cannot be written.
        """
        text = "".join(json.dumps(as_json(record)) + "\n" for record in records)
        try:
            if self._file is None:
                own_copy(self.path)
                self._file = self.path.open("a", encoding="utf-8")
            self._file.write(text)
            self._file.flush()
        except OSError as error:
            self.close()  # a line that failed must not be written later
            raise RunError(
                f"could not write {self.path}: {error.strerror}. The checkpoint is intact; free "
                f"space, then: {self._next_step()}"
            ) from error

    def rewind(self, size: int | None) -> None:
        """Truncate to ``size`` bytes, because training writes the rest again; None: do nothing.

        Raises:
            RunError: the disk cannot be written.
        """
        self.close()
        try:
            if size is not None and self.size > size:
                own_copy(self.path)
                os.truncate(self.path, size)
        except OSError as error:
            raise RunError(f"could not write {self.path}: {error.strerror}") from error

    def read(self) -> Iterator[Any]:
        """Yield the records, without a last line that is incomplete.

        Raises:
            RunError: a line is damaged, or the path is not a plain file.
        """
        if not self.path.exists():
            return
        check_file(self.path)
        with self.path.open("rb") as file:
            lines = iter(lambda: file.readline(LARGEST_JSON + 1), b"")
            for number, line in enumerate(lines, 1):
                if len(line) > LARGEST_JSON:
                    raise RunError(
                        f"{self.path} is damaged in line {number}: it has more than "
                        f"{LARGEST_JSON:,} bytes"
                    )
                if not line.endswith(b"\n"):
                    return
                try:
                    record = load_json(line)
                except (ValueError, RecursionError) as error:
                    raise RunError(
                        f"{self.path} is damaged in line {number}: {str(error)[:300]}"
                    ) from error
                if not isinstance(record, dict):
                    raise RunError(
                        f"{self.path} is damaged in line {number}: {shown(record)} is no object"
                    )
                yield fit(self._schema, record, f"{self.path}, line {number}")

    def close(self) -> None:
        """Close the file; the next line opens it again."""
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None
