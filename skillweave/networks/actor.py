"""What acts: observation scaling, a network, an action head. Shared by every algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave.networks.config import MLP
from skillweave.networks.heads import ActionHead
from skillweave.networks.stacked import Layout, mlp, mlp_shapes
from skillweave.ops.distributions import mask_logits
from skillweave.spaces import action_codec, obs_codec


@dataclass
class Actor:
    """What acting needs of an algorithm's state: a copy, so that learning may go on beside it."""

    views: dict[str, Tensor]  # the actor's parameters, each (P, *shape)
    shift: Tensor | None  # (P, 1, O), where observations are normalised
    scale: Tensor | None  # (P, 1, O)


class ActorNet:
    """An actor's architecture on one pair of spaces; parameters are given to each call."""

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        network: MLP,
        normalize_obs: bool,
    ) -> None:
        self.obs, self.head = obs_codec(observation_space), ActionHead(action_codec(action_space))
        self.network = network
        self.normalize_obs = normalize_obs and self.obs.scaled
        shapes = mlp_shapes("actor", self.obs.size, network, self.head.size)
        if not self.head.discrete:
            shapes["actor.log_std"] = (1, self.head.size)
        self.layout = Layout(shapes)

    def copy(self, params: Tensor, obs_mean: Tensor, obs_var: Tensor) -> Actor:
        """An actor from flat parameters (P, ≥ D), the actor's first, and moments (P, O)."""
        views = self.layout.views(params[:, : self.layout.size].clone())
        if not self.normalize_obs:
            return Actor(views, None, None)
        return Actor(views, obs_mean[:, None].clone(), (obs_var + 1e-8).rsqrt()[:, None])

    def from_weights(self, weights: Mapping[str, Tensor]) -> Actor:
        """One member's actor from tensors by name (P = 1)."""
        flat = self.layout.flatten({k: weights[k][None] for k in self.layout.shapes})
        nothing = torch.zeros(self.obs.size)
        moments = (weights.get(f"obs_{k}", nothing)[None] for k in ("mean", "var"))
        return self.copy(flat, *moments)

    def inputs(self, actor: Actor, obs: Tensor) -> Tensor:
        """Raw observations (P, B, *obs_shape) as the network's inputs (P, B, O)."""
        x = self.obs.encode(obs)
        if actor.shift is None or actor.scale is None:
            return x
        return ((x - actor.shift) * actor.scale).clamp(-10.0, 10.0)

    def act(
        self, actor: Actor, obs: Tensor, mask: Tensor | None, noise: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Actions in policy units, and the head they came from.

        Args:
            obs: (P, B, *obs_shape), raw.
            mask: (P, B, A) bool or None.
            noise: (P, B, A), or None to act greedily.

        Returns:
            Actions (P, B) int64 or (P, B, A) float; head (P, B, A).
        """
        head = mlp(actor.views, "actor", self.network, self.inputs(actor, obs))
        if self.head.discrete:
            head = mask_logits(head, mask)
        return self.head.act(head, actor.views.get("actor.log_std"), noise), head
