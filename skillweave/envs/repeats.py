"""Checks that an environment is a function of its seed and actions: again, beside others, and used.

They play a few steps before training, and after it, which are not counted. Whatever they draw comes
from generators of their own.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Protocol

import numpy as np

from skillweave._internal.notices import are_collected, notice
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.envs.env_infos import allowed_rows, random_actions
from skillweave.errors import SkillweaveError
from skillweave.policies.core import Array

FIRST_STEPS = 5
"""Steps of an episode before training."""
LAST_STEPS = 50
"""The most steps of an episode after training."""
PATIENCE = 1.0
"""Seconds of an episode after which environments are too slow for more of them."""
END = "EnvSpec(..., check_seed=False) ends this message"


class Checked(Protocol):
    """The engine whose environments are checked."""

    name: str
    num_envs: int
    action_space: Any
    draws_globally: bool

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        """Reset environments ``ids`` (n,) to seeds; return observations (n, …)."""
        ...

    def act(self, action: Array, ids: Array) -> Any:
        """Return the ``RawStep`` of environments ``ids`` (n,), which is not counted."""
        ...

    def mask(self) -> Array | None:
        """Return the actions allowed now, (N, A) bool; None: all."""
        ...

    def numbers(self, obs: Array) -> list[Array]:
        """Return copies of observations (n, …) as arrays of numbers."""
        ...

    def renew(self) -> None:
        """Close the environments, and make a new one in their place."""
        ...


Outcome = list[list[Array]]
"""The numbers of each step, and of the reset before it."""


def check_first_steps(engine: Checked) -> None:
    """Give a notice where environment 0 does not repeat itself, alone or beside environment 1."""
    began = time.monotonic()
    alone = _play(engine, FIRST_STEPS)
    slow = time.monotonic() - began > PATIENCE
    again = _play(engine, FIRST_STEPS)
    if not are_collected() or engine.draws_globally:  # these draws have their own notice
        return
    if not _alike(alone, again):
        notice(
            f"{engine.name}: two resets with the same seed, each with the same actions, had "
            "different results, so the same seed may give other weights. Draw from self.np_random "
            "alone, which super().reset(seed=seed) seeds, and let reset() clear all state; " + END
        )
        return
    if slow or engine.num_envs < 2:
        return

    def differs() -> bool:
        return not _alike(alone, _play(engine, FIRST_STEPS, beside=True))

    # Twice, and once more alone: what follows from a clock is no other environment's doing.
    if differs() and _alike(alone, _play(engine, FIRST_STEPS)) and differs():
        if engine.draws_globally:
            return
        notice(
            f"{engine.name}: its environments change each other: the same seed and the same "
            "actions had other results when a second environment was stepped in between. They "
            "share a world (a client of a simulator, an attribute of the class, a global of the "
            "module), so training and scores are of a mixture. Give each environment its own "
            "(PyBullet: physicsClientId=self.client in every call), or its own process, "
            f"EnvSpec(..., workers=num_envs), and evaluate(num_envs=1); {END}"
        )


def check_used(engine: Checked) -> None:
    """Give a notice where environment 0, which has been used, acts otherwise than a new one.

    Afterwards the engine can only be closed.
    """
    if not are_collected():
        return
    with suppress(SkillweaveError):  # the training result is kept
        used = _play(engine, LAST_STEPS, PATIENCE, episodes=LAST_STEPS)
        steps = len(used)

        def again() -> Outcome:
            return _play(engine, steps, episodes=steps)

        if not _alike(used, again()):
            return
        engine.renew()
        new = again()
        if _alike(used, new):
            return
        with global_generators(Seeds(1) / "check"):
            engine.renew()
        if not _alike(new, again()):  # every environment is another one
            return
        notice(
            f"{engine.name}: after training, an environment acts otherwise than a new one: the "
            "same seed and the same actions had other results. It keeps something from episode to "
            "episode (a counter, the level of a curriculum), which evaluations, films and a "
            "resumed run begin without. Let reset() clear it, or draw it there and put it into the "
            f"observation; {END}"
        )


def _play(
    engine: Checked,
    steps: int,
    seconds: float = np.inf,
    *,
    episodes: int = 1,
    beside: bool = False,
) -> Outcome:
    """Play random actions in environment 0, always from the same seeds.

    Args:
        steps: the most steps.
        seconds: no step starts later.
        episodes: the most episodes.
        beside: environment 1 is reset after environment 0, and stepped before each of its steps.
    """
    until = time.monotonic() + seconds
    row = np.arange(1)
    other = np.arange(1, 2)
    rng, other_rng = np.random.default_rng(0), np.random.default_rng(1)
    outcome: Outcome = []
    with global_generators(Seeds(0) / "check"):
        for episode in range(episodes):
            started = engine.numbers(engine.reset_some(row, [episode]))
            if beside:
                engine.reset_some(other, [episode + 1])
            over = False
            while not over and len(outcome) < steps and time.monotonic() < until:
                if beside:
                    beside = not _over(_step(engine, other, other_rng))
                raw = _step(engine, row, rng)
                ends = raw.reward, raw.terminated, raw.truncated
                outcome.append([*started, *engine.numbers(raw.next_obs), *ends])
                over = _over(raw)
            if not over:
                break
    return outcome


def _step(engine: Checked, row: Array, rng: np.random.Generator) -> Any:
    mask = allowed_rows(engine.mask(), row)
    return engine.act(random_actions(engine.action_space, 1, rng, mask), row)


def _over(raw: Any) -> bool:
    return bool(raw.terminated[0] or raw.truncated[0])


def _alike(one: Outcome, other: Outcome) -> bool:
    """Return whether two outcomes are the same, but for the last digits of physics engines."""
    return len(one) == len(other) and all(
        np.allclose(a, b, 1e-4, 1e-6, equal_nan=True)
        for numbers, others in zip(one, other, strict=True)
        for a, b in zip(numbers, others, strict=True)
    )
