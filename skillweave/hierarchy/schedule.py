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
from skillweave.hierarchy.guidance import active_guide
from skillweave.hierarchy.nesting import below, every_hierarchy, inner_hierarchies, inner_of
from skillweave.networks.config import Network
from skillweave.skills import Skill
from skillweave.training.learning_task import (
    JointTask,
    LearningTask,
    joint_task,
    selector_task,
    skill_task,
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
        as_skill: the hierarchy as a skill of another one; None: it is the outermost.
        budgets: training steps by stage; None: the hierarchy's own.
    """
    budgets = declaration.budgets() if budgets is None else budgets
    of_inner: list[Stage] = []
    if declaration.learns_apart:
        for skill, inner in inner_hierarchies(declaration.skills):
            stages = stages_of(inner, skill, below(budgets, skill.name))
            of_inner += [stage.inside(skill.name) for stage in stages]
    return of_inner + own_stages(declaration, as_skill, budgets)


def own_stages(
    declaration: Declaration,
    as_skill: Skill | None = None,
    budgets: Mapping[str, int] | None = None,
) -> list[Stage]:
    """Return the stages of a hierarchy without the stages of hierarchies below."""
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
    """Return two flags: skills, and trained selectors, are undeclared as greedy or sampling."""
    hierarchies = [hierarchy for _, hierarchy in every_hierarchy(declaration)]
    trained = any(h.ready_selector is None for h in hierarchies)
    return (
        any(h.selection.greedy_skills is None for h in hierarchies),
        trained and any(h.selection.greedy_selector is None for h in hierarchies),
    )


def _together(declaration: Declaration, as_skill: Skill | None, budget: int) -> Stage:
    """Return the stage in which skills and selectors learn from the same steps."""
    settings = declaration.together

    def learning_task(policies: Policies) -> JointTask:
        return joint_task(
            declaration.spec,
            learning_set(declaration, policies),
            active_guide(declaration),
            as_skill,
            _margins(declaration),
            _guide_kl(declaration),
        )

    ready = declaration.ready_selector is not None
    config = declaration.algorithm if ready else _with_epsilon(declaration.selector, settings)
    others = _learners(declaration, settings)
    task_weights = _task_weights(declaration)
    follows_task = any(
        task_weights.get(name, settings.task_weight)
        for name, algorithm in others.items()
        if isinstance(algorithm, OnPolicy) and not decides(name)
    )
    if settings.interrupt or follows_task:
        others |= _critic(config, settings.interrupt)
    return Stage(
        TOGETHER,
        "together",
        config,
        budget,
        learning_task,
        target=target_of(declaration.selection.target_return, None, TOGETHER),
        beside=others,
        together=settings,
        task_weights=task_weights,
        ready=ready,
        guide_kl=None if declaration.guide is None else declaration.guide.target_kl,
    )


def _plays_alone(declaration: Declaration) -> bool:
    """Return True if a hierarchy can play whole episodes: a skill may start everywhere."""
    for skill in declaration.skills:
        inner = inner_of(skill)
        if not skill.defines("initiation") and (inner is None or _plays_alone(inner)):
            return True
    return False


def _learners(declaration: Declaration, settings: Together) -> dict[str, AlgorithmConfig]:
    """Return the algorithms of all learners below the selector, by path, without its critic."""
    learners: dict[str, AlgorithmConfig] = {}
    for skill in declaration.skills:
        if skill.policy is None:
            learners[skill.name] = skill.algorithm or declaration.algorithm
        if (inner := inner_of(skill)) is None:
            continue
        inside = _learners(inner, settings)
        decider: Any = inner.algorithm
        if isinstance(inner.selector, AlgorithmConfig):
            inside[SELECTOR] = decider = _with_epsilon(inner.selector, settings)
        inside |= _critic(decider, deciding=True) if inner.together.interrupt else {}
        learners |= {f"{skill.name}/{name}": config for name, config in inside.items()}
    return learners


def _task_weights(declaration: Declaration, inherited: float | None = None) -> dict[str, float]:
    """Return the task's weight of skills that set one, or are in a hierarchy that does, by path."""
    weights: dict[str, float] = {}
    for skill in declaration.skills:
        weight = inherited if skill.task_weight is None else skill.task_weight
        if (inner := inner_of(skill)) is not None:
            below_it = _task_weights(inner, weight)
            weights |= {f"{skill.name}/{name}": value for name, value in below_it.items()}
        elif weight is not None and skill.policy is None:
            weights[skill.name] = weight
    return weights


def _margins(declaration: Declaration) -> dict[str, float]:
    """Return the margins of interruption in hierarchies below, by the paths of their critics."""
    margins: dict[str, float] = {}
    for skill, inner in inner_hierarchies(declaration.skills):
        settings = inner.together
        inside = ({CRITIC: settings.margin} if settings.interrupt else {}) | _margins(inner)
        margins |= {f"{skill.name}/{name}": margin for name, margin in inside.items()}
    return margins


def _guide_kl(declaration: Declaration) -> dict[str, float]:
    """Return the target KL of guides in hierarchies below, by the paths of their selectors."""
    targets: dict[str, float] = {}
    for skill, inner in inner_hierarchies(declaration.skills):
        inside = _guide_kl(inner)
        if inner.guide is not None and inner.guide.target_kl is not None:
            inside[SELECTOR] = inner.guide.target_kl
        targets |= {f"{skill.name}/{name}": kl for name, kl in inside.items()}
    return targets


def _with_epsilon(config: Any, settings: Together) -> Any:
    """Return a selector's settings, with the epsilon of learning together where it sets none."""
    if not isinstance(config, PPO) or config.epsilon:
        return config
    default = PPO()
    decay = ("epsilon_final", "epsilon_fraction")
    for name in decay:
        if getattr(config, name) != getattr(default, name):
            raise DeclarationError(
                f"selector.{name} is {getattr(config, name)}, but selector.epsilon is 0, and "
                f"a selector that learns together then uses Together's: set together.{name}, or "
                "selector.epsilon, too"
            )
    return replace(config, **{name: getattr(settings, name) for name in ("epsilon", *decay)})


def _critic(selector: Any, deciding: bool) -> dict[str, AlgorithmConfig]:
    """Return the critic of skills; it observes and discounts like ``selector``'s settings."""
    shared = {f: getattr(selector, f) for f in ("gamma", "learning_rate", "num_envs", "device")}
    if isinstance(selector, PPO):
        same = (
            "n_steps",
            "gae_lambda",
            "network",
            "overlap",
            "epsilon",
            "epsilon_final",
            "epsilon_fraction",
            "min_advantage_std",
        )
        shared |= {f: getattr(selector, f) for f in same}
    if "network" in shared:  # the critic has no recurrent state
        shared["network"] = replace(shared["network"], rnn=None)
    elif isinstance(network := getattr(selector, "network", None), Network):
        shared["network"] = Network(planes=network.planes)
    return {CRITIC: SkillCritic(**shared, normalize_obs=selector.normalize_obs, deciding=deciding)}


def _apart(
    declaration: Declaration, as_skill: Skill | None, budgets: Mapping[str, int]
) -> list[Stage]:
    """Return the stages of skills that train, each apart, then of the selector if it does."""
    apart = declaration.apart

    def skill_stage(skill: Skill) -> Stage:
        config = skill.algorithm or declaration.algorithm
        target = check_target(skill)

        def learning_task(policies: Policies) -> LearningTask:
            others = [s for s in declaration.skills if can_act(s, policies)]
            callable_skills = declaration.skill_set(
                [policy_of(s, policies) for s in others], others
            )
            return skill_task(
                declaration.spec,
                skill,
                declaration.reflexes,
                callable_skills if others else None,
                apart.start_calls or 0,
                apart.search_steps,
                apart.episode_calls,
            )

        return Stage(skill.name, "skill", config, budgets[skill.name], learning_task, target)

    def selector_calls(policies: Policies) -> LearningTask:
        skills = declaration.skill_set([policy_of(s, policies) for s in declaration.skills])
        guide = active_guide(declaration)
        if declaration.together.interrupt:
            return joint_task(declaration.spec, skills, guide, as_skill)
        return selector_task(declaration.spec, skills, guide, as_skill)

    skill_stages = [skill_stage(s) for s in declaration.skills if s.policy is None]
    if not isinstance(config := declaration.selector, AlgorithmConfig):
        return skill_stages
    selector = Stage(
        SELECTOR,
        "selector",
        config,
        budgets[SELECTOR],
        selector_calls,
        target_of(declaration.selection.target_return, None, SELECTOR),
        guide_kl=None if declaration.guide is None else declaration.guide.target_kl,
    )
    if declaration.together.interrupt:
        selector = replace(
            selector, beside=_critic(config, deciding=True), together=declaration.together
        )
    return [*skill_stages, selector]
