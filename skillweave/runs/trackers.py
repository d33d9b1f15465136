"""Sends metrics to TensorBoard or Weights & Biases, besides ``metrics.jsonl``."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Sequence
from typing import Any

from skillweave.runs.directory import RunDirectory
from skillweave.types import MissingExtra, SkillweaveError

TRACKERS = ("tensorboard", "wandb")


class TensorBoard:
    """Scalars by environment step, under ``<run>/tensorboard``."""

    def __init__(self, run: RunDirectory) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer: Any = SummaryWriter(str(run.path / "tensorboard"))

    def stage(self, name: str, budget: int) -> None:
        """Nothing to say."""

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Write every metric."""
        for key, value in metrics.items():
            self._writer.add_scalar(f"{name}/{key}", value, steps)

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Flush."""
        self._writer.flush()

    def message(self, text: str) -> None:
        """Messages are not tracked."""

    def close(self) -> None:
        """Close the files."""
        self._writer.close()


class WandB:
    """One Weights & Biases run; offline if there is no login. It never asks for one."""

    def __init__(self, run: RunDirectory) -> None:
        import wandb

        self._run: Any = wandb.init(
            project="skillweave",
            name=run.path.name,
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
