"""Checkpoints of ``torch.save`` that are changed, and pickles that try to run code."""

from __future__ import annotations

import pickle
import pickletools
import random
import struct
import warnings
import zipfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

BOMB = 500
"""Megabytes of zeros, in a zip of 2 MB."""
MARK = "CODE_RAN"
"""The file that a pickle's commands would make."""
CALLS: tuple[tuple[str, str, tuple[Any, ...]], ...] = (
    ("os", "system", (f"touch {MARK}",)),
    ("posix", "system", (f"touch {MARK}",)),
    ("builtins", "eval", (f"open('{MARK}', 'w')",)),
    ("builtins", "exec", (f"open('{MARK}', 'w')",)),
    ("__builtin__", "eval", (f"open('{MARK}', 'w')",)),
    ("builtins", "open", (MARK, "w")),
    ("io", "open", (MARK, "w")),
    ("builtins", "__import__", ("evil",)),
    ("builtins", "getattr", (0, "__class__")),
    ("importlib", "import_module", ("evil",)),
    ("evil", "anything", ()),
    ("subprocess", "Popen", (["touch", MARK],)),
    ("subprocess", "check_output", (["touch", MARK],)),
    ("os", "mkdir", (MARK,)),
    ("shutil", "rmtree", ("/nowhere",)),
    ("runpy", "run_path", ("evil.py",)),
    ("pty", "spawn", ("sh",)),
    ("pickle", "loads", (b"cos\nsystem\n(S'touch CODE_RAN'\ntR.",)),
    ("torch", "load", (MARK,)),
    ("torch", "save", (0, MARK)),
    ("torch.serialization", "load", (MARK,)),
    ("torch.storage", "_load_from_bytes", (b"x",)),
    ("torch.hub", "load", ("x", "y")),
    ("torch.utils._config_module", "load_config", (b"x",)),
    ("numpy", "load", (MARK, None, True)),
    ("numpy", "save", (MARK, 0)),
    ("numpy", "fromfile", ("/etc/passwd",)),
    ("numpy.testing._private.utils", "runstring", (f"open('{MARK}','w')", {})),
    ("skillweave.runs.files", "write_bytes", (MARK, b"x")),
    ("skillweave.compat.pickles", "read_torch_pickle", (MARK,)),
    ("torch._utils", "_rebuild_tensor_v2.__globals__", ()),
    ("torch._utils", "_rebuild_tensor_v2.__class__", ()),
    ("collections", "OrderedDict.__subclasses__", ()),
    ("collections", "namedtuple", (f"x', open('{MARK}','w'), '", "a")),
    ("dill._dill", "_load_type", ("CodeType",)),
    ("dill._dill", "_create_function", (0, {})),
    ("dill._dill", "_import_module", ("evil",)),
    ("codecs", "decode", (b"x", "hex")),
    ("_codecs", "encode", ("x", "evil")),
    ("", "", ()),
    ("os", "", ()),
    ("é", "\u2028", ()),
)
"""Functions that a hostile pickle would call."""
ODD: tuple[tuple[str, str, tuple[Any, ...]], ...] = (
    ("torch._utils", "_rebuild_tensor_v2", ()),
    ("torch._utils", "_rebuild_tensor_v2", (0, 0, (2,), (1,), False, None)),
    ("torch._utils", "_rebuild_parameter", (7, True, None)),
    ("torch", "device", ("x" * 1000,)),
    ("torch", "device", (None, None, None)),
    ("torch.nn.modules.loss", "MSELoss", (1, 2, 3)),
    ("collections", "OrderedDict", (7,)),
    ("builtins", "set", ([[]],)),
    ("builtins", "set", (7,)),
    ("numpy", "dtype", ("O",)),
    ("numpy", "dtype", ("V999999999",)),
    ("numpy", "dtype", ("S2147483647",)),
    ("numpy", "dtype", ([("a", "O")],)),
    ("numpy", "dtype", (None, None)),
    ("numpy", "ndarray", ((10**9,),)),
    ("numpy.core.multiarray", "scalar", (7, b"x")),
    ("numpy.core.multiarray", "scalar", ()),
    ("numpy.core.multiarray", "_reconstruct", (7, 8, 9)),
    ("dill._dill", "_create_array", (0, (), ())),
    ("_codecs", "encode", ("x" * 10, 7)),
)
"""Functions that a checkpoint may name, with arguments that no checkpoint has."""


