"""Pending calls: a selector's open decisions, and rows of those whose calls are over."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from skillweave.collecting.collector import Collector
from skillweave.collecting.guide import as_logits
from skillweave.collecting.player import LearnerActor, Player
from skillweave.collecting.restored import known
from skillweave.experience import Batch, padded_last_axis
from skillweave.types import Array, Memory


class PendingCalls:
    """The calls that one selector has begun in N environments, each since its decision.

    All that it keeps stands in the collector's ``kept`` and ``open``, so checkpoints hold it.

    Args:
        collector: of these environments.
        player: whose selector it is.
        selector: the learner that chooses; None where only ``like`` of the collector is to act.
        memory: the player's.
        keep_rewards: of each call, keep the reward of every step.
        prefix: of all names, where a collector has several selectors.
    """

    def __init__(
        self,
        collector: Collector,
        player: Player,
        selector: LearnerActor | None,
        memory: Memory,
        keep_rewards: bool = False,
        prefix: str = "",
    ) -> None:
        n = collector.num_envs
        self.player, self.selector, self.keep_rewards = player, selector, keep_rewards
        self.memory_size = 0 if selector is None else selector.acting.memory_size
        self._memory = memory
        self._collector, self._prefix, self._all = collector, prefix, np.arange(n)
        self.kept: dict[str, Array] = {
            "first": np.zeros(n, bool),  # the selector's memory was empty before this call
            "reward": np.zeros(n),  # Σ γᵏ rₖ
            "discount": np.zeros(n),  # γ^τ
            "tau": np.zeros(n, np.int64),
            "choice": np.zeros(n, np.int64),
            "before": np.zeros((n, self.memory_size), np.float32),  # the selector's memory
        }
        if player.restricts or player.guide is not None:
            self.kept["allowed"] = np.ones((n, player.skills.choices), bool)  # when it decided
        collector.kept |= {prefix + k: v for k, v in self.kept.items()}
        collector.ranges[f"{prefix}choice"] = range(player.skills.choices)

    def begin(self) -> Array:
        """Keep the decisions that the selector has just made; return their environments (k,)."""
        assert self.selector is not None
        latest, kept = self.selector.latest, self.kept
        if latest is None:
            return self._all[:0]
        ids, acted = latest.rows, latest.acted
        kept["choice"][ids] = np.asarray(self.selector.acting.to_env(acted.action))
        kept["reward"][ids], kept["discount"][ids], kept["tau"][ids] = 0.0, 1.0, 0
        if latest.recurrent_state is not None:
            kept["before"][ids] = known(latest.recurrent_state)
        if "allowed" in kept:
            kept["allowed"][ids] = latest.mask
        if (rewards := self.opened("rewards")) is not None:
            rewards[ids] = 0.0
        head = None if acted.dist_params is None else known(acted.dist_params)
        for name, value in (("obs", latest.obs), ("head", head)):
            if value is not None:
                held = self.opened(name)
                if held is None or held.shape[1:] != value.shape[1:]:
                    held = np.zeros((len(self._all), *value.shape[1:]), value.dtype)
                    self._collector.open[self._prefix + name] = held
                held[ids] = value
        return ids

    def count(self, ids: Array | slice, reward: Array, gamma: Array) -> None:
        """Add a step to the calls of environments ``ids`` (k,); ``gamma`` is of all N."""
        kept = self.kept
        if self.keep_rewards:
            self._keep(self._all[ids], reward)
        kept["reward"][ids] += kept["discount"][ids] * reward
        kept["discount"][ids] *= gamma[ids]
        kept["tau"][ids] += 1

    def opened(self, name: str) -> Array | None:
        """Return values of open calls whose shape is known only when they start."""
        return self._collector.open.get(self._prefix + name)

    def row(
        self, ids: Array, terminated: Array, truncated: Array, next_obs: Array
    ) -> dict[str, Array]:
        """The decisions of environments ``ids`` (k,), whose calls are over, as rows."""
        kept, obs = self.kept, self.opened("obs")
        assert obs is not None
        values = {
            "obs": obs[ids],
            "action": kept["choice"][ids],
            "reward": (kept["reward"][ids] - self.player.skills.call_cost).astype(np.float32),
            "steps": kept["tau"][ids],
            "terminated": terminated,
            "truncated": truncated,
            "next_obs": next_obs,
            "episode_start": kept["first"][ids],
        }
        if self.memory_size:
            values["recurrent_state"] = kept["before"][ids]
        for name, column in (("head", "dist_params"), ("rewards", "rewards")):
            if (held := self.opened(name)) is not None:
                values[column] = held[ids]
        if "allowed" in kept:
            values["mask"] = kept["allowed"][ids]
            values["next_mask"] = self._next_mask(values, ids)
        if (chances := self.chances) is not None:
            values["guide"] = as_logits(chances[ids], values["mask"])
        return values

    @property
    def chances(self) -> Array | None:
        """The probabilities of the guide's latest choices, (N, choices); None: not recorded."""
        guide = self.player.guide
        return self._memory["chances"] if guide is not None and guide.tells else None

    def _keep(self, ids: Array, reward: Array) -> None:
        """Keep the reward of this step of the open calls."""
        longest = int(self.kept["tau"].max()) + 1
        rewards = self.opened("rewards")
        if rewards is None:
            rewards = np.zeros((len(self._all), 16), np.float32)
        if longest > rewards.shape[1]:
            rewards = np.pad(rewards, ((0, 0), (0, longest)))
        self._collector.open[self._prefix + "rewards"] = rewards
        rewards[ids, self.kept["tau"][ids]] = reward

    def _next_mask(self, values: Mapping[str, Array], ids: Array) -> Array:
        """Return where skills may start in the true successors; all where that does not matter."""
        mask = np.ones_like(values["mask"])
        on = np.flatnonzero(~values["terminated"])
        if len(on):
            mask[on] = self.player.allowed(self._memory, ids[on], values["next_obs"][on])
        return mask


