import pytest
import torch
from torch import nn

from skillweave.networks.config import RNN
from skillweave.networks.stacked import (
    Layout,
    rnn_gates,
    rnn_init_,
    rnn_memory_size,
    rnn_sequence,
    rnn_shapes,
    rnn_step,
)

P, T, B, IN, H = 3, 6, 4, 5, 7


def made(kind: str):
    rnn = RNN(kind, H)
    layout = Layout(rnn_shapes("rnn", IN, rnn))
    flat = torch.zeros(P, layout.size)
    rnn_init_(layout.views(flat), "rnn", [torch.Generator().manual_seed(m) for m in range(P)])
    g = torch.Generator().manual_seed(9)
    flat += 0.1 * torch.randn(flat.shape, generator=g)
    x = torch.randn(P, T, B, IN, generator=g)
    memory = torch.randn(P, B, rnn_memory_size(rnn), generator=g)
    start = torch.rand(P, T, B, generator=g) < 0.3
    return rnn, layout, flat, x, memory, start


def reference(kind: str, views, m: int) -> nn.Module:
    torchs = nn.LSTMCell(IN, H) if kind == "lstm" else nn.GRUCell(IN, H)
    torchs.weight_ih.data = views["rnn.input"][m].T
    torchs.weight_hh.data = views["rnn.state"][m].T
    torchs.bias_ih.data, torchs.bias_hh.data = (
        views["rnn.bias"][m, 0],
        views["rnn.state_bias"][m, 0],
    )
    return torchs


def one(torchs: nn.Module, kind: str, x, memory):
    if kind == "gru":
        return torchs(x, memory)
    return torch.cat(torchs(x, (memory[:, :H], memory[:, H:])), -1)


@pytest.mark.parametrize("kind", ["lstm", "gru"])
def test_a_sequence_is_torchs_cell_step_by_step_from_nothing_where_an_episode_starts(kind):
    rnn, layout, flat, x, memory, start = made(kind)
    views = layout.views(flat)
    after = rnn_sequence(views, "rnn", rnn, x, memory, start)
    assert start.any(1).any()
    for m in range(P):
        torchs, now = reference(kind, views, m), memory[m]
        for t in range(T):
            now = now.masked_fill(start[m, t][:, None], 0.0)
            now = one(torchs, kind, x[m, t], now)
            torch.testing.assert_close(after[m, t], now)
    alone = rnn_sequence(layout.views(flat[1:2]), "rnn", rnn, x[1:2], memory[1:2], start[1:2])
    torch.testing.assert_close(alone[0], after[1])


@pytest.mark.parametrize("kind", ["lstm", "gru"])
def test_gradients_through_time_are_torchs_and_stop_where_an_episode_starts(kind):
    rnn, layout, flat, x, memory, start = made(kind)
    x.requires_grad_()
    leaves = layout.leaves(flat)
    after = rnn_sequence(leaves, "rnn", rnn, x, memory, start)
    grads = torch.autograd.grad(after[:, -1].sum(), [x, *leaves.values()], retain_graph=True)
    for m in range(P):
        own = layout.leaves(flat[m : m + 1])
        now, inputs = memory[m], x[m].detach().requires_grad_()
        for t in range(T):
            now = now.masked_fill(start[m, t][:, None], 0.0)
            gates = rnn_gates(own, "rnn", inputs[None, t])
            now = rnn_step(own, "rnn", rnn, gates, now[None])[0]
        expected = torch.autograd.grad(now.sum(), inputs)[0]
        torch.testing.assert_close(grads[0][m], expected)
        for b in range(B):
            begins = start[m, :, b].nonzero().flatten().tolist()
            if begins:
                assert not grads[0][m, : begins[-1], b].any()
                assert grads[0][m, begins[-1] :, b].any()


@pytest.mark.parametrize(("kind", "size"), [("lstm", 2 * H), ("gru", H)])
def test_the_memory_holds_what_comes_out_first(kind, size):
    rnn, layout, flat, x, memory, _ = made(kind)
    assert rnn_memory_size(rnn) == size == memory.shape[-1]
    views = layout.views(flat)
    after = rnn_sequence(
        views, "rnn", rnn, x, torch.zeros_like(memory), x.new_zeros(P, T, B).bool()
    )
    assert after[..., :H].abs().max() < 1.0
    if kind == "gru":
        return
    hidden, inner = after[..., :H], after[..., H:]
    assert (hidden.abs() <= inner.tanh().abs() + 1e-6).all()  # a gate's share of it


def test_weights_are_orthogonal_and_of_each_members_own():
    rnn = RNN("gru", H)
    layout = Layout(rnn_shapes("rnn", IN, rnn))
    flat, alone = torch.zeros(2, layout.size), torch.zeros(1, layout.size)
    rnn_init_(layout.views(flat), "rnn", [torch.Generator().manual_seed(m) for m in (0, 1)])
    rnn_init_(layout.views(alone), "rnn", [torch.Generator().manual_seed(1)])
    assert torch.equal(flat[1], alone[0])
    for weight in layout.views(flat)["rnn.state"]:
        torch.testing.assert_close(weight @ weight.T, torch.eye(H), rtol=0, atol=1e-5)
