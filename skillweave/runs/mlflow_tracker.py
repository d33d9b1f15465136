"""Sends metrics, settings and films to MLflow."""

from __future__ import annotations

import importlib
import time
from pathlib import Path
from typing import Any

from skillweave.errors import RunError
from skillweave.messages import told
from skillweave.runs.directory import RunDirectory
from skillweave.terminal import say
from skillweave.types import flat

EXPERIMENT = "skillweave"
TAG = "skillweave.run"
"""The tag of MLflow's run by which a resumed run finds its own again."""
SECONDS = 1.0
"""How long metrics wait, to be sent together."""
MOST = 500
"""Of metrics that are sent at once; MLflow takes 1,000."""
MOST_PARAMS = 100
LONGEST_PARAM = 500


class MLflow:
    """One MLflow run, at MLFLOW_TRACKING_URI or where MLflow keeps its runs by default.

    A resumed run goes on in it, and what it had told already is not told again.

    Args:
        run: what is tracked.
        identifier: the same for this run whenever it goes on, and for no other.

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
            found = self._found(identifier) or self._begun(identifier)
        except Exception as error:  # of whatever store it has
            raise RunError(
                f"MLflow at {mlflow.get_tracking_uri()} does not answer: {told(error)}. Set "
                "MLFLOW_TRACKING_URI, or train without this tracker"
            ) from error
        self._id: str = found.info.run_id
        stages = [stage["name"] for stage in run.manifest["stages"]]
        self._told = {s: found.data.metrics.get(f"{s}/steps", -1.0) for s in stages}

    def _found(self, identifier: str) -> Any:
        """Return the run of MLflow's that this one goes on with; None: it begins."""
        experiment = self._client.get_experiment_by_name(EXPERIMENT)
        if experiment is None:
            self._client.create_experiment(EXPERIMENT)
            return None
        asked = f"tags.`{TAG}` = '{identifier}'"
        found = self._client.search_runs([experiment.experiment_id], asked, max_results=1)
        if not found:
            return None
        self._client.update_run(found[0].info.run_id, status="RUNNING")
        return found[0]

    def _begun(self, identifier: str) -> Any:
        """Return a new run of MLflow's, with the settings."""
        experiment = self._client.get_experiment_by_name(EXPERIMENT)
        manifest, name = self._run.manifest, self._run.path.resolve().name
        tags = {TAG: identifier}
        begun = self._client.create_run(experiment.experiment_id, tags=tags, run_name=name)
        settings = {k: v for k, v in manifest.items() if not isinstance(v, dict | list)}
        for stage in manifest["stages"]:
            settings |= flat(stage["name"], stage.get("algorithm", {}))
        param = importlib.import_module("mlflow.entities").Param
        params = [param(k, str(v)[:LONGEST_PARAM]) for k, v in settings.items()]
        for i in range(0, len(params), MOST_PARAMS):
            self._client.log_batch(begun.info.run_id, params=params[i : i + MOST_PARAMS])
        return begun

    def stage(self, name: str, budget: int) -> None:
        """Nothing to say."""

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Keep every metric, to be sent within a second or so."""
        if steps <= self._told.get(name, -1.0):
            return
        now = int(1000 * time.time())
        for key, value in (metrics | {"steps": steps}).items():
            self._waiting.append(self._metric(f"{name}/{key}", float(value), now, steps))
        if time.monotonic() - self._since > SECONDS or len(self._waiting) > MOST:
            self._send()

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Send what waits."""
        self._send()

    def message(self, text: str) -> None:
        """Messages are not tracked."""

    def film(self, path: Path, steps: int) -> None:
        """Keep the film beside the run's other files."""
        self._client.log_artifact(self._id, str(path), f"films/{steps}")

    def _send(self) -> None:
        """Send what waits, on a thread of MLflow's: training does not wait for an answer."""
        self._since = time.monotonic()
        while self._waiting:
            some, self._waiting = self._waiting[:MOST], self._waiting[MOST:]
            self._sent.append(self._client.log_batch(self._id, metrics=some, synchronous=False))

    def close(self) -> None:
        """Send the rest, and say whether the run is finished; what was not taken is told."""
        status = "FINISHED" if self._run.finished else "KILLED"
        try:
            self._send()
            for sent in self._sent:
                sent.wait()
            self._client.set_terminated(self._id, status)
        except Exception as error:
            text = f"MLflow did not take all metrics (they are in the run's files): {told(error)}"
            say(text)
