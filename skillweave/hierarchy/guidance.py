"""Ready selectors of a hierarchy, which decide alone or guide a selector that learns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym

from skillweave.algorithms.config import PPO
from skillweave.collecting.guide import ActiveGuide
from skillweave.collecting.lengths import Lengths
from skillweave.errors import DeclarationError, RunError
from skillweave.selectors import Automaton, ReadySelector, ready_selector
from skillweave.skills.foreign_policy import fitted, source_of
from skillweave.training.stage import SELECTOR

if TYPE_CHECKING:
    from skillweave.hierarchy.declaration import Declaration


def check_selection(declared: Declaration) -> None:
    """Raise a DeclarationError where selector, guide and way of learning do not fit together."""
    if declared.ready_selector is None:
        if declared.guide is not None:
            _check_guide(declared)
        return
    refused = {
        "selection.target_return is given": declared.selection.target_return is not None,
        "together.interrupt is True": declared.together.interrupt,
        "call_steps are Lengths": isinstance(declared.call_steps, Lengths),
        "a guide is given": declared.guide is not None,
    }
    for setting, is_set in refused.items():
        if is_set:
            raise DeclarationError(f"{setting}, but the selector is ready: it does not learn")


def _check_guide(declared: Declaration) -> None:
    """Raise a DeclarationError where a guide could not guide."""
    guide = declared.guide
    assert guide is not None
    ready_guide(declared)  # raises if one of its skills does not exist
    if guide.target_kl is not None and not isinstance(declared.selector, PPO):
        raise DeclarationError(
            f"the guide's target_kl is {guide.target_kl:g}, but the selector learns by "
            f"{type(declared.selector).__name__}: only PPO can be kept near a guide"
        )
    if not guide.restrict or isinstance(guide.selector, Automaton):
        pass
    elif not isinstance(declared.call_steps, Lengths):
        raise DeclarationError(
            "the guide names one skill at each decision, so a selector that it restricts has "
            "nothing to choose: write Guide(..., restrict=False, target_kl=0.1), or let the "
            "selector choose lengths, or give an Automaton whose states have several skills"
        )
    elif not isinstance(declared.selector, PPO):
        raise DeclarationError(
            f"a selector that learns by {type(declared.selector).__name__} needs the "
            "skills allowed next, which a function or a tree returns only at decisions: give an "
            "Automaton, or use PPO"
        )
    if guide.restrict and declared.together.interrupt:
        raise DeclarationError(
            "together.interrupt is True, but the guide restricts which skill may be called "
            "instead: give one of them"
        )


def ready_guide(declared: Declaration) -> ReadySelector | None:
    """Return the guide for the skills of the hierarchy; None: no guide is declared."""
    if declared.guide is None:
        return None
    return ready_selector(declared.guide.selector, tuple(s.name for s in declared.skills))


def fitted_guide(
    declared: Declaration, observation_space: gym.Space[Any], path: str = ""
) -> ActiveGuide | None:
    """Return the guide of a selector that learns, on these observations; None: it has none.

    Args:
        path: of the hierarchy, ``inner/`` for example.

    Raises:
        SkillError: the guide fails on these observations.
    """
    if (guide := ready_guide(declared)) is None:
        return None
    choices = gym.spaces.Discrete(len(declared.skills))
    selector = fitted(guide, observation_space, choices, f"{path}guide", declared.spec.name)
    assert declared.guide is not None
    tells = declared.guide.target_kl is not None
    return ActiveGuide(cast(ReadySelector, selector), declared.guide.restrict, tells)


def restricting_guide(
    declared: Declaration, observation_space: gym.Space[Any], path: str = ""
) -> ActiveGuide | None:
    """Return the guide that restricts a selector after its training; None: it has none."""
    guide = fitted_guide(declared, observation_space, path)
    return replace(guide, tells=False) if guide is not None and guide.restricts else None


def learning_guide(declared: Declaration) -> ActiveGuide | None:
    """Return the guide of a selector that learns; None: it has none."""
    if declared.guide is None:
        return None
    return fitted_guide(declared, declared.spec.spaces.observation)


def active_guide(declared: Declaration) -> ActiveGuide | None:
    """Return the selector that guides the learning one or decides in its place; None: no guide."""
    if declared.ready_selector is None:
        return learning_guide(declared)
    ready = declared.ready_selectors()[SELECTOR]
    return ActiveGuide(cast(ReadySelector, ready), decides=True)


def guide_entry(declared: Declaration) -> dict[str, Any]:
    """Return the entry of a run for the guide of a trained selector; {} without a guide."""
    if declared.guide is None or (guide := ready_guide(declared)) is None:
        return {}
    return {
        "guide": source_of(guide),
        "guide_restrict": declared.guide.restrict,
        "guide_kl": declared.guide.target_kl,
    }


def adopt_guide(declared: Declaration, entry: Mapping[str, Any], where: str) -> None:
    """Apply the settings of the guide that a run records; ``entry`` is its ``guide_entry``.

    Raises:
        RunError: only one of the run and the hierarchy has a guide.
    """
    check_guided(declared.guide is not None, "guide" in entry, where)
    if declared.guide is not None:
        declared.guide = replace(
            declared.guide, restrict=entry["guide_restrict"], target_kl=entry["guide_kl"]
        )


def check_guided(is_guided: bool, recorded: bool, where: str) -> None:
    """Raise a RunError where only one of two selectors has a guide."""
    if is_guided != recorded:
        has = ("no guide", "a guide")
        raise RunError(
            f"{where}: the selector has {has[recorded]}, but the selector of this hierarchy has "
            f"{has[is_guided]}: declare guide= as it was, or train again"
        )
