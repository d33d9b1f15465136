"""Exact values of skills on a finite Markov decision process, by linear equations in float64.

Sutton, Precup & Singh 1999, sec. 3: a skill has a multi-time model, and with it the Bellman
equations are those of an ordinary decision process. Nothing here is shared with the library.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skillweave.types import Array


@dataclass(frozen=True)
class Process:
    """S states and A actions; what ends an episode is no successor."""

    chance: Array
    """(S, A, S), the probability of each successor; rows of less than 1 may end the episode."""
    reward: Array
    """(S, A), expected."""


@dataclass(frozen=True)
class Option:
    """A skill on S states."""

    action: Array
    """(S,), what it does."""
    starts: Array
    """(S,) bool, where it may be called."""
    goes_on: Array
    """(S,) bool, where its call goes on; elsewhere it is over after its first step."""


@dataclass(frozen=True)
class Model:
    """The outcomes of calls of O skills."""

    reward: Array
    """(S, O), the expected Σ γᵏ rₖ of a call."""
    after: Array
    """(S, O, S), the expected γ^τ where the call ends in a successor, else 0."""
    allowed: Array
    """(S, O) bool."""


def model_of(process: Process, options: list[Option], gamma: float) -> Model:
    """Return the multi-time models (eq. 5 and 6), solved for the states where a call goes on."""
    states = np.arange(len(process.reward))
    reward, after = [], []
    for option in options:
        chance = gamma * process.chance[states, option.action]
        pay = process.reward[states, option.action]
        on, off = option.goes_on, ~option.goes_on
        rest = np.eye(on.sum()) - chance[np.ix_(on, on)]
        inner = np.linalg.solve(rest, np.column_stack([pay[on], chance[np.ix_(on, off)]]))
        whole = np.zeros_like(chance)
        whole[:, off] = chance[:, off] + chance[:, on] @ inner[:, 1:]
        reward.append(pay + chance[:, on] @ inner[:, 0])
        after.append(whole)
    allowed = np.stack([o.starts for o in options], axis=1)
    return Model(np.stack(reward, 1), np.stack(after, 1), allowed)


def optimal(model: Model) -> Array:
    """Q*(s, o) over skills (eq. 9 and 10), (S, O), by value iteration; −∞ where not allowed."""
    value = np.zeros(len(model.reward))
    while True:
        q = np.where(model.allowed, model.reward + model.after @ value, -np.inf)
        before, value = value, np.where(model.allowed.any(1), q.max(1), 0.0)
        if np.abs(value - before).max() < 1e-14:
            return q


def value_of(model: Model, policy: Array) -> Array:
    """V(s) of a policy over skills (S, O), whose rows are probabilities; (S,)."""
    reward = (policy * model.reward).sum(1)
    after = np.einsum("so,sot->st", policy, model.after)
    found: Array = np.linalg.solve(np.eye(len(reward)) - after, reward)
    return found
