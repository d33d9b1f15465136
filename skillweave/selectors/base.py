"""What every ready selector is, and what it is told of the last call."""

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
    """A selector that is not trained: a policy over skills that also sees how calls end.

    It is asked only where a call is over. It keeps to the skills' initiation sets itself, as its
    mask tells them. All that it remembers is in its memory, with a row for each environment.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.skills: tuple[str, ...] = ()

    @property
    def ranges(self) -> dict[str, range]:
        """What numbers in its memory may be, of those that choose among something, by name."""
        return {}

    def among(self, skills: tuple[str, ...]) -> Self:
        """Return a copy that chooses among the skills of these names, in the hierarchy's order.

        Raises:
            DeclarationError: it names a skill that is none of them.
        """
        found = copy.copy(self)
        found.skills = skills
        return found

    def chances(self, memory: Memory, obs: Array, mask: Array | None) -> tuple[Array, Memory]:
        """How likely it is to choose each skill where a call is over, (n, S) float32.

        Returns:
            that, and the memory after it was asked.
        """
        skill, after = self.act(memory, obs, mask)
        return np.eye(len(self.skills), dtype=np.float32)[skill], after

    def allowed(self, memory: Memory) -> Array | None:
        """(n, S) bool, the skills that it may choose next; None: that depends on what it sees."""
        return None

    def watch(self, memory: Memory, step: Step, last: LastCall) -> Memory:
        """Return the memory after a step of n environments; called after every step.

        Args:
            step: as the environments answered; its ``elapsed`` counts as for any policy.
            last: ``why`` is 0 (``CallEnd.RUNNING``) where the call goes on.
        """
        return memory

    def _number(
        self, skill: Any, where: str, kind: type[SkillweaveError] = DeclarationError
    ) -> int:
        """Return the place of a skill in the hierarchy's list.

        Raises:
            DeclarationError: there is no skill of this name; the message begins with ``where``. It
                is of another ``kind`` where that is given.
        """
        if not isinstance(skill, str) or skill not in self.skills:
            raise kind(
                f"{where} names {short(skill)}, which is no skill of the hierarchy; there are: "
                f"{listed(self.skills)}"
            )
        return self.skills.index(skill)


def listed(names: tuple[str, ...]) -> str:
    """Names as one part of a sentence."""
    return shortened(", ".join(names), 300)


def shown_obs(obs: Array) -> str:
    """One observation in a message."""
    return shortened(np.array2string(obs, precision=3, threshold=20), 300)


def function_name(function: Any) -> str:
    """What a function of the user is called in messages and checksums."""
    return str(getattr(function, "__name__", type(function).__name__))
