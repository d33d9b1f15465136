"""A hierarchy's schedule: every skill apart, then the selector; or all together; or both.

Also the budgets of its stages: a hierarchy's total, split by its way of learning.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from skillweave._internal.paths import SELECTOR, decides, join
from skillweave.algorithms.config import PPO, AlgorithmConfig, OnPolicy, SkillCritic
from skillweave.errors import DeclarationError
from skillweave.experience.learners import Calling
from skillweave.experience.search import Starts
from skillweave.hierarchy.assembly import can_act, learning_set, policy_at
from skillweave.hierarchy.checks import check_target
from skillweave.hierarchy.fitting import active_guide
from skillweave.hierarchy.roles import Level, Roles
from skillweave.networks.config import Network
from skillweave.policies.parts import OBSERVATION
from skillweave.skills.goal_spaces import goal_part
from skillweave.skills.skill_set import SkillSet
from skillweave.spaces import obs_codec
from skillweave.training.learning_task import LearningTask, skill_task
from skillweave.training.role import Role
from skillweave.training.stage import TOGETHER, Policies, Stage, Together, target_of

DEFAULT_STEPS = 1_000_000
"""Training steps of a hierarchy that sets none."""
SELECTOR_SHARES = 2
"""Shares of the steps that a selector takes apart, where a skill takes one."""


def budgets_of(roles: Roles) -> dict[str, int]:
    """Return the training steps of each stage, by its path, in the order of training."""
    totals = {"": roles.outermost.steps or DEFAULT_STEPS}
    budgets: dict[str, int] = {}
    for path, level in roles.levels.items():
        if path in totals and roles.learns_apart(level):
            share = _share(roles, level, totals[path])
            for inner in level.skills:
                if inner in roles.levels:
                    part = round(share * _shares(roles, inner))
                    totals[inner] = roles.levels[inner].steps or part or DEFAULT_STEPS
    for level in roles.trained:
        budgets |= _level_budgets(roles, level, totals[level.path])
    return budgets


def _share(roles: Roles, level: Level, total: int) -> float:
    """Return the training steps of a skill that learns apart and sets none, of a level's total."""
    apart = total // 2 if roles.learns_together(level) else total
    return apart / max(1, _shares(roles, level.path))


def _shares(roles: Roles, level: str) -> int:
    """Return the shares of all in a level: one for each skill that learns, two for a selector."""
    learners = [role for role in roles.below(level) if role.config is not None]
    return sum(SELECTOR_SHARES if role.kind == "selector" else 1 for role in learners)


def _level_budgets(roles: Roles, level: Level, total: int) -> dict[str, int]:
    """Return the training steps of the stages of one level.

    Args:
        total: its training steps in all, those of levels below included.
    """
    budgets: dict[str, int] = {}
    if roles.learns_apart(level):
        share = _share(roles, level, total)
        for path, skill in level.skills.items():
            if roles[path].config is not None:
                budgets[path] = skill.steps or level.apart.skill_steps or max(1, round(share))
        if roles[level.selector_path].config is not None:
            part = round(SELECTOR_SHARES * share)
            budgets[level.selector_path] = level.apart.selector_steps or max(1, part)
    if roles.learns_together(level):
        part = total - total // 2 if roles.learns_apart(level) else total
        budgets[join(level.path, TOGETHER)] = level.together.steps or part
    return budgets


def splits_total(roles: Roles) -> bool:
    """Return True if a stage takes its steps from the hierarchy's total, or none is trained.

    Else every stage has steps of its own, and the total means nothing.
    """
    return _takes_total(roles, roles.outermost) or not budgets_of(roles)


def _takes_total(roles: Roles, level: Level) -> bool:
    """Return True if a stage of a level, or of levels below it, takes steps from its total."""
    if roles.learns_together(level) and level.together.steps is None:
        return True
    if not roles.learns_apart(level):
        return False
    if roles[level.selector_path].config is not None and level.apart.selector_steps is None:
        return True
    for path, skill in level.skills.items():
        if path in roles.levels:
            inner = roles.levels[path]
            if inner.steps is None and _takes_total(roles, inner):
                return True
        elif roles[path].config is not None and (skill.steps or level.apart.skill_steps) is None:
            return True
    return False


