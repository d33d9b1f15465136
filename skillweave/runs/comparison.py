"""The choice among several hierarchies at the end of a stage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from skillweave.schema import AtLeastOne

Candidate = Literal[
    "before", "given", "greedy", "skills_sample", "selector_samples", "both_sample", "repaired"
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
    "given": "as it was given",
    "greedy": "greedy",
    "skills_sample": "with skills that sample",
    "selector_samples": "with a selector that samples",
    "both_sample": "with skills and a selector that sample",
}


@dataclass(frozen=True)
class Comparison:
    """The record of a run of what was compared at a stage's end, and what was kept.

    Mean returns of hierarchies, or of a policy that was given and the one that learnt on from it.
    """

    kept: Candidate
    before: float | None = None
    given: float | None = None
    """The policy that the stage was given."""
    given_samples: float | None = None
    greedy: float | None = None
    skills_sample: float | None = None
    selector_samples: float | None = None
    both_sample: float | None = None
    samples: float | None = None
    given_success: float | None = None
    """The share of episodes in which the policy that was given succeeded; None: unknown."""
    success: float | None = None
    """The same of the one that learnt on."""
    worse: Literal[True] | None = None
    """What learnt on from a policy that was given is clearly worse."""
    samples_better: Literal[True] | None = None
    """What learnt on is clearly better where it samples."""
    episodes: AtLeastOne | None = None
    """Episodes of each candidate; None: training was too short for a comparison."""
    sentence: str | None = None
    """The result of a repair, which is compared by calls."""

    @property
    def is_worse(self) -> bool:
        """True if the policy that was kept is clearly worse than the one that was given."""
        return bool(self.worse) and self.kept != "given"

    def __str__(self) -> str:
        """Return a sentence on the compared hierarchies and the kept one."""
        if self.sentence is not None:
            return self.sentence
        if self.episodes is None:
            return (
                "too few steps to compare greedy and sampling in episodes: unless Selection sets "
                "it, skills sample, and the selector is greedy"
            )
        if self.given is not None and self.greedy is not None:
            return self._learnt_on()
        returns = ", ".join(
            f"{words} {mean:.4g}"
            for name, words in _WORDS.items()
            if (mean := getattr(self, name)) is not None
        )
        return f"mean return {returns} ({self.episodes} episodes each); kept: {_WORDS[self.kept]}"

    def _learnt_on(self) -> str:
        """Return a sentence on a policy that was given and the one that learnt on from it."""
        before = f"{self.given:.4g} as it was given"
        if self.given_samples is not None:
            before += f" ({self.given_samples:.4g} where it samples)"
        now = f"{self.greedy:.4g} now"
        if self.samples is not None:
            now += f" ({self.samples:.4g} where it samples)"
        found = f"mean return {before}, {now}; {self.episodes} episodes each"
        if self.given_success is not None and self.success is not None:
            found += f", success {self.given_success:.0%} as it was given, {self.success:.0%} now"
        return found + self._advice()

    def _advice(self) -> str:
        """Return the end of the sentence on a policy that learnt on from one that was given."""
        says = ""
        if self.kept == "given":
            says = (
                ": clearly worse, so the policy that was given is kept. Smaller steps may help "
                '(learning_rate), or more steps; keep="last" ends with what it has learnt'
            )
        elif self.is_worse:
            says = (
                ': clearly worse than what it was given. Without keep="last" the policy that was '
                "given would be kept; smaller steps may help (learning_rate), or more steps"
            )
        if self.samples_better:
            says += (
                ". It is clearly better where it samples than greedily: "
                "evaluate(deterministic=False)"
            )
        return says
