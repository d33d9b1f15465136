"""Tables of numbers that ready policies read: reference motions, from files or arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from skillweave._internal.messages import short
from skillweave.errors import DeclarationError, PolicyError
from skillweave.policies.archives import numbers_in
from skillweave.policies.core import Array, read_only
from skillweave.policies.untrusted import checksum, read_file

LARGEST = 2**30
"""The most bytes of a file."""


@dataclass(frozen=True, eq=False)
class Recording:
    """The numbers of a table, (rows, columns) float64, which files name by their checksum."""

    numbers: Array
    name: str
    """Of the file, or "an array"."""
    sha256: str

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Recording) and self.sha256 == other.sha256

    def __deepcopy__(self, memo: Any) -> Recording:
        return self  # it never changes

    def __reduce__(self) -> Any:
        return recording_named, (np.array(self.numbers), self.name)

    def __hash__(self) -> int:
        return hash(self.sha256)

    def __repr__(self) -> str:
        rows, columns = self.numbers.shape
        return f"<{self.name}, {rows} rows of {columns}>"

    def to_json(self) -> dict[str, Any]:
        """Return its name, size and checksum, without its numbers."""
        return {"name": self.name, "shape": list(self.numbers.shape), "sha256": self.sha256}


def recording(given: Any) -> Recording:
    """Return a table of a file or of numbers.

    Raises:
        DeclarationError: it is no table of finite numbers.
        RunError: the file cannot be read.
    """
    if isinstance(given, Recording):
        return given
    name = str(given) if isinstance(given, str | Path) else "an array"
    try:
        if isinstance(given, str | Path):
            numbers = _read(Path(given))
        elif np.iscomplexobj(given):
            raise ValueError("it has complex numbers")
        else:
            numbers = np.array(given, np.float64)
    except (TypeError, ValueError, PolicyError) as error:
        raise DeclarationError(
            f"Table.file is {short(given)}, but no table of numbers can be read from it: "
            f"{str(error)[:200]}. Give a .csv or .npy file, or an array (rows, columns)"
        ) from error
    numbers = numbers[:, None] if numbers.ndim == 1 else numbers
    if numbers.ndim != 2 or not numbers.size:
        raise DeclarationError(
            f"Table.file is {short(given)} of shape {numbers.shape}; it must be (rows, columns)"
        )
    if not (finite := np.isfinite(numbers)).all():
        row, column = np.argwhere(~finite)[0].tolist()
        raise DeclarationError(
            f"Table.file is {short(given)}, whose row {row} has {numbers[row, column]} in column "
            f"{column}; all its numbers must be finite"
        )
    return recording_named(numbers, name)


def recording_named(numbers: Array, name: str) -> Recording:
    """Return a table of numbers (rows, columns), with their checksum."""
    numbers = np.ascontiguousarray(numbers)
    shape = repr(numbers.shape).encode()
    return Recording(read_only(numbers), name, checksum(shape + numbers.tobytes()))


def _read(file: Path) -> Array:
    """Return the numbers of a file, float64.

    Raises:
        ValueError: they cannot be read.
    """
    content = read_file(file, LARGEST)
    if file.suffix == ".npy":
        return np.array(numbers_in(content), np.float64)
    lines = content.decode("utf-8-sig").splitlines()
    rows = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    separator = next((x for x in ";,\t" if rows and x in rows[-1]), None)
    while rows and not any(_is_number(cell) for cell in rows[0].split(separator)):
        del rows[0]  # names of the columns, or units
    if rows and not all(_is_number(cell) for cell in rows[0].split(separator)):
        raise ValueError(f"its line {rows[0][:80]!r} has numbers and other words")
    return np.loadtxt(rows, np.float64, delimiter=separator, ndmin=2, quotechar='"')


def _is_number(cell: str) -> bool:
    """Return whether a cell of a line is a number."""
    try:
        float(cell.strip().strip('"'))
    except ValueError:
        return False
    return True


def recorded(data: Any, known: Mapping[str, Any], where: str) -> Recording:
    """Return the table that a file names by its checksum.

    Raises:
        DeclarationError: the declaration has no such table; ``where`` begins the message.
    """
    sha256 = data.get("sha256") if isinstance(data, Mapping) else None
    table = known.get(sha256) if isinstance(sha256, str) else None
    if isinstance(table, Recording):
        return table
    name = data.get("name") if isinstance(data, Mapping) else data
    raise DeclarationError(
        f"{where} needs the table {short(name)} with the checksum {short(sha256)}: the declaration "
        "has another one, or none"
    )
