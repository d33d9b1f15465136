"""The replay store: transitions to be sampled at random, again and again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import DTypeLike
from torch import Tensor

from skillweave.buffers.columns import NOTHING, TERMINATED, Columns, copy_into
from skillweave.buffers.priorities import Priorities
from skillweave.errors import TrainingError
from skillweave.experience import Batch, Sample
from skillweave.spaces import ActionCodec, to_tensor
from skillweave.types import Array


class Relabel(Protocol):
    """Judges rows again when they are drawn, in place of what they were judged when stored."""

    raw: tuple[str, ...]
    """The raw columns of ``SCHEMA`` that it needs."""

    def __call__(self, rows: Batch) -> Batch:
        """Return rows (P·B, n) with other ``reward``, ``terminated`` and ``truncated``."""
        ...


class _Settings(Protocol):
    """What a store needs of an off-policy algorithm's settings."""

    @property
    def buffer_size(self) -> int: ...
    @property
    def n_step(self) -> int: ...
    @property
    def prioritized(self) -> bool: ...
    @property
    def priority_alpha(self) -> float: ...


def replay_store(
    config: _Settings,
    codec: ActionCodec,
    observation_space: gym.Space[Any],
    num_envs: int,
    members: int = 1,
    *,
    shared: bool = False,
    between: bool = False,
    raw: Sequence[str] = (),
    relabel: Relabel | None = None,
    device: str | torch.device = "cpu",
) -> ReplayStore:
    """An empty replay store as an algorithm's settings ask for.

    To make one only to see whether it fits costs nothing: what is not written takes no memory.

    Args:
        num_envs: of all members together.
        shared: members learn from what all did; ``buffer_size`` is then that of all together.
        between, raw: as ``OffPolicyAlgorithm`` says.
        relabel: judges transitions again when they are drawn.

    Raises:
        TrainingError: it is larger than the machine's memory.
        DeclarationError: it holds not even one row.
    """
    return ReplayStore(
        config.buffer_size * (1 if shared else members),
        num_envs,
        members,
        observation_space,
        () if codec.discrete else (codec.size,),
        np.int64 if codec.discrete else np.float32,
        mask_size=codec.size if codec.discrete else None,
        shared=shared,
        n_step=config.n_step,
        prioritized=config.prioritized,
        alpha=config.priority_alpha,
        between=between,
        raw=raw,
        relabel=relabel,
        device=device,
    )


