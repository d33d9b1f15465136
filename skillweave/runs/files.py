"""Files that are whole or not there: temporary file, fsync, rename. No pickle (contract 7)."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
from torch import Tensor

from skillweave.types import SkillweaveError

SCHEMA = 1
"""Version of everything written here; readers refuse newer ones."""


def write_bytes(path: Path, data: bytes) -> None:
    """Replace ``path`` by ``data``, or leave it exactly as it was.

    Raises:
        SkillweaveError: the disk is full or cannot be written; what was there is intact.
    """
    temporary = ""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as error:
        if temporary:
            with suppress(OSError):
                os.unlink(temporary)
        if isinstance(error, OSError):
            raise SkillweaveError(
                f"could not write {path}: {error.strerror or error}. What was saved before "
                "is intact"
            ) from error
        raise


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Replace a JSON file; ``schema`` is added."""
    text = _json(path, {"schema": SCHEMA, **data}, indent=2)
    write_bytes(path, text.encode() + b"\n")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file written by ``write_json``.

    Raises:
        SkillweaveError: missing, damaged, or of a newer schema.
    """
    try:
        data = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise SkillweaveError(f"{path} does not exist") from error
    except (OSError, ValueError) as error:
        raise SkillweaveError(f"{path} is damaged: {error}") from error
    if not isinstance(data, dict):
        raise SkillweaveError(f"{path} is damaged: not a JSON object")
    check_schema(data, path)
    return data


def check_schema(data: Mapping[str, Any], where: Path | str) -> None:
    """Raise a SkillweaveError where ``data`` comes from a newer Skillweave."""
    found = data.get("schema")
    if not isinstance(found, int):
        raise SkillweaveError(f"{where} was not written by Skillweave: it has no schema number")
    if found > SCHEMA:
        raise SkillweaveError(
            f"{where} has schema {found}; this Skillweave reads up to {SCHEMA}. Upgrade skillweave"
        )


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Replace a safetensors file; ``header`` is JSON, a checksum covers both."""
    plain = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    whole = {"schema": SCHEMA, **header}
    whole["sha256"] = _digest(_json(path, whole, sort_keys=True), plain)
    # One key only: safetensors writes several in random order, and equal runs make equal files.
    metadata = {"skillweave": _json(path, whole, sort_keys=True)}
    write_bytes(path, safetensors.torch.save(plain, metadata))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and header written by ``write_tensors``.

    Raises:
        SkillweaveError: missing, truncated, altered, not Skillweave's, or of a newer schema.
    """
    try:
        with safetensors.safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
        text = metadata["skillweave"]
        header = json.loads(text)
    except FileNotFoundError as error:
        raise SkillweaveError(f"{path} does not exist") from error
    except KeyError as error:
        raise SkillweaveError(f"{path} was not written by Skillweave") from error
    except (OSError, ValueError, safetensors.SafetensorError) as error:
        raise SkillweaveError(f"{path} is damaged (truncated?): {error}") from error
    if not isinstance(header, dict):
        raise SkillweaveError(f"{path} was not written by Skillweave: its header is no object")
    check_schema(header, path)
    if header.pop("sha256", None) != _digest(json.dumps(header, sort_keys=True), tensors):
        raise SkillweaveError(f"{path} is damaged: its contents do not match its checksum")
    # Copies: in the file tensors are aligned to 4 bytes only, and matrix products of such differ in
    # the last bit, so that a resumed run would drift.
    return {k: v.clone() for k, v in tensors.items()}, header


def _json(path: Path, data: Mapping[str, Any], **how: Any) -> str:
    try:
        return json.dumps(data, allow_nan=False, **how)
    except (TypeError, ValueError) as error:
        raise SkillweaveError(f"could not write {path}: {error}") from error


def _digest(text: str, tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        digest.update(f"{name}{tensors[name].dtype}{tuple(tensors[name].shape)}".encode())
        digest.update(tensors[name].numpy().tobytes())
    return digest.hexdigest()
