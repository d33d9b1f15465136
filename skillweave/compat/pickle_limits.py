"""Limits of a checkpoint of ``torch.save``: apart, as they are checked before it is read."""

from __future__ import annotations

import pickletools
import zipfile
from typing import Any

from skillweave.errors import RunError

DEEPEST = 100
"""Deepest nesting of a pickle's objects: hashing a deeper tuple overflows Python's stack."""
MOST_STEPS = 500_000
"""Operations of a pickle's program; each may take memory."""
LARGEST_PROGRAM = 16 * 2**20
"""Bytes of the program; tensors lie beside it."""
LARGEST = 2**30
"""Bytes of everything in the file."""
_INTO = {"APPEND", "APPENDS", "SETITEM", "SETITEMS", "ADDITEMS", "BUILD"}
"""Operations that put something into an object on the stack."""
_MARK = -1


def check_sizes(file: zipfile.ZipFile, size: int, program: str) -> None:
    """Raise where reading a zip of ``size`` bytes would take far more memory than that."""
    total = sum(member.file_size for member in file.infolist())
    if total > LARGEST:
        raise RunError(f"it declares {total:,} bytes; at most {LARGEST:,} are read")
    if total > size:
        raise RunError(
            f"refused: it declares {total:,} bytes in a file of {size:,}; what torch.save writes "
            "is not compressed"
        )
    size_of_program = file.getinfo(program).file_size
    if size_of_program > LARGEST_PROGRAM:
        raise RunError(
            f"its pickle declares {size_of_program:,} bytes; at most {LARGEST_PROGRAM:,} are read"
        )


def check_program(program: bytes) -> None:
    """Raise where a pickle's program is too long, or its objects are nested too deep.

    It is run with the depth of every object in place of the object.
    """
    stack: list[int] = []
    memo: dict[Any, int] = {}
    for step, (operation, argument, _) in enumerate(pickletools.genops(program)):
        name, taken = operation.name, operation.stack_before
        if step >= MOST_STEPS:
            raise RunError(f"its pickle has more than {MOST_STEPS:,} operations")
        if name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            memo[len(memo) if name == "MEMOIZE" else argument] = stack[-1]
            continue
        if name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
            continue
        if name == "MARK":
            stack.append(_MARK)
            continue
        inner = []
        if pickletools.markobject in taken:
            while (depth := stack.pop()) != _MARK:
                inner.append(depth)
            taken = taken[: taken.index(pickletools.markobject)]
        inner += [stack.pop() for _ in taken]
        outer = inner.pop() if name in _INTO else 0
        depth = max(outer, max(inner, default=-1) + 1)
        if depth > DEEPEST:
            raise RunError(f"its pickle nests objects more than {DEEPEST} deep")
        stack += [depth] * len(operation.stack_after)
