"""Which of several hierarchies a stage ended with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NotRequired, TypedDict

EPISODES = 100
"""Of each hierarchy, to find out which is the best."""


class Kept(TypedDict):
    """Which hierarchy a stage ended with, by their mean returns."""

    before: NotRequired[float]
    after: float
    sampled: NotRequired[float]
    """That after learning together, with skills that sample instead of greedy ones."""
    kept: Literal["before", "after", "sampled"]


def kept_words(kept: Mapping[str, Any]) -> str:
    """A sentence on the hierarchies that were compared, and on which was kept."""
    judged = "sampled" in kept
    named = {
        "before": "before learning together",
        "after": "after it with greedy skills" if judged else "after it",
        "sampled": "after it with skills that sample",
    }
    if "before" not in kept:
        named |= {"after": "with greedy skills", "sampled": "with skills that sample"}
    returns = ", ".join(f"{words} {kept[k]:.1f}" for k, words in named.items() if k in kept)
    return f"mean return {returns} ({EPISODES} episodes each): kept what was {named[kept['kept']]}"


def to_be_judged(entry: Mapping[str, Any], manifest: Mapping[str, Any]) -> bool:
    """Whether a stage of a run is to end with the best of several hierarchies."""
    both = manifest.get("learn") == "apart, then together"  # older runs say no more
    compared = entry.get("compared", both) or entry.get("greedy_judged", False)
    return entry["kind"] == "together" and bool(compared)
