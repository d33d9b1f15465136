"""A hierarchy's settings, and groups of them: training apart, selection, and the guide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

from skillweave.algorithms.config import AlgorithmConfig, AlgorithmSettings
from skillweave.errors import DeclarationError
from skillweave.schema import AtLeastOne, Check, NonNegative, Positive, settings
from skillweave.skills import Reflex
from skillweave.skills.lengths import Lengths
from skillweave.skills.selector import ReadyValue
from skillweave.training.stage import Together

StartCalls = (
    AtLeastOne | Annotated[tuple[str, ...], Check("names of skills: ('left',)", bool)] | None
)
"""Calls that come before a skill starts, while it trains."""

GuideValue = Annotated[
    ReadyValue,
    Check("a function of observations, an Automaton or a tree", lambda x: not isinstance(x, type)),
]
"""A ready selector that guides."""


@settings
class Apart:
    """Settings of skills and a selector that train one after another.

    Raises:
        DeclarationError: a value is out of its range.
    """

    skill_steps: AtLeastOne | None = None
    """Training steps of every skill without ``steps`` of its own; None: its share of
    ``Hierarchy.steps``."""
    selector_steps: AtLeastOne | None = None
    """Training steps of the selector; None: its share, twice that of a skill. A ready selector
    takes none."""
    start_calls: StartCalls = None
    """While a skill trains, its episodes begin after up to this many calls of the skills that can
    act already, a number drawn for each episode: it learns in the states in which it will be
    called. Or names: half of its episodes begin after a call of one of these skills, if it can act
    already; the others begin as usual. None: it starts as soon as it may."""
    search_steps: AtLeastOne | None = None
    """Reset an episode in which the skill cannot start within this many steps. For environments of
    several kinds, where some have nothing for the skill. None: the episode goes on."""
    episode_calls: AtLeastOne = 1
    """The most calls of a skill in an episode, while it trains. After a call that reached its
    ``max_steps`` other skills are called if ``start_calls`` is set, then the skill again, if it may
    start. 1: each call begins with a reset. Evaluations count an episode's first call."""


@settings
class Selection:
    """Settings of the selector's choices, and of the skills under it.

    Raises:
        DeclarationError: a value is out of its range.
    """

    deliberation_cost: NonNegative = 0.0
    """Cost of each decision while the selector learns, in units of reward (a deliberation cost,
    Harb et al. 2018), so that calls which change nothing are worth less. A cost above the
    discounted reward makes long calls best."""
    greedy_skills: bool | None = None
    """True: skills act greedily under the selector. False: they sample. None: greedy where they
    learn apart; where they learn together, episodes of both kinds are played at the end, and the
    better kind is kept. After a training too short for such episodes, they sample."""
    greedy_selector: bool | None = None
    """True: the selector acts greedily after training. False: it samples. None: greedy, unless
    skills and selector learn together and a sampling selector is clearly better at the end: a
    greedy one can call one skill forever."""
    target_return: float | None = None
    """The selector's stage ends early at this mean return of the evaluation while training."""


@settings
class Guide:
    """A ready selector beside one that learns.

    Raises:
        DeclarationError: it has no effect, or a value is out of its range.
    """

    selector: GuideValue
    """A function of observations, an ``Automaton``, or a tree."""
    restrict: bool = True
    """Only skills that the guide may choose are called, in training and afterwards."""
    target_kl: Positive | None = None
    """Keep the selector within this KL of the guide while it learns; None disables this."""

    def __post_init__(self) -> None:
        if self.target_kl is None and not self.restrict:
            raise DeclarationError(
                "the guide has no effect: restrict is False, and target_kl is None"
            )


CallSteps = Annotated[
    AtLeastOne | Lengths | None,
    Check("a whole number of at least 1, Lengths(1, ..., 128), or None"),
]
"""Limits of a call's length."""
SelectorValue = Annotated[
    AlgorithmConfig | ReadyValue,
    Check(
        "the settings of an algorithm, such as PPO(), or a ready selector: a function of "
        "observations, an Automaton or a tree",
        lambda x: not isinstance(x, type),
    ),
]
"""A selector that is trained, or a ready one."""
Learn = Literal["together", "apart", "apart, then together"]
"""Ways of learning: skills and selector from the same steps, one after the other, or both."""
USUAL_CALL_STEPS = 40
"""The default of ``Hierarchy.call_steps``."""


@dataclass(kw_only=True)
class Settings:
    """Settings of a hierarchy, the outermost one or one that is a skill of another.

    ``Hierarchy`` describes them, and has their defaults.
    """

    call_steps: CallSteps
    steps: AtLeastOne | None
    learn: Learn
    algorithm: AlgorithmSettings
    selector: SelectorValue
    reflexes: Sequence[Reflex]
    rest: Any
    apart: Apart
    together: Together
    selection: Selection
    guide: Guide | None


def settings_in(one: Any) -> dict[str, Any]:
    """Return the settings of a declaration, or of a level, by name."""
    return {f.name: getattr(one, f.name) for f in fields(Settings)}
