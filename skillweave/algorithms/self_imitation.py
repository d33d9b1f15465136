"""PPO with self-imitation (Oh, Guo, Singh & Lee 2018) for P members at once.

An update is PPO's, followed by gradient steps on good earlier rows, which are part of the state.
Rows are weighted by the part of the return that exceeds the value, (R − V)₊ of eqs. 2 and 3 there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Report, Rollout
from skillweave.algorithms.config import SelfImitationPPO
from skillweave.algorithms.ppo import PPOAlgorithm, State as PPOState, Terms
from skillweave.algorithms.rollouts import Cells, first_true
from skillweave.networks.stacked import Views, take_rows
from skillweave.ops.device import BOOL, FLOAT, all_false
from skillweave.ops.returns import gae
from skillweave.spaces import obs_dtype, obs_shape, to_tensor


@dataclass
class State(PPOState):
    """PPO's state, and K kept rows."""

    kept: Tensor  # (P, K) bool, the others are empty; the latest come first
    kept_obs: Tensor  # (P, K, *obs_shape)
    kept_action: Tensor  # (P, K) int64, or (P, K, A)
    kept_mask: Tensor  # (P, K, A) bool, allowed actions
    kept_return: Tensor  # (P, K), in units of reward

    @property
    def rows(self) -> Rows:
        """Return the kept rows: ``obs``, ``action``, ``mask`` and ``return``."""
        return {name: getattr(self, f"kept_{name}") for name in ("obs", "action", "mask", "return")}


Rows = dict[str, Tensor]
"""Columns of P members' rows, (P, K, …) each; fields of ``State`` without ``kept_``."""


class SelfImitationAlgorithm(PPOAlgorithm):
    """PPO that learns again from good earlier rows; see the module."""

    state_type: ClassVar[type[State]] = State
    config: SelfImitationPPO

    def fresh_state(self, seeds: Sequence[Seeds]) -> State:
        """Create the state of fresh members, which have no kept row yet."""
        lead = (len(seeds), self.config.imitation_rows)
        action = self.codec.zeros(1)
        space: gym.Space[Any] = self.observation_space
        obs = to_tensor(np.zeros((1, *obs_shape(space)), obs_dtype(space)))[0]
        return State(
            **vars(super().fresh_state(seeds)),
            kept=torch.zeros(lead, **BOOL),
            kept_obs=obs.new_zeros(*lead, *obs.shape),
            kept_action=to_tensor(action).new_zeros(*lead, *action.shape[1:]),
            kept_mask=torch.ones(*lead, self._mask_size, **BOOL),
            kept_return=torch.zeros(lead, **FLOAT),
        )

    @property
    def _mask_size(self) -> int:
        """The numbers of a mask; one where actions have no choices."""
        return sum(self.codec.counts) or 1

    def update(
        self, state: Any, batch: Rollout, rng: Sequence[torch.Generator]
    ) -> tuple[Any, Report]:
        """Update as PPO does, then learn from kept rows, good rows of this rollout included."""
        self.keep(state, batch)
        state, report = super().update(state, batch, rng)
        terms = Terms.of(self.config, state, batch)
        report.metrics |= self.imitate(state, terms.rate, rng)
        return state, report

    @torch.no_grad()
    def keep(self, state: State, rollout: Rollout) -> None:
        """Keep the rows of a rollout whose return exceeds the value, in place of the oldest."""
        cells = Cells(rollout, all_cells=False)
        obs = cells.flat(rollout.obs)
        mask = cells.flat_or_none(rollout.mask)
        value = self.value(state, obs)
        if mask is None:
            mask = state.kept_mask.new_ones(*value.shape, self._mask_size)
        returns, known = (cells.flat(x) for x in returns_of(rollout))
        good = known & (returns > value)
        if rollout.overridden is not None:
            good &= ~cells.flat(rollout.overridden)
        action = cells.flat(rollout.action)
        new = {"obs": obs, "action": action, "mask": mask, "return": returns}
        filled = torch.cat([good, state.kept], dim=1)
        latest = first_true(filled, state.kept.shape[1])
        state.kept = take_rows(filled, latest)
        for name, old in state.rows.items():
            rows = torch.cat([new[name], old], dim=1)
            setattr(state, f"kept_{name}", take_rows(rows, latest))

    def imitate(
        self, state: State, rate: Tensor, rng: Sequence[torch.Generator]
    ) -> dict[str, Tensor]:
        """Take gradient steps on kept rows, in place; return metrics (P,).

        Rows are drawn in proportion to their gain, (R − V)₊.

        Args:
            rate: (P,), Adam's step size.
        """
        cfg = self.config
        leaves = self.layout.leaves(state.params)
        rows = state.rows
        with torch.no_grad():
            gain = (rows["return"] - self.value(state, rows["obs"])).clamp_min(0.0) * state.kept
        total = gain.cumsum(1)
        count = state.kept.sum(1)
        # At most one pass over the kept rows: many passes over few rows would overfit them.
        due = (-(-count // cfg.minibatch)).clamp_max(cfg.imitation_steps) * (total[:, -1] > 0.0)
        for step in range(cfg.imitation_steps):
            if all_false(active := step < due):
                break
            drawn = torch.stack([torch.rand(cfg.minibatch, generator=g, **FLOAT) for g in rng])
            place = torch.searchsorted(total, drawn.to(total.device) * total[:, -1:], right=True)
            # Rounding may lead beyond the last row; in a member without rows it always does.
            place = place.clamp_max(total.shape[1] - 1)
            batch = {name: take_rows(x, place) for name, x in rows.items()}
            loss = self.imitation_loss(leaves, state, batch)
            self.step_(state, loss, leaves, rate, active=active)
        mean = total[:, -1] / count.clamp_min(1)
        return {"imitation_rows": count.to(gain.dtype), "imitation_gain": mean}

    def imitation_loss(self, views: Views, state: State, batch: Rows) -> Tensor:
        """Return ``E[−log π(a|s)·min(g, 1)]`` and ``½E[g²]``, weighted; g = (R − V)₊; (P,).

        Oh et al. 2018, eqs. 2 and 3; g is in deviations of returns, and at most 1 in the policy's
        loss, as in the authors' code.
        """
        inputs = self.inputs(self.learning_params(state), batch["obs"])
        dist_params = self.actor_net(views, inputs)
        raw = self.critic_net(views, inputs)
        log_std = views.get("actor.log_std")
        log_prob, _ = self.head.stats(dist_params, log_std, batch["mask"], batch["action"])
        target = (batch["return"] - state.return_mean) / state.return_scale
        gain = (target - raw.squeeze(-1)).clamp_min(0.0)
        policy = -(log_prob * gain.detach().clamp_max(1.0)).mean(1)
        cfg = self.config
        return cfg.imitation_coef * policy + cfg.imitation_vf_coef * 0.5 * gain.square().mean(1)


def returns_of(rollout: Rollout) -> tuple[Tensor, Tensor]:
    """Compute returns of a rollout for self-imitation, (P, T, B), and where they are known.

    It is known where the trajectory terminates within the rollout. Elsewhere the rest would be the
    critic's estimate, and imitation would repeat its errors.
    """
    last = rollout.last
    zeros = torch.zeros_like(rollout.reward)
    ones = zeros.new_ones(len(zeros))
    ends = (last & (rollout.discount == 0.0)).to(zeros.dtype)
    known = gae(ends, (~last).to(zeros.dtype), zeros, zeros, last, ones) > 0.0
    if rollout.valid is not None:
        known &= rollout.valid
    return gae(rollout.reward, rollout.discount, zeros, zeros, last, ones), known
