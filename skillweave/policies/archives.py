"""Zip archives and NumPy's arrays from files that others may have made: bounded before unpacked."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np

from .acting_errors import PolicyError
from .core import Array
from .untrusted import shown

DIRECTORY = 2**24
"""The most bytes of an archive's list of files."""
_END = struct.Struct("<4s4H2LH")
"""The last bytes of an archive; the seventh number is the size of the list of its files."""


def unzipped(content: bytes, most: int) -> Iterator[tuple[str, bytes]]:
    """Yield the files in a zip archive by name, one after another.

    Args:
        most: bytes of all files together.

    Raises:
        PolicyError: it is damaged, encrypted, or too large; the message is without its name.
    """
    try:
        mark, *_, listed, _, comment = _END.unpack(content[-_END.size :])
        locator = content[-_END.size - 20 : -_END.size]
        # Where these are others, zipfile would look for a list elsewhere.
        if mark != b"PK\5\6" or comment or locator.startswith(b"PK\6\7") or listed > DIRECTORY:
            raise PolicyError("it is no zip archive, or has too many files")
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            names = [one.filename for one in members]
            if len(set(names)) < len(names):
                raise PolicyError("a name is in it twice")
            for one in members:
                # Other methods unpack without a bound.
                if one.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise PolicyError(f"{shown(one.filename)} is compressed by another method")
            if (size := sum(one.file_size for one in members)) > most:
                raise PolicyError(f"it unpacks to {size:,} bytes; at most {most:,} are read")
            for one in members:
                data = archive.read(one)
                if len(data) != one.file_size:
                    raise PolicyError(f"{shown(one.filename)} has another size than it says")
                yield one.filename, data
    except PolicyError:
        raise
    except Exception as error:  # zipfile's own errors have no common class
        raise PolicyError(str(error)[:200]) from error


def numbers_in(content: bytes) -> Array:
    """Return the array in a ``.npy`` file: numbers, or records of numbers; it is read-only.

    Raises:
        PolicyError: it is damaged, or holds something else.
    """
    try:
        found = _array(content)
    except PolicyError:
        raise
    except Exception as error:  # NumPy's own errors have no common class
        raise PolicyError(str(error)[:200]) from error
    for part in _leaves(found):
        if part.dtype.kind == "f" and np.isnan(part).any():
            raise PolicyError("it holds NaN")
    return found


def _array(content: bytes) -> Array:
    """Return the array in the bytes of a ``.npy`` file; check type and size."""
    # It refuses objects. It takes the memory of the shape first, but touches only what it has read.
    stream = io.BytesIO(content)
    array: Array = np.lib.format.read_array(stream)
    if not _is_plain(array.dtype):
        raise PolicyError(f"it is {shown(str(array.dtype))}, no array of numbers")
    if stream.read(1):
        raise PolicyError(f"its shape {array.shape} is not that of its {len(content):,} bytes")
    array.flags.writeable = False
    return array


def _is_plain(dtype: np.dtype[Any]) -> bool:
    """Return whether an array's type in a file is numbers, perhaps in records."""
    inner, _ = dtype.subdtype or (dtype, ())
    if inner.names is None:
        return inner.kind in "biuf" and inner.itemsize > 0
    return len(inner.names) > 0 and all(_is_plain(inner[name]) for name in inner.names)


def _leaves(x: Array) -> Iterator[Array]:
    """Yield the parts of the records of a NumPy array from a file, which are numbers."""
    if x.dtype.names is None:
        yield x
        return
    for name in x.dtype.names:
        yield from _leaves(x[name])
