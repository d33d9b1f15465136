"""Training and scoring of each agent of the protocol: the hierarchy, and F0 to F4."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.grouped import act_by, regroup
from benchmarks.pay.flat import Flat
from benchmarks.pay.results import CODE, Result, Results, curve_of, read
from benchmarks.pay.suite import Policies, Seldom, Shaped, Suite, Task
from skillweave import Hierarchy, Lengths, Selection, Skill, TrainDefaults
from skillweave.api import Run
from skillweave.runs.directory import RunDirectory
from skillweave.types import Array

HIERARCHY, RANDOM, SINGLE = "hierarchy", "F4-random-skills", "F4-best-skill"
FLAT, SHAPED, BONUS, TUNED = "F0-flat", "F1-skill-rewards", "F2-bonus", "F3-fine-tuned"
CHAINS = ("hierarchy", "flat", "shaped", "bonus")
"""What can be run on its own: agents of one chain need what others of it have learnt."""
TUNING_SEED = 100
"""Weights of F1 are chosen on this one, which is never reported."""
TUNING_SHARE = 3
"""They are chosen after this part of the first task's steps: a third."""
LONG = 900_000
"""Flat agents with more steps compile their gradient steps, where they can. That takes half a
minute or more, and saves about a minute in a million steps."""


class Bench:
    """One suite from one seed: trains what has no result yet.

    Args:
        suite: its tasks and budgets.
        results: where results are kept.
        seed: the root of all random numbers.
    """

    def __init__(self, suite: Suite, results: Results, seed: int) -> None:
        self.suite, self.results, self.seed = suite, results, seed
        self._on_older = False  # what comes next is built on a result of other code

    def run(self, chain: str, tasks: Sequence[str] | None = None) -> None:
        """Train and score a chain of agents on tasks, by name (None: all that it is to learn)."""
        every = self.suite.headlines if chain in ("shaped", "bonus") else self.suite.tasks
        asked = [t for t in self.suite.tasks if (t in every if tasks is None else t.name in tasks)]
        {
            "hierarchy": self._hierarchy,
            "flat": self._flat,
            "shaped": self._shaped,
            "bonus": self._bonus,
        }[chain](asked)

    # The hierarchy, and what needs its skills

    def _hierarchy(self, tasks: Sequence[Task]) -> None:
        source = self.suite.tasks[0]
        budgets = self._budgets()
        for task in self._with_those_before(tasks):
            hierarchy = self.suite.hierarchy(task, None if task is source else self._skills())
            if task is not source:
                self._as_learnt(hierarchy)
            start = None
            if task.starts_from is not None:
                before = self.suite.task(task.starts_from)
                start = self._path(before, HIERARCHY)
                self._builds_on(before, HIERARCHY)
            keep = self.suite.goes_on(task)
            self._weave(task, HIERARCHY, hierarchy, budgets[task.name], keep, start)
        for task in tasks:
            for agent, declare in self.suite.variants.items():
                hierarchy = self._as_learnt(self.suite.fitted(declare(task, self._skills())))
                self._weave(task, agent, hierarchy, hierarchy.total_steps)
            self._without_learning(task)

    def _weave(
        self,
        task: Task,
        agent: str,
        hierarchy: Hierarchy,
        budget: int,
        keep: bool = False,
        start_from: Path | None = None,
    ) -> None:
        path, started = self._path(task, agent), time.perf_counter()
        if self._found(task, agent, budget, keep):
            return
        self.results.begin(path)
        regroup(
            hierarchy,
            eval_every=max(1, budget // self.suite.evaluations),
            eval_episodes=self.suite.evaluated,
        )
        if path.exists():
            run = hierarchy.resume(path, quiet=True)
        else:
            run = hierarchy.train(path, seed=self.seed, quiet=True, start_from=start_from)
        self._score(run, task, agent, budget, started, keep, ("selector", "together"))

    def _skills(self) -> dict[str, Any]:
        """Return the skills that were learnt on the first task from this seed."""
        policy = self._source_policy()
        return dict(zip(policy.labels, policy.skills.policies, strict=True))

    def _as_learnt(self, hierarchy: Hierarchy) -> Hierarchy:
        """Let skills be greedy, or sample, as on the first task, if neither the suite sets it nor a
        stage in which they go on learning finds it out."""
        together = any(stage.kind == "together" for stage in hierarchy.stages())
        if hierarchy.selection.greedy_skills is None and not together:
            regroup(hierarchy, greedy_skills=self._source_policy().skills.greedy)
        return hierarchy

    def _source_policy(self) -> Any:
        """Return the hierarchy that was learnt on the first task from this seed."""
        source = self.suite.tasks[0]
        run = self.suite.hierarchy(source, None).load(self._path(source, HIERARCHY))
        self._builds_on(source, HIERARCHY)
        return run.policy

    def _without_learning(self, task: Task) -> None:
        """F4, and the suite's fixed hierarchies."""
        fixed = {RANDOM: self._random, **self.suite.fixed}
        for agent, declare in fixed.items():
            if not self._found(task, agent, 0):
                started = time.perf_counter()
                run = self._ready(task, agent, declare(task, self._skills()))
                self._score(run, task, agent, 0, started, greedy=agent != RANDOM)
        if not self._found(task, SINGLE, 0):
            started = time.perf_counter()
            run = self._ready(task, SINGLE, self._random(task, self._skills()))
            names = [s.name for s in run.hierarchy.skills]
            policy: Any = run.policy
            greedy = policy.skills.greedy

            def alone(name: str, episodes: int, **how: Any) -> Any:
                return run.evaluate(episodes, skill=name, deterministic=greedy, **how)

            # Which one is best is found out in other episodes than those of its score, in EnvPool
            # where that has them.
            few = max(1, self.suite.episodes // 2)
            best = max(names, key=lambda n: alone(n, few, seed=TUNING_SEED, engine="auto").mean)
            returns = alone(best, self.suite.episodes).returns
            self._save(run, task, SINGLE, 0, started, returns, {best: 1.0})

    def _random(self, task: Task, skills: Policies) -> Hierarchy:
        hierarchy = self.suite.hierarchy(task, skills)
        for skill in hierarchy.skills:
            if skill.policy is None:
                act_by(skill, skills[skill.name])
        return by_lot(hierarchy, self.seed)

    def _ready(self, task: Task, agent: str, hierarchy: Hierarchy) -> Run:
        """Return the run of a hierarchy without a learner."""
        path = self._path(task, agent)
        shutil.rmtree(path, ignore_errors=True)
        self.results.begin(path)
        return self._as_learnt(hierarchy).train(path, seed=self.seed, quiet=True)

    # Flat agents

    def _flat(self, tasks: Sequence[Task]) -> None:
        source, budgets = self.suite.tasks[0], self._budgets()
        self._learn(self._agent(source), source, FLAT, keep=True)
        for task in tasks:
            if task is not source:
                self._learn(self._agent(task), task, FLAT)
            elif not self._found(task, TUNED, budgets[task.name]):
                found = self._found(task, FLAT, budgets[task.name])
                assert found is not None
                self.results.save(replace(found, agent=TUNED))
        for task in self._with_those_before(tasks)[1:]:
            agent = self._agent(task, budgets[task.name])
            agent.starts_from = self._before(task)
            self._learn(agent, task, TUNED, keep=self.suite.goes_on(task))

    def _shaped(self, tasks: Sequence[Task]) -> None:
        weights = self.tuned_weights()
        for task in tasks:
            self._learn(self._with_rewards(self._agent(task), weights), task, SHAPED)

    def _bonus(self, tasks: Sequence[Task]) -> None:
        for task in tasks:
            agent = self._agent(task)
            agent.learns = Seldom(self.suite.cells, self.suite.bonus)
            self._learn(agent, task, BONUS)

    def tuned_weights(self) -> dict[str, float]:
        """Return the weights with which F1 does best on the first task, from a seed of its own.

        After a third of its steps, so that choosing takes no longer than learning.
        """
        task, scores = self.suite.tasks[0], []
        budget = self._budgets()[task.name] // TUNING_SHARE
        other = Bench(self.suite, self.results, TUNING_SEED)
        for i, weights in enumerate(self.suite.weights):
            agent = other._with_rewards(other._agent(task, budget), weights)
            scores.append(other._learn(agent, task, f"tuning-{i}").score)
            other._builds_on(task, f"tuning-{i}")
        self._on_older |= other._on_older
        return dict(self.suite.weights[int(np.argmax(scores))])

    def _with_rewards(self, agent: Flat, weights: Any) -> Flat:
        agent.learns = Shaped(self.suite.skills(), weights, self.suite.task_weight)
        return agent

    def _agent(self, task: Task, budget: int | None = None) -> Flat:
        budget = budget or self._flat_budgets()[task.name]
        learner: Any = self.suite.flat
        if budget > LONG:
            learner = replace(learner, compile="auto")
        return Flat(
            task.env,
            learner,
            budget,
            train_defaults=TrainDefaults(
                eval_every=max(1, budget // self.suite.evaluations),
                eval_episodes=self.suite.evaluated,
            ),
        )

    def _learn(self, agent: Flat, task: Task, name: str, keep: bool = False) -> Result:
        budget, path, started = agent.steps, self._path(task, name), time.perf_counter()
        if found := self._found(task, name, budget, keep):
            return found
        self.results.begin(path)
        return self._score(
            agent.run(path, self.seed), task, name, budget, started, keep, ("agent",)
        )

    def _before(self, task: Task) -> Path:
        """Return the run of the flat agent with which F3 begins a further task."""
        source = self.suite.tasks[0]
        before = source if task.starts_from is None else self.suite.task(task.starts_from)
        name = FLAT if before is source else TUNED
        self._builds_on(before, name)
        path: Path = self._path(before, name)
        return path

    # What all share

    def _score(
        self,
        run: Run,
        task: Task,
        agent: str,
        budget: int,
        started: float,
        keep: bool = False,
        stages: tuple[str, ...] = (),
        greedy: bool | None = None,
    ) -> Result:
        greedy = self.suite.greedy if greedy is None else greedy
        found = run.evaluate(self.suite.episodes, deterministic=greedy)
        usage = found.to_json()["skill_usage"]
        return self._save(run, task, agent, budget, started, found.returns, usage, keep, stages)

    def _save(
        self,
        run: Run,
        task: Task,
        agent: str,
        budget: int,
        started: float,
        returns: Sequence[float],
        usage: dict[str, float],
        keep: bool = False,
        stages: tuple[str, ...] = (),
    ) -> Result:
        scores = [float(r) / self.suite.unit for r in returns]
        curve = curve_of(run.path, self.suite.unit, stages) if stages else []
        spent = sum(int(s["steps"]) for s in run.info()["stages"])
        # Of a training that was stopped, what came before, too.
        trained = sum(float(s["seconds"]) for s in run.info()["stages"])
        score, seconds = float(np.mean(scores)), max(time.perf_counter() - started, trained)
        begun = self.results.begun_by(run.path)
        code = CODE if begun == CODE and not self._on_older else ""
        result = Result(
            self.suite.name,
            task.name,
            agent,
            self.seed,
            score,
            spent,
            budget,
            seconds,
            [*curve, (spent, score)],
            scores,
            usage,
            code,
        )
        self.results.save(result)
        if not keep:
            shutil.rmtree(run.path, ignore_errors=True)
        return result

    def _found(self, task: Task, agent: str, budget: int, keep: bool = False) -> Result | None:
        """Return a stored result; None where others need its run, and that is not finished."""
        found = self.results.find(self.suite.name, task.name, agent, self.seed, budget)
        return None if keep and not is_over(self._path(task, agent)) else found

    def _builds_on(self, task: Task, agent: str) -> None:
        """Note that further results need this one, so they are of other code if it is."""
        path = self.results.file(self.suite.name, task.name, agent, self.seed)
        self._on_older |= read(path).code != CODE

    def _path(self, task: Task, agent: str) -> Any:
        return self.results.run_path(self.suite.name, task.name, agent, self.seed)

    def _names(self) -> list[str]:
        return [t.name for t in self.suite.tasks]

    def _budgets(self) -> dict[str, int]:
        return dict(zip(self._names(), self.suite.steps(), strict=True))

    def _flat_budgets(self) -> dict[str, int]:
        return dict(zip(self._names(), self.suite.steps_flat(), strict=True))

    def _with_those_before(self, tasks: Sequence[Task]) -> list[Task]:
        """These tasks, the first, and those that others start from, in the suite's order."""
        wanted = {self.suite.tasks[0].name, *(t.name for t in tasks)}
        for task in reversed(self.suite.tasks):
            if task.name in wanted and task.starts_from is not None:
                wanted.add(task.starts_from)
        return [t for t in self.suite.tasks if t.name in wanted]


def is_over(path: Path) -> bool:
    """Return whether there is a run, and all its stages are done."""
    if not path.exists():
        return False
    return all(s.done for s in RunDirectory.open(path).manifest.stages)


def replace_selector(hierarchy: Hierarchy, selector: Any) -> Hierarchy:
    """Return the same skills under a ready selector, without further learning."""
    skills: list[Skill] = list(hierarchy.skills)
    return Hierarchy(
        hierarchy.env,
        skills,
        call_steps=hierarchy.call_steps,
        selector=selector,
        reflexes=hierarchy.reflexes,
        selection=Selection(greedy_skills=hierarchy.selection.greedy_skills),
    )


def by_lot(hierarchy: Hierarchy, seed: int) -> Hierarchy:
    """F4: of the skills that may start, any, all equally likely."""
    rng, skills, calls = np.random.default_rng(seed), hierarchy.skills, hierarchy.call_steps

    def anyone(obs: Array) -> Array:
        allowed = np.stack([s.initiation(obs) for s in skills], axis=1)
        found: Array = np.where(allowed, rng.random(allowed.shape), -1.0).argmax(axis=1)
        return found

    if isinstance(calls, Lengths):
        hierarchy.call_steps = calls.steps[len(calls.steps) // 2]
    return replace_selector(hierarchy, anyone)
