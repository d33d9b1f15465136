"""The arguments of ``train`` and ``resume`` as data; the methods describe them.

``tests/test_signatures.py`` compares them with the methods and the command line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.api.starting import StartFrom
from skillweave.errors import DeclarationError
from skillweave.evolution.evolving import Evolve
from skillweave.schema import Count, fitted
from skillweave.training.callback import Callback, check_callback
from skillweave.workers.cluster import Ray


@dataclass(frozen=True)
class TrainOptions:
    """Arguments of a training; ``Hierarchy.train`` describes them.

    Raises:
        DeclarationError: one of them is wrong, or two do not fit together.
    """

    run_dir: str | Path | None = None
    resume: bool = False
    overwrite: bool = False
    seed: int = 0
    eval_every: int | None = None
    eval_episodes: int | None = None
    checkpoint_every: int | None = None
    keep: Literal["last", "best"] | None = None
    log_info: Sequence[str] | None = None
    log_calls: int | None = None
    log_calls_info: Sequence[str] | None = None
    quiet: bool = False
    callback: Callback | None = None
    evolve: Evolve = None
    cluster: Ray | None = None
    track: Sequence[str] = ()
    start_from: StartFrom = None
    data: Any = None
    flat: bool | AlgorithmConfig = False

    def __post_init__(self) -> None:
        check_callback(self.callback)
        fitted(Ray | None, self.cluster, "cluster")
        for name, kind in (("resume", bool), ("overwrite", bool), ("seed", Count)):
            object.__setattr__(self, name, fitted(kind, getattr(self, name), name))
        track = fitted(str | Sequence[str], self.track, "track")
        object.__setattr__(self, "track", (track,) if isinstance(track, str) else tuple(track))
        for word in ("resume", "overwrite"):
            if getattr(self, word) and self.run_dir is None:
                raise DeclarationError(
                    f'{word}=True needs a run: name its directory, train("runs/a", {word}=True)'
                )
        if self.resume and self.overwrite:
            raise DeclarationError(
                "resume continues the run in run_dir, and overwrite replaces it: leave out one of "
                "them"
            )
