"""The chance of missions that a plan predicts, beside what is done when it is played.

    python -m benchmarks.missions [--seed 69] [--episodes 20]

Twenty missions from a grammar, and twenty written by hand, of which ten are impossible. Half of
them are for functions that move in KeyDoor, half for the shipped skills of ``lander-missions``. The
figure: the calibration error in five bins, the Brier score beside that of the mean rate, and which
missions are named as impossible.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import skillweave as sw
from benchmarks.common import table
from skillweave.errors import DeclarationError, RunError
from skillweave.planning import Planner
from skillweave.toys import KeyDoor
from skillweave.types import Array, Step

X, Y, KEY_X, KEY_Y, HAS_KEY, IS_OPEN = range(6)
Words = Mapping[str, Callable[[Array], Array]]
ROOMS: Words = {
    "key": lambda obs: obs[:, HAS_KEY] == 1,
    "nokey": lambda obs: obs[:, HAS_KEY] == 0,
    "opened": lambda obs: obs[:, IS_OPEN] == 1,
    "closed": lambda obs: obs[:, IS_OPEN] == 0,
    "west": lambda obs: obs[:, X] < -0.7,
    "east": lambda obs: obs[:, X] > 0.4,
    "north": lambda obs: obs[:, Y] > 0.4,
    "south": lambda obs: obs[:, Y] < -0.4,
}
SKY: Words = {
    "high": lambda obs: obs[:, 1] > 1.0,
    "low": lambda obs: obs[:, 1] < 0.4,
    "tilted": lambda obs: np.abs(obs[:, 4]) > 0.4,
    "fast": lambda obs: np.hypot(obs[:, 2], obs[:, 3]) > 0.8,
}
LEGS = ("left", "right", "hover", "land")
POSSIBLE = (
    ("key then opened", "opened then east", "key for 10 steps", "west or east", "opened then west"),
    ("left then right", "right then left then hover", "hover then land", "high then land",
     "left, avoid land"),
)  # fmt: skip
IMPOSSIBLE = (
    ("key then nokey", "opened, avoid key", "opened then closed", "east, avoid opened",
     "key then east then nokey"),
    ("land then left", "land then high", "land, avoid low", "hover then land then right",
     "left then land then hover"),
)  # fmt: skip


class Move(sw.Skill):
    """Move to a point."""

    max_steps = 20
    place: tuple[float, float]

    def point(self, obs: Array) -> Array:
        """Return the point, (n, 2) or (1, 2)."""
        return np.array([self.place])

    def policy(self, obs: Array) -> Array:
        """Move towards it."""
        way: Array = np.clip((self.point(obs) - obs[:, [X, Y]]) / 0.05, -1, 1)
        return way

    def termination(self, step: Step) -> Array:
        """Return whether it is there."""
        off = np.abs(self.point(step.next_obs) - step.next_obs[:, [X, Y]])
        there: Array = off.max(axis=1) < 0.02
        return there


class ToKey(Move):
    """Move to where the key is, or was."""

    def point(self, obs: Array) -> Array:
        """Return the key's place."""
        key: Array = obs[:, [KEY_X, KEY_Y]]
        return key


class ToDoor(Move):
    """Move to the door."""

    place = (0.1, 0.0)


class Left(Move):
    """Move to the left."""

    place = (-0.8, 0.0)


class Right(Move):
    """Move to the right, behind the door."""

    place = (0.5, 0.0)


@dataclass
class Row:
    """A mission, its predicted chance, and the rate that was measured."""

    mission: str
    chance: float
    rate: float
    named: bool


def rooms() -> sw.Run:
    """Return the functions in KeyDoor, with a log."""
    skills = [ToKey(), ToDoor(), Left(), Right()]
    hierarchy = sw.Hierarchy(
        KeyDoor, skills, call_steps=None, selector=lambda obs: ["left"] * len(obs)
    )
    run = hierarchy.train(quiet=True)
    run.log_calls(10_000)
    return run


def lander() -> sw.Run:
    """Return the shipped skills of the lander, with a log."""
    run = sw.Hierarchy.pretrained("lander-missions")
    run.log_calls(20_000)
    return run


def drawn(rng: np.random.Generator, words: Sequence[str]) -> str:
    """Return a mission of one to three legs."""

    def leg(inner: bool = False) -> str:
        word, chance = str(rng.choice(words)), rng.random()
        if chance < 0.15:
            return f"{word} for {rng.choice([3, 10, 30])} steps"
        if chance < 0.4 and not inner:
            return f"({leg(True)} {'or' if chance < 0.3 else 'and'} {leg(True)})"
        return word

    text = " then ".join(leg() for _ in range(rng.integers(1, 4)))
    return f"{text}, avoid {rng.choice(words)}" if rng.random() < 0.3 else text


def judged(run: sw.Run, mission: str, words: Words, episodes: int) -> Row | None:
    """Return what is predicted and measured; None: it is no mission."""
    try:
        planned = run.plan(mission, predicates=words)
    except DeclarationError:
        return None
    except RunError:
        return Row(mission, 0.0, 0.0, True)
    chance, planner = planned.explain().chance or 0.0, planned.hierarchy.selector
    assert isinstance(planner, Planner)
    succeeded = planned.evaluate(episodes, quiet=True).succeeded or 0
    return Row(mission, chance, succeeded / episodes, bool(planner.obstacle))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and the figure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.missions")
    parser.add_argument("--seed", type=int, default=69)
    parser.add_argument("--episodes", type=int, default=20)
    given: Any = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    rows: list[Row] = []
    for i, (make, words, further) in enumerate(((rooms, ROOMS, ()), (lander, SKY, LEGS))):
        run, rng, few = make(), np.random.default_rng(given.seed), list[Row]()
        texts = [*POSSIBLE[i], *IMPOSSIBLE[i]]
        while len(few) < 20:
            mission = texts[len(few)] if len(few) < 10 else drawn(rng, [*words, *further])
            row = judged(run, mission, words, given.episodes)
            few += [] if row is None else [row]
        rows += few
    cells = [(r.mission, f"{r.chance:.2f}", f"{r.rate:.2f}", "×" * r.named) for r in rows]
    print(table(("mission", "chance", "rate", "impossible"), cells))
    chance, rate = (np.array([getattr(r, name) for r in rows]) for name in ("chance", "rate"))
    bins = np.minimum((chance * 5).astype(int), 4)
    off = [abs((chance - rate)[bins == b].sum()) for b in range(5)]
    brier = ((chance - rate) ** 2 + rate * (1 - rate)).mean()
    impossible = [r for r in rows if r.mission in IMPOSSIBLE[0] + IMPOSSIBLE[1]]
    error = np.abs(chance - rate).mean()
    print(f"calibration error {sum(off) / len(rows):.3f}, mean |chance − rate| {error:.3f}")
    print(f"Brier score {brier:.3f}; of the mean rate {rate.mean() * (1 - rate.mean()):.3f}")
    named, wrong = sum(r.named for r in impossible), sum(r.named and r.rate > 0.05 for r in rows)
    print(f"impossible: {named} of {len(impossible)} named; named and done in over 5 %: {wrong}")


if __name__ == "__main__":
    main()
