"""Archives and arrays that others made: bounded before they are unpacked, refused in a sentence."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from skillweave.errors import PolicyError
from skillweave.policies.archives import numbers_in, unzipped

STORED, DEFLATED = zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED


def npy(array: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def zipped(members: Mapping[str, bytes], how: int = DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", how) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


MEMBERS = {"low.npy": npy(np.linspace(0, 1, 500)), "outer/high.npy": npy(np.arange(9))}


def changed(local: int, central: int, number: int) -> bytes:
    """An archive with another number in the two headers of its first file."""
    data = bytearray(zipped(MEMBERS))
    for mark, place in ((b"PK\x03\x04", local), (b"PK\x01\x02", central)):
        first = data.find(mark) + place
        data[first : first + 2] = struct.pack("<H", number)
    return bytes(data)


def damaged() -> bytes:
    data = bytearray(zipped(MEMBERS))
    data[50:60] = b"\xff" * 10
    return bytes(data)


def twice() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a", b"1")
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive.writestr("a", b"2")
    return file.getvalue()


WRONG: dict[str, Callable[[], bytes]] = {
    "no archive": lambda: b"hello",
    "empty": lambda: b"",
    "an array alone": lambda: MEMBERS["low.npy"],
    "half of one": lambda: zipped(MEMBERS)[:300],
    "its end alone": lambda: zipped(MEMBERS)[-22:],
    "with a comment": lambda: zipped(MEMBERS)[:-2] + b"\x02\x00hi",
    "damaged": damaged,
    "encrypted": lambda: changed(6, 8, 1),
    "an unknown method": lambda: changed(8, 10, 99),
    "bzip2": lambda: zipped(MEMBERS, zipfile.ZIP_BZIP2),
    "lzma": lambda: zipped(MEMBERS, zipfile.ZIP_LZMA),
    "a larger file": lambda: changed(22, 24, 60_000),
    "a smaller file": lambda: changed(22, 24, 100),
    "a name twice": twice,
    "a bomb": lambda: zipped({"a": bytes(2_000_000)}),
    "many small ones": lambda: zipped({f"{i}": bytes(20_000) for i in range(60)}),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_archive_is_refused_in_a_sentence(name: str) -> None:
    with pytest.raises(PolicyError, match=r"\w"):
        dict(unzipped(WRONG[name](), 1_000_000))


@pytest.mark.parametrize("how", [STORED, DEFLATED])
def test_an_archive_is_read_up_to_its_limit(how: int) -> None:
    size = sum(map(len, MEMBERS.values()))
    assert dict(unzipped(zipped(MEMBERS, how), size)) == MEMBERS
    with pytest.raises(PolicyError, match=rf"unpacks to {size:,} bytes; at most {size - 1:,} are"):
        dict(unzipped(zipped(MEMBERS, how), size - 1))


ARRAYS = [
    np.linspace(0, 1, 7), np.float32(2.5), np.arange(6, dtype=np.uint8).reshape(2, 3),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.zeros((0, 3), np.int16),
    np.array([True, False]), np.array([np.inf, -np.inf]), np.arange(4, dtype=">i4"),
    np.zeros(2, np.dtype([("a", "f4", (3,)), ("b", "i8"), ("c", [("d", "u1")])], align=True)),
    np.ones(3, [("größe", "f8")]),
]  # fmt: skip


@pytest.mark.parametrize("array", ARRAYS, ids=lambda x: f"{x.dtype.kind}{x.shape}")
def test_arrays_of_numbers_are_read_as_numpy_reads_them(array: Any) -> None:
    found, wanted = numbers_in(npy(array)), np.load(io.BytesIO(npy(array)))
    assert (found.dtype, found.shape) == (wanted.dtype, wanted.shape)
    np.testing.assert_array_equal(found, wanted)


def header(text: str, numbers: bytes = b"") -> bytes:
    content = text.encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(content)) + content + numbers


def shaped(shape: Any, kind: Any = "<f4", numbers: bytes = b"") -> bytes:
    return header(repr({"descr": kind, "fortran_order": False, "shape": shape}), numbers)


NO_ARRAYS = {
    "empty": b"",
    "text": b"hello, this is no array",
    "of another version": b"\x93NUMPY\x09\x00" + b"\x00" * 20,
    "half of one": npy(np.arange(9.0))[:-1],
    "with more": npy(np.arange(9.0)) + b"x",
    "half of a header": npy(np.arange(9.0))[:30],
    "10**13 numbers": shaped((10**13,)),
    "2**64 numbers": shaped((2**64,)),
    "none of 2**80": shaped((0, 2**80)),
    "a negative shape": shaped((-1, -1), "<f4", bytes(4)),
    "a shape of halves": shaped((1.5,)),
    "a shape that is a text": shaped("x"),
    "70 axes": shaped((1,) * 70, "<f4", bytes(4)),
    "numbers without bytes": shaped((10**13,), "|V0"),
    "records without bytes": shaped((10**13,), []),
    "signs": header("{'descr':'<f4','fortran_order':False,'shape':(" + "-" * 5000 + "1,)}"),
    "brackets": header("(" * 9000),
    "no dict": header("1"),
    "a dict without fields": header("{}"),
    "a header too long": header(" " * 20_000),
    "complex": npy(np.zeros(3, complex)),
    "texts": npy(np.array(["a", "b"])),
    "bytes": npy(np.array([b"a"])),
    "dates": npy(np.zeros(2, "M8[s]")),
    "objects": shaped((1,), "|O", bytes(8)),
    "records with objects": shaped((1,), [("a", "<f4"), ("b", "|O")], bytes(12)),
    "NaN": npy(np.array([1.0, np.nan])),
    "NaN in records": npy(np.full(2, np.nan, [("a", "f4")])),
}


@pytest.mark.parametrize("content", NO_ARRAYS.values(), ids=NO_ARRAYS)
def test_what_is_no_array_of_numbers_is_refused_in_a_sentence(content: bytes) -> None:
    with pytest.raises(PolicyError, match=r"\w"):
        numbers_in(content)
