"""Evolution against random search and against the defaults, at equal environment steps.

    python -m benchmarks.search [--seeds 0 1 2 3 4] [--processes 2]

Four members begin with settings drawn from a wide prior over learning rate, γ, λ, entropy, clip,
width and depth, and train for a million steps each. Random search draws from the same prior, trains
every draw to its end and takes the best by the same fitness: once the same four draws, and once
eight draws of half as many steps. The defaults get all steps for one agent. Evolution selects by
truncation; "tournaments" is the same with the library's default selection. Scores are 100 greedy
episodes of Gymnasium's environment with seeds that training never saw.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.common import median, report, table, workers
from skillweave import PPO, Network, train_agent
from skillweave.evolution import Evolution, Mutations, Range, Tournament, Truncation

BUDGET, GENERATIONS = 4_000_000, 20
PRIOR = {
    "learning_rate": Range(1e-5, 1e-2),
    "gamma": Range(0.9, 0.9999, "complement"),
    "gae_lambda": Range(0.8, 0.99, "complement"),
    "ent_coef": Range(1e-5, 0.1),
    "clip_coef": Range(0.05, 0.5),
}
MUTATIONS = Mutations(
    none=0.2,
    hyperparameters=0.6,
    parameters=0.0,
    architecture=0.2,
    activation=0.0,
    ranges=PRIOR,
    units=(16, 256),
    layers=(1, 3),
)
# A generation is short, and while no member can land, the best one is so by chance. By truncation
# that member replaces the worst one only; by tournaments all others may be replaced at once.
EVOLVED = Evolution(
    4, GENERATIONS, episodes=20, start="random", selection=Truncation(), mutations=MUTATIONS
)
# One generation: the member that is best at the end of training.
RANDOM = {draws: replace(EVOLVED, population=draws, generations=1) for draws in (4, 8)}
MEMBER = PPO(
    num_envs=16,
    n_steps=64,
    batch_size=128,
    update_epochs=4,
    learning_rate=1e-3,
    gae_lambda=0.98,
    network=Network((64, 64), "relu"),
)
WAYS: dict[str, tuple[PPO, int, Evolution | None]] = {
    "evolution": (MEMBER, BUDGET // 4, EVOLVED),
    "random search, 4 draws": (MEMBER, BUDGET // 4, RANDOM[4]),
    "random search, 8 draws": (MEMBER, BUDGET // 8, RANDOM[8]),
    "defaults": (PPO(), BUDGET, None),
    "tournaments": (MEMBER, BUDGET // 4, replace(EVOLVED, selection=Tournament())),
}


def search(way: str, seed: int) -> dict[str, Any]:
    config, steps, evolve = WAYS[way]
    with tempfile.TemporaryDirectory() as folder:
        run = train_agent(
            "LunarLander-v3",
            config,
            steps,
            Path(folder) / "run",
            seed=seed,
            quiet=True,
            evolve=evolve,
        )
        score = run.evaluate(100)
        (stage,) = run.info()["stages"]
    return {
        "way": way,
        "seed": seed,
        "score": round(score.mean, 1),
        "solved": score.solved_fraction,
        "steps": stage["steps"],
        "seconds": round(stage["seconds"]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--ways", nargs="+", default=list(WAYS))
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    rows = []
    with workers(given.processes) as pool:
        jobs = [pool.submit(search, way, seed) for seed in given.seeds for way in given.ways]
        for job in jobs:
            rows.append(job.result())
            print(rows[-1], flush=True)
    print(table(list(rows[0]), [list(r.values()) for r in rows]))
    scores = {way: [r["score"] for r in rows if r["way"] == way] for way in given.ways}
    found = {f"{way} median": median(s) for way, s in scores.items()}
    found |= {f"{way} worst": min(s) for way, s in scores.items()}
    for way in scores:
        if way.startswith("random") and "evolution" in scores:
            pairs = zip(scores["evolution"], scores[way], strict=True)
            found[f"wins over {way}"] = sum(a > b for a, b in pairs)
    report("search", {"summary": found, "rows": rows})


if __name__ == "__main__":
    main()
