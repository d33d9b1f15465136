"""Networks of action values, optionally dueling, with noisy weights, or with atoms."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from skillweave.networks.config import Network
from skillweave.networks.net import Net
from skillweave.networks.stacked import Inputs, Views, mlp, mlp_init_, mlp_shapes
from skillweave.spaces import ObsCodec


class QNet:
    """A network of A action values, each of ``atoms`` numbers; dueling and noisy are optional.

    Dueling: the last hidden layer is split in two, one for the state's value and one for the
    actions' advantages; ``Q = V + A − mean A`` (Wang et al. 2016, eq. 9), atom by atom in C51.

    Noisy: parameters are the means of the weights of hidden layers and heads; each also has a
    ``…_sigma`` (Fortunato et al. 2018). Without noise, the network uses the means.
    """

    def __init__(
        self,
        obs: ObsCodec,
        network: Network,
        actions: int,
        *,
        atoms: int = 1,
        dueling: bool = False,
        noisy: bool = False,
    ) -> None:
        self.network = network
        self._actions = actions
        self._atoms = atoms
        self.streams: list[tuple[str, Network, int]] = []
        """Name, hidden layers and outputs of each stream of a dueling network; else none."""
        if dueling:
            trunk = replace(network, hidden=network.hidden[:-1])
            last = network.hidden[-1:]
            self.trunk = Net("q", obs, trunk, None)
            stream = replace(network, hidden=last)
            self.streams = [("value", stream, atoms), ("advantage", stream, actions * atoms)]
        else:
            self.trunk = Net("q", obs, network, actions * atoms)
        self.shapes = dict(self.trunk.shapes)
        self.encoders = self.trunk.encoders
        for name, stream, outputs in self.streams:
            self.shapes |= mlp_shapes(name, self.trunk.width, stream, outputs)
        self._noisy = []
        if noisy:
            layers = mlp_shapes("q", 1, self.trunk.network, None if dueling else 1)
            for name, stream, outputs in self.streams:
                layers |= mlp_shapes(name, 1, stream, outputs)
            self._noisy = [k.removesuffix(".weight") for k in layers if k.endswith(".weight")]
        for layer in self._noisy:
            for kind in ("weight", "bias"):
                self.shapes[f"{layer}.{kind}_sigma"] = self.shapes[f"{layer}.{kind}"]
        self.noise_size = sum(sum(self.shapes[f"{k}.weight"]) for k in self._noisy)
        """Random numbers in one draw of the weights' noise; 0: the weights have no noise."""

    def init_(self, views: Views, generators: list[torch.Generator]) -> None:
        """Draw fresh parameters in place, one generator per member."""
        self.trunk.init_(views, 1.0, generators)
        for name, stream, _ in self.streams:
            mlp_init_(views, name, stream, 1.0, generators)
        for layer in self._noisy:
            # Means uniform in ±1/√in, deviations 0.5/√in (sec. 3.2, factorised).
            bound = 1.0 / math.sqrt(self.shapes[f"{layer}.weight"][0])
            for kind in ("weight", "bias"):
                for member, generator in enumerate(generators):
                    views[f"{layer}.{kind}"][member].uniform_(-bound, bound, generator=generator)
                views[f"{layer}.{kind}_sigma"].fill_(0.5 * bound)

    def __call__(self, views: Views, inputs: Inputs) -> Tensor:
        """Map inputs (P, B, …) to (P, B, A, atoms): values, or logits of the atoms."""
        x = self.trunk(views, inputs)
        if not self.streams:
            return x.view(*x.shape[:2], self._actions, self._atoms)
        value, advantage = (mlp(views, name, stream, x) for name, stream, _ in self.streams)
        advantage = advantage.view(*x.shape[:2], self._actions, self._atoms)
        return value[..., None, :] + (advantage - advantage.mean(2, keepdim=True))

    def perturbed(self, views: Views, noise: Tensor) -> dict[str, Tensor]:
        """Return weights with factorised noise, from standard normal numbers (P, K)."""
        scaled = noise.sign() * noise.abs().sqrt()  # f(x) = sgn(x)·√|x|
        weights = dict(views)
        at = 0
        for layer in self._noisy:
            n_in, n_out = self.shapes[f"{layer}.weight"]
            rows = scaled[:, at : at + n_in, None]
            columns = scaled[:, None, at + n_in :][..., :n_out]
            at += n_in + n_out
            for kind, eps in (("weight", rows * columns), ("bias", columns)):
                mean = views[f"{layer}.{kind}"]
                sigma = views[f"{layer}.{kind}_sigma"]
                weights[f"{layer}.{kind}"] = torch.addcmul(mean, sigma, eps)
        return weights
