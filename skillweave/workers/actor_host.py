"""The actor on a node of a Ray cluster, which holds a collector."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from contextlib import suppress
from importlib import metadata
from typing import Any

import numpy as np
import ray

from skillweave.workers.host import SentError, WorkerHost, error_to_send
from skillweave.workers.shipping import unpacked

COMPUTING = "torch", "numpy", "gymnasium", "envpool", "mujoco"
"""Packages of which another version may compute other numbers."""


def actor_class() -> type:
    """Return the class of actors.

    It is sent to the nodes by its code, so that it can tell of a node without Skillweave.
    """
    packages = COMPUTING

    class CollectorActor:
        def versions(self) -> dict[str, Any]:
            """Return the versions of this node's packages, and the node."""
            found: dict[str, Any] = {"node": ray.util.get_node_ip_address()}
            found |= {"process": os.getpid(), "Python": platform.python_version()}
            for package in (*packages, "skillweave"):
                try:
                    found[package] = metadata.version(package)
                except metadata.PackageNotFoundError:
                    found[package] = None
            return found | {"Skillweave": found.pop("skillweave")}

        def make(self, code: bytes, each: int, number: int) -> Any:
            """Make the collector in this actor; return (error, None)."""
            try:
                from skillweave.workers.actor_host import ActorHost
            except ImportError as error:
                return ("TrainingError", str(error)), None
            self.stationed = ActorHost()
            return self.stationed.make(code, each, number)

        def answer(self, what: str, task: Any) -> Any:
            """Do a task in this actor; return (error, answer)."""
            return self.stationed.answer(what, task)

        def close(self) -> None:
            """Close the environments, if there are any."""
            if hasattr(self, "stationed"):
                self.stationed.close()

    return CollectorActor


class ActorHost:
    """The host of a collector in an actor; it returns errors as answers."""

    station: WorkerHost | None = None

    def make(self, code: bytes, each: int, number: int) -> tuple[SentError | None, None]:
        """Make the collector; return (error, None)."""
        import torch

        torch.set_num_threads(1)

        def made() -> None:
            self.station = WorkerHost(unpacked(code), each, number)

        return _tried(made)

    def answer(self, what: str, task: Any) -> tuple[SentError | None, Any]:
        """Do a task in the collector; return (error, answer)."""
        if isinstance(task, dict):  # a state; arrays of the object store cannot be written to
            task = {k: np.array(v) for k, v in task.items()}
        station: Any = self.station
        return _tried(lambda: station.answer(what, task))

    def close(self) -> None:
        """Close the environments, if there are any."""
        station = self.station
        self.station = None
        if station is not None:
            with suppress(Exception):
                station.collector.close()


def _tried(do: Callable[[], Any]) -> tuple[SentError | None, Any]:
    try:
        return None, do()
    except BaseException as error:
        return error_to_send(error), None
