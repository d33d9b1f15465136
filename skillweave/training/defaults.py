"""Defaults of ``train``'s arguments: evaluation while training, checkpoints, the flat baseline."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.arguments import checked_names
from skillweave.messages import short
from skillweave.training.checks import check_algorithm, check_fields
from skillweave.types import SkillweaveError


@checked_names
@dataclass(frozen=True)
class TrainDefaults:
    """Values that ``train`` uses for arguments that its caller leaves out.

    A recipe sets them: ``train_defaults=TrainDefaults(eval_every=50_000)``.

    Raises:
        SkillweaveError: a value is out of its range.
    """

    eval_every: int | None = None
    """Environment steps between evaluations while training; None: no evaluations. Their results
    are ``eval_return`` and ``eval_success`` in ``metrics.jsonl``."""
    eval_episodes: int = 20
    """Episodes of each of these evaluations."""
    checkpoint_every: int = 100_000
    """Environment steps between checkpoints."""
    flat: AlgorithmConfig | None = None
    """Settings of the flat baseline; None: the hierarchy's ``algorithm``."""

    def __post_init__(self) -> None:
        check_fields(self)
        check_algorithm(self.flat, "flat", optional=True)

    def given(self, **arguments: Any) -> TrainDefaults:
        """Return these values, replaced by the ``arguments`` that are not None."""
        return replace(self, **{k: v for k, v in arguments.items() if v is not None})


def check_defaults(value: object) -> None:
    """Raise a SkillweaveError where ``train_defaults`` is something else."""
    if not isinstance(value, TrainDefaults):
        raise SkillweaveError(
            f"train_defaults is {short(value)}; write train_defaults=TrainDefaults(eval_every=...)"
        )
