"""A hierarchy's schedule: every skill apart, then the selector; or one plain agent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from skillweave.algorithms.config import PPO, AlgorithmConfig, SkillCritic
from skillweave.collecting.calls import Interruption, calls_to_json
from skillweave.hierarchy.declaration import TOGETHER, Declaration, check_target
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.weights import check_parts
from skillweave.ops.threads import torch_threads
from skillweave.runs.directory import RunDirectory
from skillweave.skills import Skill, ready_policy
from skillweave.skills.foreign_policy import source_of
from skillweave.training.evaluation import evaluate
from skillweave.training.plain_agent import PlainAgent, load_agent_of
from skillweave.training.scene import (
    Scene,
    WovenScene,
    selector_scene,
    skill_scene,
    woven_scene,
)
from skillweave.training.stage import CRITIC, SELECTOR, Policies, Stage, target_of
from skillweave.training.stage_log import Listener
from skillweave.training.trainer import MakeLearner, OneAgent, train_stages
from skillweave.types import Policy


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
        "resume_needs_recipe": not declaration.trains_from_data,
        "reflexes": [r.name for r in declaration.reflexes],
        "needs_recipe": not declaration.is_data,
        "stages": [stage.entry() for stage in stages_of(declaration)],
    }


def stages_of(declaration: Declaration) -> list[Stage]:
    """Who learns when: skills apart, then the selector; then all together."""
    apart = _apart(declaration) if declaration.learns_apart else []
    return [*apart, *([_together(declaration)] if declaration.weaves else [])]


def _together(declaration: Declaration) -> Stage:
    """The stage in which skills and selector learn from the same steps."""
    how, learns = declaration.together, [s for s in declaration.skills if s.policy is None]

    beside: dict[str, AlgorithmConfig] = {
        s.name: s.algorithm or declaration.algorithm for s in learns
    }

    def scene(policies: Policies) -> WovenScene:
        acts: Any = [None if s in learns else policies[s.name] for s in declaration.skills]
        numbers = tuple(i for i, s in enumerate(declaration.skills) if s in learns)
        return woven_scene(declaration.spec, declaration.skill_set(acts), numbers)

    config: Any = declaration.selector
    if isinstance(config, PPO) and not config.floor:
        config = replace(config, floor=how.floor, floor_final=how.floor_final)
    beside |= _critic(declaration) if how.task_weight or declaration.interrupt else {}
    target = target_of(declaration.selector_target_return, None, TOGETHER)
    budget, cuts = declaration.together_steps, declaration.interrupt
    return Stage(TOGETHER, "together", config, budget, scene, target, beside, how, cuts)


def _critic(declaration: Declaration) -> dict[str, AlgorithmConfig]:
    """The critic of skills, which sees and discounts as the selector does."""
    own: Any = declaration.selector
    shared = {f: getattr(own, f) for f in ("gamma", "learning_rate", "num_envs", "device")}
    if isinstance(own, PPO):
        shared |= {f: getattr(own, f) for f in ("n_steps", "gae_lambda", "network", "overlap")}
    return {CRITIC: SkillCritic(**shared, normalize_obs=own.normalize_obs)}


def _apart(declaration: Declaration) -> list[Stage]:
    """The skills that are to be trained, each apart, then the selector."""
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

    def watched_calls(policies: Policies) -> WovenScene:
        skills = declaration.skill_set([policies[s.name] for s in declaration.skills])
        return woven_scene(declaration.spec, skills, ())

    config, budget = declaration.selector, declaration.selector_steps
    target = target_of(declaration.selector_target_return, None, SELECTOR)
    first = [skill_stage(s) for s in declaration.skills if s.policy is None]
    if not declaration.interrupt:
        return [*first, Stage(SELECTOR, "selector", config, budget, calls, target)]
    how, beside = declaration.together, _critic(declaration)
    last = config, budget, watched_calls, target, beside, how, True
    return [*first, Stage(SELECTOR, "selector", *last)]


JUDGED = 1_000
"""Seeds of evaluations from here on tell which hierarchy is better: people take smaller ones."""


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
    stages = stages_of(declaration)
    apart = [s for s in stages if s.kind != "together"]
    before = train_stages(apart, run, listeners, ready, make_learner)
    if len(apart) == len(stages):
        return _woven(declaration, before)
    after = train_stages(stages[len(apart) :], run, listeners, before, make_learner)
    if not apart:
        return _woven(declaration, after)
    return _better(declaration, run, before, after)


def _better(
    declaration: Declaration, run: RunDirectory, before: Policies, after: Policies
) -> HierarchyPolicy:
    """The better of two hierarchies, by episodes of the environment; written into the run."""
    entry = run.stage(TOGETHER)
    policies = {"before": _woven(declaration, before), "after": _woven(declaration, after)}
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
    return policies[entry["kept"]["kept"]]


def load(declaration: Declaration | PlainAgent, run: RunDirectory) -> Policy:
    """The policy of a finished run."""
    if run.manifest["kind"] == "agent":
        return load_agent_of(run)
    assert isinstance(declaration, Declaration)
    ready = _ready(declaration, run)
    found = ready | _learnt(run)
    policies = [found[s.name] for s in declaration.skills]
    check_parts(declaration, policies, found[SELECTOR], str(run.path))
    return _woven(declaration, found)


def _learnt(run: RunDirectory) -> dict[str, Policy]:
    """By name, everyone who learnt in a finished run, as they were in the end."""
    found: dict[str, Policy] = {}
    for entry in run.manifest["stages"]:
        if entry.get("kept", {}).get("kept") != "before":
            found |= run.load_policies(entry["name"])
    return found


def _woven(declaration: Declaration, found: Mapping[str, Policy]) -> HierarchyPolicy:
    """The hierarchy of these policies."""
    skills = declaration.skill_set([found[s.name] for s in declaration.skills])
    if declaration.interrupt:
        critic: Any = found[CRITIC]
        cuts = Interruption(critic.heads, declaration.together.margin)
        skills = replace(skills, interruption=cuts)
    return HierarchyPolicy(found[SELECTOR], skills)


def _ready(declaration: Declaration, run: RunDirectory) -> dict[str, Policy]:
    """The ready policies as they were when the run began."""
    ready = declaration.ready_policies()
    return {name: run.ready_policy(name, policy) for name, policy in ready.items()}


def _skill_entry(skill: Skill) -> dict[str, Any]:
    policy = ready_policy(skill)
    entry = {"name": skill.name, "max_steps": skill.max_steps, "ready": policy is not None}
    if skill.call_steps is not None:
        entry["call_steps"] = skill.call_steps
    return entry if policy is None else entry | {"policy": source_of(policy)}