class Decisions:
    """Decisions as their calls end: some columns have more of them than others."""

    def __init__(self, num_envs: int) -> None:
        self._count = np.zeros(num_envs, np.int64)
        self._found: list[tuple[Array, Array, dict[str, Array]]] = []

    def put(self, ids: Array, values: dict[str, Array]) -> None:
        """The calls of environments ``ids`` (k,) are over; ``values`` are as of ``row``."""
        self._found.append((self._count[ids], ids, values))
        self._count[ids] += 1

    def batch(self, calls: PendingCalls, obs: Array) -> Batch:
        """All decisions, (D, N), as far as each column goes.

        Args:
            obs: what there is to act on next, (N, …), of the kind of all observations.
        """
        if not self._found:
            return self._nothing(calls, obs)
        height = int(self._count.max())
        n = len(self._count)
        found: dict[str, Array] = {}
        for name in self._found[0][2]:
            found[name] = self._column(name, height, n)
        memory = found.pop("recurrent_state", None)
        starts = found.pop("episode_start")
        valid = np.arange(height)[:, None] < self._count
        return Batch(
            **found,
            valid=None if valid.all() else valid,
            recurrent_state=None if memory is None else memory[0],
            episode_start=None if memory is None else starts,
        )

    def _column(self, name: str, height: int, n: int) -> Array:
        """One field of all decisions, (D, N, …); rewards of calls as long as the longest."""
        values = [value[name] for _, _, value in self._found]
        if name == "rewards":
            values = padded_last_axis(values)
        whole = np.zeros((height, n, *values[0].shape[1:]), values[0].dtype)
        for (rows, ids, _), value in zip(self._found, values, strict=True):
            whole[rows, ids] = value
        return whole

    @staticmethod
    def _nothing(calls: PendingCalls, obs: Array) -> Batch:
        """One empty row: no call has ended."""
        n = len(obs)
        lead, no = (1, n), np.zeros((1, n), bool)
        head, size, chances = calls.opened("head"), calls.memory_size, calls.chances
        return Batch(
            obs=obs[None], action=np.zeros(lead, np.int64), reward=np.zeros(lead, np.float32),
            steps=np.ones(lead, np.int64), terminated=no, truncated=no, next_obs=obs[None],
            valid=no, dist_params=None if head is None else np.zeros_like(head)[None],
            recurrent_state=np.zeros((n, size), np.float32) if size else None,
            episode_start=no if size else None,
            rewards=np.zeros((*lead, 1), np.float32) if calls.keep_rewards else None,
            guide=None if chances is None else chances[None],
        )  # fmt: skip