def stages_of(roles: Roles) -> list[Stage]:
    """Return all stages in their order: hierarchies below, skills, selector, all together."""
    budgets = budgets_of(roles)
    return [stage for level in roles.trained for stage in level_stages(roles, level, budgets)]


def level_stages(roles: Roles, level: Level, budgets: Mapping[str, int]) -> list[Stage]:
    """Return the stages of a level, without those of levels below.

    Args:
        budgets: training steps by stage.
    """
    apart = _apart(roles, level, budgets) if roles.learns_apart(level) else []
    if not roles.learns_together(level):
        return apart
    together = _together(roles, level, budgets[join(level.path, TOGETHER)])
    # The episodes of a hierarchy that cannot play alone cannot be evaluated.
    if level.as_skill is None or (level.as_skill.goal_space is None and _plays_alone(roles, level)):
        left_open = any(open_choices(roles, level))
        together = replace(together, compared=bool(apart), greedy_judged=left_open)
    return [*apart, together]


def open_choices(roles: Roles, level: Level) -> tuple[bool, bool]:
    """Return two flags: skills, and trained selectors, are undeclared as greedy or sampling."""
    levels = roles.levels_from(level.path)
    trained = any(x.ready_selector is None for x in levels)
    return (
        any(x.selection.greedy_skills is None for x in levels),
        trained and any(x.selection.greedy_selector is None for x in levels),
    )


def _together(roles: Roles, level: Level, budget: int) -> Stage:
    """Return the stage in which skills and selectors of a level learn from the same steps."""
    settings = level.together

    def learning_task(policies: Policies) -> LearningTask:
        return _calling_task(roles, level, learning_set(roles, level, policies))

    ready = level.ready_selector is not None
    config = level.algorithm if ready else _with_epsilon(level.selector, settings)
    beside = _beside_selector(roles, level)
    task_weights = _task_weights(roles, level)
    follows_task = any(
        task_weights.get(path, settings.task_weight)
        for path, algorithm in beside.items()
        if isinstance(algorithm, OnPolicy) and not decides(path)
    )
    if settings.interrupt or follows_task:
        beside[level.critic_path] = _critic(config, roles[level.critic_path], settings.interrupt)
    return Stage(
        join(level.path, TOGETHER),
        "together",
        config,
        budget,
        learning_task,
        target=target_of(level.selection.target_return, None, TOGETHER),
        beside=beside,
        together=settings,
        task_weights=task_weights,
        ready=ready,
        guide_kl=roles[level.selector_path].guide_kl,
        level=level.path,
    )


def _calling_task(
    roles: Roles, level: Level, skills: SkillSet, *, together: bool = True
) -> LearningTask:
    """Return the task in which the selector of a level calls ``skills``, and learns.

    Args:
        together: others learn beside it, from the same steps.
    """
    below = {role.path: role for role in roles.below(level.path)} if together else None
    who = Calling(skills, active_guide(roles, level), level.as_skill)
    return LearningTask(roles[level.selector_path], who, below)


def _plays_alone(roles: Roles, level: Level) -> bool:
    """Return True if a level can play whole episodes: one of its skills may start everywhere."""
    return any(
        not any(skill.defines("initiation") for skill in roles.skills_to(role.path, level.path))
        for role in roles.below(level.path)
        if role.kind == "skill" and role.path not in roles.levels
    )


def _beside_selector(roles: Roles, level: Level) -> dict[str, AlgorithmConfig]:
    """Return the algorithms of all who learn beside the selector of a level, without its critic."""
    settings = level.together
    configs: dict[str, AlgorithmConfig] = {}
    for role in roles.below(level.path):
        if role.path in (level.selector_path, level.critic_path):
            continue
        if role.kind == "critic" and role.margin is not None:
            inner = roles.levels[role.level]
            decider = configs.get(inner.selector_path, inner.algorithm)
            configs[role.path] = _critic(decider, role, deciding=True)
        elif role.config is not None:
            selects = role.kind == "selector"
            configs[role.path] = _with_epsilon(role.config, settings) if selects else role.config
    return configs


