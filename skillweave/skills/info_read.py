"""The keys of ``info`` that a skill reads, so that only these are recorded with experience.

Stands alone because a skill is declared without it; only what records steps needs it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from skillweave.errors import DeclarationError
from skillweave.skills.base import Skill, path_of
from skillweave.skills.outputs import called
from skillweave.skills.probing import untouched
from skillweave.types import Step


class _Recording(dict[Any, Any]):
    """An info that notes which of its keys are read."""

    def __init__(self, info: Any) -> None:
        super().__init__(info)
        self.read: dict[Any, None] = {}
        self.whole = False
        """True if something went over all keys."""


def _noting(name: str, whole: bool) -> Callable[..., Any]:
    method = getattr(dict, name)

    def noting(self: _Recording, *arguments: Any) -> Any:
        self.whole |= whole
        self.read.update(dict.fromkeys(arguments[:1]))
        return method(self, *arguments)

    return noting


for _name in ("__iter__", "keys", "values", "items", "copy"):
    setattr(_Recording, _name, _noting(_name, True))
for _name in ("__getitem__", "__contains__", "get"):
    setattr(_Recording, _name, _noting(_name, False))

JUDGING = ("reward", "termination", "success")
"""Methods that receive a step."""


def info_keys_read(skill: Skill, step: Step, methods: Sequence[str] = JUDGING) -> tuple[str, ...]:
    """Return the keys of ``info`` that a skill's methods read, found by calling them.

    A key that is read only sometimes may not be found: a skill names it in ``needs_info``, which
    replaces the search.

    Args:
        step: n steps of the environment.
        methods: of the skill.

    Raises:
        DeclarationError: a method goes over the whole info, so ``needs_info`` must say what it
            needs.
    """
    if skill.needs_info is not None:
        return tuple(skill.needs_info)
    found: dict[str, None] = {}
    for method in methods:
        if not skill.defines(method):
            continue
        info = _Recording(step.info)
        where = f"skill {path_of(skill)!r}: {method}()"
        with untouched(skill):
            called(getattr(skill, method), replace(step, info=info), where, judges=None)
        if info.whole:
            raise DeclarationError(
                f"{where} reads info as a whole, so it cannot be found out which keys to record "
                "for it: name them in the class, needs_info = ('key', ...)"
            )
        found |= {key: None for key in info.read if isinstance(key, str)}
    return tuple(found)
