"""Checks of settings: each raises a SkillweaveError that names a field and what it must be.

This module does not import torch; see ``config``.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from skillweave.errors import SkillweaveError
from skillweave.messages import short
from skillweave.networks.config import Network, from_dict

INFINITY = float("inf")
HUGE = 1e38
"""No setting may be as large: it has to fit into a tensor, a whole number into 63 bits."""


def check(config: object, field_name: str, ok: bool, asked: str) -> None:
    """Raise a SkillweaveError that names a field and what it must be."""
    if not ok:
        value = getattr(config, field_name)
        raise SkillweaveError(
            f"{type(config).__name__}.{field_name} is {short(value)}; it must be {asked}"
        )


def whole(config: object, *names: str) -> None:
    """Raise where a field is no whole number, or less than 1."""
    for name in names:
        value = getattr(config, name)
        check(config, name, type(value) is int, "a whole number")
        check(config, name, value >= 1, "at least 1")
        _fits(config, name)


def _fits(config: object, name: str) -> None:
    value = getattr(config, name)
    largest = 2**63 if isinstance(value, int) else HUGE
    check(config, name, abs(value) < largest, f"below {largest:g}")


def number(config: object, *names: str, low: float = 0.0, high: float = INFINITY) -> None:
    """Raise where a field is no finite number between ``low`` and ``high``."""
    asked = "at least 0 and finite" if high == INFINITY else f"between {low:g} and {high:g}"
    if low == -INFINITY:
        asked = "a finite number"
    for name in names:
        value = getattr(config, name)
        ok = type(value) in (int, float) and abs(value) < INFINITY
        check(config, name, ok and low <= value <= high, asked)
        _fits(config, name)


def positive(config: object, *names: str) -> None:
    """Raise where a field is no finite number above 0."""
    for name in names:
        value = getattr(config, name)
        ok = type(value) in (int, float) and 0.0 < value < INFINITY
        check(config, name, ok, "positive and finite")
        _fits(config, name)


def one_of(config: object, field_name: str, known: tuple[str, ...]) -> None:
    """Raise where a field is none of the known words."""
    check(config, field_name, getattr(config, field_name) in known, f"one of {', '.join(known)}")


def flags(config: Any) -> None:
    """Raise where a field that is yes or no is something else."""
    for f in fields(config):
        if f.type in ("bool", bool):
            check(config, f.name, isinstance(getattr(config, f.name), bool), "True or False")


def compiles(config: Any) -> None:
    """Raise where ``compile`` is something else than yes, no or auto."""
    ok = isinstance(config.compile, bool) or config.compile == "auto"
    check(config, "compile", ok, "True, False or auto")


def check_networks(config: Any) -> None:
    """Raise where ``network`` or ``critic`` is no architecture; a dict of settings becomes one."""
    from_dict(config, "network", Network)
    if hasattr(config, "critic"):
        from_dict(config, "critic", Network)
    check(config, "network", isinstance(config.network, Network), "a Network()")
    critic = getattr(config, "critic", None)
    check(config, "critic", isinstance(critic, Network | None), "a Network() or None")
    if critic is not None:
        check(config, "critic", critic.rnn is None, "without rnn")
        same = critic.planes in (None, config.network.planes)
        check(config, "critic", same, "without planes: Network.planes of network counts for both")
