"""Trackers that send metrics and films to TensorBoard, Weights & Biases or MLflow."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from skillweave._internal.messages import error_text, suggest
from skillweave._internal.terminal import say
from skillweave.errors import DeclarationError, MissingExtra, RunError
from skillweave.policies.core import flat
from skillweave.runs.directory import RunDirectory
from skillweave.schema import as_json

MLFLOW_EXPERIMENT = "skillweave"
"""The experiment of all runs, in MLflow."""
MLFLOW_TAG = "skillweave.run"
"""The tag that identifies MLflow's run of a resumed run."""
MLFLOW_SECONDS = 1.0
"""The longest time that metrics wait, to be sent together."""
MLFLOW_MOST_METRICS = 500
"""The most metrics that are sent at once; MLflow takes 1,000."""
MLFLOW_MOST_SETTINGS = 100
"""The most settings that are sent at once."""
MLFLOW_LONGEST_SETTING = 500
"""The most characters of a setting's value in MLflow."""


class Listener:
    """Receiver of training's events, which it ignores where a subclass does not define a method."""

    def stage(self, name: str, budget: int) -> None:
        """Handle the start of a stage, or its continuation."""

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Handle the report of an update."""

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Handle the end of a stage."""

    def message(self, text: str) -> None:
        """Show a message to people."""


class Tracker(Listener):
    """A listener of training that sends its events to another program."""

    def film(self, path: Path, steps: int) -> None:
        """Report a film, a GIF or an MP4, after ``steps`` of training."""

    def close(self) -> None:
        """Release the tracker after the last event."""


class TensorBoard(Tracker):
    """A tracker of scalars by environment step, in ``<run>/tensorboard/<stage>``.

    Each stage has a folder, because it counts its steps from 0, and a resumed run purges later
    entries by the number of the step.
    """

    def __init__(self, run: RunDirectory) -> None:
        import torch.utils.tensorboard  # noqa: F401  # raises now, not after hours

        self._path = run.path / "tensorboard"
        self._writers: dict[str, Any] = {}

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Write every metric; a resumed stage's first step replaces all entries from there on."""
        if name not in self._writers:
            from torch.utils.tensorboard import SummaryWriter

            self._writers[name] = SummaryWriter(str(self._path / name), purge_step=steps)
        for key, value in metrics.items():
            self._writers[name].add_scalar(f"{name}/{key}", value, steps)

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Flush the stage's file."""
        if name in self._writers:
            self._writers[name].flush()

    def film(self, path: Path, steps: int) -> None:
        """Write a GIF unchanged; skip an MP4, which TensorBoard cannot show."""
        if path.suffix != ".gif":
            return
        from tensorboard.compat.proto.summary_pb2 import Summary
        from torch.utils.tensorboard import FileWriter

        data = path.read_bytes()
        width, height = struct.unpack("<HH", data[6:10])
        image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=data)
        writer = FileWriter(str(self._path / "film"))
        writer.add_summary(Summary(value=[Summary.Value(tag=path.stem, image=image)]), steps)
        writer.close()

    def close(self) -> None:
        """Close the files."""
        for writer in self._writers.values():
            writer.close()


