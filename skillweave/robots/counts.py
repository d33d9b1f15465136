"""Counts of robots on which two treatments differ."""

from __future__ import annotations

from math import comb


def exact_chance(lost: int, won: int) -> float:
    """Return how likely counts at least so unequal are where both are alike (McNemar's exact test).

    Args:
        lost, won: robots on which two treatments differ, by which of them is better.
    """
    n = lost + won
    tail = sum(comb(n, k) for k in range(min(lost, won) + 1)) / 2**n
    return float(min(1.0, 2 * tail))
