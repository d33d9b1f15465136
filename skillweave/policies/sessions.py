"""Sessions of onnxruntime for ONNX files that others may have made."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from typing import Any

from .acting_errors import PolicyError
from .core import Array

MOST_FIELDS = 5_000_000
"""The most fields of an ONNX file, numbers of packed arrays not counted."""
MOST_NODES = 1_000_000
"""The most nodes of an ONNX file whose functions are replaced by their nodes."""
LONGEST_TRIAL = 10.0
"""The most seconds of a trial: acting for one observation."""
MOST_MEMORY = 2**30
"""The most bytes of a trial, weights not counted."""
FOLDED = 2**26
"""The most bytes of a constant that onnxruntime computes where it opens a file."""

MESSAGES: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "tensor": {},
}
"""ONNX's messages (``onnx.proto``) by their fields: those that lead to tensors."""
EXTERNAL_DATA, DATA_LOCATION = 13, 14
"""Fields of a tensor that name another file."""
NAMES = {"node": (4, 7, 8), "function": (1, 10, 13)}
"""Fields with the name, the domain and the overload of an operator, and of a function."""
VARINT = 0
BYTES = 2
FIXED = {1: 8, 5: 4}
"""Protobuf's wire types; of the last ones the numbers of bytes."""


# Files ------------------------------------------------------------------------------------------


Operator = tuple[bytes, ...]
"""The name, the domain and the overload of an operator, or of a function that stands for nodes."""


def check_file_alone(content: bytes, who: str) -> None:
    """Raise a PolicyError where an ONNX file is damaged, or has weights in other files.

    Its fields are read as protobuf writes them, so their order and encoding do not matter. Each
    byte is read once at most.
    """
    try:
        nodes = _nodes_by_function(content, who)
    except IndexError as error:
        raise _damaged(who) from error
    if _expanded(nodes) > MOST_NODES:
        raise PolicyError(
            f"{who} has functions that call themselves, or stand for more than {MOST_NODES:,} nodes"
        )


def _damaged(who: str) -> PolicyError:
    return PolicyError(f"{who} cannot be run by onnxruntime: it is no ONNX file, or a damaged one")


def _nodes_by_function(content: bytes, who: str) -> dict[Operator, list[Operator]]:
    """Return the operators of the nodes in the graph of a file, by (), and in each function.

    Raises:
        PolicyError: the file is damaged, or a tensor is in another one.
        IndexError: it ends too early.
    """
    graph: list[Operator] = []
    functions: list[tuple[Operator, list[Operator]]] = [((), graph)]
    todo = [("model", 0, len(content), graph)]
    left = MOST_FIELDS
    while todo:
        kind, at, end, nodes = todo.pop()
        inner = MESSAGES[kind]
        name = dict.fromkeys(NAMES.get(kind, ()), b"")
        around = nodes
        if kind == "function":
            nodes = []
        while at < end:
            left -= 1
            if left < 0:
                raise PolicyError(f"{who} has more than {MOST_FIELDS:,} fields")
            tag, at = _varint(content, at, 5)
            field = (tag & 0xFFFFFFFF) >> 3
            wire = tag & 7
            value = 1
            first = at
            if wire == VARINT:
                value, at = _varint(content, at, 10)
            elif wire == BYTES:
                value, first = _varint(content, at, 5)
                at = first + value
            elif wire in FIXED:
                at += FIXED[wire]
            else:
                raise _damaged(who)
            if at > end or field == 0:
                raise _damaged(who)
            if kind == "tensor":
                elsewhere = field == DATA_LOCATION and (wire != VARINT or value != 0)
                if elsewhere or field == EXTERNAL_DATA:
                    raise PolicyError(
                        f"{who} has weights in other files, which no checksum covers: save it as "
                        "one file"
                    )
            elif wire == BYTES and field in inner:
                todo.append((inner[field], first, at, nodes))
            elif wire == BYTES and field in name:
                name[field] = content[first:at]
        operator = tuple(name.values())
        if kind == "node":
            around.append(operator)
        elif kind == "function":
            functions.append((operator, nodes))
    found: dict[Operator, list[Operator]] = {}
    for operator, nodes in functions:
        found.setdefault(operator, []).extend(nodes)
    return found


