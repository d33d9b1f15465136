"""Skills that may be called where their work is done already, where a call ends at once.

    python -m benchmarks.done_already [NAME ...] [--seeds 0 1 2 3 4] [--out runs/done-already]

Four chains with the defaults, README's key and door among them, are declared twice: "open" has
initiation sets that say what a skill needs, but not that it is done; "closed" says both. A score is
the mean return of 100 episodes, at most 1.
"""

# Skills are written as users write them, where NumPy returns Any.
# mypy: disable-error-code="no-any-return"

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import report, table, workers
from benchmarks.declared_worlds import Locked, Switches
from examples.bridge import AXE, BRIDGE, WOOD, River
from skillweave import Array, EnvSpec, Hierarchy, Skill, Step
from skillweave.toys import KeyDoor

WAYS = ("open", "closed")


class Fetch(Skill):
    """Sets flags of an observation, one or more; ends where all are set.

    Args:
        does, needs: columns of flags.
        closed: it may not start where it is done.
        towards: returns how much nearer steps came to the place of the work; None: unknown.
    """

    max_steps = 32

    def __init__(
        self,
        name: str,
        does: int,
        needs: Sequence[int] = (),
        *,
        closed: bool,
        towards: Callable[[Step], Array] | None = None,
    ) -> None:
        super().__init__()
        self.name = name
        self.does, self.needs, self.closed, self.towards = does, list(needs), closed, towards

    def initiation(self, obs: Array) -> Array:
        may = (obs[:, self.needs] == 1).all(axis=1)
        return may & (obs[:, self.does] != 1) if self.closed else may

    def reward(self, step: Step) -> Array:
        if self.towards is not None:
            return self.towards(step)
        return (step.next_obs[:, self.does] > step.obs[:, self.does]) - 0.01

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, self.does] == 1


class Last(Skill):
    """Does what the task pays for; may start anywhere, or where a flag is set."""

    max_steps = 32

    def __init__(
        self, needs: Sequence[int], towards: Callable[[Step], Array] | None = None
    ) -> None:
        super().__init__()
        self.needs, self.towards = list(needs), towards

    def initiation(self, obs: Array) -> Array:
        return (obs[:, self.needs] == 1).all(axis=1)

    def reward(self, step: Step) -> Array:
        return step.reward - 0.01 if self.towards is None else self.towards(step)


def towards(place: Callable[[Step], Array] | Sequence[float]) -> Callable[[Step], Array]:
    """Return a reward: how much nearer a step came to a place in the plane."""

    def gained(step: Step) -> Array:
        to = place(step) if callable(place) else np.array(place)
        before = np.linalg.norm(step.obs[:, :2] - to, axis=1)
        return before - np.linalg.norm(step.next_obs[:, :2] - to, axis=1)

    return gained


def key_door(closed: bool) -> list[Skill]:
    return [
        Fetch("get_key", 4, closed=closed, towards=towards(lambda step: step.obs[:, 2:4])),
        Fetch("open_door", 5, [4], closed=closed, towards=towards((0.2, 0.0))),
        Last([5], towards((1.0, 0.0))),
    ]


def bridge(closed: bool) -> list[Skill]:
    return [
        Fetch("get_axe", AXE, closed=closed),
        Fetch("chop", WOOD, [AXE], closed=closed),
        Fetch("build", BRIDGE, [WOOD], closed=closed),
        Last([]),
    ]


def switches(closed: bool) -> list[Skill]:
    return [Fetch(f"press_{i}", i, range(1, i), closed=closed) for i in (1, 2, 3)]


def locked(closed: bool) -> list[Skill]:
    return [
        Fetch("get_key", 4, closed=closed),
        Fetch("open_door", 5, [4], closed=closed),
        Last([]),
    ]


@dataclass(frozen=True)
class Chain:
    env: Any
    skills: Callable[[bool], list[Skill]]
    steps: int


CHAINS = {
    "key-door": Chain(KeyDoor, key_door, 120_000),
    "bridge": Chain(River, bridge, 500_000),
    "switches": Chain(Switches, switches, 150_000),
    "locked": Chain(Locked, locked, 250_000),
}


def score(name: str, way: str, seed: int, out: Path) -> float:
    """Return the mean return of 100 episodes after training; a result that is there is read."""
    file = out / f"{name}-{way}-{seed}.json"
    if file.exists():
        return float(json.loads(file.read_text())["mean"])
    chain = CHAINS[name]
    env = EnvSpec(chain.env, workers=1)
    hierarchy = Hierarchy(env, chain.skills(way == "closed"), steps=chain.steps)
    run = hierarchy.train(out / f"{name}-{way}-{seed}", seed=seed, quiet=True)
    found = run.evaluate(100).to_json()
    file.write_text(json.dumps(found | {"kept": run.info()["stages"][-1].get("kept")}))
    return float(found["mean"])


def main() -> None:
    """Train all, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(CHAINS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--out", type=Path, default=Path("runs/done-already"))
    parser.add_argument("--processes", type=int, default=2)
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    jobs = [(n, w, s) for n in asked.names for w in WAYS for s in asked.seeds]
    with workers(asked.processes) as pool:
        found = [(job, pool.submit(score, *job, asked.out)) for job in jobs]
        scores = {job: future.result() for job, future in found}
    rows = [
        [name] + [" ".join(f"{scores[name, w, s]:.2f}" for s in asked.seeds) for w in WAYS]
        for name in asked.names
    ]
    print(table(["chain", *WAYS], rows))
    plain = {"/".join(map(str, job)): value for job, value in scores.items()}
    report("done-already", {"seeds": asked.seeds, "scores": plain})


if __name__ == "__main__":
    main()
