"""A hierarchy's schedule: every skill apart, then the selector; or all together; or both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from skillweave.algorithms.config import PPO, AlgorithmConfig, OnPolicy, SkillCritic
from skillweave.errors import DeclarationError
from skillweave.hierarchy.assembly import can_act, learning_set, policy_of
from skillweave.hierarchy.checks import check_target
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.guidance import who_guides
from skillweave.hierarchy.nesting import below, every_hierarchy, inner_hierarchies, inner_of
from skillweave.networks.config import Network
from skillweave.skills import Skill
from skillweave.training.scene import (
    Scene,
    WovenScene,
    selector_scene,
    skill_scene,
    woven_scene,
)
from skillweave.training.stage import (
    CRITIC,
    SELECTOR,
    TOGETHER,
    Policies,
    Stage,
    Together,
    decides,
    target_of,
)


def stages_of(
    declaration: Declaration,
    as_skill: Skill | None = None,
    budgets: Mapping[str, int] | None = None,
) -> list[Stage]:
    """Return all stages in their order: hierarchies below, skills, selector, all together.

    Args:
        as_skill: the skill that the hierarchy is, of another one; None: it is the outermost.
        budgets: training steps by stage; None: the hierarchy's own.
    """
    budgets = declaration.budgets() if budgets is None else budgets
    found = []
    if declaration.learns_apart:
        for skill, inner in inner_hierarchies(declaration.skills):
            stages = stages_of(inner, skill, below(budgets, skill.name))
            found += [stage.inside(skill.name) for stage in stages]
    return found + own_stages(declaration, as_skill, budgets)


def own_stages(
    declaration: Declaration,
    as_skill: Skill | None = None,
    budgets: Mapping[str, int] | None = None,
) -> list[Stage]:
    """Return the stages of a hierarchy without those of hierarchies below."""
    budgets = declaration.budgets() if budgets is None else budgets
    apart = _apart(declaration, as_skill, budgets) if declaration.learns_apart else []
    if not declaration.learns_together:
        return apart
    together = _together(declaration, as_skill, budgets[TOGETHER])
    if as_skill is None or _plays_alone(declaration):  # else its episodes cannot be evaluated
        left_open = any(open_choices(declaration))
        together = replace(together, compared=bool(apart), greedy_judged=left_open)
    return [*apart, together]


def open_choices(declaration: Declaration) -> tuple[bool, bool]:
    """Return whether it is open anywhere if skills are greedy, and if a trained selector is."""
    hierarchies = [own for _, own in every_hierarchy(declaration)]
    trained = any(own.ready_selector is None for own in hierarchies)
    return (
        any(own.selection.greedy_skills is None for own in hierarchies),
        trained and any(own.selection.greedy_selector is None for own in hierarchies),
    )


def _together(declaration: Declaration, as_skill: Skill | None, budget: int) -> Stage:
    """Return the stage in which skills and selectors learn from the same steps."""
    how = declaration.together

    def scene(policies: Policies) -> WovenScene:
        skills, guide = learning_set(declaration, policies), who_guides(declaration)
        margins, guide_kl = _margins(declaration), _guide_kl(declaration)
        return woven_scene(declaration.spec, skills, guide, as_skill, margins, guide_kl)

    ready = declaration.ready_selector is not None
    config = declaration.algorithm if ready else _with_epsilon(declaration.selector, how)
    beside, weights = _learners(declaration, how), _task_weights(declaration)
    follows_task = any(
        weights.get(name, how.task_weight)
        for name, own in beside.items()
        if isinstance(own, OnPolicy) and not decides(name)
    )
    if how.interrupt or follows_task:
        beside |= _critic(config, how.interrupt)
    return Stage(
        TOGETHER,
        "together",
        config,
        budget,
        scene,
        target=target_of(declaration.selection.target_return, None, TOGETHER),
        beside=beside,
        together=how,
        task_weights=weights,
        ready=ready,
        guide_kl=None if declaration.guide is None else declaration.guide.target_kl,
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
            own[SELECTOR] = selects = _with_epsilon(inner.selector, how)
        own |= _critic(selects, deciding=True) if inner.together.interrupt else {}
        found |= {f"{skill.name}/{name}": config for name, config in own.items()}
    return found


def _task_weights(declaration: Declaration, inherited: float | None = None) -> dict[str, float]:
    """Return the task's weight of skills that set one, or are in a hierarchy that does, by path."""
    found: dict[str, float] = {}
    for skill in declaration.skills:
        weight = inherited if skill.task_weight is None else skill.task_weight
        if (inner := inner_of(skill)) is not None:
            below_it = _task_weights(inner, weight)
            found |= {f"{skill.name}/{name}": value for name, value in below_it.items()}
        elif weight is not None and skill.policy is None:
            found[skill.name] = weight
    return found


