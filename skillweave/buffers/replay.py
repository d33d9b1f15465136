"""The replay buffer: transitions of N environments, each observation kept once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import DTypeLike
from torch import Tensor

from skillweave.buffers.memory import check_memory
from skillweave.buffers.priorities import Priorities
from skillweave.spaces import obs_dtype, obs_shape, to_tensor
from skillweave.types import Array, Sample, SkillweaveError, VecStep

GOES_ON, CUT, TERMINATED = 0, 1, 2  # how a transition ended
INTEGERS = (np.uint8, np.int16, np.int32)  # what files can hold


class ReplayBuffer:
    """Filled a step at a time and sampled at random; the oldest transitions make room.

    N = P·B columns as in ``RolloutBuffer``. A slot is (row, column), flat; rows form a ring with
    one row more than can be sampled. What followed a transition lies in the next row of its
    column; only where an episode ended, its true successor is in a side ring that grows.
    ``mask_size`` is the number of discrete actions. Members see their own columns, or with
    ``shared`` all. ``n_step`` and ``prioritized`` (Schaul et al. 2016) say how it is sampled.

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
    ) -> None:
        if capacity < num_envs:
            raise SkillweaveError(
                f"buffer_size is {capacity}; it must be at least num_envs, {num_envs}"
            )
        kind = np.dtype(action_dtype)
        if mask_size is not None and kind.kind in "iu":
            kind = np.dtype(next(k for k in INTEGERS if mask_size - 1 <= np.iinfo(k).max))
        item, shape = obs_dtype(observation_space), obs_shape(observation_space)
        columns: dict[str, tuple[tuple[int, ...], Any]] = {
            "obs": (shape, item), "action": (action_shape, kind),
            "reward": ((), np.float32), "end": ((), np.uint8), "side": ((), np.int32),
        }  # fmt: skip
        each = 4 * prioritized * (members if shared else 1)
        each += sum(int(np.prod(s)) * np.dtype(d).itemsize for s, d in columns.values())
        check_memory(capacity, each, f"{shape} {item}")
        self._num_envs, self._n_step, self._mask_size = num_envs, n_step, mask_size or 0
        self._count, self._rows = 0, capacity // num_envs + 1  # rows ever added, and held
        self._slots = self._rows * num_envs
        # Columns that a member draws from, and the first of them.
        self._width = num_envs if shared else num_envs // members
        self._offset = np.arange(members)[:, None] * (0 if shared else self._width)
        # By slot; "steps" comes with the first call not of 1 step, "mask" (bits) with a mask.
        self._data = {k: np.zeros((self._slots, *s), d) for k, (s, d) in columns.items()}
        # Side rings of true successors, their lengths powers of two, in use from _side_first to
        # before _side_last; "side" says which is an ended transition's, modulo 2^32.
        self._ends = {"obs": np.zeros((64, *shape), item)}
        self._side_first = self._side_last = 0
        places = self._rows * self._width
        self._priorities = Priorities(members, places, alpha) if prioritized else None

    def __len__(self) -> int:
        """Transitions that can be sampled, over all columns."""
        return self._filled * self._num_envs

    @property
    def nbytes(self) -> int:
        """Bytes that are reserved; what was never written takes no memory yet."""
        arrays = (*self._data.values(), *self._ends.values())
        return sum(a.nbytes for a in arrays) + (self._priorities.nbytes if self._priorities else 0)

    def add(self, obs: Array, mask: Array | None, action: Array, step: VecStep) -> None:
        """Append a step: ``obs`` and ``mask`` acted on, ``action`` (N, ...) in policy units."""
        data, row, head = self._data, self._row(self._count), self._row(self._count + 1)
        if self._count + 1 >= self._rows:  # the oldest row makes room
            self._side_first += int(np.count_nonzero(data["end"][head]))
        data["obs"][row], data["obs"][head] = obs, step.obs
        data["action"][row], data["reward"][row] = action, step.reward
        data["end"][row] = np.where(step.terminated, TERMINATED, step.truncated * CUT)
        if "steps" not in data and (step.steps != 1).any():
            self._start("steps")
        if "steps" in data:
            data["steps"][row] = step.steps
        if "mask" not in data and any(m is not None for m in (mask, step.mask, step.next_mask)):
            self._start("mask")
        if "mask" in data:
            data["mask"][row], data["mask"][head] = _packed(mask), _packed(step.mask)
        self._count += 1
        if (columns := step.ended.nonzero()[0]).size:
            allowed = None if step.next_mask is None else step.next_mask[columns]
            self._keep(row.start + columns, obs=step.next_obs[columns], mask=_packed(allowed))
        if self._priorities is not None:
            rows = np.arange(self._count - 1, self._count + 1)[:, None] % self._rows
            self._priorities.turn(*(rows * self._width + np.arange(self._width)))

    def cut(self, columns: Array) -> None:
        """End the open episodes of ``columns`` (k,), whose environments begin anew."""
        if self._count:
            row, head = self._row(self._count - 1), self._row(self._count)
            columns = columns[self._data["end"][row][columns] == GOES_ON]
            self._data["end"][row.start + columns] = CUT
            after = {name: self._data[name][head][columns] for name in self._ends}
            self._keep(row.start + columns, **after)

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
        reward, discount = data["reward"].take(slot), self._power(factor, slot)
        end, newest = data["end"].take(slot), self._row(self._count - 1).start
        for _ in range(self._n_step - 1):
            goes_on = (end == GOES_ON) & ((slot < newest) | (slot >= newest + n))
            slot = np.where(goes_on, (slot + n) % self._slots, slot)
            reward += np.where(goes_on, discount * data["reward"].take(slot), np.float32(0))
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
            mask=self._allowed(after.get("mask")),
            weight=None if weight is None else to_tensor(weight),
            index=index,
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
        state = {name: to_tensor(array.copy()) for name, array in self._written().items()}
        if self._priorities is not None:
            state |= self._priorities.state(min(self._count, self._rows) * self._width)
        return state | {"at": torch.tensor([self._count, self._side_first, self._side_last])}

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from the ``state`` of a buffer that was made with the same arguments."""
        self._count, self._side_first, self._side_last = state["at"].tolist()
        for name in ("steps", "mask"):
            self._data.pop(name, None)
            self._ends.pop(name, None)
            if name in state:
                self._start(name)
        self._ends = {k: self._ring(k, len(state[f"{k}_ends"])) for k in self._ends}
        for name, array in self._written().items():
            to_tensor(array).copy_(state[name])
        if self._priorities is not None:
            self._priorities.load(state)

    @property
    def capacity(self) -> int:
        """Transitions that it holds when full, over all columns."""
        return (self._rows - 1) * self._num_envs

    @property
    def _filled(self) -> int:
        """Rows that can be sampled."""
        return min(self._count, self._rows - 1)

    def _row(self, count: int) -> slice:
        """The slots of a row, of all ever added."""
        start = count % self._rows * self._num_envs
        return slice(start, start + self._num_envs)

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

    def _power(self, gamma: Array, slot: Array) -> Array:
        """γ^τ of transitions (P, B)."""
        if "steps" not in self._data:
            return np.broadcast_to(gamma, slot.shape)
        return np.asarray(gamma ** self._data["steps"].take(slot))

    def _after(self, slot: Array, end: Array) -> dict[str, Array]:
        """What truly followed transitions (P, B) that ended thus: "obs" and perhaps "mask"."""
        found = {}
        for name, ring in self._ends.items():
            after = self._data[name].take(slot + self._num_envs, axis=0, mode="wrap")
            if (ended := end.nonzero())[0].size:
                after[ended] = ring[self._data["side"][slot[ended]] & len(ring) - 1]
            found[name] = after
        return found

    def _allowed(self, bits: Array | None) -> Tensor | None:
        """Masks (P, B, A) from their bits."""
        if bits is None:
            return None
        return to_tensor(np.unpackbits(bits, axis=-1, count=self._mask_size).view(bool))

    def _keep(self, slots: Array, **after: Array) -> None:
        """Put what truly followed transitions that ended into the side rings."""
        new = np.arange(self._side_last, self._side_last + len(slots))
        self._side_last += len(slots)
        self._data["side"][slots] = new.astype(np.int32)
        needed = self._side_last - self._side_first
        for name, ring in self._ends.items():
            if len(ring) < needed:
                live = np.arange(self._side_first, new[0])
                grown = self._ring(name, 1 << (needed - 1).bit_length())
                grown[live & len(grown) - 1] = ring[live & len(ring) - 1]
                self._ends[name] = ring = grown
            ring[new & len(ring) - 1] = after[name]

    def _ring(self, name: str, length: int) -> Array:
        """An empty side ring."""
        like = self._data[name]
        return np.zeros((length, *like.shape[1:]), like.dtype)

    def _start(self, name: str) -> None:
        """Begin to store "steps" or "mask", of which everything so far was 1 or allowed all."""
        if name == "steps":
            self._data[name] = np.ones(self._slots, np.float32)
        else:
            assert self._mask_size, "masks need a mask_size"
            size = -(-self._mask_size // 8)
            self._data[name] = np.full((self._slots, size), 255, np.uint8)
            self._ends[name] = np.full((len(self._ends["obs"]), size), 255, np.uint8)

    def _written(self) -> dict[str, Array]:
        """Views of all that was written, by name."""
        used = min(self._count + 1, self._rows) * self._num_envs if self._count else 0
        arrays = {name: array[:used] for name, array in self._data.items()}
        return arrays | {f"{name}_ends": ring for name, ring in self._ends.items()}


def _packed(mask: Array | None) -> Array:
    """(n, A) bool as bits; no mask allows everything."""
    return np.array(255, np.uint8) if mask is None else np.packbits(mask, axis=-1)
