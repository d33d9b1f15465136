"""A hierarchy's schedule: every skill apart, then the selector; or all together; or both."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from skillweave.algorithms.config import PPO, AlgorithmConfig, SkillCritic
from skillweave.hierarchy.assembly import can_act, learning_set, policy_of
from skillweave.hierarchy.checks import check_target
from skillweave.hierarchy.declaration import TOGETHER, Declaration
from skillweave.hierarchy.guidance import who_guides
from skillweave.hierarchy.nesting import every_hierarchy, inner_hierarchies, inner_of
from skillweave.skills import Skill
from skillweave.training.scene import (
    Scene,
    WovenScene,
    selector_scene,
    skill_scene,
    woven_scene,
)
from skillweave.training.stage import CRITIC, SELECTOR, Policies, Stage, Together, target_of
from skillweave.types import SkillweaveError


def stages_of(declaration: Declaration, seen_as: Skill | None = None) -> list[Stage]:
    """Who learns when: all in hierarchies below, skills apart, then the selector; then together.

    Args:
        seen_as: the skill that the hierarchy is, of another one; None: it is none.
    """
    found = []
    if declaration.learns_apart:
        for skill, inner in inner_hierarchies(declaration.skills):
            found += [stage.inside(skill.name) for stage in stages_of(inner, skill)]
    return found + own_stages(declaration, seen_as)


def own_stages(declaration: Declaration, seen_as: Skill | None = None) -> list[Stage]:
    """The same without those of hierarchies below."""
    apart = _apart(declaration, seen_as) if declaration.learns_apart else []
    if not declaration.weaves:
        return apart
    together = _together(declaration, seen_as)
    if seen_as is None or _plays_alone(declaration):  # else no episode can tell
        left = any(own.greedy_skills is None for _, own in every_hierarchy(declaration))
        together = replace(together, compared=bool(apart), greedy_judged=left)
    return [*apart, together]


def _together(declaration: Declaration, seen_as: Skill | None) -> Stage:
    """The stage in which skills and selectors learn from the same steps."""
    how = declaration.together

    def scene(policies: Policies) -> WovenScene:
        skills, guide = learning_set(declaration, policies), who_guides(declaration)
        margins, nats = _margins(declaration), _nats(declaration)
        return woven_scene(declaration.spec, skills, guide, seen_as, margins, nats)

    ready = declaration.ready_selector is not None
    config = declaration.algorithm if ready else _with_floor(declaration.selector, how)
    beside = _learners(declaration, how)
    if how.task_weight or declaration.interrupt:
        beside |= _critic(config, declaration.interrupt)
    target = target_of(declaration.selector_target_return, None, TOGETHER)
    return Stage(
        TOGETHER,
        "together",
        config,
        declaration.together_steps,
        scene,
        target,
        beside,
        how,
        declaration.interrupt,
        ready,
        declaration.guide_nats,
    )


def _plays_alone(declaration: Declaration) -> bool:
    """Whether a hierarchy can play whole episodes by itself: some skill may start everywhere."""
    for skill in declaration.skills:
        inner = inner_of(skill)
        if not skill.defines("initiation") and (inner is None or _plays_alone(inner)):
            return True
    return False


def _learners(declaration: Declaration, how: Together) -> dict[str, AlgorithmConfig]:
    """By path, who learns below the selector, but for the critic of its skills."""
    found: dict[str, AlgorithmConfig] = {}
    for skill in declaration.skills:
        if skill.policy is None:
            found[skill.name] = skill.algorithm or declaration.algorithm
        if (inner := inner_of(skill)) is None:
            continue
        own = _learners(inner, how)
        selects: Any = inner.algorithm
        if isinstance(inner.selector, AlgorithmConfig):
            own[SELECTOR] = selects = _with_floor(inner.selector, how)
        own |= _critic(selects, deciding=True) if inner.interrupt else {}
        found |= {f"{skill.name}/{name}": config for name, config in own.items()}
    return found


def _margins(declaration: Declaration) -> dict[str, float]:
    """By the paths of critics in hierarchies below, where calls are cut there."""
    found: dict[str, float] = {}
    for skill, inner in inner_hierarchies(declaration.skills):
        own = ({CRITIC: inner.together.margin} if inner.interrupt else {}) | _margins(inner)
        found |= {f"{skill.name}/{name}": margin for name, margin in own.items()}
    return found


def _nats(declaration: Declaration) -> dict[str, float]:
    """By the paths of selectors in hierarchies below, how far they may be from their guides."""
    found: dict[str, float] = {}
    for skill, inner in inner_hierarchies(declaration.skills):
        own = _nats(inner)
        if inner.guide_nats is not None:
            own[SELECTOR] = inner.guide_nats
        found |= {f"{skill.name}/{name}": nats for name, nats in own.items()}
    return found


def _with_floor(config: Any, how: Together) -> Any:
    """A selector's settings, with the floor of learning together where it names none."""
    if not isinstance(config, PPO) or config.floor:
        return config
    usual, falls = PPO(), ("floor_final", "floor_fraction")
    for name in falls:
        if getattr(config, name) != getattr(usual, name):
            raise SkillweaveError(
                f"selector.{name} is {getattr(config, name)}, but it has no floor of its own, and "
                f"one that learns together has that of Together: set together.{name}, or "
                "selector.floor, too"
            )
    return replace(config, **{name: getattr(how, name) for name in ("floor", *falls)})


