"""The state of parts inside parts as one flat dict, as files keep it: names ``part.inner.name``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

T = TypeVar("T")


def prefixed(prefix: str, named: Mapping[str, T]) -> dict[str, T]:
    """Return a part's state as names of the whole's: each name becomes ``prefix.name``."""
    return {f"{prefix}.{k}": v for k, v in named.items()}


def unprefixed(prefix: str, named: Mapping[str, T]) -> dict[str, T]:
    """Return a part's state from the whole's: the entries ``prefix.name``, as ``name``."""
    start = f"{prefix}."
    return {k.removeprefix(start): v for k, v in named.items() if k.startswith(start)}
