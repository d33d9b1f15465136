"""Training by a run's manifest, and loading the result: a hierarchy, or one plain agent."""

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
from skillweave.hierarchy.select_best import resolve_greedy, select_best
from skillweave.hierarchy.weights import check_parts
from skillweave.ops.threads import torch_threads
from skillweave.runs.command_words import resume_words
from skillweave.runs.copies import keep_policy, recorded_policy
from skillweave.runs.directory import RunDirectory
from skillweave.skills import Skill, ready_policy
from skillweave.skills.foreign_policy import as_recorded, source_of
from skillweave.training.defaults import TrainDefaults
from skillweave.training.joint import agents_of
from skillweave.training.plain_agent import PlainAgent, load_agent_of
from skillweave.training.stage import SELECTOR, Policies
from skillweave.training.stage_log import Listener
from skillweave.training.stage_run import MakeLearner
from skillweave.training.trainer import train_stages
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
        flat: a manifest of the flat baseline: with its own settings, or with these.
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


@torch_threads(1)  # a loop sets its own; the rest must not depend on the number of threads
def train(
    declaration: Declaration | PlainAgent,
    run: RunDirectory,
    listeners: tuple[Listener, ...] = (),
    make_learner: MakeLearner = agents_of,
) -> Policy:
    """Train, or finish training, the stages of a run; return the policy."""
    if run.manifest["kind"] == "agent":
        agent = declaration if isinstance(declaration, PlainAgent) else declaration.plain_agent()
        (stage,) = agent.stages()
        return train_stages([stage], run, listeners, {}, make_learner)[stage.name]
    assert isinstance(declaration, Declaration)
    ready = _ready(declaration, run)
    for name, policy in ready.items():
        keep_policy(run, name, policy)
    policies = _trained(declaration, run, listeners, ready, make_learner)
    return assembled(resolve_greedy(declaration, run), policies)


def _trained(
    declaration: Declaration,
    run: RunDirectory,
    listeners: tuple[Listener, ...],
    policies: Policies,
    make_learner: MakeLearner,
    nodes: tuple[str, ...] = (),
    as_skill: Skill | None = None,
) -> Policies:
    """Return all policies after the stages of a hierarchy and of those below it, by path.

    Args:
        policies: the policies before.
        nodes: the names on the way to the hierarchy, where it is a skill of another one.
        as_skill: the hierarchy as a skill.
    """
    if declaration.learns_apart:
        for skill, inner in inner_hierarchies(declaration.skills):
            below = (*nodes, skill.name)
            policies = _trained(inner, run, listeners, policies, make_learner, below, skill)
    stages = own_stages(resolve_greedy(declaration, run, nodes), as_skill)
    for name in reversed(nodes):
        stages = [stage.inside(name) for stage in stages]
    apart = [s for s in stages if s.kind != "together"]
    before = train_stages(apart, run, listeners, policies, make_learner)
    if len(apart) == len(stages):
        return before
    after = train_stages(stages[len(apart) :], run, listeners, before, make_learner)
    return select_best(declaration, run, listeners, before, after, nodes)


def load(declaration: Declaration | PlainAgent, run: RunDirectory) -> Policy:
    """Return the policy of a finished run."""
    if run.manifest["kind"] == "agent":
        return load_agent_of(run)
    assert isinstance(declaration, Declaration)
    ready = _ready(declaration, run)
    policies = ready | _learnt(run)
    if run.unjudged:
        raise RunError(
            f"{run.path}: all is trained, but the best of the hierarchies that it could end with "
            f"was not judged yet; {resume_words(run)}"
        )
    absent = [s.name for s in declaration.skills if not can_act(s, policies)]
    if absent:
        raise RunError(
            f"{run.path}: {', '.join(map(repr, absent))} did not learn there: declare the skills "
            "with the policies that they had when it was trained"
        )
    policy = assembled(resolve_greedy(declaration, run), policies)
    check_parts(declaration, policy, str(run.path))
    return policy


def _learnt(run: RunDirectory) -> dict[str, Policy]:
    """Return the trained policies of a finished run, by path."""
    policies: dict[str, Policy] = {}
    for entry in run.manifest["stages"]:
        if entry.get("kept", {}).get("kept") != "before":
            policies |= run.load_policies(entry["name"])
    return policies


def _ready(declaration: Declaration, run: RunDirectory) -> dict[str, Policy]:
    """Return the ready policies and selectors as they were when the run started, by path."""
    ready = declaration.ready_policies()
    policies = {name: recorded_policy(run, name, policy) for name, policy in ready.items()}
    for name, policy in declaration.ready_selectors().items():
        entry = _entry_of(run, name.removesuffix(SELECTOR).removesuffix("/"))
        described = f"{run.path}: the selector" + ("" if name == SELECTOR else f" {name}")
        policies[name] = as_recorded(policy, entry.get(SELECTOR), lambda: None, described)
    for path, hierarchy in every_hierarchy(declaration):
        if (
            hierarchy.guide is not None
            and hierarchy.guide.restrict
            and (guide := ready_guide(hierarchy)) is not None
        ):
            described = f"{run.path}: the guide" + (f" of {path}" if path else "")
            as_recorded(guide, _entry_of(run, path).get("guide"), lambda: None, described)
    return policies


def _entry_of(run: RunDirectory, path: str) -> dict[str, Any]:
    """Return a run's entry of the hierarchy at ``path``; "": the outermost."""
    if not path:
        return run.manifest
    entries: list[dict[str, Any]] = run.manifest["skills"]
    return next((s["hierarchy"] for s in entries if s["name"] == path), {})


def _selector_entry(declaration: Declaration) -> dict[str, Any]:
    """Return the entry of a ready selector's source, or of a trained one's guide."""
    selector = declaration.ready_selector
    return guide_entry(declaration) if selector is None else {SELECTOR: source_of(selector)}


def _learns_together(declaration: Declaration, path: str) -> bool:
    """Return True if a skill that is a hierarchy learns together with its own skills."""
    return any(
        hierarchy.learns_together
        for node, hierarchy in every_hierarchy(declaration)
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
    """Return a run's entry of a hierarchy, the outermost or one below.

    Args:
        together: all its parts learn together in a stage; else skills and selector are greedy by
            default.
    """
    selection = declaration.selection
    apart = declaration.apart
    skills = selection.greedy_skills
    selector = selection.greedy_selector
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