class ReplayStore:
    """Filled with experience and sampled at random; the oldest transitions make room.

    N = P·B columns as in ``Batch``. Members see their own columns, or with ``shared`` all;
    each has its own γ. Every end of a trajectory takes the room of a transition.

    Args:
        capacity: transitions of all columns together.
        mask_size: number of discrete actions.
        n_step, prioritized, alpha: how it is sampled (Schaul et al. 2016).
        between: samples hold the observations between the n steps, too.
        raw: raw columns that are kept, and of which samples have those that they name.
        relabel: judges transitions again when they are drawn; None: they keep the reward and the
            ends that they were stored with. Only for rows of one step.
        device: of the samples.

    Raises:
        TrainingError: it is larger than the free memory.
        DeclarationError: it holds not even one row.
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
        raw: Sequence[str] = (),
        relabel: Relabel | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        needed = (*raw, *(() if relabel is None else relabel.raw))
        self._relabel = relabel
        self._columns = Columns(
            capacity, num_envs, observation_space, action_shape, action_dtype,
            mask_size=mask_size, each=4 * prioritized * (members if shared else 1),
            keep_rewards=shared, raw=tuple(dict.fromkeys(needed)),
        )  # fmt: skip
        self.num_envs = num_envs
        self._n_step, self._between = n_step, between and n_step > 1
        self._device = torch.device(device)
        # Columns that a member draws from, and the first of them.
        self._members, self._shared = members, shared
        self._width = num_envs if shared else num_envs // members
        self._offset = np.arange(members) * (0 if shared else self._width)
        places = self._columns.rows * self._width
        self._priorities = Priorities(members, places, alpha) if prioritized else None

    def __len__(self) -> int:
        """Transitions that can be sampled, over all columns."""
        return int((self._columns.data["kind"] != NOTHING).sum())

    @property
    def raw(self) -> tuple[str, ...]:
        """The raw columns that it keeps."""
        return self._columns.raw

    @property
    def ready(self) -> bool:
        """Whether there is something to sample for every member."""
        return bool((self._columns.newest >= 0).reshape(-1, self._width).any(1).all())

    @property
    def nbytes(self) -> int:
        """Bytes that are reserved; what was never written takes no memory yet."""
        return self._columns.nbytes + (self._priorities.nbytes if self._priorities else 0)

    def add(self, batch: Batch) -> None:
        """Append the rows of a batch to their columns; they are copied."""
        for slot, after in self._columns.add(batch):
            if self._priorities is not None:
                # Of slots named twice, the last counts: a successor may be a transition.
                member, place = self._places(np.concatenate([after, slot]))
                new = np.arange(len(place)) % (2 * len(slot)) >= len(after)
                self._priorities.set_new(member, place, new)

    def cut(self, columns: Array) -> None:
        """End the open trajectories of ``columns`` (k,), whose environments begin anew."""
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
        """``batch`` transitions for each member from ``first`` on, as many as generators are given.

        Args:
            gamma: (P,), their discounts.
            beta: how far importance weights correct what priorities prefer.
            progress: of the ``Sample``.
        """
        return self.at(*self._draw(batch, rngs, beta, first), gamma, progress)

    def at(
        self, index: Array, weight: Array | None, gamma: Tensor, progress: float = 0.0
    ) -> Sample:
        """The transitions (P, B) that a sample, perhaps of another store, calls ``index``."""
        columns, data = self._columns, self._columns.data
        factor = gamma.float().cpu().numpy()[:, None]
        start = index % columns.slots
        slots, follows = self._chain(start)
        judged = None if self._relabel is None else self._judged(self._relabel, slots, follows)
        slot, goes_on = start, np.ones(start.shape, bool)
        reward, discount = np.zeros(1, np.float32), np.ones(1, np.float32)
        between: list[tuple[Array, Array]] = []
        for k in range(self._n_step):
            if k:
                goes_on = goes_on & follows[..., k]
                if judged is not None:
                    goes_on &= ~judged.ended[..., k - 1]
                slot = np.where(goes_on, slots[..., k], slot)
                between.append((slot, np.where(goes_on, discount, np.float32(0))))
            here = columns.reward(factor, slot) if judged is None else judged["reward"][..., k]
            power = columns.power(factor, slot)
            if k:
                reward += np.where(goes_on, discount * here, np.float32(0))
                discount = np.where(goes_on, discount * power, discount)
            else:
                reward, discount = here, power
        after = columns.after(slot)
        terminated = data["kind"].take(slot) == TERMINATED
        if judged is not None:
            last = (slots == slot[..., None]).argmax(-1)[..., None]
            terminated = np.take_along_axis(judged["terminated"], last, -1)[..., 0]
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
            **self._seen_between(between),
        )

    def _chain(self, start: Array) -> tuple[Array, Array]:
        """Return the slots of n rows from ``start`` (P, B) on, and which follow it, (P, B, n).

        Where a row does not follow, its slot is that of the last one that does.
        """
        slots, follows = [start], [np.ones(start.shape, bool)]
        for _ in range(self._n_step - 1):
            after = self._columns.after(slots[-1])
            follows.append(self._columns.data["kind"].take(after) != NOTHING)
            slots.append(np.where(follows[-1], after, slots[-1]))
        return np.stack(slots, -1), np.stack(follows, -1)

    def _judged(self, relabel: Relabel, slots: Array, follows: Array) -> Batch:
        """Return the rows of ``slots`` (P, B, n) with the outcome that ``relabel`` gives them."""
        columns, data = self._columns, self._columns.data
        if "steps" in data:
            raise TrainingError("transitions of several steps cannot be judged again")
        flat = slots.reshape(-1, slots.shape[-1])
        named = {k: data[k].take(flat, axis=0) for k in ("obs", "action", "reward", *columns.raw)}
        never = np.zeros(flat.shape, bool)
        rows = Batch(
            **named,
            next_obs=data["obs"].take(columns.after(flat), axis=0),
            terminated=never,
            truncated=never,
        )
        found = relabel(rows)
        outcome = {k: found[k].reshape(slots.shape) for k in ("reward", "terminated", "truncated")}
        return Batch(**outcome)

    def update_priorities(self, index: Array, priority: Tensor, first: int = 0) -> None:
        """New priorities (P, B), above 0, of what members from ``first`` on have sampled."""
        if self._priorities is not None:
            slot = index % self._columns.slots
            # What was overwritten since is skipped.
            kept = (self._columns.number(slot) == index).nonzero()
            row, column = np.divmod(slot[kept], self._columns.num_envs)
            place = row * self._width + column - self._offset[first + kept[0]]
            new = priority.detach().float().cpu().numpy()[kept]
            self._priorities.update(first + kept[0], place, new)

    def inherit(self, parents: Array) -> None:
        """Every member (P,) goes on with the priorities of the one it descends from."""
        if self._priorities is not None:
            self._priorities.inherit(parents)

    def state(self) -> dict[str, Tensor]:
        """Copies of all that was written, to go on exactly; see ``load``."""
        written = self._columns.written() | self._written_priorities()
        return {name: to_tensor(array.copy()) for name, array in written.items()}

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from the ``state`` of a store that was made with the same arguments.

        Raises:
            RunError: it is of other settings.
            ValueError: a number in it is none that is written here.
        """
        self._columns.load(state)
        if self._priorities is not None:
            self._priorities.forget()
            copy_into(self._written_priorities(), state)
            self._priorities.rebuild(*self._places(self._columns.data["kind"].nonzero()[0]))

    def _written_priorities(self) -> dict[str, Array]:
        if self._priorities is None:
            return {}
        return self._priorities.written(self._columns.used() * self._width)

    def _places(self, slot: Array) -> tuple[Array, Array]:
        """Who draws from slots (k,), and which of their own these are; of all members in turn."""
        if self._shared:
            return np.repeat(np.arange(self._members), len(slot)), np.tile(slot, self._members)
        row, column = np.divmod(slot, self._columns.num_envs)
        return column // self._width, row * self._width + column % self._width

    def _draw(
        self, batch: int, rngs: Sequence[np.random.Generator], beta: float, first: int
    ) -> tuple[Array, Array | None]:
        """Which transitions (P, B), by their numbers since the first ever, and their weights."""
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
        """Transitions (B,) of a member, all as likely: slots are drawn until B hold one."""
        columns, first, more = self._columns, self._offset[member], 1.1
        among = columns.used(first, self._width) * self._width
        assert among, "sample() before add()"
        found = np.zeros(0, np.int64)
        while len(found) < batch:
            slot = rng.integers(among, size=int(more * (batch - len(found))) + 8)
            if self._width < columns.num_envs:
                slot += slot // self._width * (columns.num_envs - self._width) + first
            slot = slot[columns.data["kind"].take(slot) != NOTHING]
            found = np.concatenate([found, slot]) if len(found) else slot
            more *= 2  # where some columns are nearly empty
        return found[:batch]

    def _seen_between(self, between: list[tuple[Array, Array]]) -> dict[str, Tensor | None]:
        """Of n steps, the observations after the first: of their slots (P, B) and discounts."""
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
