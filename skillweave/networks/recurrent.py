"""LSTM and GRU cells for P members at once, and sequences with resets at episode starts.

Stands alone because it has the equations of the cells, which ``net`` only calls.
"""

from __future__ import annotations

import torch
from torch import Tensor

from skillweave.networks.config import RNN
from skillweave.networks.stacked import Views, orthogonal_

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


def project(views: Views, prefix: str, x: Tensor) -> Tensor:
    """Return the inputs' part of the gates, (P, B, in) to (P, B, gates·H): all steps at once."""
    return torch.baddbmm(views[f"{prefix}.bias"], x, views[f"{prefix}.input"])


def cell(views: Views, prefix: str, rnn: RNN, gates: Tensor, memory: Tensor) -> Tensor:
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


def sequence(
    views: Views, prefix: str, rnn: RNN, x: Tensor, memory: Tensor, starts: Tensor
) -> Tensor:
    """Return the recurrent states after each of T steps, (P, T, B, M).

    Args:
        x: (P, T, B, in).
        memory: recurrent state (P, B, M) before the first step.
        starts: (P, T, B) bool, an episode begins at this step: its recurrent state is zero.
    """
    gates = project(views, prefix, x.flatten(1, 2)).unflatten(1, x.shape[1:3])
    keep = (~starts).unsqueeze(-1)
    after = []
    for t in range(x.shape[1]):
        memory = cell(views, prefix, rnn, gates[:, t], memory * keep[:, t])
        after.append(memory)
    return torch.stack(after, dim=1)