def _task_weights(roles: Roles, level: Level) -> dict[str, float]:
    """Return the task's weight of skills that set one, or are in a hierarchy that does, by path."""
    weights: dict[str, float] = {}
    for role in roles.below(level.path):
        if role.kind == "skill" and role.config is not None:
            way = reversed(roles.skills_to(role.path, level.path))
            weight = next((s.task_weight for s in way if s.task_weight is not None), None)
            if weight is not None:
                weights[role.path] = weight
    return weights


def _with_epsilon(config: Any, settings: Together) -> Any:
    """Return a selector's settings; if they lack epsilon, with that of ``together``."""
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


def _critic(selector: Any, role: Role, deciding: bool) -> SkillCritic:
    """Return the critic of skills; it observes and discounts like ``selector``'s settings.

    Beside what the selector sees, it sees the goals of the skills that have some.
    """
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
    sees_goals = bool(role.observed_goals)
    if sees_goals and (network := shared.get("network")) is not None and network.sees is not None:
        whole = obs_codec(role.observation_space).size
        goals = range(whole - obs_codec(goal_part(role.observation_space)).size, whole)
        seen = (f"{OBSERVATION}.{x}" if isinstance(x, str) else x for x in network.sees)
        shared["network"] = replace(network, sees=(*seen, *goals))
    how: Any = {"normalize_obs": selector.normalize_obs, "deciding": deciding}
    return SkillCritic(**shared, **how, sees_goals=sees_goals)


def _apart(roles: Roles, level: Level, budgets: Mapping[str, int]) -> list[Stage]:
    """Return the stages of skills that train, each apart, then of the selector if it does."""
    stages = [
        _skill_stage(roles, level, path, budgets[path])
        for path in level.skills
        if roles[path].config is not None
    ]
    if (config := roles[level.selector_path].config) is None:
        return stages
    return [*stages, _selector_stage(roles, level, config, budgets[level.selector_path])]


def _skill_stage(roles: Roles, level: Level, path: str, budget: int) -> Stage:
    """Return the stage in which one skill of a level trains."""
    role = roles[path]
    apart = level.apart
    calls = level.apart.start_calls
    assert role.config is not None

    def learning_task(policies: Policies) -> LearningTask:
        """Return the task of one skill, whose start may be searched by other skills."""
        others = {
            p: policy_at(roles, policies, p) for p in level.skills if can_act(roles, p, policies)
        }
        starts = Starts(
            level.skill_set(others) if others else None,
            0 if isinstance(calls, tuple) else calls or 0,
            apart.search_steps,
            apart.episode_calls,
            calls if isinstance(calls, tuple) else (),
        )
        return skill_task(role, level.reflexes, starts)

    target = check_target(level.skills[path])
    return Stage(path, "skill", role.config, budget, learning_task, target, level=level.path)


def _selector_stage(roles: Roles, level: Level, config: AlgorithmConfig, budget: int) -> Stage:
    """Return the stage in which the selector of a level trains over ready skills."""
    role = roles[level.selector_path]
    interrupts = level.together.interrupt

    def learning_task(policies: Policies) -> LearningTask:
        skills = level.skill_set({p: policy_at(roles, policies, p) for p in level.skills})
        return _calling_task(roles, level, skills, together=interrupts)

    return Stage(
        role.path,
        "selector",
        config,
        budget,
        learning_task,
        target_of(level.selection.target_return, None, SELECTOR),
        beside={level.critic_path: _critic(config, roles[level.critic_path], deciding=True)}
        if interrupts
        else {},
        together=level.together if interrupts else None,
        guide_kl=role.guide_kl,
        level=level.path,
    )
