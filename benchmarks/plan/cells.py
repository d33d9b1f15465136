"""The cells of ``python -m benchmarks.plan``: one agent on one task from one seed's skills.

What is in the folder is not made again: skills, logs and results.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pay.results import CODE, Result, Results
from benchmarks.plan.families import Family, NewTask, Policies
from skillweave import Apart, Hierarchy, Run, evaluate
from skillweave.calls import CallLog, record_calls
from skillweave.errors import RunError
from skillweave.planning import Explorer
from skillweave.runs.directory import RunDirectory
from skillweave.types import Evaluation

LOG_SEEDS = (101, 102, 103)
"""Seeds of the logs."""
PLANNER = "planner"
BY_HAND = "by-hand"
SELECTOR = "selector"
TRAINED = "trained"
AGENTS = (PLANNER, BY_HAND, SELECTOR, TRAINED)
"""The planner; the rule by hand; a selector trained for as many steps as are logged; one trained as
its recipe does."""


def results_in(folder: Path) -> Results:
    """Return the results of a folder, which stand beside skills and logs."""
    return Results(folder / "results")


class Cells:
    """The cells of a family for one seed.

    Args:
        family: tasks and how they are planned.
        folder: of skills, logs and results.
        seed: of the skills.
        episodes: of each score.
        say: called with a line for each cell that is done.
    """

    def __init__(
        self,
        family: Family,
        folder: Path,
        seed: int,
        episodes: int = 64,
        say: Callable[[str], Any] = print,
    ) -> None:
        self.family, self.seed, self.episodes, self.say = family, seed, episodes, say
        self.results = results_in(folder)
        self._folder = folder / family.name
        self._skills: Policies | None = None

    def skills(self) -> Policies:
        """Return the skills by name; they are trained where they are not there."""
        if self._skills is None:
            if self.seed == 0 and self.family.shipped is not None:
                run = Hierarchy.pretrained(self.family.shipped)
            else:
                path = self._folder / "skills" / str(self.seed)
                run = trained(self.family.source(), path, self.seed)
            policy: Any = run.policy
            self._skills = dict(zip(policy.labels, policy.skills.policies, strict=True))
        return self._skills

    def base(self, task: NewTask) -> Run:
        """Return the skills on a task under the rule by hand; nothing of it is trained."""
        path = self._folder / "bases" / f"{task.name}-{self.seed}"
        shutil.rmtree(path, ignore_errors=True)
        first = next(iter(self.skills()))
        rule = self.family.by_hand
        selector = (lambda obs: [first] * len(obs)) if rule is None else rule(task)
        return self.family.over(task, self.skills(), selector=selector).train(path, quiet=True)

    def log(self, task: NewTask, number: int) -> CallLog:
        """Return a log of calls, recorded where it is not there; ``number``: from 1."""
        name = f"{task.log}-{self.seed}-{number}-{task.steps}.safetensors"
        path = self._folder / "logs" / name
        if not path.exists():
            choose: Any = Explorer(**self.family.explorer) if task.explored else "random"
            log = record_calls(
                task.logged_in or task.env,
                self.base(task).policy,
                task.steps,
                choose=choose,
                seed=LOG_SEEDS[number - 1],
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            log.save(path)
        return CallLog.load(path).within(task.steps)

    def run(self, task: NewTask, agent: str, number: int = 0) -> Result:
        """Return the result of an agent on a task, measured where it is not there.

        Args:
            task: of the family.
            agent: of ``AGENTS``.
            number: of the planner's log, from 1.
        """
        name = f"{agent}-{number}" if agent == PLANNER else agent
        budget = self._budget(task, agent)
        place = self.family.name, task.name, name, self.seed
        if (known := self.results.find(*place, budget)) is not None:
            return known
        began = time.perf_counter()
        if agent == PLANNER:
            found, steps = self._planned(task, number)
        elif agent == BY_HAND:
            found, steps = self._score(self.base(task)), 0
        else:
            found, steps = self._trained(task, budget, self.results.run_path(*place))
        result = Result(
            *place,
            score=0.0 if found is None else self.family.score(found),
            steps=steps,
            budget=budget,
            seconds=time.perf_counter() - began,
            scores=[] if found is None else [float(x) for x in found.returns],
            code=CODE,
        )
        self.results.save(result)
        self.say(
            f"{task.name}, seed {self.seed}, {name}: {result.score:.2f} ({result.seconds:.0f} s)"
        )
        return result

    def _budget(self, task: NewTask, agent: str) -> int:
        if agent == TRAINED:
            assert self.family.selector_steps is not None
            return self.family.selector_steps
        return 0 if agent == BY_HAND else task.steps

    def _planned(self, task: NewTask, number: int) -> tuple[Evaluation | None, int]:
        """Plan on a log; no evaluation where the log has nothing of the task."""
        log = self.log(task, number)
        try:
            planned = self.base(task).plan(task.task, log, **self.family.planner)
        except RunError as error:
            self.say(str(error))
            return None, log.steps
        # The environment itself is the judge, not the task that was planned.
        return self._play(planned.policy, task), log.steps

    def _trained(self, task: NewTask, steps: int, path: Path) -> tuple[Evaluation, int]:
        """Train a selector, or finish one that was stopped."""
        hierarchy = self.family.over(task, self.skills(), apart=Apart(selector_steps=steps))
        return self._score(trained(hierarchy, path, self.seed)), steps

    def _score(self, run: Run) -> Evaluation:
        return run.evaluate(
            self.episodes, engine="auto", deterministic=self.family.greedy, quiet=True
        )

    def _play(self, policy: Any, task: NewTask) -> Evaluation:
        return evaluate(
            policy,
            task.env,
            episodes=self.episodes,
            engine="auto",
            deterministic=self.family.greedy,
        )


def trained(hierarchy: Hierarchy, path: Path, seed: int) -> Run:
    """Return a finished run; one that is there goes on, or is loaded."""
    if not path.exists():
        return hierarchy.train(path, seed=seed, quiet=True)
    if RunDirectory.open(path).finished:
        return hierarchy.load(path)
    return hierarchy.resume(path, quiet=True)


def shares(results: list[Result], good: float) -> tuple[float, float, int]:
    """Return the median, the worst score, and the number of good ones."""
    scores = np.array([r.score for r in results])
    return float(np.median(scores)), float(scores.min()), int((scores >= good).sum())
