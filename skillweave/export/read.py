"""Policies from folders with a ``policy.json``: the counterpart of ``write``, and its schema.

Only data is read: ONNX files and JSON. Python code is given by name. Stands alone because no part
of an export needs it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import gymnasium as gym
import numpy as np

from skillweave.collecting.lengths import Lengths
from skillweave.collecting.skill_set import SkillSet
from skillweave.errors import DeclarationError, PolicyError, RunError, SkillweaveError
from skillweave.export.network import ExportedNetwork, FileName, NetworkEntry, leaf_inputs
from skillweave.export.parts import PartEntry, part_of, with_base
from skillweave.export.write import FORMAT, MANIFEST
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.messages import short
from skillweave.policies.hierarchy import ActiveGuide, Interruption
from skillweave.reading import fit, parse_json, read_file
from skillweave.selectors import Automaton, ReadySelector
from skillweave.selectors.function import FunctionSelector
from skillweave.settings import AtLeastOne, Check, Count, NonNegative
from skillweave.skills import Reflex
from skillweave.skills.base import RecordedSkill
from skillweave.skills.foreign_policy import checksum
from skillweave.skills.goal_spaces import choice_space, goals_space, with_goal
from skillweave.skills.goals import Goals, goals_of
from skillweave.skills.mapped import MappedPolicy
from skillweave.skills.mapping import PolicyMapping, checked_goal
from skillweave.skills.onnx_file import OnnxPolicy
from skillweave.skills.own_part import OwnPart
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.spaces import space_from_json
from skillweave.types import Policy

LARGEST = 100_000_000
"""The most bytes of ``policy.json``."""


class Manifest(TypedDict):
    """The content of ``policy.json``; fields for the runner alone are not listed."""

    format: int
    env: str
    """The environment's name; empty: none is named."""
    licence: str
    origin: str
    """An address, or another name of the source."""
    files: dict[str, str]
    """The SHA-256 of each ONNX file."""
    code: dict[str, str]
    """A description of each function that must be given, by its name."""
    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    policy: dict[str, Any]
    """One of the kinds below."""


class CodeEntry(TypedDict):
    """A function of observations; kind "Code"."""

    code: str
    with_goal: NotRequired[Literal["goal", "second"] | None]
    """How the function takes the goal of its skill: by this name, or as its second argument."""


class StateEntry(TypedDict):
    """One array of a recurrent state."""

    input: str | None
    """The name of a file's input; None: of a function."""
    output: str | None
    shape: list[AtLeastOne]
    """Of one environment, as the model takes it."""
    axis: Count | None
    """The axis of the environments, of a function."""


class ModelEntry(TypedDict):
    """A policy from elsewhere behind a mapping; kind "Model".

    Its further fields are those of ``PolicyMapping.to_json``: sees, goal, acts, every, chunk,
    scaling.
    """

    file: FileName | None
    code: str | None
    """The name of a function, in place of a file."""
    output: str | None
    """The name of a file's output."""
    state: list[StateEntry]
    single_state: bool
    sampled: bool


class GoalEntry(TypedDict):
    """The goals of a skill."""

    space: dict[str, Any]
    """Their range."""
    clip: str | None
    """The function that moves a goal into it, in an observation."""
    joined: bool
    """The policy observes observation and goal as one; else it takes the goal beside it."""


class SkillEntry(TypedDict):
    """A skill of a hierarchy."""

    name: str
    policy: dict[str, Any]
    limit: AtLeastOne | None
    max_steps: AtLeastOne | None
    initiation: str | None
    termination: str | None
    success: str | None
    goal: NotRequired[GoalEntry | None]
    """None: it has no goals."""


