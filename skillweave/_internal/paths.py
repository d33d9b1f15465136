"""Paths of the parts of a hierarchy: names with "/" between them, ``inner/skill`` for example.

A hierarchy that is a skill is a level: its path stands before the names of its parts. The outermost
level is "".
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

T = TypeVar("T")
AGENT = "agent"
"""Path of a plain agent."""
SELECTOR = "selector"
"""Name of a level's selector."""
CRITIC = "skill_critic"
"""Name of a level's critic of skills."""


def names_in(path: str) -> tuple[str, ...]:
    """Return the names in a path, the outermost first; "" has none."""
    return tuple(path.split("/")) if path else ()


def join(*parts: str) -> str:
    """Return one path made of paths and names, of which some may be empty."""
    return "/".join(filter(None, parts))


def name_of(path: str) -> str:
    """Return the last name in a path."""
    return names_in(path)[-1]


def level_of(path: str) -> str:
    """Return the level of a part: its path without the last name."""
    return join(*names_in(path)[:-1])


def levels_to(path: str) -> list[str]:
    """Return all beginnings of a path, from the outermost level to the path itself."""
    names = names_in(path)
    return [join(*names[:count]) for count in range(len(names) + 1)]


def is_below(path: str, level: str) -> bool:
    """Return True if a path is of a part of a level, or of a level below it."""
    return path != level and (not level or path.startswith(f"{level}/"))


def relative(path: str, level: str) -> str:
    """Return a path in a level without the path of the level."""
    return path.removeprefix(f"{level}/") if level else path


def below(by_path: Mapping[str, T], level: str) -> dict[str, T]:
    """Return the values in a level, by their paths without that of the level."""
    return {relative(path, level): v for path, v in by_path.items() if is_below(path, level)}


def decides(path: str) -> bool:
    """Return True for the path of a selector or a critic of skills, which are no skills."""
    return name_of(path) in (SELECTOR, CRITIC)
