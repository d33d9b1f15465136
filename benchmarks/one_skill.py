"""One skill and calls of one step, learning together, against a flat agent on the same reward.

    python -m benchmarks.one_skill [--seeds 0 1 2 3] [--steps 60000]

CartPole-v1 by PPO. The skill is paid what the environment pays, and ends where the episode ends, so
both learn the same task from as many steps. They do not have the same weights: a skill draws its
random numbers row by row, as it is called, a plain agent those of a rollout at once. A score is the
mean of 50 greedy episodes.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from benchmarks.common import median, report, table
from skillweave import (
    PPO,
    EnvSpec,
    Hierarchy,
    Network,
    Selection,
    Skill,
    Step,
    Together,
    train_agent,
)
from skillweave.types import Array

SPEC = EnvSpec("CartPole-v1", engine="sync", workers=1)
CONFIG = PPO(num_envs=16, n_steps=64, network=Network((64, 64), "tanh"))
EPISODES = 50


class Task(Skill):
    """A skill with the environment's own reward."""

    def reward(self, step: Step) -> Array:
        """Return the environment's reward."""
        return step.reward


def flat(seed: int, steps: int, path: Path) -> float:
    run = train_agent(SPEC, CONFIG, steps, path, seed=seed, quiet=True)
    return run.evaluate(EPISODES).mean


def together(seed: int, steps: int, path: Path) -> float:
    hierarchy = Hierarchy(
        SPEC,
        [Task()],
        algorithm=CONFIG,
        selector=CONFIG,
        call_steps=1,
        learn="together",
        together=Together(epsilon=0.0, epsilon_final=0.0, quota=1.0, steps=steps),
        selection=Selection(greedy_skills=True),
    )
    return hierarchy.train(path, seed=seed, quiet=True).evaluate(EPISODES).mean


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--steps", type=int, default=60_000)
    asked = parser.parse_args()
    found: dict[str, list[float]] = {"flat": [], "together": []}
    for seed in asked.seeds:
        for name, learn in (("flat", flat), ("together", together)):
            with tempfile.TemporaryDirectory() as folder:
                found[name].append(learn(seed, asked.steps, Path(folder) / "run"))
            print(f"{name}, seed {seed}: {found[name][-1]:.1f}", flush=True)
    each = {name: " ".join(f"{s:.1f}" for s in scores) for name, scores in found.items()}
    rows = [(n, f"{median(s):.1f}", f"{min(s):.1f}", each[n]) for n, s in found.items()]
    print(table(("learns", "median", "worst", "each"), rows))
    report("one_skill", {"seeds": asked.seeds, "steps": asked.steps, "scores": found})


if __name__ == "__main__":
    main()
