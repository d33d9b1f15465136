"""Calls of a trace: a selector's decisions, each with the whole call that followed it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from skillweave._internal.paths import SELECTOR
from skillweave.algorithms.batches import Batch, Trace, padded_last_axis
from skillweave.experience.levels import LearningLevel
from skillweave.policies.core import Array
from skillweave.policies.hierarchy import unless_none
from skillweave.policies.parts import OBSERVATION

SMOOTHED = 0.05
"""Share of a guide's choice that is uniform: without it one deviation would cost infinitely much.
"""


class OpenCalls:
    """The calls of one selector that are open at the end of a request.

    Args:
        level: whose selector it is.
        shaped: the collector's dict of arrays (N, …) whose shape is known when a call starts.
        keep_rewards: of each call, keep the reward of every step.
    """

    def __init__(
        self, level: LearningLevel, shaped: dict[str, Array], *, keep_rewards: bool = False
    ) -> None:
        n = len(level.memory["skill"])
        hierarchy = level.hierarchy
        self._shaped = shaped
        self.level = level
        self.keep_rewards = keep_rewards
        self.memory_size = 0 if level.selector is None else level.selector.net.memory_size
        self.kept: dict[str, Array] = {
            "acted": np.zeros(n, bool),  # the level acted in the latest step
            "open": np.zeros(n, bool),  # a call is open
            "first": np.zeros(n, bool),  # the selector's memory was empty before this call
            "reward": np.zeros(n),  # Σ γᵏ rₖ
            "discount": np.zeros(n),  # γ^τ
            "tau": np.zeros(n, np.int64),
        }
        """State of the open call in each environment, (N, …) each; changed in place."""
        if not hierarchy.goals:  # else its shape is that of the selector's choices
            self.kept["action"] = np.zeros(n, np.int64)  # the choice
        if self.memory_size:
            self.kept["state_before"] = np.zeros((n, self.memory_size), np.float32)
        if hierarchy.restricts or hierarchy.guide is not None:
            self.kept["allowed"] = np.ones((n, hierarchy.choices), bool)  # when it decided

    def calls_of(self, trace: Trace, steps: Batch, closes: Array, gamma: Array) -> Batch:
        """Return the calls that end in a trace as decisions, (D, N); keep those that are open.

        The return of a decision is Σ γᵏ rₖ over its call, less the cost of a call. A call whose
        level does not act any more is cut: its value goes on where another skill acts.

        Args:
            steps: the level's steps, as its selector is judged by them; ``valid`` where it acts.
            closes: (T, N) bool, the selector's call is over after this step.
            gamma: (N,) float64, the discount of one step.
        """
        ends = self._ends(trace, steps, closes, gamma)
        batch = self._batch(trace, steps, ends)
        self._keep(trace)
        return batch

    def _ends(self, trace: Trace, steps: Batch, closes: Array, gamma: Array) -> dict[str, Array]:
        """Find the calls that end, in the order of time; open ones go on in place.

        Returns:
            Of each, (K,): ``row`` and ``env`` of its last step (or of the step in which another
            skill acts: ``cut``), the row in which it was ``decided`` on (−1: in an earlier
            request), ``first``, ``reward``, ``steps``; perhaps the ``rewards`` (K, L) of its steps.
        """
        kept = self.kept
        acted, is_open, total, weight, tau = (
            kept[name] for name in ("acted", "open", "reward", "discount", "tau")
        )
        lead = trace.lead
        acts = steps["valid"]
        reward = steps["reward"]
        reset = trace.ended
        begins = trace.get(f"{self.level.path}{SELECTOR}/decided")
        begins = np.zeros(lead, bool) if begins is None else begins
        over, cut, first = (np.zeros(lead, bool) for _ in range(3))
        lasted = np.zeros(lead, np.int64)
        decided = np.full(lead, -1)
        sums = np.zeros(lead)
        rewards = list[Array]()
        latest = np.full(lead[1], -1)
        for t in range(len(begins)):
            np.logical_and(is_open, ~acts[t], out=cut[t])
            new = begins[t]
            total[new] = 0.0
            weight[new] = 1.0
            tau[new] = 0
            latest[new] = t
            kept["first"][new] = ~acted[new]
            is_open[cut[t]], is_open[new] = False, True
            if self.keep_rewards:
                self._keep_rewards(new, is_open, reward[t])
            np.add(total, weight * reward[t], out=total, where=is_open)
            np.multiply(weight, gamma, out=weight, where=is_open)
            tau += is_open
            ends = closes[t] & is_open
            np.logical_or(ends, cut[t], out=over[t])
            sums[t] = total
            lasted[t] = tau
            decided[t] = latest
            first[t] = kept["first"]
            if self.keep_rewards and over[t].any():
                rewards.append(self._shaped[self.level.path + "rewards"][over[t]])
            is_open[ends] = False
            acted[:] = acts[t] & ~reset[t]
            for values in (total, weight, tau):
                values[reset[t]] = 0
        self._decided = latest
        row, env = np.nonzero(over)
        columns = {"cut": cut, "decided": decided, "first": first, "reward": sums, "steps": lasted}
        found = {name: values[row, env] for name, values in columns.items()}
        if self.keep_rewards:
            parts = padded_last_axis([*rewards, np.zeros((0, 1), np.float32)])
            found["rewards"] = np.concatenate(parts)
        return found | {"row": row, "env": env}

    def _keep_rewards(self, new: Array, is_open: Array, reward: Array) -> None:
        """Keep the reward of this step of the open calls; all (N,), ``new`` ones start."""
        tau = self.kept["tau"]
        longest = int(tau.max()) + 1
        rewards = self._shaped.get(self.level.path + "rewards")
        if rewards is None:
            rewards = np.zeros((len(tau), 16), np.float32)
        if longest > rewards.shape[1]:
            rewards = np.pad(rewards, ((0, 0), (0, longest)))
        rewards[new] = 0.0
        rewards[is_open, tau[is_open]] = reward[is_open]
        self._shaped[self.level.path + "rewards"] = rewards

    def _batch(self, trace: Trace, steps: Batch, ends: Mapping[str, Array]) -> Batch:
        """Return the calls that ended as columns (D, N): some have more of them than others."""
        row = ends["row"]
        env = ends["env"]
        cut = ends["cut"]
        values = self._at_decisions(trace, ends) | {
            "reward": (ends["reward"] - self.level.skill_set.deliberation_cost).astype(np.float32),
            "steps": ends["steps"],
            "terminated": steps["terminated"][row, env] & ~cut,
            "truncated": steps["truncated"][row, env] | cut,
            "next_obs": self.level.seen(trace, "next_obs")[row, env],
            "episode_start": ends["first"],
        }
        if cut.any():
            values["next_obs"][cut] = self.level.seen(trace, "obs")[row[cut], env[cut]]
        selector = self.level.selector
        if selector is not None and not self.level.hierarchy.goals:
            values["action"] = np.asarray(selector.net.to_env(values["action"]))
        if "mask" in values:
            values["next_mask"] = self._next_mask(trace, values, row, env)
        if (chances := trace.get(self.level.path + "chances")) is not None:
            values["guide"] = as_logits(chances[row, env], values["mask"])
        if selector is not None and "mask" in values:
            values |= {name: selector.net.widened(values[name]) for name in ("mask", "next_mask")}
        if self.keep_rewards:
            values["rewards"] = ends["rewards"]
        return self._laid_out(values, env)

    def _at_decisions(self, trace: Trace, ends: Mapping[str, Array]) -> dict[str, Array]:
        """Return the observations and selector columns of the decisions of K calls, by name."""
        seen = self.level.seen(trace, "next_obs")
        found = {"obs": seen[ends["row"], ends["env"]]}  # if there is no call
        earlier = ends["decided"] < 0
        for name, column in DECIDED_ON.items():
            values = self._decided_on(trace, column)
            held = self._held(column)
            if values is not None:
                found[name] = values[ends["decided"], ends["env"]]
                if held is not None:  # other networks have chosen, if it has another shape
                    fits = held.shape[1:] == values.shape[2:]
                    found[name][earlier] = held[ends["env"][earlier]] if fits else 0
            elif held is not None:
                found[name] = held[ends["env"]]
        return found

    def _decided_on(self, trace: Trace, name: str) -> Array | None:
        """Return a column of the selector, (T, N, …); None: it has not decided."""
        values: Array | None = trace.get(f"{self.level.path}{SELECTOR}/{name}")
        if values is None or name not in ("dist_params", "state_before"):
            return values
        # Of a member that has diverged it may be NaN: its heir goes on with the open calls.
        return np.where(np.isnan(values), np.float32(0), values)

    def _held(self, name: str) -> Array | None:
        """Return a column (N, …) of the decisions whose calls were open before; None: none was."""
        kept = self.kept.get(name)
        return self._shaped.get(self.level.path + name) if kept is None else kept

    def _next_mask(
        self, trace: Trace, values: Mapping[str, Array], row: Array, env: Array
    ) -> Array:
        """Return where skills may start in the true successors; all where that does not matter."""
        mask = np.ones_like(values["mask"])
        level = self.level
        on = np.flatnonzero(~values["terminated"])
        if len(on):
            seen = values["next_obs"][on]
            may = level.hierarchy.may_start(seen if level.goals is None else seen[OBSERVATION])
            if (allows := trace.get(level.path + "guide_allows")) is not None:
                may &= allows[row[on], env[on]]
            mask[on] = unless_none(may)
        return mask

    def _laid_out(self, values: dict[str, Array], env: Array) -> Batch:
        """Return values (K, …) of environments ``env`` (K,) as (D, N, …), by environment."""
        n = len(self.kept["tau"])
        count = np.bincount(env, minlength=n)
        order = np.argsort(env, kind="stable")
        place = np.empty(len(env), np.int64)
        place[order] = np.arange(len(env)) - (count.cumsum() - count).repeat(count)
        height = max(1, int(count.max()))
        found: dict[str, Any] = {}
        for name, value in values.items():
            found[name] = np.zeros((height, n, *value.shape[1:]), value.dtype)
            found[name][place, env] = value
        memory = found.pop("recurrent_state", None)
        starts = found.pop("episode_start")
        valid = np.arange(height)[:, None] < count
        return Batch(
            **found,
            valid=None if valid.all() else valid,
            recurrent_state=None if memory is None else memory[0],
            episode_start=None if memory is None else starts,
        )

    def _keep(self, trace: Trace) -> None:
        """Keep the decisions of calls that are still open, for the next request."""
        env = np.flatnonzero(self.kept["open"] & (self._decided >= 0))
        for name in DECIDED_ON.values():
            if (values := self._decided_on(trace, name)) is None:
                continue
            held = self._held(name)
            if held is None or held.shape[1:] != values.shape[2:]:
                held = np.zeros(values.shape[1:], values.dtype)
                self._shaped[self.level.path + name] = held
            held[env] = values[self._decided[env], env]


DECIDED_ON = {
    "obs": "obs",
    "action": "action",
    "dist_params": "dist_params",
    "mask": "allowed",
    "recurrent_state": "state_before",
}
"""By a name of decisions: the selector's column in a trace, and its name among open calls."""


def as_logits(chances: Array, may: Array) -> Array:
    """Return a guide's choices in rows as logits, of which a small share is uniform.

    Args:
        chances: (…, choices).
        may: (…, choices) bool, what is allowed: the share is shared among it.
    """
    uniform = may / np.maximum(may.sum(-1, keepdims=True), 1)
    mixed = (1.0 - SMOOTHED) * chances + SMOOTHED * uniform
    found: Array = np.log(np.maximum(mixed, 1e-8)).astype(np.float32)
    return found
