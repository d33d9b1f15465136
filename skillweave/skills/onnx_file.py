"""ONNX files as policies."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np
from gymnasium import Space

from skillweave.arguments import checked_names
from skillweave.errors import MissingExtra, PolicyError, RunError
from skillweave.messages import shortened
from skillweave.reading import check_file
from skillweave.skills.foreign_policy import Foreign, checksum
from skillweave.skills.outputs import decoded
from skillweave.types import Array, Memory

NUMBERS = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(float16)": np.float16,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(uint8)": np.uint8,
}
"""Supported types of an input, by ONNX's names."""


class OnnxPolicy(Foreign):
    """A model in ONNX's format, run by onnxruntime on the CPU."""

    kind = "onnx"
    suffix = ".onnx"

    def __init__(
        self,
        data: bytes,
        file: Path,
        output: str | None = None,
        observation_space: Any = None,
        action_space: Any = None,
    ) -> None:
        super().__init__(str(file), observation_space, action_space)
        self.data, self.file = data, file
        self._session = _session(data, file)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or not inputs[0].shape or inputs[0].type not in NUMBERS:
            found = shortened(", ".join(f"{i.name} {i.type}{i.shape}" for i in inputs))
            raise PolicyError(
                f"{file} takes {found or 'nothing'}; it must take one batch of observations"
            )
        names = [o.name for o in outputs]
        if output is not None and output not in names:
            has = shortened(", ".join(names))
            raise PolicyError(f"{file} has no output {output!r}; it has: {has}")
        self._input, self.output = inputs[0], output or names[0]
        batch = self._input.shape[0]
        if isinstance(batch, int) and batch != 1:
            raise PolicyError(
                f"{file} takes exactly {batch} observations at once; export it with a dynamic batch"
            )

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in vars(self).items() if k not in ("_session", "_input")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._session = _session(self.data, self.file)
        self._input = self._session.get_inputs()[0]

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy for these spaces.

        Raises:
            PolicyError: its input has another shape; the message names both.
        """
        bound = super().bind(observation_space, action_space, who)
        mine, theirs = self._input.shape[1:], bound.observation_space.shape or ()
        fits = len(mine) == len(theirs) and all(
            a == b for a, b in zip(mine, theirs, strict=True) if isinstance(a, int)
        )
        if not fits:
            shape = f"({', '.join(map(str, mine))})"
            raise PolicyError(
                f"{bound._who} takes observations of shape {shape}, but the environment has "
                f"{observation_space}"
            )
        return bound

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return the model's actions; logits are sampled with ``rng`` if not ``deterministic``."""
        self.must_be_bound()
        rows = np.ascontiguousarray(obs, NUMBERS[self._input.type])
        if self._input.shape[0] == 1 and len(rows) != 1:
            output = np.concatenate([self._run(row[None]) for row in rows])
        else:
            output = self._run(rows)
        action = decoded(
            output,
            len(obs),
            self.action_space,
            self._who,
            mask=mask,
            deterministic=deterministic,
            rng=rng,
        )
        return action, memory

    def _run(self, rows: Array) -> Array:
        return np.asarray(self._session.run([self.output], {self._input.name: rows})[0])

    def source(self) -> dict[str, Any]:
        """Return the file, and the checksum of the copy that the run keeps."""
        return {"kind": self.kind, "file": str(self.file), "sha256": checksum(self.data)}

    def content(self) -> bytes:
        """Return the whole model."""
        return self.data

    def restored(self, content: bytes) -> Self:
        """Return a policy with the same spaces and this model."""
        spaces = self.observation_space, self.action_space
        policy = type(self)(content, self.file, self.output, *spaces)
        policy._who = self._who
        return policy


@checked_names
def from_onnx(
    path: str | Path,
    *,
    output: str | None = None,
    observation_space: Any = None,
    action_space: Any = None,
) -> OnnxPolicy:
    """Return an ONNX file as a skill's policy; the run keeps a copy of it.

    It takes a batch of observations, of any size or of one. Whole numbers that it returns are
    actions; other numbers are logits for Discrete and MultiDiscrete, actions for Box.

    Args:
        path: the file; weights in a second file beside it are read, too.
        output: the name of the output to use; None: the first.
        observation_space: None: the environment's.
        action_space: None: the environment's.

    Returns:
        The policy, for a skill's ``policy`` or ``evaluate``.

    Raises:
        RunError: the file does not exist.
        PolicyError: it is not a model of one batch of observations.
        MissingExtra: the extra 'onnx' is not installed.
    """
    try:
        import onnx
    except ImportError as error:
        raise MissingExtra("an ONNX file", "onnx") from error
    check_file(Path(path))
    try:
        model = onnx.load(str(path))
    except OSError as error:
        raise RunError(f"could not read {path}: {error.strerror or error}") from error
    except Exception as error:  # protobuf's own errors have no common class
        raise PolicyError(f"{path} is no ONNX model: {str(error)[:300]}") from error
    for tensor in model.graph.initializer:
        if np.isnan(_numbers(tensor, path)).any():
            raise PolicyError(f"{path}: its weights {tensor.name[:60]!r} hold NaN")
    return OnnxPolicy(
        model.SerializeToString(deterministic=True),
        Path(path),
        output,
        observation_space,
        action_space,
    )


def _numbers(tensor: Any, path: str | Path) -> Array:
    """Return a weight as an array; empty if it does not hold real numbers."""
    from onnx import numpy_helper

    try:
        array = numpy_helper.to_array(tensor)
    except Exception as error:
        raise PolicyError(
            f"{path}: its weights {tensor.name[:60]!r} are damaged: {str(error)[:300]}"
        ) from error
    return array if np.issubdtype(array.dtype, np.floating) else np.zeros(0)


def _session(data: bytes, file: Path) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise MissingExtra("an ONNX file", "onnx") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # small nets; and exact
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own errors have no common class
        reason = shortened(str(error))
        raise PolicyError(f"{file} cannot be run by onnxruntime: {reason}") from error
