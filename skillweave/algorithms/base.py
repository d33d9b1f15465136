"""What every algorithm shares: spaces, observation scaling, and its parameters as a policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import gymnasium as gym
import torch
from torch import Tensor

from skillweave.algorithms.config import AlgorithmConfig, check_spaces
from skillweave.networks.encoders import Inputs
from skillweave.networks.heads import ActionHead
from skillweave.networks.stacked import Layout
from skillweave.ops.optim import merge_moments
from skillweave.ops.threads import torch_threads
from skillweave.seeding import Seeds
from skillweave.spaces import action_codec, obs_codec
from skillweave.types import Array


@dataclass
class Actor:
    """What acting needs of an algorithm's state: a copy, so that learning may go on beside it."""

    views: dict[str, Tensor]  # the parameters that act, each (P, *shape)
    shift: Tensor | None  # (P, 1, O), where observations are normalised
    scale: Tensor | None  # (P, 1, O)
    extra: dict[str, Tensor] = field(default_factory=dict)  # exploration: ε, say, each (P, 1)


@dataclass(frozen=True)
class Family:
    """Fields of a state (..., D) that hold the same networks, so they change together."""

    layout: Layout
    nets: tuple[tuple[str, Any], ...]
    """The networks in the layout, each with the field of the settings that shapes it."""
    weights: tuple[str, ...] = ("params",)
    """What learns, then its slow copy if there is one."""
    moments: tuple[str, ...] = ("mu", "nu")
    """The optimiser's."""
    count: str = "count"
    """The field with the optimiser's steps: (P,), or (..., D) where parameters differ in age."""


LARGEST = torch.finfo(torch.float32).max


def setting_number(value: float | None) -> float:
    """A setting as it stands in a state, where "no limit" (None) is the largest number there is.

    Not infinity: in a state that is not finite something has diverged.
    """
    return LARGEST if value is None else float(value)


