"""The score of a policy that a stage was given: before the first update, and at the end.

Both are scored in the same episodes, which choose nothing while it trains.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from skillweave._internal.seeding import Seeds
from skillweave.envs.checked import longest_evaluation
from skillweave.envs.engine import Engine
from skillweave.experience.collector import LENGTH, RETURN, SUCCESS
from skillweave.policies.core import Array
from skillweave.runs.comparison import Comparison
from skillweave.runs.manifest import GivenScore
from skillweave.training.episodes import standard_error

FEWEST, MOST = 5, 40
"""Episodes of a score, at least and at most."""
SHARE = 0.05
"""Share of a stage's steps that the episodes of a score may take beyond ``FEWEST``."""
LONGEST = 2.0
"""The most steps of ``FEWEST`` episodes, as a share of a stage's: longer episodes are cut."""
LOOKS, LOOKS_SHARE = 4, 0.1
"""Evaluations while a stage trains on from a policy that was given, where nobody asked for some,
and the most of its steps that they take."""
CLEAR = 2.33
"""Standard errors by which a mean is clearly below 0, of many episodes: 1 % one-sided."""

Play = Callable[[Engine, Seeds, int, bool], Array]
"""Plays an episode in each environment: the engine, seeds, the most steps, and whether the policy
is greedy; returns rows like ``Collected.episodes``."""


def score(
    engine: Engine, play: Play, seeds: Seeds, budget: int, like: GivenScore | None = None
) -> GivenScore:
    """Play a policy greedily and, where that costs little, sampling.

    Args:
        engine: of ``FEWEST`` environments.
        seeds: of the episodes.
        budget: steps of the stage.
        like: a score of the same episodes; None: their number follows from their length.
    """
    longest = min(longest_evaluation(engine.time_limit), max(1, int(LONGEST * budget / FEWEST)))
    if like is not None:
        longest = like.longest

    def rounds(count: int, first: int, greedy: bool) -> Array:
        played = [play(engine, seeds / i, longest, greedy) for i in range(first, first + count)]
        return np.concatenate(played)

    episodes = rounds(1 if like is None else like.rounds, 0, True)
    if like is None:
        length = float(episodes[:, LENGTH].mean()) if len(episodes) else math.inf
        wanted = min(MOST, int(SHARE * budget / max(1.0, length)))
        more = max(0, math.ceil(wanted / engine.num_envs) - 1)
        if more:
            episodes = np.concatenate([episodes, rounds(more, 1, True)])
        number, samples = 1 + more, wanted >= FEWEST
    else:
        number, samples = like.rounds, bool(like.sampled)
    sampled = rounds(number, 0, False)[:, RETURN].tolist() if samples else []
    success = episodes[:, SUCCESS]
    return GivenScore(
        rounds=number,
        longest=longest,
        returns=episodes[:, RETURN].tolist(),
        success=[] if np.isnan(success).any() else success.tolist(),
        sampled=sampled,
        length=float(episodes[:, LENGTH].mean()) if len(episodes) else 0.0,
    )


def looks(given: GivenScore, budget: int) -> tuple[int, int]:
    """Return the steps between evaluations and their episodes; (0, 0): they would cost too much."""
    episodes = min(20, int(LOOKS_SHARE * budget / LOOKS / max(1.0, given.length)))
    return (-(-budget // LOOKS), episodes) if episodes >= FEWEST else (0, 0)


def compared(given: GivenScore, now: GivenScore, keeps_given: bool) -> Comparison:
    """Return the record of a stage that learnt on from a policy that was given.

    Args:
        keeps_given: the stage ends with the policy that was given where the new one is worse.
    """
    worse = _is_worse(now.returns, given.returns) or _is_worse(now.success, given.success)
    return Comparison(
        "given" if worse and keeps_given else "greedy",
        given=_mean(given.returns),
        given_samples=_mean(given.sampled),
        greedy=_mean(now.returns),
        samples=_mean(now.sampled),
        given_success=_mean(given.success),
        success=_mean(now.success),
        episodes=max(1, len(now.returns)),
        worse=True if worse else None,
        samples_better=True if _is_worse(now.returns, now.sampled) else None,
    )


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _is_worse(now: Sequence[float], before: Sequence[float]) -> bool:
    """Return whether values are clearly below others, pair by pair if there are as many."""
    if min(len(now), len(before)) < 2:
        return False
    gain = float(np.mean(now) - np.mean(before))
    if len(now) == len(before):
        error = standard_error(list(np.subtract(now, before)))
    else:
        error = math.hypot(standard_error(now), standard_error(before))
    fewest = min(len(now), len(before))
    # Of few episodes the standard error itself is uncertain: near Student's t.
    clear = CLEAR * (1.0 + 2.5 / (fewest - 1))
    return -gain > max(clear * error, 1e-9 * (1.0 + abs(float(np.mean(before)))))
