"""Who begins a run with what it has learnt in another one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.config import config_from_json
from skillweave.algorithms.policy import make_algorithm
from skillweave.api.run import Run
from skillweave.hierarchy.declaration import Declaration
from skillweave.messages import as_path
from skillweave.runs.starts import Chooses, Learnt, begin_with, chosen_from, learnt_in, same_shapes
from skillweave.spaces import same_space
from skillweave.types import SkillweaveError

if TYPE_CHECKING:
    from skillweave.api import Agent, Hierarchy

StartFrom = str | Path | Run | None
"""A run in which those who are to learn have learnt before."""
Spaces = tuple[gym.Space[Any], gym.Space[Any]]
"""Of observations and of actions."""


def starts(
    declared: Hierarchy | Agent, content: dict[str, Any], start_from: StartFrom, spaces: Spaces
) -> tuple[dict[str, Learnt], str]:
    """Who has learnt in another run, and what people should know of it.

    The manifest then says who begins with what.
    """
    if start_from is None:
        return {}, ""
    where = start_from.path if isinstance(start_from, Run) else as_path(start_from, "start_from")
    learnt = learnt_in(where)
    begun = begin_with(content["stages"], learnt, where)
    observation_space, action_space = spaces
    for stage in content["stages"]:
        for name in stage.get("starts", {}):
            own = stage.get("algorithms", {}).get(name, stage["algorithm"])
            acts: Any = action_space
            if isinstance(declared, Declaration) and content["kind"] == "hierarchy":
                acts = declared.chooses_from(name, action_space)
            algorithm = make_algorithm(config_from_json(own), observation_space, acts)
            chooses = chosen_from(content, name)
            _check_start(name, algorithm, chooses, learnt[name], where)
    return learnt, f"start from {where}: {', '.join(sorted(begun))}"


def _check_start(
    name: str, algorithm: Algorithm, chooses: Chooses, learnt: Learnt, where: Path
) -> None:
    """Raise a SkillweaveError where one cannot begin with what it has learnt in another run."""
    before = learnt.policy.algorithm
    kinds = [type(a.config).__name__ for a in (before, algorithm)]
    what = ""
    if before.weight_shapes().keys() != algorithm.weight_shapes().keys() and len(set(kinds)) > 1:
        what = f"it learnt by {kinds[0]} there, and is to learn by {kinds[1]} here"
    elif learnt.chooses != chooses:
        what = f"there it chooses from {_told(learnt.chooses)}, and here from {_told(chooses)}"
    elif not same_space(before.observation_space, algorithm.observation_space):
        what = "its observations are others here"
    elif not same_space(before.action_space, algorithm.action_space):
        what = "its actions are others here"
    elif _networks(before) != _networks(algorithm) or not same_shapes(before, algorithm):
        what = "it has other networks here (network, critic, normalize_obs, or kinds of cells)"
    if what:
        raise SkillweaveError(
            f"start_from: {name!r} cannot begin with what it learnt in {where}: {what}"
        )


def _told(chooses: Chooses) -> str:
    skills, lengths = chooses
    return ", ".join(skills) + (f" in calls of {lengths} steps" if lengths else "")


def _networks(algorithm: Algorithm) -> list[Any]:
    return [getattr(algorithm.config, k, None) for k in ("network", "critic")]
