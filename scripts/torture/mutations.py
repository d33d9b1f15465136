"""One change of one file: of its bytes, of its place, or of what it says.

Every change is drawn from a ``random.Random``, so a case's number gives the same change again.
"""

from __future__ import annotations

import json
import os
import random
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
import torch

from scripts.torture import hostile_onnx, hostile_pickles
from skillweave.runs.files import write_tensors

ASKED = re.compile(
    r"run\.json\.(env|env_kwargs|hierarchy\.(call_steps|greedy_skills)|seed|checkpoint_every|eval_every|eval_episodes"
    r"|skills\.\d+\.max_steps|stages\.\d+\.(budget|algorithm|evolution))\b"
)
"""Settings of run.json that may be changed by hand: the run then plays, or trains, otherwise."""


@dataclass(frozen=True)
class Change:
    """A change of a file."""

    file: str
    kind: str
    """Equal for changes that are alike."""
    details: str
    asks: bool = False
    """Whether it asks for other behaviour, so that a policy may play otherwise."""


Way = Callable[[random.Random, Path, Path], tuple[str, str, bool]]
"""Changes a file within a folder: the kind of the change, its details, whether it asks."""


def change(rng: random.Random, folder: Path) -> Change:
    """Change one file below ``folder``."""
    path = rng.choice(sorted(p for p in folder.rglob("*") if p.is_file()))
    way = rng.choice([_bytes, _bytes, _place] + WAYS.get(path.suffix, []) * 2)
    kind, details, asks = way(rng, path, folder)
    asks = asks or ASKED.search(f"{path.name}.{kind}") is not None
    kind = f"{path.suffix} {way.__name__.strip('_')} {kind}"
    return Change(str(path.relative_to(folder)), kind, details, asks)


# Bytes and places -------------------------------------------------------------------------------


def _bytes(rng: random.Random, path: Path, folder: Path) -> tuple[str, str, bool]:
    data = bytearray(path.read_bytes())
    kind, details = damage(rng, data)
    path.write_bytes(data)
    return kind, details, path.suffix == ".onnx" and path.parent == folder


def damage(rng: random.Random, data: bytearray) -> tuple[str, str]:
    """Change bytes in place; what was done, and where."""
    at = rng.randrange(len(data) + 1)
    size = rng.choice((1, 2, 8, 100, 5000))
    noise = rng.randbytes(size)
    kind = rng.choice(("flip", "flip", "cut", "insert", "remove", "repeat", "write", "not UTF-8"))
    match kind:
        case "flip":
            for _ in range(rng.choice((1, 1, 2, 8))):
                if data:
                    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        case "cut":
            del data[at:]
        case "insert":
            data[at:at] = noise
        case "remove":
            del data[at : at + size]
        case "repeat":
            data[at:at] = data[at : at + size]
        case "write":
            data[at : at + size] = noise
        case "not UTF-8":
            data[at : at + 1] = b"\xff\xfe\xc3\x28"
    return kind, f"{size} at {at}"


def _place(rng: random.Random, path: Path, folder: Path) -> tuple[str, str, bool]:
    others = [p for p in sorted(folder.rglob("*")) if p.is_file() and p != path]
    kind = rng.choice(
        (
            "FIFO",
            "directory",
            "missing",
            "empty",
            "link to itself",
            "/dev/zero",
            "swapped",
            "swapped",
            "copied from",
            "twin of a folder",
        )
    )
    data, details = path.read_bytes(), ""
    path.unlink()
    match kind:
        case "FIFO":
            os.mkfifo(path)
        case "directory":
            path.mkdir()
        case "empty":
            path.touch()
        case "link to itself":
            path.symlink_to(path.name)
        case "/dev/zero":
            path.symlink_to("/dev/zero")
        case "swapped" | "copied from" if others:
            other = rng.choice([p for p in others if p.suffix == path.suffix] or others)
            path.write_bytes(other.read_bytes())
            if kind == "swapped":
                other.write_bytes(data)
            details = other.name
        case "twin of a folder":
            path.mkdir()
            (path / "x").write_bytes(data)
    return kind, details, False


# What is said: trees of JSON --------------------------------------------------------------------

DEEP, DIGITS, EXPONENT, TWICE = "@deep@", "@digits@", "@exponent@", "@twice@"
"""Marks in the tree for what ``json.dumps`` does not write."""
VALUES: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    1,
    -1,
    2,
    3,
    5,
    0.5,
    -0.0,
    2**31,
    2**63,
    2**64,
    10**18,
    1e308,
    -1e308,
    float("nan"),
    float("inf"),
    float("-inf"),
    "",
    "x",
    "nan",
    "0",
    "1",
    "None",
    "é\u2028\x00",
    "\ud800",
    "x" * 10_000,
    [],
    {},
    [[]],
    [None],
    {"": None},
    [0] * 1000,
    {"x": {"y": []}},
    "agent",
    "flat",
    "skill",
    "hierarchy",
    "selector",
    "done",
    "training",
    "waiting",
    "left",
    "balance",
    "PPO",
    "SAC",
    "CartPole-v0",
    "Acrobot-v1",
    "Pendulum-v1",
    "CartPole",
    "NoSuchEnv-v0",
    "evil:Evil-v0",
    "evil",
    "../../x",
    "/etc/passwd",
    "/dev/zero",
    "~",
    "a/b",
    "{0.__class__}",
    "%s%n",
    "wandb",
    "__import__('evil')",
    "Box",
    "Discrete",
    "float32",
    "F64",
    "BF16",
    DEEP,
    DIGITS,
    EXPONENT,
)
"""What may stand in place of anything."""


