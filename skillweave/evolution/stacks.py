"""Stacks: members that share one set of tensors while they learn.

Between generations members are independent; ``join`` puts members of one architecture into a stack,
``split`` takes them out again. Members whose hidden layers differ in width are padded with zeros to
the widest: a unit without incoming and outgoing weights always stays at zero, so a padded member
learns as it would alone, except for the last bits of its numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.algorithms.parameters import ParameterGroup
from skillweave.algorithms.schedules import is_schedule
from skillweave.networks.config import Network
from skillweave.networks.stacked import Layout
from skillweave.runs.manifest import Origin

SETTLED = 1 << 15
"""Steps after which Adam's corrections are 1: 0.999 to this power is below float32's ε."""


@dataclass
class Member:
    """An agent of a population, with its own settings and architecture."""

    number: int
    config: AlgorithmConfig
    state: Any  # of its algorithm, P = 1
    steps: int = 0  # environment steps that it and its ancestors were trained for
    origin: Origin = field(default_factory=Origin)

    def algorithm(self, spaces: tuple[Any, Any]) -> Algorithm:
        """Create its algorithm on (observation space, action space)."""
        return make_algorithm(self.config, *spaces)


def networks_of(config: AlgorithmConfig) -> dict[str, Network]:
    """Return the architectures in settings, by field."""
    values = {name: getattr(config, name, None) for name in ("network", "critic")}
    return {name: network for name, network in values.items() if isinstance(network, Network)}


def copy(member: Member) -> Member:
    """Copy a member of a population with its tensors."""
    state = {k: v.clone() for k, v in vars(member.state).items()}
    return replace(member, state=type(member.state)(**state))


def stack_key(config: AlgorithmConfig, settings: Sequence[str]) -> AlgorithmConfig:
    """Return the settings that members of a stack share: all except ``settings`` and widths.

    Layer norm divides by a statistic of all units of a layer, so with it widths count, too.
    """
    kind = type(config)
    changes: dict[str, Any] = {k: kind.__dataclass_fields__[k].default for k in settings}
    if is_schedule(config.learning_rate):
        del changes["learning_rate"]  # one for all members of a stack
    for name, network in networks_of(config).items():
        if not network.layer_norm:
            changes[name] = replace(network, hidden=(1,) * len(network.hidden))
    return replace(config, **changes)


def grouped(members: Sequence[Member], spaces: tuple[Any, Any]) -> list[list[Member]]:
    """Group members by their stack, in the order in which stacks first appear."""
    groups: dict[AlgorithmConfig, list[Member]] = {}
    for member in members:
        key = stack_key(member.config, member.algorithm(spaces).member_hyperparameters)
        groups.setdefault(key, []).append(member)
    return list(groups.values())


def join(
    members: Sequence[Member],
    spaces: tuple[Any, Any],
    made: dict[AlgorithmConfig, Algorithm] | None = None,
) -> tuple[Algorithm, Any]:
    """Return a stack of members: the algorithm of the widest network, and one state; copies.

    ``made`` caches algorithms, so that a compiled one need not be compiled again.
    """
    first = members[0]
    key = stack_key(first.config, first.algorithm(spaces).member_hyperparameters)
    widest: dict[str, Any] = {
        name: _widest([getattr(m.config, name) for m in members])
        for name in networks_of(first.config)
    }
    config = replace(key, **widest)
    made = {} if made is None else made
    if config not in made:
        made[config] = make_algorithm(config, *spaces)
    algorithm = made[config]
    wide = algorithm.layouts()
    padded = []
    uneven = [
        f for f in algorithm.parameter_groups() if any(_count(m, f).ndim > 1 for m in members)
    ]
    for member in members:
        layouts = member.algorithm(spaces).layouts()
        tensors = {f.name: getattr(member.state, f.name) for f in fields(member.state)}
        tensors |= {k: pad(v, layouts[k], wide[k]) for k, v in tensors.items() if k in wide}
        for f in uneven:
            like = f.weights[0]
            each = spread_count(_count(member, f), getattr(member.state, like))
            tensors[f.count] = pad(each, layouts[like], wide[like])
        padded.append(tensors)
    joined = {k: torch.cat([p[k] for p in padded]) for k in padded[0]}
    return algorithm, algorithm.state_type(**joined)


def split(
    algorithm: Algorithm, state: Any, members: Sequence[Member], spaces: tuple[Any, Any]
) -> None:
    """Copy each member's part of a stack's state to the member; the inverse of ``join``."""
    wide = algorithm.layouts()
    for i, member in enumerate(members):
        layouts = member.algorithm(spaces).layouts()
        tensors = {f.name: getattr(state, f.name)[i : i + 1].clone() for f in fields(state)}
        tensors |= {k: crop(v, wide[k], layouts[k]) for k, v in tensors.items() if k in wide}
        for f in algorithm.parameter_groups():
            if (count := tensors[f.count]).ndim > 1:
                like = f.weights[0]
                tensors[f.count] = even_count(crop(count, wide[like], layouts[like]))
        member.state = algorithm.state_type(**tensors)


def spread_count(count: Tensor, like: Tensor) -> Tensor:
    """Return Adam's steps by parameter (P, …, D), expanded from steps by member (P,)."""
    return count.view(*count.shape, *[1] * (like.ndim - count.ndim)).expand_as(like)


def even_count(count: Tensor) -> Tensor:
    """Return Adam's steps as (P,) if all parameters of each member have one age, else unchanged.

    Ages also count as equal if all are so large that Adam's corrections are 1.
    """
    rows = count.flatten(1)
    oldest = rows.amax(1)
    same = (rows == oldest[:, None]) | (rows >= SETTLED)
    return oldest if bool(same.all()) else count


def _count(member: Member, family: ParameterGroup) -> Tensor:
    count: Tensor = getattr(member.state, family.count)
    return count


def pad(flat: Tensor, narrow: Layout, wide: Layout) -> Tensor:
    """Pad parameters (…, D) with zeros to a wider layout (…, D′)."""
    rows = flat.reshape(-1, flat.shape[-1])
    padded = rows.new_zeros(len(rows), wide.size)
    into = wide.views(padded)
    for name, view in narrow.views(rows).items():
        into[name][_corner(view)] = view
    return padded.view(*flat.shape[:-1], wide.size)


def crop(flat: Tensor, wide: Layout, narrow: Layout) -> Tensor:
    """Crop parameters (…, D′) to the narrower layout (…, D)."""
    rows = flat.reshape(-1, flat.shape[-1])
    cropped = rows.new_zeros(len(rows), narrow.size)
    outof = wide.views(rows)
    for name, view in narrow.views(cropped).items():
        view.copy_(outof[name][_corner(view)])
    return cropped.view(*flat.shape[:-1], narrow.size)


def _corner(view: Tensor) -> tuple[slice, ...]:
    """Return the first entries along each axis, as many as ``view`` has."""
    return tuple(slice(n) for n in view.shape)


def _widest(networks: Sequence[Network]) -> Network:
    widths = zip(*(n.hidden for n in networks), strict=True)
    return replace(networks[0], hidden=tuple(max(w) for w in widths))
