"""Policies as JSON: one tree of their fields, with files and arrays beside it, functions by name.

Nothing but data is read: types that are listed, with fields that are checked, files with recorded
checksums. Functions are given by who reads.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from . import actor, hierarchy, leaves, mapped, parts, plan, planned, selectors, spaces, timed
from .acting_errors import PolicyError, RunError
from .actor import Deployed
from .archives import numbers_in, unzipped
from .budget import BUDGET, cost
from .core import Array
from .untrusted import checksum, parse_json, read_file, shown, shown_text

FORMAT = 3
"""Version of ``policy.json``."""
MANIFEST = "policy.json"
"""The name of the file that describes a policy."""
ARRAYS = "arrays.npz"
"""The name of the file with its large arrays."""
SMALL = 64
"""The most numbers of an array that stands in the JSON."""
LARGEST = 16 * 2**20
"""The most bytes of ``policy.json``: its large arrays are in a file of their own."""
MOST_FILES = 2**31
"""The most bytes of all files beside it."""
MOST_ARRAYS = 2**30
"""The most bytes of all arrays, once they are unpacked."""
LONGEST_NAME = 200
"""The most characters of a file's name."""
LONGEST_ERROR = 1_000
"""The most characters of a message about a field: names and spaces in it are from the file."""
LONGEST_TEXT = 4096
"""The most characters of a name."""
MOST_SHOWN = 20
"""The most functions of the field ``code`` that a message lists."""
ROOMS = (actor, hierarchy, leaves, mapped, parts, plan, planned, selectors, spaces, timed)

OTHERS = (parts.Given, parts.Viewed, plan.Near, selectors.Rule)
"""Types in these files that are never written."""


@cache
def kinds() -> dict[str, type[Any]]:
    """Return the types of policies and their parts that ``policy.json`` may name."""
    found = (x for room in ROOMS for x in vars(room).values() if isinstance(x, type))
    here = {room.__name__ for room in ROOMS}
    return {
        kind.__name__: kind
        for kind in found
        if "__dataclass_fields__" in vars(kind) and kind.__module__ in here and kind not in OTHERS
    }


# Writing ----------------------------------------------------------------------------------------


@dataclass
class Written:
    """The writer of a policy's tree as JSON, with the files and arrays that lie beside it."""

    files: dict[str, bytes] = field(default_factory=dict)
    arrays: dict[str, Array] = field(default_factory=dict)
    code: dict[str, str] = field(default_factory=dict)
    """By name, a description of each function that a reader needs."""
    functions: dict[str, Callable[..., Any]] = field(default_factory=dict)
    small: int = SMALL
    """The most numbers of an array in the tree."""

    def tree(self, value: Any, path: str = "", own: Field[Any] | None = None) -> Any:
        """Return a value of a policy's tree as JSON.

        Args:
            path: of the skill that it belongs to: ``landing``, or ``outer/landing``.
            own: the field that it is the value of.

        Raises:
            PolicyError: it has no form; the message names its place.
        """
        match value:
            case np.generic():  # first: some of these are floats, too
                return self.tree(np.asarray(value), path, own)
            case None | bool() | int() | str():
                return value
            case float():
                return value if math.isfinite(value) else {"float": repr(value)}
            case bytes():
                name = f"{path.replace('/', '.') or 'agent'}.onnx"
                return {"file": _free(self.files, name, value)}
            case np.ndarray():
                return self._array(value, path, own)
            case tuple() | list():
                return [self.tree(x, path, own) for x in value]
            case dict():
                return {name: self.tree(x, path, own) for name, x in value.items()}
        kind = type(value)
        if kinds().get(kind.__name__) is kind:
            return self._object(value, path)
        if callable(value) and own is not None:
            return {"code": self._function(value, path, own)}
        raise PolicyError(f"{path or 'the policy'} has {kind.__name__}, which cannot be written")

    def _object(self, value: Any, path: str) -> dict[str, Any]:
        """Return a policy, or a part of one, as JSON: its type, and fields without defaults."""
        entry: dict[str, Any] = {"type": type(value).__name__}
        if isinstance(value, hierarchy.CalledSkill | parts.Override):
            name = value.name
            path = f"{path}/{name}" if path else name
        made: Any = type(value)
        for one, _ in written_fields(made).values():
            own = getattr(value, one.name)
            unset = one.default if one.default is not MISSING else None
            if own is unset or (isinstance(unset, bool | int | float | str) and own == unset):
                continue
            entry[one.name] = self.tree(own, _below(path, one.name), one)
        return entry

    def _array(self, value: Array, path: str, own: Field[Any] | None) -> dict[str, Any]:
        if value.size > self.small or value.dtype.names is not None:
            name = f"{path}.{own.name}" if own is not None else path
            return {"stored": _free(self.arrays, name, value)}
        return {"array": self.tree(value.tolist(), path), "dtype": str(value.dtype)}

    def _function(self, value: Any, path: str, own: Field[Any]) -> str:
        """Return the name under which ``policy.json`` lists a user's function."""
        bare = getattr(value, "bare", value)
        label = own.metadata.get("label") or getattr(bare, "__name__", type(bare).__name__)
        alone = path.rpartition("/")[2] == label  # of a selector that is a function
        wanted = path if alone else f"{path}.{label}".removeprefix(".")
        name = _free(self.functions, wanted, bare)
        self.code[name] = own.metadata.get("what", "observations (n, ...) to numbers (n, ...)")
        return name

    def content(self) -> dict[str, bytes]:
        """Return the files that lie beside ``policy.json``, with one of the arrays."""
        if not self.arrays:
            return self.files
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **self.arrays)  # type: ignore[arg-type]
        return self.files | {ARRAYS: buffer.getvalue()}


