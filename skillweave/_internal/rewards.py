"""The rewards that learners can compute with."""

from __future__ import annotations

import numpy as np

from skillweave.policies.core import Array

LARGEST_REWARD = 1e15
"""The largest size of a reward: learners square sums of rewards in float32."""


def wrong_reward(rewards: Array) -> int | None:
    """Return the first row that is not finite or exceeds ``LARGEST_REWARD``; None: all fit."""
    fit = np.abs(rewards) <= LARGEST_REWARD
    return int(np.flatnonzero(~fit)[0]) if b"\0" in fit.tobytes() else None
