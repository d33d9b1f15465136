"""A population: members that train in stacks, are compared, and become the next generation.

Between generations members are independent; ``stacks`` joins them for learning in a ``part``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.evolution.config import Evolution
from skillweave.evolution.mutation import mutate, random_config
from skillweave.evolution.selection import select
from skillweave.evolution.shard import FitnessEnvs, OnGenerationTick, Shard
from skillweave.evolution.split import Parts
from skillweave.evolution.stacks import Member, copy, grouped
from skillweave.policies.core import Array
from skillweave.runs.manifest import Origin
from skillweave.training.learning_task import LearningTask


class Population:
    """A population: its members, their part, and their evolution.

    Members of one stack are adjacent in ``members``.

    Args:
        learning_task: the task that they learn.
        part: trains them; None: all in this process.
    """

    def __init__(
        self,
        members: list[Member],
        evolution: Evolution,
        learning_task: LearningTask,
        seeds: Seeds,
        part: Shard | Parts | None = None,
    ) -> None:
        self.members = members
        self.evolution = evolution
        self.spaces = learning_task.role.spaces
        self.next_number = len(members)
        self.part = part or Shard(learning_task, members[0].config, seeds, len(members))

    @classmethod
    def fresh(
        cls,
        config: AlgorithmConfig,
        evolution: Evolution,
        learning_task: LearningTask,
        seeds: Seeds,
        part: Shard | Parts | None = None,
    ) -> Population:
        """Create the first generation, each member with its own weights."""
        members = []
        spaces = learning_task.role.spaces
        for i in range(evolution.population):
            settings = config
            if evolution.start == "random":
                rng = (seeds / "start" / i).numpy()
                settings = random_config(config, evolution.mutations, rng)
            member = Member(i, settings, None)
            member.state = member.algorithm(spaces).init([seeds / "member" / i])
            members.append(member)
        ordered = [m for group in grouped(members, spaces) for m in group]
        return cls(ordered, evolution, learning_task, seeds, part)

    @property
    def steps(self) -> int:
        """Return the steps of all members and their ancestors, each as often as it has heirs.

        The stage counts the steps that were really spent.
        """
        return sum(m.steps for m in self.members)

    def train(
        self, until: int, schedule_steps: int, seeds: Seeds, on_tick: OnGenerationTick
    ) -> None:
        """Train every member until it has ``until`` steps."""
        self.part.train(self.members, until, schedule_steps, seeds, on_tick)

    def fitness(self, eval_envs: FitnessEnvs, seeds: Seeds) -> Array:
        """Return each member's mean return in the same episodes; −inf if it has diverged."""
        return self.part.fitness(self.members, eval_envs, seeds)

    def evolve(self, fitness: Array, seeds: Seeds) -> None:
        """Replace the members by the next generation."""
        rng = (seeds / "select").numpy()
        heirs = select(self.evolution, fitness, rng)
        places: dict[int, int] = {}
        members = []
        for place, heir in enumerate(heirs):
            parent = self.members[heir.parent]
            if heir.mutates:
                rng = (seeds / "mutate" / place).numpy()
                child = mutate(parent, self.evolution.mutations, self.spaces, rng)
            else:
                child = replace(copy(parent), origin=Origin(parent.number, "goes on"))
            if heir.mutates or parent.number in places:
                child.number = self.next_number
                self.next_number += 1
            places[child.number] = heir.parent
            members.append(child)
        self.members = [m for group in grouped(members, self.spaces) for m in group]
        if self.part.store is not None:
            self.part.store.inherit(np.array([places[m.number] for m in self.members]))
