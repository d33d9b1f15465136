"""Twelve declarations as a user would write them, with the defaults, beside apart and flat.

    python -m benchmarks.declarations [NAME ...] [--seeds 0 1 2] [--out runs/declarations]

Every way has the same steps in all, and nothing but the defaults. "new" is the default way of
learning; "apart" is the same declaration with ``learn="apart"``; "flat" is one plain agent. A score
is the mean return of 100 episodes. Four tasks are dense: their reward leads to the goal.
"""

# Skills are written as users write them, where NumPy returns Any.
# mypy: disable-error-code="no-any-return"

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import report, table, workers
from benchmarks.declared_worlds import Delivery, Locked, Reach, Switches, Track
from skillweave import EnvSpec, Hierarchy, Skill, Step
from skillweave.types import Array

WAYS = ("new", "apart", "flat")


def gained(step: Step, place: Any, columns: slice = slice(0, 2)) -> Array:
    """Return how much nearer a step came to a place, (N,)."""
    before = np.linalg.norm(step.obs[:, columns] - place, axis=1)
    found: Array = before - np.linalg.norm(step.next_obs[:, columns] - place, axis=1)
    return found


# CartPole-v1 (dense)


class Center(Skill):
    def reward(self, step: Step) -> Array:
        return 1.0 - np.abs(step.next_obs[:, 0])


class Upright(Skill):
    def reward(self, step: Step) -> Array:
        return 1.0 - 5.0 * np.abs(step.next_obs[:, 2])


# Pendulum-v1 (dense): cos, sin, speed


class SwingUp(Skill):
    def reward(self, step: Step) -> Array:
        return step.next_obs[:, 0] - step.obs[:, 0] + 0.01 * np.abs(step.next_obs[:, 2])


class Hold(Skill):
    def reward(self, step: Step) -> Array:
        return step.next_obs[:, 0] - 0.1 * np.abs(step.next_obs[:, 2])


# Reach and Track (dense)


class Approach(Skill):
    def reward(self, step: Step) -> Array:
        return gained(step, step.obs[:, 4:6])


class Brake(Skill):
    def reward(self, step: Step) -> Array:
        return -np.abs(step.next_obs[:, 2:4]).sum(axis=1)


class Chase(Skill):
    def reward(self, step: Step) -> Array:
        return gained(step, step.obs[:, 4:6])


class Stay(Skill):
    def reward(self, step: Step) -> Array:
        return -np.abs(step.next_obs[:, :2] - step.next_obs[:, 2:4]).sum(axis=1)


# Acrobot-v1: cos and sin of two joints, two speeds


class Pump(Skill):
    def reward(self, step: Step) -> Array:
        return 0.1 * np.abs(step.next_obs[:, 4])


class Raise(Skill):
    def reward(self, step: Step) -> Array:
        o = step.next_obs
        return -o[:, 0] - (o[:, 0] * o[:, 2] - o[:, 1] * o[:, 3])


# MountainCar-v0 and MountainCarContinuous-v0: place, speed


class BuildSpeed(Skill):
    def reward(self, step: Step) -> Array:
        return 100.0 * (np.abs(step.next_obs[:, 1]) - np.abs(step.obs[:, 1]))


class Climb(Skill):
    def reward(self, step: Step) -> Array:
        return 10.0 * (step.next_obs[:, 0] - step.obs[:, 0])


# FrozenLake8x8-v1, without slipping: a place of 64


class East(Skill):
    def reward(self, step: Step) -> Array:
        hole = step.terminated & (step.reward == 0)
        return (step.next_obs % 8 - step.obs % 8) - 5.0 * hole


class South(Skill):
    def reward(self, step: Step) -> Array:
        hole = step.terminated & (step.reward == 0)
        return (step.next_obs // 8 - step.obs // 8) - 5.0 * hole


# Taxi-v4: one of 500 states


class Fetch(Skill):
    def initiation(self, obs: Array) -> Array:
        return passenger(obs) < 4

    def reward(self, step: Step) -> Array:
        return 10.0 * self.termination(step) + step.reward

    def termination(self, step: Step) -> Array:
        return passenger(step.next_obs) == 4


class Bring(Skill):
    def initiation(self, obs: Array) -> Array:
        return passenger(obs) == 4


def passenger(obs: Array) -> Array:
    """Return where the passenger is: 0 to 3 a stop, 4 in the taxi."""
    return (obs // 4) % 5


# Switches: place, three switches


class _Press(Skill):
    number = 0

    def initiation(self, obs: Array) -> Array:
        return obs[:, 1:].sum(axis=1) == self.number

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, 1:].sum(axis=1) > self.number

    def reward(self, step: Step) -> Array:
        return self.termination(step) - 0.01


class First(_Press):
    number = 0


class Second(_Press):
    number = 1


class Third(_Press):
    number = 2


# Delivery: x, y, parcel, carried, delivered


class GetParcel(Skill):
    def initiation(self, obs: Array) -> Array:
        return obs[:, 4] == 0

    def reward(self, step: Step) -> Array:
        return gained(step, step.obs[:, 2:4]) + self.termination(step)

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, 4] == 1


class Deliver(Skill):
    def initiation(self, obs: Array) -> Array:
        return (obs[:, 4] == 1) & (obs[:, 5] == 0)

    def reward(self, step: Step) -> Array:
        return gained(step, 0.8) + self.termination(step)

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, 5] == 1


