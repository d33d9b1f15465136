"""A ready selector beside a selector that learns, or in its place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from skillweave.skills.goal_spaces import number_of
from skillweave.types import Array, Memory, Step, prefixed, unprefixed

SMOOTHED = 0.05
"""Share of a guide's choice that is uniform: without it one deviation would cost infinitely much.
"""


@dataclass(frozen=True, slots=True)
class LastCall:
    """The last call of n environments, and how it ended; RUNNING where it has not."""

    skill: Array  # (n,) int64, its place in the hierarchy's list; −1: the episode has just begun
    why: Array  # (n,) int8, ``CallEnd`` it ended
    succeeded: Array  # (n,) bool: by the skill's success(), where it has none by its own end


class Ready(Protocol):
    """A ready selector as a guide uses it; its state is in the memory that it is given."""

    skills: tuple[str, ...]
    lengths: tuple[int, ...]
    """The lengths of calls that it chooses with skills; empty: it chooses skills alone."""

    @property
    def ranges(self) -> dict[str, range]:
        """The valid ranges of indices in its memory, by name."""
        ...

    def start(self, n: int) -> Memory:
        """Return the memory of n environments whose episodes start."""
        ...

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return its choices, (n,), and the memory after them."""
        ...

    def chances(self, memory: Memory, obs: Array, mask: Array | None) -> tuple[Array, Memory]:
        """Return the probability of each of its choices, (n, …), and the memory after them."""
        ...

    def allowed(self, memory: Memory) -> Array | None:
        """(n, S) bool, what it may choose next; None: that depends on what it will see."""
        ...

    def watch(self, memory: Memory, step: Step, last: LastCall) -> Memory:
        """Return the memory after a step."""
        ...


@dataclass(frozen=True)
class ActiveGuide:
    """A ready selector that is asked wherever a selector decides.

    What it remembers stands under ``guide.<key>`` in the memories that it is given, with a row for
    each environment; it is changed in place.
    """

    selector: Ready
    restricts: bool = True
    """Only what it may choose is allowed."""
    tells: bool = False
    """Record the guide's action probabilities for the KL penalty."""
    decides: bool = False
    """It makes the choices itself."""

    def start(self, n: int) -> Memory:
        """Return its memory of n environments whose episodes start."""
        return prefixed("guide", self.selector.start(n))

    def ask(
        self,
        memory: Memory,
        rows: Array,
        obs: Array,
        may: Array,
        greedy: bool = True,
        rng: np.random.Generator | None = None,
    ) -> Array:
        """Return the probability of each choice at decisions of environments ``rows`` (k,).

        Where it chooses no lengths, all lengths of a skill are equally likely.

        Args:
            obs: (k, …).
            may: (k, choices) bool, choices whose skill may start.
            greedy, rng: where it decides, how it takes one of several skills.

        Returns:
            (k, choices) float32, the sum of each row is 1.
        """
        own = {k: v[rows] for k, v in unprefixed("guide", memory).items()}
        choices = len(self.selector.skills) * max(1, len(self.selector.lengths))
        lengths = may.shape[1] // choices
        if self.decides:
            choice, after = self.selector.act(
                own, obs, may[:, ::lengths], deterministic=greedy, rng=rng
            )
            chances: Array = np.eye(choices, dtype=np.float32)[number_of(choice)]
        else:
            chances, after = self.selector.chances(own, obs, may[:, ::lengths])
        for k, v in after.items():
            memory[f"guide.{k}"][rows] = v
        return chances.repeat(lengths, axis=1) / np.float32(lengths)

    def choose(
        self,
        memory: Memory,
        rows: Array,
        obs: Array,
        may: Array,
        greedy: bool = True,
        rng: np.random.Generator | None = None,
    ) -> Array:
        """Return its choices (k,) with their goals, where it decides; see ``ask``."""
        own = {k: v[rows] for k, v in unprefixed("guide", memory).items()}
        choice, after = self.selector.act(own, obs, may, deterministic=greedy, rng=rng)
        for k, v in after.items():
            memory[f"guide.{k}"][rows] = v
        return choice

    def ahead(self, memory: Memory, rows: Array, may: Array) -> Array:
        """Return the choices that it leaves, (k, choices) bool, in environments ``rows`` (k,).

        Nothing is asked of it, and nothing changes.
        """
        own = {k: v[rows] for k, v in unprefixed("guide", memory).items()}
        allowed = self.selector.allowed(own) if self.restricts else None
        if allowed is None:
            return may
        return may & allowed.repeat(may.shape[1] // allowed.shape[1], axis=1)

    def watch(self, memory: Memory, rows: Array, step: Step, last: LastCall) -> None:
        """Show it a step of environments ``rows`` (k,)."""
        own = {k: v[rows] for k, v in unprefixed("guide", memory).items()}
        for k, v in self.selector.watch(own, step, last).items():
            memory[f"guide.{k}"][rows] = v


def as_logits(chances: Array, may: Array) -> Array:
    """Logits of choices that are as likely as that, but for a share that is uniform.

    Args:
        chances: (…, choices).
        may: (…, choices) bool, what is allowed: the share is shared among it.
    """
    uniform = may / np.maximum(may.sum(-1, keepdims=True), 1)
    mixed = (1.0 - SMOOTHED) * chances + SMOOTHED * uniform
    found: Array = np.log(np.maximum(mixed, 1e-8)).astype(np.float32)
    return found
