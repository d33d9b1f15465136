"""What a replay buffer holds: steps of N environments, each observation kept once."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import DTypeLike
from torch import Tensor

from skillweave.buffers.memory import check_memory
from skillweave.buffers.ring import Ring
from skillweave.spaces import obs_dtype, obs_shape, to_tensor
from skillweave.types import Array, SkillweaveError, VecStep

GOES_ON, CUT, TERMINATED = 0, 1, 2  # how a transition ended
INTEGERS = (np.uint8, np.int16, np.int32)  # what files can hold


class Store:
    """Filled a step at a time; the oldest transitions make room.

    A slot is (row, column), flat; rows form a ring with one row more than can be sampled. What
    followed a transition lies in the next row of its column; only where an episode ended, its true
    successor is in a side ring that grows. ``mask_size`` is the number of discrete actions.

    Args:
        each: bytes that every transition takes elsewhere.
        keep_rewards: of calls, keep the reward of every step, so that any γ can be applied.

    Raises:
        SkillweaveError: it is larger than the free memory, or holds not even one row.
    """

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        observation_space: gym.Space[Any],
        action_shape: tuple[int, ...],
        action_dtype: DTypeLike,
        *,
        mask_size: int | None,
        each: int,
        keep_rewards: bool,
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
        each += sum(int(np.prod(s)) * np.dtype(d).itemsize for s, d in columns.values())
        check_memory(capacity, each, f"{shape} {item}")
        self._num_envs, self._mask_size = num_envs, mask_size or 0
        self._count, self._rows = 0, capacity // num_envs + 1  # rows ever added, and held
        self._slots = self._rows * num_envs
        # By slot; "steps" comes with the first call not of 1 step, "mask" (bits) with a mask.
        self._data = {k: np.zeros((self._slots, *s), d) for k, (s, d) in columns.items()}
        # True successors; "side" is the number of an ended transition's.
        self._ends = {"obs": Ring(shape, item)}
        # The reward of each step of calls; "call" is the number of a call's first one.
        self._keeps_rewards = keep_rewards
        self._rewards: Ring | None = None

    def __len__(self) -> int:
        """Transitions that can be sampled, over all columns."""
        return self._filled * self._num_envs

    @property
    def nbytes(self) -> int:
        """Bytes that are reserved; what was never written takes no memory yet."""
        rings = [*self._ends.values(), *([self._rewards] if self._rewards else [])]
        arrays = (*self._data.values(), *(ring.rows for ring in rings))
        return sum(a.nbytes for a in arrays)

    def add(self, obs: Array, mask: Array | None, action: Array, step: VecStep) -> None:
        """Append a step: ``obs`` and ``mask`` acted on, ``action`` (N, ...) in policy units."""
        data, row, head = self._data, self._row(self._count), self._row(self._count + 1)
        if self._count + 1 >= self._rows:  # the oldest row makes room
            for ring in self._ends.values():
                ring.drop(int(np.count_nonzero(data["end"][head])))
            if self._rewards is not None:
                self._rewards.drop(int(data["steps"][head].sum()))
        data["obs"][row], data["obs"][head] = obs, step.obs
        data["action"][row], data["reward"][row] = action, step.reward
        data["end"][row] = np.where(step.terminated, TERMINATED, step.truncated * CUT)
        if "steps" not in data and (step.steps != 1).any():
            self._start("steps")
        if "steps" in data:
            data["steps"][row] = step.steps
        given = self._keeps_rewards and "steps" in data and "rewards" in step.info
        if given and self._rewards is None:
            self._start("call")
        if self._rewards is not None:
            self._keep_rewards(row, step.info["rewards"], step.steps)
        if "mask" not in data and any(m is not None for m in (mask, step.mask, step.next_mask)):
            self._start("mask")
        if "mask" in data:
            data["mask"][row], data["mask"][head] = _packed(mask), _packed(step.mask)
        self._count += 1
        if (columns := step.ended.nonzero()[0]).size:
            allowed = None if step.next_mask is None else step.next_mask[columns]
            self._keep(row.start + columns, obs=step.next_obs[columns], mask=_packed(allowed))

    def cut(self, columns: Array) -> None:
        """End the open episodes of ``columns`` (k,), whose environments begin anew."""
        if self._count:
            row, head = self._row(self._count - 1), self._row(self._count)
            columns = columns[self._data["end"][row][columns] == GOES_ON]
            self._data["end"][row.start + columns] = CUT
            after = {name: self._data[name][head][columns] for name in self._ends}
            self._keep(row.start + columns, **after)

    def state(self) -> dict[str, Tensor]:
        """Copies of all that was written, to go on exactly; see ``load``."""
        state = {name: to_tensor(array.copy()) for name, array in self._written().items()}
        at = [self._count]
        for ring in self._rings().values():
            at += [ring.first, ring.last]
        return state | {"at": torch.tensor(at)}

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from the ``state`` of a buffer that was made with the same arguments."""
        self._rewards, (self._count, *at) = None, state["at"].tolist()
        for name in ("steps", "mask", "call"):
            self._data.pop(name, None)
            self._ends.pop(name, None)
            if name in state:
                self._start(name)
        for name, ring in self._rings().items():
            ring.rows = np.zeros((len(state[name]), *ring.rows.shape[1:]), ring.rows.dtype)
            (ring.first, ring.last), at = at[:2], at[2:]
        for name, array in self._written().items():
            to_tensor(array).copy_(state[name])

    @property
    def _filled(self) -> int:
        """Rows that can be sampled."""
        return min(self._count, self._rows - 1)

    def _row(self, count: int) -> slice:
        """The slots of a row, of all ever added."""
        start = count % self._rows * self._num_envs
        return slice(start, start + self._num_envs)

    def _reward(self, gamma: Array, slot: Array) -> Array:
        """Rewards of transitions (P, B), float32; of calls Σγᵏrₖ."""
        if self._rewards is None:
            return self._data["reward"].take(slot)
        steps = self._data["steps"].take(slot).astype(np.int64)
        ends = steps.ravel().cumsum()
        begins = ends - steps.ravel()
        # Calls end to end: for each step its place in its call, and its call's first reward.
        place = np.arange(ends[-1]) - begins.repeat(steps.ravel())
        first = self._data["call"].take(slot).ravel().repeat(steps.ravel())
        factor = np.broadcast_to(np.float64(gamma), slot.shape).ravel().repeat(steps.ravel())
        # Numbers are modulo 2^32, and so is their sum.
        each = factor**place * self._rewards.take(first + place.astype(np.int32))
        found: Array = np.add.reduceat(each, begins).reshape(slot.shape).astype(np.float32)
        return found

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
                after[ended] = ring.take(self._data["side"][slot[ended]])
            found[name] = after
        return found

    def _allowed(self, bits: Array | None) -> Tensor | None:
        """Masks (P, B, A) from their bits."""
        if bits is None:
            return None
        return to_tensor(np.unpackbits(bits, axis=-1, count=self._mask_size).view(bool))

    def _keep(self, slots: Array, **after: Array) -> None:
        """Put what truly followed transitions that ended into the side rings."""
        for name, ring in self._ends.items():
            rows = np.broadcast_to(after[name], (len(slots), *ring.rows.shape[1:]))
            self._data["side"][slots] = ring.put(rows)

    def _keep_rewards(self, row: slice, rewards: Array, steps: Array) -> None:
        """Put the rewards (N, longest) of calls of ``steps`` (N,) into their ring."""
        assert self._rewards is not None
        first = self._rewards.last + steps.cumsum() - steps
        self._data["call"][row] = first.astype(np.int32)
        self._rewards.put(rewards[np.arange(rewards.shape[1]) < steps[:, None]])

    def _start(self, name: str) -> None:
        """Begin to store "steps", "mask" or "call".

        Everything so far was of 1 step, allowed all, and had the reward of one step.
        """
        if name == "steps":
            self._data[name] = np.ones(self._slots, np.float32)
        elif name == "call":
            self._data[name], self._rewards = np.zeros(self._slots, np.int32), Ring((), np.float32)
            kept = min(self._count, self._rows - 2) * self._num_envs  # those that will be dropped
            slots = np.arange(self._count * self._num_envs - kept, self._count * self._num_envs)
            slots %= self._slots
            self._data[name][slots] = self._rewards.put(self._data["reward"][slots])
        else:
            assert self._mask_size, "masks need a mask_size"
            size, ends = -(-self._mask_size // 8), self._ends["obs"]
            self._data[name] = np.full((self._slots, size), 255, np.uint8)
            self._ends[name] = Ring((size,), np.uint8, len(ends.rows))
            self._ends[name].rows[:] = 255
            self._ends[name].first, self._ends[name].last = ends.first, ends.last

    def _rings(self) -> dict[str, Ring]:
        """The rings, by their names in a checkpoint."""
        found = {f"{name}_ends": ring for name, ring in self._ends.items()}
        return found | ({"rewards": self._rewards} if self._rewards is not None else {})

    def _written(self) -> dict[str, Array]:
        """Views of all that was written, by name."""
        used = min(self._count + 1, self._rows) * self._num_envs if self._count else 0
        arrays = {name: array[:used] for name, array in self._data.items()}
        return arrays | {name: ring.rows for name, ring in self._rings().items()}


def _packed(mask: Array | None) -> Array:
    """(n, A) bool as bits; no mask allows everything."""
    return np.array(255, np.uint8) if mask is None else np.packbits(mask, axis=-1)
