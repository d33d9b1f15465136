"""Trackers that send metrics and films to TensorBoard, Weights & Biases or MLflow."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import re
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from skillweave._internal.messages import error_text, short, suggest
from skillweave._internal.notices import notice
from skillweave.errors import DeclarationError, MissingExtra, RunError
from skillweave.policies.core import flat
from skillweave.runs.directory import RunDirectory
from skillweave.schema import as_json

WANDB_PROJECT = "skillweave"
"""The project of all runs, in W&B."""
WANDB_LONGEST_NAME = 128
"""The most characters of a run's name in W&B."""
WANDB_SEVERAL = (0, 19, 10)
"""The first version of wandb in which a program can have several runs open."""
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
MLFLOW_LONGEST_NAME = 250
"""The most characters of the name of a metric or a setting in MLflow."""
MLFLOW_LONGEST_KEY = 180
"""The most characters of a key of ``info`` in such a name."""
MLFLOW_REFUSED = re.compile(r"[^\w.\- /]" if os.name == "nt" else r"[^\w.\- /:]")
"""A character that MLflow refuses in names."""


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

    A resumed run continues it: its id follows from the run's path and time of creation. A run that
    the program has open stays open and as it is. Only if it is one of a sweep, whose agent reads
    its metrics, this tracker logs into it.

    Raises:
        RunError: W&B does not answer.
    """

    def __init__(self, run: RunDirectory) -> None:
        import wandb

        outer: Any = wandb.run
        several = _numbers(wandb.__version__) >= WANDB_SEVERAL
        self._is_outer = outer is not None and (bool(outer.sweep_id) or not several)
        if outer is not None and not run.finished:
            notice(_about_outer(outer, self._is_outer))
        if self._is_outer:
            self._run: Any = outer
            return
        beside: dict[str, Any] = {} if outer is None else {"reinit": "create_new"}
        try:
            self._run = wandb.init(
                project=WANDB_PROJECT,
                name=run.path.name[:WANDB_LONGEST_NAME],
                id=identifier(run),
                resume="allow",
                dir=str(run.path),
                config=as_json(run.manifest),
                mode=wandb_mode(),
                settings=wandb.Settings(silent=True),
                **beside,
            )
        except Exception as error:  # of any server
            raise RunError(
                f"W&B does not answer: {error_text(error)}. Set WANDB_MODE=offline, or train "
                "without this tracker"
            ) from error

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
        """Finish the run, unless it is the program's."""
        if not self._is_outer:
            self._run.finish()


def _about_outer(outer: Any, is_used: bool) -> str:
    """Return a sentence on a run of W&B that the program has open."""
    name = f"the W&B run {outer.name or outer.id!r}"
    if not is_used:
        return (
            f"{name} is open and stays as it is; the metrics of this training go into a run of "
            f"their own, in the project {WANDB_PROJECT!r}"
        )
    why = "it is one of a sweep"
    if not outer.sweep_id:
        why = f"wandb before {'.'.join(map(str, WANDB_SEVERAL))} has one run at a time"
    return f"the metrics of this training go into {name}, which stays open: {why}"


def _numbers(version: str) -> tuple[int, ...]:
    """Return the first three numbers of a version."""
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])


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
        self._keys = mlflow_keys(run.manifest.log_info)
        changed = [f"{short(k)} is {short(v)}" for k, v in self._keys.items() if k != v]
        if changed and not run.finished:
            notice(
                "MLflow refuses some letters and lengths in names, so of log_info there "
                f"{', '.join(changed)}"
            )
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
        params = [
            param(_shortened(k), str(v)[:MLFLOW_LONGEST_SETTING]) for k, v in settings.items()
        ]
        for i in range(0, len(params), MLFLOW_MOST_SETTINGS):
            self._client.log_batch(created.info.run_id, params=params[i : i + MLFLOW_MOST_SETTINGS])
        return created

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Store every metric, to be sent after about a second."""
        if steps <= self._sent_steps.get(name, -1.0):
            return
        now = int(1000 * time.time())
        for key, value in (metrics | {"steps": steps}).items():
            self._waiting.append(
                self._metric(self._name(f"{name}/{key}"), float(value), now, steps)
            )
        if (
            time.monotonic() - self._since > MLFLOW_SECONDS
            or len(self._waiting) > MLFLOW_MOST_METRICS
        ):
            self._send()

    def _name(self, name: str) -> str:
        """Return the name of a metric in MLflow."""
        for key, accepted in self._keys.items():
            if name.endswith(f"/info/{key}"):
                return _shortened(name.removesuffix(key) + accepted)
        return _shortened(name)

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
        """Send the rest and the run's status; raise the first error of what was refused."""
        status = "FINISHED" if self._run.finished else "KILLED"
        errors = list[Exception]()
        self._send()
        for sent in self._sent:
            try:
                sent.wait()
            except Exception as error:  # of any store; the other metrics are sent
                errors.append(error)
        self._client.set_terminated(self._id, status)
        if errors:
            raise errors[0]


