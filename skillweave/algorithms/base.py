"""The base of all algorithms: spaces, observation scaling, and parameters as a policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NoReturn, TypeVar

import gymnasium as gym
import torch
from torch import Tensor

from skillweave._internal.prefixes import prefixed
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Report
from skillweave.algorithms.config import check_spaces
from skillweave.algorithms.parameters import ParameterGroup, member_setting
from skillweave.algorithms.schedules import is_schedule
from skillweave.errors import DeclarationError
from skillweave.networks.heads import ActionHead, JointHead
from skillweave.networks.stacked import Inputs, Layout, Views
from skillweave.ops.device import FLOAT, INT
from skillweave.ops.moments import CLIP, merge_moments, scale_of
from skillweave.ops.optim import adam_, clip_grad_norm_
from skillweave.ops.threads import torch_threads
from skillweave.policies.core import Array
from skillweave.spaces import (
    ActionCodec,
    ChoiceSpace,
    NumberedChoiceCodec,
    ObsCodec,
    action_codec,
    choice_codec,
    numbered_choice_codec,
    obs_codec,
)

S = TypeVar("S")
Device = torch.device | str
OBS_STATS = ("obs_mean", "obs_var", "obs_low", "obs_high", "obs_count")
"""The fields of a state that its policy's weights also hold, where observations are normalised."""


@dataclass
class AgentState:
    """State of any algorithm: P members, D parameters, O observation numbers."""

    HOST: ClassVar[tuple[str, ...]] = ()
    """Fields that stay on the CPU, because Python decides by them."""

    params: Tensor  # (P, D)
    mu: Tensor  # (P, D), Adam's first moment
    nu: Tensor  # (P, D), Adam's second moment
    count: Tensor  # (P,) int64, Adam's steps; (P, D) where parameters differ in age
    obs_mean: Tensor  # (P, O)
    obs_var: Tensor  # (P, O)
    obs_low: Tensor  # (P, O), the lowest number seen
    obs_high: Tensor  # (P, O)
    obs_count: Tensor  # (P,)
    return_mean: Tensor  # (P, 1)
    return_var: Tensor  # (P, 1)
    return_count: Tensor  # (P,)
    learning_rate: Tensor  # (P,), of each member
    gamma: Tensor  # (P,), of each member

    @property
    def return_scale(self) -> Tensor:
        """Return the deviation of returns, (P, 1)."""
        return scale_of(self.return_mean, self.return_var)


def state_to(state: S, device: Device) -> S:
    """Return the state on a device; tensors that are there already are not copied."""
    stay: tuple[str, ...] = getattr(state, "HOST", ())
    moved = {k: v if k in stay else v.to(device) for k, v in vars(state).items()}
    return type(state)(**moved)


