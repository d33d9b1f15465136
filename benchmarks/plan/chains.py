"""Chains of the lander's skills: their success as a log estimates it, and as it is measured.

    python -m benchmarks.plan.chains [--seeds 0] [--steps 300000] [--episodes 400] [--out runs/plan]

A chain succeeds where each of its skills does its leg within one call: one after another, from the
start of an episode. Random calls make the log. For the measurement the skills are called in the
chain's order.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import table
from benchmarks.pay.results import CODE, Result, of_other_code
from benchmarks.plan.cells import Cells
from benchmarks.plan.families import LEGS, lander
from skillweave import Run
from skillweave.calls import CallLog, record_calls
from skillweave.calls.handover import calls_done
from skillweave.errors import SkillweaveError
from skillweave.ops.threads import torch_threads
from skillweave.recipes import lander_missions
from skillweave.types import Array, Memory

CHAINS = (
    ("go_left", "hover"),
    ("go_right", "hover"),
    ("hover", "land"),
    ("go_left", "land"),
    ("go_left", "go_right", "hover"),
    ("go_right", "go_left", "hover"),
    ("hover", "go_left", "go_right"),
    ("go_right", "hover", "go_left"),
    ("go_left", "go_right", "land"),
    ("hover", "go_right", "land"),
)
DONE = {"hover": LEGS["hover"], "go_left": LEGS["left"], "go_right": LEGS["right"]}
"""The events that the calls are for; landing has its own success."""
NEAR = 0.1
"""An estimate counts as right within this."""
MEASURED_SEED = 201


class InOrder:
    """A selector that calls skills in their order, and the last of all afterwards.

    Args:
        order: numbers of skills.
    """

    def __init__(self, order: Sequence[int]) -> None:
        self._order = np.array(order)

    def start(self, n: int) -> Memory:
        """Return the memory of ``n`` environments: the number of calls so far."""
        return {"calls": np.zeros(n, np.int64)}

    def act(self, memory: Memory, obs: Array, mask: Array | None = None, **how: Any) -> Any:
        """Return choices (n,); where a skill may not start, the first one that may."""
        calls = memory["calls"]
        wanted = self._order[np.minimum(calls, len(self._order) - 1)]
        if mask is not None:
            allowed = mask[np.arange(len(obs)), wanted]
            wanted = np.where(allowed, wanted, mask.argmax(axis=1))
        return wanted, {"calls": calls + 1}

    def observe(self, memory: Memory, step: Any) -> Memory:
        """Return the memory unchanged."""
        return memory


def did_all(log: CallLog, skills: Sequence[str], episodes: int) -> Array:
    """Return whether each of the first episodes did the chain, (episodes,) bool."""
    won = calls_done(log, DONE)
    done = np.ones((episodes, len(skills)), bool)
    for i, name in enumerate(skills):
        right = won & (log.skill == log.number(name)) & (log.order == i)
        done[:, i] = np.isin(np.arange(episodes), log.episode[right])
    every: Array = np.asarray(done.all(axis=1))
    return every


def measured(run: Run, skills: Sequence[str], episodes: int) -> Array:
    """Return the successes of a chain, (episodes,) bool."""
    limits = {skill.name: skill for skill in run.hierarchy.skills}
    longest = sum(limits[n].call_steps or limits[n].max_steps or 0 for n in skills)
    order = [run.policy.labels.index(name) for name in skills]
    # Every environment's first episode gets as many steps as the chain may take.
    log = record_calls(
        lander_missions.environment("any"),
        run.policy,
        episodes * longest,
        choose=InOrder(order),
        num_envs=episodes,
        seed=MEASURED_SEED,
    )
    return did_all(log, skills, episodes)


class Chains:
    """The chains of one seed's skills; what is in the folder is not made again.

    Args:
        folder: of skills, logs and results.
        seed: of the skills.
        steps: of the log.
        episodes: of a measurement.
    """

    def __init__(self, folder: Path, seed: int, steps: int, episodes: int) -> None:
        family = lander()
        self._task = replace(family.tasks[0], name="chains", steps=steps)
        self._cells = Cells(family, folder, seed, episodes)
        self._seed, self._steps, self._episodes = seed, steps, episodes

    def results(self, skills: Sequence[str]) -> tuple[Result, Result, Result]:
        """Return the estimate of a chain, the product of its pairs, and what was measured."""

        def estimate() -> list[float]:
            return [self._log.chain(*skills, done=DONE).estimate]

        def product() -> list[float]:
            return [self._log.chain(*skills, done=DONE).product]

        def share() -> list[float]:
            found: list[float] = measured(self._run, skills, self._episodes).astype(float).tolist()
            return found

        return (
            self._kept(skills, f"estimate-{self._steps}", self._steps, estimate),
            self._kept(skills, f"product-{self._steps}", self._steps, product),
            self._kept(skills, "measured", self._episodes, share),
        )

    def _kept(
        self, skills: Sequence[str], name: str, budget: int, find: Callable[[], list[float]]
    ) -> Result:
        """Return a result that is there, or find it and write it down."""
        place = "chains", "-then-".join(skills), name, self._seed
        if (known := self._cells.results.find(*place, budget)) is not None:
            return known
        began, scores = time.perf_counter(), find()
        spent = time.perf_counter() - began
        score = float(np.mean(scores))
        result = Result(*place, score, budget, budget, spent, scores=scores, code=CODE)
        self._cells.results.save(result)
        return result

    @cached_property
    def _log(self) -> CallLog:
        return self._cells.log(self._task, 1)

    @cached_property
    def _run(self) -> Run:
        return self._cells.base(self._task)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--episodes", type=int, default=400)
    parser.add_argument("--out", type=Path, default=Path("runs/plan"))
    asked = parser.parse_args(arguments)
    for seed in asked.seeds:
        chains = Chains(asked.out, seed, asked.steps, asked.episodes)
        rows, found = [], list[Result]()
        for skills in CHAINS:
            three = chains.results(skills)
            found += three
            rows.append((", ".join(skills), *(f"{r.score:.2f}" for r in three)))
            print(f"seed {seed}, {': '.join(rows[-1][:2])}, measured {rows[-1][3]}", flush=True)
        off = np.abs([a.score - c.score for a, c in zip(found[::3], found[2::3], strict=True)])
        print(f"\nseed {seed}, {asked.steps:,} logged steps")
        print(table(("chain", "estimate", "product of pairs", "measured"), rows))
        print(f"within {NEAR} of the measured share: {(off <= NEAR).sum()} of {len(off)} chains")
        if warning := of_other_code(found):
            print(warning)


if __name__ == "__main__":
    try:
        with torch_threads(1):
            main()
    except SkillweaveError as error:
        sys.exit(f"error: {error}")
