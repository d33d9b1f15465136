"""Collectors that run elsewhere: their tasks, and the recreation of lost ones.

A collector is a function of its state and of what it is asked for. So a lost worker, a
process or a machine, is recreated from its last state and repeats the requests since then; the
result is identical.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from skillweave._internal.messages import error_text
from skillweave._internal.seeding import Seeds
from skillweave.envs.engine import checksums
from skillweave.errors import SkillweaveError, TrainingError, kind_of, reworded
from skillweave.experience.acting import Request
from skillweave.experience.collector import Collected
from skillweave.experience.group import CollectorGroup, joined_states, split_states
from skillweave.policies.core import Array

SNAPSHOT_EVERY = 16
"""Requests after which workers say where they stand, so that less need be done again."""


WorkerFactory = Callable[[int, int], Any]
"""Makes what stands at a worker and does its tasks, as ``MakeCollector`` makes a collector."""


SentError = tuple[str, str]
"""The kind of an error and its message, as a worker sends them."""


def error_to_send(error: BaseException) -> SentError:
    """Return the kind of an error and its message; the environment's own errors are EnvErrors."""
    if isinstance(error, SkillweaveError):
        return kind_of(error), str(error)
    return "TrainingError" if isinstance(error, MemoryError) else "EnvError", error_text(error)


class WorkerLost(Exception):
    """The error of a worker whose process or machine has ended; the message says why."""


class Worker:
    """A worker elsewhere, which has a collector: it does one task after another."""

    tries = 1
    """Number of times that a lost worker is made again before a request fails."""
    who = ""
    """Its name in messages; ``Workers`` gives it."""

    def begin(self) -> None:
        """Start the worker, which makes its collector; ``receive`` then returns None."""
        raise NotImplementedError

    def send(self, what: str, task: Any) -> None:
        """Send a task to the worker; see ``WorkerHost.answer``.

        Raises:
            WorkerLost: it has ended.
        """
        raise NotImplementedError

    def receive(self) -> Any:
        """Return the answer to the oldest task that has none.

        Raises:
            WorkerLost: it has ended.
            SkillweaveError: the collector failed; the kind and the message are those of its error.
        """
        raise NotImplementedError

    def release(self) -> None:
        """End the worker, if it has not ended."""
        raise NotImplementedError

    def release_all(self, workers: Sequence[Any]) -> None:
        """End workers of this kind, this one among them."""
        for worker in workers:
            worker.release()

    def shared(self, task: Any) -> Any:
        """Return a task as it is sent to several workers of its kind."""
        return task


class WorkerHost:
    """The object at a worker that answers tasks: a collector, or part of a population.

    Args:
        each: its environments, if it is a collector.
        number: of the worker.
    """

    def __init__(self, make: WorkerFactory, each: int, number: int) -> None:
        self.number = number
        self.collector = make(each, number * each)

    def answer(self, what: str, task: Any) -> Any:
        """Do a task by the method of the collector, or part of a population, of its name.

        Args:
            what: "collect", "start", "state", "restore" or "finish", of a collector; "train",
                "fitness", "state" or "restore", of a part of a population.
            task: the method's argument; a request is for all workers. None: it has none.
        """
        match what:
            case "collect":
                return self._collect(task)
            case "start":
                return self.collector.start(task)
            case "state":
                return self.collector.state()
            case "restore":
                return self.collector.restore(task)
            case "finish":
                return self.collector.finish()
            case "train":
                return self.collector.train(task)
            case "fitness":
                return self.collector.fitness(task)
        raise AssertionError(f"no worker is asked for {what!r}")

    def _collect(self, task: Request) -> Collected:
        """Return this worker's part of a request, with checksums of where it stands then."""
        found: Collected = self.collector.collect(task.of_collector(self.number))
        kept = self.collector.kept  # where few observations are possible, they alone tell little
        about = np.column_stack([kept["age"], kept["sums"]])
        found.checksums = checksums(self.collector.obs) + checksums(about)
        return found


