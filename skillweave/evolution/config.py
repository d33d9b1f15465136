"""Settings of evolution; this module does not import torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, field, fields
from typing import Annotated, Any, Literal, TypedDict, get_args

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.algorithms.schedules import is_schedule
from skillweave.errors import DeclarationError
from skillweave.networks.config import Activation
from skillweave.schema import AtLeastOne, Check, Fraction, NonNegative, check, fit, settings

Scale = Literal["linear", "log", "complement"]
KINDS = ("none", "hyperparameters", "parameters", "architecture", "activation")
"""The kinds of mutation; ``Mutations`` has a probability of each."""


@settings
class Range:
    """The range of a setting, and the scale on which it mutates.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    low: float
    """The smallest value."""
    high: float
    """The largest value."""
    scale: Scale = "log"
    """linear; log: ratios count; complement: ratios of 1 − x count (γ, λ)."""

    def __post_init__(self) -> None:
        check(self, "high", self.low < self.high, f"more than low ({self.low})")
        if self.scale == "log":
            check(self, "low", self.low > 0.0, "positive on a log scale")
        if self.scale == "complement":
            check(self, "high", self.high < 1.0, "below 1 as a complement")

    def to_unit(self, value: float) -> float:
        """Return the position of a ``value`` between low (0) and high (1)."""
        low, high, x = (self._scaled(v) for v in (self.low, self.high, value))
        return (x - low) / (high - low)

    def from_unit(self, unit: float) -> float:
        """Return the value at position ``unit``, clipped to the range."""
        low, high = self._scaled(self.low), self._scaled(self.high)
        x = low + min(1.0, max(0.0, unit)) * (high - low)
        value = {"linear": x, "log": math.exp(x), "complement": 1.0 - math.exp(-x)}[self.scale]
        return min(self.high, max(self.low, value))

    def _scaled(self, value: float) -> float:
        if self.scale == "linear":
            return value
        return math.log(value) if self.scale == "log" else -math.log(1.0 - value)


USUAL: dict[str, Range] = {
    "learning_rate": Range(1e-5, 1e-2),
    "gamma": Range(0.9, 0.9999, "complement"),
    "gae_lambda": Range(0.8, 0.99, "complement"),
    "clip_coef": Range(0.05, 0.5),
    "ent_coef": Range(1e-5, 0.1),
    "vf_coef": Range(0.1, 2.0),
    "max_grad_norm": Range(0.1, 20.0),
    "batch_size": Range(16, 4096),
    "update_epochs": Range(1, 16),
    "n_steps": Range(8, 1024),
    "update_ratio": Range(0.05, 4.0),
    "tau": Range(0.001, 1.0),
    "exploration_noise": Range(0.01, 1.0),
    "target_noise": Range(0.01, 1.0),
    "target_noise_clip": Range(0.1, 1.0),
    "policy_delay": Range(1, 8),
    "target_update_interval": Range(1, 1000),
    "exploration_final_eps": Range(0.001, 0.2),
    "target_kl": Range(0.002, 0.1),
}
"""All settings that can mutate, and their default ranges."""
_MUTATED = ("learning_rate", "gamma", "gae_lambda", "clip_coef", "ent_coef", "tau")
"""Settings that mutate by default: they never split a stack."""


Limits = Annotated[
    tuple[AtLeastOne, AtLeastOne],
    Check("(fewest, most) in this order, each at least 1", lambda x: x[0] <= x[1]),
]
"""Fewest and most."""
Activations = Annotated[
    tuple[Activation, ...], Check(f"some of {', '.join(get_args(Activation))}", bool)
]
"""At least one nonlinearity."""


@settings
class Mutations:
    """Probabilities of the kinds of change of an heir, of which one happens.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    none: Fraction = 0.2
    """No change."""
    hyperparameters: Fraction = 0.4
    """One setting moves within its range."""
    parameters: Fraction = 0.1
    """Gaussian noise on a share of the policy's weights."""
    architecture: Fraction = 0.2
    """Units or a layer are added or removed; growth does not change the function."""
    activation: Fraction = 0.1
    """Another nonlinearity."""
    ranges: Mapping[str, Range] | None = None
    """Ranges by setting; None: learning_rate, gamma and others, if the start value is within."""
    strength: NonNegative = 0.1
    """Deviation of the noise on weights, in units of the deviation of the layer's weights."""
    share: Fraction = 0.1
    """Share of the weights that get noise."""
    step: Fraction = 0.1
    """The step of a setting, up or down, as a share of its range."""
    layer_share: Fraction = 0.2
    """Share of architecture mutations that add or remove a layer; the others change units."""
    layers: Limits = (1, 3)
    """Fewest and most hidden layers."""
    units: Limits = (16, 256)
    """Fewest and most units of a hidden layer."""
    channels: Limits = (8, 64)
    """Fewest and most channels of a convolution."""
    kernels: Limits = (1, 8)
    """Smallest and largest kernel of a convolution; changes keep the size of all outputs."""
    activations: Activations = ("tanh", "relu", "elu", "silu")
    """Nonlinearities to choose from."""

    def __post_init__(self) -> None:
        total = sum(getattr(self, name) for name in KINDS)
        if abs(total - 1.0) > 1e-6:
            raise DeclarationError(
                f"Mutations: the probabilities {', '.join(KINDS)} sum to {total:g}; "
                "they must sum to 1"
            )

    def ranges_of(self, config: AlgorithmConfig, *, start: bool = True) -> dict[str, Range]:
        """Return the ranges of an algorithm's settings.

        Args:
            config: the algorithm's settings.
            start: members begin with its values, so these must be within the ranges.

        Returns:
            By setting, its range.

        Raises:
            DeclarationError: a setting does not exist, or a range excludes the start value.
        """
        settings = {f.name for f in fields(config)}
        learnt = {"ent_coef"} if getattr(config, "learn_ent_coef", False) else set()
        scheduled = is_schedule(getattr(config, "learning_rate", 0.0))
        if self.ranges is None:
            fixed = learnt | ({"learning_rate"} if scheduled else set())
            usual = {k: USUAL[k] for k in _MUTATED if k in settings - fixed}
            return {k: r for k, r in usual.items() if r.low <= getattr(config, k) <= r.high}
        for name, limits in self.ranges.items():
            kind = type(config).__name__
            if name not in settings or name not in USUAL:
                can = ", ".join(k for k in USUAL if k in settings - learnt)
                raise DeclarationError(
                    f"Mutations.ranges: {kind} has no setting {name!r} that can mutate; "
                    f"those that can: {can}"
                )
            if name in learnt:
                raise DeclarationError(
                    f"Mutations.ranges: {kind} learns {name} (learn_{name}=True), so a mutation "
                    f"would have no effect: omit it, or set learn_{name}=False"
                )
            if name == "learning_rate" and scheduled:
                raise DeclarationError(
                    f"Mutations.ranges: {kind}.learning_rate is a schedule, which cannot mutate: "
                    "omit it, or give a number"
                )
            value = getattr(config, name)
            if start and (value is None or not limits.low <= value <= limits.high):
                raise DeclarationError(
                    f"Mutations.ranges[{name!r}] is {limits.low:g} to {limits.high:g}, which "
                    f"excludes the start value {kind}.{name} = {value}"
                )
        return dict(self.ranges)


