"""The base of ready selectors, which choose skills without training."""

from __future__ import annotations

import copy
from typing import Any, Self

import numpy as np

from skillweave.collecting.guide import LastCall
from skillweave.errors import DeclarationError, SkillweaveError
from skillweave.messages import short, shortened
from skillweave.skills.foreign_policy import Foreign
from skillweave.types import Array, Memory, Step


class ReadySelector(Foreign):
    """A selector that is not trained: a policy over skills that also observes the ends of calls.

    It is called only where a call is over. It respects the skills' initiation sets, which are its
    mask. Its whole state is its memory, with a row for each environment.
    """

    lengths: tuple[int, ...] = ()
    """The lengths of calls that it chooses with skills; empty: it chooses skills alone."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.skills: tuple[str, ...] = ()

    @property
    def ranges(self) -> dict[str, range]:
        """Return the valid range of each index in its memory, by name."""
        return {}

    def among(self, skills: tuple[str, ...]) -> Self:
        """Return a copy that chooses among the skills of these names, in the hierarchy's order.

        Raises:
            DeclarationError: it names another skill.
        """
        selector = copy.copy(self)
        selector.skills = skills
        return selector

    def chances(self, memory: Memory, obs: Array, mask: Array | None) -> tuple[Array, Memory]:
        """Return the probability of each choice where a call is over, (n, choices) float32.

        Returns:
            The probabilities, and the memory after the choice.
        """
        choice, after = self.act(memory, obs, mask)
        choices = len(self.skills) * max(1, len(self.lengths))
        return np.eye(choices, dtype=np.float32)[choice], after

    def allowed(self, memory: Memory) -> Array | None:
        """Return the skills that it may choose next, (n, S) bool; None: depends on observations."""
        return None

    def watch(self, memory: Memory, step: Step, last: LastCall) -> Memory:
        """Return the memory after a step of n environments; called after every step.

        Args:
            step: the environments' transition; ``elapsed`` counts as for any policy.
            last: the last calls; ``why`` is 0 (``CallEnd.RUNNING``) where the call continues.
        """
        return memory

    def _number(
        self, skill: Any, where: str, kind: type[SkillweaveError] = DeclarationError
    ) -> int:
        """Return the place of a skill in the hierarchy's list.

        Raises:
            DeclarationError: no skill has this name; the message begins with ``where``. ``kind`` is
                the type of the error.
        """
        if not isinstance(skill, str) or skill not in self.skills:
            raise kind(
                f"{where} names {short(skill)}, which is no skill of the hierarchy; its skills "
                f"are: {listed(self.skills)}"
            )
        return self.skills.index(skill)


def listed(names: tuple[str, ...]) -> str:
    """Join names to a part of a sentence."""
    return shortened(", ".join(names), 300)


def shown_obs(obs: Array) -> str:
    """Format an observation for a message."""
    return shortened(np.array2string(obs, precision=3, threshold=20), 300)


def function_name(function: Any) -> str:
    """Return a user function's name for messages and checksums."""
    return str(getattr(function, "__name__", type(function).__name__))
