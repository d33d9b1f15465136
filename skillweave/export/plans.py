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
from skillweave.planning.graph import FURTHER, CallGraph
from skillweave.planning.neighbours import AHEAD, FAR, SOFT
from skillweave.planning.planner import Planner
from skillweave.planning.tried import LATEST, SLACK, TRUST
from skillweave.selectors.base import function_name
from skillweave.skills.goal_spaces import from_numbers
from skillweave.spaces import obs_codec
from skillweave.types import Array

Asks = Callable[[str, Any, str], str]
"""Of a name, a function and a description; returns the runner's name of the function."""


def plan_entry(planner: Planner, name: str, asks: Asks) -> tuple[dict[str, Any], bytes]:
    """Return the entry of a planner in ``policy.json``, without its file, and the file's bytes.

    Raises:
        PolicyError: each episode has another goal, for which the runner cannot plan.
    """
    task, graph, machine = planner.task, planner.graph, planner.machine
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
        if each.places is not None:
            what = f"observations (1, ...) to their flat numbers at {each.places}, (1, F)"
        features.append(asks(f"{name}.features.{graph.log.skills[i]}", each.raw, what))
    groups = graph.groups
    arrays["units"] = graph.units
    arrays["usual"] = np.array([group.usual for _, group in groups], np.float32)
    for g, (choice, group) in enumerate(groups):
        arrays |= {f"rows.{g}": group.rows, f"starts.{g}": group.starts}
        arrays |= _goals_of(planner, graph.skill_of[choice], group.goal, g)
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
        "groups": [[choice, group.options] for choice, group in groups],
        "goals": bool(planner.goal_spaces),
        "aims": _width(graph),
        "neighbours": graph.neighbours,
        "gamma": planner.gamma,
        "caution": planner.caution,
        "temperature": planner.temperature,
    }
    constants = {"ahead": AHEAD, "soft": SOFT, "latest": LATEST, "trust": TRUST, "slack": SLACK}
    constants |= {"further": FURTHER, "far": FAR}
    entry = {"kind": "Plan", "features": features, "events": events, "rewards": rewards}
    return entry | settings | constants, buffer.getvalue()


def _goals_of(planner: Planner, skill: int, call: Array, group: int) -> dict[str, Array]:
    """Return the arrays of the goals of a group's options; {}: they have none.

    Args:
        call: (m,) the calls that have the goals.
    """
    graph = planner.graph
    name, standard = graph.log.skills[skill], graph.goals[skill]
    if standard is None or (call < 0).any():
        return {}
    aims = np.zeros((len(call), _width(graph)), np.float32)
    aims[:, : standard.shape[1]] = standard[call]
    found = {f"aims.{group}": aims}
    if name in planner.goal_spaces:  # a guide gives no goals
        numbers = graph.log.goals[name][call]
        found[f"goals.{group}"] = from_numbers(planner.goal_spaces[name], numbers)
    return found


def _width(graph: CallGraph) -> int:
    """Return the numbers of the largest goal; 0: no skill has goals."""
    return max((goals.shape[1] for goals in graph.goals if goals is not None), default=0)
