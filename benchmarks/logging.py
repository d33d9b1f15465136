"""Cost of recording calls: evaluating and collecting with a log of calls, against without.

    python -m benchmarks.logging [lander] [pool] [--rounds 7] [--rows 1500]

``lander``: the shipped recipe ``lander-missions``, in Gymnasium's environments. ``pool``: two
scripted skills in EnvPool's CartPole, whose steps cost next to nothing: the most that recording can
cost. Evaluating plays whole episodes; collecting is what training does between updates, by a
selector that learns. Each round does both, with and without a log, one after another. A ratio is of
processor time; the median round counts.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

import skillweave as sw
from benchmarks.common import median, report, table
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.calls.recorder import Recorder
from skillweave.experience.acting import Acting, Request
from skillweave.experience.learners import Calling
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.roles import roles_of
from skillweave.training.evaluation import evaluate
from skillweave.training.learning_task import LearningTask

ENVS = 16
LIMIT = 0.10
"""The most that recording may cost of the steps' time."""


class Push(sw.Skill):
    """To the side to which the pole leans, for ten steps."""

    max_steps = 10

    def policy(self, obs: Any) -> Any:
        """Return the side."""
        return (obs[:, 2] > 0).astype(np.int64)

    def success(self, step: sw.Step) -> Any:
        """Return where the pole is upright."""
        return np.abs(step.next_obs[:, 2]) < 0.05


class Catch(Push):
    """To the side to which the pole falls."""

    def policy(self, obs: Any) -> Any:
        """Return the side."""
        return (obs[:, 3] > 0).astype(np.int64)


def hierarchies() -> dict[str, tuple[Any, Callable[[], Any]]]:
    """Return an engine and a function that makes a policy with its declaration, by case."""
    return {
        "lander": ("sync", partial(sw.Hierarchy.pretrained, "lander-missions")),
        "pool": ("envpool", pool),
    }


def pool() -> Any:
    """Return a run of scripted skills that learnt next to nothing."""
    import tempfile

    algorithm = sw.PPO(num_envs=ENVS, n_steps=8, batch_size=64)
    env = sw.EnvSpec("CartPole-v1", engine="envpool")
    declared = sw.Hierarchy(
        env, [Push(), Catch()], algorithm=algorithm, selector=algorithm, steps=256
    )
    with tempfile.TemporaryDirectory() as folder:
        return declared.train(f"{folder}/run", quiet=True)


def evaluating(run: Any, engine: Any, episodes: int) -> Callable[[bool], float]:
    """Return a function that evaluates, and returns the processor time of a step in seconds."""

    def timed(log: bool) -> float:
        began = time.process_time()
        score = evaluate(
            run.policy, run.hierarchy.spec, episodes=episodes, num_envs=ENVS, engine=engine,
            log_calls=log,
        )  # fmt: skip
        return (time.process_time() - began) / sum(score.lengths)

    return timed


def collecting(run: Any, engine: Any, rows: int) -> Callable[[bool], float]:
    """Return a function that collects by a new selector; see ``evaluating``."""
    policy = run.policy
    assert isinstance(policy, HierarchyPolicy)
    role = roles_of(run.hierarchy)["selector"]
    role = replace(role, spec=replace(role.spec, engine=engine))
    task = LearningTask(role, Calling(policy.skills))
    algorithm = make_algorithm(sw.PPO(), *role.spaces)
    params = algorithm.acting_params(algorithm.init([Seeds(0)]))
    spaces = role.spec.spaces.observation, role.spec.spaces.action

    def timed(log: bool) -> float:
        told = replace(task, log_calls=() if log else None)
        collector = told.collector(ENVS, Acting([(algorithm, 1)], ENVS))
        recorder = Recorder(policy.skills, spaces, ENVS, latest=10_000)
        collector.start(Seeds(1))
        began, steps = time.process_time(), 0
        for i in range(-(-rows // 128)):
            collected = collector.collect(Request(128, (params,), np.array([0.99]), Seeds(i)))
            steps += collected.steps
            if collected.calls is not None:
                recorder.add(collected.calls)
        seconds = time.process_time() - began
        collector.close()
        return seconds / steps

    return timed


def main() -> None:
    """Measure, and print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=["lander", "pool"])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--rows", type=int, default=1_500)
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows, result = [], {}
    for case in given.cases:
        engine, make = hierarchies()[case]
        run = make()
        ways = {
            "evaluating": evaluating(run, engine, 8 if case == "lander" else 128),
            "collecting": collecting(run, engine, given.rows),
        }
        for way, timed in ways.items():
            timed(True)  # what is imported and compiled at first does not count
            pairs = [in_turn(timed, i) for i in range(given.rounds)]
            more = median(log / plain for plain, log in pairs) - 1
            step = median(plain for plain, _ in pairs)
            rows.append((case, way, f"{1e6 * step:.1f}", f"{more:+.1%}"))
            print(*rows[-1], flush=True)
            result[f"{case}/{way}"] = {"step_seconds": step, "more": more}
    print(table(("case", "while", "µs a step", "with a log"), rows))
    report("logging", {"ratios": result, "at_most": LIMIT})


def in_turn(timed: Callable[[bool], float], i: int) -> tuple[float, float]:
    """Return the times without a log and with one; every other round the log comes first."""
    first = timed(i % 2 == 1)
    second = timed(i % 2 == 0)
    return (second, first) if i % 2 else (first, second)


if __name__ == "__main__":
    main()