@dataclass
class ActingParams:
    """A copy of the part of a state that acting needs, so that learning may continue beside it."""

    views: Mapping[str, Tensor]  # the parameters that act, each (P, *shape)
    shift: Tensor | None  # (P, 1, O), where observations are normalised
    scale: Tensor | None  # (P, 1, O)
    extra: dict[str, Tensor] = field(default_factory=dict)  # of exploration, such as ε, (P, 1)

    def state(self) -> dict[str, Tensor]:
        """Return copies of the tensors by name, (P, ...) each, for a checkpoint."""
        scaling = {"shift": self.shift, "scale": self.scale}
        tensors = {k: v for k, v in scaling.items() if v is not None}
        tensors |= prefixed("views", self.views) | prefixed("extra", self.extra)
        return {k: v.detach().to("cpu", copy=True).contiguous() for k, v in tensors.items()}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Load a ``state`` of acting parameters of the same algorithm.

        Weights are copied in place: the last bit of a product of matrices can depend on where they
        lie in memory.
        """
        for name, view in self.views.items():
            view.copy_(state[f"views.{name}"])
        self.shift, self.scale = (
            None if x is None else state[name].clone()
            for name, x in (("shift", self.shift), ("scale", self.scale))
        )
        self.extra = {name: state[f"extra.{name}"].clone() for name in self.extra}


def read_by(config: Any, observation_space: gym.Space[Any], where: str = "") -> ObsCodec:
    """Return the codec by which the networks of settings read observations.

    Args:
        config: settings of an algorithm.
        where: the start of messages: ``skill 'land': ``.

    Raises:
        DeclarationError: the channels of an image may be in more than one axis.
    """
    networks = [getattr(config, name, None) for name in ("network", "critic")]
    codec = obs_codec(observation_space, getattr(networks[0], "planes", None))
    # Cells are read one by one, so the order of their axes makes no difference.
    ordered = any(n is not None and getattr(n, "encoder", None) != "cells" for n in networks)
    if codec.unclear and ordered:
        raise DeclarationError(
            f"{where}{codec.unclear[0]} may have its planes (channels) in the first axis or in the "
            f'last: write {type(config).__name__}(network=Network(planes="first")), or '
            'planes="last", with the other settings of the network'
        )
    return codec


class Algorithm:
    """Base class of all algorithms.

    A subclass sets ``layout``, the columns of its state's ``params`` (P, D), and ``acting``, the
    first of them, which acting needs. It defines ``fresh_state``, ``parameter_groups``, ``act``,
    ``value`` and ``update``. Everything learnt is in the state, nothing in this object. The
    arguments are its settings (``config``), ``observation_space`` and ``action_space``.

    Raises:
        DeclarationError: the algorithm does not support a setting.
    """

    store: ClassVar[Literal["rollout", "replay"]]
    """The kind of batch to learn from: a ``Rollout`` of recent rows or a ``Sample`` of replay."""
    action_spaces: ClassVar[tuple[type[gym.Space[Any]], ...]]
    """The kinds of action spaces that the algorithm supports."""
    state_type: ClassVar[Any] = AgentState
    """The dataclass of the state's tensors."""
    raw: ClassVar[tuple[str, ...]] = ()
    """Raw columns of experience to learn from, too: "env_reward", the environment's own."""
    member_hyperparameters: ClassVar[tuple[str, ...]] = ("learning_rate", "gamma")
    """Fields of the config with one value per member; the state has a tensor (P,) of each."""
    follows_schedules: ClassVar[bool] = False
    """True if ``update`` takes its learning rate from ``rate_now``: then it may be a schedule."""
    config: Any
    layout: Layout
    acting: Layout
    head: ActionHead | JointHead
    memory_size: int = 0
    """M, the size of an environment's recurrent state; 0: the networks have none."""

    def __init__(
        self, config: Any, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        check_spaces(config, action_space)
        if is_schedule(config.learning_rate) and not self.follows_schedules:
            raise DeclarationError(
                f"{type(config).__name__}.learning_rate is a schedule, but {type(self).__name__} "
                "does not follow schedules: give a number"
            )
        self.config = config
        self.observation_space = observation_space
        self.action_space = action_space
        self.obs = read_by(config, observation_space)
        self.codec: ActionCodec
        if not isinstance(action_space, ChoiceSpace):
            self.codec = action_codec(action_space)
        elif self.store == "replay":  # it learns a value of each choice
            self.codec = numbered_choice_codec(action_space)
        else:
            self.codec = choice_codec(action_space)
        self.normalize_obs = config.normalize_obs and self.obs.scaled

    # Methods that an algorithm defines

    def fresh_state(self, seeds: Sequence[Seeds]) -> Any:
        """Create the state of fresh members, one per node of ``seeds``; see ``fresh_fields``."""
        self._missing("fresh_state")

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return the groups of state fields that have the shape of networks."""
        self._missing("parameter_groups")

    def act(
        self,
        params: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Any,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Return actions in policy units, their dist_params, and the recurrent state after them.

        Args:
            params: of ``acting_params`` or ``learning_params``.
            obs: (P, B, *item), raw.
            mask: (P, B, A) bool, allowed actions, or None: all.
            noise: one step of ``noise``, or None to act greedily.
            memory: recurrent state (P, B, M), for networks that have one.
        """
        self._missing("act")

    def value(self, state: Any, obs: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the expected return, (P, B), in units of reward.

        Args:
            state: of P members.
            obs: (P, B, *item), raw.
            mask: (P, B, A) bool, allowed actions, or None: all.
        """
        self._missing("value")

    def update(self, state: Any, batch: Any, rng: Sequence[torch.Generator]) -> tuple[Any, Report]:
        """Learn from a batch, in place; return the state and a report of metrics.

        Args:
            state: of P members.
            batch: of the kind that ``store`` names, on the device of the state.
            rng: one generator per member, on the CPU.
        """
        self._missing("update")

    # Methods that all algorithms share

    def init(self, seeds: Sequence[Seeds]) -> Any:
        """Create fresh members on the CPU, one per node of ``seeds``, each independent."""
        with torch_threads(1):  # the last bits of a QR decomposition depend on the thread count
            return self.fresh_state(seeds)

    def member_generators(self, seeds: Sequence[Seeds]) -> list[torch.Generator]:
        """Return the generators of fresh members' weights, one for each of ``seeds``."""
        return [(s / "init").torch() for s in seeds]

    def fresh_fields(self, params: Tensor) -> dict[str, Tensor]:
        """Return the fields that every state has, for fresh ``params`` (P, D)."""
        members = len(params)
        largest = torch.finfo(torch.float32).max
        return {
            "params": params,
            "mu": torch.zeros_like(params),
            "nu": torch.zeros_like(params),
            "count": torch.zeros(members, **INT),
            "obs_mean": torch.zeros(members, self.obs.size, **FLOAT),
            "obs_var": torch.ones(members, self.obs.size, **FLOAT),
            "obs_low": torch.full((members, self.obs.size), largest, **FLOAT),
            "obs_high": torch.full((members, self.obs.size), -largest, **FLOAT),
            "obs_count": torch.zeros(members, **FLOAT),
            "return_mean": torch.zeros(members, 1, **FLOAT),
            "return_var": torch.ones(members, 1, **FLOAT),
            "return_count": torch.zeros(members, **FLOAT),
            **{
                k: torch.full((members,), member_setting(self.config, k), **FLOAT)
                for k in self.member_hyperparameters
            },
        }

    def acting_params(
        self, state: Any, progress: float = 1.0, device: Device = "cpu"
    ) -> ActingParams:
        """Copy the part of a ``state`` that acting needs to a ``device``.

        ``progress`` is the share of the budget that is spent.
        """
        flat = state.params[:, : self.acting.size].detach().to(device, copy=True)
        shift, scale = (None if x is None else x.to(device) for x in self.scaling(state))
        numbers = self.exploration(state, progress)
        extra = {name: x.to(device, copy=True) for name, x in numbers.items()}
        return ActingParams(self.acting.views(flat), shift, scale, extra)

    def exploration(self, state: Any, progress: float) -> dict[str, Tensor]:
        """Return the numbers that exploration depends on now, such as ε, (P, …); by default none.

        Args:
            state: of P members.
            progress: the share of the budget that is spent.
        """
        return {}

    def learning_params(self, state: Any) -> ActingParams:
        """Return the acting parameters of a ``state`` without copying, for learning."""
        return ActingParams(self.layout.views(state.params), *self.scaling(state))

    def scaling(self, state: Any) -> tuple[Tensor | None, Tensor | None]:
        """Return a ``state``'s shift and scale of observations, (P, 1, O); None: not normalised."""
        if not self.normalize_obs:
            return None, None
        return _scaling(state.obs_mean, state.obs_var)

    def layouts(self) -> dict[str, Layout]:
        """Return the layout of each state field that holds parameters or their moments."""
        groups = self.parameter_groups()
        return {name: g.layout for g in groups for name in (*g.weights, *g.moments)}

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of one member's ``weights``."""
        scaling = dict.fromkeys(OBS_STATS, (self.obs.size,)) | {"obs_count": ()}
        return self.layout.shapes | (scaling if self.normalize_obs else {})

    def weights(self, state: Any, member: int = 0) -> dict[str, Tensor]:
        """Copy the policy of a ``member`` of a ``state``: parameters (*shape), scaling (O,)."""
        named = {k: v[member] for k, v in self.layout.views(state.params).items()}
        if self.normalize_obs:
            named |= {k: getattr(state, k)[member] for k in OBS_STATS}
        return {k: v.detach().to("cpu", copy=True) for k, v in named.items()}

    def set_weights(self, state: Any, weights: Mapping[str, Tensor]) -> None:
        """Load ``weights`` into a ``state`` of one member, in place; its slow copy too."""
        for name in self.parameter_groups()[0].weights:
            for k, view in self.layout.views(getattr(state, name)).items():
                view[0].copy_(weights[k])
        if self.normalize_obs:
            for k in OBS_STATS:
                getattr(state, k)[0].copy_(weights[k])

    def acting_params_of(self, weights: Mapping[str, Tensor]) -> ActingParams:
        """Return the acting parameters of one member's ``weights`` (P = 1)."""
        views = {k: weights[k][None].clone() for k in self.acting.shapes}
        if not self.normalize_obs:
            return ActingParams(views, None, None)
        return ActingParams(views, *_scaling(weights["obs_mean"][None], weights["obs_var"][None]))

    def inputs(self, params: ActingParams, obs: Tensor) -> Inputs:
        """Convert raw ``obs`` (P, B, *item) to the network's inputs, scaled by ``params``.

        Images are not scaled.
        """
        vector, images = self.obs.split(obs)
        inputs = {f"image.{i}": image for i, image in enumerate(images)}
        if self.obs.size:
            if params.shift is not None and params.scale is not None:
                vector = ((vector - params.shift) * params.scale).clamp(-CLIP, CLIP)
            inputs["vector"] = vector
        return inputs

    def noise(self, generators: Sequence[torch.Generator], steps: int, batch: int) -> Any:
        """Draw exploration noise for ``steps`` calls of ``act`` on (P, ``batch``) rows, by step.

        ``generators`` has one generator per member.
        """
        return self.head.noise(generators, steps, batch)

    def step_(
        self,
        state: Any,
        loss: Tensor,
        leaves: Views,
        rate: Tensor,
        max_norm: Tensor | None = None,
        active: Tensor | None = None,
    ) -> Tensor:
        """Take one step of Adam on ``state.params``; return the unclipped gradient norm, (P,).

        Args:
            state: of P members.
            loss: (P,), of ``leaves``.
            leaves: of ``layout``.
            rate: (P,), the learning rate.
            max_norm: (P,), gradients are scaled down to it; None: ``state.max_grad_norm``.
            active: (P,) bool, members that change; None: all.
        """
        grad = self.layout.gradient(loss, leaves)
        norm = clip_grad_norm_(grad, state.max_grad_norm if max_norm is None else max_norm)
        moments = (state.mu, state.nu, state.count)
        eps = self.config.adam_eps
        adam_(state.params, grad, *moments, rate, eps=eps, active=active)
        return norm

    def update_obs_stats(
        self, state: Any, obs: Tensor, valid: Tensor | None = None, *, scales: bool = True
    ) -> None:
        """Update the running moments and the range of observations, in place.

        Args:
            state: of P members.
            obs: (P, B, *item), raw.
            valid: (P, B) bool, rows that count; None: all.
            scales: False: the moments stay, and with them how observations are scaled.
        """
        if self.normalize_obs:
            vector, _ = self.obs.split(obs)
            if scales:
                state.obs_mean, state.obs_var, state.obs_count = merge_moments(
                    state.obs_mean, state.obs_var, state.obs_count, vector, valid
                )
            if valid is not None:
                vector = torch.where(valid[..., None], vector, state.obs_mean[:, None])
            state.obs_low = state.obs_low.minimum(vector.amin(1))
            state.obs_high = state.obs_high.maximum(vector.amax(1))

    def update_return_stats(self, state: Any, returns: Tensor, valid: Tensor | None = None) -> None:
        """Update the moments in ``state`` with ``returns`` (P, B) where ``valid`` (P, B)."""
        moments = state.return_mean, state.return_var, state.return_count
        state.return_mean, state.return_var, state.return_count = merge_moments(
            *moments, returns[..., None], valid
        )

    def widened(self, mask: Array | None) -> Array | None:
        """Return a ``mask`` of skills (n, choices) as one of actions (n, A) with their goals."""
        if mask is None or not isinstance(self.codec, NumberedChoiceCodec):
            return mask
        widened: Array = mask[:, self.codec.number_of_choice]
        return widened

    def to_env(self, action: Array) -> Array:
        """Convert an ``action`` (n, …) from policy units to the environment's."""
        return self.codec.to_env(action)

    def _missing(self, method: str) -> NoReturn:
        raise DeclarationError(
            f"{type(self).__name__} has no method {method!r}, which every algorithm needs; "
            "see skillweave.algorithms.Algorithm"
        )


REQUIRED = ("fresh_state", "parameter_groups", "act", "value", "update")
"""Methods that an algorithm must define."""


def _scaling(mean: Tensor, var: Tensor) -> tuple[Tensor, Tensor]:
    """Compute shift and scale (P, 1, O) from moments (P, O); both are copies."""
    return mean[:, None].clone(), scale_of(mean, var).reciprocal()[:, None]
