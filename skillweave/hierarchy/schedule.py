"""A hierarchy's schedule: every skill apart, then the selector; or all together; or both."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from skillweave.algorithms.config import PPO, AlgorithmConfig, SkillCritic
from skillweave.hierarchy.checks import check_target
from skillweave.hierarchy.declaration import TOGETHER, Declaration
from skillweave.hierarchy.guidance import who_guides
from skillweave.skills import Skill
from skillweave.training.scene import (
    Scene,
    WovenScene,
    selector_scene,
    skill_scene,
    woven_scene,
)
from skillweave.training.stage import CRITIC, SELECTOR, Policies, Stage, target_of


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
        skills = declaration.skill_set(acts)
        if not declaration.reflexes_in_training:
            skills = replace(skills, reflexes=())
        return woven_scene(declaration.spec, skills, numbers, who_guides(declaration))

    ready = declaration.ready_selector is not None
    config: Any = declaration.algorithm if ready else declaration.selector
    if not ready and isinstance(config, PPO) and not config.floor:
        config = replace(config, floor=how.floor, floor_final=how.floor_final)
    beside |= _critic(declaration) if how.task_weight or declaration.interrupt else {}
    target = target_of(declaration.selector_target_return, None, TOGETHER)
    budget, cuts = declaration.together_steps, declaration.interrupt
    return Stage(
        TOGETHER, "together", config, budget, scene, target, beside, how, cuts, ready,
        declaration.guide_nats,
    )  # fmt: skip


def _critic(declaration: Declaration) -> dict[str, AlgorithmConfig]:
    """The critic of skills, which sees and discounts as the selector does."""
    own: Any = declaration.selector
    own = own if isinstance(own, AlgorithmConfig) else declaration.algorithm
    shared = {f: getattr(own, f) for f in ("gamma", "learning_rate", "num_envs", "device")}
    if isinstance(own, PPO):
        shared |= {f: getattr(own, f) for f in ("n_steps", "gae_lambda", "network", "overlap")}
    if "network" in shared:  # the critic remembers nothing
        shared["network"] = replace(shared["network"], rnn=None)
    return {CRITIC: SkillCritic(**shared, normalize_obs=own.normalize_obs)}


def _apart(declaration: Declaration) -> list[Stage]:
    """The skills that are to be trained, each apart, then the selector if it is not ready."""
    reflexes = declaration.reflexes if declaration.reflexes_in_training else ()

    def skill_stage(skill: Skill) -> Stage:
        config, budget = skill.algorithm or declaration.algorithm, declaration.budget(skill)
        target = check_target(skill)

        def scene(policies: Policies) -> Scene:
            others = [s for s in declaration.skills if s.name in policies]
            starters = declaration.skill_set([policies[s.name] for s in others], others)
            led_by = starters if others else None
            return skill_scene(
                declaration.spec, skill, reflexes, led_by, declaration.start_calls or 0
            )

        return Stage(skill.name, "skill", config, budget, scene, target)

    def calls(policies: Policies) -> Scene:
        skills = declaration.skill_set([policies[s.name] for s in declaration.skills])
        if declaration.interrupt:
            return woven_scene(declaration.spec, skills, (), who_guides(declaration))
        return selector_scene(declaration.spec, skills, who_guides(declaration))

    first = [skill_stage(s) for s in declaration.skills if s.policy is None]
    if not isinstance(config := declaration.selector, AlgorithmConfig):
        return first
    budget = declaration.selector_steps
    target = target_of(declaration.selector_target_return, None, SELECTOR)
    nats = declaration.guide_nats
    last = Stage(SELECTOR, "selector", config, budget, calls, target, guide_nats=nats)
    if declaration.interrupt:
        how, beside = declaration.together, _critic(declaration)
        last = replace(last, beside=beside, together=how, interrupt=True)
    return [*first, last]
