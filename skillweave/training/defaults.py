"""Defaults of ``train``'s arguments: evaluation while training, checkpoints, the flat baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from skillweave.algorithms.config import AlgorithmSettings
from skillweave.schema import AtLeastOne, Check, annotations_of, fitted, settings

InfoKeys = Annotated[
    Sequence[Annotated[str, Check("a key of info, such as 'distance'", bool)]],
    Check("a list of keys of info, such as ['distance']"),
]
"""Keys of ``info``."""


@settings
class TrainDefaults:
    """Values that ``train`` uses for arguments that its caller leaves out.

    A recipe sets them: ``train_defaults=TrainDefaults(eval_every=50_000)``.

    Raises:
        DeclarationError: a value is out of its range.
    """

    eval_every: AtLeastOne | None = None
    """Environment steps between evaluations while training; None: no evaluations. Their results
    are ``eval_return`` and ``eval_success`` in ``metrics.jsonl``."""
    eval_episodes: AtLeastOne = 20
    """Episodes of each of these evaluations."""
    checkpoint_every: AtLeastOne = 100_000
    """Environment steps between checkpoints."""
    keep: Literal["last", "best"] = "last"
    """What each stage ends with: its last weights, or those with the best periodic evaluation."""
    log_info: InfoKeys = ()
    """Keys of ``info`` whose values at the ends of episodes are logged."""
    log_calls: AtLeastOne | None = None
    """Steps of the log of calls, the latest ones of a stage in which a selector acts; None: no
    log."""
    log_calls_info: InfoKeys = ()
    """Keys of ``info`` in the log of calls."""
    flat: AlgorithmSettings | None = None
    """Settings of the flat baseline; None: the hierarchy's ``algorithm``."""

    def __post_init__(self) -> None:
        for name in ("log_info", "log_calls_info"):
            object.__setattr__(self, name, tuple(dict.fromkeys(getattr(self, name))))

    def given(self, **arguments: Any) -> TrainDefaults:
        """Return these values, replaced by the ``arguments`` that are not None.

        Raises:
            DeclarationError: one of them is wrong; the message calls it by its name alone.
        """
        kinds = annotations_of(TrainDefaults)
        given = {k: fitted(kinds[k], v, k) for k, v in arguments.items() if v is not None}
        return replace(self, **given)