def _free(table: dict[str, Any], wanted: str, value: Any) -> str:
    """Return the name of a value beside ``policy.json``; a second value of it gets a number."""
    stem, dot, suffix = wanted.rpartition(".") if wanted.endswith(".onnx") else (wanted, "", "")
    tried = (wanted if i == 1 else f"{stem}#{i}{dot}{suffix}" for i in range(1, 10_000))
    name = next(n for n in tried if table.get(n, value) is value)
    table[name] = value
    return name


NAMED = ("selector", "guide", "critic", "base")
"""Fields whose names are added to the path: of files and functions below them."""


def _below(path: str, name: str) -> str:
    if name not in NAMED:
        return path
    return f"{path}.{name}" if name == "base" else f"{path}/{name}".removeprefix("/")


@cache
def written_fields(kind: Any) -> dict[str, tuple[Field[Any], Any]]:
    """Return the fields of a type that ``policy.json`` has, and their kinds, by name."""
    hints = get_type_hints(kind)
    return {
        one.name: (one, one.metadata.get("kind", hints[one.name]))
        for one in fields(kind)
        if one.metadata.get("written", True)
    }


# Reading ----------------------------------------------------------------------------------------


@dataclass
class Reader:
    """The reader of a policy's tree from ``policy.json``, with the content beside it."""

    code: Mapping[str, Callable[..., Any]]
    files: Mapping[str, bytes]
    arrays: Mapping[str, Array]
    small: int = SMALL
    left: int = BUDGET
    """The bytes that further objects may take."""

    def read(self, kind: Any, entry: Any, where: str) -> Any:
        """Return the value of an entry of ``policy.json``, which must be of a kind.

        Raises:
            PolicyError: it is not; the message names the place ``where``.
        """
        options = _options(kind)
        fitting = [option for option in options if _fits(*option, entry)]
        if len(fitting) != 1:
            raise _unfit(where, entry, " or ".join(_wanted(*option) for option in options))
        kind, origin, inner = fitting[0]
        if kind is float:
            return float(entry["float"]) if isinstance(entry, dict) else float(entry)
        if kind is str or origin is dict:
            for text in (entry,) if kind is str else entry:
                if len(text) > LONGEST_TEXT:
                    raise _unfit(where, text, f"a text of at most {LONGEST_TEXT:,} characters")
        if kind is int or kind in PLAIN or origin is Literal:
            return entry
        if kind is bytes:
            return self._beside(self.files, entry["file"], where, "files")
        if kind == Array:
            return self._array(entry, where)
        if origin is Callable:
            return self._beside(self.code, entry["code"], where, "code")
        if origin is tuple:
            some = inner[:1] * len(entry) if inner[1:] == (...,) else inner
            if len(some) != len(entry):
                raise _unfit(where, entry, f"a list of {len(some)}")
            pairs = enumerate(zip(some, entry, strict=True))
            return tuple(self.read(k, x, f"{where}[{i}]") for i, (k, x) in pairs)
        if origin is dict:
            return {k: self.read(inner[1], x, f"{where}[{shown(k)}]") for k, x in entry.items()}
        return self._object(entry, where)

    def _object(self, entry: dict[str, Any], where: str) -> Any:
        """Return a policy, or a part of one, from its JSON; check every field."""
        made: Any = kinds()[entry["type"]]
        own = written_fields(made)
        values = dict[str, Any]()
        if wrong := [name for name in entry if name not in own and name != "type"]:
            near = get_close_matches(str(wrong[0])[:60], own, 1)
            hint = f": is {near[0]!r} meant?" if near else f"; there are: {', '.join(own)}"
            raise PolicyError(f"{where}.{shown(wrong[0])} is unknown{hint}")
        if "who" in made.__dataclass_fields__ and "who" not in own:
            values["who"] = where
        for name, (one, kind) in own.items():
            if name in entry:
                values[name] = self.read(kind, entry[name], f"{where}.{name}")
            elif one.default is MISSING and one.default_factory is MISSING:
                raise PolicyError(f"{where} has no field {name!r}")
        self.left -= cost(made, values)
        if self.left < 0:
            raise PolicyError(f"{where}: acting would take more than {BUDGET:,} bytes in all")
        try:
            return made(**values)
        except PolicyError as error:
            raise PolicyError(f"{where}: {error}") from error

    def _array(self, entry: dict[str, Any], where: str) -> Array:
        """Return an array of a policy from its JSON, or from the file of arrays."""
        if "stored" in entry:
            found: Array = self._beside(self.arrays, entry["stored"], where, ARRAYS)
            return found
        name = entry.get("dtype")
        if not isinstance(name, str) or not spaces.DTYPE.fullmatch(name):
            raise PolicyError(f"{where} is no array: its dtype is {shown(name)}")
        try:
            dtype = np.dtype(name)
            kind = float if dtype.kind == "f" else bool if dtype.kind == "b" else int
            numbers = self._numbers(kind, entry["array"], f"{where}.array")
            # Before NumPy 2, an array of a smaller type wraps numbers that it cannot hold.
            wide = np.int64 if kind is int and dtype != np.uint64 else dtype
            with np.errstate(over="raise"):
                found = np.array(numbers, wide).astype(dtype)
            if kind is int and found.tolist() != numbers:
                raise OverflowError(f"not all of its numbers are of {dtype}")
        except (KeyError, TypeError, ValueError, ArithmeticError) as error:
            raise PolicyError(f"{where} is no array: {str(error)[:200]}") from error
        if found.size > self.small:
            raise PolicyError(f"{where} is no array of at most {self.small} numbers")
        return found

    def _numbers(self, kind: type[Any], entry: Any, where: str) -> Any:
        """Return the numbers of an array in ``policy.json``, nested as lists."""
        if isinstance(entry, list):
            return [self._numbers(kind, x, where) for x in entry]
        if kind is int and type(entry) is int:  # the array's type bounds it
            return entry
        return self.read(kind, entry, where)

    def _beside(self, table: Mapping[str, Any], name: str, where: str, what: str) -> Any:
        if name not in table:
            raise PolicyError(f"{where} is {shown(name)}, which {what} does not list")
        return table[name]


