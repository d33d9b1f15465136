"""What an update of PPO learns from: the samples of a rollout, and the terms of its loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from skillweave.algorithms.base import ActingParams
from skillweave.algorithms.config import PPO, SkillCritic
from skillweave.algorithms.parameters import rate_now
from skillweave.algorithms.rollouts import Cells, Samples, values_after
from skillweave.experience import Reference, Rollout
from skillweave.networks.stacked import take_rows
from skillweave.ops.losses import likelihood_ratio
from skillweave.ops.moments import explained_variance, normalise
from skillweave.ops.returns import gae

if TYPE_CHECKING:
    from skillweave.algorithms.ppo import PPOAlgorithm, State


@dataclass
class Terms:
    """What schedules, and the stage, say of an update."""

    rate: Tensor  # (P,), Adam's step size
    ent_coef: Tensor  # (P,)
    reference: Reference | None

    @classmethod
    def of(cls, config: PPO, state: Any, rollout: Rollout) -> Terms:
        """Those of an update from this rollout."""
        progress = rollout.progress
        rate = rate_now(config, state.learning_rate, progress)
        ent_coef, final = state.ent_coef, config.ent_coef_final
        if final is not None:
            ent_coef = torch.lerp(ent_coef, torch.full_like(ent_coef, final), progress)
        return cls(rate, ent_coef, rollout.reference)


def epsilon_now(config: PPO | SkillCritic, progress: float, like: Tensor) -> Tensor | None:
    """The share of actions that is drawn uniformly, (P, 1, 1); None: there is no such share.

    Args:
        like: (P,).
    """
    first, last = config.epsilon, config.epsilon_final
    if max(first, last or 0.0) == 0.0:
        return None
    fallen = min(1.0, progress / max(config.epsilon_fraction, 1e-9))
    share = first if last is None else first + fallen * (last - first)
    return torch.full((len(like), 1, 1), share, dtype=torch.float32, device=like.device)


@torch.no_grad()
def samples_of(
    agent: PPOAlgorithm, state: State, rollout: Rollout, now: Terms
) -> tuple[Samples, dict[str, Tensor]]:
    """What ``loss`` needs of a rollout without gaps, and metrics (P,)."""
    cfg, memory, starts = agent.config, rollout.recurrent_state, rollout.episode_start
    if not agent.memory_size:
        memory = starts = None
    cells = Cells(rollout, all_cells=memory is not None)
    obs, valid = cells.flat(rollout.obs), cells.flat_or_none(rollout.valid)
    agent.update_obs_stats(state, obs, valid)
    params = agent.learning_params(state)
    inputs = agent.inputs(params, obs)
    if memory is not None:
        inputs = {k: cells.unflat(v) for k, v in inputs.items()}
    raw, after = agent.run(agent.critic_net, params.views, inputs, memory, starts)
    value = agent.in_rewards(state, raw)
    following = next_values(agent, state, params, rollout, cells.grid(value), after)
    reward, discount, last = rollout.reward, rollout.discount, rollout.last
    grid = gae(reward, discount, cells.grid(value), following, last, state.gae_lambda)
    advantage = cells.flat(grid)
    returns = advantage + value
    metrics = {"explained_variance": explained_variance(value, returns, valid)}
    if cfg.normalize_returns:
        agent.update_return_stats(state, returns, valid)
    mean, scale = state.return_mean, state.return_scale
    action, mask = cells.flat(rollout.action), cells.flat_or_none(rollout.mask)
    # Clipping and KL count from the policy as it is now, whoever acted: an older one, or one with a
    # epsilon. A ratio of mixtures would let the policy collapse within the clip where epsilon is
    # high: all it can change in the mixture is 1 − epsilon.
    head, _ = agent.run(agent.actor_net, params.views, inputs, memory, starts)
    log_prob, _ = agent.head.stats(head, params.views.get("actor.log_std"), mask, action)
    own = _own(cells.flat_or_none(rollout.overridden), valid)
    samples = Samples(
        inputs={} if memory is not None else inputs,
        action=action,
        log_prob=log_prob,
        importance=likelihood_ratio(log_prob, _acted(agent, rollout, cells, mask, action)),
        advantage=_advantage(agent, advantage, cells.flat_or_none(rollout.advantage), own),
        reference=_reference(agent, now, rollout, cells),
        target=(returns - mean) / scale,
        old_value=None if cfg.clip_value is None else (value - mean) / scale,
        mask=mask,
        valid=valid,
        own=own,
        most=cells.most,
    )
    if memory is not None:
        samples = samples.changed(cells.unflat)
        samples.inputs, samples.memory, samples.starts = inputs, memory, starts
    return samples, metrics


def _own(overridden: Tensor | None, valid: Tensor | None) -> Tensor | None:
    """Samples that the policy learns from, (P, N) bool: a reflex's action says nothing of it."""
    if overridden is None:
        return valid
    return ~overridden if valid is None else valid & ~overridden


def _reference(agent: PPOAlgorithm, now: Terms, rollout: Rollout, cells: Cells) -> Tensor | None:
    """Heads (P, N, H) of the policy that the learner is to stay near.

    Where there is a memory, it runs along each trajectory. What the reference would remember from
    before the rollout's first row is not known; the learner, who is near, says it.
    """
    if now.reference is None:
        return None
    if now.reference.params is None:
        return cells.flat_or_none(rollout.guide)
    params, recurrent = now.reference.params, bool(agent.memory_size)
    inputs = agent.inputs(params, cells.flat(rollout.obs))
    if recurrent:
        inputs = {k: cells.unflat(v) for k, v in inputs.items()}
    memory, starts = (rollout.recurrent_state, rollout.episode_start) if recurrent else (None, None)
    return agent.run(agent.actor_net, params.views, inputs, memory, starts)[0]


def _advantage(
    agent: PPOAlgorithm, own: Tensor, other: Tensor | None, counts: Tensor | None
) -> Tensor:
    """The learner's own advantage, and what counts beside it in the same units, (P, N)."""
    if agent.config.normalize_advantage:
        own = normalise(own, counts, min_std=agent.config.min_advantage_std)
    return own if other is None else own + other


def _acted(
    agent: PPOAlgorithm, rollout: Rollout, cells: Cells, mask: Tensor | None, action: Tensor
) -> Tensor:
    """Log-probabilities (P, N) of the actions by the policy that acted."""
    assert rollout.dist_params is not None
    log_std = rollout.log_std
    if log_std is not None:
        one = log_std.shape[2] == 1
        log_std = log_std[:, 0] if one else cells.flat(log_std.expand(-1, cells.shape[0], -1, -1))
    return agent.head.stats(cells.flat(rollout.dist_params), log_std, mask, action)[0]


def next_values(
    agent: PPOAlgorithm,
    state: State,
    params: ActingParams,
    rollout: Rollout,
    value: Tensor,
    after: Tensor | None,
) -> Tensor:
    """V(next_obs), (P, T, B): V(obs), (P, T, B), of the next row, except at ends.

    Args:
        after: (P, T·B, M), the critic's memory after each row, if it has one.
    """

    def at_ends(rows: Tensor) -> Tensor:
        inputs = agent.inputs(params, take_rows(rollout.next_obs.flatten(1, 2), rows))
        if after is None:
            raw = agent.critic_net(params.views, inputs)
        else:
            raw, _ = agent.critic_net.step(params.views, inputs, take_rows(after, rows))
        return agent.in_rewards(state, raw)

    return values_after(value, rollout.last, at_ends)
