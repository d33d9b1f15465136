"""Defaults of ``train``'s arguments: evaluation while training, checkpoints, the flat baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.arguments import checked_names
from skillweave.errors import SkillweaveError
from skillweave.messages import short
from skillweave.training.checks import check_algorithm, check_fields


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
    keep: Literal["last", "best"] = "last"
    """What each stage ends with: its last weights, or those with the best periodic evaluation."""
    log_info: Sequence[str] = ()
    """Keys of ``info`` whose values at the ends of episodes are logged."""
    flat: AlgorithmConfig | None = None
    """Settings of the flat baseline; None: the hierarchy's ``algorithm``."""

    def __post_init__(self) -> None:
        check_fields(self)
        check_algorithm(self.flat, "flat", optional=True)
        if self.keep not in ("last", "best"):
            raise SkillweaveError(f"keep is {short(self.keep)}; it must be 'last' or 'best'")
        object.__setattr__(self, "log_info", _checked_keys(self.log_info))

    def given(self, **arguments: Any) -> TrainDefaults:
        """Return these values, replaced by the ``arguments`` that are not None."""
        return replace(self, **{k: v for k, v in arguments.items() if v is not None})


def _checked_keys(keys: object) -> tuple[str, ...]:
    """Return names of keys as a tuple, each once.

    Raises:
        SkillweaveError: they are something else.
    """
    if isinstance(keys, str) or not isinstance(keys, Sequence):
        example = keys if isinstance(keys, str) and keys else "key"
        raise SkillweaveError(
            f"log_info is {short(keys)}; it must be a list of keys: log_info=[{example!r}]"
        )
    for key in keys:
        if not isinstance(key, str) or not key:
            raise SkillweaveError(
                f"log_info has {short(key)}; each must be a key of info, such as 'distance'"
            )
    return tuple(dict.fromkeys(keys))


def check_defaults(value: object) -> None:
    """Raise a SkillweaveError where ``train_defaults`` is something else."""
    if not isinstance(value, TrainDefaults):
        raise SkillweaveError(
            f"train_defaults is {short(value)}; write train_defaults=TrainDefaults(eval_every=...)"
        )