class WandB(Tracker):
    """A tracker of one Weights & Biases run; offline without a login, for which it never asks.

    A resumed run continues it: its id follows from the run's path and time of creation.
    """

    def __init__(self, run: RunDirectory) -> None:
        import wandb

        self._run: Any = wandb.init(
            project="skillweave",
            name=run.path.name,
            id=identifier(run),
            resume="allow",
            dir=str(run.path),
            config=as_json(run.manifest),
            mode=wandb_mode(),
            settings=wandb.Settings(silent=True),
        )

    def stage(self, name: str, budget: int) -> None:
        """Plot metrics of this stage over its own steps."""
        self._run.define_metric(f"{name}/*", step_metric=f"{name}/steps")

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Log every metric."""
        self._run.log({f"{name}/{k}": v for k, v in (metrics | {"steps": steps}).items()})

    def film(self, path: Path, steps: int) -> None:
        """Log the film, of which Weights & Biases stores a copy."""
        import wandb

        self._run.log({f"film/{path.stem}": wandb.Video(str(path)), "film/steps": steps})

    def close(self) -> None:
        """Finish the run."""
        self._run.finish()


class MLflow(Tracker):
    """One MLflow run, at MLFLOW_TRACKING_URI or in MLflow's default store.

    A resumed run continues it, and does not send its earlier metrics again.

    Raises:
        RunError: MLflow does not answer.
    """

    def __init__(self, run: RunDirectory) -> None:
        mlflow = importlib.import_module("mlflow")
        self._metric = importlib.import_module("mlflow.entities").Metric
        self._run = run
        self._waiting = list[Any]()
        self._sent = list[Any]()
        self._since = time.monotonic()
        try:
            self._client: Any = mlflow.MlflowClient()
            known = self._client.get_experiment_by_name(MLFLOW_EXPERIMENT)
            experiment = (
                self._client.create_experiment(MLFLOW_EXPERIMENT)
                if known is None
                else known.experiment_id
            )
            tag = identifier(run)
            mlflow_run = self._existing(experiment, tag) or self._new(experiment, tag)
        except Exception as error:  # of any store
            raise RunError(
                f"MLflow at {mlflow.get_tracking_uri()} does not answer: {error_text(error)}. Set "
                "MLFLOW_TRACKING_URI, or train without this tracker"
            ) from error
        self._id: str = mlflow_run.info.run_id
        stages = [stage.name for stage in run.manifest.stages]
        self._sent_steps = {s: mlflow_run.data.metrics.get(f"{s}/steps", -1.0) for s in stages}

    def _existing(self, experiment: str, tag: str) -> Any:
        """Return MLflow's run of an earlier part of this run; None: it has none."""
        query = f"tags.`{MLFLOW_TAG}` = '{tag}'"
        runs = self._client.search_runs([experiment], query, max_results=1)
        if not runs:
            return None
        self._client.update_run(runs[0].info.run_id, status="RUNNING")
        return runs[0]

    def _new(self, experiment: str, tag: str) -> Any:
        """Create MLflow's run, with the settings."""
        manifest = self._run.manifest
        created = self._client.create_run(
            experiment,
            tags={MLFLOW_TAG: tag},
            run_name=self._run.path.resolve().name,
        )
        fields = {"kind": manifest.kind} | as_json(manifest) | (as_json(manifest.hierarchy) or {})
        settings = {k: v for k, v in fields.items() if not isinstance(v, dict | list)}
        for stage in manifest.stages:
            settings |= flat(stage.algorithm, f"{stage.name}.")
        param = importlib.import_module("mlflow.entities").Param
        params = [param(k, str(v)[:MLFLOW_LONGEST_SETTING]) for k, v in settings.items()]
        for i in range(0, len(params), MLFLOW_MOST_SETTINGS):
            self._client.log_batch(created.info.run_id, params=params[i : i + MLFLOW_MOST_SETTINGS])
        return created

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Store every metric, to be sent after about a second."""
        if steps <= self._sent_steps.get(name, -1.0):
            return
        now = int(1000 * time.time())
        for key, value in (metrics | {"steps": steps}).items():
            self._waiting.append(self._metric(f"{name}/{key}", float(value), now, steps))
        if (
            time.monotonic() - self._since > MLFLOW_SECONDS
            or len(self._waiting) > MLFLOW_MOST_METRICS
        ):
            self._send()

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Send waiting metrics."""
        self._send()

    def film(self, path: Path, steps: int) -> None:
        """Upload the film as an artifact."""
        self._client.log_artifact(self._id, str(path), f"films/{steps}")

    def _send(self) -> None:
        """Send waiting metrics in a thread of MLflow's, so training does not wait for an answer."""
        self._since = time.monotonic()
        while self._waiting:
            batch = self._waiting[:MLFLOW_MOST_METRICS]
            self._waiting = self._waiting[MLFLOW_MOST_METRICS:]
            self._sent.append(self._client.log_batch(self._id, metrics=batch, synchronous=False))

    def close(self) -> None:
        """Send the rest and the run's status; print a message if metrics were refused."""
        status = "FINISHED" if self._run.finished else "KILLED"
        try:
            self._send()
            for sent in self._sent:
                sent.wait()
            self._client.set_terminated(self._id, status)
        except Exception as error:
            say(
                "MLflow did not take all metrics (they are in the run's files): "
                f"{error_text(error)}"
            )


def identifier(run: RunDirectory) -> str:
    """Return 16 letters that identify a run, also when it is resumed."""
    parts = (str(run.path.resolve()), run.manifest.created, run.manifest.id)
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


MAKE: dict[str, Callable[[RunDirectory], Tracker]] = {
    "tensorboard": TensorBoard,
    "wandb": WandB,
    "mlflow": MLflow,
}
TRACKERS = tuple(MAKE)
"""Names of the trackers, of their modules and of their extras."""


def make_trackers(names: Sequence[str], run: RunDirectory | None) -> tuple[Tracker, ...]:
    """Return the trackers with these names; if ``run`` is None, only check that they can be made.

    Raises:
        DeclarationError: a tracker of this name does not exist.
        RunError: a tracker does not answer.
        MissingExtra: its package is not installed.
    """
    for name in names:
        if name not in TRACKERS:
            raise DeclarationError(f"no tracker {name!r}{suggest(name, TRACKERS)}")
        if importlib.util.find_spec(name) is None:
            raise MissingExtra(f"tracking with {name}", name)
    return () if run is None else tuple(MAKE[name](run) for name in names)


@contextmanager
def trackers_of(run: RunDirectory) -> Iterator[tuple[Tracker, ...]]:
    """Yield the trackers of a run's training, to send later results.

    None if they are not installed: the run was trained on another machine.
    """
    with ExitStack() as stack:
        try:
            trackers = make_trackers(run.manifest.track, run)
        except MissingExtra:
            trackers = ()
        for tracker in trackers:
            stack.callback(tracker.close)
        yield trackers


def track_film(run: RunDirectory, path: Path) -> None:
    """Send a film to the run's trackers."""
    with trackers_of(run) as trackers:
        for tracker in trackers:
            tracker.film(path, steps_of(run))


def steps_of(run: RunDirectory) -> int:
    """Return the environment steps of all stages."""
    return sum(stage.steps or 0 for stage in run.manifest.stages)


def wandb_mode() -> Any:
    """Return WANDB_MODE if it is set; else "online" with a login, "offline" without."""
    login = bool(os.environ.get("WANDB_API_KEY")) or _has_netrc()
    return os.environ.get("WANDB_MODE") or ("online" if login else "offline")


def _has_netrc() -> bool:
    try:
        with open(os.path.expanduser("~/.netrc")) as file:
            return "api.wandb.ai" in file.read()
    except OSError:
        return False
