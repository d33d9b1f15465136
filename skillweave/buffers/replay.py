"""The replay store: transitions that are sampled at random, again and again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.batches import Batch, Sample
from skillweave.buffers.priorities import Priorities
from skillweave.buffers.replay_storage import NOTHING, TERMINATED, Columns, copy_into
from skillweave.policies.core import Array
from skillweave.spaces import to_tensor


class ReplayStore:
    """Transitions that are sampled at random; new ones replace the oldest.

    The store has N = P·B columns as in ``Batch``. A member draws from its own columns, or with
    ``shared`` from all; each has its own γ. Every end of a trajectory takes the room of a
    transition. A store that is made only to check that it fits costs nothing: unwritten slots take
    no memory.

    Args:
        capacity: transitions of all columns together.
        num_envs: N.
        members: P.
        action: an example of actions, (1, …).
        choices: number of discrete actions; 0: actions are numbers, or have no masks.
        shared: each member learns from the experience of all.
        n_step, prioritized, alpha: settings of sampling (Schaul et al. 2016).
        between: samples hold the observations between the n steps, too.
        raw: raw columns that are stored; a sample has those that are among its fields.
        examples, calls: see ``Columns``.
        device: of the samples.

    Raises:
        TrainingError: the store is larger than the free memory.
        DeclarationError: the store is smaller than one row.
    """

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        members: int,
        observation_space: gym.Space[Any],
        action: Array,
        *,
        choices: int = 0,
        shared: bool = False,
        n_step: int = 1,
        prioritized: bool = False,
        alpha: float = 0.6,
        between: bool = False,
        raw: Sequence[str] = (),
        examples: Mapping[str, Array] | None = None,
        calls: bool = False,
        device: str | torch.device = "cpu",
    ) -> None:
        each = 4 * prioritized * (members if shared else 1)
        self._columns = Columns(
            capacity,
            num_envs,
            observation_space,
            action,
            choices,
            each,
            shared,
            raw,
            examples,
            calls,
        )
        self.num_envs = num_envs
        self._n_step = n_step
        self._between = between and n_step > 1
        self._device = torch.device(device)
        self._members = members
        self._shared = shared
        # The number of columns that a member draws from, and the first of them.
        self._width = num_envs if shared else num_envs // members
        self._offset = np.arange(members) * (0 if shared else self._width)
        places = self._columns.rows * self._width
        self._priorities = Priorities(members, places, alpha) if prioritized else None

    def __len__(self) -> int:
        """Return the number of transitions in all columns."""
        return int((self._columns.data["kind"] != NOTHING).sum())

    @property
    def raw(self) -> tuple[str, ...]:
        """The raw columns that are stored."""
        return self._columns.raw

    def seen(self, batch: Batch) -> tuple[Array, Array | None]:
        """Return a batch's observations (T, N, …) as the learner sees them, and which count.

        The latter are (T, N) bool; None: all count.
        """
        return batch["obs"], batch.get("valid")

    @property
    def ready(self) -> bool:
        """True if every member has a transition to sample."""
        return bool((self._columns.newest >= 0).reshape(-1, self._width).any(1).all())

    @property
    def nbytes(self) -> int:
        """Number of reserved bytes; unwritten slots take no memory yet."""
        return self._columns.nbytes + (self._priorities.nbytes if self._priorities else 0)

    def add(self, batch: Batch) -> None:
        """Append copies of a batch's rows to their columns."""
        for slot, after in self._columns.add(batch):
            if self._priorities is not None:
                # The last value of a repeated slot counts: a successor may be a transition.
                member, place = self._places(np.concatenate([after, slot]))
                new = np.arange(len(place)) % (2 * len(slot)) >= len(after)
                self._priorities.set_new(member, place, new)

    def cut(self, columns: Array) -> None:
        """End the open trajectories of ``columns`` (k,), whose environments were reset."""
        self._columns.cut(columns)

    def sample(
        self,
        batch: int,
        gamma: Tensor,
        rngs: Sequence[np.random.Generator],
        beta: float = 1.0,
        first: int = 0,
        progress: float = 0.0,
    ) -> Sample:
        """Draw ``batch`` transitions for each member from ``first`` on, one for each generator.

        Args:
            gamma: (P,), the members' discounts.
            beta: exponent of the importance weights that correct the preference of priorities.
            progress: of the ``Sample``.
        """
        return self.at(*self._draw(batch, rngs, beta, first), gamma, progress)

    def at(
        self, index: Array, weight: Array | None, gamma: Tensor, progress: float = 0.0
    ) -> Sample:
        """Return the transitions ``index`` (P, B), perhaps from a sample of another store."""
        columns = self._columns
        data = self._columns.data
        factor = gamma.float().cpu().numpy()[:, None]
        slot = start = index % columns.slots
        goes_on = np.ones(start.shape, bool)
        reward, discount = columns.reward(factor, start), columns.power(factor, start)
        between: list[tuple[Array, Array]] = []
        for _ in range(1, self._n_step):
            after = columns.after(slot)
            goes_on = goes_on & (data["kind"].take(after) != NOTHING)
            slot = np.where(goes_on, after, slot)
            between.append((slot, np.where(goes_on, discount, np.float32(0))))
            paid = discount * columns.reward(factor, slot)
            reward = reward + np.where(goes_on, paid, np.float32(0))
            discount = np.where(goes_on, discount * columns.power(factor, slot), discount)
        after = columns.after(slot)
        terminated = data["kind"].take(slot) == TERMINATED
        action = data["action"].take(start, axis=0)
        env_reward = data.get("env_reward")
        return Sample(
            obs=self._tensor(data["obs"].take(start, axis=0)),
            action=self._tensor(action.astype(np.int64) if action.dtype.kind in "iu" else action),
            reward=self._tensor(reward),
            discount=self._tensor(discount * ~terminated),
            next_obs=self._tensor(data["obs"].take(after, axis=0)),
            mask=self._mask(start),
            next_mask=self._mask(after),
            weight=None if weight is None else self._tensor(weight),
            index=index,
            env_reward=None if env_reward is None else self._tensor(env_reward.take(start)),
            progress=progress,
            **self._between_fields(between),
        )

    def update_priorities(self, index: Array, priority: Tensor, first: int = 0) -> None:
        """Set the priorities (P, B), above 0, of the samples of members from ``first`` on."""
        if self._priorities is not None:
            slot = index % self._columns.slots
            # Transitions that were overwritten since are skipped.
            stored = (self._columns.number(slot) == index).nonzero()
            row, column = np.divmod(slot[stored], self._columns.num_envs)
            place = row * self._width + column - self._offset[first + stored[0]]
            new = priority.detach().float().cpu().numpy()[stored]
            self._priorities.update(first + stored[0], place, new)

    def inherit(self, parents: Array) -> None:
        """Copy to each member the priorities of its parent (P,)."""
        if self._priorities is not None:
            self._priorities.inherit(parents)

    def state(self) -> dict[str, Tensor]:
        """Return copies of all that was written, to continue exactly; see ``load``."""
        written = self._columns.written() | self._written_priorities()
        return {name: to_tensor(array.copy()) for name, array in written.items()}

    def load(self, state: dict[str, Tensor]) -> None:
        """Restore the ``state`` of a store that was made with the same arguments.

        Raises:
            RunError: the state belongs to other settings.
        """
        self._columns.load(state)
        if self._priorities is not None:
            self._priorities.forget()
            copy_into(self._written_priorities(), state)
            self._priorities.rebuild()

    def _written_priorities(self) -> dict[str, Array]:
        if self._priorities is None:
            return {}
        return self._priorities.written(self._columns.used() * self._width)

    def _places(self, slot: Array) -> tuple[Array, Array]:
        """Return the members that draw from slots (k,), and the slots in their own numbering.

        With ``shared``, for all members in turn.
        """
        if self._shared:
            return np.repeat(np.arange(self._members), len(slot)), np.tile(slot, self._members)
        row, column = np.divmod(slot, self._columns.num_envs)
        return column // self._width, row * self._width + column % self._width

    def _draw(
        self, batch: int, rngs: Sequence[np.random.Generator], beta: float, first: int
    ) -> tuple[Array, Array | None]:
        """Draw transitions (P, B), as running numbers since the first, and their weights."""
        if self._priorities is None:
            members = range(first, first + len(rngs))
            drawn = [self._uniform(batch, r, p) for r, p in zip(rngs, members, strict=True)]
            return self._columns.number(np.stack(drawn)), None
        assert self.ready, "sample() before add()"
        uniform = np.stack([rng.random(batch) for rng in rngs])
        place, weight = self._priorities.draw(uniform, beta, first)
        slot = place + place // self._width * (self._columns.num_envs - self._width)
        slot += self._offset[first : first + len(rngs), None]
        return self._columns.number(slot), weight

    def _uniform(self, batch: int, rng: np.random.Generator, member: int) -> Array:
        """Draw transitions (B,) of a member uniformly: slots are drawn until B hold one."""
        columns = self._columns
        first = self._offset[member]
        surplus = 1.1
        candidates = columns.used(first, self._width) * self._width
        assert candidates, "sample() before add()"
        drawn = np.zeros(0, np.int64)
        while len(drawn) < batch:
            slot = rng.integers(candidates, size=int(surplus * (batch - len(drawn))) + 8)
            if self._width < columns.num_envs:
                slot += slot // self._width * (columns.num_envs - self._width) + first
            slot = slot[columns.data["kind"].take(slot) != NOTHING]
            drawn = np.concatenate([drawn, slot]) if len(drawn) else slot
            surplus *= 2  # where some columns are nearly empty
        return drawn[:batch]

    def _between_fields(self, between: list[tuple[Array, Array]]) -> dict[str, Any]:
        """Return the observations between the n steps, at slots (P, B), with their discounts."""
        if not self._between:
            return {}
        slots, discounts = (np.stack(each, -1) for each in zip(*between, strict=True))
        return {
            "between_obs": self._tensor(self._columns.data["obs"].take(slots, axis=0)),
            "between_mask": self._mask(slots),
            "between_discount": self._tensor(discounts),
        }

    def _mask(self, slot: Array) -> Tensor | None:
        mask = self._columns.mask(slot)
        return None if mask is None else self._tensor(mask)

    def _tensor(self, array: Array) -> Tensor:
        tensor = to_tensor(array)
        return tensor if self._device.type == "cpu" else tensor.to(self._device)