class Algorithm:
    """The part of an algorithm that is the same for all.

    A subclass sets ``layout``, the columns of its state's ``params`` (P, D), and ``acting``, the
    first of them, which acting needs; it says how to act, and how to learn.
    """

    state_type: ClassVar[Any]
    """The dataclass of tensors that it learns."""
    settings: ClassVar[tuple[str, ...]] = ()
    """Settings that each member has a value of its own of; all others shape the computation."""
    config: Any
    layout: Layout
    acting: Layout
    head: ActionHead
    memory: int = 0
    """M, numbers that an environment's memory holds; 0: none."""

    def __init__(
        self,
        config: AlgorithmConfig,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
    ) -> None:
        check_spaces(config, action_space)
        self.config = config
        self.observation_space, self.action_space = observation_space, action_space
        self.obs, self.codec = obs_codec(observation_space), action_codec(action_space)
        self.normalize_obs = config.normalize_obs and self.obs.scaled

    def fresh(self, members: int) -> dict[str, Tensor]:
        """The fields that every state has: moments of observations and returns, settings."""
        return {
            "obs_mean": torch.zeros(members, self.obs.size),
            "obs_var": torch.ones(members, self.obs.size),
            "obs_count": torch.full((members,), 1e-4),
            "return_mean": torch.zeros(members, 1),
            "return_var": torch.ones(members, 1),
            "return_count": torch.full((members,), 1e-4),
            **{
                k: torch.full((members,), setting_number(getattr(self.config, k)))
                for k in self.settings
            },
        }

    def actor(self, state: Any, progress: float = 1.0) -> Actor:
        """A copy of what acting needs; ``progress`` is the share of the budget that is spent."""
        views = self.acting.views(state.params[:, : self.acting.size].clone())
        return Actor(views, *self.scaling(state))

    def scaling(self, state: Any) -> tuple[Tensor | None, Tensor | None]:
        """Shift and scale of observations, each (P, 1, O), or None where they are not scaled."""
        if not self.normalize_obs:
            return None, None
        return _scaling(state.obs_mean, state.obs_var)

    def families(self) -> list[Family]:
        """Everything in the state that has the shape of networks."""
        raise NotImplementedError

    def layouts(self) -> dict[str, Layout]:
        """The fields of the state that hold parameters, or moments of them, and their columns."""
        return {name: f.layout for f in self.families() for name in (*f.weights, *f.moments)}

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of one member's ``weights``."""
        scaling = {"obs_mean": (self.obs.size,), "obs_var": (self.obs.size,)}
        return self.layout.shapes | (scaling if self.normalize_obs else {})

    def weights(self, state: Any, member: int = 0) -> dict[str, Tensor]:
        """One member's policy by name: parameters and observation scaling, copied."""
        named = {k: v[member].clone() for k, v in self.layout.views(state.params).items()}
        if self.normalize_obs:
            named |= {k: getattr(state, k)[member].clone() for k in ("obs_mean", "obs_var")}
        return named

    def set_weights(self, state: Any, weights: Mapping[str, Tensor]) -> None:
        """The inverse of ``weights`` for a state of one member, in place; its slow copy follows."""
        for name in self.families()[0].weights:
            for k, view in self.layout.views(getattr(state, name)).items():
                view[0].copy_(weights[k])
        if self.normalize_obs:
            for k in ("obs_mean", "obs_var"):
                getattr(state, k)[0].copy_(weights[k])

    def actor_of(self, weights: Mapping[str, Tensor]) -> Actor:
        """The actor of one member's ``weights`` (P = 1)."""
        views = {k: weights[k][None].clone() for k in self.acting.shapes}
        if not self.normalize_obs:
            return Actor(views, None, None)
        return Actor(views, *_scaling(weights["obs_mean"][None], weights["obs_var"][None]))

    def inputs(self, actor: Actor, obs: Tensor) -> Inputs:
        """Raw observations (P, B, *item) as the network's inputs; images stay as they came."""
        vector, images = self.obs.split(obs)
        found = {f"image.{i}": image for i, image in enumerate(images)}
        if self.obs.size:
            if actor.shift is not None and actor.scale is not None:
                vector = ((vector - actor.shift) * actor.scale).clamp(-10.0, 10.0)
            found["vector"] = vector
        return found

    def noise(self, generators: list[torch.Generator], steps: int, batch: int) -> Any:
        """Exploration noise for ``steps`` calls of ``act``, by step; a stream a member."""
        return self.head.noise(generators, steps, batch)

    def act(
        self,
        actor: Actor,
        obs: Tensor,
        mask: Tensor | None,
        noise: Any,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Actions in policy units, what they were chosen from, and the memory after them.

        Args:
            obs: (P, B, *item), raw.
            mask: (P, B, A) bool, allowed actions, or None: all.
            noise: one step of ``noise``, or None to act greedily.
            memory: (P, B, M), for networks that have one.
        """
        raise NotImplementedError

    def init(self, seeds: list[Seeds]) -> Any:
        """Fresh members, one for each seed; a member does not depend on its neighbours."""
        with torch_threads(1):  # of a QR decomposition, the last bits depend on their number
            return self._fresh_state(seeds)

    def _fresh_state(self, seeds: list[Seeds]) -> Any:
        """What ``init`` returns."""
        raise NotImplementedError

    def see(self, state: Any, obs: Tensor) -> None:
        """Take observations (P, B, *item) into account in the running moments, in place."""
        if self.normalize_obs:
            moments = state.obs_mean, state.obs_var, state.obs_count
            vector, _ = self.obs.split(obs)
            state.obs_mean, state.obs_var, state.obs_count = merge_moments(*moments, vector)

    def see_returns(self, state: Any, returns: Tensor) -> None:
        """Take returns (P, B) into account in their running moments, in place."""
        moments = state.return_mean, state.return_var, state.return_count
        state.return_mean, state.return_var, state.return_count = merge_moments(
            *moments, returns[..., None]
        )

    def to_env(self, action: Array) -> Array:
        """Policy units (n, …) to the environment's."""
        return self.codec.to_env(action)

    def member_generators(self, seeds: list[Seeds]) -> list[torch.Generator]:
        """The generators of fresh members' weights."""
        return [(s / "init").torch() for s in seeds]


def _scaling(mean: Tensor, var: Tensor) -> tuple[Tensor, Tensor]:
    """Shift and scale (P, 1, O) from moments (P, O); copies."""
    return mean[:, None].clone(), (var + 1e-8).rsqrt()[:, None]
