"""Read checkpoints of ``torch.save`` without running code from them.

A pickle is a program that calls what it names. Here it may name only what builds tensors, NumPy
numbers and arrays, devices and plain containers, each by a function of this module's or one that
has no other effect; everything else stops the reading.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave._internal.messages import short, shortened
from skillweave.errors import RunError, SkillweaveError
from skillweave.policies.untrusted import check_file, shown

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


_STORAGES = {
    "FloatStorage": torch.float32,
    "DoubleStorage": torch.float64,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}


class Inert:
    """A stand-in for an object that is not needed, such as a loss of torch's."""

    def __setstate__(self, state: Any) -> None:
        """Ignore it."""


class _Dict(dict[Any, Any]):
    """An OrderedDict; a dict keeps its order, too."""

    def __setstate__(self, state: Any) -> None:
        """Ignore it: torch keeps the versions of its modules there."""


class _Held:
    """A tensor while the pickle is being read, so that the pickle cannot alter it."""

    __slots__ = ("tensor",)

    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor

    def __setstate__(self, state: Any) -> None:
        raise RunError("refused: the pickle sets the attributes of a tensor")


class _Call:
    """A function that the pickle may only call."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise RunError("refused: the pickle sets the attributes of a function")


def read_torch_pickle(path: Path) -> Any:
    """Return the content of a ``torch.save``: tensors, numbers, arrays and plain containers.

    Raises:
        RunError: the file is missing, damaged, too large or nested too deep, or names
            anything else; it is named.
    """
    check_file(path)
    try:
        with zipfile.ZipFile(path) as file:
            name = next((n for n in file.namelist() if n.endswith("/data.pkl")), None)
            if name is None:
                raise RunError("it is a zip, but not one of torch.save's")
            check_sizes(file, path.stat().st_size, name)
            program = file.read(name)
            check_program(program)
            prefix = name.removesuffix("data.pkl")
            return _plain(_Unpickler(io.BytesIO(program), file, prefix).load())
    except zipfile.BadZipFile as error:
        reason = shortened(str(error))  # it may quote much of the file
        raise RunError(
            f"{path} is no checkpoint of torch.save's (or one of before torch 1.6): {reason}"
        ) from error
    except SkillweaveError as error:
        raise RunError(f"{path}: {error}") from error
    except Exception as error:  # a damaged pickle can fail in any way
        reason = f"{type(error).__name__}: {shortened(str(error))}"
        raise RunError(f"{path} is damaged: {reason}") from error


def check_sizes(file: zipfile.ZipFile, size: int, program: str) -> None:
    """Raise where reading a zip with a pickle would take far more memory than its size."""
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


class _Weight:
    """The size and depth of a pickle's object, which are known before it is made."""

    def __init__(self) -> None:
        self.depth = 0
        self.size = 1  # in objects, if nothing were shared
        self.taken = False  # another object holds it, so it may not grow any more


def check_program(program: bytes) -> None:
    """Raise where a pickle's program is too long, or what it makes too deep, endless or too large.

    It is run with the weight of every object in place of the object.
    """
    stack: list[_Weight] = []
    memo: dict[Any, _Weight] = {}
    mark = _Weight()
    for step, (operation, argument, _) in enumerate(pickletools.genops(program)):
        name = operation.name
        operands = operation.stack_before
        if step >= MOST_STEPS:
            raise RunError(f"its pickle has more than {MOST_STEPS:,} operations")
        if name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            memo[len(memo) if name == "MEMOIZE" else argument] = stack[-1]
            continue
        if name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
            continue
        if name == "MARK":
            stack.append(mark)
            continue
        if name == "DUP":  # no pickle of Python's has it
            raise RunError("refused: the pickle doubles an object")
        inner = []
        if pickletools.markobject in operands:
            while (weight := stack.pop()) is not mark:
                inner.append(weight)
            operands = operands[: operands.index(pickletools.markobject)]
        inner += [stack.pop() for _ in operands]
        outer = inner.pop() if name in _INTO else _Weight()
        for part in inner:
            part.taken = True
            outer.depth = max(outer.depth, part.depth + 1)
            outer.size += part.size
        if outer.depth > DEEPEST or (inner and outer.taken):  # it would hold itself, endlessly
            raise RunError(f"its pickle nests objects more than {DEEPEST} deep")
        if outer.size > MOST_STEPS:
            raise RunError(f"its pickle holds more than {MOST_STEPS:,} objects")
        stack += [outer] * len(operation.stack_after)


