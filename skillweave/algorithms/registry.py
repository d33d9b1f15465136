"""The registry of algorithms: those of this library, and those that users register."""

from __future__ import annotations

import importlib
from dataclasses import is_dataclass
from typing import Any, cast

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave.algorithms.base import REQUIRED, Algorithm
from skillweave.algorithms.config import (
    BUILT_IN,
    AlgorithmConfig,
    OffPolicy,
    OnPolicy,
    Registration,
    add_registration,
    registration_of,
)
from skillweave.errors import DeclarationError, EnvError

MOST_BYTES = 8_000_000_000
"""The most bytes of the observations of a batch, as float32 numbers."""
_SETTINGS: dict[str, type[Any]] = {"rollout": OnPolicy, "replay": OffPolicy}


@checked_names
def register_algorithm(config_type: type[Any], algorithm_type: type[Algorithm]) -> None:
    """Register an algorithm under the name of its settings.

    It can then train plain agents, skills, selectors and populations, and its settings are written
    to and read from files. Every process that uses it must register it, so call this in the file
    that defines it. The same name may be registered again: the latest counts.

    Args:
        config_type: a frozen dataclass on ``OnPolicy`` (``store = "rollout"``) or ``OffPolicy``
            (``store = "replay"``).
        algorithm_type: a subclass of ``Algorithm`` that is made with
            ``(config, observation_space, action_space)``.

    Raises:
        DeclarationError: a method or a class attribute is missing; the message names it. Or the
            name belongs to this library.
    """
    name = config_type.__name__
    where = f"register_algorithm({name}, {algorithm_type.__name__})"
    if not issubclass(algorithm_type, Algorithm):
        raise DeclarationError(
            f"{where}: {algorithm_type.__name__} is no subclass of skillweave.algorithms.Algorithm"
        )
    lacks = [k for k in REQUIRED if getattr(algorithm_type, k) is getattr(Algorithm, k)]
    lacks += [k for k in ("store", "action_spaces") if not hasattr(algorithm_type, k)]
    if lacks:
        raise DeclarationError(
            f"{where}: {algorithm_type.__name__} lacks {', '.join(lacks)}; see "
            "skillweave.algorithms.Algorithm"
        )
    settings = _SETTINGS.get(algorithm_type.store)
    if settings is None:
        raise DeclarationError(
            f"{where}: {algorithm_type.__name__}.store is {algorithm_type.store!r}; it must be "
            "'rollout' or 'replay'"
        )
    frozen = is_dataclass(config_type) and cast(Any, config_type).__dataclass_params__.frozen
    if not (frozen and issubclass(config_type, settings)):
        raise DeclarationError(
            f"{where}: {name} must be a frozen dataclass on {settings.__name__}, because "
            f"{algorithm_type.__name__}.store is {algorithm_type.store!r}"
        )
    if name in BUILT_IN:
        raise DeclarationError(f"{where}: {name} is an algorithm of this library; use another name")
    add_registration(Registration(config_type, algorithm_type, algorithm_type.action_spaces))


def make_algorithm(config: AlgorithmConfig, observation_space: Any, action_space: Any) -> Algorithm:
    """Create the algorithm of these settings on one pair of spaces.

    Raises:
        DeclarationError: the algorithm is not registered, or cannot act in these spaces; the
            message names algorithms that can.
        EnvError: a batch of observations would need too much memory.
    """
    kind = registration_of(config).algorithm
    if isinstance(kind, str):
        module, name = kind.split(":")
        kind = getattr(importlib.import_module(module), name)
    _check_batch(config, observation_space)
    return cast(Algorithm, kind(config, observation_space, action_space))


def _check_batch(config: AlgorithmConfig, space: Any) -> None:
    """Raise an EnvError where the largest batch of observations needs too much memory.

    Images are not counted, as they are smaller than what networks make of them.
    """
    network = getattr(config, "network", None)
    if getattr(network, "sees", None) is not None or getattr(network, "encoder", None) is not None:
        return
    from skillweave.spaces import obs_codec

    replay = getattr(config, "batch_size", 1)
    rows = config.num_envs * config.n_steps if isinstance(config, OnPolicy) else replay
    most = max(rows, config.num_envs)
    numbers = obs_codec(space).size
    needed = most * numbers * 4
    if needed > MOST_BYTES:
        smaller = "num_envs or n_steps" if isinstance(config, OnPolicy) else "batch_size"
        raise EnvError(
            f"observation space {short(space)} is {numbers:,} numbers to a network, choices "
            f"one-hot, and {type(config).__name__} computes with {most:,} observations at once: "
            f"{needed / 1e9:,.1f} GB, more than {MOST_BYTES / 1e9:g}. Wrap the environment so that "
            "it gives fewer numbers (a position as coordinates, an id as its features), or lower "
            f"{smaller}"
        )
