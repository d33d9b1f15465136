"""Three skills of a half-cheetah, each from its own steps and from those of all three.

    python -m benchmarks.shared [apart shared half together alone] [--seeds 0 1]

They run forward, run backward, and hold the nose up. ``apart``: 100k steps each. ``shared``: the
same, but each also learns from the steps of those before it, which are half of each batch.
``half``: the same with 50k steps each, and twice the gradient steps, so equally many. ``together``:
they are called by chance for 300k steps, and half of each batch are steps of the others;
``alone``: so, but each learns from its own steps. A score is the mean return of 100 calls, as a
share of the way from no force (0) to ``apart`` (1).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import report, table, workers
from skillweave import SAC, EnvSpec, Hierarchy, Network, Skill, Step
from skillweave.types import Array

CALLS = 100
PITCH, SPEED = 1, 8
"""Places of the observation: the angle of the body, and its speed forward."""
KINDS = ("apart", "shared", "half", "together", "alone")


class Cheetah(Skill):
    """A skill of the half-cheetah, which costs force."""

    max_steps = 200

    def force(self, step: Step) -> Array:
        """Return the cost of the force."""
        cost: Array = 0.1 * np.square(step.action).sum(axis=1)
        return cost


class Forward(Cheetah):
    """Run forward."""

    def reward(self, step: Step) -> Array:
        """Return the speed forward, less the cost."""
        paid: Array = step.next_obs[:, SPEED] - self.force(step)
        return paid


class Back(Cheetah):
    """Run backward."""

    def reward(self, step: Step) -> Array:
        """Return the speed backward, less the cost."""
        paid: Array = -step.next_obs[:, SPEED] - self.force(step)
        return paid


class Stand(Cheetah):
    """Hold the nose up."""

    def reward(self, step: Step) -> Array:
        """Return 1 where the body is upright, nose up, 0 where it lies, less the cost."""
        paid: Array = -np.sin(step.next_obs[:, PITCH]) - self.force(step)
        return paid


def no_force(obs: Array) -> Array:
    """Return no force."""
    return np.zeros((len(obs), 6), np.float32)


NAMES = ("forward", "back", "stand")


def by_chance(obs: Array) -> Array:
    """Choose a skill by the last digits of the body's height, which are as good as dice."""
    return np.array(NAMES)[(np.abs(obs[:, 0]) * 1e6).astype(np.int64) % 3]


def returns(run: Any, seed: int) -> dict[str, float]:
    """Return the mean return of a call of each skill."""
    found = {}
    for name in NAMES:
        score = run.evaluate(CALLS, skill=name, seed=seed, quiet=True).skills[name]
        found[name] = score.return_sum / score.calls
    return found


def trained(kind: str, seed: int) -> dict[str, Any]:
    """Train the skills in one way; return their mean returns, and minutes of processor."""
    began = time.process_time()
    algorithm = SAC(
        network=Network((128, 128), "relu"),
        update_ratio=1.0 if kind == "half" else 0.5,
        shared_replay=0.0 if kind in ("apart", "alone") else 0.5,
    )
    hierarchy = Hierarchy(
        EnvSpec("HalfCheetah-v5", workers=1),
        [Forward(), Back(), Stand()],
        algorithm=algorithm,
        selector=by_chance,
        learn="together" if kind in ("together", "alone") else "apart",
        steps=150_000 if kind == "half" else 300_000,
    )
    with tempfile.TemporaryDirectory() as folder:
        found = returns(hierarchy.train(Path(folder) / "run", seed=seed, quiet=True), 1)
    return found | {"minutes": (time.process_time() - began) / 60}


def nothing() -> dict[str, float]:
    """Return the mean returns of the skills where no force is applied."""
    still = [type(k.__name__, (k,), {"policy": no_force})() for k in (Forward, Back, Stand)]
    hierarchy = Hierarchy("HalfCheetah-v5", still, selector=by_chance)
    with tempfile.TemporaryDirectory() as folder:
        return returns(hierarchy.train(Path(folder) / "run", quiet=True), 1)


def main() -> None:
    """Train in the ways of the command line, and print returns and shares."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("kinds", nargs="*", default=KINDS, choices=KINDS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    asked = parser.parse_args()
    jobs = [(kind, seed) for seed in asked.seeds for kind in asked.kinds]
    with workers(2) as pool:
        futures = {job: pool.submit(trained, *job) for job in jobs}
        found = {job: future.result() for job, future in futures.items()}
    zero = nothing()
    rows = []
    for (kind, seed), row in found.items():
        one = found.get(("apart", seed))
        for name in NAMES:
            share = (row[name] - zero[name]) / (one[name] - zero[name]) if one else np.nan
            rows.append([kind, seed, name, round(row[name], 1), round(share, 2)])
    print(f"no force: {zero}")
    print(table(["kind", "seed", "skill", "return", "share"], rows))
    report("shared", {"nothing": zero, "scores": rows})


if __name__ == "__main__":
    main()