def _plain(data: Any) -> Any:
    """Return a checkpoint's pickled objects as plain tensors, numbers and containers."""
    if isinstance(data, dict):
        return {_plain(key): _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple | set | frozenset):
        return type(data)(map(_plain, data))
    if isinstance(data, _Held):
        return data.tensor
    if isinstance(data, _Array):
        return np.asarray(data)
    return data.item() if isinstance(data, np.generic) else data


class _Unpickler(pickle.Unpickler):
    """An unpickler of AgileRL's checkpoints that makes only plain things, and runs no code."""

    def __init__(self, data: Any, file: zipfile.ZipFile, prefix: str) -> None:
        super().__init__(data, encoding="utf-8")
        self._file = file
        self._prefix = prefix
        self._storages: dict[tuple[str, torch.dtype], Tensor] = {}
        # Made again for each file: a pickle may set attributes of a class.
        self._inert = type("Inert", (Inert,), {})

    def find_class(self, module: str, name: str) -> Any:
        """Return what a pickle names, if it is allowed: a tensor, a number, a plain container."""
        module = module.replace("numpy._core", "numpy.core")
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        allowed = _ALLOWED.get((module, name))
        if allowed is None:
            raise RunError(
                f"refused: the pickle names {module[:60]}.{name[:60]}, which is neither a tensor, "
                "a number, an array, a device nor a plain container"
            )
        return self._inert if allowed is Inert else _Call(allowed)

    def persistent_load(self, pid: Any) -> _Held:
        """Return a tensor's storage that the pickle of a checkpoint refers to."""
        kind, dtype, key, _, size = pid
        if kind != "storage" or not isinstance(dtype, torch.dtype) or not isinstance(key, str):
            raise RunError(f"refused: the pickle refers to {shown(pid)}")
        if (key, dtype) not in self._storages:
            data = bytearray(self._file.read(f"{self._prefix}data/{key}"))
            empty = torch.empty(0, dtype=dtype, device="cpu")
            self._storages[key, dtype] = torch.frombuffer(data, dtype=dtype) if data else empty
        storage = self._storages[key, dtype]
        if len(storage) != size:
            raise RunError(f"is damaged: storage {shown(key)} does not hold {shown(size)}")
        return _Held(storage)


def _tensor(storage: _Held, offset: int, size: Any, stride: Any, *_: Any) -> _Held:
    # No copy: a file of one number could ask for a billion. as_strided checks the bounds.
    return _Held(storage.tensor.as_strided(size, stride, offset))


def _parameter(data: _Held, *_: Any) -> _Held:
    return data


class _DType:
    """A plain dtype; of a pickle's further wishes for it only the byte order counts."""

    def __init__(self, kind: Any, *_: Any) -> None:
        self.real = np.dtype(kind)
        if self.real.kind not in "biufcSU":
            raise RunError(f"refused: the pickle holds an array of {short(self.real)}")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.real = self.real.newbyteorder(state[1])


def _scalar(dtype: _DType, data: bytes) -> Any:
    return np.frombuffer(data, dtype.real, 1)[0]


class _Array(np.ndarray[Any, Any]):
    """A rebuilt array, of numbers alone."""

    def __new__(cls, *_: Any) -> _Array:
        return super().__new__(cls, 0)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, fortran, data = state
        super().__setstate__((1, shape, dtype.real, fortran, data))


def _create_array(make: Any, arguments: Any, state: Any, *_: Any) -> Any:
    """Return a NumPy array as dill writes it into a pickle."""
    if not isinstance(make, _Call) or make._function is not _Array:  # dill writes arrays so
        raise RunError(f"refused: the pickle makes an array by {shown(make)}")
    array = _Array(*arguments)
    array.__setstate__(state)
    return array


def _encode(text: str, encoding: str) -> bytes:
    return text.encode("latin1")  # how pickles of protocol 2 write bytes


def _load_type(name: str) -> type:
    kinds: dict[str, type] = {k.__name__: k for k in (set, frozenset, dict, list, tuple)}
    if name not in kinds:  # dill's function has all types, that of code too
        raise RunError(f"refused: the pickle names the type {shown(name)}")
    return kinds[name]


_ALLOWED: dict[tuple[str, str], Callable[..., Any] | type] = {
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): _parameter,
    ("torch", "device"): torch.device,
    ("torch.nn.modules.loss", "MSELoss"): Inert,
    ("torch.nn.modules.loss", "SmoothL1Loss"): Inert,
    ("collections", "OrderedDict"): _Dict,
    ("builtins", "set"): set,
    ("__builtin__", "set"): set,
    ("dill._dill", "_load_type"): _load_type,
    ("dill._dill", "_create_array"): _create_array,
    ("_codecs", "encode"): _encode,
    ("numpy", "dtype"): _DType,
    ("numpy", "ndarray"): _Array,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy.core.multiarray", "_reconstruct"): _Array,
}
