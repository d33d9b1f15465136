"""A population in several parts, each of which trains at a worker: a process, or an actor of Ray.

A part is a ``Part``: its places stay at its worker, members go there and come back in each
generation. What members become depends on how many parts there are, and not on where they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.config import AlgorithmConfig, config_from_json, config_to_json
from skillweave.algorithms.policy import make_algorithm
from skillweave.collecting.group import joined_states, split_states
from skillweave.collecting.where import MakeWorkers
from skillweave.evolution.fitness import FitnessArena
from skillweave.evolution.part import OnGenerationTick, Part
from skillweave.evolution.stacks import Member
from skillweave.seeding import Seeds, seed_global_generators
from skillweave.training.episodes import EpisodeTally
from skillweave.training.scene import Scene
from skillweave.types import Array

Sent = tuple[int, dict[str, Any], int, dict[str, Array]]
"""A member on its way: number, settings as JSON, steps, tensors of its state."""


@dataclass(frozen=True)
class Training:
    """What a part is to train; see ``Part.train``."""

    members: Sequence[Sent]
    until: int
    schedule_steps: int
    seeds: Seeds


@dataclass(frozen=True)
class Trained:
    """What came of it."""

    states: list[dict[str, Array]]
    steps: list[int]
    ticks: list[tuple[int, dict[str, float]]]
    tally: EpisodeTally
    """Of all episodes at this part so far."""


class Parts:
    """Several parts as one.

    Args:
        make_workers: says where they are.
        scene, config, seeds: as of ``Part``.
        count: places.
        parts: how many; their sizes differ by one at most.
        episodes: of which a member's fitness is the mean return.
    """

    store = None
    rounds = 0

    def __init__(
        self,
        make_workers: MakeWorkers,
        scene: Scene,
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
        """Environment steps of measuring fitness that were made in other processes."""
        self.tally = EpisodeTally()
        """Which logged keys of ``info`` occurred."""
        make = partial(_stationed, scene, _alone(config), seeds, self._bounds, episodes)
        self._workers, self._closed = make_workers(make, parts, scene.name), False

    def train(
        self,
        members: Sequence[Member],
        until: int,
        schedule_steps: int,
        seeds: Seeds,
        on_tick: OnGenerationTick,
    ) -> None:
        """Train members until each has ``until`` steps; ticks are told when all parts are done."""
        groups = self._divided(members)
        tasks = [Training(_sent(group), until, schedule_steps, seeds) for group in groups]
        before, self.tally = 0, EpisodeTally()
        for group, trained in zip(groups, self._workers.ask("train", tasks), strict=True):
            for steps, metrics in trained.ticks:
                on_tick(before + steps, dict(metrics))
            self.tally.add(trained.tally)
            before += sum(trained.steps) - sum(m.steps for m in group)
            for member, state, steps in zip(group, trained.states, trained.steps, strict=True):
                member.state, member.steps = type(member.state)(**_tensors(state)), steps

    def fitness(self, members: Sequence[Member], arena: FitnessArena, seeds: Seeds) -> Array:
        """As ``Part.fitness``, in arenas of the parts' own."""
        tasks = [(_sent(group), seeds) for group in self._divided(members)]
        found = self._workers.ask("fitness", tasks, kept=False)
        self.steps_elsewhere += sum(steps for _, steps in found)
        return np.concatenate([fitness for fitness, _ in found])

    def state(self) -> dict[str, Tensor]:
        """Return what a checkpoint needs of the environments. It changes nothing."""
        return _tensors(joined_states(self._workers.states()))

    def restore(
        self, saved: dict[str, Tensor], members: Sequence[Member], store: dict[str, Tensor]
    ) -> Array:
        """Stand where ``state`` was asked; (k,) environments that begin anew."""
        arrays = {k: v.numpy() for k, v in saved.items()}
        states = split_states(arrays, len(self._bounds) - 1)
        return self._columns(self._workers.stand(states))

    def close(self) -> None:
        """End the workers, once."""
        if not self._closed:
            self._closed = True
            self._workers.close()

    def _divided(self, members: Sequence[Member]) -> list[Sequence[Member]]:
        return [members[first:end] for first, end in pairwise(self._bounds)]

    def _columns(self, ids: Sequence[Array]) -> Array:
        """Environments of each part as those of the population."""
        return np.concatenate([
            own + first * self._each for own, first in zip(ids, self._bounds[:-1], strict=True)
        ])  # fmt: skip


class StationedPart:
    """A part where its worker is: it speaks of plain data alone."""

    def __init__(self, part: Part, arena: FitnessArena) -> None:
        self._part, self._arena = part, arena

    def train(self, task: Training) -> Trained:
        """Train members."""
        members, ticks = _received(task.members, self._part.spaces), list[Any]()
        self._part.train(
            members, task.until, task.schedule_steps, task.seeds, lambda *tick: ticks.append(tick)
        )
        states, steps = [_arrays(m.state) for m in members], [m.steps for m in members]
        return Trained(states, steps, ticks, self._part.tally)

    def fitness(self, task: tuple[Sequence[Sent], Seeds]) -> tuple[Array, int]:
        """Their fitness, and the environment steps that it took."""
        before = self._arena.steps_made
        members = _received(task[0], self._part.spaces)
        found = self._part.fitness(members, self._arena, task[1])
        return found, self._arena.steps_made - before

    def state(self) -> dict[str, Array]:
        """What ``restore`` needs."""
        return {k: v.numpy() for k, v in self._part.state().items()}

    def restore(self, state: dict[str, Array]) -> Array:
        """Stand where ``state`` was asked."""
        return self._part.restore(_tensors(state), (), {})

    def close(self) -> None:
        """Release the environments."""
        self._part.close()
        self._arena.close()


def _stationed(
    scene: Scene,
    config: AlgorithmConfig,
    seeds: Seeds,
    bounds: Sequence[int],
    episodes: int,
    each: int,
    number: int,
) -> StationedPart:
    seed_global_generators(seeds / "global" / number)
    first, end = bounds[number], bounds[number + 1]
    part = Part(scene, config, seeds, end - first, first)
    return StationedPart(part, FitnessArena(scene, episodes, config.num_envs))


def _alone(config: AlgorithmConfig) -> AlgorithmConfig:
    """Settings as at a worker, which has one core; weights do not depend on threads."""
    return replace(config, threads=1, device="cpu")


def _sent(members: Sequence[Member]) -> list[Sent]:
    return [
        (m.number, config_to_json(_alone(m.config)), m.steps, _arrays(m.state)) for m in members
    ]


def _received(members: Sequence[Sent], spaces: tuple[Any, Any]) -> list[Member]:
    found = []
    for number, told, steps, state in members:
        config = config_from_json(told)
        kind = make_algorithm(config, *spaces).state_type
        found.append(Member(number, config, kind(**_tensors(state)), steps))
    return found


def _arrays(state: Any) -> dict[str, Array]:
    return {k: v.numpy() for k, v in vars(state).items()}


def _tensors(arrays: Mapping[str, Array]) -> dict[str, Tensor]:
    """Copies: arrays of Ray's object store cannot be written to."""
    return {k: torch.from_numpy(np.array(v)) for k, v in arrays.items()}