def change(rng: random.Random, path: Path, folder: Path) -> tuple[str, str, bool]:
    """Change a checkpoint, its pickle, or its zip; as a ``Way`` of ``mutations``."""
    way = rng.choice((_hostile, _hostile, _values, _values, _pickle_bytes, _zip))
    kind, details, asks = way(rng, path)
    return f"{way.__name__.strip('_')} {kind}", details, asks


def _entries(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def _write(path: Path, entries: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w") as file:
        for name, data in entries.items():
            file.writestr(name, data)


def _pickle_name(entries: dict[str, bytes]) -> str:
    return next(name for name in entries if name.endswith("/data.pkl"))


# Other values -----------------------------------------------------------------------------------


def _values(rng: random.Random, path: Path) -> tuple[str, str, bool]:
    """Another checkpoint: one value of it is changed before it is saved."""
    from scripts.torture.mutations import mutate_tree

    tree: Any = torch.load(path, weights_only=False)
    if rng.random() < 0.5:
        kind, details = mutate_tree(rng, tree)
        asks = True
    else:
        part = tree[rng.choice(("actor_state_dict", "critic_state_dict"))]
        name = rng.choice(sorted(part))
        value = part[name]
        kinds: dict[str, Any] = {
            "NaN": value * float("nan"),
            "transposed": value.t().contiguous().clone(),
            "flat": value.flatten(),
            "double": value.double(),
            "whole numbers": value.long(),
            "empty": value[:0],
            "other": -value,
            "numpy": value.numpy(),
            "list": value.tolist(),
            "complex": value + 1j,
            "reshaped": value.reshape(-1, value.shape[0]),
            "half": value.half(),
            "scalar": value.flatten()[0],
            "quoted": str(value),
        }
        kind = rng.choice(sorted(kinds))
        part[name] = kinds[kind]
        details, asks = (
            name,
            kind
            in (
                "double",
                "other",
                "numpy",
                "list",
                "half",
                "whole numbers",
            ),
        )
    try:
        torch.save(tree, path)
    except Exception:  # a value that no pickle holds
        return "nothing", "", False
    return kind, details, asks


def _pickle_bytes(rng: random.Random, path: Path) -> tuple[str, str, bool]:
    """Change some bytes of the pickle; the zip's own checksum is right."""
    from scripts.torture.mutations import damage

    entries = _entries(path)
    name = rng.choice([_pickle_name(entries), *entries])
    data = bytearray(entries[name])
    kind, details = damage(rng, data)
    _write(path, entries | {name: bytes(data)})
    return kind, f"{name} {details}", True


# Code -------------------------------------------------------------------------------------------


def _hostile(rng: random.Random, path: Path) -> tuple[str, str, bool]:
    """Return a pickle that is no checkpoint, or a checkpoint with something more in it."""
    name, program = rng.choice(programs())
    entries = _entries(path)
    key = _pickle_name(entries)
    where = rng.choice(("alone", "as a value", "as the algorithm"))
    if where != "alone":
        # The checkpoint's dict is under construction on the stack: put one more item into it.
        field = "extra" if where == "as a value" else "algo"
        item = _text(field) + program + b"s."
        entries[key] = entries[key].removesuffix(b".") + item
    else:
        entries[key] = b"\x80\x02" + program + b"."
    _write(path, entries)
    return where, name, False


@lru_cache
def programs() -> tuple[tuple[str, bytes], ...]:
    """Named pieces of pickles that each leave one object on the stack."""
    found: dict[str, bytes] = {}
    for module, name, arguments in (*CALLS, *ODD):
        packed = _plain(arguments)
        old = f"c{module}\n{name}\n".encode()
        new = _text(module) + _text(name) + b"\x93"
        label = f"{module}.{name}{str(arguments)[:30]}"
        found[f"GLOBAL {label}"] = old + packed + b"R"
        found[f"STACK_GLOBAL {label}"] = new + packed + b"R"
        found[f"NEWOBJ {label}"] = old + packed + b"\x81"
    found |= _builds() | _sizes() | _shapes()
    return tuple(sorted(found.items()))


def _builds() -> dict[str, bytes]:
    """BUILD sets attributes of what is on the stack."""
    found = {}
    for module, name in (
        ("torch._utils", "_rebuild_tensor_v2"),
        ("torch._utils", "_rebuild_parameter"),
        ("numpy.core.multiarray", "scalar"),
        ("numpy", "dtype"),
        ("_codecs", "encode"),
        ("torch.nn.modules.loss", "MSELoss"),
        ("collections", "OrderedDict"),
        ("builtins", "set"),
    ):
        target = f"c{module}\n{name}\n".encode()
        for state in ({"mine": 1}, (None, {"mine": 1}), (None, {"__defaults__": (1,)}), 7):
            found[f"BUILD of {name} with {state}"] = target + _plain(state) + b"b"
        found[f"BUILD of a made {name}"] = target + b")R" + _plain({"__class__": 1}) + b"b"
    return found


def _sizes() -> dict[str, bytes]:
    """Return pickles with sizes that are not there."""
    eight = struct.pack("<Q", 2**62)
    return {
        "BINUNICODE8 of 4 EiB": b"\x8d" + eight + b"x",
        "BINBYTES8 of 4 EiB": b"\x8e" + eight + b"x",
        "BYTEARRAY8 of 4 EiB": b"\x96" + eight + b"x",
        "BYTEARRAY8 of 4 GiB": b"\x96" + struct.pack("<Q", 2**32) + b"x",
        "LONG4 of 2 GiB": b"\x8b" + struct.pack("<i", 2**31 - 1) + b"x",
        "FRAME of 4 EiB": b"\x95" + eight + b"N",
        "LONG_BINPUT far away": b"Nr" + struct.pack("<I", 2**31),
        "LONG_BINPUT farther away": b"Nr" + struct.pack("<I", 2**32 - 1),
        "BINGET of nothing": b"h\xff",
        "LONG of many digits": b"L" + b"9" * 10_000 + b"L\n",
        "INT of letters": b"Iabc\n",
        "EXT": b"\x82\x01",
        "PERSID": b"Pabc\n",
        "odd persistent id": _plain(("storage", 7, 8)) + b"Q",
        "persistent id of another storage": _plain(("storage", "x", "../../x", "cpu", 3)) + b"Q",
        "persistent id that is huge": b"("
        + _text("storage")
        + b"ctorch\nFloatStorage\n"
        + _text("0")
        + _text("cpu")
        + _plain(2**40)
        + b"tQ",
    }


def _shapes() -> dict[str, bytes]:
    """Return structures that are deep, endless, or grow when they are shown."""
    bomb = b"]" + b"".join(
        b"q" + bytes([i]) + b"]h" + bytes([i]) + b"ah" + bytes([i]) + b"a" for i in range(60)
    )
    return {
        "lists 200,000 deep": b"]" * 200_000 + b"a" * 199_999,
        "tuples 200,000 deep": b")" + b"\x85" * 200_000,
        "dicts 100,000 deep": (b"}" + _text("x")) * 100_000 + b"N" + b"s" * 100_000,
        "a list within itself": b"]q\x00h\x00a",
        "a dict within itself": b"}q\x00" + _text("x") + b"h\x00s",
        "2^60 lists": bomb,
        "a million marks": b"(" * 1_000_000 + b"1" * 999_999 + b"t",
        "an empty stack": b"0" * 20,
        "DUP without end": b"N" + b"2" * 1_000_000 + b"0" * 1_000_000,
    }


def _plain(value: Any) -> bytes:
    """Return a value as a pickle's opcodes, without header, memo and end."""
    data = pickletools.optimize(pickle.dumps(value, 2))
    return data[2:-1]


def _text(text: str) -> bytes:
    data = text.encode()
    return b"X" + struct.pack("<I", len(data)) + data


# The zip ----------------------------------------------------------------------------------------


def _zip(rng: random.Random, path: Path) -> tuple[str, str, bool]:
    """Return zips with entries missing, doubled, renamed, or far larger than they look."""
    entries = _entries(path)
    name = rng.choice(sorted(entries))
    kind = rng.choice(
        ("missing", "renamed", "empty", "twice", "bomb", "directory", "tiny", "no zip", "outside")
    )
    match kind:
        case "missing":
            del entries[name]
        case "renamed":
            entries[f"x/{name}"] = entries.pop(name)
        case "empty":
            entries[name] = b""
        case "directory":
            entries[f"{name}/"] = entries.pop(name)
        case "tiny":
            entries[name] = entries[name][:3]
        case "outside":
            entries["../../x"] = b"x"
    _write(path, entries)
    match kind:
        case "no zip":
            path.write_bytes(pickle.dumps({"algo": "PPO"}))
        case "twice":
            with zipfile.ZipFile(path, "a") as file, warnings.catch_warnings(action="ignore"):
                file.writestr(zipfile.ZipInfo(name), b"x")
        case "bomb":
            name = rng.choice([n for n in sorted(entries) if "/data" in n])
            del entries[name]
            _write(path, entries)
            deflated = zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1)
            with deflated as file, file.open(name, "w") as entry:
                for _ in range(BOMB):
                    entry.write(bytes(1 << 20))
    return kind, name, False