def mlflow_keys(keys: Iterable[str]) -> dict[str, str]:
    """Return for keys of ``info`` what is in their place in MLflow's names, each another one."""
    names = {key: _accepted(key) for key in keys}
    used = {key for key, name in names.items() if key == name}
    for key, name in names.items():
        if key == name:
            continue
        number = 1
        while names[key] in used:
            number += 1
            names[key] = f"{name}_{number}"
        used.add(names[key])
    return names


def _accepted(key: str) -> str:
    """Return a key as MLflow takes it: without letters that it refuses, and no path like a/../b."""
    parts = MLFLOW_REFUSED.sub("_", key)[:MLFLOW_LONGEST_KEY].split("/")
    return "/".join("_" if part in ("", ".", "..") else part for part in parts)


def _shortened(name: str) -> str:
    """Return a name that is not too long for MLflow; of a long one its end is a checksum."""
    if len(name) <= MLFLOW_LONGEST_NAME:
        return name
    return f"{name[: MLFLOW_LONGEST_NAME - 9]}_{hashlib.sha256(name.encode()).hexdigest()[:8]}"


class Guarded(Tracker):
    """A tracker whose errors end no training: a notice gives the first one.

    Args:
        name: of the tracker, for the notice.
        tracker: receives the events.
    """

    def __init__(self, name: str, tracker: Tracker) -> None:
        self._name = name
        self._tracker = tracker
        self._failed = False

    def _attempt(self, function: Callable[..., None], *values: Any) -> None:
        """Call the tracker; the first error becomes a notice, and training continues."""
        try:
            function(*values)
        except Exception as error:  # of any tracker: no network, a full disk, a closed run
            if not self._failed:
                notice(
                    f"{self._name} did not take everything ({error_text(error)}); all metrics are "
                    "in the run's files"
                )
            self._failed = True

    def stage(self, name: str, budget: int) -> None:
        """Forward the start of a stage to the tracker."""
        self._attempt(self._tracker.stage, name, budget)

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Forward the report of an update to the tracker."""
        self._attempt(self._tracker.tick, name, steps, seconds, metrics)

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Forward the end of a stage to the tracker."""
        self._attempt(self._tracker.done, name, steps, seconds, metrics)

    def film(self, path: Path, steps: int) -> None:
        """Forward a film to the tracker."""
        self._attempt(self._tracker.film, path, steps)

    def close(self) -> None:
        """Release the tracker."""
        self._attempt(self._tracker.close)


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
    if run is None:
        return ()
    trackers = list[Tracker]()
    for name in names:
        try:
            trackers.append(Guarded(name, MAKE[name](run)))
        except BaseException:
            for tracker in trackers:
                tracker.close()
            raise
    return tuple(trackers)


@contextmanager
def trackers_of(run: RunDirectory) -> Iterator[tuple[Tracker, ...]]:
    """Yield the trackers of a run's training, to send later results.

    None if they are not installed: the run was trained on another machine. Or if one does not
    answer, which a notice says: the results are in the run's files.
    """
    with ExitStack() as stack:
        trackers: tuple[Tracker, ...] = ()
        try:
            trackers = make_trackers(run.manifest.track, run)
        except MissingExtra:
            pass
        except RunError as error:
            notice(str(error))
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
    """Return whether ``wandb login`` has stored a key: without one, W&B asks for it and waits."""
    try:
        with open(os.path.expanduser("~/.netrc")) as file:
            return "api.wandb.ai" in file.read()
    except OSError:
        return False
