"""Storage of replayed transitions in columns, one for each environment; no observation twice."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from torch import Tensor

from skillweave.algorithms.batches import INFO, Batch, number_type
from skillweave.buffers.ram import check_memory
from skillweave.errors import DeclarationError, RunError
from skillweave.policies.core import Array
from skillweave.spaces import obs_dtype, obs_shape, to_tensor

# Content of a slot. The value of the successor counts after GOES_ON, not after TERMINATED.
NOTHING = 0
GOES_ON = 1
TERMINATED = 2
INTEGERS = (np.uint8, np.int16, np.int32)  # types that checkpoint files can hold
OPTIONAL = ("steps", "mask", "call")


class Columns:
    """N rings of slots, one for each environment; the oldest transitions make room.

    A slot holds an observation and the action taken there; the next slot of its column holds the
    successor. Where a trajectory ended, that next slot is a boundary: it holds only the true
    successor, and the next trajectory starts behind it. The newest slot of a column is a boundary,
    too, until the trajectory goes on. Slots are numbered ``row · N + column``.

    Args:
        action: an example of actions, (1, …).
        choices: numbers of a mask, of which there are at least as many as discrete actions; 0:
            actions are numbers, or have no masks.
        each: bytes that every transition takes elsewhere.
        keep_rewards: store the reward of every step of a call, so that any γ can be applied.
        raw: names of raw columns of ``SCHEMA`` that are stored unchanged, too.
        examples: by name, further raw columns, (1, …) of their shape and type.
        calls: store how many rows of its call follow each row, which ``rows_left`` returns.

    Raises:
        TrainingError: the storage is larger than the free memory.
        DeclarationError: the capacity is less than one row.
    """

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        observation_space: gym.Space[Any],
        action: Array,
        choices: int,
        each: int,
        keep_rewards: bool,
        raw: Sequence[str],
        examples: Mapping[str, Array] | None = None,
        calls: bool = False,
    ) -> None:
        if capacity < num_envs:
            raise DeclarationError(
                f"buffer_size is {capacity}; it must be at least num_envs, {num_envs}"
            )
        chosen: Any = action.dtype
        if choices and action.dtype.kind in "iu":
            chosen = next(k for k in INTEGERS if choices - 1 <= np.iinfo(k).max)
        item = obs_dtype(observation_space)
        shape = obs_shape(observation_space)
        kinds: dict[str, tuple[tuple[int, ...], Any]] = {
            "obs": (shape, item),
            "action": (action.shape[1:], chosen),
            "reward": ((), np.float32),
            "kind": ((), np.uint8),
        }
        examples = examples or {}
        kinds |= {name: (x.shape[1:], x.dtype) for name, x in examples.items()}
        if calls:
            kinds["left"] = ((), np.int32)
        each += sum(int(np.prod(s)) * np.dtype(d).itemsize for s, d in kinds.values())
        each += 12 * keep_rewards  # the place of a call's rewards, and at least one of them
        what = f"a replay buffer of {capacity:,} transitions of {shape} {item}"
        check_memory(capacity, each, what, "buffer_size")
        self.num_envs = num_envs
        self.rows = capacity // num_envs + 1
        self.slots = self.rows * num_envs
        # By slot. The first call of several steps adds "steps"; the first mask adds "mask" (bits).
        self.data = {k: np.zeros((self.slots, *s), d) for k, (s, d) in kinds.items()}
        self.newest = np.full(num_envs, -1)
        """(N,) the newest slot of each column, counted from the first in the run."""
        self._column = np.arange(num_envs)
        self._open = np.zeros(num_envs, bool)  # True where the trajectory goes on
        self._choices = choices
        self._keeps_rewards = keep_rewards
        self.raw = (*raw, *examples)
        self._started_raw = tuple(examples)
        # (N,) the places of the first rows of open calls, or of the next ones.
        self._begins = np.zeros(num_envs, np.int64)
        # The rewards of calls one after another; "call" holds the first place of a slot's rewards.
        self._rewards = np.zeros(64 * keep_rewards, np.float32)
        self._rewards_used = 0

    @property
    def nbytes(self) -> int:
        """Number of reserved bytes; unwritten slots take no memory yet."""
        return sum(a.nbytes for a in (*self.data.values(), self._rewards))

    def used(self, first: int = 0, count: int | None = None) -> int:
        """Return the rows written in the longest of ``count`` columns from ``first`` on."""
        last = None if count is None else first + count
        return min(int(self.newest[first:last].max()) + 1, self.rows)

    def add(self, batch: Batch) -> list[tuple[Array, Array]]:
        """Append rows.

        Returns:
            In the order of time, the slots of new transitions and the slots of their successors,
            both (k,). A successor is another transition or a boundary.
        """
        most = self.rows // 2  # a row takes at most two slots
        return [self._add(part) for part in _split_rows(batch, most)]

    def cut(self, columns: Array) -> None:
        """End the open trajectories of ``columns`` (k,), whose environments were reset."""
        if "left" in self.data:
            for column in columns[self._open[columns]]:
                self._close_call(column, self.newest[column] - 1, boundary=True)
        self._open[columns] = False

    def rows_left(self, slot: Array) -> Array:
        """Return how many rows of its call follow each row, so far where the call goes on."""
        column = slot % self.num_envs
        so_far = self.newest[column] - 1 - self.number(slot) // self.num_envs
        left = self.data["left"].take(slot)
        return np.where(left < 0, so_far, left)

    def rows_before(self, slot: Array) -> Array:
        """Return how many rows of its column before each row are still stored, at most."""
        place = self.number(slot) // self.num_envs
        oldest = np.maximum(0, self.newest - self.rows + 1)
        before: Array = place - oldest[slot % self.num_envs]
        return before

    def further(self, slot: Array, rows: Array) -> Array:
        """Return the slots of rows that come ``rows`` later in their columns, or earlier."""
        found: Array = (slot + rows * self.num_envs) % self.slots
        return found

    def after(self, slot: Array) -> Array:
        """Return the next slots of the columns of ``slot``."""
        following: Array = slot + self.num_envs
        following -= self.slots * (following >= self.slots)
        return following

    def number(self, slot: Array) -> Array:
        """Return running numbers of the contents of ``slot``, counted from the run's first slot.

        A number modulo ``slots`` is the slot.
        """
        row = slot // self.num_envs
        laps = (self.newest.take(slot - row * self.num_envs) - row) // self.rows
        number: Array = slot + laps * self.slots
        return number

    def in_order(self) -> tuple[Array, Array]:
        """Return the slots (T, N) of all columns in the order of time, and which hold rows."""
        oldest = np.maximum(0, self.newest - self.rows + 1)
        place = oldest + np.arange(self.used())[:, None]
        slot = place % self.rows * self.num_envs + self._column
        return slot, (place < self.newest) & (self.data["kind"][slot] != NOTHING)

    def reward(self, gamma: Array, slot: Array) -> Array:
        """Return rewards of transitions (P, B), float32; of calls Σγᵏrₖ."""
        if "call" not in self.data:
            return self.data["reward"].take(slot)
        places, steps = self._places(slot.ravel())
        offsets = steps.cumsum() - steps
        power = np.arange(len(places)) - offsets.repeat(steps)
        factor = np.broadcast_to(np.float64(gamma), slot.shape).ravel().repeat(steps)
        each = factor**power * self._rewards.take(places)
        reward: Array = np.add.reduceat(each, offsets).reshape(slot.shape).astype(np.float32)
        return reward

    def power(self, gamma: Array, slot: Array) -> Array:
        """Return γ^τ of transitions (P, B)."""
        if "steps" not in self.data:
            return np.broadcast_to(gamma, slot.shape)
        return np.asarray(gamma ** self.data["steps"].take(slot))

    def mask(self, slot: Array) -> Array | None:
        """Return the actions allowed in ``slot``, (…, A) bool; None: no mask was ever stored."""
        if "mask" not in self.data:
            return None
        bits = self.data["mask"].take(slot, axis=0)
        return np.unpackbits(bits, axis=-1, count=self._choices).view(bool)

    def load(self, state: dict[str, Tensor]) -> None:
        """Restore the arrays that ``written`` of columns with the same arguments returned.

        Raises:
            RunError: the arrays belong to other settings.
        """
        self.data["kind"][:] = NOTHING
        for name in OPTIONAL:
            self.data.pop(name, None)
            if name in state:
                self._start(name)
        for name in self.raw:
            if name.startswith(INFO) and name in state:
                self.data[name] = self.data[name].astype(state[name].numpy().dtype)
            if name in self._started_raw:
                continue
            self.data.pop(name, None)
            if name in state:
                self._start_raw(name, state[name].numpy())
        self._rewards_used = len(state["rewards"]) if "rewards" in state else 0
        self._rewards = np.zeros(max(self._rewards_used, len(self._rewards)), np.float32)
        copy_into({"newest": self.newest}, state)
        copy_into(self.written(), state)

    def written(self) -> dict[str, Array]:
        """Return views of all that was written, by name."""
        used = self.used() * self.num_envs
        views = {name: array[:used] for name, array in self.data.items()}
        if "call" in views:
            views["rewards"] = self._rewards[: self._rewards_used]
        if "left" in views:
            views["begins"] = self._begins
        return views | {"newest": self.newest, "open": self._open}

    def _add(self, rows: Batch) -> tuple[Array, Array]:
        """Append rows that fit into each column at once."""
        data = self.data
        valid = rows.get("valid")
        mask = rows.get("mask")
        next_mask = rows.get("next_mask")
        place = self._claim(rows)
        slots = place % self.rows * self.num_envs + self._column
        slot = slots.ravel() if valid is None else slots[valid]
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
        data["obs"][after] = flat(rows["next_obs"])
        data["kind"][after] = NOTHING
        data["obs"][slot] = flat(rows["obs"])
        data["action"][slot] = flat(rows["action"])
        data["reward"][slot] = flat(rows["reward"])
        if "steps" in data:
            data["steps"][slot] = flat(rows["steps"])
        if "call" in data:
            data["kind"][slot] = NOTHING  # overwritten transitions need their rewards no more
            each = rows["rewards"] if "rewards" in rows else rows["reward"][..., None]
            self._store_rewards(slot, flat(each), flat(rows["steps"]))
        for name in (name for name in self.raw if name in rows):
            if name not in data:
                self._start_raw(name, flat(rows[name]))
            if name.startswith(INFO):
                self._widen(name, rows[name].dtype)
            data[name][slot] = flat(rows[name])
        if "mask" in data:
            for slots, x in (after, next_mask), (slot, mask):
                data["mask"][slots] = 255 if x is None else np.packbits(flat(x), axis=-1)
        data["kind"][slot] = GOES_ON + flat(rows["terminated"])
        if "left" in data:
            data["left"][slot] = -1
            self._close_calls(place, rows)
        return slot, after

    def _close_calls(self, place: Array, rows: Batch) -> None:
        """Store for the rows of calls that are over how many follow; ``place`` as of ``_claim``."""
        ended = rows.ended
        over = ended | (rows["call_end"] != 0)
        if (valid := rows.get("valid")) is not None:
            over &= valid
        for at, column in zip(*np.nonzero(over), strict=True):
            self._close_call(column, place[at, column], boundary=bool(ended[at, column]))

    def _close_call(self, column: int, last: int, *, boundary: bool) -> None:
        """Store for the rows of a column's open call how many follow.

        Args:
            last: the place of its last row.
            boundary: a boundary follows it.
        """
        oldest = self.newest[column] - self.rows + 1  # what is older was overwritten
        places = np.arange(max(self._begins[column], oldest), last + 1)
        self.data["left"][places % self.rows * self.num_envs + column] = last - places
        self._begins[column] = last + 1 + boundary

    def _claim(self, rows: Batch) -> Array:
        """Reserve places (T, N) for the valid rows: running numbers of the rows of each column."""
        valid = rows.get("valid")
        ended = rows.ended
        place = (self.newest + ~self._open)[None]
        if len(ended) > 1:  # a slot for each row before, and for each end before
            before = np.ones_like(ended) if valid is None else valid
            slots_needed = before + (ended & before).astype(np.int64)
            place = place + slots_needed.cumsum(0) - slots_needed
        if valid is None:
            self.newest = place[-1] + 1
            self._open = ~ended[-1]
            return place
        column = np.flatnonzero(valid.any(0))
        last = len(valid) - 1 - valid[::-1, column].argmax(0), column
        self.newest[column] = place[last] + 1
        self._open[column] = ~ended[last]
        return place

    def _start(self, name: str) -> None:
        """Start to store "steps", "mask" or "call".

        Every row so far had 1 step, allowed all actions, and had the reward of one step.
        """
        if name == "steps":
            self.data[name] = np.ones(self.slots, np.float32)
        elif name == "mask":
            self.data[name] = np.full((self.slots, -(-self._choices // 8)), 255, np.uint8)
        else:
            self.data[name] = np.zeros(self.slots, np.int64)
            self._rewards_used = 0
            slots = self.data["kind"].nonzero()[0]
            self._store_rewards(
                slots, self.data["reward"][slots, None], np.ones(len(slots), np.int64)
            )

    def _start_raw(self, name: str, like: Array) -> None:
        """Start to store a raw column, of the shape and type of ``like`` (k, …).

        Raises:
            TrainingError: the column needs more than the free memory.
        """
        each = like.dtype.itemsize * math.prod(like.shape[1:])
        check_memory(self.slots, each, f"the column {name!r} of a replay buffer", "buffer_size")
        self.data[name] = np.zeros((self.slots, *like.shape[1:]), like.dtype)

    def _widen(self, name: str, kind: np.dtype[Any]) -> None:
        """Let a column of ``info`` hold numbers of another type: whole ones first, others later."""
        column = self.data[name]
        if not np.can_cast(kind, column.dtype):
            self.data[name] = column.astype(number_type(np.result_type(kind, column.dtype)))

    def _store_rewards(self, slot: Array, rewards: Array, steps: Array) -> None:
        """Append the rewards (k, longest) of calls of ``steps`` (k,); missing ones are 0."""
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
        """Drop the rewards of overwritten calls; grow if more than half of the room is in use."""
        live = self.data["kind"].nonzero()[0] if self._rewards_used else np.zeros(0, np.int64)
        places, steps = self._places(live)
        size = 1 << (2 * (len(places) + needed) - 1).bit_length()
        if size > len(self._rewards):
            what = f"the replay buffer's room for the rewards of {size:,} steps of calls"
            check_memory(size, 4, what, "buffer_size")
        rewards = np.zeros(max(size, len(self._rewards)), np.float32)
        rewards[: len(places)] = self._rewards[places]
        self.data["call"][live] = steps.cumsum() - steps
        self._rewards = rewards
        self._rewards_used = len(places)

    def _places(self, slot: Array) -> tuple[Array, Array]:
        """Return the places of the rewards of calls (k,), call after call, and their steps (k,)."""
        steps = self.data["steps"].take(slot).astype(np.int64)
        offsets = steps.cumsum() - steps
        first = (self.data["call"].take(slot) - offsets).repeat(steps)
        return first + np.arange(len(first)), steps


def _split_rows(batch: Batch, most: int) -> list[Batch]:
    """Cut a batch into parts of at most ``most`` rows, for the rings of the replay store."""
    rows, _ = batch.lead
    if 0 < rows <= most:
        return [batch]
    return [batch.rows(slice(start, start + most)) for start in range(0, rows, most)]


def copy_into(arrays: dict[str, Array], state: dict[str, Tensor]) -> None:
    """Copy the tensors of a checkpoint into the arrays of a replay store."""
    for name, array in arrays.items():
        into = to_tensor(array)
        stored = state.get(name)
        if stored is None or stored.shape != into.shape or stored.dtype != into.dtype:
            actual = "missing" if stored is None else f"{stored.dtype} {tuple(stored.shape)}"
            raise RunError(
                f"the checkpoint's replay buffer does not fit: {name!r} is {actual}, where "
                f"{into.dtype} {tuple(into.shape)} belongs; continue with the settings that it was "
                "written with, or start a new run"
            )
        into.copy_(stored)