def _critic(own: Any, deciding: bool) -> dict[str, AlgorithmConfig]:
    """The critic of skills; it sees and discounts as a selector with the settings ``own`` does."""
    shared = {f: getattr(own, f) for f in ("gamma", "learning_rate", "num_envs", "device")}
    if isinstance(own, PPO):
        same = (
            "n_steps", "gae_lambda", "network", "overlap", "floor", "floor_final",
            "floor_fraction", "min_advantage_std",
        )  # fmt: skip
        shared |= {f: getattr(own, f) for f in same}
    if "network" in shared:  # the critic remembers nothing
        shared["network"] = replace(shared["network"], rnn=None)
    return {CRITIC: SkillCritic(**shared, normalize_obs=own.normalize_obs, deciding=deciding)}


def _apart(declaration: Declaration, seen_as: Skill | None) -> list[Stage]:
    """The skills that are to be trained, each apart, then the selector if it is not ready."""
    reflexes = declaration.reflexes if declaration.reflexes_in_training else ()

    def skill_stage(skill: Skill) -> Stage:
        config, budget = skill.algorithm or declaration.algorithm, declaration.budget(skill)
        target = check_target(skill)

        def scene(policies: Policies) -> Scene:
            others = [s for s in declaration.skills if can_act(s, policies)]
            starters = declaration.skill_set([policy_of(s, policies) for s in others], others)
            led_by = starters if others else None
            return skill_scene(
                declaration.spec,
                skill,
                reflexes,
                led_by,
                declaration.start_calls or 0,
                declaration.search_steps,
                declaration.episode_calls,
            )

        return Stage(skill.name, "skill", config, budget, scene, target)

    def calls(policies: Policies) -> Scene:
        skills = declaration.skill_set([policy_of(s, policies) for s in declaration.skills])
        guide = who_guides(declaration)
        if declaration.interrupt:
            return woven_scene(declaration.spec, skills, guide, seen_as)
        return selector_scene(declaration.spec, skills, guide, seen_as)

    first = [skill_stage(s) for s in declaration.skills if s.policy is None]
    if not isinstance(config := declaration.selector, AlgorithmConfig):
        return first
    budget = declaration.selector_steps
    target = target_of(declaration.selector_target_return, None, SELECTOR)
    nats = declaration.guide_nats
    last = Stage(SELECTOR, "selector", config, budget, calls, target, guide_nats=nats)
    if declaration.interrupt:
        how, beside = declaration.together, _critic(config, deciding=True)
        last = replace(last, beside=beside, together=how, interrupt=True)
    return [*first, last]
