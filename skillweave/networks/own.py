"""The encoder that runs a PyTorch module of the user from the flat parameters of P members.

The user's factory creates a ``torch.nn.Module`` for an observation space, as for a features
extractor of Stable-Baselines3. Its parameters are columns of the flat tensor, like all others, and
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

from skillweave._internal.messages import error_text, short
from skillweave._internal.named import Named
from skillweave.errors import DeclarationError, SkillweaveError
from skillweave.networks.stacked import Inputs, Views
from skillweave.ops.device import Constant, usual_defaults
from skillweave.spaces import ObsCodec
from skillweave.spaces.packing import parts

ROWS = 3
"""Example observations that check a new module."""
_CLOSE: dict[str, Any] = {"rtol": 1e-3, "atol": 1e-4}


class ModuleEncoder:
    """A module of the user as an ``Encoder``.

    Its trainable parameters are learnt and saved. Buffers and frozen parameters are constants: the
    factory sets them each time, so they must be equal each time.

    Args:
        obs: the codec of the observation space.
        factory: creates the module for the space of ``forward``'s input.

    Raises:
        DeclarationError: the factory or the module raised, or the module does not return finite
            features (B, F), or it changes its buffers, or its output is not a function of one
            observation.
    """

    def __init__(self, obs: ObsCodec, factory: Named) -> None:
        self._obs = obs
        self._factory = factory
        self._label = f"Network.encoder {factory}"
        self._parts = _parts_of(obs)
        self.space = _seen_space(obs.space, iter([part.space for part in self._parts]))
        """The space of ``forward``'s input."""
        self._template = self._new_module(0)
        self._scalars: set[str] = set()
        self.shapes: dict[str, tuple[int, ...]] = {}
        for name, value in self._template.named_parameters():
            if not value.requires_grad:
                continue
            if value.dtype != torch.float32:
                raise DeclarationError(
                    f"{self._label}: its parameter {name} holds {value.dtype}; it must hold "
                    "torch.float32"
                )
            if not value.ndim:
                self._scalars.add(name)
            self.shapes[name] = tuple(value.shape) or (1,)
        self._check_constants()
        self.size = self._checked_size()
        self._constants = {k: Constant(v.detach()) for k, v in _constants(self._template).items()}
        # A call with other parameters changes the module while it runs, and the collector acts
        # while the learner learns: each thread takes a module that no other thread uses.
        self._idle: list[nn.Module] = []

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to send to another process."""
        return vars(self) | {"_idle": []}

    def init_(self, views: Views, generators: list[torch.Generator]) -> None:
        """Fill in the parameters of a new module per member, seeded by its generator."""
        for member, generator in enumerate(generators):
            seed = int(torch.randint(2**62, (), generator=generator, device="cpu"))
            fresh = dict(self._new_module(seed).named_parameters())
            for name, view in views.items():
                view[member].copy_(fresh[name].detach())

    def __call__(self, views: Views, inputs: Inputs) -> Tensor:
        """Map inputs to features (P, B, F), one member after another."""
        leaves = [part.read(self._obs, inputs) for part in self._parts]
        members = leaves[0].shape[0]
        device = leaves[0].device
        constants = {k: value.on(device) for k, value in self._constants.items()}
        if torch.compiler.is_compiling():  # the module does not run, so it does not change
            module = self._template
        else:
            module = self._idle.pop() if self._idle else copy.deepcopy(self._template)
        features = []
        for m in range(members):
            values = {k: v[m].view(()) if k in self._scalars else v[m] for k, v in views.items()}
            obs = _nested(self._obs.space, iter([leaf[m] for leaf in leaves]))
            features.append(torch.func.functional_call(module, values | constants, (obs,)))
        if module is not self._template:
            self._idle.append(module)
        return features[0][None] if members == 1 else torch.stack(features)

    def _new_module(self, seed: int) -> nn.Module:
        """Create a module with the factory, initialised by a seed alone."""
        with usual_defaults(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            try:
                module = self._factory.function(self.space)
            except SkillweaveError:
                raise
            except (Exception, SystemExit) as error:
                raise DeclarationError(
                    f"{self._label} raised {error_text(error)} when it was called with the "
                    f"observation space {short(self.space, 200)}"
                ) from error
            if not isinstance(module, nn.Module):
                raise DeclarationError(
                    f"{self._label} returned {short(module)}; it must return a torch.nn.Module "
                    "whose forward turns observations into features"
                )
            module = module.to("cpu").train()
            if any(is_lazy(value) for value in module.parameters()):
                self._run(module, ROWS)
        return module

    def _run(self, module: nn.Module, rows: int) -> Any:
        """Return a module's output for the first ``rows`` example observations."""
        rng = np.random.default_rng(0)
        examples = [part.examples(rng)[:rows] for part in self._parts]
        try:
            with usual_defaults(), torch.no_grad():
                return module(_nested(self._obs.space, iter(examples)))
        except (Exception, SystemExit) as error:
            shapes = ", ".join(str(tuple(leaf.shape)) for leaf in examples)
            raise DeclarationError(
                f"{self._label}: forward raised {error_text(error)} for observations of "
                f"shape {shapes}"
            ) from error

    def _check_constants(self) -> None:
        """Raise where a constant of the module differs between two modules of the factory."""
        other = _constants(self._new_module(1))
        for name, value in _constants(self._template).items():
            if name not in other or not torch.equal(value, other[name]):
                raise DeclarationError(
                    f"{self._label}: {name} differs each time the module is made, and only "
                    "trainable parameters are saved: make it trainable, or set it to fixed values"
                )

    def _checked_size(self) -> int:
        """Return F, after checks with a few example observations."""
        module = copy.deepcopy(self._template)
        before = {k: v.clone() for k, v in _constants(module).items()}
        features = self._run(module, ROWS)
        if not isinstance(features, Tensor):
            raise DeclarationError(
                f"{self._label}: forward returned {short(features)}; it must return one tensor of "
                "features (B, F)"
            )
        if features.ndim != 2 or len(features) != ROWS or not features.shape[1]:
            raise DeclarationError(
                f"{self._label}: forward returned shape {tuple(features.shape)} for {ROWS} "
                f"observations; it must return features (B, F), here ({ROWS}, F)"
            )
        if features.dtype != torch.float32:
            raise DeclarationError(
                f"{self._label}: forward returned {features.dtype}; it must return torch.float32"
            )
        if not bool(features.isfinite().all()):
            raise DeclarationError(f"{self._label}: forward returned NaN or infinity")
        after = _constants(module)
        if changed := [k for k in before if not torch.equal(before[k], after[k])]:
            raise DeclarationError(
                f"{self._label}: forward changes the buffer {changed[0]}, which is not saved "
                "(BatchNorm does that); use LayerNorm or GroupNorm"
            )
        again = self._run(module, ROWS)
        if not torch.allclose(features, again, **_CLOSE):
            raise DeclarationError(
                f"{self._label}: forward returned other features for the same observations "
                "(Dropout does that); the same observation must have the same features"
            )
        if not torch.allclose(features, self._run(module.eval(), ROWS), **_CLOSE):
            raise DeclarationError(
                f"{self._label}: forward returns other features in evaluation mode (Dropout and "
                "BatchNorm do that); it must be the same function while it learns and acts"
            )
        if not torch.allclose(features[:1], self._run(module, 1), **_CLOSE):
            raise DeclarationError(
                f"{self._label}: the features of an observation depend on the other observations "
                "of the batch (BatchNorm does that); use LayerNorm or GroupNorm"
            )
        return int(features.shape[1])


