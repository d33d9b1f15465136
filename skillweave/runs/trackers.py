"""Sends metrics to TensorBoard or Weights & Biases, besides ``metrics.jsonl``."""

from __future__ import annotations

import hashlib
import importlib.util
import os
from collections.abc import Sequence
from typing import Any

from skillweave.runs.directory import RunDirectory
from skillweave.types import MissingExtra, SkillweaveError

TRACKERS = ("tensorboard", "wandb")


class TensorBoard:
    """Scalars by environment step, under ``<run>/tensorboard``, in a folder for each stage.

    A folder each, because every stage counts its steps from 0, and what a resumed run replaces is
    purged by the number of the step.
    """

    def __init__(self, run: RunDirectory) -> None:
        import torch.utils.tensorboard  # noqa: F401  # fails here, not after hours

        self._path = run.path / "tensorboard"
        self._writers: dict[str, Any] = {}

    def stage(self, name: str, budget: int) -> None:
        """Nothing to say."""

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Write every metric; a resumed stage's first one takes the place of all from there on."""
        if name not in self._writers:
            from torch.utils.tensorboard import SummaryWriter

            self._writers[name] = SummaryWriter(str(self._path / name), purge_step=steps)
        for key, value in metrics.items():
            self._writers[name].add_scalar(f"{name}/{key}", value, steps)

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Flush."""
        if name in self._writers:
            self._writers[name].flush()

    def message(self, text: str) -> None:
        """Messages are not tracked."""

    def close(self) -> None:
        """Close the files."""
        for writer in self._writers.values():
            writer.close()


class WandB:
    """One Weights & Biases run; offline if there is no login. It never asks for one.

    A resumed run goes on in it: its id follows from the run's path, and from when it was begun.
    """

    def __init__(self, run: RunDirectory) -> None:
        import wandb

        self._run: Any = wandb.init(
            project="skillweave",
            name=run.path.name,
            id=_identifier(run),
            resume="allow",
            dir=str(run.path),
            config=run.manifest,
            mode=wandb_mode(),
            settings=wandb.Settings(silent=True),
        )

    def stage(self, name: str, budget: int) -> None:
        """Metrics of this stage are drawn over its own steps."""
        self._run.define_metric(f"{name}/*", step_metric=f"{name}/steps")

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Log every metric."""
        self._run.log({f"{name}/{k}": v for k, v in (metrics | {"steps": steps}).items()})

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Weights & Biases needs nothing here."""

    def message(self, text: str) -> None:
        """Messages are not tracked."""

    def close(self) -> None:
        """Finish the run."""
        self._run.finish()


def _identifier(run: RunDirectory) -> str:
    """The same for a run and for what resumes it, and for no other."""
    told = (str(run.path.resolve()), run.manifest["created"], run.manifest.get("id"))
    return hashlib.sha256(repr(told).encode()).hexdigest()[:16]


def make_trackers(
    names: Sequence[str], run: RunDirectory | None
) -> tuple[TensorBoard | WandB, ...]:
    """The trackers with these names; if ``run`` is None, only check that they can be made.

    Raises:
        SkillweaveError: no such tracker.
        MissingExtra: its package is not installed.
    """
    for name in names:
        if name not in TRACKERS:
            raise SkillweaveError(f"no tracker {name!r}; there are: {', '.join(TRACKERS)}")
        if importlib.util.find_spec(name) is None:
            raise MissingExtra(f"tracking with {name}", name)
    if run is None:
        return ()
    return tuple(TensorBoard(run) if name == "tensorboard" else WandB(run) for name in names)


def wandb_mode() -> Any:
    """The value of WANDB_MODE if it is set; else online if there is a login, else offline."""
    login = bool(os.environ.get("WANDB_API_KEY")) or _has_netrc()
    return os.environ.get("WANDB_MODE") or ("online" if login else "offline")


def _has_netrc() -> bool:
    try:
        with open(os.path.expanduser("~/.netrc")) as file:
            return "api.wandb.ai" in file.read()
    except OSError:
        return False