class HierarchyEntry(TypedDict):
    """A selector and its skills; kind "Hierarchy"."""

    selector: dict[str, Any]
    guide: dict[str, Any] | None
    skills: Annotated[
        list[SkillEntry],
        Check(
            "a list of at least one skill, each of another name",
            lambda skills: len({skill["name"] for skill in skills}) == len(skills) > 0,
        ),
    ]
    lengths: Annotated[
        list[AtLeastOne],
        Check("steps that rise", lambda steps: all(a < b for a, b in pairwise(steps))),
    ]
    reflexes: list[tuple[str, str | None, Any]]
    """The condition, the function of the action, or the action."""
    critic: NetworkEntry | None
    margin: NonNegative | None


class FunctionEntry(TypedDict):
    """A function as a selector; kind "Function"."""

    code: str
    goals: NotRequired[list[str]]
    """The skills that have goals: the function returns goals, too."""


class AutomatonEntry(TypedDict):
    """An automaton as a selector; kind "Automaton"."""

    start: Count
    skills: list[list[Count]]
    transitions: list[tuple[Count, Count, str, str | None]]
    goals: NotRequired[list[tuple[Count, Count, Any, str | None]]]
    """State, skill, and its goal there: fixed, or by the name of a function."""


def read_policy(
    folder: Path, code: Mapping[str, Callable[..., Any]] | None = None, goal: Any = None
) -> Policy:
    """Return the policy in a folder that ``write_export`` wrote.

    Args:
        folder: has ``policy.json`` and ONNX files.
        code: the functions that its field ``code`` lists.
        goal: replaces the goal of a single policy.

    Raises:
        RunError: a file is missing or damaged; the message names it and the field.
        PolicyError: it needs a function that was not given.
        DeclarationError: it has no goal.
    """
    return _Reading(folder, code or {}).policy(goal)


