"""Whether a run is one of a declaration, and what is taken over from it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from skillweave.collecting.lengths import calls_from_json
from skillweave.envs.make import EnvSpec
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.guidance import adopt_guide
from skillweave.hierarchy.weights import check_selector
from skillweave.runs.directory import RunDirectory
from skillweave.training.plain_agent import PlainAgent
from skillweave.types import SkillweaveError


def check_run(declared: Declaration | PlainAgent, run: RunDirectory) -> None:
    """Raise a SkillweaveError where a run is not one of this declaration."""
    if run.manifest["kind"] == "hierarchy":
        if isinstance(declared, PlainAgent):
            raise SkillweaveError(f"{run.path} is the run of a hierarchy, not of a plain agent")
        mine = [s.name for s in declared.skills]
        theirs = [s["name"] for s in run.manifest["skills"]]
        if mine != theirs:
            raise SkillweaveError(
                f"{run.path} was trained with the skills {', '.join(theirs)}, but this hierarchy "
                f"has {', '.join(mine)}"
            )
        ready = declared.ready_selector is not None
        check_selector(ready, "selector" in run.manifest, str(run.path))
    if run.manifest["env"] != declared.spec.name:
        what = "agent" if isinstance(declared, PlainAgent) else "hierarchy"
        raise SkillweaveError(
            f"{run.path} was trained on {run.manifest['env']}, but this {what} is on "
            f"{declared.spec.name}"
        )


def adopt_run_config(declared: Declaration, run: RunDirectory) -> None:
    """Take over from a run how its skills are called, after a check that it fits."""
    check_run(declared, run)
    if run.manifest["kind"] == "hierarchy":
        adopt_guide(declared, run.manifest, str(run.path))
        declared.call_steps = calls_from_json(run.manifest)
        margin = run.manifest.get("interrupt")
        declared.interrupt = margin is not None
        if margin is not None:
            declared.together = replace(declared.together, margin=margin)
        declared.learn = run.manifest.get("learn", "apart")
        declared.reflexes_in_training = run.manifest.get("reflexes_in_training", True)
        declared.start_calls = run.manifest.get("start_calls")
        declared.greedy_skills = run.manifest["greedy_skills"]


def spec_of(told: dict[str, Any]) -> EnvSpec:
    """The environment that a manifest or a header names, if that says it all."""
    spec = EnvSpec(told["env"], kwargs=told.get("env_kwargs", {}))
    if not spec.is_data:
        raise SkillweaveError(f"the environment {spec.name!r} names code; give the recipe")
    return spec
