"""Training what a run says, and loading what it learnt: a hierarchy, or one plain agent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from skillweave.collecting.lengths import calls_to_json
from skillweave.hierarchy.declaration import TOGETHER, Declaration
from skillweave.hierarchy.guidance import fitted_guide, ready_guide
from skillweave.hierarchy.policy import HierarchyPolicy, with_interruption
from skillweave.hierarchy.schedule import stages_of
from skillweave.hierarchy.weights import check_parts
from skillweave.ops.threads import torch_threads
from skillweave.runs.copies import keep_policy, recorded_policy
from skillweave.runs.directory import RunDirectory
from skillweave.skills import Skill, ready_policy
from skillweave.skills.foreign_policy import as_recorded, source_of
from skillweave.training.evaluation import evaluate
from skillweave.training.plain_agent import PlainAgent, load_agent_of
from skillweave.training.stage import CRITIC, SELECTOR, Policies
from skillweave.training.stage_log import Listener
from skillweave.training.trainer import MakeLearner, train_stages
from skillweave.training.woven import agents_of
from skillweave.types import Policy, SkillweaveError


def manifest(declaration: Declaration, *, seed: int, flat: bool) -> dict[str, Any]:
    """What a new run's ``run.json`` says."""
    if flat:
        return declaration.plain_agent().manifest(seed)
    return {
        "kind": "hierarchy",
        "env": declaration.spec.name,
        "env_kwargs": declaration.spec.kwargs,
        "seed": seed,
        "cut_every": declaration.cut_every,
        "eval_every": declaration.eval_every,
        "eval_episodes": declaration.eval_episodes,
        "skills": [_skill_entry(s) for s in declaration.skills],
        **calls_to_json(declaration.call_steps),
        "learn": declaration.learn,
        "interrupt": declaration.together.margin if declaration.interrupt else None,
        "greedy_skills": declaration.greedy_skills,
        "reflexes_in_training": declaration.reflexes_in_training,
        "start_calls": declaration.start_calls,
        "resume_needs_recipe": not declaration.trains_from_data,
        "reflexes": [r.name for r in declaration.reflexes],
        "needs_recipe": not declaration.is_data,
        **_selector_entry(declaration),
        "stages": [stage.entry() for stage in stages_of(declaration)],
    }


JUDGED = 1_000
"""Seeds of evaluations from here on tell which hierarchy is better: people take smaller ones."""


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
        (stage,) = agent.stages(run.manifest["stages"][0]["name"])
        return train_stages([stage], run, listeners, {}, make_learner)[stage.name]
    assert isinstance(declaration, Declaration)
    ready = _ready(declaration, run)
    for name, policy in ready.items():
        keep_policy(run, name, policy)
    stages = stages_of(declaration)
    apart = [s for s in stages if s.kind != "together"]
    before = train_stages(apart, run, listeners, ready, make_learner)
    if len(apart) == len(stages):
        return _woven(declaration, run, before)
    after = train_stages(stages[len(apart) :], run, listeners, before, make_learner)
    if not apart:
        return _woven(declaration, run, after)
    return _better(declaration, run, listeners, before, after)


def _better(
    declaration: Declaration,
    run: RunDirectory,
    listeners: tuple[Listener, ...],
    before: Policies,
    after: Policies,
) -> HierarchyPolicy:
    """The better of two hierarchies, by episodes of the environment; written into the run."""
    entry = run.stage(TOGETHER)
    policies = {
        "before": _woven(declaration, run, before),
        "after": _woven(declaration, run, after),
    }
    if "kept" not in entry:
        seed = JUDGED + int(run.manifest["seed"])
        means = {
            name: evaluate(policy, declaration.spec, episodes=100, seed=seed)
            for name, policy in policies.items()
        }
        entry["kept"] = {name: found.mean for name, found in means.items()}
        better = means["after"].mean >= means["before"].mean
        entry["kept"]["kept"] = "after" if better else "before"
        entry["evaluation_steps"] += sum(sum(found.lengths) for found in means.values())
        run.save()
        kept = entry["kept"]
        for listener in listeners:
            listener.message(
                f"{TOGETHER}: mean return before {kept['before']:.1f}, after {kept['after']:.1f} "
                f"(100 episodes each): kept what was {kept['kept']}"
            )
    return policies[entry["kept"]["kept"]]


def load(declaration: Declaration | PlainAgent, run: RunDirectory) -> Policy:
    """The policy of a finished run."""
    if run.manifest["kind"] == "agent":
        return load_agent_of(run)
    assert isinstance(declaration, Declaration)
    ready = _ready(declaration, run)
    found = ready | _learnt(run)
    if run.unjudged:
        raise SkillweaveError(
            f"{run.path}: all is learnt, but whether the hierarchy before or that after learning "
            f"together is better was not judged yet; skillweave resume {run.path}"
        )
    policy = _woven(declaration, run, found)
    check_parts(declaration, policy.skills.policies, policy.selector, str(run.path))
    return policy


def _learnt(run: RunDirectory) -> dict[str, Policy]:
    """By name, everyone who learnt in a finished run, as they were in the end."""
    found: dict[str, Policy] = {}
    for entry in run.manifest["stages"]:
        if entry.get("kept", {}).get("kept") != "before":
            found |= run.load_policies(entry["name"])
    return found


def _woven(
    declaration: Declaration, run: RunDirectory, found: Mapping[str, Policy]
) -> HierarchyPolicy:
    """The hierarchy of these policies."""
    skills = declaration.skill_set([found[s.name] for s in declaration.skills])
    if declaration.interrupt:
        skills = with_interruption(skills, found[CRITIC], declaration.together.margin)
    selector = _ready_selector(declaration, run, skills.policies[0]) or found[SELECTOR]
    guide = fitted_guide(declaration, selector.observation_space)
    if guide is None or not guide.restricts:
        return HierarchyPolicy(selector, skills)
    told = run.manifest.get("guide")
    as_recorded(cast(Policy, guide.selector), told, lambda: None, f"{run.path}: the guide")
    return HierarchyPolicy(selector, skills, guide)


def _ready(declaration: Declaration, run: RunDirectory) -> dict[str, Policy]:
    """The ready policies as they were when the run began."""
    ready = declaration.ready_policies()
    return {name: recorded_policy(run, name, policy) for name, policy in ready.items()}


def _ready_selector(declaration: Declaration, run: RunDirectory, skill: Policy) -> Policy | None:
    """The selector where it is ready, after a check that it is that of the run."""
    selector = declaration.fitted_selector(skill.observation_space)
    if selector is None:
        return None
    return as_recorded(
        selector, run.manifest.get(SELECTOR), lambda: None, f"{run.path}: the selector"
    )


def _selector_entry(declaration: Declaration) -> dict[str, Any]:
    """Where a ready selector comes from, or the guide of a trained one."""
    selector = declaration.ready_selector
    found: dict[str, Any] = {} if selector is None else {SELECTOR: source_of(selector)}
    if (guide := ready_guide(declaration)) is not None:
        found |= {"guide": source_of(guide), "guide_restricts": declaration.guide_restricts}
    return found


def _skill_entry(skill: Skill) -> dict[str, Any]:
    policy = ready_policy(skill)
    entry = {"name": skill.name, "max_steps": skill.max_steps, "ready": policy is not None}
    if skill.call_steps is not None:
        entry["call_steps"] = skill.call_steps
    return entry if policy is None else entry | {"policy": source_of(policy)}
