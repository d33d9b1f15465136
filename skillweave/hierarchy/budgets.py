"""Training steps of each stage: a hierarchy's total, split by its way of learning."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.hierarchy.nesting import inner_hierarchies
from skillweave.training.stage import SELECTOR, TOGETHER

if TYPE_CHECKING:
    from skillweave.hierarchy.declaration import Declaration

DEFAULT_STEPS = 1_000_000
"""Training steps of a hierarchy that sets none."""
SELECTOR_SHARES = 2
"""Shares of the steps that a selector takes apart, where a skill takes one."""


def budgets_of(declared: Declaration, total: int | None = None) -> dict[str, int]:
    """Return the training steps of each stage, by its path, in the order of training.

    Args:
        total: the part of an outer hierarchy's steps for this one; None: it is the outermost.
    """
    total = declared.steps or total or DEFAULT_STEPS
    budgets: dict[str, int] = {}
    if declared.learns_apart:
        apart = total // 2 if declared.learns_together else total
        share = apart / max(1, _shares(declared))
        for skill, inner in inner_hierarchies(declared.skills):
            part = round(share * _shares(inner))
            budgets |= {f"{skill.name}/{k}": v for k, v in budgets_of(inner, part).items()}
        for skill in declared.skills:
            if skill.policy is None:
                budgets[skill.name] = (
                    skill.steps or declared.apart.skill_steps or max(1, round(share))
                )
        if isinstance(declared.selector, AlgorithmConfig):
            part = round(SELECTOR_SHARES * share)
            budgets[SELECTOR] = declared.apart.selector_steps or max(1, part)
    if declared.learns_together:
        part = total - total // 2 if declared.learns_apart else total
        budgets[TOGETHER] = declared.together.steps or part
    return budgets


def _shares(declared: Declaration) -> int:
    """Return a hierarchy's shares: one for each skill that learns, two for a selector."""
    skills = sum(s.policy is None for s in declared.skills)
    below = sum(_shares(inner) for _, inner in inner_hierarchies(declared.skills))
    selector = SELECTOR_SHARES * isinstance(declared.selector, AlgorithmConfig)
    return skills + below + selector


def scale_budgets(declared: Declaration, factor: float, *, inner: bool = False) -> None:
    """Multiply all training steps of a hierarchy by ``factor``, in place.

    Args:
        inner: True for a skill of another hierarchy; without its own total it shares the outer one.
    """

    def scaled(steps: int | None) -> int | None:
        return None if steps is None else max(1, round(steps * factor))

    for skill in declared.skills:
        if skill.policy is None:
            skill.steps = scaled(skill.steps)
    for _, below in inner_hierarchies(declared.skills):
        scale_budgets(below, factor, inner=True)
    declared.steps = scaled(declared.steps or (None if inner else DEFAULT_STEPS))
    apart, together = declared.apart, declared.together
    declared.apart = replace(
        apart,
        skill_steps=scaled(apart.skill_steps),
        selector_steps=scaled(apart.selector_steps),
    )
    declared.together = replace(together, steps=scaled(together.steps))
