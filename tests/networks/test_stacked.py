import math

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from skillweave.networks.config import Network
from skillweave.networks.stacked import ACTIVATIONS, Layout, mlp, mlp_init_, mlp_shapes

NETS = [
    Network((8, 6)),
    Network((7,), "relu", layer_norm=True),
    Network(()),
    Network((5, 5), "gelu", True),
]


def network(net: Network, seeds: list[int], inputs: int = 3, outputs: int = 2, gain: float = 1.0):
    layout = Layout(mlp_shapes("net", inputs, net, outputs))
    flat = torch.zeros(len(seeds), layout.size)
    generators = [torch.Generator().manual_seed(s) for s in seeds]
    mlp_init_(layout.views(flat), "net", net, gain, generators)
    return layout, flat


def noisy(flat: torch.Tensor) -> torch.Tensor:
    """Biases and norms away from 0 and 1."""
    return flat + 0.1 * torch.randn(flat.shape, generator=torch.Generator().manual_seed(9))


@pytest.mark.parametrize("net", NETS, ids=str)
def test_a_stack_computes_what_a_plain_torch_network_computes(net):
    layout, flat = network(net, [0, 1, 2])
    flat = noisy(flat)
    x = torch.randn(3, 11, 3, generator=torch.Generator().manual_seed(3))
    got, views = mlp(layout.views(flat), "net", net, x), layout.views(flat)
    for m in range(3):
        y = x[m]
        for i in range(len(net.hidden) + 1):
            y = F.linear(y, views[f"net.{i}.weight"][m].T, views[f"net.{i}.bias"][m, 0])
            if i == len(net.hidden):
                break
            if net.layer_norm:
                norm = nn.LayerNorm(net.hidden[i])
                norm.weight.data = views[f"net.{i}.norm_weight"][m, 0]
                norm.bias.data = views[f"net.{i}.norm_bias"][m, 0]
                y = norm(y)
            y = ACTIVATIONS[net.activation](y)
        torch.testing.assert_close(got[m], y)


@pytest.mark.parametrize("net", NETS, ids=str)
def test_a_member_does_not_depend_on_its_neighbours(net):
    layout, flat = network(net, [0, 1, 2])
    x = torch.randn(3, 4, 3, generator=torch.Generator().manual_seed(3))
    whole = mlp(layout.views(flat), "net", net, x)
    for m in range(3):
        _, alone = network(net, [m])
        assert torch.equal(alone[0], flat[m])
        torch.testing.assert_close(mlp(layout.views(alone), "net", net, x[m : m + 1])[0], whole[m])


def test_one_backward_pass_gives_each_member_its_own_gradient():
    net = Network((8,))
    layout, flat = network(net, [0, 1])
    x = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(3))

    def gradient(rows: slice, scale: torch.Tensor) -> torch.Tensor:
        leaves = layout.leaves(flat[rows])
        loss = (scale * mlp(leaves, "net", net, x[rows]).square().mean((1, 2))).sum()
        return layout.flatten(
            dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))
        )

    scale = torch.tensor([1.0, 100.0])
    together = gradient(slice(None), scale)
    for m in range(2):
        alone = gradient(slice(m, m + 1), scale[m : m + 1])
        torch.testing.assert_close(together[m : m + 1], alone)


def test_weights_are_orthogonal_with_their_gain_and_biases_zero():
    layout, flat = network(Network((8, 8)), [0, 1], inputs=8, outputs=4, gain=0.01)
    views = layout.views(flat)
    for i, gain in enumerate([math.sqrt(2), math.sqrt(2), 0.01]):
        for weight in views[f"net.{i}.weight"]:
            gram = weight.T @ weight
            torch.testing.assert_close(gram, gain**2 * torch.eye(len(gram)), atol=1e-5, rtol=1e-5)
        assert not views[f"net.{i}.bias"].any()


def test_views_are_windows_and_flatten_is_their_inverse():
    layout, flat = network(Network((4,), layer_norm=True), [0, 1])
    views = layout.views(flat)
    assert sum(v[0].numel() for v in views.values()) == layout.size == flat.shape[1]
    assert torch.equal(layout.flatten(views), flat)
    views["net.0.bias"].fill_(7.0)
    assert (flat == 7.0).sum() == 2 * 4
    # In the layout's order, whatever the mapping's.
    other = Layout({"a": (2,), "b": (1,)})
    mapping = {"b": torch.tensor([[3.0]]), "a": torch.tensor([[1.0, 2.0]])}
    assert other.flatten(mapping).tolist() == [[1, 2, 3]]


def test_leaves_share_memory_with_the_flat_parameters():
    layout, flat = network(Network((4,)), [0])
    leaves = layout.leaves(flat)
    flat.zero_()
    assert all(v.requires_grad and v.is_leaf and not v.any() for v in leaves.values())