@settings
class Tournament:
    """A selection in which each heir's parent is the best of a few members drawn at random.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    size: AtLeastOne = 2
    """Members in a tournament."""
    elitism: bool = True
    """The best member continues unchanged."""


@settings
class Truncation:
    """A selection that replaces the worst members by heirs of the best (Jaderberg et al. 2017).

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    share: Annotated[float, Check("more than 0 and at most 0.5", lambda x: 0 < x <= 0.5)] = 0.25
    """The share of members that are replaced, and that are parents."""


@settings
class Evolution:
    """A population in place of one agent: it trains, is compared, selected and mutated.

    ```python
    from skillweave.evolution import Evolution, Mutations, Range

    ranges = {"learning_rate": Range(1e-4, 1e-2)}
    search = Evolution(population=4, generations=5, mutations=Mutations(ranges=ranges))
    ```

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    population: AtLeastOne = 8
    """Members."""
    generations: AtLeastOne = 20
    """The number of comparisons; the rest of the budget is shared evenly between them."""
    episodes: AtLeastOne = 10
    """Episodes whose mean return is a member's fitness; all members play the same ones, in at most
    as many environments as in training (``num_envs``)."""
    target: float | None = None
    """Fitness at which evolution ends early; None: never."""
    start: Literal["config", "random"] = "config"
    """Members begin with the declared settings, or with settings drawn from the ranges."""
    selection: Any = field(default_factory=Tournament)
    """Tournament(), Truncation(), or your own: see ``ParentSelection``."""
    mutations: Mutations = field(default_factory=Mutations)
    """The changes from parent to heir."""

    def __post_init__(self) -> None:
        if isinstance(self.selection, Tournament) and self.selection.elitism:
            check(self, "population", self.population > 1, "at least 2 with Tournament.elitism")
        if isinstance(self.selection, Tournament):
            fits = self.selection.size <= self.population
            check(self, "population", fits, f"at least Tournament.size ({self.selection.size})")
        if not isinstance(self.selection, Tournament | Truncation):
            able = callable(getattr(self.selection, "select", None))
            check(self, "selection", able, "Tournament(), Truncation() or have select()")


def evolution_to_json(evolution: Evolution) -> dict[str, Any]:
    """Convert an evolution to plain JSON; a selection of the user becomes its name."""
    data = asdict(evolution)
    data["selection"] = {"kind": type(evolution.selection).__name__}
    if isinstance(evolution.selection, Tournament | Truncation):
        data["selection"] |= asdict(evolution.selection)
    return data


def evolution_from_json(data: Mapping[str, Any], where: str, selection: Any = None) -> Evolution:
    """Read the JSON of ``evolution_to_json``; ``selection`` is the user's, which it lacks.

    Raises:
        DeclarationError: an unknown field, a value of another type or out of range, or the
            selection is missing.
    """
    values: dict[str, Any] = fit(dict[str, Any], data, where, "evolution")
    chosen: dict[str, Any] = fit(_Selection, values.get("selection"), where, "evolution.selection")
    kind = chosen.pop("kind")
    known: dict[str, Any] = {"Tournament": Tournament, "Truncation": Truncation}
    if kind not in known and type(selection).__name__ != kind:
        raise DeclarationError(
            f"{where} evolves by a selection of your own, {kind[:60]}; pass it: "
            f"resume(..., evolve=Evolution(selection={kind[:60]}(), ...))"
        )
    if kind in known:
        selection = fit(known[kind], chosen, where, "evolution.selection")
    evolution: Evolution = fit(Evolution, values | {"selection": selection}, where, "evolution")
    return evolution


class _Selection(TypedDict):
    """The name of a selection in JSON; further fields are its settings."""

    kind: str