def nodes(tree: Any, at: str = "") -> list[tuple[Any, Any, str]]:
    """(container, key, path) of every value within a tree."""
    if isinstance(tree, dict):
        items: Any = tree.items()
    elif isinstance(tree, list):
        items = enumerate(tree)
    else:
        return []
    found = []
    for key, value in items:
        path = f"{at}.{key}" if at else str(key)
        found += [(tree, key, path), *nodes(value, path)]
    return found


def mutate_tree(rng: random.Random, tree: Any) -> tuple[str, str]:
    """Change one value somewhere in a tree, in place; where, and how."""
    places = nodes(tree)
    if not places:
        return "nothing", ""
    holder, key, path = rng.choice(places)
    value = holder[key]
    kind = rng.choice(
        ("delete", "value", "value", "value", "number", "nest", "name", "swap", "repeat")
    )
    match kind:
        case "delete":
            del holder[key]
        case "number" if isinstance(value, int | float) and not isinstance(value, bool):
            holder[key] = rng.choice(
                (-value, value + 1, value - 1, value * 10**9, value / 3, str(value), float(value))
            )
        case "nest":
            holder[key] = rng.choice(([value], {"x": value}, {path: value}, [value, value]))
        case "name" if isinstance(holder, dict):
            other = rng.choice(("", "x", f"{key}x", str(key).upper(), "é", rng.choice(places)[2]))
            holder[other] = holder.pop(key)
            return path, f"is named {other[:40]!r}"
        case "swap":
            alike = [p for p in places if type(p[0][p[1]]) is type(value) and p[2] != path]
            there, name, to = rng.choice(alike or places)
            if not (to.startswith(path) or path.startswith(to)):
                holder[key], there[name] = there[name], value
            return path, f"swapped with {to}"
        case "repeat" if isinstance(holder, list):
            holder.insert(0, value)
        case _:
            kind = "value"
            holder[key] = rng.choice(VALUES)
    shown = repr(holder[key])[:60] if kind != "delete" and key in _keys(holder) else ""
    return path, f"{kind} {shown}"


def _keys(holder: Any) -> Any:
    return holder if isinstance(holder, dict) else range(len(holder))


def dump(rng: random.Random, tree: Any) -> str:
    """Return a tree as JSON, with what ``json.dumps`` would not write."""
    text = json.dumps(tree, indent=rng.choice((None, 2)))
    depth = rng.choice((100, 2_000, 100_000))
    text = text.replace(f'"{DEEP}"', "[" * depth + "]" * depth)
    return text.replace(f'"{DIGITS}"', "9" * 5_000).replace(f'"{EXPONENT}"', "-1e99999")


def _json(rng: random.Random, path: Path, folder: Path) -> tuple[str, str, bool]:
    tree = json.loads(path.read_text())
    where, how = mutate_tree(rng, tree)
    path.write_text(dump(rng, tree), errors="surrogatepass")
    return where, how, False


def _text(rng: random.Random, path: Path, folder: Path) -> tuple[str, str, bool]:
    """JSON that is another document altogether."""
    text = path.read_text()
    kind, data = rng.choice(
        (
            ("a list", f"[{text}]"),
            ("a number", "7"),
            ("null", "null"),
            ("empty object", "{}"),
            ("byte order mark", "\ufeff" + text),
            ("twice", text + text),
            ("deep", "[" * 100_000),
            ("UTF-16", text.encode("utf-16")),
            ("NUL", text + "\x00"),
            ("a string", json.dumps(text)),
        )
    )
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return kind, "", False


def _line(rng: random.Random, path: Path, folder: Path) -> tuple[str, str, bool]:
    lines = path.read_text().splitlines()
    number = rng.randrange(len(lines)) if lines else 0
    if not lines:
        return "nothing", "", False
    kind = rng.choice(("tree", "tree", "tree", "drop", "repeat", "blank", "other"))
    how = ""
    match kind:
        case "tree":
            tree = json.loads(lines[number])
            kind, how = mutate_tree(rng, tree)
            text = dump(random.Random(0), tree).replace("\n", " ")
            lines[number] = text.encode(errors="replace").decode()
        case "drop":
            del lines[number]
        case "repeat":
            lines.insert(number, lines[number])
        case "blank":
            lines.insert(number, rng.choice(("", " ", "\t", "\x00")))
        case "other":
            lines[number] = rng.choice(("[]", "7", "null", '"x"', "{}", "[" * 5_000))
    path.write_text("\n".join(lines) + "\n")
    return kind, f"line {number + 1} {how}", False


