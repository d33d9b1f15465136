"""Collectors on other machines, by Ray."""

from __future__ import annotations

import ipaddress
import math
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

from skillweave._internal.messages import error_text, short
from skillweave.envs.make import cores
from skillweave.errors import DeclarationError, TrainingError, needs_extra
from skillweave.experience.group import CollectorGroup, MakeCollector, share_of
from skillweave.schema import AtLeastOne, Check, NonNegative, Positive, settings
from skillweave.workers.host import WorkerCollectors, WorkerFactory, Workers
from skillweave.workers.placement import Placement

PATIENCE = 5.0
"""Seconds that an address has to answer."""


@settings
class Ray:
    """Collectors as actors of Ray, on this machine or on a cluster.

    The weights are those of as many collectors in processes (``EnvSpec(workers=8)``), bit for bit
    on processors of one kind, also where actors or nodes are lost on the way.

    ```python
    import skillweave as sw

    cluster = sw.workers.Ray(collectors=8, address="10.0.0.1:6379")
    ```

    Raises:
        DeclarationError: a value is out of its range.
    """

    collectors: AtLeastOne | None = None
    """Number of collectors; they share a stage's environments equally, or a population's members.
    None: as many as there would be processes without Ray. A run keeps the number, as results depend
    on it."""
    address: Annotated[str, Check("a text such as '10.0.0.1:6379'")] | None = None
    """``host:port`` of a cluster's head, ``ray://host:port``, or ``auto``: the one that runs on
    this machine. None: what RAY_ADDRESS says, or else a new one of this machine alone."""
    cpus: Positive = 1.0
    """CPUs of the cluster that each collector takes."""
    patience: NonNegative = 300.0
    """Seconds to wait while the cluster has no room for all collectors, or lost some of it."""

    def check(self) -> None:
        """Raise an error where Ray is not installed, or nothing listens at the address.

        Raises:
            MissingExtra: the extra 'ray' is not installed.
            DeclarationError: the address is none.
            TrainingError: nothing listens there.
        """
        if not imported().is_initialized() and self._where not in ("local", "auto"):
            _must_listen(self._where)

    @property
    def _where(self) -> str:
        return self.address or os.environ.get("RAY_ADDRESS") or "local"

    @contextmanager
    def joined(self, most: int) -> Iterator[Any]:
        """Connect this process to the cluster for a block; yield the module ``ray``.

        Args:
            most: the number of workers that will run at once.

        Raises:
            MissingExtra: the extra 'ray' is not installed.
            DeclarationError: the address is none, or the process is joined to another cluster.
            TrainingError: nothing listens at the address, or another version of Ray or Python.
        """
        self.check()
        ray = imported()
        begun = not ray.is_initialized()
        if begun:
            self._connect(ray, most)
        elif self.address:
            _must_be_joined(ray, self.address)
        try:
            yield ray
        finally:
            if begun:
                ray.shutdown()

    @contextmanager
    def connected(self, most: int, tell: Callable[[str], None]) -> Iterator[Placement]:
        """Connect to the cluster for a block; yield the placement of workers on it.

        Args:
            most: workers that will run at once.
            tell: called with sentences for people.

        Raises:
            SkillweaveError: the kinds of ``joined``.
        """
        with self.joined(most):
            from skillweave.workers.actors import Actors, actor_workers

            actors = Actors(most, self.cpus, self.patience, tell)

            def make_collectors(
                make: MakeCollector, num_envs: int, workers: int, members: int, name: str
            ) -> CollectorGroup:
                """Make collectors as actors of Ray, with equal shares of the environments."""
                each = share_of(num_envs, workers, members, name)
                elsewhere = actor_workers(actors, make, each, workers, name)
                return WorkerCollectors(elsewhere, each, members, name)

            def make_workers(make: WorkerFactory, count: int, name: str) -> Workers:
                return Workers(actor_workers(actors, make, 1, count, name), name)

            try:
                yield Placement(make_collectors, make_workers)
            finally:
                actors.close()

    def _connect(self, ray: Any, most: int) -> None:
        """Connect this process to the cluster by ``ray.init``."""
        address = self._where
        how: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
        if address == "local":  # as many as were asked for, be there cores or not
            room = max(cores(), math.ceil(most * self.cpus))
            how |= {"num_cpus": room, "include_dashboard": False}
        try:
            ray.init(address, **how)
        except ConnectionError as error:
            if address == "auto":
                raise TrainingError(
                    "this machine is part of no Ray cluster that runs. Begin one with: ray start "
                    "--head; or leave 'auto' out, for this machine alone"
                ) from error
            raise TrainingError(
                f"a program listens at {short(address)}, but Ray could not connect "
                f"({error_text(error)}). Perhaps it is no Ray cluster, or one that needs a token, "
                "as those of `ray start` do: then RAY_AUTH_MODE=token is needed here, too (see "
                "Ray's page on token authentication)"
            ) from error
        except (RuntimeError, ValueError) as error:  # another version of Ray or Python
            raise TrainingError(
                f"the Ray cluster at {short(address)} cannot be used: {error_text(error)}"
            ) from error


def imported() -> Any:
    """Import Ray with its own output off, and return it.

    Raises:
        MissingExtra: it is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    # What Ray says of lost actors would go to standard output; ``workers`` reports it.
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", ".")
    with needs_extra("Ray, for collectors on a cluster,", "ray"):
        import ray
    return ray


def _must_be_joined(ray: Any, address: str) -> None:
    """Raise a DeclarationError where this process is joined to a cluster at another address."""
    joined = ray.get_runtime_context().gcs_address
    if address in ("local", "auto") or address.startswith("ray://"):  # a client's port is another
        return
    (mine, _, port), (theirs, _, joined_port) = address.rpartition(":"), joined.rpartition(":")
    # One machine has many names, so hosts are compared only where both are numbers.
    if port != joined_port or (_is_outside(mine) and _is_outside(theirs) and mine != theirs):
        raise DeclarationError(
            f"Ray: address is {short(address)}, but this process is joined to the cluster at "
            f"{joined} already. Leave the address out, or call ray.shutdown() before"
        )


def _is_outside(host: str) -> bool:
    """Return whether a host's number is not one of this machine."""
    try:
        return not ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _must_listen(address: str) -> None:
    """Raise a TrainingError where nothing listens: Ray itself would try for minutes."""
    host, sign, port = address.removeprefix("ray://").rpartition(":")
    if not sign or not host or not port.isdigit() or not 0 < int(port) < 65_536:
        raise DeclarationError(
            f"Ray: address is {short(address)}; write host:port (that of the head, usually with "
            "6379), ray://host:port, or auto"
        )
    try:
        socket.create_connection((host.strip("[]"), int(port)), PATIENCE).close()
    except OSError as error:
        why = error.strerror or str(error)
        raise TrainingError(
            f"no program listens at {address} ({why}), so there is no Ray cluster. Start one with: "
            "ray start --head; or leave the address out, for this machine alone"
        ) from error
