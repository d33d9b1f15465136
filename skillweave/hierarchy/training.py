"""Training what a run says, and loading what it learnt: a hierarchy, or one plain agent."""

from __future__ import annotations

from typing import Any

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.collecting.lengths import calls_to_json
from skillweave.errors import RunError
from skillweave.hierarchy.assembly import assembled, can_act
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.guidance import guide_entry, ready_guide
from skillweave.hierarchy.nesting import (
    check_nested,
    every_hierarchy,
    every_skill,
    inner_hierarchies,
    inner_of,
)
from skillweave.hierarchy.schedule import own_stages, stages_of
from skillweave.hierarchy.select_best import select_best, settled
from skillweave.hierarchy.weights import check_parts
from skillweave.ops.threads import torch_threads
from skillweave.runs.command_words import resume_words
from skillweave.runs.copies import keep_policy, recorded_policy
from skillweave.runs.directory import RunDirectory
from skillweave.skills import Skill, ready_policy
from skillweave.skills.foreign_policy import as_recorded, source_of
from skillweave.training.defaults import TrainDefaults
from skillweave.training.plain_agent import PlainAgent, load_agent_of
from skillweave.training.stage import SELECTOR, Policies
from skillweave.training.stage_log import Listener
from skillweave.training.stage_run import MakeLearner
from skillweave.training.trainer import train_stages
from skillweave.training.woven import agents_of
from skillweave.types import Policy


def manifest(
    declaration: Declaration,
    *,
    seed: int,
    flat: bool | AlgorithmConfig = False,
    how: TrainDefaults | None = None,
) -> dict[str, Any]:
    """Return the content of a new run's ``run.json``.

    Args:
        flat: of the flat baseline: with its own settings, or with these.
        how: evaluation and checkpoints; None: the declaration's defaults.
    """
    how = how or declaration.train_defaults
    if flat is not False:
        return declaration.plain_agent(None if flat is True else flat).manifest(seed, how)
    check_nested(declaration)
    stages = stages_of(declaration)
    code = any(stage.acts_by_code for stage in stages)
    learns = any(stage.learns_by_code for stage in stages)
    return {
        "kind": "hierarchy",
        "env": declaration.spec.name,
        "env_kwargs": declaration.spec.json_kwargs,
        "seed": seed,
        "checkpoint_every": how.checkpoint_every,
        "eval_every": how.eval_every,
        "eval_episodes": how.eval_episodes,
        "keep": how.keep,
        "log_info": how.log_info,
        "skills": [
            _skill_entry(path, s, together=_learns_together(declaration, path))
            for path, s in every_skill(declaration.skills)
        ],
        **_hierarchy_entry(declaration, together=declaration.learns_together),
        "resume_needs_recipe": learns or not declaration.trains_from_data,
        "needs_recipe": code or not declaration.is_data,
        "stages": [stage.entry() for stage in stages],
    }


@torch_threads(1)  # a loop sets its own; all else must not depend on how many there are
def train(
    declaration: Declaration | PlainAgent,
    run: RunDirectory,
    listeners: tuple[Listener, ...] = (),
    make_learner: MakeLearner = agents_of,
) -> Policy:
    """Train, or finish training, what the run says; returns the policy."""
    if run.manifest["kind"] == "agent":
        agent = declaration if isinstance(declaration, PlainAgent) else declaration.plain_agent()
        (stage,) = agent.stages()
        return train_stages([stage], run, listeners, {}, make_learner)[stage.name]
    assert isinstance(declaration, Declaration)
    ready = _ready(declaration, run)
    for name, policy in ready.items():
        keep_policy(run, name, policy)
    found = _trained(declaration, run, listeners, ready, make_learner)
    return assembled(settled(declaration, run), found)


def _trained(
    declaration: Declaration,
    run: RunDirectory,
    listeners: tuple[Listener, ...],
    known: Policies,
    make_learner: MakeLearner,
    nodes: tuple[str, ...] = (),
    as_skill: Skill | None = None,
) -> Policies:
    """By path, everyone who can act after the stages of a hierarchy and of those below it.

    Args:
        known: who can act before.
        nodes: the names on the way to the hierarchy, where it is a skill of another one.
        as_skill: that skill.
    """
    if declaration.learns_apart:
        for skill, inner in inner_hierarchies(declaration.skills):
            where = (*nodes, skill.name)
            known = _trained(inner, run, listeners, known, make_learner, where, skill)
    stages = own_stages(settled(declaration, run, nodes), as_skill)
    for name in reversed(nodes):
        stages = [stage.inside(name) for stage in stages]
    apart = [s for s in stages if s.kind != "together"]
    before = train_stages(apart, run, listeners, known, make_learner)
    if len(apart) == len(stages):
        return before
    after = train_stages(stages[len(apart) :], run, listeners, before, make_learner)
    return select_best(declaration, run, listeners, before, after, nodes)