# Safetensors ------------------------------------------------------------------------------------


def _raw_header(rng: random.Random, path: Path, folder: Path) -> tuple[str, str, bool]:
    """Return the outer header: dtypes, shapes, offsets; the checksum stays as it is."""
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    where, how = mutate_tree(rng, header)
    text = dump(rng, header).encode(errors="surrogatepass")
    length = rng.choice((len(text),) * 4 + (0, 2**63, len(text) + 1))
    path.write_bytes((length % 2**64).to_bytes(8, "little") + text + data[8 + size :])
    return where, how, False


def _header(rng: random.Random, path: Path, folder: Path) -> tuple[str, str, bool]:
    """Change Skillweave's own header, and correct its checksum where people share the file."""
    tensors, header = _parts(path)
    where, how = mutate_tree(rng, header)
    return where, how, _seal(rng, path, folder, tensors, header)


def _tensors(rng: random.Random, path: Path, folder: Path) -> tuple[str, str, bool]:
    """Change tensors, and correct the checksum where people share the file."""
    tensors, header = _parts(path)
    if not tensors:
        return "nothing", "", False
    name = rng.choice(sorted(tensors))
    value, other = tensors[name], rng.choice(sorted(tensors))
    kinds = ("dtype", "shape", "NaN", "infinite", "values", "swap", "drop", "more", "empty", "huge")
    kind = rng.choice(kinds)
    match kind:
        case "dtype":
            dtypes = (torch.float64, torch.float16, torch.int64, torch.bool, torch.uint8)
            tensors[name] = value.to(rng.choice(dtypes))
        case "shape":
            shapes = (value.flatten(), value[None], value[..., None], value.transpose(0, -1))
            tensors[name] = rng.choice(shapes if value.ndim else shapes[:2]).contiguous()
        case "NaN" | "infinite" if value.is_floating_point():
            flat = value.flatten().clone()
            flat[rng.randrange(max(1, len(flat))) :][:1] = float("nan" if kind == "NaN" else "inf")
            tensors[name] = flat.reshape(value.shape)
        case "values" if value.is_floating_point():
            tensors[name] = -value + 0.5
        case "swap":
            tensors[name], tensors[other] = tensors[other], value
        case "drop":
            del tensors[name]
        case "more":
            tensors[rng.choice(("x", "", "state.params", f"{name}.x"))] = value.clone()
        case "empty":
            tensors[name] = value.flatten()[:0]
        case "huge" if value.is_floating_point():
            tensors[name] = torch.full_like(value, 1e30)
        case _:
            kind = "one more"
            tensors[name] = value.clone() + 1
    asks = _seal(rng, path, folder, tensors, header)
    return kind, name, asks and kind not in ("NaN", "infinite")


def _parts(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(json.loads(data[8 : 8 + size])["__metadata__"]["skillweave"])
    return safetensors.torch.load(data), header


def _seal(rng: random.Random, path: Path, folder: Path, tensors: Any, header: Any) -> bool:
    """Write the parts with a right checksum, in half of the cases also where run.json says it.

    A file that only its own run reads keeps the checksum of what it held: with a right one it is
    trusted. Returns whether the file may act otherwise now: nothing vouches for what it was before.
    """
    text = json.dumps(header)
    marks = (DEEP, DIGITS, EXPONENT, "NaN", "Infinity", "\\ud800")
    if not isinstance(header, dict) or any(m in text for m in marks):
        size = dump(rng, {"__metadata__": {"skillweave": dump(rng, header)}}).encode()
        path.write_bytes(len(size).to_bytes(8, "little") + size)
        return False
    if "checkpoint" in path.name or path.parent.name in ("states", "final"):
        path.write_bytes(safetensors.torch.save(tensors, {"skillweave": text}))
        return False
    old = header.pop("sha256", None)
    write_tensors(path, tensors, header)
    manifest = path.parent.parent / "run.json"
    if rng.random() < 0.5 and isinstance(old, str) and manifest.exists():
        said = manifest.read_text()
        manifest.write_text(said.replace(old, _parts(path)[1]["sha256"]))
        if old in said:
            return True
    return path.parent == folder


WAYS: dict[str, list[Callable[[random.Random, Path, Path], tuple[str, bool]]]] = {
    ".json": [_json, _json, _json, _json, _text],
    ".jsonl": [_line, _line],
    ".safetensors": [_raw_header, _header, _header, _tensors, _tensors],
    ".pt": [hostile_pickles.change, hostile_pickles.change, hostile_pickles.change],
    ".onnx": [hostile_onnx.change, hostile_onnx.change],
}
