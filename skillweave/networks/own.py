"""Encoders that are ordinary modules of the user, run from the flat parameters of P members.

The user's factory makes a ``torch.nn.Module`` for an observation space, as a features extractor of
Stable-Baselines3 is made. Here its parameters are columns of the flat tensor, like all others, and
``torch.func.functional_call`` runs the module with the values of one member.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from skillweave.errors import DeclarationError, SkillweaveError
from skillweave.messages import short, told
from skillweave.named import Named
from skillweave.networks.encoders import Inputs
from skillweave.networks.stacked import Views
from skillweave.ops.device import Constant, usual_defaults
from skillweave.spaces import ObsCodec
from skillweave.spaces.packing import parts

ROWS = 3
"""Observations that a new module is tried with."""
_CLOSE: dict[str, Any] = {"rtol": 1e-3, "atol": 1e-4}


class ModuleEncoder:
    """A module of the user as an ``Encoder``.

    Its trainable parameters are learnt and saved. Buffers and frozen parameters are constants: they
    come from the factory each time, so they must be the same each time.

    Args:
        obs: of the observation space.
        factory: makes the module, given the space of what ``forward`` gets.

    Raises:
        DeclarationError: the factory or the module raised, or the module does not return finite
            features (B, F), or it changes its buffers, or its output is not a function of one
            observation.
    """

    def __init__(self, obs: ObsCodec, factory: Named) -> None:
        self._obs, self._factory, self._who = obs, factory, f"Network.encoder {factory}"
        self._parts = _parts_of(obs)
        self.space = _seen_space(obs.space, iter([part.space for part in self._parts]))
        """Of what ``forward`` gets."""
        self._template = self._made(0)
        self._scalars: set[str] = set()
        self.shapes: dict[str, tuple[int, ...]] = {}
        for name, value in self._template.named_parameters():
            if not value.requires_grad:
                continue
            if value.dtype != torch.float32:
                raise DeclarationError(
                    f"{self._who}: its parameter {name} holds {value.dtype}; it must hold "
                    "torch.float32"
                )
            if not value.ndim:
                self._scalars.add(name)
            self.shapes[name] = tuple(value.shape) or (1,)
        self._check_constants()
        self.size = self._checked_size()
        self._constants = {k: Constant(v.detach()) for k, v in _constants(self._template).items()}
        # Running a module with other parameters changes it meanwhile, and the collector acts
        # while the learner learns: each borrows a module that no other thread has.
        self._idle: list[nn.Module] = []

    def __getstate__(self) -> dict[str, Any]:
        """Return what is sent to another process."""
        return vars(self) | {"_idle": []}

    def init_(self, views: Views, generators: list[torch.Generator]) -> None:
        """Fill fresh parameters in place: those of a module that each member's generator seeds."""
        for member, generator in enumerate(generators):
            seed = int(torch.randint(2**62, (), generator=generator, device="cpu"))
            fresh = dict(self._made(seed).named_parameters())
            for name, view in views.items():
                view[member].copy_(fresh[name].detach())

    def __call__(self, views: Views, inputs: Inputs) -> Tensor:
        """Inputs to features (P, B, F), one member after another."""
        leaves = [part.read(self._obs, inputs) for part in self._parts]
        members, device = leaves[0].shape[0], leaves[0].device
        constants = {k: value.on(device) for k, value in self._constants.items()}
        if torch.compiler.is_compiling():  # nothing runs, so nothing is changed
            module = self._template
        else:
            module = self._idle.pop() if self._idle else copy.deepcopy(self._template)
        found = []
        for m in range(members):
            values = {k: v[m].view(()) if k in self._scalars else v[m] for k, v in views.items()}
            given = _nested(self._obs.space, iter([leaf[m] for leaf in leaves]))
            found.append(torch.func.functional_call(module, values | constants, (given,)))
        if module is not self._template:
            self._idle.append(module)
        return found[0][None] if members == 1 else torch.stack(found)

    def _made(self, seed: int) -> nn.Module:
        """Return a new module of the factory, initialised by a seed alone."""
        with usual_defaults(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            try:
                module = self._factory.function(self.space)
            except SkillweaveError:
                raise
            except (Exception, SystemExit) as error:
                raise DeclarationError(
                    f"{self._who} raised {told(error)} when it was called with the observation "
                    f"space {short(self.space, 200)}"
                ) from error
            if not isinstance(module, nn.Module):
                raise DeclarationError(
                    f"{self._who} returned {short(module)}; it must return a torch.nn.Module whose "
                    "forward turns observations into features"
                )
            module = module.to("cpu").train()
            if any(is_lazy(value) for value in module.parameters()):
                self._run(module, ROWS)
        return module

    def _run(self, module: nn.Module, rows: int) -> Any:
        """Return what a module makes of the first ``rows`` observations that it is tried with."""
        rng = np.random.default_rng(0)
        examples = [part.examples(rng)[:rows] for part in self._parts]
        try:
            with usual_defaults(), torch.no_grad():
                return module(_nested(self._obs.space, iter(examples)))
        except (Exception, SystemExit) as error:
            shapes = ", ".join(str(tuple(leaf.shape)) for leaf in examples)
            raise DeclarationError(
                f"{self._who}: forward raised {told(error)} for observations of shape {shapes}"
            ) from error

    def _check_constants(self) -> None:
        """Raise where a constant of the module is not the same each time the module is made."""
        other = _constants(self._made(1))
        for name, value in _constants(self._template).items():
            if name not in other or not torch.equal(value, other[name]):
                raise DeclarationError(
                    f"{self._who}: {name} is another one each time the module is made, and only "
                    "trainable parameters are saved: make it trainable, or set it to fixed values"
                )

    def _checked_size(self) -> int:
        """Return F, after trying a module with a few observations."""
        module = copy.deepcopy(self._template)
        before = {k: v.clone() for k, v in _constants(module).items()}
        found = self._run(module, ROWS)
        if not isinstance(found, Tensor):
            raise DeclarationError(
                f"{self._who}: forward returned {short(found)}; it must return one tensor of "
                "features (B, F)"
            )
        if found.ndim != 2 or len(found) != ROWS or not found.shape[1]:
            raise DeclarationError(
                f"{self._who}: forward returned shape {tuple(found.shape)} for {ROWS} "
                f"observations; it must return features (B, F), here ({ROWS}, F)"
            )
        if found.dtype != torch.float32:
            raise DeclarationError(
                f"{self._who}: forward returned {found.dtype}; it must return torch.float32"
            )
        if not bool(found.isfinite().all()):
            raise DeclarationError(f"{self._who}: forward returned NaN or infinity")
        after = _constants(module)
        if changed := [k for k in before if not torch.equal(before[k], after[k])]:
            raise DeclarationError(
                f"{self._who}: forward changes the buffer {changed[0]}, which is not saved "
                "(BatchNorm does that); use LayerNorm or GroupNorm"
            )
        again = self._run(module, ROWS)
        if not torch.allclose(found, again, **_CLOSE):
            raise DeclarationError(
                f"{self._who}: forward returned other features for the same observations (Dropout "
                "does that); the same observation must have the same features"
            )
        if not torch.allclose(found, self._run(module.eval(), ROWS), **_CLOSE):
            raise DeclarationError(
                f"{self._who}: forward returns other features in evaluation mode (Dropout and "
                "BatchNorm do that); it must be the same function while it learns and acts"
            )
        if not torch.allclose(found[:1], self._run(module, 1), **_CLOSE):
            raise DeclarationError(
                f"{self._who}: the features of an observation depend on the other observations of "
                "the batch (BatchNorm does that); use LayerNorm or GroupNorm"
            )
        return int(found.shape[1])


def _constants(module: nn.Module) -> dict[str, Tensor]:
    """Return what the module holds beside its trainable parameters, by name."""
    frozen = {k: v for k, v in module.named_parameters() if not v.requires_grad}
    return frozen | dict(module.named_buffers())


@dataclass(frozen=True)
class _Part:
    """A part of an observation without parts of its own, as ``forward`` gets it."""

    source: str  # of the network's inputs
    space: gym.spaces.Box
    start: int = 0  # of the vector
    choices: tuple[int, ...] = ()

    def read(self, obs: ObsCodec, inputs: Inputs) -> Tensor:
        """Return it, (P, B, *shape)."""
        given = inputs[self.source]
        if self.source != "vector":
            return obs.pixels(given, int(self.source.removeprefix("image.")))
        numbers = given[..., self.start : self.start + math.prod(self.space.shape)]
        return numbers.reshape(*given.shape[:-1], *self.space.shape)

    def examples(self, rng: np.random.Generator) -> Tensor:
        """Return what a few observations might be, (B, *shape)."""
        shape = (ROWS, *self.space.shape)
        if self.choices:
            drawn = [np.eye(n)[rng.integers(n, size=ROWS)] for n in self.choices]
            return torch.from_numpy(np.concatenate(drawn, axis=1).astype(np.float32))
        if self.space.is_bounded():
            values = rng.uniform(self.space.low, self.space.high, shape)
        else:
            values = rng.standard_normal(shape)
        return torch.from_numpy(values.astype(np.float32))


def _parts_of(obs: ObsCodec) -> list[_Part]:
    """Return the parts of an observation in the order of ``ObsCodec.leaves``."""
    found, start, images = [], 0, 0
    for leaf, space in zip(obs.leaves, _leaf_spaces(obs.space), strict=True):
        if leaf.image is not None:
            low, high = (
                obs.pixels(leaf.image.read(torch.from_numpy(x), torch.Size()), images)
                for x in (np.asarray(x, np.float64) for x in (space.low, space.high))
            )
            box = gym.spaces.Box(low.numpy(), high.numpy(), dtype=np.float32)
            found.append(_Part(f"image.{images}", box))
            images += 1
            continue
        shape = (leaf.size,) if leaf.choices else leaf.shape
        bounds = (0.0, 1.0) if leaf.choices else (-np.inf, np.inf)
        box = gym.spaces.Box(*bounds, shape, np.float32)
        found.append(_Part("vector", box, start, leaf.choices))
        start += leaf.size
    return found


def _leaf_spaces(space: gym.Space[Any]) -> Iterator[Any]:
    inner = parts(space)
    if inner is None:
        yield space
        return
    for part in inner.values():
        yield from _leaf_spaces(part)


def _seen_space(space: gym.Space[Any], leaves: Iterator[gym.Space[Any]]) -> gym.Space[Any]:
    """Return a space with the parts of ``space``, whose leaves are the next ``leaves``."""
    inner = parts(space)
    if inner is None:
        return next(leaves)
    seen = [(name, _seen_space(part, leaves)) for name, part in inner.items()]
    if isinstance(space, gym.spaces.Tuple):
        return gym.spaces.Tuple([part for _, part in seen])
    return gym.spaces.Dict(seen)


def _nested(space: gym.Space[Any], leaves: Iterator[Tensor]) -> Any:
    """Return the next ``leaves`` as the tensor, dict or tuple that observations of a space are."""
    inner = parts(space)
    if inner is None:
        return next(leaves)
    found = {name: _nested(part, leaves) for name, part in inner.items()}
    return tuple(found.values()) if isinstance(space, gym.spaces.Tuple) else found
