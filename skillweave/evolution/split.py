"""A population in several parts, each at a worker: a process, or an actor of Ray.

A part is a ``Shard``: its places stay at its worker, members are sent there and back in each
generation. Results depend on the number of parts, but not on their workers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds, seed_global_generators
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.config import AlgorithmConfig, config_from_json, config_to_json
from skillweave.evolution.shard import FitnessEnvs, OnGenerationTick, Shard
from skillweave.evolution.stacks import Member
from skillweave.experience.group import joined_states, split_states
from skillweave.policies.core import Array
from skillweave.training.episodes import EpisodeTally
from skillweave.training.learning_task import LearningTask
from skillweave.workers.placement import MakeWorkers

Sent = tuple[int, dict[str, Any], int, dict[str, Array]]
"""A member as a message: number, settings as JSON, steps, tensors of its state."""


Task = tuple[list[Sent], int, int, Seeds]
"""The members that train at a part, and the next three arguments of ``Shard.train``."""
Ticks = list[tuple[int, dict[str, float]]]


class Parts:
    """Shards of a population at workers, with the interface of one ``Shard``.

    Args:
        make_workers: creates their workers.
        learning_task, config, seeds: see ``Shard``.
        count: the number of places.
        parts: the number of parts; their sizes differ by at most one.
        episodes: episodes whose mean return is a member's fitness.
    """

    store = None
    rounds = 0

    def __init__(
        self,
        make_workers: MakeWorkers,
        learning_task: LearningTask,
        config: AlgorithmConfig,
        seeds: Seeds,
        count: int,
        parts: int,
        episodes: int,
    ) -> None:
        self._bounds = [count * i // parts for i in range(parts + 1)]
        self.num_envs = count * config.num_envs
        self._each = config.num_envs
        self.steps_elsewhere = 0
        """Environment steps of fitness measurements in other processes."""
        self.tally = EpisodeTally()
        """The tally of logged keys of ``info``."""
        make = partial(_make_host, learning_task, _alone(config), seeds, self._bounds, episodes)
        self._workers = make_workers(make, parts, learning_task.role.spec.name)
        self._closed = False

    def train(
        self,
        members: Sequence[Member],
        until: int,
        schedule_steps: int,
        seeds: Seeds,
        on_tick: OnGenerationTick,
    ) -> None:
        """Train members until each has ``until`` steps; report ticks when all parts are done."""
        groups = self._divided(members)
        tasks: list[Task] = [(_sent(group), until, schedule_steps, seeds) for group in groups]
        before = 0
        self.tally = EpisodeTally()
        results = self._workers.ask("train", tasks)
        for group, (trained, ticks, tally) in zip(groups, results, strict=True):
            for steps, metrics in ticks:
                on_tick(before + steps, dict(metrics))
            self.tally.add(tally)
            for member, (_, _, steps, state) in zip(group, trained, strict=True):
                before += steps - member.steps
                member.state = type(member.state)(**_tensors(state))
                member.steps = steps

    def fitness(self, members: Sequence[Member], eval_envs: FitnessEnvs, seeds: Seeds) -> Array:
        """Return fitness as ``Shard.fitness`` does, each part in its own environments."""
        tasks = [(_sent(group), seeds) for group in self._divided(members)]
        results = self._workers.ask("fitness", tasks, kept=False)
        self.steps_elsewhere += sum(steps for _, steps in results)
        return np.concatenate([fitness for fitness, _ in results])

    def state(self) -> dict[str, Tensor]:
        """Return the state of the environments for a checkpoint."""
        return _tensors(joined_states(self._workers.states()))

    def restore(
        self, saved: dict[str, Tensor], members: Sequence[Member], store: dict[str, Tensor]
    ) -> Array:
        """Restore a ``state``; return the environments that were reset, (k,)."""
        arrays = {k: v.numpy() for k, v in saved.items()}
        states = split_states(arrays, len(self._bounds) - 1)
        ids = zip(self._workers.restore(states), self._bounds[:-1], strict=True)
        return np.concatenate([rows + first * self._each for rows, first in ids])

    def close(self) -> None:
        """End the workers, if they run."""
        if not self._closed:
            self._closed = True
            self._workers.close()

    def _divided(self, members: Sequence[Member]) -> list[Sequence[Member]]:
        return [members[first:end] for first, end in pairwise(self._bounds)]


class PartHost:
    """The shard of a population at a worker; arguments and results are plain data."""

    def __init__(self, part: Shard, eval_envs: FitnessEnvs) -> None:
        self._part = part
        self._eval_envs = eval_envs

    def train(self, task: Task) -> tuple[list[Sent], Ticks, EpisodeTally]:
        """Train members; return them, the ticks, and the tally of all episodes here so far."""
        sent, until, schedule_steps, seeds = task
        members = _received(sent, self._part.spaces)
        ticks = Ticks()
        self._part.train(members, until, schedule_steps, seeds, lambda *tick: ticks.append(tick))
        return _sent(members), ticks, self._part.tally

    def fitness(self, task: tuple[Sequence[Sent], Seeds]) -> tuple[Array, int]:
        """Return the members' fitness, and the environment steps of its measurement."""
        before = self._eval_envs.steps_made
        members = _received(task[0], self._part.spaces)
        fitness = self._part.fitness(members, self._eval_envs, task[1])
        return fitness, self._eval_envs.steps_made - before

    def state(self) -> dict[str, Array]:
        """Return the shard's state, for ``restore``."""
        return {k: v.numpy() for k, v in self._part.state().items()}

    def restore(self, state: dict[str, Array]) -> Array:
        """Restore a ``state``; return the environments that were reset."""
        return self._part.restore(_tensors(state), (), {})

    def close(self) -> None:
        """Release the environments in which the members train, and those of their fitness."""
        self._part.close()
        self._eval_envs.close()


def _make_host(
    learning_task: LearningTask,
    config: AlgorithmConfig,
    seeds: Seeds,
    bounds: Sequence[int],
    episodes: int,
    each: int,
    number: int,
) -> PartHost:
    """Return the host of a worker's shard, in a process whose generators are seeded."""
    seed_global_generators(seeds / "global" / number)
    first = bounds[number]
    end = bounds[number + 1]
    part = Shard(learning_task, config, seeds, end - first, first)
    return PartHost(part, FitnessEnvs(learning_task, episodes, config.num_envs))


def _alone(config: AlgorithmConfig) -> AlgorithmConfig:
    """Return settings for a worker, which has one core; weights do not depend on threads."""
    return replace(config, threads=1, device="cpu")


def _sent(members: Sequence[Member]) -> list[Sent]:
    return [
        (m.number, config_to_json(_alone(m.config)), m.steps, _arrays(m.state)) for m in members
    ]


def _received(members: Sequence[Sent], spaces: tuple[Any, Any]) -> list[Member]:
    """Return the members that a worker was sent."""
    received = []
    for number, settings, steps, state in members:
        config = config_from_json(settings)
        kind = make_algorithm(config, *spaces).state_type
        received.append(Member(number, config, kind(**_tensors(state)), steps))
    return received


def _arrays(state: Any) -> dict[str, Array]:
    return {k: v.numpy() for k, v in vars(state).items()}


def _tensors(arrays: Mapping[str, Array]) -> dict[str, Tensor]:
    """Copy arrays to tensors, because arrays of Ray's object store are read-only."""
    return {k: torch.from_numpy(np.array(v)) for k, v in arrays.items()}