def load(declaration: Declaration | PlainAgent, run: RunDirectory) -> Policy:
    """The policy of a finished run."""
    if run.manifest["kind"] == "agent":
        return load_agent_of(run)
    assert isinstance(declaration, Declaration)
    ready = _ready(declaration, run)
    found = ready | _learnt(run)
    if run.unjudged:
        raise RunError(
            f"{run.path}: all is learnt, but which of the hierarchies that it could end with is "
            f"the best was not judged yet; {resume_words(run)}"
        )
    absent = [s.name for s in declaration.skills if not can_act(s, found)]
    if absent:
        raise RunError(
            f"{run.path}: {', '.join(map(repr, absent))} did not learn there: declare the skills "
            "with the policies that they had when it was trained"
        )
    policy = assembled(settled(declaration, run), found)
    check_parts(declaration, policy, str(run.path))
    return policy


def _learnt(run: RunDirectory) -> dict[str, Policy]:
    """By name, everyone who learnt in a finished run, as they were in the end."""
    found: dict[str, Policy] = {}
    for entry in run.manifest["stages"]:
        if entry.get("kept", {}).get("kept") != "before":
            found |= run.load_policies(entry["name"])
    return found


def _ready(declaration: Declaration, run: RunDirectory) -> dict[str, Policy]:
    """By path, the ready policies as they were when the run began, those of selectors too."""
    ready = declaration.ready_policies()
    found = {name: recorded_policy(run, name, policy) for name, policy in ready.items()}
    for name, policy in declaration.ready_selectors().items():
        told = _told_of(run, name.removesuffix(SELECTOR).removesuffix("/"))
        where = f"{run.path}: the selector" + ("" if name == SELECTOR else f" {name}")
        found[name] = as_recorded(policy, told.get(SELECTOR), lambda: None, where)
    for path, own in every_hierarchy(declaration):
        if own.guide is not None and own.guide.restrict and (guide := ready_guide(own)) is not None:
            where = f"{run.path}: the guide" + (f" of {path}" if path else "")
            as_recorded(guide, _told_of(run, path).get("guide"), lambda: None, where)
    return found


def _told_of(run: RunDirectory, path: str) -> dict[str, Any]:
    """What the run says of a hierarchy: of itself, or of one below."""
    if not path:
        return run.manifest
    entries: list[dict[str, Any]] = run.manifest["skills"]
    return next((s["hierarchy"] for s in entries if s["name"] == path), {})


def _selector_entry(declaration: Declaration) -> dict[str, Any]:
    """Where a ready selector comes from, or the guide of a trained one."""
    selector = declaration.ready_selector
    return guide_entry(declaration) if selector is None else {SELECTOR: source_of(selector)}


def _learns_together(declaration: Declaration, path: str) -> bool:
    """Whether a skill that is a hierarchy learns together with its own skills at any time."""
    return any(
        own.learns_together
        for node, own in every_hierarchy(declaration)
        if not node or f"{path}/".startswith(f"{node}/")
    )


def _skill_entry(path: str, skill: Skill, *, together: bool) -> dict[str, Any]:
    inner = inner_of(skill)
    policy = ready_policy(skill) if inner is None else None
    entry: dict[str, Any] = {"name": path, "max_steps": skill.max_steps}
    entry["ready"] = policy is not None
    if skill.call_steps is not None:
        entry["call_steps"] = skill.call_steps
    if inner is not None:
        entry["hierarchy"] = _hierarchy_entry(inner, together=together)
    return entry if policy is None else entry | {"policy": source_of(policy)}


def _hierarchy_entry(declaration: Declaration, *, together: bool) -> dict[str, Any]:
    """What a run says of a hierarchy, be it itself or one below.

    Args:
        together: all in it learn together at any time; else skills and selector are greedy by
            default.
    """
    selection, apart = declaration.selection, declaration.apart
    skills, selector = selection.greedy_skills, selection.greedy_selector
    return {
        **calls_to_json(declaration.call_steps),
        "learn": declaration.learn,
        "interrupt": declaration.together.margin if declaration.together.interrupt else None,
        "greedy_skills": True if skills is None and not together else skills,
        "greedy_selector": True if selector is None and not together else selector,
        "reflexes": [r.name for r in declaration.reflexes],
        "start_calls": apart.start_calls,
        "search_steps": apart.search_steps,
        "episode_calls": apart.episode_calls,
        "call_cost": selection.call_cost,
        **_selector_entry(declaration),
    }