class LocalWorker(Worker):
    """A worker in this thread: it does a task when its answer is requested.

    Args:
        each: its environments, if it has a collector.
        number: of the worker.
    """

    def __init__(self, make: WorkerFactory, each: int, number: int) -> None:
        self._make = make
        self._each = each
        self._number = number
        self._station: WorkerHost | None = None
        self._due = deque[tuple[str, Any]]()

    def begin(self) -> None:
        """Queue the making of the collector; ``receive`` then returns None."""
        self._due.append(("", None))

    def send(self, what: str, task: Any) -> None:
        """Queue a task for the collector."""
        self._due.append((what, task))

    def receive(self) -> Any:
        """Return the answer to the oldest task that has none."""
        what, task = self._due.popleft()
        if self._station is None:
            self._station = WorkerHost(self._make, self._each, self._number)
            return None
        return self._station.answer(what, task)

    def release(self) -> None:
        """Close the collector in this thread."""
        station = self._station
        self._station = None
        if station is not None:
            station.collector.close()


class Workers:
    """Workers that do tasks at the same time; lost ones are made again.

    Args:
        workers: W of them, of one kind.
        name: what messages call the environment.
        each: environments of a worker, which messages name; 0: it has none of its own.
        repeated: called with a task and the answers of the workers that were made again and have
            repeated it, by their numbers; None: nobody needs these.

    Raises:
        SkillweaveError: a task failed; the kind is the kind of its error.
        TrainingError: a worker was lost again and again at the same place; the message names it.
    """

    def __init__(
        self,
        workers: Sequence[Worker],
        name: str,
        each: int = 0,
        repeated: Callable[[str, dict[int, Any]], None] | None = None,
    ) -> None:
        self._workers = list(workers)
        self._repeated = repeated
        for number, worker in enumerate(workers):
            worker.who = f"{name}: worker {number}"
            if each:
                worker.who += f" (environments {number * each} to {(number + 1) * each - 1})"
        self.past: list[tuple[str, Sequence[Any]]] = []
        """What brings workers to where they stand: a start or states, then tasks."""
        try:
            for worker in self._workers:
                worker.begin()
            self._completed(self._received(range(len(workers))), [])
        except BaseException:
            self.close()
            raise

    def ask(self, what: str, tasks: Sequence[Any], kept: bool = True) -> list[Any]:
        """Return the workers' answers, each to a task of its own; lost workers are recreated.

        Args:
            kept: the tasks change where workers stand.
        """
        path = [*self.past, (what, tasks)]
        if kept:
            self.past = path
        return self._completed(self._asked(range(len(self._workers)), what, tasks), path)

    def ask_once(self, what: str) -> None:
        """Ask for something; workers that are lost in it are not made again."""
        self._asked(range(len(self._workers)), what, [None] * len(self._workers))

    def states(self) -> list[dict[str, Array]]:
        """Return the workers' states, from which lost ones are made again from now on."""
        states: list[dict[str, Array]] = self.ask("state", [None] * len(self._workers), kept=False)
        self.past = [("restore", states)]
        return states

    def restore(self, states: Sequence[dict[str, Array]]) -> list[Array]:
        """Restore the open episodes of each worker; return environments that start again."""
        self.past = []
        return self.ask("restore", states)

    def close(self) -> None:
        """End the workers."""
        self._workers[0].release_all(self._workers)

    def _completed(
        self, found: dict[int, Any], path: Sequence[tuple[str, Sequence[Any]]]
    ) -> list[Any]:
        """Return the answers of all workers; those that are not in ``found`` are recreated."""
        tries = self._workers[0].tries
        for tried in range(1, tries + 1):
            if lost := [i for i in range(len(self._workers)) if i not in found]:
                found |= self._again(lost, path, must=tried == tries)
        return [found[i] for i in range(len(self._workers))]

    def _again(
        self, numbers: list[int], path: Sequence[tuple[str, Sequence[Any]]], must: bool
    ) -> dict[int, Any]:
        """Make lost workers again, and let them repeat the tasks that the others have done."""
        for i in numbers:
            self._workers[i].release()
        for i in numbers:
            self._workers[i].begin()
        found = self._received(numbers, must)
        for at, (what, tasks) in enumerate(path, 1):
            found = self._asked(found, what, tasks, must)
            if at < len(path) and self._repeated is not None:
                self._repeated(what, found)
        return found

    def _asked(
        self, numbers: Iterable[int], what: str, tasks: Sequence[Any], must: bool = False
    ) -> dict[int, Any]:
        """Return the answers of some workers, without those that are lost."""
        numbers = list(numbers)
        for i in numbers:
            with suppress(WorkerLost):  # that is found out when it should answer
                self._workers[i].send(what, tasks[i])
        return self._received(numbers, must)

    def _received(self, numbers: Iterable[int], must: bool = False) -> dict[int, Any]:
        """Return the answers of some workers; ``must``: none may be lost."""
        found = {}
        for i in numbers:
            try:
                found[i] = self._workers[i].receive()
            except WorkerLost as lost:
                if must:
                    again = f"{self._workers[i].who} {lost}, and again when it was made again"
                    raise TrainingError(again) from None
            except SkillweaveError as error:
                raise reworded(error, f"{error} (in worker {i})") from error
        return found


