"""Collectors as actors of Ray: on this machine, or on any node of a cluster.

Parameters go into Ray's object store once for each request, however many workers read them;
batches come back through it. An actor that dies, alone or with its node, is recreated (``workers``)
wherever there is room.
"""

from __future__ import annotations

import platform
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import deepcopy
from importlib import metadata
from time import monotonic
from typing import Any

import ray
from ray import exceptions
from ray.util.placement_group import (
    placement_group,
    placement_group_table,
    remove_placement_group,
)
from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy

from skillweave._internal.messages import error_text
from skillweave.errors import TrainingError, make_error
from skillweave.workers.actor_host import COMPUTING, actor_class
from skillweave.workers.host import Worker, WorkerFactory, WorkerLost
from skillweave.workers.shipping import packed

PATIENCE = 1.0
"""Seconds that actors have to close their environments."""
LOOK = 3.0
"""Seconds between looks at whether there is room for an actor that has not begun."""
LOST = (
    exceptions.RayActorError, exceptions.ObjectLostError, exceptions.NodeDiedError,
    exceptions.WorkerCrashedError, exceptions.OutOfMemoryError,
)  # fmt: skip
FULL = exceptions.ObjectStoreFullError, exceptions.OutOfDiskError


class Actors:
    """The actors of a run, kept from stage to stage; each holds one collector.

    Args:
        count: the most actors at once; the cluster keeps room for them.
        cpus: of each.
        patience: seconds to wait while the cluster has no room for them.
        tell: called with sentences for people.
    """

    def __init__(
        self, count: int, cpus: float, patience: float, tell: Callable[[str], None]
    ) -> None:
        self.count = count
        self.cpus = cpus
        self.patience = patience
        self.tell = tell
        self._kind: Any = ray.remote(num_cpus=cpus, max_restarts=0)(actor_class())
        self._group = placement_group([{"CPU": cpus}] * count)
        self._actors: dict[int, Any] = {}
        self._waited, self._told = 0.0, False
        self._told_versions = set[str]()

    def get(self, number: int) -> Any:
        """Return an actor; make it where it does not exist."""
        if number not in self._actors:
            where = PlacementGroupSchedulingStrategy(self._group, number)
            self._actors[number] = self._kind.options(scheduling_strategy=where).remote()
        return self._actors[number]

    def end(self, number: int) -> None:
        """End an actor, if it exists."""
        if number in self._actors:
            with suppress(Exception):  # perhaps there is no cluster any more
                ray.kill(self._actors.pop(number))

    def let_close(self) -> None:
        """Let the actors close their environments; end those that do not."""
        with suppress(Exception):  # perhaps there is no cluster any more
            closed = {actor.close.remote(): number for number, actor in self._actors.items()}
            for late in ray.wait(list(closed), num_returns=len(closed), timeout=PATIENCE)[1]:
                self.end(closed[late])

    def close(self) -> None:
        """End all actors."""
        for number in list(self._actors):
            self.end(number)
        with suppress(Exception):
            remove_placement_group(self._group)

    def tell_versions(self, there: dict[str, Any]) -> None:
        """Report once for each node which packages differ in version from this machine's."""
        found = differing_versions(there)
        if found and there["node"] not in self._told_versions:
            self._told_versions.add(there["node"])
            self.tell(
                f"node {there['node']} of the Ray cluster has {found}: where the same versions are "
                "on all nodes, a run gives the same weights again"
            )

    def wait_for(self, ref: Any) -> None:
        """Wait until an actor has answered.

        Raises:
            TrainingError: there was no room for it for too long.
        """
        began = monotonic()
        while not ray.wait([ref], timeout=LOOK)[0]:
            now = monotonic()
            if placement_group_table(self._group)["state"] == "CREATED":  # it is only slow
                began = now
                continue
            self._waited = self._waited + now - began
            began = now
            total = ray.cluster_resources().get("CPU", 0.0)
            free = ray.available_resources().get("CPU", 0.0)
            says = (
                f"{self.count} collectors need {self.count * self.cpus:g} CPUs of the Ray cluster; "
                f"it has {total:g}, of which {free:g} are free"
            )
            if self._waited > self.patience:
                raise TrainingError(
                    f"{says}, and waiting {self.patience:g} s for more was in vain. Ask for fewer "
                    "collectors, give each less (cpus), or add nodes"
                )
            if not self._told:
                self._told = True
                self.tell(f"{says}: waiting up to {self.patience:g} s for more (Ctrl-C stops)")
        self._waited, self._told = 0.0, False


