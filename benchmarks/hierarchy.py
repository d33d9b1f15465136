"""Figures 1 to 3 and 10: a whole hierarchy, and the flat baseline on as many steps.

    python -m benchmarks.hierarchy [--recipe lunar-lander] [--seeds 0 1 2 3 4] [--no-flat]
    python -m benchmarks.hierarchy --apart --no-flat

With ``--apart`` the skills of ``lunar-lander`` learn one by one, then the selector, with the
settings and budgets of ``chains.LANDER_APART`` and ``chains.LANDER_APART_STEPS``.
Every run is a process of its own, so that its peak memory is its own. Training time is the sum
of the stages' seconds, without imports; scores are greedy over 100 episodes of Gymnasium's
environment with seeds that training never saw.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common import median, report, run_command, table


def declared(recipe: str, settings: list[str]) -> Any:
    """Return a recipe's hierarchy with other settings."""
    from skillweave import recipes
    from skillweave.cli.overrides import apply_overrides

    hierarchy = recipes.load(recipe)
    apply_overrides(hierarchy, settings)
    return hierarchy


def apart() -> list[str]:
    """Return the settings with which the skills of ``lunar-lander`` learn apart."""
    from benchmarks.chains import LANDER_APART, LANDER_APART_STEPS

    return LANDER_APART + LANDER_APART_STEPS


def one(recipe: str, seed: int, flat: bool, settings: list[str]) -> dict[str, object]:
    """Train and score in this process."""
    hierarchy = declared(recipe, settings)
    with tempfile.TemporaryDirectory() as folder:
        run = hierarchy.train(Path(folder) / "run", seed=seed, flat=flat, quiet=True)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        stages = run.info()["stages"]
        score = run.evaluate(100).to_json()
    return {
        "seed": seed,
        "steps": sum(p["steps"] for p in stages),
        "seconds": sum(p["seconds"] for p in stages),
        "score": score["mean"],
        "solved": score["solved_fraction"],
        "length": score["length_mean"],
        "peak_mb": peak,
        "usage": score["skill_usage"],
        "stages": {p["name"]: [p["steps"], p["seconds"]] for p in stages},
    }


def child(recipe: str, seed: int, flat: bool, settings: list[str]) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks.hierarchy", "--recipe", recipe, "--one", str(seed)]
    command += ["--flat-one"] * flat + [w for s in settings for w in ("--set", s)]
    done = run_command(command, capture=True)
    result: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recipe", default="lunar-lander")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--no-flat", action="store_true")
    parser.add_argument("--no-hierarchy", action="store_true")
    parser.add_argument("--apart", action="store_true")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--one", type=int)
    parser.add_argument("--flat-one", action="store_true")
    given = parser.parse_args()
    if given.apart and given.recipe != "lunar-lander":
        parser.error("--apart: its settings are those of the recipe lunar-lander")
    if given.apart:
        given.set = apart() + given.set
    if given.one is not None:
        print(json.dumps(one(given.recipe, given.one, given.flat_one, given.set)))
        return
    result: dict[str, object] = {"recipe": given.recipe, "settings": given.set}
    kinds = ["hierarchy"] * (not given.no_hierarchy) + ["flat"] * (not given.no_flat)
    for kind in kinds:
        rows = []
        for seed in given.seeds:
            rows.append(child(given.recipe, seed, kind == "flat", given.set))
            shown = [k for k in rows[0] if k not in ("usage", "stages")]
            print(
                f"{kind}:\n" + table(shown, [[_short(r[k]) for k in shown] for r in rows]),
                flush=True,
            )
        for key, worst in (("score", min), ("solved", min), ("seconds", max), ("peak_mb", max)):
            result[f"{kind}_{key}_median"] = median(r[key] for r in rows)
            result[f"{kind}_{key}_worst"] = worst(r[key] for r in rows)
        result[kind] = rows
    how = ["apart"] if given.apart else []
    report("-".join([*kinds, given.recipe, *how]), result)


def _short(value: float) -> str:
    return f"{value:,.2f}" if isinstance(value, float) else f"{value:,}"


if __name__ == "__main__":
    main()
