"""Which parameters belong to a layer's units, so that networks can grow and shrink."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Part:
    """Where a layer's units lie in a parameter: unit u from ``start + u·block`` on of an axis."""

    name: str
    axis: int  # from the end: negative
    start: int = 0
    block: int = 1


@dataclass(frozen=True)
class Units:
    """Units that stand side by side: what computes them, and what reads them."""

    count: int
    own: tuple[Part, ...]
    onward: tuple[Part, ...]


def units_of(
    shapes: Mapping[str, tuple[int, ...]], count: int, layer: str, readers: Sequence[str]
) -> Units:
    """The units of a layer of weights (in, out), read by the weights named; noise goes along."""
    names = (f"{name}{sigma}" for name in readers for sigma in ("", "_sigma"))
    return Units(
        count,
        tuple(Part(name, -1) for name in shapes if name.startswith(f"{layer}.")),
        tuple(Part(name, -2) for name in names if name in shapes),
    )


@dataclass(frozen=True)
class Joint:
    """Where a layer can be added or taken away: behind the last hidden layer."""

    prefix: str
    depth: int
    readers: tuple[tuple[str, str], ...]  # weight and bias of what reads it
    kinds: tuple[str, ...]  # parameters of a layer: weight, bias, and perhaps their sigmas
