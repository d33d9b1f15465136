"""Settings by dotted name: ``selector.gamma=0.99``, ``skills.center.steps=1e6``."""

from __future__ import annotations

import ast
import difflib
import types
import typing
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from skillweave.hierarchy.declaration import Declaration
from skillweave.types import SkillweaveError

T = TypeVar("T")

PLAIN = (
    "call_steps",
    "skill_steps",
    "selector_steps",
    "greedy_skills",
    "reflexes_in_training",
    "cut_every",
)
CONFIGS = ("algorithm", "selector", "flat")


def apply_settings(declaration: Declaration, settings: Sequence[str]) -> None:
    """Change a declaration in place by ``name=value`` strings.

    Raises:
        SkillweaveError: no such setting (with close matches), or a value out of range.
    """
    for setting in settings:
        name, sign, text = setting.partition("=")
        if not sign:
            raise SkillweaveError(f"--set {setting!r}: write name=value, for example call_steps=20")
        _set(declaration, name.strip(), text.strip())
    declaration.__post_init__()


def list_settings(declaration: Declaration) -> dict[str, Any]:
    """Every setting's dotted name and value."""
    found: dict[str, Any] = {name: getattr(declaration, name) for name in PLAIN}
    for skill in declaration.skills:
        if skill.policy is None:
            found[f"skills.{skill.name}.steps"] = declaration.budget(skill)
            config = skill.algorithm or declaration.algorithm
            found |= _flatten(f"skills.{skill.name}.", config)
    return found | _flatten("selector.", declaration.selector)


def _set(declaration: Declaration, name: str, text: str) -> None:
    head, *rest = name.split(".")
    if head in PLAIN and not rest:
        hint = typing.get_type_hints(Declaration)[head]
        setattr(declaration, head, _parse(name, text, hint))
    elif head in CONFIGS and rest:
        config = getattr(declaration, head) or declaration.algorithm
        setattr(declaration, head, _replaced(config, rest, name, text))
    elif head == "skills" and len(rest) == 2 and rest[1] == "steps":
        declaration.skill(rest[0]).steps = _parse(name, text, int)
    elif head == "skills" and len(rest) >= 2:
        skill = declaration.skill(rest[0])
        skill.algorithm = _replaced(skill.algorithm or declaration.algorithm, rest[1:], name, text)
    else:
        known = [*list_settings(declaration), *(f"{c}." for c in CONFIGS)]
        raise _unknown(name, known)


def _replaced(config: T, path: list[str], name: str, text: str) -> T:
    """``config`` with the field at ``path`` parsed from ``text``."""
    field, *deeper = path
    known = [f.name for f in fields(config)]  # type: ignore[arg-type]
    if field not in known:
        raise _unknown(name, [name.removesuffix(".".join(path)) + k for k in known])
    hint = typing.get_type_hints(type(config))[field]
    if deeper:
        inner = getattr(config, field)
        if inner is None and field == "critic":
            inner = getattr(config, "network", None)  # what it stands for
        if not is_dataclass(inner):
            raise SkillweaveError(f"--set {name}: {field} has no parts")
        return replace(config, **{field: _replaced(inner, deeper, name, text)})  # type: ignore[type-var]
    return replace(config, **{field: _parse(name, text, hint)})  # type: ignore[type-var]


def _parse(name: str, text: str, hint: Any) -> Any:
    """``text`` as a value of the annotated type."""
    options = [hint]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        options = list(typing.get_args(hint))
    if type(None) in options and text.lower() in ("none", "null"):
        return None
    try:
        value = ast.literal_eval(text.capitalize() if text.lower() in ("true", "false") else text)
    except (ValueError, SyntaxError):
        value = text
    for option in options:
        origin = typing.get_origin(option)
        if option is bool and isinstance(value, bool):
            return value
        whole = isinstance(value, int | float) and not isinstance(value, bool)
        if option is int and whole and float(value).is_integer():
            return int(value)
        if option is float and whole:
            return float(value)
        if origin is tuple and isinstance(value, tuple | list | int):
            return tuple(value) if isinstance(value, tuple | list) else (value,)
        if origin is typing.Literal and value in typing.get_args(option):
            return value
    wanted = getattr(hint, "__name__", str(hint).replace("typing.", ""))
    if typing.get_origin(hint) is typing.Literal:
        wanted = "one of " + ", ".join(map(str, typing.get_args(hint)))
    raise SkillweaveError(f"--set {name}={text}: expected {wanted}")


def _flatten(prefix: str, config: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for f in fields(config):
        value = getattr(config, f.name)
        found |= (
            _flatten(f"{prefix}{f.name}.", value)
            if is_dataclass(value)
            else {prefix + f.name: value}
        )
    return found


def _unknown(name: str, known: Sequence[str]) -> SkillweaveError:
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = f"; did you mean {', '.join(near)}?" if near else ""
    return SkillweaveError(f"no setting {name!r}{hint} (skillweave info RECIPE lists them)")
