"""Policies from folders that ``write`` wrote, for skills and evaluations."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import short
from skillweave._internal.policy_protocol import Policy
from skillweave.errors import DeclarationError, PolicyError
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.policies.actor import Deployed
from skillweave.policies.codec import read_folder
from skillweave.policies.core import Around, RowPolicy, innermost
from skillweave.policies.functional import Functional
from skillweave.policies.hierarchy import CallAndReturn, CalledSkill
from skillweave.policies.mapped import Mapped, Take
from skillweave.policies.parts import Reflexes
from skillweave.policies.untrusted import checksum
from skillweave.schema import fitted
from skillweave.skills import Reflex
from skillweave.skills.base import RecordedSkill
from skillweave.skills.foreign_policy import Foreign
from skillweave.skills.goal_spaces import with_goal
from skillweave.skills.goals import Goals
from skillweave.skills.lengths import Lengths
from skillweave.skills.mapped import check_range
from skillweave.skills.mapping import GoalValue, check_in_range
from skillweave.skills.skill_set import SkillSet, within
from skillweave.spaces.saving import gym_space


def read_policy(
    folder: Path, code: Mapping[str, Callable[..., Any]] | None = None, goal: Any = None
) -> Policy:
    """Return the policy in an exported folder.

    Args:
        folder: has ``policy.json`` and ONNX files.
        code: the functions that its field ``code`` lists.
        goal: replaces the goal of a single policy.

    Raises:
        RunError: a file is missing or damaged; the message names it and the field.
        PolicyError: it needs a function that was not given.
        DeclarationError: it takes no goal.
    """
    deployed, _, archive = read_folder(folder, code)
    if isinstance(innermost(deployed.policy), CallAndReturn):
        if goal is not None:
            raise DeclarationError(f"load_policy(): the policy in {folder} takes no goal")
        return ExportedHierarchy(deployed, checksum(archive))
    policy = Exported(folder, deployed, archive, code)
    return policy if goal is None else policy.with_goal(goal)


class Exported(Functional, Foreign):
    """One policy of an exported folder; a run keeps a copy of all that it needs."""

    kind = "exported"
    suffix = ".zip"

    def __init__(
        self, folder: Path, deployed: Deployed, archive: bytes, code: Mapping[str, Any] | None
    ) -> None:
        spaces = gym_space(deployed.sees), gym_space(deployed.acts)
        Foreign.__init__(self, str(folder), *spaces)
        Functional.__init__(self, deployed.policy, *spaces)
        self._archive = archive
        self._code = code

    @property
    def _goal_places(self) -> list[Take]:
        """The places of the goal among its inputs."""
        takes = getattr(self.in_place, "takes", ())
        return [take for take in takes if take.source == "goal"]

    @property
    def takes_goal(self) -> bool:
        """Return whether the goal of a skill is an input of it."""
        return bool(self._goal_places)

    def with_goal(self, goal: Any) -> Self:
        """Return a copy with another goal.

        Raises:
            DeclarationError: it takes none, or the goal is out of its range.
        """
        try:
            numbers = fitted(GoalValue, goal, "goal")
            if not self.takes_goal:
                raise DeclarationError(f"goal is given, {short(goal)}, but the policy takes none")
            if not callable(numbers):
                if (takes := self._goal_places[0].size) != len(numbers):
                    raise DeclarationError(
                        f"goal has {len(numbers)} numbers, but the policy takes {takes}"
                    )
                check_in_range(numbers, self._goal_places)
            return self._aiming(goal=numbers if callable(numbers) else np.array(numbers))
        except (DeclarationError, PolicyError) as error:
            raise DeclarationError(f"load_policy(): {self.name}: {error}") from None

    def bind_with_goals(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        who: str,
        goals: Goals,
    ) -> Self:
        """Return a copy as the policy of a skill that has goals; see ``MappedPolicy``."""
        bound = self.bind(observation_space, action_space, who)
        check_range(goals, self._goal_places, bound._who)
        bound = bound._aiming(goal=None, goal_space=goals.space)
        bound.joins = True
        bound.observation_space = with_goal(observation_space, goals.goal_space)
        return bound

    def _aiming(self, **goal: Any) -> Self:
        changed = copy.copy(self)
        assert isinstance(self.in_place, Mapped)
        changed.in_place = replace(self.in_place, **goal)
        return changed

    def content(self) -> bytes:
        """Return the whole folder as one file."""
        return self._archive

    def restored(self, content: bytes) -> Self:
        """Return the policy of the ``content`` from a run."""
        deployed, _, archive = read_folder(self.name, self._code, content)
        return type(self)(Path(self.name), deployed, archive, self._code)


class ExportedHierarchy(HierarchyPolicy):
    """A hierarchy of a folder: its skills are known by name, and act by its data alone."""

    def __init__(self, deployed: Deployed, sha256: str) -> None:
        spaces = gym_space(deployed.sees), gym_space(deployed.acts)
        Functional.__init__(self, deployed.policy, *spaces)
        self.skills = _skill_set(deployed)
        self.labels = tuple(skill.name for skill in self.skills.skills)
        self.goals = None
        self._sha256 = sha256

    def source(self) -> dict[str, Any]:
        """Return the checksum of all its files."""
        return {"sha256": self._sha256}


def _skill_set(deployed: Deployed) -> SkillSet:
    """Return the skills of an exported hierarchy, as reports know them."""
    tree = within(deployed.policy)
    return SkillSet(
        tuple(_recorded(skill, [one.name for one in tree.skills]) for skill in tree.skills),
        tuple(_policy(skill, deployed) for skill in tree.skills),
        reflexes=_reflexes(deployed.policy),
        call_steps=Lengths(*tree.lengths) if tree.lengths else None,
        greedy=tree.greedy,
        greedy_selector=tree.greedy_selector,
        interruption=tree.interruption,
    )


def _policy(skill: CalledSkill, deployed: Deployed) -> Policy:
    """Return the policy of a skill that was exported, to act or to be a skill again."""
    inside = Deployed(skill.policy, deployed.sees, deployed.acts)
    if isinstance(innermost(skill.policy), CallAndReturn):
        return ExportedHierarchy(inside, "")
    spaces = gym_space(deployed.sees), gym_space(deployed.acts)
    return Functional(skill.policy, *spaces, joins=skill.goals is not None)


def _recorded(called: CalledSkill, names: Sequence[str]) -> RecordedSkill:
    """Return a skill of an exported hierarchy, with the functions that judge its calls.

    Args:
        names: of all skills beside it.
    """
    methods: dict[str, Any] = {
        name: staticmethod(function)
        for name in ("initiation", "termination", "success")
        if (function := getattr(called, name)) is not None
    }
    if called.goals is not None:
        methods["goal_space"] = gym_space(called.goals.space)
        if called.goals.clip is not None:
            methods["clip_goal"] = staticmethod(called.goals.clip)
    skill: RecordedSkill = type("Exported", (RecordedSkill,), methods | {"name": called.name})()
    skill.max_steps, skill.call_steps = called.max_steps, called.limit
    if any(called.fades):
        skill.fade = {name: n for name, n in zip(names, called.fades, strict=True) if n}
    return skill


def _reflexes(policy: RowPolicy) -> tuple[Reflex, ...]:
    """Return the reflexes around an exported hierarchy."""
    found: list[Reflex] = []
    while isinstance(policy, Around):
        if isinstance(policy, Reflexes):
            for rule in policy.reflexes:
                action = rule.action if callable(rule.action) else rule.action[0]
                found.append(Reflex(rule.condition, action, rule.name))
        policy = policy.policy
    return tuple(found)
