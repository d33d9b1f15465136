"""The replay store of raw rows: what is drawn is judged again, for hindsight and shared replay.

The store holds what the environment did, and a ``Judge`` computes rewards and ends anew: under
goals that were reached (hindsight experience replay, Andrychowicz et al. 2017), and of steps that
other skills have made (scheduled auxiliary control, Riedmiller et al. 2018).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from torch import Tensor

from skillweave.algorithms.batches import Batch, RawRows, Sample
from skillweave.algorithms.config import Hindsight
from skillweave.buffers.replay import ReplayStore
from skillweave.buffers.replay_storage import NOTHING, TERMINATED, Columns
from skillweave.errors import TrainingError
from skillweave.policies.core import Array
from skillweave.spaces import to_tensor

CHECKED = 1_000
"""The most own rows that are judged again at once, to compare with what was paid."""
FEW, SHARE = 2, 0.001
"""Rows that may be judged otherwise than they were: so many, or such a share."""
PIECE = 1 << 26
"""Bytes of observations that are taken over at once from another skill's rows."""
OWN_COLUMNS = ("action", "reward", "goal", "own")
"""The columns that are a learner's alone."""


class Judge(Protocol):
    """A learner's own form of raw rows: its goals, its reward and ends, its part of all."""

    who: str
    """Begins messages."""
    observation_space: gym.Space[Any]
    """The environment's."""
    examples: Mapping[str, Array]
    """The raw columns that it reads, (1, …) by name."""
    choices: int
    """The numbers of the environment's action mask."""

    def goals(self, rows: RawRows) -> Array | None:
        """Return the goals that rows (…) had; None: it has none."""
        ...

    def practised(self, obs: Array, rng: np.random.Generator) -> Array:
        """Return goals to practise in observations (k, …)."""
        ...

    def achieved(self, obs: Array) -> Array:
        """Return the goals that observations (k, …) have reached."""
        ...

    def judged(self, rows: RawRows, goal: Array | None) -> tuple[Array, Array]:
        """Return rewards (k,) float32 under these goals, and where the value ends, (k,) bool."""
        ...

    def check(self, rows: RawRows, goal: Array, *, differ: bool) -> None:
        """Raise an error, or give a notice, where the goals that rows have reached are odd.

        Args:
            differ: rewards or ends are others under these goals than under the rows' own.
        """
        ...

    def check_shared(self, rows: RawRows, goal: Array | None) -> None:
        """Raise an error where steps of others cannot be judged."""
        ...

    def seen(self, obs: Array, goal: Array | None) -> Array:
        """Return observations (…) as the learner sees them, with these goals."""
        ...

    def mask(self, mask: Array | None) -> Array | None:
        """Return the learner's part of the environment's action masks (…, A)."""
        ...

    def action(self, env_action: Array) -> tuple[Array, Array]:
        """Return the environment's actions (k, …) as the learner's, and which are, (k,) bool."""
        ...


