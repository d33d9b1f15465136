"""The tracker that sends metrics, settings and films to MLflow.

Stands alone because it is an implementation of ``Tracker`` with its own protocol of resuming.
"""

from __future__ import annotations

import importlib
import time
from pathlib import Path
from typing import Any

from skillweave.errors import RunError
from skillweave.messages import error_text
from skillweave.runs.directory import RunDirectory
from skillweave.terminal import say
from skillweave.types import flat

EXPERIMENT = "skillweave"
TAG = "skillweave.run"
"""The tag that identifies MLflow's run of a resumed run."""
SECONDS = 1.0
"""The longest time that metrics wait, to be sent together."""
MOST = 500
"""The most metrics that are sent at once; MLflow takes 1,000."""
MOST_PARAMS = 100
LONGEST_PARAM = 500


class MLflow:
    """One MLflow run, at MLFLOW_TRACKING_URI or in MLflow's default store.

    A resumed run continues it, and does not send its earlier metrics again.

    Args:
        run: the tracked run.
        identifier: identifies this run, also when it is resumed.

    Raises:
        RunError: MLflow does not answer.
    """

    def __init__(self, run: RunDirectory, identifier: str) -> None:
        mlflow = importlib.import_module("mlflow")
        self._metric = importlib.import_module("mlflow.entities").Metric
        self._run, self._waiting, self._sent = run, list[Any](), list[Any]()
        self._since = time.monotonic()
        try:
            self._client: Any = mlflow.MlflowClient()
            mlflow_run = self._existing(identifier) or self._new(identifier)
        except Exception as error:  # of any store
            raise RunError(
                f"MLflow at {mlflow.get_tracking_uri()} does not answer: {error_text(error)}. Set "
                "MLFLOW_TRACKING_URI, or train without this tracker"
            ) from error
        self._id: str = mlflow_run.info.run_id
        stages = [stage["name"] for stage in run.manifest["stages"]]
        self._sent_steps = {s: mlflow_run.data.metrics.get(f"{s}/steps", -1.0) for s in stages}

    def _existing(self, identifier: str) -> Any:
        """Return MLflow's run of an earlier part of this run; None: it has none."""
        experiment = self._client.get_experiment_by_name(EXPERIMENT)
        if experiment is None:
            self._client.create_experiment(EXPERIMENT)
            return None
        query = f"tags.`{TAG}` = '{identifier}'"
        runs = self._client.search_runs([experiment.experiment_id], query, max_results=1)
        if not runs:
            return None
        self._client.update_run(runs[0].info.run_id, status="RUNNING")
        return runs[0]

    def _new(self, identifier: str) -> Any:
        """Create MLflow's run, with the settings."""
        experiment = self._client.get_experiment_by_name(EXPERIMENT)
        manifest, name = self._run.manifest, self._run.path.resolve().name
        tags = {TAG: identifier}
        created = self._client.create_run(experiment.experiment_id, tags=tags, run_name=name)
        settings = {k: v for k, v in manifest.items() if not isinstance(v, dict | list)}
        for stage in manifest["stages"]:
            settings |= flat(stage["name"], stage.get("algorithm", {}))
        param = importlib.import_module("mlflow.entities").Param
        params = [param(k, str(v)[:LONGEST_PARAM]) for k, v in settings.items()]
        for i in range(0, len(params), MOST_PARAMS):
            self._client.log_batch(created.info.run_id, params=params[i : i + MOST_PARAMS])
        return created

    def stage(self, name: str, budget: int) -> None:
        """Do nothing."""

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Store every metric, to be sent after about a second."""
        if steps <= self._sent_steps.get(name, -1.0):
            return
        now = int(1000 * time.time())
        for key, value in (metrics | {"steps": steps}).items():
            self._waiting.append(self._metric(f"{name}/{key}", float(value), now, steps))
        if time.monotonic() - self._since > SECONDS or len(self._waiting) > MOST:
            self._send()

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Send waiting metrics."""
        self._send()

    def message(self, text: str) -> None:
        """Do nothing: messages are not tracked."""

    def film(self, path: Path, steps: int) -> None:
        """Upload the film as an artifact."""
        self._client.log_artifact(self._id, str(path), f"films/{steps}")

    def _send(self) -> None:
        """Send waiting metrics in a thread of MLflow's, so training does not wait for an answer."""
        self._since = time.monotonic()
        while self._waiting:
            batch, self._waiting = self._waiting[:MOST], self._waiting[MOST:]
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
