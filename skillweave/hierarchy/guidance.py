"""Ready selectors of a hierarchy: one that decides, or one that guides a selector that learns."""

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
    """Raise a DeclarationError where selector, guide and how they learn do not fit together."""
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
    for what, asked in refused.items():
        if asked:
            raise DeclarationError(f"{what}, but the selector is ready: it does not learn")


def _check_guide(declared: Declaration) -> None:
    """Raise a DeclarationError where a guide could not guide."""
    guide = declared.guide
    assert guide is not None
    ready_guide(declared)  # says which of its skills does not exist
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
            f"a selector that learns by {type(declared.selector).__name__} asks what may be called "
            "next, which a function or a tree says only at decisions: give an Automaton, or PPO"
        )
    if guide.restrict and declared.together.interrupt:
        raise DeclarationError(
            "together.interrupt is True, but the guide restricts which skill may be called "
            "instead: give one of them"
        )


def ready_guide(declared: Declaration) -> ReadySelector | None:
    """The guide, among the skills of the hierarchy; None: there is none."""
    if declared.guide is None:
        return None
    return ready_selector(declared.guide.selector, tuple(s.name for s in declared.skills))


def fitted_guide(
    declared: Declaration, observation_space: gym.Space[Any], path: str = ""
) -> ActiveGuide | None:
    """The guide of a selector that learns, on these observations; None: there is none.

    Args:
        path: of the hierarchy, ``inner/`` for example.

    Raises:
        SkillError: it fails on them.
    """
    if (found := ready_guide(declared)) is None:
        return None
    choices = gym.spaces.Discrete(len(declared.skills))
    own = fitted(found, observation_space, choices, f"{path}guide", declared.spec.name)
    assert declared.guide is not None
    tells = declared.guide.target_kl is not None
    return ActiveGuide(cast(ReadySelector, own), declared.guide.restrict, tells)


def restricting_guide(
    declared: Declaration, observation_space: gym.Space[Any], path: str = ""
) -> ActiveGuide | None:
    """The guide that a selector keeps to after it has learnt; None: there is none."""
    guide = fitted_guide(declared, observation_space, path)
    return replace(guide, tells=False) if guide is not None and guide.restricts else None


def own_guide(declared: Declaration) -> ActiveGuide | None:
    """The guide of a selector that learns; None: there is none."""
    if declared.guide is None:
        return None
    return fitted_guide(declared, declared.spec.spaces.observation)


def who_guides(declared: Declaration) -> ActiveGuide | None:
    """Who is asked while the selector learns, or instead of it; None: nobody."""
    if declared.ready_selector is None:
        return own_guide(declared)
    ready = declared.ready_selectors()[SELECTOR]
    return ActiveGuide(cast(ReadySelector, ready), decides=True)


def guide_entry(declared: Declaration) -> dict[str, Any]:
    """What a run says of the guide of a trained selector; nothing where there is none."""
    if declared.guide is None or (guide := ready_guide(declared)) is None:
        return {}
    return {
        "guide": source_of(guide),
        "guide_restrict": declared.guide.restrict,
        "guide_kl": declared.guide.target_kl,
    }


def adopt_guide(declared: Declaration, told: Mapping[str, Any], where: str) -> None:
    """Take over from a run how a selector keeps to its guide; ``told`` is its ``guide_entry``.

    Raises:
        RunError: of the run and the hierarchy one has a guide, and the other has none.
    """
    check_guided(declared.guide is not None, "guide" in told, where)
    if declared.guide is not None:
        declared.guide = replace(
            declared.guide, restrict=told["guide_restrict"], target_kl=told["guide_kl"]
        )


def check_guided(mine: bool, theirs: bool, where: str) -> None:
    """Raise a RunError where of two selectors one has a guide and the other has none."""
    if mine != theirs:
        has = ("no guide", "a guide")
        raise RunError(
            f"{where}: the selector has {has[theirs]}, but that of this hierarchy has {has[mine]}: "
            "declare guide= as it was, or train anew"
        )
