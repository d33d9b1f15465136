"""Mutations from a parent to its heir: a setting, weights, the architecture, an activation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.algorithms.parameters import setting_number
from skillweave.errors import DeclarationError, SkillweaveError
from skillweave.evolution.architecture import check_architecture, draw_change, rebuilt
from skillweave.evolution.config import KINDS, Evolution, Mutations, Range
from skillweave.evolution.stacks import Member, copy, networks_of
from skillweave.networks.config import Network
from skillweave.ops.device import FLOAT
from skillweave.runs.manifest import Origin
from skillweave.schema import flat

Spaces = tuple[Any, Any]


def mutate(
    member: Member, mutations: Mutations, spaces: Spaces, rng: np.random.Generator
) -> Member:
    """Return a child of the member with one mutation, or "none" if no mutation is possible."""
    kind = str(rng.choice(KINDS, p=np.array([getattr(mutations, k) for k in KINDS])))
    if kind == "hyperparameters":
        changed = _move_setting(member, mutations, rng)
    elif kind == "parameters":
        changed = _add_noise(member, mutations, spaces, rng)
    elif kind == "architecture":
        change = draw_change(member, mutations, spaces, rng)
        changed = member if change is None else rebuilt(member, change, spaces, rng)
    elif kind == "activation":
        changed = _change_activation(member, mutations, rng)
    else:
        changed = member
    if changed is member:
        changed = copy(member)
        kind = "none"
    changes = difference(member.config, changed.config)
    return replace(changed, origin=Origin(member.number, kind, changes))


def difference(old: AlgorithmConfig, new: AlgorithmConfig) -> dict[str, tuple[Any, Any]]:
    """Return the old and new values of settings that differ, by dotted name."""
    before = flat(old)
    return {k: (before.get(k), v) for k, v in flat(new).items() if before.get(k) != v}


def with_settings(member: Member, **settings: Any) -> Member:
    """Return a copy of the member with other settings, also in the tensors of its state."""
    changed = copy(member)
    changed.config = replace(member.config, **settings)
    for name, value in settings.items():
        if hasattr(changed.state, name):
            getattr(changed.state, name).fill_(setting_number(value))
    return changed


def random_config(
    config: AlgorithmConfig, mutations: Mutations, rng: np.random.Generator
) -> AlgorithmConfig:
    """Draw settings, architecture and activation uniformly from the ranges of mutations."""
    for _ in range(100):
        drawn = {
            name: _valued(config, name, within.from_unit(rng.random()))
            for name, within in sorted(mutations.ranges_of(config, start=False).items())
        }
        for name, network in networks_of(config).items():
            drawn[name] = _random_network(network, mutations, rng)
        try:
            return replace(config, **drawn)
        except SkillweaveError:
            continue  # they are not compatible: a batch larger than a rollout
    raise DeclarationError("Mutations.ranges: 100 settings drawn from them did not fit together")


def _random_network(network: Network, by: Mutations, rng: np.random.Generator) -> Network:
    """Draw a network's architecture and activation from the ranges of mutations."""
    if by.architecture > 0.0:
        depth = int(rng.integers(by.layers[0], by.layers[1] + 1))
        low, high = by.units
        widths = Range(low, high + 1) if high > low else None
        hidden = tuple(int(widths.from_unit(rng.random())) if widths else low for _ in range(depth))
        network = replace(network, hidden=tuple(min(high, w) for w in hidden))
    if by.activation > 0.0:
        chosen: Any = by.activations[int(rng.integers(len(by.activations)))]
        network = replace(network, activation=chosen)
    return network


def check_mutations(config: AlgorithmConfig, evolution: Evolution, where: str) -> None:
    """Raise a DeclarationError where a mutation does not fit the algorithm or its network."""
    mutations = evolution.mutations
    try:
        ranges = mutations.ranges_of(config, start=evolution.start == "config")
    except SkillweaveError as error:
        raise DeclarationError(f"{where}{error}") from error
    if mutations.hyperparameters > 0.0 and not ranges:
        raise DeclarationError(f"{where}Mutations.hyperparameters is positive, but ranges is empty")
    check_architecture(config, mutations, where)


def _move_setting(member: Member, by: Mutations, rng: np.random.Generator) -> Member:
    """Move one setting up or down; a whole number by at least one."""
    ranges = by.ranges_of(member.config, start=False)
    for name in rng.permutation(sorted(ranges)):
        within = ranges[name]
        old = getattr(member.config, name)
        if old is None:
            continue
        sign = 1 if rng.random() < 0.5 else -1
        for way in (sign, -sign):  # the other direction at the end of a range
            at = within.to_unit(min(within.high, max(within.low, old)))
            new = _valued(member.config, name, within.from_unit(at + way * by.step))
            if isinstance(old, int) and new == old:
                new = old + way
            if new == old or not within.low <= new <= within.high:
                continue
            try:
                return with_settings(member, **{str(name): new})
            except SkillweaveError:
                continue  # it is not compatible with the others
    return member


def _valued(config: AlgorithmConfig, name: str, value: float) -> Any:
    """Convert a number to the type of the setting."""
    return round(value) if isinstance(getattr(config, name), int) else float(value)


def _add_noise(member: Member, by: Mutations, spaces: Spaces, rng: np.random.Generator) -> Member:
    """Add noise to a share of the acting weights, and the same to their slow copy."""
    algorithm = member.algorithm(spaces)
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    noisy = copy(member)
    online = algorithm.layout.views(noisy.state.params)
    noise = torch.zeros_like(noisy.state.params)
    for name, view in algorithm.layout.views(noise).items():
        if name in algorithm.acting.shapes:
            scale = online[name].square().mean().sqrt() * by.strength
            chosen = torch.rand(view.shape, generator=generator, **FLOAT) < by.share
            view.copy_(torch.randn(view.shape, generator=generator, **FLOAT) * chosen * scale)
    if not bool(noise.any()):
        return member
    for name in algorithm.parameter_groups()[0].weights:
        getattr(noisy.state, name).add_(noise)
    return noisy


def _change_activation(member: Member, by: Mutations, rng: np.random.Generator) -> Member:
    """Change the nonlinearity in all networks."""
    others = [a for a in by.activations if a != member.config.network.activation]
    if not others:
        return member
    chosen = others[int(rng.integers(len(others)))]
    networks: dict[str, Any] = {
        name: replace(network, activation=chosen)
        for name, network in networks_of(member.config).items()
    }
    changed = copy(member)
    changed.config = replace(member.config, **networks)
    return changed
