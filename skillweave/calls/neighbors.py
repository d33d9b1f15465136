"""The nearest logged calls of each choice, by what the skill sees at the start of a call."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from skillweave._internal.messages import error_text, short
from skillweave.errors import DeclarationError
from skillweave.ops.moments import is_constant, scale_of
from skillweave.ops.seen import Seen
from skillweave.policies import plan
from skillweave.policies.core import Array
from skillweave.skills.outputs import Wrapped
from skillweave.spaces import obs_codec, to_tensor

MOST_DISTINCT = 0.9
"""The share of a number's distinct values that are looked for in the shortest interval."""
OUTSIDE = 3.0
"""Lengths of that interval, beside it, beyond which values do not count to the deviation."""
Features = Callable[[Array], Any] | Sequence[int]
"""Features of observations: a function (n, *obs_shape) to (n, F), or places in the flat vector."""

FEATURES = (
    "declare Hierarchy(features=...), or give features= to plan(), chain() or blame(): a function "
    "from observations (n, ...) to numbers (n, F)"
)
"""Advice where images cannot be compared."""


def check_features(features: Any, who: str) -> None:
    """Raise a DeclarationError where features have a wrong type; ``who`` begins the message."""
    each = features.values() if isinstance(features, Mapping) else [features]
    for one in each:
        places = isinstance(one, Sequence | np.ndarray) and not isinstance(one, str | bytes)
        if isinstance(one, type) or not (one is None or callable(one) or places):
            raise DeclarationError(
                f"{who}: features is {short(one)}; give places in the observation, features=[0, 1],"
                " or a function of observations (n, ...) to (n, F), or a dict of these by skill"
            )


class Standard:
    """Values standardised by the mean and deviation of most of the known ones; constants are 0.

    A few values far away do not rule the scale, such as -999 for "not measured".

    Args:
        known: (n, F).
    """

    def __init__(self, known: Array) -> None:
        known = np.asarray(known, np.float64)
        counts = np.ones(known.shape, bool)
        for number, typical in zip(known.T, counts.T, strict=True):
            distinct = np.unique(number)
            most = max(2, int(MOST_DISTINCT * len(distinct)))
            lengths = distinct[most - 1 :] - distinct[: 1 - most]
            if len(lengths):
                half = lengths.min() / 2
                middle = distinct[lengths.argmin()] + half
                typical[:] = np.abs(number - middle) <= (1 + 2 * OUTSIDE) * half
        self.mean, var = known.mean(0, where=counts), known.var(0, where=counts)
        self.moments = torch.from_numpy(self.mean), torch.from_numpy(var)
        self.varies = ~is_constant(*self.moments).numpy()
        self.scale: Array = self.varies / scale_of(*self.moments, eps=0.0).numpy()

    def __call__(self, values: Array) -> Array:
        """Return standardised values (..., F), float64."""
        standard: Array = (values - self.mean) * self.scale
        return standard.clip(-plan.FAR, plan.FAR)