class GoHome(Skill):
    def initiation(self, obs: Array) -> Array:
        return obs[:, 5] == 1

    def reward(self, step: Step) -> Array:
        return gained(step, -0.8) + step.reward


# Locked: row, column, key, has the key, door is open


class GetKey(Skill):
    def initiation(self, obs: Array) -> Array:
        return obs[:, 4] == 0

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, 4] == 1

    def reward(self, step: Step) -> Array:
        return self.termination(step) - 0.01


class OpenDoor(Skill):
    def initiation(self, obs: Array) -> Array:
        return (obs[:, 4] == 1) & (obs[:, 5] == 0)

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, 5] == 1

    def reward(self, step: Step) -> Array:
        return self.termination(step) - 0.01


class Leave(Skill):
    def initiation(self, obs: Array) -> Array:
        return obs[:, 5] == 1

    def reward(self, step: Step) -> Array:
        return step.reward - 0.01


@dataclass(frozen=True)
class Declared:
    """A task and what a user would declare for it."""

    env: Any
    skills: Callable[[], Sequence[Skill]]
    steps: int
    dense: bool = False


LAKE = EnvSpec("FrozenLake8x8-v1", kwargs={"is_slippery": False})
TASKS = {
    "cartpole": Declared("CartPole-v1", lambda: [Center(), Upright()], 150_000, dense=True),
    "pendulum": Declared("Pendulum-v1", lambda: [SwingUp(), Hold()], 300_000, dense=True),
    "reach": Declared(Reach, lambda: [Approach(), Brake()], 200_000, dense=True),
    "track": Declared(Track, lambda: [Chase(), Stay()], 150_000, dense=True),
    "acrobot": Declared("Acrobot-v1", lambda: [Pump(), Raise()], 200_000),
    "mountain-car": Declared("MountainCar-v0", lambda: [BuildSpeed(), Climb()], 200_000),
    "mountain-car-continuous": Declared(
        "MountainCarContinuous-v0", lambda: [BuildSpeed(), Climb()], 200_000
    ),
    "frozen-lake": Declared(LAKE, lambda: [East(), South()], 150_000),
    "taxi": Declared("Taxi-v4", lambda: [Fetch(), Bring()], 400_000),
    "switches": Declared(Switches, lambda: [First(), Second(), Third()], 150_000),
    "delivery": Declared(Delivery, lambda: [GetParcel(), Deliver(), GoHome()], 250_000),
    "locked": Declared(Locked, lambda: [GetKey(), OpenDoor(), Leave()], 250_000),
}
"""The list was written before any of it was trained."""


def score(name: str, way: str, seed: int, out: Path) -> float:
    """Return the mean return of 100 episodes after training."""
    task = TASKS[name]
    env = task.env if isinstance(task.env, EnvSpec) else EnvSpec(task.env, workers=1)
    hierarchy = Hierarchy(env, task.skills(), steps=task.steps)
    if way == "apart":
        hierarchy.learn = "apart"
    return scored(hierarchy, out / f"{name}-{way}-{seed}", seed, flat=way == "flat")


def scored(hierarchy: Hierarchy, folder: Path, seed: int, flat: bool = False) -> float:
    """Return the mean return of 100 episodes after training; a result that is there is read."""
    file = Path(f"{folder}.json")
    if file.exists():
        return float(json.loads(file.read_text())["mean"])
    run = hierarchy.train(folder, seed=seed, flat=flat, quiet=True)
    found = run.evaluate(100).to_json()
    stages = run.info()["stages"]
    kept = stages[-1].get("kept", {}).get("kept")
    file.write_text(json.dumps(found | {"kept": kept, "steps": sum(s["steps"] for s in stages)}))
    return float(found["mean"])


def compare(
    what: str,
    tasks: Mapping[str, str],
    ways: Sequence[str],
    seeds: Sequence[int],
    score: Callable[[str, str, int, Path], float],
    about: str | None,
) -> None:
    """Train tasks in several ways, and print a table of the scores.

    Args:
        what: the benchmark's name.
        tasks: their names, and their kinds for the table.
        seeds: the default.
        score: of a task, a way and a seed; the folder is for its runs.
        about: the description for ``--help``.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("names", nargs="*", default=list(tasks))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(seeds))
    parser.add_argument("--out", type=Path, default=Path("runs", what))
    parser.add_argument("--processes", type=int, default=2)
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    jobs = [(n, w, s) for n in asked.names for w in ways for s in asked.seeds]
    with workers(asked.processes) as pool:
        found = [(job, pool.submit(score, *job, asked.out)) for job in jobs]
        scores = {job: future.result() for job, future in found}
    rows = [
        [name, tasks[name]]
        + [" ".join(f"{scores[name, way, s]:.2f}" for s in asked.seeds) for way in ways]
        for name in asked.names
    ]
    print(table(["task", "reward", *ways], rows))
    plain = {"/".join(map(str, job)): value for job, value in scores.items()}
    report(what, {"seeds": asked.seeds, "scores": plain})


def main() -> None:
    """Train all, and print a table."""
    kinds = {name: "dense" if task.dense else "sparse" for name, task in TASKS.items()}
    compare("declarations", kinds, WAYS, (0, 1, 2), score, __doc__)


if __name__ == "__main__":
    main()
