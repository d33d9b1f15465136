"""The ready policies of an owner of a ``Balancer``, and plain loops that play them."""

from __future__ import annotations

from typing import Any

import numpy as np

import skillweave as sw
from skillweave.toys.balancer import Balancer

DRIVE = np.array([4.0, 0.6, 0.35, -0.35])
WAVE = np.array([2.5, 0.45, 0.5])


def driving(x: Any) -> Any:
    """Drive at the speed that is the fourth number."""
    return np.stack([x @ DRIVE, 0 * x[:, 0]], axis=1)


def waving(x: Any) -> Any:
    """Hold the arm out, as it was made from standing."""
    return np.stack([x @ WAVE, np.full(len(x), 0.3)], axis=1)


def up(obs: Any) -> Any:
    """Whether the robot is upright."""
    return abs(obs["tilt"][:, 0]) < 0.5


def policies() -> dict[str, Any]:
    """Four policies: three commands of one, and one that falls out of a fast drive."""
    sees = ("tilt", "gyro", "speed")
    drive = sw.from_function(driving, sees=(*sees, sw.Goal()))
    speeds = {"fast": 1.5, "slow": 0.5, "stand": 0.0}
    found: dict[str, Any] = {name: drive.with_goal((speed,)) for name, speed in speeds.items()}
    return found | {"wave": sw.from_function(waving, sees=sees)}


SPEEDS = {"fast": 1.5, "slow": 0.5, "stand": 0.0}


def plainly(
    seed: int, settings: dict[str, Any], calls: list[tuple[str, int]]
) -> list[tuple[bool, int]]:
    """Play calls in a plain loop; whether each was upright in all its steps, and its steps."""
    env = Balancer(**settings)
    obs, _ = env.reset(seed=seed)
    found = []
    for name, steps in calls:
        good, made = True, 0
        while good and made < steps:
            x = np.array([[obs["tilt"][0], obs["gyro"][0], obs["speed"][0]]], np.float32)
            if name in SPEEDS:
                action = driving(np.concatenate([x, [[SPEEDS[name]]]], axis=1))
            else:
                action = waving(x)
            action = np.clip(action, -1, 1).astype(np.float32)
            obs, _, fell, _, _ = env.step(action[0])
            made += 1
            good = bool(up({"tilt": obs["tilt"][None]})[0]) and not fell
        found.append((good, made))
        if not good:
            break
    return found
