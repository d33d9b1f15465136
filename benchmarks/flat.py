"""Figures 4 and 5: flat PPO, training time until an evaluation reaches 200, score after 30 s.

    python -m benchmarks.flat [--seeds 0 1 2 3 4] [--steps 2500000] [--plain]

It has the settings of the recipe ``lunar-lander``; with ``--plain`` it is ``PPO()``.
The policy is copied once a second of training and scored afterwards, greedily, over 100 episodes
of Gymnasium's environment with seeds that training never saw.
"""

from __future__ import annotations

import argparse
from typing import Any

from benchmarks.bare import train_bare
from benchmarks.common import median, report, table, warm_up
from skillweave import PPO, recipes
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.training.episodes import Tick
from skillweave.training.evaluation import evaluate
from skillweave.training.learner import Stack


def learn(seed: int, steps: int, every: float, plain: bool) -> dict[str, object]:
    hierarchy = recipes.load("lunar-lander")
    config = PPO() if plain else hierarchy.train_defaults.flat or hierarchy.algorithm
    copies: list[tuple[float, int, AgentPolicy]] = []

    last: list[Tick] = []

    def on_tick(tick: Tick, stack: Stack) -> None:
        last[:] = [tick]
        if tick.seconds >= every * (len(copies) + 1):
            policy = AgentPolicy.of(stack.algorithm, stack.state)
            copies.append((tick.seconds, tick.steps, policy))

    seeds = Seeds(seed) / "flat"
    stack = train_bare(hierarchy.spec, config, seeds, steps, on_tick)
    seconds = last[-1].seconds
    scores = []
    reached = None
    for at, spent, policy in copies:
        score = evaluate(policy, hierarchy.spec, episodes=100)
        scores.append((at, spent, score.mean, score.solved_fraction))
        if score.mean >= 200:
            reached = at
            break
    final = evaluate(AgentPolicy.of(stack.algorithm, stack.state), hierarchy.spec, episodes=100)
    return {
        "seed": seed,
        "seconds_to_200": reached,
        "seconds": seconds,
        "steps_per_second": last[-1].steps / seconds,
        "final": final.mean,
        "final_solved": final.solved_fraction,
        "curve": scores,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--steps", type=int, default=2_500_000)
    parser.add_argument("--every", type=float, default=1.0)
    parser.add_argument("--plain", action="store_true")
    given = parser.parse_args()
    warm_up()
    rows: list[dict[str, Any]] = []
    for seed in given.seeds:
        rows.append(learn(seed, given.steps, given.every, given.plain))
        shown = [k for k in rows[0] if k != "curve"]
        print(table(shown, [[_short(r[k]) for k in shown] for r in rows]), flush=True)
    times = [r["seconds_to_200"] or float("inf") for r in rows]
    report(
        "flat",
        {
            "seconds_to_200_median": median(times),
            "seconds_to_200_worst": max(times),
            "score_median": median(r["final"] for r in rows),
            "score_worst": min(r["final"] for r in rows),
            "seconds_median": median(r["seconds"] for r in rows),
            "rows": rows,
        },
    )


def _short(value: object) -> str:
    return f"{value:,.2f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
