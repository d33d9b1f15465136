"""Small hierarchies that learn together."""

from __future__ import annotations

from declaring import plainly
from small_runs import (
    OFF,
    ON,
    Balance,
    Left,
    Push,
)

from skillweave import EnvSpec, Hierarchy


def declare(*skills, **how):
    options = {
        "env": EnvSpec("CartPole-v1", engine="sync", workers=how.pop("workers", 1)),
        "skills": skills or [Left(), Balance(), Push()],
        "call_steps": 6,
        "algorithm": ON,
        "selector": ON,
        "learn": "together",
        "together_steps": 450,
        "skill_steps": 150,
        "selector_steps": 150,
        "checkpoint_every": 75,
    }
    return Hierarchy(**plainly(options | how))


class Other(Balance):
    """Learns from replay."""

    algorithm = OFF
