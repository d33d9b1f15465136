"""Whether a run is one of a declaration, and what the declaration takes over from it."""

from __future__ import annotations

from typing import Any

from skillweave.envs.make import EnvSpec
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.guidance import adopt_guide
from skillweave.hierarchy.nesting import every_hierarchy, every_skill, inner_of
from skillweave.hierarchy.weights import adopt_calls, check_selector
from skillweave.runs.directory import RunDirectory
from skillweave.training.plain_agent import PlainAgent
from skillweave.types import SkillweaveError


def adopt(declared: Declaration, run: RunDirectory) -> None:
    """Take over from a run how skills are called, here and in hierarchies below, if it fits.

    Raises:
        SkillweaveError: the run is not one of this declaration.
    """
    check_run(declared, run)
    if run.manifest["kind"] != "hierarchy":
        return
    entries = {s["name"]: s for s in run.manifest["skills"]}
    for path, own in every_hierarchy(declared):
        if path:
            _adopt(own, entries[path]["hierarchy"], f"{run.path}: {path}")
        else:
            _adopt(own, run.manifest, str(run.path))


def _adopt(declared: Declaration, told: dict[str, Any], where: str) -> None:
    adopt_guide(declared, told, where)
    adopt_calls(declared, told)
    declared.learn = told.get("learn", "apart")
    declared.reflexes_in_training = told.get("reflexes_in_training", True)
    declared.start_calls = told.get("start_calls")
    declared.search_steps = told.get("search_steps")


def check_run(declared: Declaration | PlainAgent, run: RunDirectory) -> None:
    """Raise a SkillweaveError where a run is not one of this declaration."""
    if run.manifest["kind"] == "hierarchy":
        if isinstance(declared, PlainAgent):
            raise SkillweaveError(f"{run.path} is the run of a hierarchy, not of a plain agent")
        found = dict(every_skill(declared.skills))
        mine = list(found)
        theirs = [s["name"] for s in run.manifest["skills"]]
        if mine != theirs:
            raise SkillweaveError(
                f"{run.path} was trained with the skills {', '.join(theirs)}, but this hierarchy "
                f"has {', '.join(mine)}"
            )
        ready = declared.ready_selector is not None
        check_selector(ready, "selector" in run.manifest, str(run.path))
        for entry in run.manifest["skills"]:
            inner = inner_of(found[entry["name"]])
            if (inner is not None) != ("hierarchy" in entry):
                raise SkillweaveError(
                    f"{run.path}: of skill {entry['name']!r} the run and this declaration do not "
                    "say the same: to one it is a hierarchy"
                )
            if inner is not None:
                where, ready = f"{run.path}: {entry['name']}", inner.ready_selector is not None
                check_selector(ready, "selector" in entry["hierarchy"], where)
    if run.manifest["env"] != declared.spec.name:
        what = "agent" if isinstance(declared, PlainAgent) else "hierarchy"
        raise SkillweaveError(
            f"{run.path} was trained on {run.manifest['env']}, but this {what} is on "
            f"{declared.spec.name}"
        )


def spec_of(told: dict[str, Any]) -> EnvSpec:
    """The environment that a manifest or a header names.

    Raises:
        SkillweaveError: it is one that needs code.
    """
    spec = EnvSpec(told["env"], kwargs=told.get("env_kwargs", {}))
    if not spec.is_data:
        raise SkillweaveError(f"the environment {spec.name!r} names code; give the recipe")
    return spec
