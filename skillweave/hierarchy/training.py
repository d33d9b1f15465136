"""A hierarchy's schedule: every skill apart, then the selector; or one plain agent."""

from __future__ import annotations

from typing import Any

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.hierarchy.declaration import Declaration, check_target
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.weights import check_parts
from skillweave.ops.threads import torch_threads
from skillweave.runs.directory import RunDirectory
from skillweave.skills import Skill, ready_policy
from skillweave.skills.foreign_policy import as_recorded, source_of
from skillweave.training.plain_agent import PlainAgent, load_agent_of
from skillweave.training.scene import Scene, selector_scene, skill_scene
from skillweave.training.stage import Policies, Stage, target_of
from skillweave.training.stage_log import Listener
from skillweave.training.trainer import MakeLearner, OneAgent, train_stages
from skillweave.types import Policy

SELECTOR = "selector"
"""What the selector's stage is named."""


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
        "call_steps": declaration.call_steps,
        "greedy_skills": declaration.greedy_skills,
        "reflexes_in_training": declaration.reflexes_in_training,
        "resume_needs_recipe": not declaration.trains_from_data,
        "reflexes": [r.name for r in declaration.reflexes],
        "needs_recipe": not declaration.is_data,
        **_selector_entry(declaration),
        "stages": [stage.entry() for stage in stages_of(declaration)],
    }


def stages_of(declaration: Declaration) -> list[Stage]:
    """The skills that are to be trained, each apart, then the selector if it is not ready."""
    reflexes = declaration.reflexes if declaration.reflexes_in_training else ()

    def skill_stage(skill: Skill) -> Stage:
        config, budget = skill.algorithm or declaration.algorithm, declaration.budget(skill)
        target = check_target(skill)

        def scene(policies: Policies) -> Scene:
            others = [s for s in declaration.skills if s.name in policies]
            starters = declaration.skill_set([policies[s.name] for s in others], others)
            return skill_scene(declaration.spec, skill, reflexes, starters if others else None)

        return Stage(skill.name, "skill", config, budget, scene, target)

    def calls(policies: Policies) -> Scene:
        skills = declaration.skill_set([policies[s.name] for s in declaration.skills])
        return selector_scene(declaration.spec, skills)

    stages = [skill_stage(s) for s in declaration.skills if s.policy is None]
    if isinstance(config := declaration.selector, AlgorithmConfig):
        target = target_of(declaration.selector_target_return, None, SELECTOR)
        budget = declaration.selector_steps
        stages.append(Stage(SELECTOR, "selector", config, budget, calls, target))
    return stages


@torch_threads(1)  # a loop sets its own; all else must not depend on how many there are
def train(
    declaration: Declaration | PlainAgent,
    run: RunDirectory,
    listeners: tuple[Listener, ...] = (),
    make_learner: MakeLearner = OneAgent,
) -> Policy:
    """Train, or finish training, what the run says; returns the policy."""
    if run.manifest["kind"] == "agent":
        agent = declaration if isinstance(declaration, PlainAgent) else declaration.plain_agent()
        (stage,) = agent.stages(run.manifest["stages"][0]["name"])
        return train_stages([stage], run, listeners, {}, make_learner)[stage.name]
    assert isinstance(declaration, Declaration)
    ready = _ready(declaration, run)
    for name, policy in ready.items():
        run.keep_policy(name, policy)
    found = train_stages(stages_of(declaration), run, listeners, ready, make_learner)
    skills = declaration.skill_set([found[s.name] for s in declaration.skills])
    selector = _ready_selector(declaration, run, skills.policies[0]) or found[SELECTOR]
    return HierarchyPolicy(selector, skills)


def load(declaration: Declaration | PlainAgent, run: RunDirectory) -> Policy:
    """The policy of a finished run."""
    if run.manifest["kind"] == "agent":
        return load_agent_of(run)
    assert isinstance(declaration, Declaration)
    ready = _ready(declaration, run)
    names = [s.name for s in declaration.skills]
    policies = [ready[n] if n in ready else run.load_policy(n) for n in names]
    selector = _ready_selector(declaration, run, policies[0]) or run.load_policy(SELECTOR)
    check_parts(declaration, policies, selector, str(run.path))
    return HierarchyPolicy(selector, declaration.skill_set(policies))


def _ready(declaration: Declaration, run: RunDirectory) -> dict[str, Policy]:
    """The ready policies as they were when the run began."""
    ready = declaration.ready_policies()
    return {name: run.ready_policy(name, policy) for name, policy in ready.items()}


def _ready_selector(declaration: Declaration, run: RunDirectory, skill: Policy) -> Policy | None:
    """The selector where it is ready, after a check that it is that of the run."""
    selector = declaration.fitted_selector(skill.observation_space)
    if selector is None:
        return None
    return as_recorded(
        selector, run.manifest.get(SELECTOR), lambda: None, f"{run.path}: the selector"
    )


def _selector_entry(declaration: Declaration) -> dict[str, Any]:
    """Where a ready selector comes from; nothing where it is trained."""
    selector = declaration.ready_selector
    return {} if selector is None else {SELECTOR: source_of(selector)}


def _skill_entry(skill: Skill) -> dict[str, Any]:
    policy = ready_policy(skill)
    entry = {"name": skill.name, "max_steps": skill.max_steps, "ready": policy is not None}
    if skill.call_steps is not None:
        entry["call_steps"] = skill.call_steps
    return entry if policy is None else entry | {"policy": source_of(policy)}
