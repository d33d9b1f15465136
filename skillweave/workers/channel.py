"""Messages between this process and a worker: a pipe, and shared memory for their arrays.

Arrays and tensors go as one block of bytes in memory that both processes map. The block has no name
in a file system, and two descriptors for any number of tensors. Where the system gives no such
memory, the bytes go through the pipe.
"""

from __future__ import annotations

import io
import mmap
import os
import pickle
import struct
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing import reduction
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch
from torch import Tensor

ALIGNED = 64
"""Each array begins at a multiple of this many bytes, as in memory that torch allocates."""
_ZEROS = bytes(2**20)


class Block:
    """Memory that two processes share; the process that writes it makes it larger if needed."""

    def __init__(self) -> None:
        self._file = _unnamed_file()
        self._reserved = 0
        self._map: mmap.mmap | None = None

    def __getstate__(self) -> tuple[Any]:
        """Return the descriptor for a process that is not forked.

        It stands in a tuple because pickle does not restore a state of None.
        """
        return (None if self._file is None else reduction.DupFd(self._file),)

    def __setstate__(self, state: tuple[Any]) -> None:
        (file,) = state
        self._file = None if file is None else file.detach()
        self._reserved = 0
        self._map = None

    def reserve(self, size: int) -> bool:
        """Make the block large enough for ``size`` bytes; return False if there is no room."""
        if self._file is None:
            return False
        if size > self._reserved:
            for more in (size + size // 4, size):
                try:
                    _allocate(self._file, self._reserved, more)
                except OSError:  # no room for that size
                    continue
                self._reserved = more
                return True
            return False
        return True

    def bytes(self, size: int) -> memoryview:
        """Return the first ``size`` bytes, which are reserved."""
        assert self._file is not None
        if self._map is None or len(self._map) < size:
            # Views of the former map keep it alive.
            self._map = mmap.mmap(self._file, os.fstat(self._file).st_size)
        return memoryview(self._map)[:size]

    def close(self) -> None:
        """Release the memory; where views of it remain, it is freed with the last one."""
        if self._map is not None:
            with suppress(BufferError):  # it has views
                self._map.close()
            self._map = None
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _unnamed_file() -> int | None:
    """Return a descriptor of a file in memory, or of a temporary file; None if neither opens."""
    with suppress(OSError):
        if hasattr(os, "memfd_create"):  # not in /dev/shm, which may be small or read-only
            return os.memfd_create("skillweave", os.MFD_CLOEXEC)
    with suppress(OSError), tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
    return None


def _allocate(file: int, before: int, size: int) -> None:
    """Reserve ``size`` bytes for a file.

    Writing to a file that is long but has no reserved room ends the process.

    Raises:
        OSError: there is no room.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
        return
    at = before
    while at < size:
        at += os.pwrite(file, _ZEROS[: size - at], at)


class Channel:
    """One end of a connection.

    Args:
        pipe: to the other end.
        out: memory that this end writes.
        back: memory that the other end writes.
    """

    def __init__(self, pipe: Connection, out: Block, back: Block) -> None:
        self.pipe = pipe
        self._out = out
        self._back = back

    def send(self, message: Any) -> None:
        """Send a message to the other process: anything that can be pickled.

        The other end must have received the message before: its arrays are overwritten.

        Raises:
            OSError: the other end is closed (``BrokenPipeError``), or the system refuses.
            Exception: it cannot be pickled.
        """
        buffers: list[pickle.PickleBuffer] = []
        stream = io.BytesIO()
        _Pickler(stream, 5, buffer_callback=buffers.append).dump(message)
        parts = [b.raw() for b in buffers]
        sizes = [part.nbytes for part in parts]
        places, total = _places(sizes)
        shared = total > 0 and self._out.reserve(total)
        head = struct.pack(f"<?Q{len(sizes)}Q", shared, len(sizes), *sizes)
        if shared:
            block = self._out.bytes(total)
            for at, part in zip(places, parts, strict=True):
                block[at : at + part.nbytes] = part
        self.pipe.send_bytes(head + stream.getvalue())
        if not shared:
            for part in parts:
                self.pipe.send_bytes(part)

    def receive(self, *, views: bool = False) -> Any:
        """Return the next message.

        Args:
            views: return arrays that are views of the shared memory, valid until this end sends
                again; else copies.

        Raises:
            EOFError, OSError: the other end is closed.
        """
        data = memoryview(self.pipe.recv_bytes())
        shared, count = struct.unpack_from("<?Q", data)
        end = struct.calcsize(f"<?Q{count}Q")
        sizes = struct.unpack_from(f"<?Q{count}Q", data)[2:]
        places, total = _places(sizes)
        block: Any = None
        if shared:
            block = np.frombuffer(self._back.bytes(total), np.uint8)
        if not (shared and views):
            found = torch.empty(total, dtype=torch.uint8).numpy()
            if shared:
                found[:] = block
            else:
                for at, size in zip(places, sizes, strict=True):
                    self.pipe.recv_bytes_into(found.data[at : at + size])
            block = found
        buffers = [block[at : at + size] for at, size in zip(places, sizes, strict=True)]
        return pickle.loads(data[end:], buffers=buffers)

    def close(self) -> None:
        """Close this end."""
        self.pipe.close()
        self._out.close()
        self._back.close()


def channels(context: Any) -> tuple[Channel, Channel]:
    """Return both ends of a connection between processes of a ``multiprocessing`` context."""
    ours, theirs = context.Pipe()
    there, back = Block(), Block()
    return Channel(ours, there, back), Channel(theirs, back, there)


def _places(sizes: Sequence[int]) -> tuple[list[int], int]:
    """Return the offsets of a message's arrays in shared memory, and the size in bytes."""
    places, at = [], 0
    for size in sizes:
        places.append(at)
        at += -(-size // ALIGNED) * ALIGNED
    return places, at


class _Pickler(pickle.Pickler):
    """A pickler that returns the bytes of arrays and tensors as separate buffers."""

    def __init__(self, *about: Any, **how: Any) -> None:
        super().__init__(*about, **how)
        self._storages: dict[int, _Storage] = {}

    def reducer_override(self, thing: Any) -> Any:
        """Return the function and arguments that rebuild an array or a tensor; else use pickle."""
        kind = type(thing)
        if kind is np.ndarray and thing.nbytes and not thing.dtype.hasobject:
            flat = np.ascontiguousarray(thing).reshape(-1).view(np.uint8)
            return _array, (pickle.PickleBuffer(flat.data), thing.dtype, thing.shape)
        if kind is Tensor and _is_plain(thing):
            storage = thing.untyped_storage()
            kept = self._storages.setdefault(storage.data_ptr(), _Storage(thing))
            dtype = str(thing.dtype).removeprefix("torch.")  # pickle looks for it in every module
            place = thing.storage_offset(), tuple(thing.shape), thing.stride()
            return _tensor, (kept, dtype, *place)
        return NotImplemented


class _Storage:
    """The bytes that several tensors view, sent once for all of them."""

    def __init__(self, tensor: Tensor) -> None:
        whole = torch.empty(0, dtype=torch.uint8).set_(tensor.untyped_storage())
        self._bytes = whole.numpy()

    def __reduce__(self) -> Any:
        return _storage, (pickle.PickleBuffer(self._bytes.data),)


def _is_plain(tensor: Tensor) -> bool:
    """Return True for a tensor of plain numbers, whose bytes a message can copy."""
    return (
        tensor.device.type == "cpu"
        and tensor.layout is torch.strided
        and not tensor.requires_grad
        and not (tensor.is_conj() or tensor.is_neg())
        and tensor.untyped_storage().nbytes() > 0
    )


def _array(data: Any, dtype: Any, shape: tuple[int, ...]) -> Any:
    return np.ndarray(shape, dtype, data)


def _storage(data: Any) -> Any:
    return torch.frombuffer(data, dtype=torch.uint8).untyped_storage()


def _tensor(storage: Any, dtype: str, offset: int, shape: Any, stride: Any) -> Tensor:
    empty = torch.empty(0, dtype=getattr(torch, dtype))
    return empty.set_(storage, offset, shape, stride)
