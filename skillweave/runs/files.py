"""Files that are complete or absent (temporary file, fsync, rename), and never links.

No pickle.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from skillweave.errors import RunError
from skillweave.policies.untrusted import check_file, parse_json, read_file, shown
from skillweave.schema import as_json, fit

SCHEMA = 1
"""Version of all files; readers refuse newer ones."""
TEMPORARY = ".*.tmp"
"""Names of files while they are written; only a killed process leaves some behind."""
_BINARY = getattr(os, "O_BINARY", 0)  # of Windows
LARGEST_JSON = 16 * 2**20
"""The most bytes of a JSON file, or of a line of one."""
LARGEST_WEIGHTS = 2**31
"""The most bytes of a file with a policy; checkpoints also hold replay buffers, of any size."""


def write_bytes(
    path: Path, data: bytes, *, make_directories: bool = True, durable: bool = True
) -> None:
    """Replace ``path`` by ``data``, or leave it unchanged.

    Args:
        make_directories: make those above it, where they are missing.
        durable: wait until it is on the disk.

    Raises:
        RunError: the disk is full or cannot be written; the old file is intact.
    """
    temporary = ""
    try:
        if make_directories:
            path.parent.mkdir(parents=True, exist_ok=True)
        temporary = str(path.parent / f".{path.name}.{secrets.token_hex(4)}.tmp")
        # The umask applies to this mode.
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _BINARY, 0o666)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
        if durable:
            _sync(path.parent)
    except BaseException as error:
        if temporary:
            with suppress(OSError):
                os.unlink(temporary)
        if isinstance(error, OSError):
            raise _unwritten(path, error) from error
        raise


@contextmanager
def written(path: Path) -> Iterator[None]:
    """Turn an OSError while the block writes a file into a RunError that names ``path``."""
    try:
        yield
    except OSError as error:
        raise RunError(f"could not write {path}: {error.strerror or error}") from error


def move(source: Path, target: Path) -> None:
    """Rename a file of a run, in place of a file with that name.

    Raises:
        RunError: the disk is full or cannot be written; both files are unchanged.
    """
    try:
        os.replace(source, target)
        _sync(target.parent)
    except OSError as error:
        raise _unwritten(target, error) from error


def check_utf8(path: Path) -> None:
    """Raise a RunError where a path is no UTF-8, because safetensors opens no such file."""
    try:
        os.fsencode(path).decode("utf-8")
    except UnicodeError:
        raise RunError(
            f"{str(path)!a} is not UTF-8, and files of weights cannot be read from such a path: "
            "choose another folder, or rename it"
        ) from None


def make_directory(path: Path) -> None:
    """Make a directory of a run in an existing one.

    Raises:
        RunError: it cannot be made.
    """
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise RunError(f"could not make {path}: {error.strerror}") from error


def remove(path: Path) -> None:
    """Delete a file of a run, if it exists.

    Raises:
        RunError: it cannot be deleted.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise RunError(f"could not delete {path}: {error.strerror or error}") from error


def _unwritten(path: Path, error: OSError) -> RunError:
    """Return the RunError for a file of a run that could not be written."""
    if isinstance(error, FileNotFoundError):
        return RunError(
            f"could not write {path}: its directory no longer exists; was it deleted or moved?"
        )
    return RunError(f"could not write {path}: {error.strerror or error}. Earlier files are intact")


def _sync(directory: Path) -> None:
    """Write the new name of a run's file to the disk, before older files are deleted."""
    with suppress(OSError):  # not every system supports this
        handle = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def write_json(path: Path, data: Any) -> None:
    """Replace a JSON file by a dataclass or a dict; add ``schema`` and a checksum."""
    write_bytes(path, json_bytes(path, data), make_directories=False)


def json_bytes(path: Path, data: Any) -> bytes:
    """Return the bytes that ``write_json`` writes."""
    plain = _without_surrogates(json.loads(_json(path, {"schema": SCHEMA, **as_json(data)})))
    text = _json(path, plain | {"sha256": _digest(path, plain)}, indent=2)
    return text.encode() + b"\n"