class ActorWorker(Worker):
    """A collector in an actor.

    Args:
        actors: where.
        code: the packed function that makes the collector, in the object store.
        each: its environments.
        number: of the worker, and of its actor.
        alone: no answers of other workers are joined with its own.
    """

    tries = 5  # one may be made again on a node of which Ray does not know yet that it is lost

    def __init__(self, actors: Actors, code: Any, each: int, number: int, alone: bool) -> None:
        self._actors = actors
        self._code = code
        self._each = each
        self._number = number
        self._alone = alone
        self._due = deque[Any]()
        self._lost = ""
        self.place: dict[str, Any] = {}
        """The actor's node, process and versions."""
        self._versions: Any = None

    def begin(self) -> None:
        """Request an actor, which makes the collector."""
        if self._lost:
            self._actors.tell(f"worker {self._number} {self._lost}; it is made again")
        actor = self._actors.get(self._number)
        self._versions = actor.versions.remote()
        self._due = deque([actor.make.remote(self._code, self._each, self._number)])

    def send(self, what: str, task: Any) -> None:
        """Send a task to the actor."""
        self._due.append(self._actors.get(self._number).answer.remote(what, task))

    def receive(self) -> Any:
        """Return the actor's next answer."""
        ref = self._due.popleft()
        try:
            if self._versions is not None:
                self._actors.wait_for(self._versions)
                self.place = ray.get(self._versions)
                check_versions(self.place)
                self._actors.tell_versions(self.place)
                self._versions = None
            error, answer = ray.get(ref)
        except LOST as lost:
            self._lost = _how(lost)
            raise WorkerLost(self._lost) from None
        except FULL as full:
            raise _full(full) from full
        if error is not None:
            raise make_error(*error)
        # Arrays of the object store cannot be written to; joining several copies them.
        return deepcopy(answer) if self._alone else answer

    def release(self) -> None:
        """End the actor."""
        self._due.clear()
        self._actors.end(self._number)

    def release_all(self, workers: Sequence[Any]) -> None:
        """Let the actors close their environments; end those that do not."""
        self._actors.let_close()

    def shared(self, task: Any) -> Any:
        """Return a reference to the task in the object store."""
        return _put(task)


def actor_workers(
    actors: Actors, make: WorkerFactory, each: int, count: int, name: str
) -> list[ActorWorker]:
    """Return workers in actors; ``make`` is sent to the nodes with the user's code that it needs.

    Args:
        actors: where.
        make: makes the collector of each.
        each: environments of a worker.
        count: W.
        name: the environment's name in messages.
    """
    code = _put(packed(make, f"what collectors of {name} are made of"))
    return [ActorWorker(actors, code, each, i, count == 1) for i in range(count)]


def _put(thing: Any) -> Any:
    try:
        return ray.put(thing)
    except FULL as full:
        raise _full(full) from full


def _full(error: Exception) -> TrainingError:
    """Return the error of a full object store of a Ray cluster."""
    return TrainingError(
        f"the object store of the Ray cluster is full ({error_text(error)}). Batches "
        "go through it: give it more memory (ray start --object-store-memory=BYTES), or ask for "
        "less at once (num_envs, n_steps)"
    )


def check_versions(there: dict[str, Any]) -> None:
    """Raise a TrainingError where a node runs something else."""
    here = {"Skillweave": metadata.version("skillweave"), "Python": platform.python_version()}
    for name, mine in here.items():
        theirs = there[name]
        if theirs is None:
            raise TrainingError(
                f"node {there['node']} of the Ray cluster has no {name}: install the same version "
                f"on all nodes, {mine}"
            )
        digits = 2 if name == "Python" else None
        if theirs.split(".")[:digits] != mine.split(".")[:digits]:
            raise TrainingError(
                f"node {there['node']} of the Ray cluster has {name} {theirs}, but here is {mine}: "
                "all nodes need the same"
            )


def differing_versions(there: dict[str, Any]) -> str:
    """Return the packages that a node has in another version, in words; none: an empty text."""
    found = []
    for package in COMPUTING:
        try:
            here = metadata.version(package)
        except metadata.PackageNotFoundError:
            here = None
        if there[package] != here:
            found.append(f"{package} {there[package] or 'missing'} (here {here or 'missing'})")
    return ", ".join(found)


def _how(lost: Exception) -> str:
    """Return words on the end of a Ray actor."""
    if isinstance(lost, exceptions.OutOfMemoryError):
        return "was ended by Ray, as its node was short of memory"
    if isinstance(lost, exceptions.ActorUnavailableError):
        return "is out of reach"
    return "was lost with its node" if "its node has died" in str(lost) else "died"
