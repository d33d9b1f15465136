"""How many rows of its call follow a stored row, against plain lists."""

from __future__ import annotations

import numpy as np
import pytest
from plain_replay import SPACE

from skillweave.algorithms.batches import Batch
from skillweave.buffers.replay_storage import NOTHING, Columns
from skillweave.spaces import to_tensor


class Lists:
    """Columns of a store, and beside them lists of rows (tag, call), None behind ends."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.n = int(self.rng.integers(1, 4))
        capacity = int(self.rng.integers(self.n, 40))
        self.columns = Columns(
            capacity, self.n, SPACE, np.zeros(1, np.int64), 0, 0, False, (), calls=True
        )
        self.lists: list[list] = [[] for _ in range(self.n)]
        self.begins = [True] * self.n
        self.call = [0] * self.n
        self.tag = 0.0

    def cut(self) -> None:
        """Some environments are reset."""
        some = np.flatnonzero(self.rng.random(self.n) < 0.5)
        self.columns.cut(some)
        for c in some:
            if not self.begins[c]:
                self.call[c] += 1
            self.begins[c] = True

    def add(self) -> None:
        """Some rows; calls may end where trajectories go on."""
        rng, shape = self.rng, (int(self.rng.integers(1, 5)), self.n)
        valid = rng.random(shape) < rng.choice([0.5, 1.0])
        ended = rng.random(shape) < 0.15
        over = ended | (rng.random(shape) < 0.2)
        tags = np.zeros((*shape, 2), np.float32)
        for t, c in zip(*np.nonzero(valid), strict=True):
            self.tag += 1
            tags[t, c] = self.tag
            if not self.begins[c]:
                self.lists[c].pop()
            self.lists[c] += [(self.tag, self.call[c]), None]
            self.begins[c] = bool(ended[t, c])
            self.call[c] += bool(over[t, c])
        terminated = ended & (rng.random(shape) < 0.5)
        self.columns.add(
            Batch(
                obs=tags,
                next_obs=tags + 0.5,
                action=np.zeros(shape, np.int64),
                reward=np.zeros(shape, np.float32),
                steps=np.ones(shape, np.int64),
                terminated=terminated,
                truncated=ended & ~terminated,
                call_end=over.astype(np.int8),
                valid=None if valid.all() else valid,
            )
        )

    def check(self) -> int:
        """Compare all that is stored; return how many rows that is."""
        columns = self.columns
        slots = np.flatnonzero(columns.data["kind"] != NOTHING)
        left, before = columns.rows_left(slots), columns.rows_before(slots)
        for slot, found, earlier in zip(slots.tolist(), left, before, strict=True):
            rows = self.lists[slot % self.n]
            stored = rows[-columns.rows :]
            tag = columns.data["obs"][slot, 0]
            at = next(i for i, row in enumerate(stored) if row is not None and row[0] == tag)
            later = [r for r in stored[at + 1 :] if r is not None and r[1] == stored[at][1]]
            assert found == len(later)
            assert earlier == at
            for k, row in enumerate(later, 1):
                assert columns.data["obs"][columns.further(slot, np.int64(k)), 0] == row[0]
        return len(slots)


@pytest.mark.parametrize("seed", range(40))
def test_the_rows_that_follow_in_a_call_are_those_of_plain_lists(seed: int) -> None:
    lists = Lists(seed)
    seen = 0
    for _ in range(40):
        lists.cut() if lists.rng.random() < 0.15 else lists.add()
        if lists.tag:
            seen += lists.check()
    again = Columns(
        (lists.columns.rows - 1) * lists.n,
        lists.n,
        SPACE,
        np.zeros(1, np.int64),
        0,
        0,
        False,
        (),
        calls=True,
    )

    again.load({k: to_tensor(v.copy()) for k, v in lists.columns.written().items()})
    lists.columns = again  # a run that is resumed
    for _ in range(10):
        lists.add()
        seen += lists.check()
    assert seen