def _constants(module: nn.Module) -> dict[str, Tensor]:
    """Return the module's buffers and frozen parameters, by name."""
    frozen = {k: v for k, v in module.named_parameters() if not v.requires_grad}
    return frozen | dict(module.named_buffers())


@dataclass(frozen=True)
class _Input:
    """An innermost part of an observation, as ``forward`` receives it."""

    source: str  # of the network's inputs
    space: gym.spaces.Box
    start: int = 0  # of the vector
    choices: tuple[int, ...] = ()

    def read(self, obs: ObsCodec, inputs: Inputs) -> Tensor:
        """Return the part of the inputs, (P, B, *shape)."""
        source = inputs[self.source]
        if self.source != "vector":
            return obs.pixels(source, int(self.source.removeprefix("image.")))
        numbers = source[..., self.start : self.start + math.prod(self.space.shape)]
        return numbers.reshape(*source.shape[:-1], *self.space.shape)

    def examples(self, rng: np.random.Generator) -> Tensor:
        """Draw a few example observations, (B, *shape)."""
        shape = (ROWS, *self.space.shape)
        if self.choices:
            drawn = [np.eye(n)[rng.integers(n, size=ROWS)] for n in self.choices]
            return torch.from_numpy(np.concatenate(drawn, axis=1).astype(np.float32))
        if self.space.is_bounded():
            values = rng.uniform(self.space.low, self.space.high, shape)
        else:
            values = rng.standard_normal(shape)
        return torch.from_numpy(values.astype(np.float32))


def _parts_of(obs: ObsCodec) -> list[_Input]:
    """Return the parts of an observation in the order of ``ObsCodec.leaves``."""
    observed: list[_Input] = []
    start = 0
    images = 0
    for leaf in obs.leaves:
        if leaf.image is not None:
            low, high = (obs.pixels(x, images) for x in leaf.ends)
            box = gym.spaces.Box(low.numpy(), high.numpy(), dtype=np.float32)
            observed.append(_Input(f"image.{images}", box))
            images += 1
            continue
        shape = (leaf.size,) if leaf.choices else leaf.shape
        bounds = (0.0, 1.0) if leaf.choices else (-np.inf, np.inf)
        box = gym.spaces.Box(*bounds, shape, np.float32)
        observed.append(_Input("vector", box, start, leaf.choices))
        start += leaf.size
    return observed


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
    """Return the next ``leaves`` as an observation of a space: a tensor, dict or tuple."""
    inner = parts(space)
    if inner is None:
        return next(leaves)
    nested = {name: _nested(part, leaves) for name, part in inner.items()}
    return tuple(nested.values()) if isinstance(space, gym.spaces.Tuple) else nested
