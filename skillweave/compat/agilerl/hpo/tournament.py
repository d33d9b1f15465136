"""AgileRL's tournaments."""

from typing import Any

import numpy as np

from skillweave.compat.agilerl.agent import random_seed
from skillweave.evolution.config import Evolution, Tournament
from skillweave.evolution.selection import Heir, select


class TournamentSelection:
    """A selection: each heir's parent is the best of ``tournament_size`` random agents."""

    def __init__(
        self, tournament_size: int, elitism: bool, population_size: int, evo_step: int
    ) -> None:
        self.tournament_size = tournament_size
        self.elitism = elitism
        self.population_size = population_size
        self.evo_step = evo_step

    def select(self, population: list[Any]) -> tuple[Any, list[Any]]:
        """Return the best agent by its last ``evo_step`` fitnesses, and the next population."""
        fitness = np.array([np.mean(a.fitness[-self.evo_step :]) for a in population])
        rng = np.random.default_rng(random_seed())
        size = self.tournament_size
        by = Evolution(max(2, size), selection=Tournament(size, elitism=False))
        elite = population[int(fitness.argmax())]
        number = max(a.index for a in population)
        heirs = [Heir(population.index(elite), False)] if self.elitism else []
        while len(heirs) < self.population_size:
            heirs += select(by, fitness, rng)
        clones = []
        for heir in heirs[: self.population_size]:
            number += heir.mutates
            clones.append(population[heir.parent].clone(number if heir.mutates else None))
        return elite.clone(), clones
