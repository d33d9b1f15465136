"""Batches for algorithms, made of the records of a user's training loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.batches import Rollout, Sample
from skillweave.algorithms.ppo import PPOAlgorithm, State
from skillweave.networks.heads import ActionHead


def returns_of(
    env: Any, act: Callable[[Any], Any], episodes: int, max_steps: int
) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Play episodes of at most ``max_steps`` steps by ``act(obs)``; return their returns.

    In a vector environment only the first environment counts.
    """
    returns = np.zeros(episodes)
    for i in range(episodes):
        obs = env.reset()[0]
        for _ in range(max_steps):
            action = act(obs)
            obs, *step = env.step(action if hasattr(env, "num_envs") else action[0])
            reward, terminated, truncated = (np.ravel(x)[0] for x in step[:3])
            returns[i] += reward
            if terminated or truncated:
                break
    return returns


def rollout_of(
    algorithm: PPOAlgorithm,
    state: State,
    obs: Any,
    action: Any,
    log_prob: Any,
    reward: Any,
    terminated: Any,
    next_obs: Any,
) -> Rollout:
    """Return T steps of N environments as a rollout; each argument has T entries (N, ...).

    The successor of a step is the next entry of ``obs``; ``next_obs`` belongs to the last step.
    Actions are in policy units, and count as drawn with the log-probabilities given.
    """
    rewards = _tensor(reward, np.float32)
    lead = 1, len(rewards), max(1, rewards[0].numel())
    before = _rows(algorithm, obs).unflatten(0, lead)
    after = _rows(algorithm, next_obs)[None, None]
    ended = _tensor(terminated, bool).view(lead)
    last = ended.clone()
    last[:, -1] = True
    kind = np.int64 if algorithm.codec.discrete else np.float32
    actions = _tensor(action, kind).view(*lead, *(algorithm.action_space.shape or ()))
    discount = state.gamma[:, None, None] * ~ended
    following = torch.cat([before[:, 1:], after], 1)
    log_std = algorithm.layout.views(state.params).get("actor.log_std")
    log_std = None if log_std is None else log_std[:, None].clone()
    log_probs = _tensor(log_prob, np.float32).view(lead)
    assert isinstance(algorithm.head, ActionHead)  # of an agent, not of a selector
    dist_params = algorithm.head.with_log_prob(actions, log_probs, log_std)
    rewards = rewards.view(lead)
    return Rollout(
        before,
        actions,
        rewards,
        discount,
        following,
        last,
        dist_params=dist_params,
        log_std=log_std,
    )


def sample_of(
    algorithm: Algorithm,
    gamma: float,
    obs: Any,
    action: Any,
    reward: Any,
    next_obs: Any,
    terminated: Any,
    weight: Any = None,
) -> Sample:
    """Return B transitions as a sample; environment's actions, γ for all of their steps."""
    rewards = _tensor(reward, np.float32).view(1, -1)
    size = rewards.shape[1]
    shape = algorithm.action_space.shape or ()
    units = algorithm.codec.from_env(np.asarray(action).reshape(size, *shape))
    return Sample(
        _rows(algorithm, obs)[None],
        torch.from_numpy(units)[None],
        rewards,
        gamma * (1.0 - _tensor(terminated, np.float32).view(1, -1)),
        _rows(algorithm, next_obs)[None],
        None,
        None,
        None if weight is None else _tensor(weight, np.float32).view(1, -1),
        np.arange(size)[None],
    )


def _rows(algorithm: Algorithm, obs: Any) -> Tensor:
    """Return observations, however nested, as (n, *shape) with the dtype of the space."""
    space = algorithm.observation_space
    return _tensor(obs, space.dtype).view(-1, *(space.shape or ()))


def _tensor(values: Any, kind: Any) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(np.asarray(values), kind))
