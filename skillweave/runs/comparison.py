"""The choice among several hierarchies at the end of a stage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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


@dataclass(frozen=True)
class Comparison:
    """The record of a run of the hierarchies compared at a stage's end, and the kept one."""

    kept: Candidate
    before: float | None = None
    greedy: float | None = None
    skills_sample: float | None = None
    selector_samples: float | None = None
    both_sample: float | None = None
    episodes: AtLeastOne | None = None
    """Episodes of each candidate; None: training was too short for a comparison."""
    sentence: str | None = None
    """The result of a repair, which is compared by calls."""

    def __str__(self) -> str:
        """Return a sentence on the compared hierarchies and the kept one."""
        if self.sentence is not None:
            return self.sentence
        if self.episodes is None:
            return (
                "too few steps to compare greedy and sampling in episodes: unless Selection sets "
                "it, skills sample, and the selector is greedy"
            )
        returns = ", ".join(
            f"{words} {mean:.4g}"
            for name, words in _WORDS.items()
            if (mean := getattr(self, name)) is not None
        )
        return f"mean return {returns} ({self.episodes} episodes each); kept: {_WORDS[self.kept]}"
