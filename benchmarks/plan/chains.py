"""Chains of the lander's skills: their success as a log estimates it, and as it is measured.

    python -m benchmarks.plan.chains [--seeds 0] [--steps 100000] [--episodes 400] [--out runs/plan]

A chain succeeds where each of its skills does its leg within one call: one after another, from the
start of an episode. Random calls make the log. For the measurement the skills are called in the
chain's order.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import table
from benchmarks.pay.results import CODE, Result, Results, of_other_code
from benchmarks.plan.cells import Cells
from benchmarks.plan.families import LEGS, lander
from skillweave import Array, Run
from skillweave.errors import SkillweaveError
from skillweave.ops.threads import torch_threads
from skillweave.planning import CallLog, chain, record_calls
from skillweave.planning.hand_over import calls_done
from skillweave.recipes import lander_missions
from skillweave.types import Memory

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
LOG_SEED = 101
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
    every: Array = done.all(axis=1)
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


def one_seed(folder: Path, seed: int, steps: int, episodes: int) -> list[Result]:
    """Return estimates and measurements of all chains, measured where they are not there."""
    family, results = lander(), Results(folder)
    task = replace(family.tasks[0], name="chains", steps=steps)
    cells = Cells(family, folder, seed, episodes)
    found, run, log = [], None, None
    for skills in CHAINS:
        place = "chains", "-then-".join(skills)
        known = results.find(*place, "measured", seed, episodes)
        if known is None:
            run = run or cells.base(task)
            log = log or cells.log(task, 1)
            began = time.perf_counter()
            estimate = chain(log, *skills, done=DONE)
            spent = time.perf_counter() - began
            for agent, score in (("estimate", estimate.estimate), ("product", estimate.product)):
                results.save(Result(*place, agent, seed, score, log.steps, steps, spent, code=CODE))
            won = measured(run, skills, episodes)
            spent = time.perf_counter() - began - spent
            known = Result(
                *place, "measured", seed, float(won.mean()), 0, episodes, spent,
                scores=won.astype(float).tolist(), code=CODE,
            )  # fmt: skip
            results.save(known)
        for agent in ("estimate", "product"):
            either = results.find(*place, agent, seed, steps)
            assert either is not None
            found.append(either)
        found.append(known)
        _, estimated, product, share = _row(found[-3:])
        print(f"seed {seed}, {', '.join(skills)}: {estimated}, {product}, {share}", flush=True)
    return found


def _row(results: Sequence[Result]) -> tuple[str, str, str, str]:
    """Return a chain's line of the table."""
    estimate, product, share = (f"{r.score:.2f}" for r in results)
    return results[0].task.replace("-then-", ", "), estimate, product, share


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--episodes", type=int, default=400)
    parser.add_argument("--out", type=Path, default=Path("runs/plan"))
    asked = parser.parse_args(arguments)
    for seed in asked.seeds:
        found = one_seed(asked.out, seed, asked.steps, asked.episodes)
        rows = [_row(found[i : i + 3]) for i in range(0, len(found), 3)]
        print(f"\nseed {seed}")
        print(table(("chain", "estimate", "product of pairs", "measured"), rows))
        off = np.array([abs(a.score - c.score) for a, c in zip(found[::3], found[2::3])])  # noqa: B905
        print(f"within {NEAR} of the measured share: {(off <= NEAR).sum()} of {len(off)} chains")
        if warning := of_other_code(found):
            print(warning)


if __name__ == "__main__":
    try:
        with torch_threads(1):
            main()
    except SkillweaveError as error:
        sys.exit(f"error: {error}")
