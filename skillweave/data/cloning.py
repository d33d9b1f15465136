"""Behavioural cloning: a network learns the actions of recorded steps (Pomerleau 1989)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.algorithms.registry import make_algorithm
from skillweave.ops.optim import adam_
from skillweave.ops.threads import torch_threads
from skillweave.policies.core import Array
from skillweave.spaces import to_tensor

GRADIENT_STEPS, BATCH = 4_000, 256
"""The most gradient steps, and the rows of each."""
LOOK = 200
"""Gradient steps between two looks at rows that are not learnt from."""
PATIENCE = 5
"""Looks without a better one, after which it ends."""
RATE = 1e-3
"""Adam's step size."""
HELD = 0.1
"""The share of groups that chooses the step at which it ends, and of as many that judge it."""
STD = "actor.log_std"
"""The log deviation of a policy, where it is a parameter: it keeps the value that it starts with,
as what is recorded says little about how much to explore."""


@dataclass(frozen=True)
class Clone:
    """A policy that was cloned."""

    policy: AgentPolicy
    rows: int
    """Steps, or decisions, from which it learnt."""
    loss: float
    """−log π(a|s) of held-out rows, in nats."""
    before: float
    """The same of the network at its start."""
    agrees: float | None
    """The share of held-out rows whose greedy choice is the recorded one; None: of numbers."""

    held_out: bool = True
    """Rows were held out; else there were too few groups, and the loss is of rows learnt from."""

    def __str__(self) -> str:
        if not self.held_out:
            return f"{self.rows:,} rows, of too few episodes or calls to hold any out"
        agrees = "" if self.agrees is None else f", agrees in {self.agrees:.0%}"
        return (
            f"{self.rows:,} rows, held-out loss {self.loss:.3g} (at the start {self.before:.3g})"
            f"{agrees}"
        )


def clone(
    config: Any,
    obs: Array,
    action: Array,
    group: Array,
    spaces: tuple[gym.Space[Any], gym.Space[Any]],
    seeds: Seeds,
    mask: Array | None = None,
) -> Clone:
    """Train an actor of PPO to take recorded actions, by their log-probability.

    A tenth of the groups chooses the step at which it ends, and another tenth judges the result.

    Args:
        config: settings of PPO; the network has no memory.
        obs: (n, *obs_shape).
        action: (n, ...), in the policy's units.
        group: (n,) int64, the episode or call of each row: a group is learnt from, or held out.
        spaces: of observations and actions.
        seeds: of the first weights, of the groups, and of the order of rows.
        mask: (n, A) bool, allowed actions; None: all.
    """
    algorithm: Any = make_algorithm(config, *spaces)
    state = algorithm.init([seeds])
    first = algorithm.weights(state).get(STD)
    parts = _split(group, seeds)
    # Copies: the arrays of a data set cannot be written to, which tensors can.
    inputs = to_tensor(np.array(obs))[None]
    actions = torch.from_numpy(np.array(action))[None]
    allowed = None if mask is None else torch.from_numpy(mask)[None]
    rng = (seeds / "rows").torch()
    if getattr(algorithm.head, "squash", False):
        actions = torch.atanh(actions.clamp(-0.999, 0.999))

    def losses(leaves: Any, rows: Any) -> Any:
        """Return −log π(a|s) of rows, (1, n)."""
        params = algorithm.learning_params(state)
        found = algorithm.actor_net(leaves, algorithm.inputs(params, inputs[:, rows]))
        some = None if allowed is None else allowed[:, rows]
        log_prob, _ = algorithm.head.stats(found, leaves.get(STD), some, actions[:, rows])
        return -log_prob

    def judged(rows: Any) -> float:
        """Return the mean loss of rows that are not learnt from."""
        with torch.no_grad():
            leaves = algorithm.layout.leaves(state.params)
            chunks = [losses(leaves, some) for some in rows.split(4_096)]
            return float(torch.cat(chunks, dim=1).mean())

    learnt, chooses, judges = (torch.from_numpy(rows) for rows in parts)
    with torch.enable_grad(), torch_threads(1):
        algorithm.update_obs_stats(state, inputs[:, learnt])
        before, best, kept, waits = judged(judges), judged(chooses), state.params.clone(), 0
        for step in range(1, GRADIENT_STEPS + 1):
            size = min(BATCH, len(learnt))
            rows = learnt[torch.randint(len(learnt), (size,), generator=rng)]
            leaves = algorithm.layout.leaves(state.params)
            loss = losses(leaves, rows).mean(1)
            gradient = algorithm.layout.gradient(loss, leaves)
            rate = torch.full_like(loss.detach(), RATE)
            adam_(state.params, gradient, state.mu, state.nu, state.count, rate)
            if step % LOOK:
                continue
            now = judged(chooses)
            waits = 0 if now < best else waits + 1
            if now < best:
                best, kept = now, state.params.clone()
            if waits == PATIENCE:
                break
    state.params.copy_(kept)
    after = judged(judges)
    weights = dict(algorithm.weights(state))
    if first is not None:
        weights[STD] = first
    policy = AgentPolicy(algorithm, weights)
    agrees = None
    if isinstance(spaces[1], gym.spaces.Discrete):
        with torch.no_grad():
            leaves = algorithm.layout.leaves(state.params)
            found = algorithm.actor_net(
                leaves, algorithm.inputs(algorithm.learning_params(state), inputs[:, judges])
            )
            may = None if allowed is None else allowed[:, judges]
            greedy = algorithm.head.masked(found, may).argmax(-1)
            agrees = float((greedy == actions[:, judges]).float().mean())
    return Clone(policy, len(learnt), after, before, agrees, parts[0] is not parts[2])


def _split(group: Array, seeds: Seeds) -> tuple[Array, Array, Array]:
    """Return the rows that are learnt from, that choose, that judge; of few groups all each."""
    groups = (seeds / "groups").numpy().permutation(np.unique(group))
    held = max(1, round(HELD * len(groups)))
    if len(groups) < 3:
        every = np.arange(len(group))
        return every, every, every
    parts = groups[2 * held :], groups[:held], groups[held : 2 * held]
    learnt, chooses, judges = (np.flatnonzero(np.isin(group, part)) for part in parts)
    return learnt, chooses, judges
