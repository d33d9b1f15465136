"""The replay store with hindsight: rows are drawn with goals that their calls have reached.

Hindsight experience replay (Andrychowicz et al. 2017, "Hindsight Experience Replay"), in which ends
are relabelled, too: the store holds raw rows, and a ``Judge`` computes rewards and ends anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from torch import Tensor

from skillweave.algorithms.batches import Batch, RawRows, Sample
from skillweave.algorithms.config import Hindsight
from skillweave.buffers.replay import ReplayStore
from skillweave.buffers.replay_storage import NOTHING, TERMINATED
from skillweave.errors import TrainingError
from skillweave.policies.core import Array

CHECKED = 1_000
"""The most rows that are judged again with their own goals, before anything is learnt."""
FEW, SHARE = 2, 0.001
"""Rows that may be judged otherwise than they were: so many, or such a share."""


class Judge(Protocol):
    """A learner's goals, and its reward and ends under other ones."""

    who: str
    """Begins messages."""
    observation_space: gym.Space[Any]
    """The environment's."""
    examples: Mapping[str, Array]
    """The raw columns that it reads, (1, …) by name."""

    def goals(self, rows: RawRows) -> Array:
        """Return the goals that rows (…) had."""
        ...

    def achieved(self, obs: Array) -> Array:
        """Return the goals that observations (k, …) have reached."""
        ...

    def judged(self, rows: RawRows, goal: Array) -> tuple[Array, Array]:
        """Return rewards (k,) float32 under these goals, and where the value ends, (k,) bool."""
        ...

    def check(self, rows: RawRows, goal: Array, *, differ: bool) -> None:
        """Raise an error, or give a notice, where the goals that rows have reached are odd.

        Args:
            differ: rewards or ends are others under these goals than under the rows' own.
        """
        ...

    def seen(self, obs: Array, goal: Array) -> Array:
        """Return observations (…) as the learner sees them, with these goals."""
        ...


