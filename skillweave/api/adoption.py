"""Whether a run is one of a declaration, and what the declaration takes over from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from skillweave.envs.make import EnvSpec
from skillweave.errors import RunError
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.guidance import adopt_guide
from skillweave.hierarchy.nesting import copied, every_hierarchy, every_skill, inner_of
from skillweave.hierarchy.training import manifest
from skillweave.hierarchy.weights import adopt_calls, check_selector
from skillweave.reporting.report.facts import plain, settings
from skillweave.runs.directory import RunDirectory
from skillweave.training.plain_agent import PlainAgent

if TYPE_CHECKING:
    from skillweave.api import Agent, Hierarchy

MOST_NAMED = 3
"""Settings that a message names."""

D = TypeVar("D", bound=Declaration)


def adopted(declared: D, run: RunDirectory) -> D:
    """A copy that calls its skills as a run does, here and in hierarchies below, if it fits.

    Raises:
        RunError: the run is not one of this declaration.
    """
    check_run(declared, run)
    if run.manifest["kind"] != "hierarchy":
        return declared
    found = copied(declared)
    entries = {s["name"]: s for s in run.manifest["skills"]}
    for path, skill in every_skill(found.skills):
        for field in ("max_steps", "call_steps"):
            if getattr(skill, field) != entries[path].get(field):
                setattr(skill, field, entries[path].get(field))
    for path, own in every_hierarchy(found):
        if path:
            _adopt(own, entries[path]["hierarchy"], f"{run.path}: {path}")
        else:
            _adopt(own, run.manifest, str(run.path))
    return found


def told_differences(declared: Hierarchy | Agent, run: RunDirectory) -> str:
    """A sentence on settings that a run has otherwise than declared; empty if there are none.

    A recipe is not asked: nobody knows any more what was changed on the command line.
    """
    if declared.recorded or declared.recipe is not None:
        return ""
    seed, flat = run.manifest["seed"], run.manifest["kind"] == "agent"
    if isinstance(declared, Declaration):
        content = manifest(declared, seed=seed, flat=flat)
    else:
        content = declared.manifest(seed)
    return differences(content, run)


def differences(content: Mapping[str, Any], run: RunDirectory, *, budgets: bool = True) -> str:
    """Return a sentence on settings that a run has otherwise; empty if there are none.

    Args:
        content: the manifest that a new run would have.
        budgets: also on the steps of stages.
    """
    here, there = settings(content), settings(run.manifest)
    if not budgets:
        here = {k: v for k, v in here.items() if not k.endswith(".budget")}
    evolve = tuple(f"{s['name']}." for s in run.manifest["stages"] if s.get("evolution"))
    # A population's settings follow a plan. Where a file lies is no setting; its checksum is.
    both = [k for k in here if k in there and not k.startswith(evolve) and not k.endswith(".file")]
    # Nor is it told where this declaration leaves it open.
    left = [k for k in both if k.endswith(("greedy_skills", "greedy_selector")) and here[k] is None]
    differ = [k for k in both if k not in left and plain(here[k]) != plain(there[k])]
    if not differ:
        return ""
    named = [
        f"{k} is {plain(there[k])} (declared now: {plain(here[k])})" for k in differ[:MOST_NAMED]
    ]
    more = f", and {len(differ) - MOST_NAMED} more differ" if len(differ) > MOST_NAMED else ""
    return f"the run continues with its own settings: {', '.join(named)}{more}"


def _adopt(declared: Declaration, told: dict[str, Any], where: str) -> None:
    adopt_guide(declared, told, where)
    adopt_calls(declared, told)
    declared.learn = told["learn"]
    search = ("start_calls", "search_steps", "episode_calls")
    declared.apart = replace(declared.apart, **{name: told[name] for name in search})
    declared.selection = replace(declared.selection, call_cost=told["call_cost"])


def check_run(declared: Declaration | PlainAgent, run: RunDirectory) -> None:
    """Raise a RunError where a run is not one of this declaration."""
    if run.manifest["kind"] == "hierarchy":
        if isinstance(declared, PlainAgent):
            raise RunError(f"{run.path} is the run of a hierarchy, not of a plain agent")
        found = dict(every_skill(declared.skills))
        mine = list(found)
        theirs = [s["name"] for s in run.manifest["skills"]]
        if mine != theirs:
            raise RunError(
                f"{run.path} was trained with the skills {', '.join(theirs)}, but this hierarchy "
                f"has {', '.join(mine)}"
            )
        ready = declared.ready_selector is not None
        check_selector(ready, "selector" in run.manifest, str(run.path))
        for entry in run.manifest["skills"]:
            inner = inner_of(found[entry["name"]])
            if (inner is not None) != ("hierarchy" in entry):
                raise RunError(
                    f"{run.path}: of skill {entry['name']!r} the run and this declaration do not "
                    "say the same: to one it is a hierarchy"
                )
            if inner is not None:
                where, ready = f"{run.path}: {entry['name']}", inner.ready_selector is not None
                check_selector(ready, "selector" in entry["hierarchy"], where)
                _check_reflexes(inner, entry["hierarchy"], where)
        _check_reflexes(declared, run.manifest, str(run.path))
    _check_place(declared, run)


def _check_reflexes(declared: Declaration, told: dict[str, Any], where: str) -> None:
    """Raise a RunError where others are in force than those that were trained with."""
    theirs: list[str] = told["reflexes"]
    mine = [str(r.name) for r in declared.reflexes]
    if mine != theirs:
        raise RunError(
            f"{where} was trained with {_reflexes(theirs)}, but this hierarchy has "
            f"{_reflexes(mine)}: declare them as they were, or train anew"
        )


def _reflexes(names: list[str]) -> str:
    return f"the reflexes {', '.join(names)}" if names else "no reflexes"


def _check_place(declared: Declaration | PlainAgent, run: RunDirectory) -> None:
    """Raise a RunError where a run was trained in another environment."""
    theirs, kwargs = run.manifest["env"], run.manifest["env_kwargs"]
    mine, own = declared.spec.name, declared.spec.json_kwargs
    if (theirs, kwargs) == (mine, own):
        return
    if theirs == mine:
        theirs, mine = f"{theirs} made with {kwargs}", f"one made with {own}"
    what = "agent" if isinstance(declared, PlainAgent) else "hierarchy"
    raise RunError(
        f"{run.path} was trained on {theirs}, but this {what} is on {mine}. Load it where it was "
        "trained; to try its policy elsewhere then: evaluate(run.policy, env)"
    )


def spec_of(told: dict[str, Any]) -> EnvSpec:
    """The environment that a manifest or a header names.

    Raises:
        RunError: it is one that needs code.
    """
    spec = EnvSpec(told["env"], kwargs=told.get("env_kwargs", {}))
    if not spec.is_data:
        raise RunError(f"the environment {spec.name!r} names code; give the recipe")
    return spec