@cache
def _options(kind: Any) -> tuple[tuple[Any, Any, tuple[Any, ...]], ...]:
    """Return the kinds of a union, or the only one; each with its origin and what is inside."""
    options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    return tuple((option, get_origin(option), get_args(option)) for option in options)


@cache
def _types(kind: Any) -> dict[str, type[Any]]:
    """Return the types that may be written for a kind, by name."""
    return {name: one for name, one in kinds().items() if issubclass(one, kind)}


def _fits(kind: Any, origin: Any, inner: tuple[Any, ...], entry: Any) -> bool:
    """Return whether an entry of ``policy.json`` has the form of a kind."""
    if kind in PLAIN:
        return type(entry) is kind
    whole = type(entry) is int and abs(entry) < 2**63
    if kind is int:
        return whole
    if origin is tuple:
        return isinstance(entry, list)
    if origin is Literal:
        return isinstance(entry, str | int) and entry in inner
    given = entry if isinstance(entry, dict) else {}
    if kind is float:
        return whole or type(entry) is float or given.get("float") in ("inf", "-inf")
    if kind == Array:
        return isinstance(given.get("stored"), str) or "array" in given
    if kind is bytes or origin is Callable:
        name = "file" if kind is bytes else "code"
        return set(given) == {name} and isinstance(given[name], str)
    if origin is dict:
        return isinstance(entry, dict) and "type" not in entry
    typed = given.get("type")
    return isinstance(typed, str) and typed in _types(kind)


