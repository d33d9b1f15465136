"""Compare a declaration with a run, and apply the run's manifest to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from skillweave.envs.make import EnvSpec
from skillweave.errors import RunError
from skillweave.hierarchy import training
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.guidance import adopt_guide
from skillweave.hierarchy.nesting import copied, every_hierarchy, every_skill, inner_of
from skillweave.hierarchy.weights import adopt_calls, check_selector
from skillweave.reporting.report.facts import plain, settings
from skillweave.runs.command_words import Caller, called_by
from skillweave.runs.directory import RunDirectory
from skillweave.training.plain_agent import PlainAgent
from skillweave.types import Policy

MOST_NAMED = 3
"""Settings that a message names."""

D = TypeVar("D", bound=Declaration | PlainAgent)
Trained = tuple[D, RunDirectory, Policy]
"""A declaration with a run's manifest applied, the run, and its policy."""


def load_policy(declared: D, path: Path) -> Trained[D]:
    """Open the finished run at ``path`` and load its policy.

    Raises:
        RunError: there is no run, it is not finished or damaged, or is one of another declaration.
    """
    run = RunDirectory.open(path)
    declared.validate()
    with called_by(caller_of(declared)):
        declared = apply_manifest(declared, run)
        return declared, run, training.load(declared, run)


def caller_of(declared: Declaration | PlainAgent) -> Caller:
    """Return what messages call a declaration."""
    return "hierarchy" if isinstance(declared, Declaration) else "agent"


def apply_manifest(declared: D, run: RunDirectory) -> D:
    """Return a copy that calls its skills as a run does, here and in hierarchies below.

    Raises:
        RunError: the run is not one of this declaration.
    """
    check_run(declared, run)
    if not isinstance(declared, Declaration) or run.manifest["kind"] != "hierarchy":
        return declared
    copy = copied(declared)
    entries = {s["name"]: s for s in run.manifest["skills"]}
    for path, skill in every_skill(copy.skills):
        for field in ("max_steps", "call_steps"):
            if getattr(skill, field) != entries[path].get(field):
                setattr(skill, field, entries[path].get(field))
    for path, hierarchy in every_hierarchy(copy):
        if path:
            _apply_settings(hierarchy, entries[path]["hierarchy"], f"{run.path}: {path}")
        else:
            _apply_settings(hierarchy, run.manifest, str(run.path))
    return copy


def describe_differences(
    declared: Declaration | PlainAgent, run: RunDirectory, recipe: str | None = None
) -> str:
    """Describe the settings in which a run differs from its declaration; empty if none does.

    A recipe's settings are not compared: the command line may have changed them.
    """
    if declared.recorded or recipe is not None:
        return ""
    seed, flat = run.manifest["seed"], run.manifest["kind"] == "agent"
    if isinstance(declared, Declaration):
        content = training.manifest(declared, seed=seed, flat=flat)
    else:
        content = declared.manifest(seed)
    return differences(content, run)


def differences(content: Mapping[str, Any], run: RunDirectory, *, budgets: bool = True) -> str:
    """Describe the settings in which a run differs from a manifest; empty if none does.

    Args:
        content: the manifest that a new run would have.
        budgets: compare the steps of stages, too.
    """
    here, there = settings(content), settings(run.manifest)
    if not budgets:
        here = {k: v for k, v in here.items() if not k.endswith(".budget")}
    evolve = tuple(f"{s['name']}." for s in run.manifest["stages"] if s.get("evolution"))
    # A population's settings follow a plan. A file's place is no setting; its checksum is.
    both = [k for k in here if k in there and not k.startswith(evolve) and not k.endswith(".file")]
    # Greediness that this declaration leaves open cannot differ.
    greedy = ("greedy_skills", "greedy_selector")
    unset = {k for k in both if k.endswith(greedy) and here[k] is None}
    differ = [k for k in both if k not in unset and plain(here[k]) != plain(there[k])]
    if not differ:
        return ""
    named = [
        f"{k} is {plain(there[k])} (declared now: {plain(here[k])})" for k in differ[:MOST_NAMED]
    ]
    more = f", and {len(differ) - MOST_NAMED} more differ" if len(differ) > MOST_NAMED else ""
    return f"the run continues with its own settings: {', '.join(named)}{more}"


