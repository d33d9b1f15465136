"""Checkpoints of ``torch.save``, read without running code from them.

A pickle is a program that calls what it names. Here it may name only what builds tensors, NumPy
numbers and arrays, devices and plain containers, each by a function of this module's or one that
is known to do nothing else; everything else stops the reading.
"""

from __future__ import annotations

import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.types import SkillweaveError

_STORAGES = {
    "FloatStorage": torch.float32, "DoubleStorage": torch.float64, "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16, "LongStorage": torch.int64, "IntStorage": torch.int32,
    "ShortStorage": torch.int16, "CharStorage": torch.int8, "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}  # fmt: skip


class Inert:
    """Stands for an object that carries nothing worth having, such as a loss of torch's."""


def read_torch_pickle(path: Path) -> Any:
    """What ``torch.save`` wrote, if it is tensors, numbers, arrays and plain containers.

    Raises:
        SkillweaveError: the file is missing or damaged, or names anything else; it is named.
    """
    try:
        with zipfile.ZipFile(path) as file:
            name = next((n for n in file.namelist() if n.endswith("/data.pkl")), None)
            if name is None:
                raise SkillweaveError(f"{path} is a zip, but not one of torch.save's")
            with file.open(name) as data:
                return _Reader(data, file, name.removesuffix("data.pkl")).load()
    except FileNotFoundError as error:
        raise SkillweaveError(f"{path} does not exist") from error
    except zipfile.BadZipFile as error:
        raise SkillweaveError(
            f"{path} is no checkpoint of torch.save's (or one of before torch 1.6): {error}"
        ) from error
    except SkillweaveError as error:
        raise SkillweaveError(f"{path}: {error}") from error
    except Exception as error:  # a damaged pickle can fail in any way
        raise SkillweaveError(f"{path} is damaged: {type(error).__name__}: {error}") from error


class _Reader(pickle.Unpickler):
    def __init__(self, data: Any, file: zipfile.ZipFile, prefix: str) -> None:
        super().__init__(data, encoding="utf-8")
        self._file, self._prefix = file, prefix

    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy._core", "numpy.core")
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        if (module, name) not in _ALLOWED:
            raise SkillweaveError(
                f"refused: the pickle names {module}.{name}, which is neither a tensor, a number, "
                "an array, a device nor a plain container"
            )
        return _ALLOWED[module, name]

    def persistent_load(self, pid: Any) -> Tensor:
        kind, dtype, key, _, size = pid
        if kind != "storage" or not isinstance(dtype, torch.dtype):
            raise SkillweaveError(f"refused: the pickle refers to {pid!r}")
        data = bytearray(self._file.read(f"{self._prefix}data/{key}"))
        return torch.frombuffer(data, dtype=dtype, count=size) if size else torch.empty(0).to(dtype)


def _tensor(storage: Tensor, offset: int, size: Any, stride: Any, *_: Any) -> Tensor:
    return storage.as_strided(size, stride, offset).clone()  # as_strided checks the bounds


def _parameter(data: Tensor, *_: Any) -> Tensor:
    return data


class _DType:
    """A plain dtype; of a pickle's further wishes for it only the byte order counts."""

    def __init__(self, kind: Any, *_: Any) -> None:
        self.real = np.dtype(kind)
        if self.real.kind not in "biufcSU":
            raise SkillweaveError(f"refused: the pickle holds an array of {self.real}")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.real = self.real.newbyteorder(state[1])


def _scalar(dtype: _DType, data: bytes) -> Any:
    return np.frombuffer(data, dtype.real, 1)[0]


class _Array(np.ndarray[Any, Any]):
    """What arrays are rebuilt as: never more than numbers."""

    def __new__(cls, *_: Any) -> _Array:
        return super().__new__(cls, 0)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, fortran, data = state
        super().__setstate__((1, shape, dtype.real, fortran, data))


def _create_array(make: Any, arguments: Any, state: Any, *_: Any) -> Any:
    if make is not _Array:  # dill's way to write an array
        raise SkillweaveError(f"refused: the pickle makes an array by {make}")
    found = _Array(*arguments)
    found.__setstate__(state)
    return found


def _encode(text: str, encoding: str) -> bytes:
    return text.encode("latin1")  # how pickles of protocol 2 write bytes


def _load_type(name: str) -> type:
    kinds: dict[str, type] = {k.__name__: k for k in (set, frozenset, dict, list, tuple)}
    if name not in kinds:  # dill's function knows all types, that of code too
        raise SkillweaveError(f"refused: the pickle names the type {name!r}")
    return kinds[name]


_ALLOWED: dict[tuple[str, str], Callable[..., Any] | type] = {
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): _parameter,
    ("torch", "device"): torch.device,
    ("torch.nn.modules.loss", "MSELoss"): Inert,
    ("torch.nn.modules.loss", "SmoothL1Loss"): Inert,
    ("collections", "OrderedDict"): OrderedDict,
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