class WorkerCollectors(CollectorGroup):
    """Collectors elsewhere, each with as many environments.

    Args:
        workers: W of them.
        each: environments of a worker.
        members: P.
        name: the environment's name in messages.
    """

    def __init__(self, workers: Sequence[Worker], each: int, members: int, name: str) -> None:
        super().__init__(each * len(workers), members)
        self._workers = workers
        none = np.empty(0, np.int64)
        self._checksums = [none] * len(workers)  # of each, after what was collected last
        self._restarted = [none] * len(workers)  # of each, what did not repeat itself
        self._together = Workers(workers, name, each, self._note_restarted)

    def start(self, seeds: Seeds) -> None:
        """Start every environment, unless they have started."""
        if not self._together.past:
            self._together.ask("start", [seeds / number for number in range(len(self._workers))])

    def collect(self, request: Request) -> Collected:
        """Step each environment ``request.rows`` times, and return the joined rows."""
        task = self._workers[0].shared(request)
        answers: list[Collected] = self._together.ask("collect", [task] * len(self._workers))
        self._checksums = [answer.checksums for answer in answers]  # type: ignore[misc]
        found = replace(self._joined(answers), restarted=self.take_restarted())
        if len(self._together.past) > SNAPSHOT_EVERY:
            self._together.states()
        return found

    def state(self) -> dict[str, Array]:
        """Return what ``restore`` needs. Only a worker that is lost meanwhile can change."""
        return joined_states(self._together.states())

    def restore(self, state: dict[str, Array]) -> Array:
        """Restore the open episodes of ``state``; return (k,) environments that start again."""
        return self._columns(self._together.restore(split_states(state, len(self._workers))))

    def take_restarted(self) -> Array:
        """Return the environments (k,) that could not be restored with a lost worker, each once."""
        found = self._columns(self._restarted)
        none = np.empty(0, np.int64)
        self._restarted = [none] * len(self._restarted)
        self.restarts += len(found)
        return found

    def finish(self) -> None:
        """Check at the end of training what it has left in the environments.

        A worker that is lost in it is not made again: the training result is there.
        """
        self._together.ask_once("finish")

    def close(self) -> None:
        """End the workers."""
        self._together.close()

    def _note_restarted(self, what: str, found: dict[int, Any]) -> None:
        """Note which environments of workers that were made again stand elsewhere now."""
        for i, answer in found.items():
            if what == "restore":
                self._restarted[i] = answer
            elif what == "collect":
                self._restarted[i] = np.flatnonzero(answer.checksums != self._checksums[i])
