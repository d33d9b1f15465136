"""A policy as data: networks as files, and a state machine as JSON.

Stands alone because it describes any policy; ``write`` makes one folder of the description.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.algorithms.policy import AgentPolicy
from skillweave.collecting.skill_set import SkillSet
from skillweave.errors import PolicyError
from skillweave.export.foreign import mapping_entry, model_of
from skillweave.export.graphs import Graph, agent_graph, dtype_to_json, inputs_of, worth_graph
from skillweave.export.network import ExportedNetwork
from skillweave.export.parts import part_entry
from skillweave.export.plans import plan_entry
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.planning.planner import Planner
from skillweave.selectors import Automaton
from skillweave.selectors.base import function_name
from skillweave.selectors.function import FunctionSelector
from skillweave.skills import Reflex
from skillweave.skills.goal_spaces import example_of, leaf_paths, part_at
from skillweave.skills.mapped import MappedPolicy
from skillweave.skills.mapping import function_name as written_name
from skillweave.skills.onnx_file import OnnxPolicy
from skillweave.skills.sb3 import SB3Policy
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.spaces import obs_dtype, obs_shape, space_to_json
from skillweave.types import Array, Policy


class States:
    """The description of a policy: its files, and the code that it needs.

    Args:
        space: the environment's space of actions.
    """

    def __init__(self, space: gym.Space[Any]) -> None:
        self.space = space
        self.files: dict[str, bytes] = {}
        self.code: dict[str, str] = {}
        """By name, a description of each function that the runner needs."""
        self.functions: dict[str, Any] = {}

    def policy(self, policy: Policy, name: str = "", sampled: bool = False) -> dict[str, Any]:
        """Return a policy, and all below it, as JSON.

        Args:
            name: its path: ``landing``, or ``outer/landing`` for a skill in a nested hierarchy;
                the whole policy has none.
            sampled: it samples; else it is greedy.

        Raises:
            PolicyError: it cannot be exported; the message has the reason, and what to do.
        """
        where = f"the policy of {name!r}" if name else "the policy"
        if why := getattr(policy, "not_exported", ""):
            raise PolicyError(f"{where} {why}")
        match policy:
            case HierarchyPolicy():
                return self._hierarchy(policy, f"{name}/" if name else "", sampled)
            case AgentPolicy():
                return self._network(agent_graph(policy, sampled, where), name)
            case ExportedNetwork():
                return self._exported(policy, name)
            case ScriptedPolicy() if policy.mapping.is_identity:
                acts: Any = policy.function
                with_goal = policy.with_goal
            case MappedPolicy():
                return self._model(policy, name, where, sampled)
            case _:
                acts, with_goal = policy, None
        if policy.start(1):
            raise PolicyError(
                f"{where} is a {type(policy).__name__}, whose memory cannot be written as "
                "ONNX: train the skill, or give it an ONNX file"
            )
        beside = "" if with_goal is None else " and goals (1, ...)"
        what = f"observations (1, ...){beside} to actions (1, ...)"
        return {
            "kind": "Code",
            "code": self._asks(f"{name}.policy", acts, what),
            "with_goal": with_goal,
        }

    def _hierarchy(self, policy: HierarchyPolicy, prefix: str, sampled: bool) -> dict[str, Any]:
        skills = policy.skills
        cuts = policy.skills.interruption
        selector = policy.selector
        samples = sampled or not skills.greedy_selector
        guide: Any = None if policy.guide is None else policy.guide.selector
        needs_success = any(
            isinstance(x, Automaton) or getattr(x, "takes_last_call", False)
            for x in (selector, guide)
        )
        entry: dict[str, Any] = {
            "kind": "Hierarchy",
            "selector": self._selector(selector, f"{prefix}selector", samples),
            "guide": None if guide is None else self._selector(guide, f"{prefix}guide", False),
            "skills": [
                self._skill(skills, i, prefix, needs_success) for i in range(len(skills.skills))
            ],
            "lengths": list(skills.lengths),
            "reflexes": [self._reflex(reflex, prefix) for reflex in skills.reflexes],
            "critic": None,
            "margin": None,
        }
        if cuts is not None:
            name = f"{prefix}critic"
            match cuts.critic:
                case AgentPolicy():
                    critic = self._network(worth_graph(cuts.critic, "the skill critic"), name)
                case ExportedNetwork():
                    critic = self._exported(cuts.critic, name)
                case _:
                    raise PolicyError(f"the critic of {prefix or 'the selector'} is not trained")
            entry |= {"critic": critic, "margin": cuts.margin}
        return entry

    def _skill(self, skills: SkillSet, i: int, prefix: str, needs_success: bool) -> dict[str, Any]:
        skill = skills.skills[i]
        name = prefix + skills.skills[i].name

        def method(name: str, what: str) -> str | None:
            if not skill.defines(name):
                return None
            return self._asks(f"{prefix}{skill.name}.{name}", getattr(skill, name), what)

        return {
            "name": skill.name,
            "policy": self._own(skills, i, name),
            "limit": skills.limit(i),
            "max_steps": skill.max_steps,
            "initiation": method("initiation", "observations (1, ...) to (1,) bool"),
            "termination": method("termination", "a Step to (1,) bool"),
            "success": method("success", "a Step to (1,) bool") if needs_success else None,
            "goal": self._goal(skills, i, method),
        }

    def _goal(self, skills: SkillSet, i: int, method: Any) -> dict[str, Any] | None:
        """Return the goals of a skill; None: it has none."""
        space, policy = skills.skills[i].goal_space, skills.policies[i]
        if space is None:
            return None
        example = example_of(space)
        return {
            "space": space_to_json(space),
            "dtype": dtype_to_json(obs_dtype(space)),
            "shape": list(obs_shape(space)),
            "example": [_short(part_at(example, path)) for path in leaf_paths(space)],
            "inputs": _goal_inputs(space),
            "clip": method("clip_goal", "observations and goals (1, ...) to goals (1, ...)"),
            "joined": skills.part(i) is None and _is_joined(policy),
        }

    def _own(self, skills: SkillSet, i: int, name: str) -> dict[str, Any]:
        """Return the entry of a skill's policy, with its own part of observations and actions."""
        entry = self.policy(skills.policies[i], name, sampled=not skills.greedy)
        if (part := skills.part(i)) is None:
            return entry
        base = None
        if part.base is not None:
            if isinstance(part.base, HierarchyPolicy):
                raise PolicyError(
                    f"skill {name!r} corrects a hierarchy (Residual), which no runner follows: "
                    "correct one of its skills instead"
                )
            base = self.policy(part.base, f"{name}.base")

        def name_of(function: Any) -> str:
            plain = written_name(function).rpartition(":")[2]
            what = "observations (1, ...) to numbers (1, ...)"
            return self._asks(f"{name}.{plain}", function, what)

        whole = part_entry(part, entry, base, name_of)
        if (space := skills.skills[i].goal_space) is not None:
            both = {"policy": skills.policies[i], "base": part.base}
            whole["joined"] = {which: _is_joined(one) for which, one in both.items()}
            whole["inputs"] = _goal_inputs(space)
        return whole

    def _reflex(self, reflex: Reflex, prefix: str) -> list[Any]:
        name = f"{prefix}{reflex.name}"
        code = None
        fixed = None
        what = "observations (1, ...) to (1,) bool"
        condition = self._asks(f"{name}.condition", reflex.condition, what)
        if callable(reflex.action):
            what = "observations (1, ...) to actions (1, ...)"
            code = self._asks(f"{name}.action", reflex.action, what)
        else:
            fixed = reflex.fixed(self.space).tolist()
        return [condition, code, fixed]

    def _network(self, graph: Graph, name: str) -> dict[str, Any]:
        return {
            "kind": "Network",
            "file": self._file(name, graph.content),
            "choices": graph.choices,
            "memory": {"memory": graph.memory} if graph.memory else {},
            "noise": [list(n) for n in graph.noise],
        }

    def _exported(self, policy: ExportedNetwork, name: str) -> dict[str, Any]:
        """Return the entry of a network that was loaded from an export, with its new file."""
        return {"kind": "Network", **policy.entry, "file": self._file(name, policy.data)}

    def _model(self, policy: MappedPolicy, name: str, where: str, sampled: bool) -> dict[str, Any]:
        if sampled and isinstance(policy, SB3Policy):
            raise PolicyError(
                f"{where} samples by Stable-Baselines3's own code, which the runner does not have: "
                "train with selection=Selection(greedy_skills=True)"
            )

        def name_of(function: Any, what: str) -> str:
            plain = written_name(function).rpartition(":")[2]
            return self._asks(f"{name}.{plain}", function, what)

        entry: dict[str, Any] = {
            "kind": "Model",
            "file": None,
            "code": None,
            "output": None,
            "state": [],
            "single_state": policy.mapping.single_state,
            "logits": policy.logits,
            "sampled": sampled,
            "with_goal": None,
        }
        if isinstance(policy, ScriptedPolicy):
            what = "its inputs to outputs (1, ...), as the mapping in policy.json says"
            entry["code"] = self._asks(f"{name}.policy", policy.function, what)
            entry["with_goal"] = policy.with_goal
            entry["state"] = [
                {
                    "input": None,
                    "output": None,
                    "shape": [1 if n is None else n for n in shape],
                    "axis": shape.index(None),
                }
                for shape in policy.mapping.state
            ]
            return mapping_entry(policy.plan, "", name_of) | entry
        model = model_of(policy, where)
        entry["file"] = self._file(name, model.content)
        entry["output"] = model.output
        entry["state"] = [
            {"input": given, "output": after, "shape": list(shape), "axis": None}
            for given, after, shape in model.state
        ]
        mapped = mapping_entry(policy.plan, model.only, name_of)
        if mapped["sees"] is None and isinstance(policy, OnnxPolicy):
            shape = list(policy.observation_space.shape or ())
            whole: dict[str, Any] = {
                "source": "observation",
                "key": "",
                "places": None,
                "fields": [],
            }
            mapped["sees"] = {model.only: [whole | {"choices": [], "one_hot": False}]}
            mapped["shapes"] = {model.only: shape}
        return mapped | entry

    def _file(self, name: str, content: bytes) -> str:
        """Add a file of a part of the policy; return its name."""
        file = f"{name.replace('/', '.') or 'agent'}.onnx"
        self.files[file] = content
        return file

    def _selector(self, selector: Policy, name: str, sampled: bool) -> dict[str, Any]:
        match selector:
            case Automaton():
                if sampled:
                    raise PolicyError(
                        f"{name} is an automaton that draws among the skills of a state, which the "
                        "runner does not: train with Selection(greedy_selector=True) for it, and "
                        "greedy_skills=True for the skills around it"
                    )
                return self._automaton(selector, name)
            case FunctionSelector():
                last = ", and the LastCall," if selector.takes_last_call else ""
                beside = " and goals" if selector.goal_spaces else ""
                what = f"observations (1, ...){last} to skills (1,){beside}"
                return {
                    "kind": "Function",
                    "code": self._asks(name, selector.function, what),
                    "names": list(selector.skills),
                    "asks_last": selector.takes_last_call,
                    "goals": list(selector.goal_spaces),
                }
            case Planner():
                entry, content = plan_entry(selector, name, self._asks)
                file = f"{name.replace('/', '.')}.npz"
                self.files[file] = content
                return entry | {"file": file}
            case AgentPolicy():
                return self._network(agent_graph(selector, sampled, name), name)
            case ExportedNetwork():
                return self._exported(selector, name)
        raise PolicyError(
            f"{name} is a {getattr(selector, 'kind', type(selector).__name__)}, which the runner "
            "cannot run: select by an Automaton, by a function, or train the selector"
        )

    def _automaton(self, selector: Automaton, name: str) -> dict[str, Any]:
        ranks = selector.ranks
        transitions = []
        for origin, target, event in selector.arrows:
            ends = event
            code = None
            if callable(event):
                ends = ""
                what = "a Step to (1,) bool"
                code = self._asks(f"{name}.{function_name(event)}", event, what)
            transitions.append([origin, target, ends, code])
        order = [[int(i) for i in np.argsort(-rank, kind="stable") if rank[i]] for rank in ranks]
        start = selector.state_names.index(selector.start_state)
        goals = []
        for (state, skill), goal in selector.goals.items():
            place = selector.state_names.index(state), selector.skills.index(skill)
            code = None
            if callable(goal):
                what = "observations (1, ...) to goals (1, ...)"
                code = self._asks(f"{name}.{function_name(goal)}", goal, what)
            goals.append([*place, None if code else _as_json(goal), code])
        return {
            "kind": "Automaton",
            "start": start,
            "skills": order,
            "transitions": transitions,
            "goals": goals,
        }

    def _asks(self, name: str, function: Any, what: str) -> str:
        """Return the runner's name of a function; a second function of a name gets a number."""
        names = [name, *(f"{name}#{i}" for i in range(2, 1000))]
        free = next(n for n in names if self.functions.get(n, function) == function)
        self.functions[free] = function
        self.code[free] = what
        return free


def _is_joined(policy: Policy | None) -> bool:
    """Return whether the policy of a skill with goals observes observation and goal as one.

    What takes the goal by another input does not; of a hierarchy only the selector does.
    """
    mapped = isinstance(policy, MappedPolicy) and policy.has_goals
    return not mapped and not isinstance(policy, HierarchyPolicy)


def _goal_inputs(space: gym.Space[Any]) -> list[list[Any]]:
    """Return the inputs of files that a goal is: names, and fields in the goal."""
    return [[f"obs.goal{name[3:]}", fields] for name, fields, _ in inputs_of(space)]


def _short(numbers: Array) -> Any:
    """Return numbers as JSON; one number if all are equal."""
    same = (numbers == numbers.flat[0]).all()
    return numbers.flat[0].item() if same else numbers.tolist()


def _as_json(goal: Any) -> Any:
    """Return a fixed goal as JSON."""
    if isinstance(goal, Mapping):
        return {name: _as_json(part) for name, part in goal.items()}
    if isinstance(goal, tuple | list):
        return [_as_json(part) for part in goal]
    return np.asarray(goal).tolist()
