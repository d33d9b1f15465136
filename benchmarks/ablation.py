"""Ablation: the limits of the hierarchy with the tutorial's three skills.

    python -m benchmarks.ablation [--seeds 0 1 2]

The skills are trained once a seed, as the recipe says; then only the selector is trained again,
with one thing changed at a time. The last rows train the landing skill with other settings and
score it alone, since the selector cannot be better than what it selects from.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.common import median, report, table
from benchmarks.grouped import act_by, regroup
from skillweave import Hierarchy, recipes
from skillweave.skills import Skill
from skillweave.types import Policy

Change = Callable[[Hierarchy], None]


def no_reflex(h: Hierarchy) -> None:
    h.reflexes = ()


def sampled(h: Hierarchy) -> None:
    regroup(h, greedy_skills=False)


def calls_of(steps: int) -> Change:
    def change(h: Hierarchy) -> None:
        h.call_steps = steps

    return change


SELECTORS: dict[str, Change] = {
    "as shipped (calls of 10 steps)": lambda h: None,
    "calls of 4 steps": calls_of(4),
    "calls of 40 steps": calls_of(40),
    "skills sample inside a call": sampled,
    "no reflex": no_reflex,
}
LANDINGS: dict[str, dict[str, float]] = {
    "landing alone, 600k steps": {"steps": 600_000},
    "landing alone, little exploration (ent_coef 0.01)": {"ent_coef": 0.01},
    "landing alone, γ = 0.99": {"gamma": 0.99},
}


def trained_skills(seed: int, only: str | None = None, **settings: float) -> dict[str, Policy]:
    """Return the recipe's skills after training, without a selector to speak of."""
    h = recipes.load("lunar-lander")
    regroup(h, selector_steps=1)
    if only is not None:
        h.skills = [h.skill(only)]
    landing = h.skill("landing")
    landing.steps = int(settings.pop("steps", landing.steps or 0))
    landing.algorithm = replace(landing.algorithm, **settings)
    with tempfile.TemporaryDirectory() as folder:
        run = h.train(Path(folder) / "run", seed=seed, quiet=True)
        policies: Sequence[Policy] = run.policy.skills.policies  # type: ignore[attr-defined]
    return {s.name: p for s, p in zip(h.skills, policies, strict=True)}


def score(h: Hierarchy, seed: int) -> tuple[float, float]:
    with tempfile.TemporaryDirectory() as folder:
        result = h.train(Path(folder) / "run", seed=seed, quiet=True).evaluate(100)
    return result.mean, result.solved_fraction or 0.0


def alone(policy: Policy, seed: int) -> tuple[float, float]:
    h = recipes.load("lunar-lander")
    skill: Skill = h.skill("landing")
    act_by(skill, policy)
    h.skills = [skill]
    regroup(h, selector_steps=1)
    return score(h, seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    given = parser.parse_args()
    found: dict[str, list[tuple[float, float]]] = {}
    for seed in given.seeds:
        policies = trained_skills(seed)
        found.setdefault("landing alone, no selector", []).append(alone(policies["landing"], seed))
        for name, change in SELECTORS.items():
            h = recipes.load("lunar-lander")
            for skill in h.skills:
                act_by(skill, policies[skill.name])
            change(h)
            found.setdefault(name, []).append(score(h, seed))
        for name, settings in LANDINGS.items():
            policy = trained_skills(seed, "landing", **settings)["landing"]
            found.setdefault(name, []).append(alone(policy, seed))
        rows = [
            [
                k,
                *(f"{m:.1f}" for m, _ in v),
                f"{median(m for m, _ in v):.1f}",
                f"{median(s for _, s in v):.0%}",
            ]
            for k, v in found.items()
        ]
        done = [f"seed {s}" for s in given.seeds[: len(rows[0]) - 3]]
        print(table(["variant", *done, "median", "solved"], rows), flush=True)
    report("ablation", {"seeds": given.seeds, "scores": found})


if __name__ == "__main__":
    main()
