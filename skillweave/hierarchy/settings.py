"""Groups of a hierarchy's settings: training apart, selection, and the guide."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from skillweave.arguments import checked_names
from skillweave.errors import SkillweaveError
from skillweave.messages import short
from skillweave.selectors.ready import ReadyValue
from skillweave.training.checks import check_fields


@checked_names
@dataclass(frozen=True)
class Apart:
    """Settings of skills and a selector that train one after another.

    Raises:
        SkillweaveError: a value is out of its range.
    """

    skill_steps: int | None = None
    """Training steps of every skill without ``steps`` of its own; None: its share of
    ``Hierarchy.steps``."""
    selector_steps: int | None = None
    """Training steps of the selector; None: its share, twice that of a skill. A ready selector
    takes none."""
    start_calls: int | None = None
    """While a skill trains, its episodes begin after up to this many calls of the skills that can
    act already, a number drawn for each episode: it learns where it will be called. None: it
    starts as soon as it may."""
    search_steps: int | None = None
    """Reset an episode in which the skill cannot start within this many steps. For environments of
    several kinds, where some have nothing for the skill. None: the episode goes on."""
    episode_calls: int = 1
    """The most calls of a skill in an episode, while it trains. After a call that reached its
    ``max_steps`` other skills are called if ``start_calls`` is set, then the skill again, if it may
    start. 1: each call begins with a reset. Evaluations count an episode's first call."""

    def __post_init__(self) -> None:
        check_fields(self)


@checked_names
@dataclass(frozen=True)
class Selection:
    """Settings of how the selector chooses and how skills act under it.

    Raises:
        SkillweaveError: a value is out of its range.
    """

    call_cost: float = 0.0
    """Cost of each decision while the selector learns, in units of reward (a deliberation cost,
    Harb et al. 2018), so that calls which change nothing are worth less. A cost above the
    discounted reward makes long calls best."""
    greedy_skills: bool | None = None
    """True: skills act greedily under the selector. False: they sample. None: greedy where they
    learn apart; where they learn together, episodes of both kinds are played at the end, and the
    better kind is kept."""
    greedy_selector: bool | None = None
    """The same for the selector. None: greedy, unless skills and selector learn together and a
    sampling selector is clearly better at the end: a greedy one can call one skill forever."""
    target_return: float | None = None
    """The selector's stage ends early at this mean return of the evaluation while training."""

    def __post_init__(self) -> None:
        check_fields(self)
        cost: Any = self.call_cost
        if isinstance(cost, bool) or not isinstance(cost, int | float) or not 0 <= cost < math.inf:
            raise SkillweaveError(
                f"call_cost is {short(cost)}; it must be a number of at least 0, in units of reward"
            )


@checked_names
@dataclass(frozen=True)
class Guide:
    """A ready selector beside one that learns.

    Raises:
        SkillweaveError: it has no effect, or a value is out of its range.
    """

    selector: ReadyValue
    """A function of observations, an ``Automaton``, or a tree."""
    restrict: bool = True
    """Only skills that the guide may choose are called, in training and afterwards."""
    target_kl: float | None = None
    """Keep the selector within this KL of the guide while it learns; None disables this."""

    def __post_init__(self) -> None:
        check_fields(self)
        kl: Any = self.target_kl
        if kl is not None and (isinstance(kl, bool) or not isinstance(kl, int | float)):
            raise SkillweaveError(f"Guide: target_kl is {short(kl)}; it must be a number, or None")
        if kl is not None and not 0.0 < kl < math.inf:
            raise SkillweaveError(
                f"Guide: target_kl is {short(kl)}; it must be positive and finite"
            )
        if kl is None and not self.restrict:
            raise SkillweaveError(
                "the guide has no effect: restrict is False, and target_kl is None"
            )
