"""Stacked layers and recurrent cells: P members of one architecture as one set of tensors.

All parameters of a network are in one flat tensor (P, D); ``Layout`` names its columns. So cloning,
clipping, Adam, saving and selecting members are one operation each.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from skillweave.networks.config import RNN, Activation, Network
from skillweave.ops.device import FLOAT

Views = Mapping[str, Tensor]
"""Named parameters, each (P, *shape)."""
Inputs = Mapping[str, Tensor]
"""Inputs of a network: ``vector`` (P, B, O) float and ``image.<i>`` (P, B, C, H, W), raw."""

ACTIVATIONS: dict[Activation, Callable[[Tensor], Tensor]] = {
    "tanh": torch.tanh_,
    "relu": torch.relu_,  # in place: nothing else reads its input
    "elu": F.elu,
    "silu": F.silu,
    "gelu": F.gelu,
}


@dataclass(frozen=True)
class Layout:
    """Names and shapes of the parameters in the columns of a flat (P, D) tensor, in order."""

    shapes: dict[str, tuple[int, ...]]  # of one member

    @property
    def size(self) -> int:
        """Return D, the number of parameters of one member."""
        return sum(math.prod(s) for s in self.shapes.values())

    def views(self, flat: Tensor) -> dict[str, Tensor]:
        """Return windows into ``flat`` (P, D), each (P, *shape); writes to one change ``flat``."""
        parts = flat.split([math.prod(s) for s in self.shapes.values()], dim=1)
        named = zip(self.shapes.items(), parts, strict=True)
        return {name: part.view(-1, *shape) for (name, shape), part in named}

    def leaves(self, flat: Tensor) -> dict[str, Tensor]:
        """Return windows into ``flat`` (P, D) as ``views`` does, each a leaf of a gradient."""
        return {k: v.detach().requires_grad_() for k, v in self.views(flat).items()}

    def gradient(self, loss: Tensor, leaves: Views) -> Tensor:
        """Return the gradient (P, D) of ``loss`` (P,) by ``leaves``; 0 for unused leaves."""
        # Members do not mix: the gradient of the sum is each member's own. With a gradient of each
        # loss instead of the sum, torch would import its symbolic shapes, for a third of a second.
        gradients = torch.autograd.grad(loss.sum(), list(leaves.values()), allow_unused=True)
        flat = [
            torch.zeros_like(leaf).flatten(1) if g is None else g.flatten(1)
            for g, leaf in zip(gradients, leaves.values(), strict=True)
        ]
        return torch.cat(flat, dim=1)

    def flatten(self, named: Mapping[str, Tensor]) -> Tensor:
        """Copy ``named`` tensors (P, *shape) into one (P, D); the inverse of ``views``."""
        return torch.cat([named[name].flatten(1) for name in self.shapes], dim=1)


def mlp_shapes(
    prefix: str, inputs: int, net: Network, outputs: int | None
) -> dict[str, tuple[int, ...]]:
    """Return names and shapes of hidden layers and head; weights (in, out), biases (1, out).

    ``outputs`` None: the network has no head.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    widths = (inputs, *net.hidden) if outputs is None else (inputs, *net.hidden, outputs)
    for i, (n_in, n_out) in enumerate(itertools.pairwise(widths)):
        shapes[f"{prefix}.{i}.weight"] = (n_in, n_out)
        shapes[f"{prefix}.{i}.bias"] = (1, n_out)
        if net.layer_norm and i < len(net.hidden):
            shapes[f"{prefix}.{i}.norm_weight"] = (1, n_out)
            shapes[f"{prefix}.{i}.norm_bias"] = (1, n_out)
    return shapes


def orthogonal_(weight: Tensor, gain: float, generators: list[torch.Generator]) -> None:
    """Draw orthogonal matrices in place, (P, in, ...), one generator per member (Saxe et al. 2014).

    So a member's weights do not depend on its neighbours.
    """
    for member, generator in enumerate(generators):
        fresh = torch.empty(weight.shape[1:], **FLOAT)
        torch.nn.init.orthogonal_(fresh, gain, generator=generator)
        weight[member].copy_(fresh)


def mlp_init_(
    views: Views, prefix: str, net: Network, head_gain: float, generators: list[torch.Generator]
) -> None:
    """Draw orthogonal weights in place, gain √2 (``head_gain`` for the head), biases zero."""
    for i in range(_depth(views, prefix)):
        gain = head_gain if i == len(net.hidden) else math.sqrt(2.0)
        orthogonal_(views[f"{prefix}.{i}.weight"], gain, generators)
        views[f"{prefix}.{i}.bias"].zero_()
        if f"{prefix}.{i}.norm_weight" in views:
            views[f"{prefix}.{i}.norm_weight"].fill_(1.0)
            views[f"{prefix}.{i}.norm_bias"].zero_()


