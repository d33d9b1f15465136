"""Train the flat agents that ``skillweave demo`` quotes, and record their scores for it.

    python -m benchmarks.demo_flat [--seed 0] [--scale 1.0] [--out skillweave/demo/demo_flat.json]

They take about five minutes, so the demo does not train them. Each has as many steps as the
hierarchy of its task in all, those of the skills included.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from skillweave import Agent, recipes
from skillweave.demo.demo_command import (
    EPISODES,
    FLAT_RESULTS,
    MISSION,
    NEW_SELECTOR_STEPS,
    complete,
)
from skillweave.recipes import lander_missions as missions


def agents() -> dict[str, Agent]:
    """Return the flat agent of each task of the demo."""
    flat = missions.declare(MISSION).plain_agent()
    flat.steps = missions.declare().total_steps + NEW_SELECTOR_STEPS
    return {"lunar-lander": recipes.load("lunar-lander").plain_agent(), MISSION: flat}


def record(agent: Agent, task: str, seed: int, folder: Path) -> dict[str, Any]:
    """Train and score an agent."""
    run = agent.train(folder, seed=seed)
    score = run.evaluate(EPISODES[task])
    return {
        "steps": agent.steps,
        "seed": seed,
        "episodes": EPISODES[task],
        "mean": round(score.mean, 3),
        "complete": complete(score),
        "command": "python -m benchmarks.demo_flat",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--out", type=Path, default=FLAT_RESULTS)
    asked = parser.parse_args()
    found = {}
    for name, agent in agents().items():
        agent.steps = max(1, round(agent.steps * asked.scale))
        with tempfile.TemporaryDirectory() as folder:
            found[name] = record(agent, name, asked.seed, Path(folder) / "run")
        asked.out.write_text(json.dumps(found, indent=2) + "\n")
        print(name, found[name], flush=True)


if __name__ == "__main__":
    main()
