"""A planner as data: its solved plan, the nearest calls, and its task, for the runner.

Stands alone because it reads a planner's parts, and ``states`` describes any policy.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.errors import PolicyError
from skillweave.planning.goal import GoalTask
from skillweave.planning.graph import FURTHER
from skillweave.planning.neighbours import AHEAD, SOFT
from skillweave.planning.planner import Planner
from skillweave.planning.tried import LATEST, SLACK, TRUST
from skillweave.selectors.base import function_name
from skillweave.spaces import obs_codec
from skillweave.types import Array

Asks = Callable[[str, Any, str], str]
"""Of a name, a function and a description; returns the runner's name of the function."""


def plan_entry(planner: Planner, name: str, asks: Asks) -> tuple[dict[str, Any], bytes]:
    """Return the entry of a planner in ``policy.json``, without its file, and the file's bytes.

    Raises:
        PolicyError: each episode has a goal of its own, for which the runner cannot plan; or the
            plan chooses goals of skills, which the runner cannot.
    """
    task, graph, machine = planner.task, planner.graph, planner.machine
    if planner.goal_spaces:
        raise PolicyError(
            f"{name} is a plan that chooses goals ({', '.join(planner.goal_spaces)}), which the "
            "runner does not: export a selector that starts from the plan, "
            "planned.with_selector(...).train(...), or act with run.player()"
        )
    if isinstance(task, GoalTask) and task.columns is not None:
        raise PolicyError(
            f"{name} plans again for each goal that it observes, which the runner does not: export "
            "a plan of one goal, GoalTask(reached, goal=[...]), or train a selector"
        )
    space = graph.log.observation_space
    plain = isinstance(space, gym.spaces.Box) and not obs_codec(space).images
    features: list[str | None] = []
    arrays: dict[str, Array] = {
        "worth": planner.plan.worth,
        "call": graph.pieces.call,
        "skill_of": graph.skill_of,
        "usual": graph.usual,
        "lengths": np.array(graph.log.lengths, np.int64),
        **{f"machine.{k}": v for k, v in machine.arrays.items()},
        **{f"states.{k}": v for k, v in planner.states.arrays.items()},
        "machine.start": machine.start(1)[0],
    }
    for i, each in enumerate(graph.maps):
        arrays |= {f"{part}.{i}": value for part, value in each.arrays.items()}
        if plain and each.places is not None:
            arrays[f"places.{i}"] = np.array(each.places)
            features.append(None)
            continue
        what = "observations (1, ...) to features (1, F)"
        features.append(asks(f"{name}.features.{graph.log.skills[i]}", each.raw, what))
    for c, (rows, starts) in enumerate(graph.pieces_by_choice):
        arrays |= {f"rows.{c}": rows, f"starts.{c}": starts}
    events = []
    for event in machine.events:
        what = "observations (1, ...)" if event.reads == "obs" else "a Step"
        code = asks(f"{name}.{event.name}", event.function, f"{what} to (1,) bool")
        events.append([code, event.reads])
    rewards = [
        asks(f"{name}.{function_name(reward)}", reward, "a Step to (1,) numbers")
        for reward in machine.rewards
    ]
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    settings = {
        "neighbours": graph.neighbours,
        "gamma": planner.gamma,
        "caution": planner.caution,
        "temperature": planner.temperature,
    }
    constants = {"ahead": AHEAD, "soft": SOFT, "latest": LATEST, "trust": TRUST, "slack": SLACK}
    constants["further"] = FURTHER
    entry = {"kind": "Plan", "features": features, "events": events, "rewards": rewards}
    return entry | settings | constants, buffer.getvalue()
