"""Random experience with gaps, and the plainest replay there is, to compare stores with."""

from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np

from skillweave.algorithms.batches import Batch
from skillweave.buffers.replay import ReplayStore

SPACE = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
A = 3


@dataclass
class Kept:
    """A transition with everything that belongs to it."""

    obs: np.ndarray
    mask: np.ndarray
    action: int
    reward: float
    next_obs: np.ndarray
    next_mask: np.ndarray
    terminated: bool
    ended: bool
    steps: int
    rewards: np.ndarray


@dataclass
class World:
    """Random rows of N columns, added to a store and noted one by one.

    ``slots`` of a column are its transitions, and None behind each end and behind the newest.
    """

    store: ReplayStore
    num_envs: int
    rng: np.random.Generator
    ending: float = 0.3
    longest: int = 1
    masked: float = 0.0
    filled: float = 1.0  # share of cells that are valid
    told: bool = False  # the rewards of each step of a call
    slots: list[list[Kept | None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.slots = [[] for _ in range(self.num_envs)]
        self.begins = [True] * self.num_envs
        self.now = [self.draw() for _ in range(self.num_envs)]

    def draw(self) -> tuple[np.ndarray, np.ndarray]:
        """An observation, and what is allowed there."""
        masked = self.rng.random() < self.masked
        mask = self.rng.random(A) < 0.5 if masked else np.ones(A, bool)
        return self.rng.random(2, dtype=np.float32), mask

    def transition(self, column: int) -> Kept:
        rng, (obs, mask), (after, allowed) = self.rng, self.now[column], self.draw()
        terminated, truncated = rng.random() < self.ending, rng.random() < self.ending / 2
        steps = int(rng.integers(1, self.longest + 1))
        rewards = rng.random(steps, dtype=np.float32)
        ended = terminated or truncated
        self.now[column] = self.draw() if ended else (after, allowed)
        return Kept(
            obs, mask, int(rng.integers(A)), float(rewards @ 0.7 ** np.arange(steps)),
            after, allowed, terminated, ended, steps, rewards,
        )  # fmt: skip

    def note(self, column: int, kept: Kept) -> None:
        slots = self.slots[column]
        if not self.begins[column]:
            slots.pop()
        slots += [kept, None]
        self.begins[column] = kept.ended

    def collect(self, rows: int = 1, only: int | None = None) -> Batch:
        """Some rows, perhaps of one column, noted; cells that are not valid hold anything."""
        n, rng = self.num_envs, self.rng
        valid = rng.random((rows, n)) < self.filled
        valid &= only is None or np.arange(n) == only
        e = empty(rows, n, self.longest, rng)
        for t in range(rows):
            for c in valid[t].nonzero()[0]:
                kept = self.transition(c)
                self.note(c, kept)
                put(e, (t, c), kept)
        absent: dict[str, None] = {} if self.told else {"rewards": None}
        for name in ("mask", "next_mask"):
            if e[name][valid].all():
                absent[name] = None
        e = e.replace(**absent)
        return e if self.filled == 1.0 and only is None else e.replace(valid=valid)

    def add(self, rows: int = 1) -> None:
        self.store.add(self.collect(rows))

    def cut(self) -> None:
        """Some environments begin anew."""
        columns = np.flatnonzero(self.rng.random(self.num_envs) < 0.5)
        self.store.cut(columns)
        for c in columns:
            if self.slots[c]:
                self.slots[c][-2].ended = True
            self.begins[c], self.now[c] = True, self.draw()

    def live(self, rows: int) -> set[int]:
        """The numbers of all that can be sampled, where a column keeps ``rows`` slots."""
        return {
            number * self.num_envs + c
            for c, slots in enumerate(self.slots)
            for number, kept in enumerate(slots)
            if kept is not None and number >= len(slots) - rows
        }

    def expected(self, index: int, n_step: int, gamma: float) -> dict:
        number, column = divmod(index, self.num_envs)
        reward, discount = 0.0, 1.0
        between_obs, between_mask = np.zeros((n_step - 1, 2)), np.ones((n_step - 1, A), bool)
        counts = np.zeros(n_step - 1)
        for k, kept in enumerate(self.slots[column][number : number + n_step]):
            if kept is None:
                break
            if k:
                between_obs[k - 1], between_mask[k - 1] = kept.obs, kept.mask
                counts[k - 1] = discount
            own = kept.reward
            if self.told:
                own = sum(gamma**i * r for i, r in enumerate(kept.rewards))
            reward += discount * own
            discount *= gamma**kept.steps
            last = kept
        first = self.slots[column][number]
        return {
            "obs": first.obs, "mask": first.mask, "action": first.action,
            "reward": reward, "discount": discount * (not last.terminated),
            "next_obs": last.next_obs, "next_mask": last.next_mask,
            "between_discount": counts, "between_obs": between_obs, "between_mask": between_mask,
        }  # fmt: skip


def empty(rows: int, n: int, longest: int, rng: np.random.Generator) -> Batch:
    """Return a batch of which every cell holds nonsense."""

    def floats(*shape: int) -> np.ndarray:
        return rng.random((rows, n, *shape), dtype=np.float32) + 50

    def bools(*shape: int) -> np.ndarray:
        return rng.random((rows, n, *shape)) < 0.5

    return Batch(
        obs=floats(2), action=rng.integers(A, size=(rows, n)), reward=floats(),
        steps=rng.integers(7, size=(rows, n)), terminated=bools(), truncated=bools(),
        next_obs=floats(2), mask=bools(A), next_mask=bools(A), rewards=floats(longest),
    )  # fmt: skip


def put(e: Batch, cell: tuple[int, int], kept: Kept) -> None:
    """Write a transition into a cell."""
    e["obs"][cell], e["next_obs"][cell], e["action"][cell] = kept.obs, kept.next_obs, kept.action
    e["reward"][cell], e["steps"][cell] = kept.reward, kept.steps
    e["terminated"][cell] = kept.terminated
    e["truncated"][cell] = kept.ended and not kept.terminated
    e["mask"][cell], e["next_mask"][cell] = kept.mask, kept.next_mask
    e["rewards"][cell] = 0.0
    e["rewards"][cell][: kept.steps] = kept.rewards
