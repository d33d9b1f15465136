"""The tasks of ``benchmarks.together``: chains of skills, and the tutorial's three."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from examples import bridge, doorkey, yard
from skillweave import PPO, Hierarchy, Run, recipes
from skillweave.cli.overrides import apply_overrides
from skillweave.recipes import lunar_lander
from skillweave.types import Array


@dataclass(frozen=True)
class Task:
    """A chain of skills to learn."""

    declare: Callable[..., Hierarchy]
    algorithm: Callable[..., PPO]
    parts: tuple[int, ...]
    """Of the steps apart, how many parts each skill gets, and last the selector."""
    apart: Mapping[str, Any]
    """Settings where skills learn apart."""
    cells: Callable[[Array], Array]
    """Observations (n, …) to whole numbers (n, k): what ``bonus`` counts visits of."""
    last_skill: PPO | None = None
    """Who trains the last skill apart; None: who trains the others."""
    has_engines: bool = True
    """``--engine`` is about it."""
    by_return: bool = False
    """The score is the mean return of greedy episodes, not the share of episodes solved."""

    def score(
        self, run: Run, greedy: bool | None = None, **how: Any
    ) -> tuple[float, dict[str, float]]:
        """Return the score of 100 episodes, and each skill's share of their steps.

        Args:
            greedy: whether who decides is greedy, or samples; None: as the task is scored.
            how: other arguments of ``run.evaluate``, such as ``skill``.
        """
        greedy = self.by_return if greedy is None else greedy
        found = run.evaluate(100, deterministic=greedy, **how)
        won = found.mean if self.by_return else float(np.mean(np.array(found.returns) > 0))
        return won, found.to_json()["skill_usage"]

    def shown(self, score: float) -> str:
        """Return a score in words."""
        return f"{score:.1f}" if self.by_return else f"{score:.0%}"


def _doorkey(room: str, parts: tuple[int, ...], goal: PPO | None = None, **apart: Any) -> Task:
    """Three skills in a room with a key and a door.

    Args:
        room: MiniGrid's name of it, without version.
        parts: of the steps apart.
        goal: who trains the third skill apart; None: who trains the others.
        apart: settings where skills learn apart, beside those of every room.
    """
    every = {
        "episode_calls": 8,
        "deliberation_cost": 0.001,  # as measured; together, rooms other than 8x8 have none
        "algorithm": doorkey.algorithm(ent_coef=0.03),  # with less `goal` settles too early
    }
    return Task(
        functools.partial(doorkey.declare, room),
        doorkey.algorithm,
        parts,
        every | apart,
        cells=lambda obs: obs.reshape(len(obs), -1),
        last_skill=goal,
    )


APART_SELECTOR = replace(lunar_lander.SELECTOR, learning_rate=1e-3, num_envs=128, n_steps=80)
LANDER_APART = [
    "learn=apart",
    "algorithm.update_epochs=6",
    "algorithm.batch_size=512",
    "skills.landing.update_epochs=4",
    "skills.landing.learning_rate=0.002",
    "skills.landing.ent_coef=0.05",
    "selector.learning_rate=0.001",
    "selector.num_envs=128",
    "selector.n_steps=80",
    "selection.greedy_skills=none",
]
"""Settings with which the skills and the selector of ``lunar-lander`` learn apart."""
LANDER_APART_STEPS = [
    "apart.skill_steps=250000",
    "skills.landing.steps=2800000",
    "apart.selector_steps=600000",
]
"""For how long: 3.9M steps in all."""
LANDER_STEPS = {
    "apart.skill_steps": 10_000,
    "skills.landing.steps": 50_000,
    "apart.selector_steps": 50_000,
    "together.steps": 1_500_000,
}
"""The budgets of the recipe ``lunar-lander``."""
LANDER_TOTAL = (
    sum(LANDER_STEPS.values()) + LANDER_STEPS["apart.skill_steps"]
)  # of each of two skills


def lander_budgets(steps: int = LANDER_TOTAL) -> list[str]:
    """Return settings that share out ``steps`` as ``LANDER_STEPS`` does."""
    return [f"{name}={steps * own // LANDER_TOTAL}" for name, own in LANDER_STEPS.items()]


def _lander(steps: int, workers: int, engine: Any = "auto", **how: Any) -> Hierarchy:
    """Return the recipe ``lunar-lander`` with other steps, or with its skills apart alone.

    Args:
        steps: in all.
        workers: of its environments.
        engine: auto: EnvPool, where it is installed; sync: Gymnasium.
        how: other settings of the hierarchy.
    """
    hierarchy = recipes.load("lunar-lander")
    if how.get("learn") == "apart":
        apply_overrides(hierarchy, LANDER_APART)
    else:
        how["selector"] = hierarchy.selector  # `then` would bring the one that learns apart
    apply_overrides(hierarchy, lander_budgets(steps))
    spec = replace(hierarchy.spec, workers=workers, engine=engine)
    return replace(hierarchy, env=spec, **how)


TASKS = {
    "8x8": _doorkey("DoorKey-8x8", (1, 2, 3, 2)),
    "unlock-pickup": _doorkey("UnlockPickup", (1, 2, 3, 2)),
    # `goal` succeeds once in 1,000 steps at first: it needs most of the steps, and rollouts with
    # several successes. It learns from them without a limit on its advantages: the entropy's bonus
    # would be larger than what the first few teach.
    "16x16": _doorkey(
        "DoorKey-16x16",
        (1, 2, 6, 1),
        goal=replace(
            doorkey.algorithm(ent_coef=0.015, min_advantage_std=0.0), n_steps=512, update_epochs=10
        ),
        start_calls=16,
        algorithm=doorkey.algorithm(ent_coef=0.03, min_advantage_std=0.0),
    ),
    "bridge": Task(
        bridge.declare,
        bridge.algorithm,
        (4, 5, 5, 3, 3),
        {},
        cells=lambda obs: obs[:, :5],
        has_engines=False,
    ),
    "yard": Task(
        yard.declare,
        yard.algorithm,
        (1, 1, 1, 1),
        {},
        cells=lambda obs: np.floor(obs / 0.1),
        has_engines=False,
    ),
    # Its skills learn from the task's advantage, a hundred times as much as from their own rewards,
    # as in the table of docs/results.md; `no task advantage` says what that is worth.
    "lander": Task(
        _lander,
        functools.partial(replace, APART_SELECTOR),
        (5, 5, 56, 12),
        {"start_calls": None, "selector": APART_SELECTOR},
        cells=lambda obs: np.floor(obs / 0.1),
        by_return=True,
    ),
}
"""By name, what is to be learnt."""
