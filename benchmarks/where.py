"""Where the time of a step goes: microseconds of an environment step by part of training.

    python -m benchmarks.where [plain together sac processes] [--steps 200000]

``plain``: PPO with its defaults on EnvPool's LunarLander. ``together``: the recipe
``lunar-lander`` where selector and skills learn together. ``sac``: SAC on the continuous lander,
for an eighth of the steps. ``processes``: PPO on CartPole in Python, in two worker processes.

A part's time is without the parts within it. ``clock`` includes waiting for the other thread and
for Python's lock, ``processor`` is the thread's own work. The first quarter of the steps, in which
memory is allocated and nets are young, does not count.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from unittest import mock

from benchmarks.common import report, table, warm_up
from skillweave import PPO, SAC, EnvSpec, recipes, train_agent
from skillweave.algorithms import actor_critic, base, ppo, sac as sac_algorithm
from skillweave.algorithms.actor_critic import ActorCriticAlgorithm
from skillweave.algorithms.dqn import DQNAlgorithm
from skillweave.algorithms.ppo import PPOAlgorithm
from skillweave.algorithms.rollouts import minibatches
from skillweave.buffers.replay import ReplayStore
from skillweave.buffers.rollout import RolloutStore
from skillweave.envs.engine import GymnasiumEngine, WatchedEngine
from skillweave.envs.envpool_engine import EnvPoolEngine
from skillweave.experience.collector import Collector
from skillweave.experience.writer import TraceWriter
from skillweave.networks.stacked import Layout
from skillweave.policies.hierarchy import CallAndReturn
from skillweave.policies.leaves import Learning
from skillweave.training.joint import JointLearner
from skillweave.training.learner import RolloutLearner
from skillweave.training.loop import Loop
from skillweave.training.replay_learner import ReplayLearner
from skillweave.workers.host import Workers

PARTS: dict[str, list[tuple[Any, str]]] = {
    "environments": [(EnvPoolEngine, "_act"), (GymnasiumEngine, "_act")],
    "environments: checks, history": [(WatchedEngine, "step")],
    "environments: resets": [(Collector, "_reset")],
    "workers: waiting for them": [(Workers, "ask")],
    "writing": [(TraceWriter, "write"), (TraceWriter, "next")],
    "judging: rewards, ends": [(Collector, "_judge"), (Collector, "_ends")],
    "judging: rows of learners": [(Collector, "_views")],
    "acting: network": [(Learning, "act")],
    "acting: calls": [(CallAndReturn, "act"), (CallAndReturn, "observe")],
    "acting: parameters": [(Collector, "_prepare")],
    "the rest of a step": [(Collector, "_step")],
    "the rest of a request": [(Collector, "collect")],
    "storing": [(RolloutLearner, "take"), (ReplayLearner, "take"), (JointLearner, "take")],
    "gather: rollout": [(RolloutStore, "rollout")],
    "gather: samples of replay": [(ReplayStore, "sample")],
    "gather: advantages": [(PPOAlgorithm, "samples")],
    "forward, targets": [
        (PPOAlgorithm, "loss"),
        (ActorCriticAlgorithm, "learn"),
        (DQNAlgorithm, "learn"),
    ],
    "backward": [(Layout, "gradient")],
    "optimiser": [
        (base, "adam_"),
        (base, "clip_grad_norm_"),
        (actor_critic, "adam_"),
        (actor_critic, "clip_grad_norm_"),
        (sac_algorithm, "adam_"),
    ],
    "the rest of an update": [(RolloutLearner, "learn"), (ReplayLearner, "learn")],
    "waiting for the learner": [(Loop, "_finish_update")],
}
"""By part, the methods and functions of classes and modules that it consists of."""


class Clock:
    """Time by thread and part, each without the parts within it."""

    def __init__(self) -> None:
        self.spent: dict[tuple[str, str], list[float]] = defaultdict(lambda: [0.0, 0.0])
        self._open = threading.local()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the time within the block as that of a part."""
        within = self._open.__dict__.setdefault("within", [[0.0, 0.0]])
        within.append([0.0, 0.0])
        began = time.perf_counter(), time.thread_time()
        try:
            yield
        finally:
            took = time.perf_counter() - began[0], time.thread_time() - began[1]
            inner = within.pop()
            spent = self.spent[threading.current_thread().name, name]
            for i in range(2):
                spent[i] += took[i] - inner[i]
                within[-1][i] += took[i]

    def timed(self, function: Callable[..., Any], name: str) -> Callable[..., Any]:
        """Return a function whose time is that of a part."""

        @functools.wraps(function)
        def call(*args: Any, **how: Any) -> Any:
            with self.part(name):
                return function(*args, **how)

        return call


