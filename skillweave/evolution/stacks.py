"""Stacks: members that share one set of tensors while they learn (contract 5).

Between generations every member is a thing of its own; ``join`` puts members of one architecture
into a stack, ``split`` takes them out again. Members whose hidden layers differ in width are padded
with zeros to the widest: a unit with no weights in and none out stays at zero for ever, whatever
the others learn, so a padded member is the member alone, but for the last bits of its numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.algorithms.parameters import ParameterGroup
from skillweave.algorithms.policy import make_algorithm
from skillweave.algorithms.schedules import is_schedule
from skillweave.networks.config import Network
from skillweave.networks.stacked import Layout

SETTLED = 1 << 15
"""Steps after which Adam's corrections are exactly 1: 0.999 to this power is below float32's ε."""


@dataclass(frozen=True)
class Origin:
    """Where a member comes from: its parent, and what changed, each setting's old and new value."""

    parent: int | None = None
    mutation: str = "start"
    changes: dict[str, tuple[Any, Any]] = field(default_factory=dict)


@dataclass
class Member:
    """One agent of a population, with settings and architecture of its own."""

    number: int
    config: AlgorithmConfig
    state: Any  # of its algorithm, P = 1
    steps: int = 0  # environment steps that it and its ancestors were trained for
    origin: Origin = field(default_factory=lambda: Origin())

    def algorithm(self, spaces: tuple[Any, Any]) -> Algorithm:
        """Return the algorithm it learns by, on (observation space, action space)."""
        return make_algorithm(self.config, *spaces)


def networks_of(config: AlgorithmConfig) -> dict[str, Network]:
    """Return the architectures that settings hold, by field."""
    found = {name: getattr(config, name, None) for name in ("network", "critic")}
    return {name: network for name, network in found.items() if isinstance(network, Network)}


def copy(member: Member) -> Member:
    """The same member with tensors of its own."""
    state = {k: v.clone() for k, v in vars(member.state).items()}
    return replace(member, state=type(member.state)(**state))


def stack_key(config: AlgorithmConfig, settings: Sequence[str]) -> AlgorithmConfig:
    """What members must have in common to share a stack: all but ``settings`` and widths.

    Layer norm divides by what all units of a layer do, so there widths count, too.
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
    """Members by the stack that they share, in the order in which stacks first appear."""
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
    """Return the algorithm of the widest of all, and one state of P members; copies.

    Algorithms are kept in ``made``: what one of them has compiled need not be compiled again.
    """
    first = members[0]
    key = stack_key(first.config, first.algorithm(spaces).member_hyperparameters)
    widest: dict[str, Any] = {
        name: _widest([getattr(m.config, name) for m in members])
        for name in networks_of(first.config)
    }
    config, made = replace(key, **widest), {} if made is None else made
    if config not in made:
        made[config] = make_algorithm(config, *spaces)
    algorithm = made[config]
    wide, padded = algorithm.layouts(), []
    uneven = [
        f for f in algorithm.parameter_groups() if any(_count(m, f).ndim > 1 for m in members)
    ]
    for member in members:
        own = member.algorithm(spaces).layouts()
        tensors = {f.name: getattr(member.state, f.name) for f in fields(member.state)}
        tensors |= {k: pad(v, own[k], wide[k]) for k, v in tensors.items() if k in wide}
        for f in uneven:
            like = f.weights[0]
            each = spread_count(_count(member, f), getattr(member.state, like))
            tensors[f.count] = pad(each, own[like], wide[like])
        padded.append(tensors)
    joined = {k: torch.cat([p[k] for p in padded]) for k in padded[0]}
    return algorithm, algorithm.state_type(**joined)


def split(
    algorithm: Algorithm, state: Any, members: Sequence[Member], spaces: tuple[Any, Any]
) -> None:
    """Give each member its part of a stack's state: the inverse of ``join``; copies."""
    wide = algorithm.layouts()
    for i, member in enumerate(members):
        own = member.algorithm(spaces).layouts()
        tensors = {f.name: getattr(state, f.name)[i : i + 1].clone() for f in fields(state)}
        tensors |= {k: crop(v, wide[k], own[k]) for k, v in tensors.items() if k in wide}
        for f in algorithm.parameter_groups():
            if (count := tensors[f.count]).ndim > 1:
                like = f.weights[0]
                tensors[f.count] = even_count(crop(count, wide[like], own[like]))
        member.state = algorithm.state_type(**tensors)


def spread_count(count: Tensor, like: Tensor) -> Tensor:
    """Adam's steps of each parameter (P, …, D), as those of a member (P,) or as they are."""
    return count.view(*count.shape, *[1] * (like.ndim - count.ndim)).expand_as(like)


def even_count(count: Tensor) -> Tensor:
    """Adam's steps (P,) where all parameters of each member have one age, else as they are.

    Ages count as one, too, where all have taken so many steps that nothing is left to correct.
    """
    rows = count.flatten(1)
    oldest = rows.amax(1)
    same = (rows == oldest[:, None]) | (rows >= SETTLED)
    return oldest if bool(same.all()) else count


def _count(member: Member, family: ParameterGroup) -> Tensor:
    found: Tensor = getattr(member.state, family.count)
    return found


def pad(flat: Tensor, own: Layout, wide: Layout) -> Tensor:
    """Parameters (…, D) in a wider layout (…, D′), zero where there was nothing."""
    rows = flat.reshape(-1, flat.shape[-1])
    found = rows.new_zeros(len(rows), wide.size)
    into = wide.views(found)
    for name, view in own.views(rows).items():
        into[name][_corner(view)] = view
    return found.view(*flat.shape[:-1], wide.size)


def crop(flat: Tensor, wide: Layout, own: Layout) -> Tensor:
    """Parameters (…, D′) in the narrower layout (…, D) that they were padded from."""
    rows = flat.reshape(-1, flat.shape[-1])
    found = rows.new_zeros(len(rows), own.size)
    outof = wide.views(rows)
    for name, view in own.views(found).items():
        view.copy_(outof[name][_corner(view)])
    return found.view(*flat.shape[:-1], own.size)


def _corner(view: Tensor) -> tuple[slice, ...]:
    """Return the first entries along each axis, as many as ``view`` has."""
    return tuple(slice(n) for n in view.shape)


def _widest(networks: Sequence[Network]) -> Network:
    widths = zip(*(n.hidden for n in networks), strict=True)
    return replace(networks[0], hidden=tuple(max(w) for w in widths))
