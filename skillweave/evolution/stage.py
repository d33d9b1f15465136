"""A stage in which a population evolves, generation by generation, in a run directory.

Beside what every stage writes, ``lineage.jsonl`` gets a line for each member of each generation.
A generation is one piece: a run that was killed goes on from the last complete one.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from skillweave.algorithms.config import config_from_json, config_to_json
from skillweave.algorithms.policy import AgentPolicy, make_algorithm, state_from
from skillweave.evolution.config import Evolution, evolution_from_json
from skillweave.evolution.lineage import lineage_of, settings_of
from skillweave.evolution.population import Population, score
from skillweave.evolution.stacks import Member, Origin
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import Generation
from skillweave.seeding import Seeds
from skillweave.training.episodes import Tick
from skillweave.training.stage import (
    START,
    Listener,
    Stage,
    Record,
    resume_episodes,
    train_stage,
)
from skillweave.types import Array, prefixed, unprefixed


@dataclass
class Nothing:
    """A population's state, for a checkpoint: its members' tensors stand beside it."""


@dataclass
class Best:
    """The best member so far: its policy is what the stage ends with.

    Fitness is that of the latest generation's episodes.
    """

    fitness: float
    number: int
    generation: int
    policy: AgentPolicy


def evolve_stage(
    stage: Stage,
    run: RunDirectory,
    seeds: Seeds,
    listeners: tuple[Listener, ...],
    selection: Any = None,
) -> AgentPolicy:
    """Like ``train_stage``; where the run's entry says so, a population evolves instead.

    The settings in the run count, not those of ``stage``: a resumed run goes on as it began.

    Args:
        selection: the user's own, which the run knows by name only.

    Raises:
        SkillweaveError: every member diverged, or the selection is missing or wrong.
    """
    entry = run.stage(stage.name)
    if entry.get("evolution") is None:
        return train_stage(stage, run, seeds, listeners)
    if entry["status"] == "done":
        return run.load_policy(stage.name)
    where = f"{run.path}: stage {stage.name!r}"
    evolution = evolution_from_json(entry["evolution"], where, selection)
    evolving = _Evolving(stage, run, seeds, listeners, evolution)
    try:
        while not evolving.over:
            evolving.generation()
    finally:
        evolving.close()
    return evolving.finish()


class _Evolving:
    """One stage's population under way."""

    def __init__(
        self,
        stage: Stage,
        run: RunDirectory,
        seeds: Seeds,
        listeners: tuple[Listener, ...],
        evolution: Evolution,
    ) -> None:
        self.stage, self.run, self.seeds, self.evolution = stage, run, seeds, evolution
        self.listeners, entry = listeners, run.stage(stage.name)
        self.config = config_from_json(entry["algorithm"])
        self.budget = int(entry["budget"])
        # It may be damaged: before there is an arena.
        found = run.load_checkpoint(Nothing, stage.name, schema=Generation)
        self.arena = stage.make_env(evolution.episodes, self.config.gamma)
        """Where fitness is measured."""
        self.spaces = self.arena.observation_space, self.arena.action_space
        self.best: Best | None = None
        self.done = 0
        """Complete generations."""
        self.fitness_steps = 0
        """Environment steps that the latest measurement of fitness took."""
        if found is None:
            at: dict[str, Any] = dict(START)
            self.population = Population.fresh(
                self.config, evolution, stage.make_env, self.spaces, seeds
            )
        else:
            _, at, tensors = found
            self._restore(at, tensors)
        run.lineage.rewind(at.get("lineage_bytes", entry.get("lineage_bytes")))
        entry.setdefault("lineage_bytes", run.lineage.size)
        self.record = Record(stage.name, run, listeners, at)
        if found is not None:
            self._resume_episodes(found[2])
        self._started: float = time.perf_counter() - at["seconds"]

    @property
    def over(self) -> bool:
        """Whether all generations are complete, the target is reached, or the budget is spent."""
        target = self.evolution.target
        good = self.best is not None and target is not None and self.best.fitness >= target
        spent = self.done > 0 and self.record.at["steps"] >= self.budget
        return good or spent or self.done >= self.evolution.generations

    def generation(self) -> None:
        """Train, compare, write down, evolve, and save."""
        before = self.record.at["steps"]

        def on_tick(steps: int, tick: Tick) -> None:
            metrics = tick.metrics
            if self.best is not None:
                metrics |= {"fitness": self.best.fitness}
            update = self.record.at["update"] + 1
            self.record.tick(update, before + steps, self._seconds, metrics)

        seeds = self.seeds / "generation" / self.done
        self.population.train(*self._until(before), seeds, on_tick)
        measured = self.arena.steps_made
        fitness = self.population.fitness(self.arena, seeds / "fitness")
        self._keep_best(fitness, seeds / "fitness")
        self.fitness_steps = self.arena.steps_made - measured
        self.record.at["steps"] += self.fitness_steps
        self._note(fitness)
        self.done += 1
        if not self.over:
            self.population.evolve(fitness, seeds)
        self._save()

    def finish(self) -> AgentPolicy:
        """The stage is over."""
        assert self.best is not None
        asked, target = self.evolution.generations, self.evolution.target
        if self.done < asked and (target is None or self.best.fitness < target):
            self._tell(
                f"its budget of {self.budget:,} steps is spent after {self.done} of {asked} "
                "generations: measuring fitness counts, too. Give it more steps, or fewer episodes"
            )
        entry = self.record.entry
        entry["winner"] = {"member": self.best.number, "fitness": self.best.fitness}
        entry["winner"] |= {"generation": self.best.generation, "generations": self.done}
        self.record.done(self.best.policy)
        return self.best.policy

    def close(self) -> None:
        """Release the environments."""
        self.arena.close()
        if self.population is not None:
            self.population.close()

    def _until(self, spent: int) -> tuple[int, int]:
        """Steps of each member at this generation's end, and when schedules end.

        The budget counts measuring fitness too, which takes as many steps as the last time.
        """
        left, members = self.evolution.generations - self.done, len(self.population.members)
        now = self.population.steps // members
        training = self.budget - spent - left * self.fitness_steps
        return now + max(1, training // (left * members)), now + max(1, training // members)

    @property
    def _seconds(self) -> float:
        return time.perf_counter() - self._started

    def _keep_best(self, fitness: Array, seeds: Seeds) -> None:
        """Keep the best policy so far: the old one plays this generation's episodes, too."""
        if self.best is not None:
            self.best.fitness = score(self.best.policy, self.arena, seeds)
        # Of equals the latest: it has learnt for longer.
        if self.best is None or fitness.max() >= self.best.fitness:
            member = self.population.members[int(fitness.argmax())]
            policy = self.population.policy(member)
            self.best = Best(float(fitness.max()), member.number, self.done, policy)

    def _note(self, fitness: Array) -> None:
        """Write the generation down, and tell."""
        members = self.population.members
        best = self.best.number if self.best and self.best.generation == self.done else None
        self.run.lineage.append(
            lineage_of(self.stage.name, self.done, members, fitness, self.evolution, best)
        )
        lost = [str(m.number) for m, f in zip(members, fitness, strict=True) if f == -np.inf]
        if lost:
            self._tell(
                f"generation {self.done + 1}: member {', '.join(lost)} diverged; it is replaced"
            )
        winner = members[int(fitness.argmax())]
        settings = settings_of(winner.config, self.evolution)
        shown = ", ".join(f"{k} {_short(v)}" for k, v in settings.items())
        self._tell(
            f"generation {self.done + 1} of {self.evolution.generations}: best is member "
            f"{winner.number} with {fitness.max():.1f} ({shown})"
        )

    def _tell(self, text: str) -> None:
        for listener in self.listeners:
            listener.message(f"{self.stage.name}: {text}")

    def _save(self) -> None:
        """A checkpoint of the whole population, as it is to go on."""
        tensors = prefixed("collector", self.population.cut(self.seeds / "cut" / self.done))
        for i, member in enumerate(self.population.members):
            tensors |= prefixed(str(i), vars(member.state))
        buffer = self.population.buffer
        if buffer is not None and self.config.save_buffer and not self.over:  # type: ignore[union-attr]
            tensors |= prefixed("buffer", buffer.state())
        header: dict[str, Any] = {
            "generation": self.done,
            "rounds": self.population.rounds,
            "fitness_steps": self.fitness_steps,
            "next_number": self.population.next_number,
            "lineage_bytes": self.run.lineage.size,
            "members": [_member_to_json(m) for m in self.population.members],
        }
        if self.best is not None:
            weights, about = self.best.policy.to_file()
            tensors |= prefixed("best", weights)
            header["best"] = {"fitness": self.best.fitness, "number": self.best.number}
            header["best"] |= {"generation": self.best.generation, "policy": about}
        self.run.save_checkpoint(Nothing(), self.record.header() | header, tensors)

    def _resume_episodes(self, tensors: dict[str, Tensor]) -> None:
        """Bring the environments, and what was seen in them, back to where a checkpoint was."""
        population, saved = self.population, unprefixed("collector", tensors)
        resume_episodes(population.collector, saved, self.seeds, self.record)
        if buffer := unprefixed("buffer", tensors):
            population.load_buffer(buffer)

    def _restore(self, at: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        """Stand where a checkpoint says."""
        members = []
        for i, told in enumerate(at["members"]):
            member = _member_from_json(told)
            algorithm, own = (
                make_algorithm(member.config, *self.spaces),
                unprefixed(str(i), tensors),
            )
            fresh, where = algorithm.init([self.seeds]), f"{self.run.path}: member {i}"
            member.state = state_from(own, fresh, where, algorithm.families())
            members.append(member)
        self.population = Population(
            members, self.evolution, self.stage.make_env, self.spaces, self.seeds
        )
        self.population.rounds, self.population.next_number = at["rounds"], at["next_number"]
        self.done, self.fitness_steps = at["generation"], at["fitness_steps"]
        if best := at.get("best"):
            weights, where = unprefixed("best", tensors), str(self.run.path)
            policy = AgentPolicy.from_file(weights, best["policy"], where)
            self.best = Best(best["fitness"], best["number"], best["generation"], policy)


def _member_to_json(member: Member) -> dict[str, Any]:
    return {
        "number": member.number,
        "steps": member.steps,
        "config": config_to_json(member.config),
        "origin": vars(member.origin),
    }


def _member_from_json(told: dict[str, Any]) -> Member:
    origin = dict(told["origin"])
    origin["changes"] = {k: tuple(v) for k, v in origin["changes"].items()}
    config = config_from_json(told["config"])
    return Member(told["number"], config, None, told["steps"], Origin(**origin))


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
