"""Pick and place with skills that own their parts: some move the arm, some the fingers.

    python -m benchmarks.own_parts [--seeds 0] [--scale 1.0] [--out runs/own-parts]

The skills are those of ``pick-and-place``, cut in two: four see what they need of the observation
and move the arm, one of them is learnt; two move the fingers. While the arm moves the fingers keep
their grip, and while the fingers move the arm stands still. A selector learns when to use which.
Printed: the share of 100 episodes in calm that succeed.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np

from skillweave import Apart, Hierarchy, Skill, Step
from skillweave.recipes import pick_and_place as whole
from skillweave.recipes._arm import is_held, spec
from skillweave.types import Array

ARM, FINGERS = slice(0, 3), 3
REST = (0.0, 0.0, 0.0, "hold")
"""The arm stands still, the fingers keep their grip."""
OPEN = 0.085
"""Metres between open fingers, at least."""


def is_open(obs: Array) -> Array:
    """Return whether the fingers are open, (N,) bool."""
    opened: Array = obs[:, whole.FINGERS].sum(axis=1) > OPEN
    return opened


def move(way: Array) -> Array:
    """Return the arm's action (n, 3) for a way (n, 3) in metres."""
    moved: Array = np.clip(10.0 * way, -1.0, 1.0).astype(np.float32)
    return moved


def rise(offset: Array) -> Array:
    """Return the arm's action that leads above the block, for its way to the block (n, 3)."""
    return move(offset + np.array([0.0, 0.0, 0.1]))


def widen(fingers: Array) -> Array:
    """Return the fingers' action (n, 1) that opens them."""
    return np.ones((len(fingers), 1), np.float32)


def narrow(fingers: Array) -> Array:
    """Return the fingers' action (n, 1) that closes them."""
    return -widen(fingers)


def to_goal(obs: Array) -> Array:
    """Return the way of the block to the goal, (n, 3)."""
    way: Array = obs[:, whole.GOAL] - obs[:, whole.BLOCK]
    return way


class Above(whole.Above):
    """Move the arm above the block."""

    sees, acts = whole.OFFSET, ARM

    policy = rise

    def initiation(self, obs: Array) -> Array:
        """Return whether the fingers are open."""
        return is_open(obs)


class Descend(whole.Descend):
    """Move the arm down around the block."""

    sees, acts = whole.OFFSET, ARM
    policy = move

    def initiation(self, obs: Array) -> Array:
        """Return whether it is above the block with open fingers."""
        return whole.is_above(obs) & is_open(obs)


class Carry(whole.Carry):
    """Move the arm with the block to the goal."""

    sees, acts = to_goal, ARM
    policy = move


class Recover(whole.Recover):
    """Move the arm until the block is between the fingers. It is learnt."""

    sees, acts = (whole.OFFSET, slice(11, 25)), ARM

    def initiation(self, obs: Array) -> Array:
        """Return whether the fingers are open."""
        return is_open(obs)


class Open(Skill):
    """Open the fingers, until they are open."""

    sees, acts = whole.FINGERS, FINGERS

    policy = widen

    def initiation(self, obs: Array) -> Array:
        """Return whether they are not open, and hold nothing."""
        return ~is_open(obs) & ~is_held(obs)

    def termination(self, step: Step) -> Array:
        """Return whether they are open."""
        return is_open(step.next_obs)


class Close(whole.Close):
    """Close the fingers, until they hold the block."""

    sees, acts = whole.FINGERS, FINGERS

    policy = narrow


def declare() -> Hierarchy:
    """Return the hierarchy of six skills with parts."""
    return Hierarchy(
        spec(),
        [Open(), Above(), Descend(), Close(), Carry(), Recover()],
        rest=REST,
        call_steps=10,
        algorithm=whole.LEARNER,
        selector=whole.SELECTOR,
        learn="apart",
        apart=Apart(skill_steps=20_000, selector_steps=60_000),
    )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--scale", type=float, default=1.0, help="of all budgets")
    parser.add_argument("--out", type=Path, default=Path("runs/own-parts"))
    asked = parser.parse_args(arguments)
    for seed in asked.seeds:
        place = asked.out / str(seed)
        shutil.rmtree(place, ignore_errors=True)
        hierarchy = declare()
        hierarchy.scale(asked.scale)
        run = hierarchy.train(place, seed=seed, quiet=True)
        found = run.evaluate(episodes=100, seed=1000 + seed)
        calls = ", ".join(f"{name} {n}" for name, n in found.skill_calls.items())
        print(f"seed {seed}: {found.mean:.0%} of 100 episodes succeed; calls: {calls}", flush=True)


if __name__ == "__main__":
    main()