class _Reading:
    """The content of a folder while its policy is made."""

    def __init__(self, folder: Path, code: Mapping[str, Callable[..., Any]]) -> None:
        self.folder = folder
        self.file = folder / MANIFEST
        self.code = code
        data = parse_json(read_file(self.file, LARGEST), self.file)
        version = data.get("format") if isinstance(data, dict) else None
        if version != FORMAT:
            raise RunError(
                f"{self.file} has format {short(version)}, but this version reads {FORMAT}: export "
                "the policy again"
            )
        self.content: Manifest = fit(Manifest, data, str(self.file))
        missing = {k: what for k, what in self.content["code"].items() if k not in code}
        if missing:
            raise PolicyError(
                f"{folder} needs Python code, load_policy(..., code={{name: function}}), for "
                + "; ".join(f"{k!r}: {what}" for k, what in missing.items())
            )
        self.spaces = self._space("observation_space"), self._space("action_space")
        self.parts: dict[str, OwnPart] = {}
        """The own parts of skills, by the paths of their policies in the file."""

    def policy(self, goal: Any) -> Policy:
        """Return the whole policy, a single one with this ``goal``."""
        policy = self._policy(self.content["policy"], "policy")
        if goal is not None:
            if not isinstance(policy, MappedPolicy):
                raise DeclarationError(f"load_policy(): the policy in {self.folder} takes no goal")
            try:
                policy.mapping = replace(policy.mapping, goal=checked_goal(goal))
                policy.mapping.check_goal()
            except DeclarationError as error:
                raise DeclarationError(f"load_policy(): {self.folder}: {error}") from None
            policy.fit_mapping()
        if isinstance(policy, MappedPolicy):
            policy.try_out()
        return policy

    def _space(self, field: str) -> gym.Space[Any]:
        return self._space_of(self.content[field], field)  # type: ignore[literal-required]

    def _space_of(self, data: Any, path: str) -> gym.Space[Any]:
        try:
            return space_from_json(data)
        except RunError as error:
            raise RunError(f"{self.file}: {path}: {error}") from error

    def _policy(
        self, entry: dict[str, Any], path: str, goals: Goals | None = None, joined: bool = True
    ) -> Policy:
        """Return the policy of an entry of the file at ``path``.

        Args:
            goals: of the skill whose policy it is; None: it has none.
            joined: it observes them with the observation, else beside it.
        """
        if goals is not None and joined:
            whole = self.spaces
            self.spaces = with_goal(whole[0], goals.space), whole[1]
            try:
                return self._policy(entry, path)
            finally:
                self.spaces = whole
        match entry.get("kind"):
            case "Code":
                name = self._fit(CodeEntry, entry, path)["code"]
                scripted = ScriptedPolicy(self._function(name, path), *self.spaces)
                acts: Policy = self._bound(scripted, path, goals=goals)
                return acts
            case "Network" if goals is None:
                return self._network(entry, path, self.spaces[1])
            case "Model":
                return self._model(entry, path, goals)
            case "Part" if path.endswith("].policy"):  # of a skill
                return self._part(entry, path, goals)
            case "Hierarchy":
                return self._hierarchy(entry, path, goals)
        raise RunError(
            f"{self.file}: {path}.kind is {short(entry.get('kind'))}; it must be one of Code, "
            "Network, Model, Hierarchy, and Part of a skill"
        )

    def _fit(self, kind: Any, entry: Any, path: str) -> Any:
        return fit(kind, entry, str(self.file), path)

    def _function(self, name: str, path: str) -> Callable[..., Any]:
        function = self.code.get(name)
        if not callable(function):
            raise RunError(
                f"{self.file}: {path} names the function {short(name)}, which code does not list"
            )
        return function

    def _bound(
        self,
        policy: Any,
        path: str,
        action_space: gym.Space[Any] | None = None,
        goals: Goals | None = None,
    ) -> Any:
        """Return a policy for the spaces; errors name its place in the file."""
        space = self.spaces[1] if action_space is None else action_space
        to = self.spaces[0], space, f"{self.file}: {path}"
        try:
            bound = policy.bind(*to) if goals is None else policy.bind_with_goals(*to, goals)
            if isinstance(bound, OnnxPolicy):
                bound.try_out()
        except SkillweaveError as error:
            raise RunError(str(error)) from error
        return bound

    def _model(self, entry: dict[str, Any], path: str, goals: Goals | None = None) -> MappedPolicy:
        fitted: ModelEntry = self._fit(ModelEntry, entry, path)
        data = dict(entry)
        data["state"] = [
            [s["input"], s["output"]]
            if fitted["file"]
            else [None if i == s["axis"] else n for i, n in enumerate(s["shape"])]
            for s in fitted["state"]
        ]
        try:
            mapping = PolicyMapping.from_json(data, self.code)
        except DeclarationError as error:
            raise RunError(f"{self.file}: {path}.{error}") from error
        if fitted["file"] is None:
            if fitted["code"] is None:
                raise RunError(f"{self.file}: {path} has neither file nor code")
            function = self._function(fitted["code"], path)
            scripted = ScriptedPolicy(function, *self.spaces, mapping)
            return self._bound(scripted, path, goals=goals)  # type: ignore[no-any-return]
        if mapping.sees is None:
            mapping = replace(mapping, sees=leaf_inputs(self.spaces[0]))
        file, content = self._content(fitted["file"], path)
        try:
            policy = OnnxPolicy(content, file, fitted["output"], *self.spaces, mapping)
        except PolicyError as error:
            raise RunError(f"{self.file}: {path}: {error}") from error
        bound: MappedPolicy = self._bound(policy, path, goals=goals)
        for given, (name, _, shape) in zip(fitted["state"], policy.single_states(), strict=True):
            if tuple(given["shape"]) != shape:
                raise RunError(
                    f"{self.file}: {path}.state has the shape {given['shape']}, but the input "
                    f"{name!r} of {file} has {shape}"
                )
        return bound

    def _part(self, entry: dict[str, Any], path: str, goals: Goals | None = None) -> Policy:
        """Return the policy of a skill with a part of its own, which is kept by its path."""
        fitted: PartEntry = self._fit(PartEntry, entry, path)
        joined = {"policy": True, "base": True} | fitted.get("joined", {})
        spaces = self.spaces
        try:
            part = part_of(fitted, spaces, f"{self.file}: {path}", self.code)
            if fitted["base"] is not None:
                self.spaces = part.observation_space, part.action_space
                base = self._policy(fitted["base"], f"{path}.base", goals, joined["base"])
                part = with_base(part, base, fitted.get("residual"))
        except SkillweaveError as error:
            raise RunError(str(error)) from error
        self.spaces = part.observation_space, part.action_space
        policy = self._policy(fitted["policy"], f"{path}.policy", goals, joined["policy"])
        self.spaces, self.parts[path] = spaces, part
        return policy

    def _network(
        self, entry: Any, path: str, action_space: gym.Space[Any], output: str = "action"
    ) -> ExportedNetwork:
        fitted: NetworkEntry = self._fit(NetworkEntry, entry, path)
        file, content = self._content(fitted["file"], path)
        try:
            policy = ExportedNetwork(content, file, fitted, self.spaces[0], action_space, output)
        except SkillweaveError as error:
            raise RunError(f"{self.file}: {path}: {error}") from error
        bound: ExportedNetwork = self._bound(policy, path, action_space)
        return bound

    def _content(self, name: str, path: str) -> tuple[Path, bytes]:
        """Return an ONNX file of the folder, compared with its checksum."""
        file = self.folder / name
        recorded = self.content["files"].get(name)
        if recorded is None:
            raise RunError(f"{self.file}: {path}.file is {short(name)}, which files does not list")
        content = read_file(file)
        if checksum(content) != recorded:
            raise RunError(
                f"{file} has another checksum than {self.file} records in files: it is damaged, or "
                "another version. Get both from one source"
            )
        return file, content

    def _hierarchy(
        self, entry: dict[str, Any], path: str, own: Goals | None = None
    ) -> HierarchyPolicy:
        fitted: HierarchyEntry = self._fit(HierarchyEntry, entry, path)
        skills = []
        policies = []
        for i, one in enumerate(fitted["skills"]):
            skills.append(self._skill(one, f"{path}.skills[{i}]"))
            goal = one.get("goal") or {"joined": True}
            seen = goals_of(skills[-1]), goal["joined"]
            policies.append(self._policy(one["policy"], f"{path}.skills[{i}].policy", *seen))
        names = tuple(skill.name for skill in skills)
        whole = self.spaces
        if own is not None:  # the selector, the guide and the critic see its goal
            self.spaces = with_goal(whole[0], own.space), whole[1]
        plain = gym.spaces.Discrete(len(skills) * max(1, len(fitted["lengths"])))
        spaces = {skill.name: skill.goal_space for skill in skills}
        with_goals = {name: space for name, space in spaces.items() if space is not None}
        choices = choice_space(int(plain.n), with_goals, names)
        interruption = None
        if fitted["critic"] is not None:
            before = self.spaces  # its values: of each skill, and of a new decision
            worth = gym.spaces.Box(-np.inf, np.inf, (len(skills) + 1,))
            if with_goals:
                self.spaces = with_goal(before[0], goals_space(with_goals)), before[1]
            critic = self._network(fitted["critic"], f"{path}.critic", worth, "worth")
            self.spaces = before
            interruption = Interruption(critic.worth, fitted["margin"] or 0.0, critic)
        sampled = [_samples(one["policy"]) for one in fitted["skills"]]
        selector = self._selector(fitted["selector"], f"{path}.selector", names, choices)
        if fitted["lengths"] and isinstance(selector, ReadySelector):
            raise RunError(f"{self.file}: {path}.lengths are given, but its selector chooses none")
        kept = tuple(self.parts.get(f"{path}.skills[{i}].policy") for i in range(len(skills)))
        skill_set = SkillSet(
            tuple(skills),
            tuple(policies),
            reflexes=tuple(self._reflex(*r, f"{path}.reflexes") for r in fitted["reflexes"]),
            call_steps=Lengths(*fitted["lengths"]) if fitted["lengths"] else None,
            greedy=not any(sampled),
            interruption=interruption,
            greedy_selector=not _samples(fitted["selector"]),
            parts=kept if any(kept) else (),
        )
        guide = None
        if fitted["guide"] is not None:
            ready = self._selector(fitted["guide"], f"{path}.guide", names, plain)
            if not isinstance(ready, ReadySelector):
                raise RunError(
                    f"{self.file}: {path}.guide is a Network; it must be a Function or an Automaton"
                )
            guide = ActiveGuide(ready)
        self.spaces = whole
        return HierarchyPolicy(selector, skill_set, guide, own)

    def _skill(self, entry: SkillEntry, path: str) -> RecordedSkill:
        methods: dict[str, Any] = {}
        for name in ("initiation", "termination", "success"):
            if (code := entry[name]) is not None:
                function = self._function(code, path)
                methods[name] = _method(function)
        if goal := entry.get("goal"):
            methods["goal_space"] = self._space_of(goal["space"], f"{path}.goal.space")
            if goal["clip"] is not None:
                methods["clip_goal"] = _method(self._function(goal["clip"], path))
        kind = type("Exported", (RecordedSkill,), methods | {"name": entry["name"]})
        skill: RecordedSkill = kind()
        skill.max_steps = entry["max_steps"]
        skill.call_steps = entry["limit"]
        try:
            skill.validate()
        except DeclarationError as error:
            raise RunError(f"{self.file}: {path}: {error}") from error
        return skill

    def _reflex(self, condition: str, code: str | None, fixed: Any, path: str) -> Reflex:
        action = fixed if code is None else self._function(code, path)
        reflex = Reflex(self._function(condition, path), action, condition.rpartition(".")[0])
        try:
            reflex.check(self.spaces[1])
        except DeclarationError as error:
            raise RunError(f"{self.file}: {path}: {error}") from error
        return reflex

    def _selector(
        self, entry: dict[str, Any], path: str, names: tuple[str, ...], choices: gym.Space[Any]
    ) -> Policy:
        """Return a selector or a guide."""
        if entry.get("kind") == "Network":
            return self._network(entry, path, choices)
        selector: ReadySelector
        if entry.get("kind") == "Function":
            code = self._fit(FunctionEntry, entry, path)["code"]
            selector = FunctionSelector(self._function(code, path))
        elif entry.get("kind") == "Automaton":
            selector = self._automaton(self._fit(AutomatonEntry, entry, path), path, names)
        elif entry.get("kind") == "Plan":
            raise PolicyError(
                f"{self.file}: {path} is a plan, which only the runner beside it acts by: plan "
                "again in Skillweave, or use Runner(path)"
            )
        else:
            raise RunError(
                f"{self.file}: {path}.kind is {short(entry.get('kind'))}; it must be one of "
                "Network, Function, Automaton"
            )
        if isinstance(choices, gym.spaces.Discrete):
            choices = gym.spaces.Discrete(len(names))
        bound: Policy = self._bound(selector.among(names), path, choices)
        return bound

    def _automaton(self, entry: AutomatonEntry, path: str, names: tuple[str, ...]) -> Automaton:
        goals = {
            (state, skill): fixed if code is None else self._function(code, path)
            for state, skill, fixed, code in entry.get("goals", ())
        }
        try:
            return Automaton(
                {
                    str(i): [(names[k], goals[i, k]) if (i, k) in goals else names[k] for k in ks]
                    for i, ks in enumerate(entry["skills"])
                },
                {
                    (str(origin), str(target)): event
                    if code is None
                    else self._function(code, path)
                    for origin, target, event, code in entry["transitions"]
                },
                start=str(entry["start"]),
            )
        except (IndexError, DeclarationError) as error:
            raise RunError(f"{self.file}: {path}: {error}") from error


def _method(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function as the method of a skill."""

    def method(self: Any, *about: Any) -> Any:
        return function(*about)

    return method


def _samples(entry: dict[str, Any]) -> bool:
    """Return whether an entry draws its actions; a hierarchy's selector says that for itself."""
    if entry.get("kind") == "Part":
        return _samples(entry["policy"])
    return bool(entry.get("noise")) or entry.get("sampled") is True
