"""The replay buffer: transitions of N environments, each observation kept once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import DTypeLike
from torch import Tensor

from skillweave.buffers.priorities import Priorities
from skillweave.buffers.store import GOES_ON, TERMINATED, Store
from skillweave.experience import Sample
from skillweave.spaces import to_tensor
from skillweave.types import Array, VecStep


class ReplayBuffer(Store):
    """Filled a step at a time and sampled at random.

    N = P·B columns as in ``RolloutBuffer``. Members see their own columns, or with ``shared`` all;
    each has its own γ. ``n_step`` and ``prioritized`` (Schaul et al. 2016) say how it is sampled,
    and ``between`` that samples hold the observations between the n steps, too.

    Raises:
        SkillweaveError: the buffer is larger than the free memory, or holds not even one row.
    """

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        members: int,
        observation_space: gym.Space[Any],
        action_shape: tuple[int, ...],
        action_dtype: DTypeLike,
        *,
        mask_size: int | None = None,
        shared: bool = False,
        n_step: int = 1,
        prioritized: bool = False,
        alpha: float = 0.6,
        between: bool = False,
    ) -> None:
        super().__init__(
            capacity, num_envs, observation_space, action_shape, action_dtype,
            mask_size=mask_size, each=4 * prioritized * (members if shared else 1),
            keep_rewards=shared,
        )  # fmt: skip
        self._n_step, self._between = n_step, between and n_step > 1
        # Columns that a member draws from, and the first of them.
        self._width = num_envs if shared else num_envs // members
        self._offset = np.arange(members)[:, None] * (0 if shared else self._width)
        places = self._rows * self._width
        self._priorities = Priorities(members, places, alpha) if prioritized else None

    @property
    def nbytes(self) -> int:
        """Bytes that are reserved; what was never written takes no memory yet."""
        return super().nbytes + (self._priorities.nbytes if self._priorities else 0)

    def add(self, obs: Array, mask: Array | None, action: Array, step: VecStep) -> None:
        """Append a step: ``obs`` and ``mask`` acted on, ``action`` (N, ...) in policy units."""
        super().add(obs, mask, action, step)
        if self._priorities is not None:
            rows = np.arange(self._count - 1, self._count + 1)[:, None] % self._rows
            self._priorities.turn(*(rows * self._width + np.arange(self._width)))

    def sample(
        self,
        batch: int,
        gamma: Tensor,
        rngs: Sequence[np.random.Generator],
        beta: float = 1.0,
        first: int = 0,
    ) -> Sample:
        """``batch`` transitions for each member from ``first`` on, as many as generators are given.

        ``gamma`` (P,) are their discounts.
        """
        assert self._count, "sample() before add()"
        return self.at(*self._draw(batch, rngs, beta, first), gamma)

    def at(self, index: Array, weight: Array | None, gamma: Tensor) -> Sample:
        """The transitions (P, B) that a sample, perhaps of another buffer, calls ``index``."""
        data, n = self._data, self._num_envs
        start = slot = index % self._slots
        factor = gamma.float().numpy()[:, None]
        reward, discount = self._reward(factor, slot), self._power(factor, slot)
        end, newest = data["end"].take(slot), self._row(self._count - 1).start
        between: list[tuple[Array, Array]] = []
        for _ in range(self._n_step - 1):
            goes_on = (end == GOES_ON) & ((slot < newest) | (slot >= newest + n))
            slot = np.where(goes_on, (slot + n) % self._slots, slot)
            between.append((slot, np.where(goes_on, discount, np.float32(0))))
            reward += np.where(goes_on, discount * self._reward(factor, slot), np.float32(0))
            discount = np.where(goes_on, discount * self._power(factor, slot), discount)
            end = data["end"].take(slot)
        now = {name: data[name].take(start, axis=0) for name in self._ends}
        action, after = data["action"].take(start, axis=0), self._after(slot, end)
        return Sample(
            obs=to_tensor(now["obs"]),
            action=to_tensor(action.astype(np.int64) if action.dtype.kind in "iu" else action),
            reward=to_tensor(reward),
            discount=to_tensor(discount * (end != TERMINATED)),
            next_obs=to_tensor(after["obs"]),
            obs_mask=self._allowed(now.get("mask")),
            next_obs_mask=self._allowed(after.get("mask")),
            weight=None if weight is None else to_tensor(weight),
            index=index,
            **self._seen_between(between),
        )

    def update_priorities(self, index: Array, priority: Tensor, first: int = 0) -> None:
        """New priorities (P, B), above 0, of what members from ``first`` on have sampled."""
        if self._priorities is not None:
            # What was overwritten since is skipped.
            member, place = (index >= self._count * self._num_envs - len(self)).nonzero()
            index, width = index[member, place], self._width
            own = index - index // self._num_envs * (self._num_envs - width)
            own = (own - self._offset[first + member, 0]) % (self._rows * width)
            new = priority.detach().float().numpy()[member, place]
            self._priorities.update(first + member, own, new)

    def inherit(self, parents: Array) -> None:
        """Every member (P,) goes on with the priorities of the one it descends from."""
        if self._priorities is not None:
            self._priorities.inherit(parents)

    def state(self) -> dict[str, Tensor]:
        """Copies of all that was written, to go on exactly; see ``load``."""
        state = super().state()
        if self._priorities is not None:
            state |= self._priorities.state(min(self._count, self._rows) * self._width)
        return state

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from the ``state`` of a buffer that was made with the same arguments."""
        super().load(state)
        if self._priorities is not None:
            self._priorities.load(state)

    @property
    def capacity(self) -> int:
        """Transitions that it holds when full, over all columns."""
        return (self._rows - 1) * self._num_envs

    def _draw(
        self, batch: int, rngs: Sequence[np.random.Generator], beta: float, first: int
    ) -> tuple[Array, Array | None]:
        """Which transitions (P, B), counted from the first ever added, and their weights."""
        width, weight = self._width, None
        if self._priorities is None:
            among = self._filled * width
            drawn = np.stack([rng.integers(among, size=batch) for rng in rngs])
            drawn += (self._count - self._filled) * width
        else:
            uniform = np.stack([rng.random(batch) for rng in rngs])
            place, weight = self._priorities.draw(uniform, beta, first)
            newest = self._count * width - 1
            drawn = newest - (newest - place) % (self._rows * width)
        # Counted so far among the member's own columns.
        start = self._offset[first : first + len(rngs)]
        return drawn + drawn // width * (self._num_envs - width) + start, weight

    def _seen_between(self, between: list[tuple[Array, Array]]) -> dict[str, Any]:
        """Of n steps, the observations after the first: of their slots (P, B) and discounts."""
        if not self._between:
            return {}
        slots, discounts = (np.stack(each, -1) for each in zip(*between, strict=True))
        seen = {name: self._data[name].take(slots, axis=0) for name in self._ends}
        return {
            "between_obs": to_tensor(seen["obs"]),
            "between_mask": self._allowed(seen.get("mask")),
            "between_discount": to_tensor(discounts),
        }