def _varint(content: bytes, at: int, most: int) -> tuple[int, int]:
    """Return a number in an ONNX file of ``most`` bytes at most, and the place after it.

    Raises:
        IndexError: it does not end.
    """
    value = 0
    for i in range(most):
        byte = content[at + i]
        value |= (byte & 127) << 7 * i
        if byte < 128:
            return value, at + i + 1
    raise IndexError


def _expanded(nodes: Mapping[Operator, Sequence[Operator]]) -> float:
    """Return the number of an ONNX file's nodes where functions are replaced by theirs.

    Infinite: a function calls itself.
    """
    sizes: dict[Operator, int] = {}
    entered: set[Operator] = set()
    todo: list[Operator] = [()]
    while todo:
        here = todo[-1]
        needed = {one for one in nodes[here] if one in nodes and one not in sizes}
        if here in sizes or not needed:
            if here not in sizes:
                sizes[here] = sum(sizes.get(one, 1) for one in nodes[here])
            todo.pop()
            entered.discard(here)
            continue
        entered.add(here)
        if needed & entered:
            return math.inf
        todo += needed
    return sizes[()]


# Sessions ---------------------------------------------------------------------------------------


def open_session(content: bytes, who: str, *, trial: bool = False) -> Any:
    """Return a session of onnxruntime for an ONNX file.

    Args:
        trial: of a file that others may have made: a run may take ``LONGEST_TRIAL`` seconds and
            ``MOST_MEMORY`` bytes. The session is slower.

    Raises:
        PolicyError: onnxruntime cannot run it, or it has weights in other files.
    """
    import onnxruntime

    check_file_alone(content, who)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # small nets; and exact
    options.log_severity_level = 4 if trial else 3
    # Another format of onnxruntime's own is not checked above.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.add_session_config_entry(
        "optimization.constant_folding_max_output_size_in_bytes", str(FOLDED)
    )
    if trial:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        options.add_session_config_entry("session.use_env_allocators", "1")
        options.add_session_config_entry("session.use_device_allocator_for_initializers", "1")
        options.enable_mem_pattern = False  # its buffers would outlive a run
        _bound_memory()
    try:
        providers = ["CPUExecutionProvider"]
        session = onnxruntime.InferenceSession(content, options, providers=providers)
    except Exception as error:  # onnxruntime's own errors have no common class
        raise PolicyError(f"{who} cannot be run by onnxruntime: {str(error)[:300]}") from error
    return Trial(session) if trial else session


class Trial:
    """A session of onnxruntime whose runs are bounded in time and memory."""

    def __init__(self, session: Any) -> None:
        self._session = session
        self.get_inputs = session.get_inputs
        self.get_outputs = session.get_outputs

    def run(self, outputs: Any, feeds: Mapping[str, Array]) -> Any:
        """Return the outputs, as a session does.

        Raises:
            PolicyError: it takes too long, or too much memory.
        """
        import onnxruntime

        how = onnxruntime.RunOptions()
        how.log_severity_level = 4
        how.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
        found: list[Any] = []
        failed: list[Exception] = []

        def run() -> None:
            try:
                found.append(self._session.run(outputs, feeds, how))
            except Exception as error:
                failed.append(error)

        # In a thread, as some operators do not look whether they are to end.
        thread = threading.Thread(target=run, name="skillweave-trial", daemon=True)
        thread.start()
        thread.join(LONGEST_TRIAL)
        if thread.is_alive():
            how.terminate = True
            thread.join(1.0)
            raise PolicyError(f"it acts for more than {LONGEST_TRIAL:g} seconds")
        if failed:
            if "Available memory of" in str(failed[0]):
                raise PolicyError(f"it takes more than {MOST_MEMORY:,} bytes to act")
            raise failed[0]
        return found[0]


@cache
def _bound_memory() -> None:
    """Let trials of ONNX files allocate memory together, up to ``MOST_MEMORY``."""
    import onnxruntime

    kind = onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR
    memory = onnxruntime.OrtMemoryInfo("Cpu", kind, 0, onnxruntime.OrtMemType.DEFAULT)
    how = onnxruntime.OrtArenaCfg({"max_mem": MOST_MEMORY, "arena_extend_strategy": 1})
    with suppress(RuntimeError):  # the program has an own one, which serves as well
        onnxruntime.create_and_register_allocator(memory, how)