def _without_surrogates(data: Any) -> Any:
    """Return a file's JSON whose texts have no surrogates, which UTF-8 cannot hold.

    In a locale without all characters, Python represents some in file names as surrogates.
    """
    if isinstance(data, str):
        return data if data.isascii() else _text_without_surrogates(data)
    if isinstance(data, dict):
        return {_without_surrogates(k): _without_surrogates(v) for k, v in data.items()}
    return [_without_surrogates(x) for x in data] if isinstance(data, list) else data


def _text_without_surrogates(text: str) -> str:
    try:
        return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:
        return text.encode("utf-8", "backslashreplace").decode()


def read_json(path: Path, convert: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """Return the content of a JSON file written by ``write_json``.

    Args:
        convert: makes what is returned from the content. It comes before the checksum is
            compared, for a more specific error; None: a dict is returned, without checksum.

    Raises:
        RunError: missing, damaged, altered, no plain file, or of a newer schema.
    """
    data = parse_json(read_file(path, LARGEST_JSON), path)
    if not isinstance(data, dict):
        raise RunError(f"{path} is damaged: not a JSON object")
    check_schema(data, path)
    found = data if convert is None else convert(data)
    if data.pop("sha256", None) != _digest(path, data):
        raise RunError(
            f"{path} is damaged: its contents do not match its checksum (edited by hand?)"
        )
    return found


def check_schema(data: Mapping[str, Any], where: Path | str) -> None:
    """Raise a RunError where ``data`` comes from a newer Skillweave."""
    schema = data.get("schema")
    if type(schema) is not int:
        raise RunError(f"{where} was not written by Skillweave: it has no schema number")
    if schema > SCHEMA:
        raise RunError(
            f"{where} has schema {shown(schema)}; this Skillweave reads up to {SCHEMA}. Upgrade "
            "skillweave"
        )


def write_tensors(
    path: Path,
    tensors: Mapping[str, Tensor],
    header: Any,
    *,
    make_directories: bool = True,
) -> str:
    """Replace a safetensors file; return the checksum of tensors and header.

    Args:
        header: a dataclass, or a dict.
        make_directories: make those above it, where they are missing.

    Raises:
        RunError: it cannot be written, or not be read from there again.
    """
    check_utf8(path)
    plain = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    whole = {"schema": SCHEMA, **as_json(header)}
    whole["sha256"] = _digest(path, whole, plain)
    # Only one key: safetensors writes several in random order, and equal runs need equal files.
    metadata = {"skillweave": _json(path, whole, sort_keys=True)}
    content = safetensors.torch.save(plain, metadata)
    write_bytes(path, content, make_directories=make_directories)
    return str(whole["sha256"])


def record_in(kind: Any, header: Mapping[str, Any], path: Path | str) -> Any:
    """Return a file's content or header as a dataclass; a RunError names the wrong field."""
    return fit(kind, {k: v for k, v in header.items() if k not in ("schema", "sha256")}, str(path))


def read_tensors(
    path: Path, most: int | None = LARGEST_WEIGHTS
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return tensors and header, with its checksum ``sha256``, written by ``write_tensors``.

    Args:
        most: the most bytes of the file, which are all read; None: any number.

    Raises:
        RunError: missing, truncated, altered, no plain file, too large, not Skillweave's, or of a
            newer schema.
    """
    check_file(path, most)
    header, tensors = _open(path, with_tensors=True)
    if header.get("sha256") != _digest(path, header, tensors):
        raise RunError(f"{path} is damaged: its contents do not match its checksum")
    # Copies: in the file, tensors are aligned to 4 bytes only, and their matrix products differ in
    # the last bit, so a resumed run would drift.
    return {k: v.clone() for k, v in tensors.items()}, header


def check_unchanged(path: Path, header: Mapping[str, Any], recorded: str | None) -> None:
    """Raise a RunError where a file's checksum differs from the one that the run recorded."""
    if header["sha256"] != recorded:
        raise RunError(
            f"{path} is not the file that the run wrote there: its checksum differs. Restore the "
            "file, or train again"
        )


def read_header(path: Path) -> dict[str, Any]:
    """Return the header of a safetensors file alone, quickly: no checksum is compared.

    Raises:
        RunError: as ``read_tensors``.
    """
    return _open(path, with_tensors=False)[0]


def _open(path: Path, with_tensors: bool) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the header and the tensors of a safetensors file of a run."""
    check_utf8(path)
    check_file(path)
    try:
        # Before 0.5, safetensors creates tensors on the default device, which the user may change.
        with (
            torch.device("cpu"),
            safetensors.safe_open(str(path), framework="pt") as file,
        ):
            metadata = file.metadata() or {}
            names = file.keys() if with_tensors else ()
            tensors = {k: file.get_tensor(k) for k in names}
    except (
        OSError,
        ValueError,
        TypeError,
        AttributeError,
        RuntimeError,
        safetensors.SafetensorError,
    ) as error:
        raise RunError(f"{path} is damaged (truncated?): {str(error)[:300]}") from error
    if "skillweave" not in metadata:
        raise RunError(f"{path} was not written by Skillweave")
    header = parse_json(metadata["skillweave"], path)
    if not isinstance(header, dict):
        raise RunError(f"{path} was not written by Skillweave: its header is no object")
    check_schema(header, path)
    return header, tensors


def _json(path: Path, data: Mapping[str, Any], **options: Any) -> str:
    try:
        return json.dumps(data, allow_nan=False, **options)
    except (TypeError, ValueError, RecursionError) as error:
        raise RunError(f"could not write {path}: {error}") from error


def _digest(
    path: Path, content: Mapping[str, Any], tensors: Mapping[str, Tensor] = MappingProxyType({})
) -> str:
    """Return the checksum of a run's file with this content and these tensors."""
    plain = {k: v for k, v in content.items() if k != "sha256"}
    digest = hashlib.sha256(_json(path, plain, sort_keys=True).encode())
    for name in sorted(tensors):
        digest.update(f"{name}{tensors[name].dtype}{tuple(tensors[name].shape)}".encode())
        flat = tensors[name].reshape(-1)
        if len(flat) < 2:  # it may have the stride 0, which cannot be viewed as bytes
            flat = flat.clone(memory_format=torch.contiguous_format)
        # As bytes, because NumPy lacks some types of PyTorch.
        digest.update(flat.view(torch.uint8).numpy().data)
    return digest.hexdigest()


ABOVE = 2
"""Folders above a file that may be its run: ``<run>/policies/<file>``."""
TRACKERS = ("wandb",)
"""Folders of trackers that make links to other files of the same folder."""
OF_TRACKERS = "wandb/*/logs/debug-core.log"
"""A link that W&B makes to its own log outside, and through which nothing is written later."""


def check_no_links(run: Path) -> None:
    """Raise a RunError where a run holds a link, a pipe or a device.

    Args:
        run: its directory, which may be reached through a link.
    """
    for path in _entries(run):
        if path.is_symlink():
            if not _stays_in_tracker(run, path):
                raise RunError(
                    f"{path} is a link to {path.readlink()}, and nothing is written into a run "
                    "with links, because that would change files outside of it. Put a copy in its "
                    "place, or delete it"
                )
        elif not path.is_file() and not path.is_dir():
            raise RunError(
                f"{path} is a pipe or a device, and nothing is written into a run with such "
                "files. Delete it"
            )


def check_no_links_around(folder: Path) -> None:
    """Raise a RunError where a folder is in a run that holds a link, or is one."""
    folder = folder.absolute()
    for place in (folder, *folder.parents[:ABOVE]):
        if os.path.lexists(place / "run.json"):
            check_no_links(place)
            return


def own_copy(path: Path) -> None:
    """Replace a file with further names (hard links) by a separate copy.

    ``cp -al`` makes such copies of a run. A line appended to one would appear in all.
    """
    with suppress(FileNotFoundError):
        if os.stat(path).st_nlink > 1:
            write_bytes(path, path.read_bytes(), make_directories=False)


def _entries(folder: Path) -> Iterator[Path]:
    """Yield all entries below a run's folder; links are not followed."""

    def fail(error: OSError) -> None:
        raise RunError(f"could not read {error.filename}: {error.strerror}") from error

    for place, folders, files in os.walk(folder, onerror=fail):
        yield from (Path(place, name) for name in sorted(folders + files))


def _stays_in_tracker(run: Path, link: Path) -> bool:
    """Return whether a link in a tracker's folder leads to something there, or is its log's."""
    folder = run / link.relative_to(run).parts[0]
    if folder.name not in TRACKERS or folder == link:
        return False
    if link.relative_to(run).match(OF_TRACKERS):
        return True
    return link.resolve().is_relative_to(folder.resolve())