def mlp(views: Views, prefix: str, net: Network, x: Tensor) -> Tensor:
    """Map (P, B, in) to (P, B, out); without a head in the views, to the last hidden layer."""
    activation = ACTIVATIONS[net.activation]
    for i in range(len(net.hidden)):
        x = torch.baddbmm(views[f"{prefix}.{i}.bias"], x, views[f"{prefix}.{i}.weight"])
        if net.layer_norm:
            x = F.layer_norm(x, x.shape[-1:])
            norm_bias = views[f"{prefix}.{i}.norm_bias"]
            x = torch.addcmul(norm_bias, x, views[f"{prefix}.{i}.norm_weight"])
        x = activation(x)
    head = f"{prefix}.{len(net.hidden)}"
    if f"{head}.weight" not in views:
        return x
    return torch.baddbmm(views[f"{head}.bias"], x, views[f"{head}.weight"])


def _depth(views: Views, prefix: str) -> int:
    return next(i for i in itertools.count() if f"{prefix}.{i}.weight" not in views)


def take_rows(x: Tensor, rows: Tensor) -> Tensor:
    """Select rows of each member: x (P, B, ...), rows (P, K) to (P, K, ...)."""
    if x.shape[0] == 1:
        return x[0].index_select(0, rows[0])[None]
    return x[torch.arange(x.shape[0], device=x.device)[:, None], rows]


Shapes = dict[str, tuple[int, ...]]


def rnn_memory_size(rnn: RNN) -> int:
    """Return M, the size of one environment's recurrent state: h, and an LSTM's c after it."""
    return rnn.size * (2 if rnn.kind == "lstm" else 1)


def rnn_shapes(prefix: str, inputs: int, rnn: RNN) -> Shapes:
    """Return a cell's parameter shapes: ``input`` (in, gates·H), ``state`` (H, gates·H), biases."""
    width = rnn.size * (4 if rnn.kind == "lstm" else 3)
    return {
        f"{prefix}.input": (inputs, width),
        f"{prefix}.state": (rnn.size, width),
        f"{prefix}.bias": (1, width),
        f"{prefix}.state_bias": (1, width),
    }


def rnn_init_(views: Views, prefix: str, generators: list[torch.Generator]) -> None:
    """Draw orthogonal weights, set biases to zero, as in CleanRL's recurrent PPO."""
    for name in ("input", "state"):
        orthogonal_(views[f"{prefix}.{name}"], 1.0, generators)
    for name in ("bias", "state_bias"):
        views[f"{prefix}.{name}"].zero_()


def rnn_gates(views: Views, prefix: str, x: Tensor) -> Tensor:
    """Return the inputs' part of the gates, (P, B, in) to (P, B, gates·H): all steps at once."""
    return torch.baddbmm(views[f"{prefix}.bias"], x, views[f"{prefix}.input"])


def rnn_step(views: Views, prefix: str, rnn: RNN, gates: Tensor, memory: Tensor) -> Tensor:
    """Step: map projected inputs (P, B, gates·H) and recurrent state (P, B, M) to the next state.

    The output is the state's first H numbers. Gates as in torch.nn.LSTMCell and GRUCell.
    """
    size = rnn.size
    h = memory[..., :size]
    state = torch.baddbmm(views[f"{prefix}.state_bias"], h, views[f"{prefix}.state"])
    if rnn.kind == "lstm":
        i, f, g, o = (gates + state).chunk(4, dim=-1)
        c = torch.sigmoid(f) * memory[..., size:] + torch.sigmoid(i) * torch.tanh(g)
        return torch.cat([torch.sigmoid(o) * torch.tanh(c), c], dim=-1)
    xr, xz, xn = gates.chunk(3, dim=-1)
    hr, hz, hn = state.chunk(3, dim=-1)
    r, z = torch.sigmoid(xr + hr), torch.sigmoid(xz + hz)
    return torch.lerp(torch.tanh(xn + r * hn), h, z)


def rnn_sequence(
    views: Views, prefix: str, rnn: RNN, x: Tensor, memory: Tensor, starts: Tensor
) -> Tensor:
    """Return the recurrent states after each of T steps, (P, T, B, M).

    Args:
        x: (P, T, B, in).
        memory: recurrent state (P, B, M) before the first step.
        starts: (P, T, B) bool, an episode begins at this step: its recurrent state is zero.
    """
    gates = rnn_gates(views, prefix, x.flatten(1, 2)).unflatten(1, x.shape[1:3])
    keep = (~starts).unsqueeze(-1)
    after = []
    for t in range(x.shape[1]):
        memory = rnn_step(views, prefix, rnn, gates[:, t], memory * keep[:, t])
        after.append(memory)
    return torch.stack(after, dim=1)
