"""A population: it trains side by side in stacks, is compared, and becomes its own next generation.

Between generations a member is a thing of its own; see ``stacks`` for how they learn together, and
``part`` for where.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from torch import Tensor

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.algorithms.policy import AgentPolicy
from skillweave.evolution.config import Evolution
from skillweave.evolution.fitness import FitnessArena
from skillweave.evolution.mutation import mutate, random_config
from skillweave.evolution.part import OnGenerationTick, Part, policy_of, spaces_of
from skillweave.evolution.selection import select
from skillweave.evolution.split import Parts
from skillweave.evolution.stacks import Member, Origin, copy, grouped
from skillweave.seeding import Seeds
from skillweave.training.scene import Scene
from skillweave.types import Array


class Population:
    """Members, where they learn, and how they evolve.

    Members of one stack stand side by side in ``members``.

    Args:
        scene: where they learn.
        part: trains them; None: all in this process.
    """

    def __init__(
        self,
        members: list[Member],
        evolution: Evolution,
        scene: Scene,
        seeds: Seeds,
        part: Part | Parts | None = None,
    ) -> None:
        self.members, self.evolution = members, evolution
        self.spaces = spaces_of(scene)
        self.next_number = len(members)
        self.part = part or Part(scene, members[0].config, seeds, len(members))

    @classmethod
    def fresh(
        cls,
        config: AlgorithmConfig,
        evolution: Evolution,
        scene: Scene,
        seeds: Seeds,
        part: Part | Parts | None = None,
    ) -> Population:
        """Return the first generation, each member with weights of its own."""
        members, spaces = [], spaces_of(scene)
        for i in range(evolution.population):
            own = config
            if evolution.start == "random":
                own = random_config(config, evolution.mutations, (seeds / "start" / i).numpy())
            member = Member(i, own, None)
            member.state = member.algorithm(spaces).init([seeds / "member" / i])
            members.append(member)
        ordered = [m for group in grouped(members, spaces) for m in group]
        return cls(ordered, evolution, scene, seeds, part)

    @property
    def steps(self) -> int:
        """Environment steps of all members and of their ancestors, each as often as it has heirs.

        What was really spent is counted by the stage.
        """
        return sum(m.steps for m in self.members)

    def train(
        self, until: int, schedule_steps: int, seeds: Seeds, on_tick: OnGenerationTick
    ) -> None:
        """Train every member until it has ``until`` steps."""
        self.part.train(self.members, until, schedule_steps, seeds, on_tick)

    def fitness(self, arena: FitnessArena, seeds: Seeds) -> Array:
        """Mean return of each member's episodes, from the same starts; −inf if it has diverged."""
        return self.part.fitness(self.members, arena, seeds)

    def state(self) -> dict[str, Tensor]:
        """Return what a checkpoint needs of the environments. It changes nothing."""
        return self.part.state()

    def resume(self, saved: dict[str, Tensor], store: dict[str, Tensor]) -> Array:
        """Stand where ``state`` was called; (k,) environments that begin anew."""
        return self.part.restore(saved, self.members, store)

    def close(self) -> None:
        """Release the environments."""
        self.part.close()

    def policy(self, member: Member) -> AgentPolicy:
        """What a member has learnt."""
        return policy_of(member, self.spaces)

    def evolve(self, fitness: Array, seeds: Seeds) -> None:
        """Become the next generation."""
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
                child.number, self.next_number = self.next_number, self.next_number + 1
            places[child.number] = heir.parent
            members.append(child)
        self.members = [m for group in grouped(members, self.spaces) for m in group]
        if self.part.store is not None:
            self.part.store.inherit(np.array([places[m.number] for m in self.members]))