@dataclass
class Window:
    """The rounds that are counted, and the time that their parts took."""

    began: float = 0.0
    """By the clock, in seconds."""
    ended: float = 0.0
    first: int | None = None
    """Environment steps before it; None: it has not begun."""
    last: int = 0
    """Environment steps after it."""
    spent: dict[tuple[str, str], list[float]] = field(default_factory=dict)
    """By thread and part, seconds by the clock and of the processor."""


@contextmanager
def watched(clock: Clock, skip: int) -> Iterator[Window]:
    """Count the parts of the training in the block, after ``skip`` steps of it."""
    window = Window()
    timed_round = clock.timed(Loop._round, "the rest of a round")

    def one_round(loop: Loop) -> None:
        if window.first is None and loop.at.steps >= skip:
            clock.spent.clear()
            window.first = loop.at.steps
            window.began = time.perf_counter()
        timed_round(loop)
        # What comes after the last round, as final files, does not count.
        window.ended = time.perf_counter()
        window.last = loop.at.steps
        window.spent = {key: list(spent) for key, spent in clock.spent.copy().items()}

    def timed_minibatches(*args: Any) -> Iterator[Any]:
        drawn = minibatches(*args)
        while True:
            with clock.part("gather: minibatches"):
                batch = next(drawn, None)
            if batch is None:
                return
            yield batch

    with ExitStack() as stack:
        for name, methods in PARTS.items():
            for owner, method in methods:
                timed = clock.timed(getattr(owner, method), name)
                stack.enter_context(mock.patch.object(owner, method, timed))
        stack.enter_context(mock.patch.object(Loop, "_round", one_round))
        stack.enter_context(mock.patch.object(ppo, "minibatches", timed_minibatches))
        yield window


def measure(train: Callable[[int], Any], steps: int) -> dict[str, Any]:
    """Train; return steps a second, and microseconds of a step by thread and part."""
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.chdir(folder),
        watched(Clock(), steps // 4) as window,
    ):
        train(steps)
    assert window.first is not None, "the training was too short"
    counted = window.last - window.first
    rows: list[dict[str, Any]] = [
        {
            "thread": thread,
            "part": part,
            "clock": round(1e6 * spent[0] / counted, 2),
            "processor": round(1e6 * spent[1] / counted, 2),
        }
        for (thread, part), spent in window.spent.items()
    ]
    rows.sort(key=lambda row: (row["thread"] != "MainThread", -row["clock"]))
    return {"steps_per_second": round(counted / (window.ended - window.began)), "rows": rows}


def plain(steps: int) -> None:
    train_agent("LunarLander-v3", PPO(), steps, quiet=True)


def sac(steps: int) -> None:
    train_agent("LunarLanderContinuous-v3", SAC(learning_starts=1_000), steps, quiet=True)


def processes(steps: int) -> None:
    train_agent(EnvSpec("CartPole-v1", engine="sync", workers=2), PPO(), steps, quiet=True)


def together(steps: int) -> None:
    hierarchy = recipes.load("lunar-lander")
    hierarchy.learn = "together"
    hierarchy.together = replace(hierarchy.together, steps=steps)
    hierarchy.train(quiet=True)


CASES: dict[str, tuple[Callable[[int], None], int]] = {
    "plain": (plain, 1),
    "together": (together, 1),
    "sac": (sac, 8),
    "processes": (processes, 1),
}
"""By name, a training, and the number by which its steps are divided: slow ones make fewer."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", nargs="*", choices=[*CASES, []], default=[*CASES])
    parser.add_argument("--steps", type=int, default=200_000)
    given = parser.parse_args()
    warm_up()
    summary: dict[str, Any] = {}
    for name in given.cases:
        train, divisor = CASES[name]
        summary[name] = found = measure(train, given.steps // divisor)
        print(f"\n{name}: {found['steps_per_second']:,} steps a second")
        rows = found["rows"]
        print(table(list(rows[0]), [list(row.values()) for row in rows]), flush=True)
    report("where", summary)


if __name__ == "__main__":
    main()