class JudgedStore(ReplayStore):
    """A replay store of raw rows, which are judged when they are drawn.

    Args:
        hindsight: draws rows with a goal that their call has reached; None: with their own alone.
        of_others: the share of drawn rows that other skills have made.
        judge: of the learner.
        more: as of ``ReplayStore``.
    """

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        members: int,
        action: Array,
        hindsight: Hindsight | None,
        of_others: float,
        judge: Judge,
        **more: Any,
    ) -> None:
        space = judge.observation_space
        examples = dict(judge.examples)
        if of_others:
            examples["own"] = np.zeros(1, bool)
        super().__init__(
            capacity,
            num_envs,
            members,
            space,
            action,
            choices=judge.choices,
            examples=examples,
            calls=True,
            **more,
        )
        self._hindsight = hindsight
        self._of_others = of_others
        self._judge = judge
        self._draws = 0
        self._compared = 0
        self._wrong = 0

    @property
    def raw(self) -> tuple[str, ...]:
        """The raw columns that are needed."""
        return (*super().raw, "call_end")

    def seen(self, batch: Batch) -> tuple[Array, Array | None]:
        """Return a batch's observations as the learner sees them; see ``ReplayStore.seen``.

        Those of others are among them, unless goals belong to them, which are drawn later.
        """
        rows = RawRows(batch["obs"], batch["next_obs"], batch)
        goals = self._judge.goals(rows)
        counts = batch.own_rows if "own" in batch and goals is not None else batch.get("valid")
        return self._judge.seen(rows.obs, goals), counts

    def load(self, state: dict[str, Tensor]) -> None:
        """Restore the ``state`` of a store that was made with the same arguments."""
        super().load(state)
        self._draws = 0

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
            TrainingError: own rows with their own goals are judged otherwise than they were.
        """
        self._draws += 1
        # At the first, second, fourth, … draw: later steps may be judged by other lines.
        checks = self._draws & (self._draws - 1) == 0
        if checks:
            self._check()
        index = self._drawn(batch, rngs, beta, first)
        shape = index.shape
        slot = (index % self._columns.slots).ravel()
        rows = self._rows(slot)
        own = rows.columns["own"] if self._of_others else np.ones(len(slot), bool)
        goal, given = self._goals(rows, slot, own, rngs)
        # All are judged, so that own rows with their own goals show where something has changed.
        reward, ends = self._judge.judged(rows, goal)
        if checks and self._of_others:
            self._judge.check_shared(rows, goal)
        self._compare(slot[given], reward[given], ends[given])
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

    def shared_rows(self) -> dict[str, Tensor]:
        """Return copies of the learner's own rows, without what is its alone; see ``begin_with``.

        {}: it has none.
        """
        columns = self._columns
        slot, stored = columns.in_order()
        own = stored & columns.data["own"][slot]
        if not own.any():
            return {}
        first = int(own.any(axis=1).argmax())  # those of others were there before
        data = {k: x[slot[first:].ravel()] for k, x in columns.data.items() if k not in OWN_COLUMNS}
        data["kind"][~own[first:].ravel()] = NOTHING
        oldest = np.maximum(0, columns.newest - columns.rows + 1)
        data["newest"] = columns.newest - oldest - first
        return {name: to_tensor(x) for name, x in data.items()}

    def begin_with(self, shared: Mapping[str, Tensor]) -> Iterator[Batch]:
        """Add the ``shared_rows`` of another skill; yield what is stored.

        Raises:
            RunError: they are not of such a store.
        """
        theirs = self._columns_of(shared)
        data = theirs.data
        slot, stored = theirs.in_order()
        action, possible = self._judge.action(data["env_action"][slot.ravel()])
        valid = stored & possible.reshape(stored.shape)
        terminated = valid & data["env_terminated"][slot]
        truncated = valid & ~terminated
        truncated[:-1] &= (data["kind"][theirs.after(slot[:-1])] == NOTHING) | ~valid[1:]
        rows = max(1, PIECE // data["obs"][: theirs.num_envs].nbytes)
        for begin in range(0, len(slot), rows):
            part = slice(begin, begin + rows)
            at = slot[part]
            raw = {name: data[name][at] for name in self.raw if name in data}
            if "goal" in self._judge.examples:
                none = self._judge.examples["goal"]
                raw["goal"] = np.broadcast_to(none, (*at.shape, *none.shape[1:]))
            after = theirs.after(at)
            batch = Batch(
                obs=data["obs"][at],
                action=action.reshape(*slot.shape, *action.shape[1:])[part],
                reward=np.zeros(at.shape, np.float32),
                steps=np.ones(at.shape, np.int64),
                terminated=terminated[part],
                truncated=truncated[part],
                next_obs=data["obs"][after],
                valid=valid[part],
                mask=theirs.mask(at),
                next_mask=theirs.mask(after),
                call_end=(data["left"][at] == 0).astype(np.int8),
                **(raw | {"own": np.zeros(at.shape, bool)}),
            )
            self.add(batch)
            yield batch

    def add_recorded(self, rows: Batch, rng: np.random.Generator) -> Batch:
        """Add rows that were recorded elsewhere; return them as the learner judges them.

        Args:
            rows: raw columns; ``valid`` where there is a step, ``call_end`` where an episode ends.
            rng: draws the goals that a skill practises there.

        Raises:
            SkillweaveError: the learner cannot judge them.
        """
        lead = rows["valid"].shape
        env_action = rows["env_action"].reshape(-1, *rows["env_action"].shape[2:])
        action, possible = self._judge.action(env_action)
        valid = rows["valid"] & possible.reshape(lead)
        terminated = valid & rows["env_terminated"]
        over = rows["call_end"] != 0
        over[:-1] |= ~valid[1:]
        over[-1] = True
        added = rows.replace(
            action=action.reshape(*lead, *action.shape[1:]),
            reward=np.zeros(lead, np.float32),
            steps=np.ones(lead, np.int64),
            terminated=terminated,
            truncated=valid & over & ~terminated,
            valid=valid,
            own=np.zeros(lead, bool),
        )
        goal, reward, ends = self._judged_at_once(added, rng)
        if goal is not None and "goal" in self._judge.examples:
            added = added.replace(goal=goal)
        self.add(added)
        return added.replace(
            obs=self._judge.seen(rows["obs"], goal),
            own=None,
            reward=reward,
            terminated=valid & ends,
            truncated=added["truncated"] & ~ends,
        )

    def _judged_at_once(
        self, rows: Batch, rng: np.random.Generator
    ) -> tuple[Array | None, Array, Array]:
        """Return goals to practise, rewards and ends of all rows (T, N), a piece at a time."""
        count, _ = rows["valid"].shape
        most = max(1, PIECE // max(1, rows["obs"][0].nbytes))
        goals, rewards, ends = list[Any](), list[Array](), list[Array]()
        for begin in range(0, count, most):
            part = {name: x[begin : begin + most] for name, x in rows.items()}
            lead = part["valid"].shape

            def flat(x: Array) -> Array:
                return x.reshape(-1, *x.shape[2:])

            columns = {name: flat(x) for name, x in part.items()}
            columns |= {
                name: np.repeat(example, len(columns["valid"]), axis=0)
                for name, example in self._judge.examples.items()
                if name not in columns
            }
            raw = RawRows(columns["obs"], columns["next_obs"], columns)
            goal = self._judge.goals(raw)
            if goal is not None:
                goal = self._judge.practised(raw.obs, rng)
                goals.append(goal.reshape(*lead, *goal.shape[1:]))
            reward, end = self._judge.judged(raw, goal)
            rewards.append(reward.reshape(lead))
            ends.append(end.reshape(lead))
        goal = np.concatenate(goals) if goals else None
        return goal, np.concatenate(rewards), np.concatenate(ends)

    def _columns_of(self, shared: Mapping[str, Tensor]) -> Columns:
        """Return storage that holds the ``shared_rows`` of another store."""
        (num_envs,) = shared["newest"].shape
        rows = len(shared["kind"]) // num_envs
        examples = {k: x for k, x in self._judge.examples.items() if k not in OWN_COLUMNS}
        space, choices = self._judge.observation_space, self._judge.choices
        action = np.zeros(1, np.int64)
        columns = Columns(
            (rows - 1) * num_envs, num_envs, space, action, choices, 0, False, (), examples, True
        )
        rest = columns.written() | columns.data  # what is a learner's alone stays empty
        columns.load({name: to_tensor(x) for name, x in rest.items()} | dict(shared))
        return columns

    def _drawn(
        self, batch: int, rngs: Sequence[np.random.Generator], beta: float, first: int
    ) -> Array:
        """Draw transitions (P, B), as running numbers; a share of them of other skills."""
        columns = self._columns
        others: Array = np.zeros(0, np.int64)
        if self._of_others:
            used = columns.used() * columns.num_envs
            stored, own = (columns.data[name][:used] for name in ("kind", "own"))
            others = np.flatnonzero((stored != NOTHING) & ~own)
        if not len(others):
            return self._draw(batch, rngs, beta, first)[0]
        mine = np.flatnonzero((stored != NOTHING) & own)
        (rng,) = rngs  # a population shares nothing
        theirs = rng.random(batch) < (self._of_others if len(mine) else 1.0)
        slot = others[rng.integers(len(others), size=batch)]
        if len(mine):
            slot = np.where(theirs, slot, mine[rng.integers(len(mine), size=batch)])
        return columns.number(slot[None])

    def _goals(
        self, rows: RawRows, slot: Array, own: Array, rngs: Sequence[np.random.Generator]
    ) -> tuple[Array | None, Array]:
        """Return the goals of drawn rows (k,), and which are own rows with the goal they had.

        Args:
            slot: (k,) of the rows, those of the first generator first.
            own: (k,) bool, of the learner itself.
        """
        goal = self._judge.goals(rows)
        if goal is None:
            return None, own
        if not own.all():
            (rng,) = rngs
            goal[~own] = self._judge.practised(rows.obs[~own], rng)
        if self._hindsight is None:
            return goal, own
        batch = len(slot) // len(rngs)
        chance = np.stack([rng.random((2, batch)) for rng in rngs], axis=1).reshape(2, -1)
        other = chance[0] < self._hindsight.share
        if other.any():
            later = self._later(self._hindsight, slot[other], chance[1][other])
            obs = self._columns.data["obs"]
            goal[other] = self._judge.achieved(obs.take(self._columns.after(later), axis=0))
        return goal, own & ~other

    def _mask(self, slot: Array) -> Tensor | None:
        mask = self._judge.mask(self._columns.mask(slot))
        return None if mask is None else self._tensor(mask)

    def _rows(self, slot: Array) -> RawRows:
        """Return the raw rows of slots (k,)."""
        columns = self._columns
        data = columns.data
        raw = {name: data[name].take(slot, axis=0) for name in columns.raw if name in data}
        after = columns.after(slot)
        return RawRows(data["obs"].take(slot, axis=0), data["obs"].take(after, axis=0), raw)

    def _later(self, how: Hindsight, slot: Array, chance: Array) -> Array:
        """Return slots of rows of the same calls, in which the goals are reached; both (k,).

        Args:
            chance: (k,) in [0, 1).
        """
        columns = self._columns
        left = columns.rows_left(slot)
        kind = how.goal_selection_strategy
        if kind == "final":
            return columns.further(slot, left)
        before = np.zeros_like(left)
        if kind == "episode":
            elapsed = columns.data["call_elapsed"].take(slot)
            before = np.minimum(elapsed - 1, columns.rows_before(slot))
        drawn = np.floor(chance * (before + left + 1)).astype(np.int64) - before
        later = columns.further(slot, drawn)
        # Steps that a skill could not have made were left out, so it may be of another call.
        same = columns.rows_left(later) == left - drawn
        return np.where(same, later, slot)

    def _check(self) -> None:
        """Judge own rows again with their own goals, and before anything is learnt with others.

        Raises:
            TrainingError: they are judged otherwise than they were.
        """
        data = self._columns.data
        own = data["own"] if self._of_others else True
        filled = np.flatnonzero((data["kind"] != NOTHING) & own)
        if not len(filled):
            return
        slot = filled[:: -(-len(filled) // CHECKED)]
        rows = self._rows(slot)
        goals = self._judge.goals(rows)
        reward, ends = self._judge.judged(rows, goals)
        self._compare(slot, reward, ends)
        if self._hindsight is not None and self._draws == 1:
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
            f"{self._judge.who}: its algorithm judges past steps again, but {self._wrong:,} of "
            f"{self._compared:,} are judged otherwise than they were (the {what} of one is now "
            f"{now[at].item():g}, and was {then[at].item():g}): this must depend on the step and "
            "the goal alone. Perhaps it draws, keeps a state, or is changed by a wrapper, or the "
            "environment shows the next goal already"
        )