def _apply_settings(declared: Declaration, entry: dict[str, Any], where: str) -> None:
    adopt_guide(declared, entry, where)
    adopt_calls(declared, entry)
    declared.learn = entry["learn"]
    search = ("start_calls", "search_steps", "episode_calls")
    declared.apart = replace(declared.apart, **{name: entry[name] for name in search})
    declared.selection = replace(declared.selection, call_cost=entry["call_cost"])


def check_run(declared: Declaration | PlainAgent, run: RunDirectory) -> None:
    """Raise a RunError where a run is not one of this declaration."""
    if run.manifest["kind"] == "hierarchy":
        if isinstance(declared, PlainAgent):
            raise RunError(f"{run.path} is the run of a hierarchy, not of a plain agent")
        skills = dict(every_skill(declared.skills))
        mine = list(skills)
        theirs = [s["name"] for s in run.manifest["skills"]]
        if mine != theirs:
            raise RunError(
                f"{run.path} was trained with the skills {', '.join(theirs)}, but this hierarchy "
                f"has {', '.join(mine)}"
            )
        ready = declared.ready_selector is not None
        check_selector(ready, "selector" in run.manifest, str(run.path))
        for entry in run.manifest["skills"]:
            inner = inner_of(skills[entry["name"]])
            if (inner is not None) != ("hierarchy" in entry):
                raise RunError(
                    f"{run.path}: skill {entry['name']!r} is a hierarchy in the run or in "
                    "this declaration, not in both; declare it as it was trained"
                )
            if inner is not None:
                where = f"{run.path}: {entry['name']}"
                ready = inner.ready_selector is not None
                check_selector(ready, "selector" in entry["hierarchy"], where)
                _check_reflexes(inner, entry["hierarchy"], where)
        _check_reflexes(declared, run.manifest, str(run.path))
    _check_place(declared, run)


def _check_reflexes(declared: Declaration, entry: dict[str, Any], where: str) -> None:
    """Raise a RunError where the reflexes are not those of training."""
    theirs: list[str] = entry["reflexes"]
    mine = [str(r.name) for r in declared.reflexes]
    if mine != theirs:
        raise RunError(
            f"{where} was trained with {_reflexes(theirs)}, but this hierarchy has "
            f"{_reflexes(mine)}: declare them as they were, or train again"
        )


def _reflexes(names: list[str]) -> str:
    return f"the reflexes {', '.join(names)}" if names else "no reflexes"


def _check_place(declared: Declaration | PlainAgent, run: RunDirectory) -> None:
    """Raise a RunError where a run was trained in another environment."""
    theirs, their_kwargs = run.manifest["env"], run.manifest["env_kwargs"]
    mine, my_kwargs = declared.spec.name, declared.spec.json_kwargs
    if (theirs, their_kwargs) == (mine, my_kwargs):
        return
    if theirs == mine:
        theirs, mine = f"{theirs} made with {their_kwargs}", f"one made with {my_kwargs}"
    what = "agent" if isinstance(declared, PlainAgent) else "hierarchy"
    raise RunError(
        f"{run.path} was trained on {theirs}, but this {what} is on {mine}. Load it where it was "
        "trained; to try its policy elsewhere then: evaluate(run.policy, env)"
    )


def spec_of(header: dict[str, Any]) -> EnvSpec:
    """Return the environment that a manifest or a weights file's header names.

    Raises:
        RunError: it needs code.
    """
    spec = EnvSpec(header["env"], kwargs=header.get("env_kwargs", {}))
    if not spec.is_data:
        raise RunError(f"the environment {spec.name!r} names code; give the recipe")
    return spec
