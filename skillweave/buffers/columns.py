"""Columns: what a replay store keeps of N environments, each observation once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import DTypeLike
from torch import Tensor

from skillweave.buffers.held import check_columns
from skillweave.buffers.ram import check_memory
from skillweave.errors import DeclarationError, RunError
from skillweave.experience import Batch
from skillweave.spaces import obs_dtype, obs_shape, to_tensor
from skillweave.types import Array

NOTHING, GOES_ON, TERMINATED = 0, 1, 2  # what lies in a slot; after GOES_ON the value counts
INTEGERS = (np.uint8, np.int16, np.int32)  # what files can hold
OPTIONAL = ("steps", "mask", "call")


class Columns:
    """N rings of slots, one for each environment; the oldest transitions make room.

    A slot holds an observation and what was done there; the next slot of its column holds what
    followed. Where a trajectory ended, that is a boundary: a slot with the true successor alone,
    and the next trajectory begins behind it. The newest slot of a column is a boundary, too, until
    the trajectory goes on. Slots are numbered ``row · N + column``.

    Args:
        mask_size: number of discrete actions.
        each: bytes that every transition takes elsewhere.
        keep_rewards: of calls, keep the reward of every step, so that any γ can be applied.
        raw: names of raw columns of ``SCHEMA`` that are kept, too, as they come.

    Raises:
        TrainingError: it is larger than the free memory.
        DeclarationError: it holds not even one row.
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
        raw: Sequence[str] = (),
    ) -> None:
        if capacity < num_envs:
            raise DeclarationError(
                f"buffer_size is {capacity}; it must be at least num_envs, {num_envs}"
            )
        action = np.dtype(action_dtype)
        if mask_size is not None and action.kind in "iu":
            action = np.dtype(next(k for k in INTEGERS if mask_size - 1 <= np.iinfo(k).max))
        item, shape = obs_dtype(observation_space), obs_shape(observation_space)
        kinds: dict[str, tuple[tuple[int, ...], Any]] = {
            "obs": (shape, item), "action": (action_shape, action),
            "reward": ((), np.float32), "kind": ((), np.uint8),
        }  # fmt: skip
        each += sum(int(np.prod(s)) * np.dtype(d).itemsize for s, d in kinds.values())
        each += 12 * keep_rewards  # where a call's rewards are, and at least one of them
        what = f"a replay buffer of {capacity:,} transitions of {shape} {item}"
        check_memory(capacity, each, what, "buffer_size")
        self.num_envs, self.rows = num_envs, capacity // num_envs + 1
        self.slots = self.rows * num_envs
        # By slot. "steps" comes with the first call not of 1 step, "mask" (bits) with a mask.
        self.data = {k: np.zeros((self.slots, *s), d) for k, (s, d) in kinds.items()}
        self.newest = np.full(num_envs, -1)
        """(N,) the newest slot of each column, counted from its first one ever."""
        self._column = np.arange(num_envs)
        self._open = np.zeros(num_envs, bool)  # the trajectory goes on there
        self._space, self._mask_size = observation_space, mask_size or 0
        self._keeps_rewards, self.raw = keep_rewards, tuple(raw)
        # The rewards of calls one after another; "call" says where those of a slot begin.
        self._rewards, self._rewards_used = np.zeros(64 * keep_rewards, np.float32), 0

    @property
    def nbytes(self) -> int:
        """Bytes that are reserved; what was never written takes no memory yet."""
        return sum(a.nbytes for a in (*self.data.values(), self._rewards))

    def used(self, first: int = 0, count: int | None = None) -> int:
        """Rows that are written, of the longest of ``count`` columns from ``first`` on."""
        last = None if count is None else first + count
        return min(int(self.newest[first:last].max()) + 1, self.rows)

    def add(self, batch: Batch) -> list[tuple[Array, Array]]:
        """Append rows.

        Returns:
            In the order of time, the slots of new transitions and those of their successors, of
            which some are transitions as well and the others boundaries; both (k,).
        """
        most = self.rows // 2  # a row takes at most two slots
        return [self._add(part) for part in _parts(batch, most)]

    def cut(self, columns: Array) -> None:
        """End the open trajectories of ``columns`` (k,), whose environments begin anew."""
        self._open[columns] = False

    def after(self, slot: Array) -> Array:
        """The next slots of the columns of ``slot``."""
        found: Array = slot + self.num_envs
        found -= self.slots * (found >= self.slots)
        return found

    def number(self, slot: Array) -> Array:
        """The numbers of what lies in ``slot``, counted from the first ever; modulo ``slots``."""
        row = slot // self.num_envs
        laps = (self.newest.take(slot - row * self.num_envs) - row) // self.rows
        found: Array = slot + laps * self.slots
        return found

    def reward(self, gamma: Array, slot: Array) -> Array:
        """Rewards of transitions (P, B), float32; of calls Σγᵏrₖ."""
        if "call" not in self.data:
            return self.data["reward"].take(slot)
        where, steps = self._places(slot.ravel())
        begins = steps.cumsum() - steps
        power = np.arange(len(where)) - begins.repeat(steps)
        factor = np.broadcast_to(np.float64(gamma), slot.shape).ravel().repeat(steps)
        each = factor**power * self._rewards.take(where)
        found: Array = np.add.reduceat(each, begins).reshape(slot.shape).astype(np.float32)
        return found

    def power(self, gamma: Array, slot: Array) -> Array:
        """γ^τ of transitions (P, B)."""
        if "steps" not in self.data:
            return np.broadcast_to(gamma, slot.shape)
        return np.asarray(gamma ** self.data["steps"].take(slot))

    def mask(self, slot: Array) -> Array | None:
        """The actions allowed in the observations of ``slot``, (…, A) bool; None: all, always."""
        if "mask" not in self.data:
            return None
        bits = self.data["mask"].take(slot, axis=0)
        return np.unpackbits(bits, axis=-1, count=self._mask_size).view(bool)

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from what ``written`` gave, of columns that were made with the same arguments.

        Raises:
            RunError: it is of other settings.
            ValueError: a number in it is none that is written here.
        """
        self.data["kind"][:] = NOTHING
        for name in OPTIONAL:
            self.data.pop(name, None)
            if name in state:
                self._start(name)
        for name in self.raw:
            self.data.pop(name, None)
            if name in state:
                self._start_raw(name, state[name].numpy())
        self._rewards_used = len(state["rewards"]) if "rewards" in state else 0
        self._rewards = np.zeros(max(self._rewards_used, len(self._rewards)), np.float32)
        copy_into({"newest": self.newest}, state)
        copy_into(self.written(), state)
        check_columns(self.written(), self._space, self._mask_size)

    def written(self) -> dict[str, Array]:
        """Views of all that was written, by name."""
        used = self.used() * self.num_envs
        found = {name: array[:used] for name, array in self.data.items()}
        if "call" in found:
            found["rewards"] = self._rewards[: self._rewards_used]
        return found | {"newest": self.newest, "open": self._open}

    def _add(self, rows: Batch) -> tuple[Array, Array]:
        """Append rows of which each column has room for all."""
        data, valid, slot = self.data, rows.get("valid"), self._claim(rows)
        mask, next_mask = rows.get("mask"), rows.get("next_mask")
        after = self.after(slot)

        def flat(x: Array) -> Array:
            return x.reshape(-1, *x.shape[2:]) if valid is None else x[valid]

        if "steps" not in data and (flat(rows["steps"]) != 1).any():
            self._start("steps")
            if self._keeps_rewards:
                self._start("call")
        if "mask" not in data and not (mask is None and next_mask is None):
            self._start("mask")
        # Where a trajectory goes on, a successor's slot is that of the next transition as well.
        data["obs"][after], data["kind"][after] = flat(rows["next_obs"]), NOTHING
        data["obs"][slot] = flat(rows["obs"])
        data["action"][slot], data["reward"][slot] = flat(rows["action"]), flat(rows["reward"])
        if "steps" in data:
            data["steps"][slot] = flat(rows["steps"])
        if "call" in data:
            data["kind"][slot] = NOTHING  # what is overwritten needs its rewards no more
            each = rows["rewards"] if "rewards" in rows else rows["reward"][..., None]
            self._keep_rewards(slot, flat(each), flat(rows["steps"]))
        for name in (name for name in self.raw if name in rows):
            if name not in data:
                self._start_raw(name, flat(rows[name]))
            data[name][slot] = flat(rows[name])
        if "mask" in data:
            for where, x in (after, next_mask), (slot, mask):
                data["mask"][where] = 255 if x is None else np.packbits(flat(x), axis=-1)
        data["kind"][slot] = GOES_ON + flat(rows["terminated"])
        return slot, after

    def _claim(self, rows: Batch) -> Array:
        """The slots (k,) that valid rows take, in the order of time; moves the newest ones on."""
        valid, ended = rows.get("valid"), rows.ended
        place = (self.newest + ~self._open)[None]
        if len(ended) > 1:  # a slot for each row before, and for each end before
            before = np.ones_like(ended) if valid is None else valid
            taken = before + (ended & before).astype(np.int64)
            place = place + taken.cumsum(0) - taken
        slot: Array = place % self.rows * self.num_envs + self._column
        if valid is None:
            self.newest, self._open = place[-1] + 1, ~ended[-1]
            return slot.ravel()
        column = np.flatnonzero(valid.any(0))
        last = len(valid) - 1 - valid[::-1, column].argmax(0), column
        self.newest[column], self._open[column] = place[last] + 1, ~ended[last]
        return slot[valid]

    def _start(self, name: str) -> None:
        """Begin to store "steps", "mask" or "call".

        Everything so far was of 1 step, allowed all, and had the reward of one step.
        """
        if name == "steps":
            self.data[name] = np.ones(self.slots, np.float32)
        elif name == "mask":
            assert self._mask_size, "masks need a mask_size"
            self.data[name] = np.full((self.slots, -(-self._mask_size // 8)), 255, np.uint8)
        else:
            self.data[name], self._rewards_used = np.zeros(self.slots, np.int64), 0
            kept = self.data["kind"].nonzero()[0]
            self._keep_rewards(kept, self.data["reward"][kept, None], np.ones(len(kept), np.int64))

    def _start_raw(self, name: str, like: Array) -> None:
        """Begin to store a raw column, of the shape and type of ``like`` (k, …).

        Raises:
            TrainingError: it takes more than the free memory.
        """
        each = like.dtype.itemsize * math.prod(like.shape[1:])
        check_memory(self.slots, each, f"the column {name!r} of a replay buffer", "buffer_size")
        self.data[name] = np.zeros((self.slots, *like.shape[1:]), like.dtype)

    def _keep_rewards(self, slot: Array, rewards: Array, steps: Array) -> None:
        """Append the rewards (k, longest) of calls of ``steps`` (k,); none after those given."""
        needed = int(steps.sum())
        if self._rewards_used + needed > len(self._rewards):
            self._compact(needed)
        self.data["call"][slot] = self._rewards_used + steps.cumsum() - steps
        whole = np.zeros((len(steps), steps.max(initial=1)), np.float32)
        width = min(whole.shape[1], rewards.shape[1])
        whole[:, :width] = rewards[:, :width]
        end = self._rewards_used + needed
        self._rewards[self._rewards_used : end] = whole[np.arange(whole.shape[1]) < steps[:, None]]
        self._rewards_used = end

    def _compact(self, needed: int) -> None:
        """Drop the rewards of calls that were overwritten; grow where half are still needed."""
        live = self.data["kind"].nonzero()[0] if self._rewards_used else np.zeros(0, np.int64)
        where, steps = self._places(live)
        size = 1 << (2 * (len(where) + needed) - 1).bit_length()
        if size > len(self._rewards):
            what = f"the replay buffer's room for the rewards of {size:,} steps of calls"
            check_memory(size, 4, what, "buffer_size")
        kept = np.zeros(max(size, len(self._rewards)), np.float32)
        kept[: len(where)] = self._rewards[where]
        self.data["call"][live] = steps.cumsum() - steps
        self._rewards, self._rewards_used = kept, len(where)

    def _places(self, slot: Array) -> tuple[Array, Array]:
        """Where the rewards of calls (k,) are, one call after another, and their steps (k,)."""
        steps = self.data["steps"].take(slot).astype(np.int64)
        begins = steps.cumsum() - steps
        where = (self.data["call"].take(slot) - begins).repeat(steps)
        return where + np.arange(len(where)), steps


def _parts(batch: Batch, most: int) -> list[Batch]:
    """Cut a batch into parts of at most ``most`` rows."""
    rows, _ = batch.lead
    if 0 < rows <= most:
        return [batch]
    return [batch.rows(slice(start, start + most)) for start in range(0, rows, most)]


def copy_into(arrays: dict[str, Array], state: dict[str, Tensor]) -> None:
    """Write what a checkpoint holds into arrays of the same shapes and types."""
    for name, array in arrays.items():
        into, kept = to_tensor(array), state.get(name)
        if kept is None or kept.shape != into.shape or kept.dtype != into.dtype:
            found = "missing" if kept is None else f"{kept.dtype} {tuple(kept.shape)}"
            raise RunError(
                f"the checkpoint's replay buffer does not fit: {name!r} is {found}, where "
                f"{into.dtype} {tuple(into.shape)} belongs; go on with the settings that it was "
                "written with, or begin a new run"
            )
        into.copy_(kept)