class FeatureMap:
    """Standardised features of observations for one skill.

    Args:
        space: of the observations.
        features: a function, or places; None: all numbers.
        known: (n, *obs_shape), logged observations, by which features are standardised.
        who: the skill, for messages.

    Raises:
        DeclarationError: features have a wrong shape, are not finite, or are all constant.
    """

    def __init__(self, space: gym.Space[Any], features: Any, known: Array, who: str) -> None:
        self._space = space
        self._features = features
        self._who = who
        self._codec = None if callable(features) else obs_codec(space)
        self.places: list[int] | None = None
        """The places in the flat observation; None: the features are a function."""
        if self._codec is not None:
            if self._codec.images and features is None:
                raise DeclarationError(
                    f"{who} sees images, or what a function makes of them, and images have no "
                    f"distance that means something; {FEATURES}"
                )
            self.places = self._checked_places(features, self._codec.size)
        raw = self.raw(known)
        if wrong := np.flatnonzero(~np.isfinite(raw).all(0)).tolist():
            raise DeclarationError(
                f"feature {wrong[0]} of {who} is not finite in the log; leave it out, or clip it"
            )
        standard = Standard(raw)
        at = np.flatnonzero(standard.varies)
        self._standard = plan.Features(
            at, standard.mean[at], standard.scale[at], self.raw, self._check
        )
        self.size = len(at)
        """F, the number of features."""
        if not self.size:
            raise DeclarationError(
                f"all features of {who} are constant in the log, so no call is nearer than "
                "another; give features= that change, or record calls from other states"
            )
        low, high = torch.from_numpy(raw.min(0)), torch.from_numpy(raw.max(0))
        self._seen = Seen(f"the plan with {who}: feature", *standard.moments, low, high, len(raw))

    def __call__(self, obs: Array) -> Array:
        """Return standardised features, (n, F) float32; constant ones are left out."""
        return self._standard(obs)

    @property
    def acting(self) -> plan.Features:
        """The features for a plan that acts: one far beyond the log is named once."""
        function: Callable[..., Any] = self.raw
        if self._codec is None:
            function = Wrapped(self._features, self.raw)
        elif isinstance(self._space, gym.spaces.Box) and not self._codec.images:
            places = np.array(self.places)[self._standard.places]
            return replace(
                self._standard,
                places=places,
                function=None,
                look=lambda numbers: self._notice(numbers[:, self.places].astype(np.float64)),
            )
        return replace(self._standard, function=function, look=self._notice)

    def _notice(self, raw: Array) -> None:
        self._check(raw)
        self._seen.look(torch.from_numpy(raw))

    def _check(self, raw: Array) -> None:
        if not np.isfinite(raw).all():
            raise DeclarationError(
                f"a feature of {self._who} is not finite in an observation; clip it"
            )

    def raw(self, obs: Array) -> Array:
        """Return the features of observations (n, ...) as they are, (n, F) float64."""
        if self._codec is not None:
            vector = self._codec.split(to_tensor(obs))[0].numpy().reshape(len(obs), -1)
            features: Array = vector[:, self.places].astype(np.float64)
            return features
        try:
            value = np.asarray(self._features(obs), np.float64)
        except (Exception, SystemExit) as error:
            raise DeclarationError(
                f"features() of {self._who} raised {error_text(error)}; it must be a function of "
                "observations (n, ...)"
            ) from error
        if value.ndim == 1 and len(value) == len(obs):
            value = value[:, None]
        if value.ndim != 2 or len(value) != len(obs) or not value.shape[1]:
            raise DeclarationError(
                f"features() of {self._who} returned shape {value.shape}, but ({len(obs)}, F) was "
                "expected: a row for each observation"
            )
        return value

    def _checked_places(self, places: Any, size: int) -> list[int]:
        """Return places of features in the flat observation, checked; None: all."""
        if places is None:
            return list(range(size))
        whole = [p for p in places if isinstance(p, int | np.integer) and 0 <= p < size]
        if len(whole) != len(places) or not whole or len(set(whole)) != len(whole):
            raise DeclarationError(
                f"features of {self._who} are {short(places)}; give places from 0 to {size - 1}, "
                "each once, or a function of observations"
            )
        return [int(p) for p in whole]


@lru_cache(64)
def tie_order(count: int) -> Array:
    """Return the order in which equally near logged calls count, (count,) int64.

    It is by chance, but always the same: those of one part of a log would resemble one another.
    """
    return np.random.default_rng(0).permutation(count).argsort()


def evenly(rows: Array, most: int) -> Array:
    """Return at most ``most`` of the rows (n, …), at equal distances."""
    found: Array = rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)]
    return found


def nearest(points: Array, to: Array, count: int, group: Array) -> tuple[Array, Array]:
    """Return the ``count`` nearest points to each row of ``to``, each of another group.

    Args:
        points: (m, F) float32.
        to: (n, F) float32.
        count: the number of points.
        group: (m,) the group of each point; of a group only the nearest point counts.

    Returns:
        Their rows (n, count) int64, the nearest first, of equally near ones the first by
        ``tie_order``; and distances (n, count) float32. Where there are fewer groups, the distance
        is infinite.
    """
    order = tie_order(len(points))
    near, far = plan.nearest(points[order], to, count, group[order])
    return order[near], far
