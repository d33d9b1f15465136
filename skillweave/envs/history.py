"""The actions in each environment since its seed, to repeat its open episode.

An environment cannot be copied, but it can be repeated: the same seed and the same actions lead to
the same state. So a checkpoint can restore open episodes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from skillweave.policies.core import Array


class History:
    """The actions of N environments since their seeds, and the starts of episodes among them.

    Args:
        num_envs: N.
        action: an example of N actions, (N, *action_shape), for their shape and type.
    """

    def __init__(self, num_envs: int, action: Array) -> None:
        self.length = np.zeros(num_envs, np.int64)
        """Actions since the seed, (N,)."""
        self._action = np.zeros((64, *action.shape), action.dtype)  # (capacity, N, *action_shape)
        self._begins = np.zeros((64, num_envs), bool)  # an episode begins before this action

    @property
    def total(self) -> int:
        """Return the number of actions of all environments."""
        return int(self.length.sum())

    def forget(self, ids: Array) -> None:
        """Clear the history of environments ``ids`` (n,), which have been seeded."""
        self._begins[: int(self.length[ids].max(initial=0)) + 1, ids] = False
        self.length[ids] = 0

    def begin(self, ids: Array) -> None:
        """Record the start of episodes in environments ``ids`` (n,), without a new seed."""
        self._begins[self.length[ids], ids] = True

    def add(self, action: Array, ids: Array) -> None:
        """Record actions (n, *action_shape) of environments ``ids`` (n,)."""
        at = self.length[ids]
        self._action[at, ids] = action
        self.length[ids] = at + 1
        if int(at.max()) + 2 > len(self._action):  # one row stays free for the next start
            self._action = np.concatenate([self._action, np.zeros_like(self._action)])
            self._begins = np.concatenate([self._begins, np.zeros_like(self._begins)])

    def play(self) -> Iterator[tuple[Array, Array, Array]]:
        """Yield the history of all environments at once, action by action.

        Yields:
            ids (b,) of environments in which an episode starts, ids (n,) of environments that then
            act, and their actions (n, *action_shape). The last item has no actions.
        """
        for t in range(int(self.length.max(initial=0)) + 1):
            here = self.length >= t
            acts = np.flatnonzero(self.length > t)
            yield np.flatnonzero(self._begins[t] & here), acts, self._action[t, acts]

    def state(self) -> dict[str, Array]:
        """Return arrays for a file, no longer than the history."""
        longest = int(self.length.max(initial=0))
        done = np.arange(longest)[:, None] < self.length
        begins = np.argwhere(self._begins & (np.arange(len(self._begins))[:, None] <= self.length))
        return {
            "length": self.length.copy(),
            "action": self._action[:longest][done],
            "begins": begins.astype(np.int64),
        }

    def load(self, state: dict[str, Array]) -> None:
        """Load a history from ``state``."""
        self.length = state["length"].copy()
        longest = int(self.length.max(initial=0))
        capacity = max(64, 1 << (longest + 1).bit_length())
        self._action = np.zeros((capacity, *self._action.shape[1:]), self._action.dtype)
        self._begins = np.zeros((capacity, len(self.length)), bool)
        done = np.arange(longest)[:, None] < self.length
        self._action[:longest][done] = self._packed(state["action"])
        self._begins[tuple(state["begins"].T)] = True

    def _packed(self, action: Array) -> Array:
        """Return actions of a file (n, …), where those with parts are bytes (n, K)."""
        dtype = self._action.dtype
        if dtype.fields is None or action.dtype == dtype:
            return action
        return np.ascontiguousarray(action).view(dtype).reshape(len(action))