def _wanted(kind: Any, origin: Any, inner: tuple[Any, ...]) -> str:
    """Return a description of a kind's form in ``policy.json``, for messages."""
    plain: dict[Any, str] = {**PLAIN, int: "a whole number", float: "a number"}
    if kind in plain:
        return plain[kind]
    if origin is Literal:
        return f"one of {', '.join(map(repr, inner))}"
    if origin is tuple:
        return "a list"
    if kind == Array:
        return "an array"
    if kind is bytes or origin is Callable:
        return f'{{"{"file" if kind is bytes else "code"}": its name}}'
    if origin is dict:
        return "an object"
    return f'an object whose field "type" is one of {", ".join(_types(kind))}'


PLAIN = {bool: "true or false", str: "a text", NoneType: "null"}
"""Kinds whose values are in JSON what they are in Python, described for messages."""


def _unfit(where: str, entry: Any, wanted: str) -> PolicyError:
    text = shown(entry.get("type", entry) if isinstance(entry, dict) else entry)
    return PolicyError(f"{where} is {text}; it must be {wanted}")


# Folders ----------------------------------------------------------------------------------------


def read_folder(
    path: Any,
    code: Mapping[str, Callable[..., Any]] | None = None,
    archive: bytes | None = None,
) -> tuple[Deployed, dict[str, Any], bytes]:
    """Return the policy in a folder, the content of its ``policy.json``, and an archive of both.

    Args:
        code: the functions that its field ``code`` lists.
        archive: is read in place of the folder.

    Raises:
        RunError: a file is missing or damaged; the message names it and the field.
        PolicyError: it needs a function that was not given.
    """
    folder = Path(path)
    code = dict(code or {})
    file = folder / MANIFEST
    opened = _Folder(folder, archive)
    content = parse_json(opened.read(MANIFEST, LARGEST), file)
    version = content.get("format") if isinstance(content, dict) else None
    if version != FORMAT:
        raise RunError(
            f"{file} has format {shown(version)}, but this version reads {FORMAT}: export the "
            "policy again"
        )
    for name, kind in FIELDS.items():
        if name not in content:
            raise RunError(f"{file} is damaged: no field {name!r}")
        if not isinstance(content[name], kind):
            raise RunError(f"{file}: {name} is {shown(content[name])}; it must be {kind.__name__}")
    for name in ("files", "code"):
        for key, text in content[name].items():
            if not isinstance(text, str):
                raise RunError(f"{file}: {name}[{shown(key)}] is {shown(text)}; it must be str")
    _check_code(folder, content["code"], code)
    files = {name: _content(folder, name, x, opened) for name, x in content["files"].items()}
    try:
        arrays = _arrays(files.pop(ARRAYS, b""))
        reader = Reader({name: code[name] for name in content["code"]}, files, arrays)
        found: Deployed = reader.read(Deployed, content["policy"], "policy")
        found.policy.check(found.sees, found.acts, None, "policy")
        if found.policy.holds and not isinstance(found.policy, mapped.Mapped):
            raise PolicyError("policy holds the last action, but nothing remembers it (Remembers)")
    except PolicyError as error:
        raise RunError(f"{file}: {str(error)[:LONGEST_ERROR]}") from error
    return found, content, archive or _archived(opened.content)


