"""The choice among several hierarchies at the end of a stage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NotRequired, TypedDict

from skillweave.schema import AtLeastOne

Candidate = Literal[
    "before", "greedy", "skills_sample", "selector_samples", "both_sample", "repaired"
]
"""A hierarchy that a stage could end with."""

SAMPLING: dict[str, tuple[bool, bool]] = {
    "greedy": (False, False),
    "skills_sample": (True, False),
    "selector_samples": (False, True),
    "both_sample": (True, True),
}
"""For each candidate: skills sample, the selector samples."""
_WORDS = {
    "before": "before learning together",
    "greedy": "greedy",
    "skills_sample": "with skills that sample",
    "selector_samples": "with a selector that samples",
    "both_sample": "with skills and a selector that sample",
}


class Comparison(TypedDict):
    """The hierarchy that a stage ended with, and the mean returns of the compared ones."""

    before: NotRequired[float]
    greedy: NotRequired[float]
    skills_sample: NotRequired[float]
    selector_samples: NotRequired[float]
    both_sample: NotRequired[float]
    episodes: NotRequired[AtLeastOne]
    """Episodes of each candidate; absent: training was too short for a comparison."""
    sentence: NotRequired[str]
    """The result of a repair, which is compared by calls."""
    kept: Candidate


def comparison_words(kept: Mapping[str, Any]) -> str:
    """Return a sentence on the compared hierarchies and the kept one."""
    if "sentence" in kept:
        return str(kept["sentence"])
    if "episodes" not in kept:
        return (
            "too few steps to compare greedy and sampling in episodes: unless Selection sets it, "
            "skills sample, and the selector is greedy"
        )
    returns = ", ".join(f"{words} {kept[k]:.4g}" for k, words in _WORDS.items() if k in kept)
    return f"mean return {returns} ({kept['episodes']} episodes each); kept: {_WORDS[kept['kept']]}"


def best_words(best: Mapping[str, Any]) -> str:
    """Return a sentence on the evaluation whose weights a stage ended with (``keep="best"``)."""
    what = "mean return" if best["of"] == "return" else "share of successes"
    return (
        f"kept the weights of step {best['steps']:,}, whose evaluation was best: "
        f"{what} {best['value']:.4g}"
    )


def needs_comparison(entry: Mapping[str, Any]) -> bool:
    """Return whether a stage of a run must end with the best of several hierarchies."""
    if "repair" in entry:
        return True
    return entry["kind"] == "together" and bool(entry["compared"] or entry["greedy_judged"])