def _margins(declaration: Declaration) -> dict[str, float]:
    """By the paths of critics in hierarchies below, where calls are cut there."""
    found: dict[str, float] = {}
    for skill, inner in inner_hierarchies(declaration.skills):
        how = inner.together
        own = ({CRITIC: how.margin} if how.interrupt else {}) | _margins(inner)
        found |= {f"{skill.name}/{name}": margin for name, margin in own.items()}
    return found


def _guide_kl(declaration: Declaration) -> dict[str, float]:
    """By the paths of selectors in hierarchies below, the KL within which they stay of guides."""
    found: dict[str, float] = {}
    for skill, inner in inner_hierarchies(declaration.skills):
        own = _guide_kl(inner)
        if inner.guide is not None and inner.guide.target_kl is not None:
            own[SELECTOR] = inner.guide.target_kl
        found |= {f"{skill.name}/{name}": kl for name, kl in own.items()}
    return found


def _with_epsilon(config: Any, how: Together) -> Any:
    """A selector's settings, with the epsilon of learning together where it names none."""
    if not isinstance(config, PPO) or config.epsilon:
        return config
    usual, falls = PPO(), ("epsilon_final", "epsilon_fraction")
    for name in falls:
        if getattr(config, name) != getattr(usual, name):
            raise DeclarationError(
                f"selector.{name} is {getattr(config, name)}, but selector.epsilon is 0, and "
                f"a selector that learns together then uses Together's: set together.{name}, or "
                "selector.epsilon, too"
            )
    return replace(config, **{name: getattr(how, name) for name in ("epsilon", *falls)})


def _critic(own: Any, deciding: bool) -> dict[str, AlgorithmConfig]:
    """The critic of skills; it sees and discounts as a selector with the settings ``own`` does."""
    shared = {f: getattr(own, f) for f in ("gamma", "learning_rate", "num_envs", "device")}
    if isinstance(own, PPO):
        same = (
            "n_steps", "gae_lambda", "network", "overlap", "epsilon", "epsilon_final",
            "epsilon_fraction", "min_advantage_std",
        )  # fmt: skip
        shared |= {f: getattr(own, f) for f in same}
    if "network" in shared:  # the critic remembers nothing
        shared["network"] = replace(shared["network"], rnn=None)
    elif isinstance(network := getattr(own, "network", None), Network):
        shared["network"] = Network(planes=network.planes)
    return {CRITIC: SkillCritic(**shared, normalize_obs=own.normalize_obs, deciding=deciding)}


def _apart(
    declaration: Declaration, as_skill: Skill | None, budgets: Mapping[str, int]
) -> list[Stage]:
    """Return the stages of skills that train, each apart, then of the selector if it does."""
    search = declaration.apart

    def skill_stage(skill: Skill) -> Stage:
        config, budget = skill.algorithm or declaration.algorithm, budgets[skill.name]
        target = check_target(skill)

        def scene(policies: Policies) -> Scene:
            others = [s for s in declaration.skills if can_act(s, policies)]
            starters = declaration.skill_set([policy_of(s, policies) for s in others], others)
            led_by = starters if others else None
            return skill_scene(
                declaration.spec,
                skill,
                declaration.reflexes,
                led_by,
                search.start_calls or 0,
                search.search_steps,
                search.episode_calls,
            )

        return Stage(skill.name, "skill", config, budget, scene, target)

    def calls(policies: Policies) -> Scene:
        skills = declaration.skill_set([policy_of(s, policies) for s in declaration.skills])
        guide = who_guides(declaration)
        if declaration.together.interrupt:
            return woven_scene(declaration.spec, skills, guide, as_skill)
        return selector_scene(declaration.spec, skills, guide, as_skill)

    first = [skill_stage(s) for s in declaration.skills if s.policy is None]
    if not isinstance(config := declaration.selector, AlgorithmConfig):
        return first
    last = Stage(
        SELECTOR,
        "selector",
        config,
        budgets[SELECTOR],
        calls,
        target_of(declaration.selection.target_return, None, SELECTOR),
        guide_kl=None if declaration.guide is None else declaration.guide.target_kl,
    )
    if declaration.together.interrupt:
        last = replace(last, beside=_critic(config, deciding=True), together=declaration.together)
    return [*first, last]