FIELDS = {"env": str, "license": str, "origin": str, "files": dict, "code": dict, "policy": dict}
"""The fields of ``policy.json`` beside its format, and their types."""


class _Folder:
    """The files of an exported policy's folder, or of an archive of one."""

    def __init__(self, folder: Path, archive: bytes | None) -> None:
        self.folder = folder
        self.content: dict[str, bytes] = {}
        self._left = MOST_FILES
        self._archive: dict[str, bytes] | None = None
        if archive is not None:
            try:
                self._archive = dict(unzipped(archive, len(archive)))  # which is not compressed
            except PolicyError as error:
                raise RunError(f"the copy of {folder} is damaged: {error}") from error

    def read(self, name: str, most: int = MOST_FILES) -> bytes:
        """Return a file of an exported policy's folder.

        Raises:
            RunError: it is missing or too large, or all files together are.
        """
        path = self.folder / name
        if self._archive is None:
            found = read_file(path, min(most, self._left))
        elif name in self._archive:
            found = self._archive[name]
        else:
            raise RunError(f"the copy of {self.folder} is damaged: it has no file {shown(name)}")
        self._left -= len(found)
        self.content[name] = found
        return found


def _check_code(folder: Path, listed: Mapping[str, str], given: Mapping[str, Any]) -> None:
    """Raise a PolicyError that names a policy's functions which were not given."""
    missing = [name for name in listed if name not in given]
    if missing:
        wanted = [f"{shown(x, 100)}: {shown_text(listed[x], 200)}" for x in missing[:MOST_SHOWN]]
        if more := len(missing) - len(wanted):
            wanted.append(f"and {more:,} more")
        raise PolicyError(
            f"{folder} needs Python code, code={{name: function}}, for {'; '.join(wanted)}"
        )


def _content(folder: Path, name: str, recorded: str, opened: _Folder) -> bytes:
    """Return a file of an exported policy's folder, compared with its checksum."""
    plain = not set(name) & set("/\\\0") and not name.startswith(".")
    if not plain or not name.endswith((".onnx", ARRAYS)) or len(name) > LONGEST_NAME:
        raise RunError(f"{folder / MANIFEST}: files has {shown(name)}, no file of the folder")
    content = opened.read(name)
    if checksum(content) != recorded:
        raise RunError(
            f"{folder / name} has another checksum than {folder / MANIFEST} records in files: it "
            "is damaged, or another version. Get both from one source"
        )
    return content


def _archived(files: Mapping[str, bytes]) -> bytes:
    """Return the files of a policy as one zip, which has the same bytes each time."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in sorted(files):
            archive.writestr(zipfile.ZipInfo(name), files[name])
    return buffer.getvalue()


def _arrays(content: bytes) -> dict[str, Array]:
    """Return a policy's arrays in the file ``arrays.npz`` by name."""
    found: dict[str, Array] = {}
    try:
        for name, data in unzipped(content, MOST_ARRAYS) if content else ():
            found[name.removesuffix(".npy")] = numbers_in(data)
    except PolicyError as error:
        raise PolicyError(f"{ARRAYS} is damaged: {error}") from error
    return found