class HindsightStore(ReplayStore):
    """A replay store of raw rows, most of which are drawn with a goal that their call reached.

    Args:
        how: the share of such rows, and which goals.
        judge: of the learner.
        others: as of ``ReplayStore``.
    """

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        members: int,
        action: Array,
        how: Hindsight,
        judge: Judge,
        **others: Any,
    ) -> None:
        space = judge.observation_space
        examples = judge.examples
        super().__init__(
            capacity, num_envs, members, space, action, examples=examples, calls=True, **others
        )
        self._how = how
        self._judge = judge
        self._checked = False
        self._compared = 0
        self._wrong = 0

    @property
    def raw(self) -> tuple[str, ...]:
        """The raw columns that are needed."""
        return (*super().raw, "call_end")

    def seen(self, batch: Batch) -> Array:
        """Return the observations (T, N, …) of a batch as the learner sees them."""
        rows = RawRows(batch["obs"], batch["next_obs"], batch)
        return self._judge.seen(rows.obs, self._judge.goals(rows))

    def load(self, state: dict[str, Tensor]) -> None:
        """Restore the ``state`` of a store that was made with the same arguments."""
        super().load(state)
        self._checked = False

    def sample(
        self,
        batch: int,
        gamma: Tensor,
        rngs: Sequence[np.random.Generator],
        beta: float = 1.0,
        first: int = 0,
        progress: float = 0.0,
    ) -> Sample:
        """Draw transitions, see ``ReplayStore.sample``, and judge them again.

        Raises:
            TrainingError: rows with their own goals are judged otherwise than they were.
        """
        if not self._checked:
            self._check()
            self._checked = True
        index, _ = self._draw(batch, rngs, beta, first)
        shape = index.shape
        slot = (index % self._columns.slots).ravel()
        chance = np.stack([rng.random((2, batch)) for rng in rngs], axis=1).reshape(2, -1)
        rows = self._rows(slot)
        goal = self._judge.goals(rows)
        other = chance[0] < self._how.share
        if other.any():
            later = self._later(slot[other], chance[1][other])
            obs = self._columns.data["obs"]
            goal[other] = self._judge.achieved(obs.take(self._columns.after(later), axis=0))
        # All are judged, so that rows with their own goals show where something has changed.
        reward, ends = self._judge.judged(rows, goal)
        self._compare(slot[~other], reward[~other], ends[~other])
        action = self._columns.data["action"].take(slot, axis=0)
        if action.dtype.kind in "iu":
            action = action.astype(np.int64)
        env_reward = rows.columns.get("env_reward")

        def tensor(x: Array) -> Tensor:
            return self._tensor(x.reshape(*shape, *x.shape[1:]))

        return Sample(
            obs=tensor(self._judge.seen(rows.obs, goal)),
            action=tensor(action),
            reward=tensor(reward),
            discount=self._tensor(gamma.float().cpu().numpy()[:, None] * ~ends.reshape(shape)),
            next_obs=tensor(self._judge.seen(rows.next_obs, goal)),
            mask=self._mask(slot.reshape(shape)),
            next_mask=self._mask(self._columns.after(slot).reshape(shape)),
            weight=None,
            index=index,
            env_reward=None if env_reward is None else tensor(env_reward),
            progress=progress,
        )

    def _rows(self, slot: Array) -> RawRows:
        """Return the raw rows of slots (k,)."""
        columns = self._columns
        data = columns.data
        raw = {name: data[name].take(slot, axis=0) for name in columns.raw if name in data}
        after = columns.after(slot)
        return RawRows(data["obs"].take(slot, axis=0), data["obs"].take(after, axis=0), raw)

    def _later(self, slot: Array, chance: Array) -> Array:
        """Return slots of rows of the same calls, in which the goals are reached; both (k,).

        Args:
            chance: (k,) in [0, 1).
        """
        columns = self._columns
        left = columns.rows_left(slot)
        kind = self._how.goal_selection_strategy
        if kind == "final":
            return columns.further(slot, left)
        before = np.zeros_like(left)
        if kind == "episode":
            elapsed = columns.data["call_elapsed"].take(slot)
            before = np.minimum(elapsed - 1, columns.rows_before(slot))
        drawn = np.floor(chance * (before + left + 1)).astype(np.int64)
        return columns.further(slot, drawn - before)

    def _check(self) -> None:
        """Judge stored rows again before anything is learnt, with their own goals and others.

        Raises:
            TrainingError: they are judged otherwise than they were.
        """
        filled = np.flatnonzero(self._columns.data["kind"] != NOTHING)
        slot = filled[:: -(-len(filled) // CHECKED)]
        rows = self._rows(slot)
        reward, ends = self._judge.judged(rows, self._judge.goals(rows))
        self._compare(slot, reward, ends)
        reached = self._judge.achieved(rows.next_obs)
        other, other_ends = self._judge.judged(rows, reached)
        differ = bool((other != reward).any() or (other_ends != ends).any())
        self._judge.check(rows, reached, differ=differ)

    def _compare(self, slot: Array, reward: Array, ends: Array) -> None:
        """Raise a TrainingError where too many rows (k,) are judged otherwise than they were.

        Observations may be rounder than what the environment computed with: rewards may differ a
        little, and a few rows at the edge of a goal wholly.
        """
        given = self._columns.data["reward"].take(slot)
        ended = self._columns.data["kind"].take(slot) == TERMINATED
        size = np.abs(given).max(initial=0.01)
        differ = ~np.isclose(reward, given, rtol=1e-4, atol=1e-4 * size)
        wrong = differ | (ends != ended)
        self._compared += len(slot)
        self._wrong += int(wrong.sum())
        if not wrong.any() or self._wrong <= max(FEW, self._compared * SHARE):
            return
        at = int(wrong.argmax())
        what, now, then = ("reward", reward, given) if differ[at] else ("end", ends, ended)
        raise TrainingError(
            f"{self._judge.who}: hindsight judges past steps again, but {self._wrong:,} of "
            f"{self._compared:,} are judged otherwise than they were (the {what} of one is now "
            f"{now[at].item():g}, and was {then[at].item():g}): this must depend on the step and "
            "the goal alone. Perhaps it draws, keeps a state, or is changed by a wrapper, or the "
            "environment shows the next goal already"
        )
