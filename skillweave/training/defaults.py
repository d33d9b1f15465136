"""Defaults of ``train``'s arguments: evaluation while training, checkpoints, the flat baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Annotated, Any, Literal

from skillweave.algorithms.config import AlgorithmSettings
from skillweave.schema import AtLeastOne, Check, annotations_of, fitted, settings
from skillweave.training.options import CallReports, Reports

InfoKeys = Annotated[
    Sequence[Annotated[str, Check("a key of info, such as 'distance'", bool)]],
    Check("a list of keys of info, such as ['distance']"),
]
"""Keys of ``info``."""


@settings
class TrainDefaults(CallReports):
    """Values that ``train`` uses for arguments that its caller leaves out.

    A recipe sets them: ``train_defaults=TrainDefaults(eval_every=50_000)``.

    Raises:
        DeclarationError: a value is out of its range.
    """

    eval_every: AtLeastOne | None = None
    eval_episodes: AtLeastOne = 20
    checkpoint_every: AtLeastOne = 100_000
    keep: Literal["last", "best"] = "last"
    log_info: InfoKeys = ()
    log_calls: AtLeastOne | None = None
    log_calls_info: InfoKeys = ()
    flat: AlgorithmSettings | None = None
    """Settings of the flat baseline; None: the hierarchy's ``algorithm``."""

    def __post_init__(self) -> None:
        for name in ("log_info", "log_calls_info"):
            object.__setattr__(self, name, tuple(dict.fromkeys(getattr(self, name))))

    def given(self, options: Reports) -> TrainDefaults:
        """Return these values, replaced by the ``options`` that are not None.

        Raises:
            DeclarationError: one of them is wrong; the message calls it by its name alone.
        """
        kinds = annotations_of(TrainDefaults)
        return replace(
            self,
            **{
                f.name: fitted(kinds[f.name], value, f.name)
                for f in fields(CallReports)
                if (value := getattr(options, f.name, None)) is not None
            },
        )

    def entries(self, kind: type[Reports]) -> dict[str, Any]:
        """Return the fields of a run's manifest for the options of a ``kind``."""
        return {f.name: getattr(self, f.name) for f in fields(kind)}
