"""A stage in which a population evolves, generation by generation, in a run directory.

The stage also writes a line to ``lineage.jsonl`` for each member of each generation. A killed run
resumes from the last complete generation.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from skillweave._internal import interrupts
from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm, state_from
from skillweave.algorithms.config import AlgorithmConfig, config_from_json, config_to_json
from skillweave.evolution.config import Evolution, evolution_from_json
from skillweave.evolution.population import Population
from skillweave.evolution.shard import FitnessEnvs, policy_of
from skillweave.evolution.split import Parts
from skillweave.evolution.stacks import Member
from skillweave.networks.config import Network
from skillweave.policies.core import Array
from skillweave.runs.manifest import BestEntry, Generation, LineageLine, MemberEntry, Winner
from skillweave.training.stage_log import StageLog, resumed
from skillweave.training.stage_run import StageRun
from skillweave.workers.placement import LOCAL, Placement


@dataclass
class Champion:
    """The best member so far, with whose policy the stage ends.

    Its fitness is measured in the latest generation's episodes.
    """

    fitness: float
    number: int
    generation: int
    policy: AgentPolicy


class EvolvingPopulation:
    """The learner of a stage in which a population evolves.

    Args:
        selection: the user's selection, of which the run records only the name.
        where: the placement of the parts, if the stage's entry has several.

    Raises:
        DeclarationError: the selection is missing or wrong.
    """

    def __init__(self, stage: StageRun, selection: Any = None, where: Placement = LOCAL) -> None:
        self.entry = stage.entry
        self.run = stage.run
        self.seeds = stage.seeds
        self.task, self.config = stage.learning_task, stage.config
        label = f"{stage.run.path / 'run.json'}: stage {stage.entry.name!r}"
        self.evolution = evolution_from_json(stage.entry.evolution or {}, label, selection)
        self.best: Champion | None = None
        self.done = 0
        """The number of complete generations."""
        self.fitness_steps = 0
        """Environment steps of the latest measurement of fitness."""
        self._open = ExitStack()
        self._where = where

    def open(self) -> None:
        """Create the environments of fitness measurements."""
        task = self.task
        episodes = self.evolution.episodes
        self.eval_envs = FitnessEnvs(task, episodes, self.config.num_envs)
        self._open.callback(self.eval_envs.close)
        self.parts: Parts | None = None  # members train in this process
        if (parts := self.entry.workers) > 1:
            how = task, self.config, self.seeds, self.evolution.population, parts, episodes
            self.parts = Parts(self._where.workers, *how)
            self._open.callback(self.parts.close)

    def restore(self, tensors: dict[str, Tensor], log: StageLog) -> None:
        """Restore a checkpoint, whose members are in ``tensors``."""
        self.log = log
        if tensors:
            self._restore(tensors)
        else:
            self.population = Population.fresh(
                self.config, self.evolution, self.task, self.seeds, self.parts
            )
        part = self.population.part
        self._open.callback(part.close)
        if tensors:
            saved, store = unprefixed("collector", tensors), unprefixed("store", tensors)
            ids = resumed(log, lambda: part.restore(saved, self.population.members, store))
            log.report_reset(len(ids), part.num_envs)
        self._started: float = time.perf_counter() - log.at.seconds

    def train(self) -> dict[str, AgentPolicy]:
        """Train all generations; return the best policy, by the stage's name.

        Raises:
            TrainingError: every member diverged.
        """
        while not self.over:
            self.generation()
            if interrupts.requested() and not self.over:
                interrupts.stop()
        self.log.report_episodes(self.population.part.tally, over=True)
        return {self.entry.name: self._finish()}

    def states(self) -> dict[str, Any]:
        """Return no states: only the policy of the best member is kept."""
        return {}

    def close(self) -> None:
        """Release the environments."""
        self._open.close()

    @property
    def over(self) -> bool:
        """Return whether all generations are complete, or the stage ends early.

        It ends when the target is reached, the budget is spent, or a callback requests it.
        """
        spent = self.done > 0 and self.log.at.steps >= self.entry.budget
        early = self._good or spent or self.log.stop_requested
        return early or self.done >= self.evolution.generations

    @property
    def _good(self) -> bool:
        """Return whether the stage's target is reached."""
        target = self.entry.target
        best = self.best
        return target is not None and best is not None and best.fitness >= target.at_least

    def generation(self) -> None:
        """Train, compare, log, evolve and save."""
        before = self.log.at.steps

        def on_tick(steps: int, metrics: dict[str, float]) -> None:
            if self.best is not None:
                metrics |= {"fitness": self.best.fitness}
            update = self.log.at.update + 1
            self.log.tick(update, before + steps, self._seconds, metrics)

        seeds = self.seeds / "generation" / self.done
        self.population.train(*self._until(before), seeds, on_tick)
        measured = self._measured
        fitness = self.population.fitness(self.eval_envs, seeds / "fitness")
        self._keep_best(fitness, seeds / "fitness")
        self.fitness_steps = self._measured - measured
        self.log.at.steps += self.fitness_steps
        self._note(fitness)
        self.done += 1
        self.log.report_episodes(self.population.part.tally, over=False)
        if self.log.stop_requested:
            return  # no checkpoint: a run resumed from the previous one arrives here again
        if not self.over:
            self.population.evolve(fitness, seeds)
        self._save()

    @property
    def _measured(self) -> int:
        """Return the environment steps of fitness measurements since this process began."""
        return self.eval_envs.steps_made + self.population.part.steps_elsewhere

    def _finish(self) -> AgentPolicy:
        """Return the final policy of the stage."""
        assert self.best is not None
        generations = self.evolution.generations
        if self._good:
            self.log.reached(self.best.fitness)
        elif self.log.stop_requested:
            self.log.stopped()
        elif self.done < generations:
            self.log.message(
                f"its budget of {self.entry.budget:,} steps is spent after {self.done} of "
                f"{generations} generations: measuring fitness counts, too. Give it more steps, or "
                "fewer episodes"
            )
        best = self.best
        self.entry.winner = Winner(best.number, best.fitness, best.generation, self.done)
        return self.best.policy

    def _until(self, spent: int) -> tuple[int, int]:
        """Return the steps of each member at the generation's end, and at the end of schedules.

        The budget includes fitness measurements, which are assumed to take as many steps as the
        last one.
        """
        left = self.evolution.generations - self.done
        members = len(self.population.members)
        now = self.population.steps // members
        training = self.entry.budget - spent - left * self.fitness_steps
        return now + max(1, training // (left * members)), now + max(1, training // members)

    @property
    def _seconds(self) -> float:
        return time.perf_counter() - self._started

    def _keep_best(self, fitness: Array, seeds: Seeds) -> None:
        """Keep the best policy so far: the old one plays this generation's episodes, too."""
        if self.best is not None:
            self.best.fitness = self.eval_envs.score(self.best.policy, seeds)
        # The latest of equal ones: it has learnt for longer.
        if self.best is None or fitness.max() >= self.best.fitness:
            member = self.population.members[int(fitness.argmax())]
            policy = policy_of(member, self.population.spaces)
            self.best = Champion(float(fitness.max()), member.number, self.done, policy)

    def _note(self, fitness: Array) -> None:
        """Log the generation, and report it."""
        members = self.population.members
        best = self.best.number if self.best and self.best.generation == self.done else None
        self.run.lineage.append(
            lineage_of(self.entry.name, self.done, members, fitness, self.evolution, best)
        )
        lost = [str(m.number) for m, f in zip(members, fitness, strict=True) if f == -np.inf]
        if lost:
            self.log.message(
                f"generation {self.done + 1}: member {', '.join(lost)} diverged; it is replaced"
            )
        winner = members[int(fitness.argmax())]
        settings = settings_of(winner.config, self.evolution)
        shown = ", ".join(f"{k} {_short(v)}" for k, v in settings.items())
        self.log.message(
            f"generation {self.done + 1} of {self.evolution.generations}: best is member "
            f"{winner.number} with {fitness.max():.1f} ({shown})"
        )

    def _save(self) -> None:
        """Write a checkpoint of the whole population, to continue from."""
        tensors = prefixed("collector", self.population.part.state())
        for i, member in enumerate(self.population.members):
            tensors |= prefixed(str(i), vars(member.state))
        store = self.population.part.store
        if store is not None and self.config.save_buffer and not self.over:  # type: ignore[union-attr]
            tensors |= prefixed("store", store.state())
        best = self.best
        entry = None
        weights = dict[str, Tensor]()
        if best is not None:
            weights, header = best.policy.to_file()
            entry = BestEntry(best.fitness, best.number, best.generation, header)
        self.log.at.population = Generation(
            self.fitness_steps,
            self.done,
            self.population.part.rounds,
            self.population.next_number,
            [
                MemberEntry(m.number, m.steps, config_to_json(m.config), m.origin)
                for m in self.population.members
            ],
            entry,
        )
        self.log.save(tensors | prefixed("best", weights))

    def _restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the population from a checkpoint."""
        where = str(self.run.path)
        at = self.log.at.population
        assert at is not None
        self.done = at.generation
        self.fitness_steps = at.fitness_steps
        if (best := at.best) is not None:
            policy = AgentPolicy.from_file(unprefixed("best", tensors), best.policy, where)
            self.best = Champion(best.fitness, best.number, best.generation, policy)
        members = [
            self._restored(entry, unprefixed(str(i), tensors), f"{where}: member {i}")
            for i, entry in enumerate(at.members)
        ]
        self.population = Population(members, self.evolution, self.task, self.seeds, self.parts)
        self.population.part.rounds = at.rounds
        self.population.next_number = at.next_number

    def _restored(self, entry: MemberEntry, tensors: dict[str, Tensor], where: str) -> Member:
        """Return a member of a checkpoint."""
        config = config_from_json(entry.config)
        algorithm = make_algorithm(config, *self.task.role.spaces)
        like = algorithm.init([self.seeds])
        groups = algorithm.parameter_groups()
        state = state_from(tensors, like, where, groups)
        return Member(entry.number, config, state, entry.steps, entry.origin)


def lineage_of(
    stage: str,
    generation: int,
    members: Sequence[Member],
    fitness: Array,
    evolution: Evolution,
    best: int | None,
) -> list[LineageLine]:
    """Return a generation's lines; ``best``: the best member's number, if it is among them."""
    return [
        LineageLine(
            stage=stage,
            generation=generation,
            member=member.number,
            **vars(member.origin),
            fitness=float(value) if np.isfinite(value) else None,
            diverged=not np.isfinite(value),
            best=member.number == best,
            steps=member.steps,
            settings=settings_of(member.config, evolution),
        )
        for member, value in zip(members, fitness, strict=True)
    ]


def settings_of(config: AlgorithmConfig, evolution: Evolution) -> dict[str, Any]:
    """Return the settings of a member that evolution may change, by name."""
    ranges = evolution.mutations.ranges_of(config, start=False)
    settings: dict[str, Any] = {name: getattr(config, name) for name in ranges}
    network: Network = config.network
    settings |= {"hidden": list(network.hidden), "activation": network.activation}
    return settings


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
