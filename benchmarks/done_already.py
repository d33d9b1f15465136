"""Skills that may be called where their work is done already, where a call ends at once.

    python -m benchmarks.done_already [NAME ...] [--seeds 0 1 2 3 4] [--out runs/done-already]

Four chains with the defaults, README's key and door among them, are declared twice: "open" has
initiation sets that say what a skill needs, but not that it is done; "closed" says both. A score is
the mean return of 100 episodes, at most 1.
"""

# Skills are written as users write them, where NumPy returns Any.
# mypy: disable-error-code="no-any-return"

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.declarations import compare, gained, scored
from benchmarks.declared_worlds import Locked, Switches
from examples.bridge import AXE, BRIDGE, WOOD, River
from skillweave import PPO, EnvSpec, Hierarchy, Skill, Step
from skillweave.toys import KeyDoor
from skillweave.types import Array

WAYS = ("open", "closed")


class Fetch(Skill):
    """Sets a flag of the observation, and ends where it is set.

    Args:
        does: the column of the flag.
        needs: the columns of flags that must be set.
        closed: it may not start where it is done.
        progress: how much nearer steps came to the place of the work; None: unknown.
    """

    max_steps = 32

    def __init__(
        self,
        name: str,
        does: int,
        needs: Sequence[int] = (),
        *,
        closed: bool,
        progress: Callable[[Step], Array] | None = None,
    ) -> None:
        super().__init__()
        self.name = name
        self.does, self.needs, self.closed, self.progress = does, list(needs), closed, progress

    def initiation(self, obs: Array) -> Array:
        may = (obs[:, self.needs] == 1).all(axis=1)
        return may & (obs[:, self.does] != 1) if self.closed else may

    def reward(self, step: Step) -> Array:
        if self.progress is not None:
            return self.progress(step)
        return (step.next_obs[:, self.does] > step.obs[:, self.does]) - 0.01

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, self.does] == 1


class Last(Skill):
    """Does what the task pays for; may start where all flags of ``needs`` are set."""

    max_steps = 32

    def __init__(
        self, needs: Sequence[int], progress: Callable[[Step], Array] | None = None
    ) -> None:
        super().__init__()
        self.needs, self.progress = list(needs), progress

    def initiation(self, obs: Array) -> Array:
        return (obs[:, self.needs] == 1).all(axis=1)

    def reward(self, step: Step) -> Array:
        return step.reward - 0.01 if self.progress is None else self.progress(step)


def key_door(closed: bool) -> list[Skill]:
    return [
        Fetch("get_key", 4, closed=closed, progress=lambda step: gained(step, step.obs[:, 2:4])),
        Fetch("open_door", 5, [4], closed=closed, progress=lambda step: gained(step, (0.2, 0.0))),
        Last([5], lambda step: gained(step, (1.0, 0.0))),
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


CHAINS: dict[str, tuple[Any, Callable[[bool], list[Skill]], int]] = {
    "key-door": (KeyDoor, key_door, 120_000),
    "bridge": (River, bridge, 500_000),
    "switches": (Switches, switches, 150_000),
    "locked": (Locked, locked, 250_000),
}
"""Environment, skills (closed or open) and steps."""
LEARNER = PPO(num_envs=64, n_steps=64, batch_size=256, update_epochs=10, learning_rate=1e-3)
"""The algorithm of skills and selectors."""


def score(name: str, way: str, seed: int, out: Path) -> float:
    """Return the mean return of 100 episodes after training."""
    env, skills, steps = CHAINS[name]
    hierarchy = Hierarchy(
        EnvSpec(env, workers=1),
        skills(way == "closed"),
        algorithm=LEARNER,
        selector=LEARNER,
        steps=steps,
    )
    return scored(hierarchy, out / f"{name}-{way}-{seed}", seed)


def main() -> None:
    """Train all, and print a table."""
    compare("done-already", dict.fromkeys(CHAINS, "sparse"), WAYS, range(5), score, __doc__)


if __name__ == "__main__":
    main()
