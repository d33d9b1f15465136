"""Policies that contain no other: ready selectors, and networks that learn."""

from __future__ import annotations

from typing import Any

import numpy as np

from .core import Array, LastCall, Memory, Policy, Step, Turn
from .functional import Returns


class Ready(Returns):
    """A selector that is not trained: it also watches how calls end.

    Its policy has ``chances``, ``allowed``, ``watch``, ``ranges``, ``skills`` and ``lengths``, as
    ``ReadySelector`` has them.
    """

    def chances(self, memory: Memory, rows: Array, obs: Array, may: Array) -> Array:
        """Return how likely each of the choices that ``may`` be made is, (k, choices) float32.

        Where it chooses no lengths, all lengths of a skill are equally likely.
        """
        own = len(self.policy.skills) * max(1, len(self.policy.lengths))
        lengths = may.shape[1] // own
        chances, after = self.policy.chances(self._of(memory, rows), obs, may[:, ::lengths])
        self._keep(memory, rows, after)
        found: Array = chances.repeat(lengths, axis=1) / np.float32(lengths)
        return found

    def ahead(self, memory: Memory, rows: Array, may: Array) -> Array:
        """Return which choices (k, choices) it leaves, as far as is known before it sees more."""
        allowed = self.policy.allowed(self._of(memory, rows))
        if allowed is None:
            return may
        left: Array = may & allowed.repeat(may.shape[1] // allowed.shape[1], axis=1)
        return left

    def watch(self, memory: Memory, rows: Array, step: Step, last: LastCall) -> None:
        """Show it a step, and how the last calls ended."""
        self._keep(memory, rows, self.policy.watch(self._of(memory, rows), step, last))

    def redraws(self, greedy: bool) -> bool:
        """Return False: what it chooses follows from what it sees."""
        return False

    def values(self) -> dict[str, Any]:
        """Return the ranges of indices in its memory."""
        return dict(self.policy.ranges)


class Learning(Policy):
    """A network that learns; what it chooses is written where the step is recorded.

    Args:
        net: acts in some of N environments; by their numbers it knows which member acts.
        path: of the learner, before the names of its columns.
        decides: it is a selector: what it decided on is written, too.
    """

    def __init__(self, net: Any, path: str, *, decides: bool = False) -> None:
        self.net = net
        names = ("action", "dist_params", "decided", "obs", "allowed", "state_before")
        self._columns = [f"{path}/{name}" for name in (names if decides else names[:2])]

    @property
    def action_space(self) -> Any:
        """The space of its actions in the environment's units."""
        return self.net.stacks[0][0].action_space

    def start(self, n: int) -> Memory:
        """Return zeros (n, M), where the network is recurrent."""
        size = self.net.memory_size
        return {"rnn": np.zeros((n, size), np.float32)} if size else {}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return actions (k, …) in the environment's units, as the latest request says."""
        before, mask = memory["rnn"][rows] if "rnn" in memory else None, turn.mask
        acted = self.net.some(rows, obs, self.net.widened(mask), before)
        if acted.recurrent_state is not None:
            memory["rnn"][rows] = acted.recurrent_state
        if turn.world.trace is not None:
            every = np.ones(len(rows), bool)
            values = acted.action, acted.dist_params, every, obs, mask, before
            turn.world.trace.write(rows, **dict(zip(self._columns, values, strict=False)))
        action: Array = self.net.to_env(acted.action)
        return action

    def redraws(self, greedy: bool) -> bool:
        """Return True: it explores, whatever the turn says."""
        return True
