"""DQN for P members at once, with the six extensions of Rainbow (Hessel et al. 2018).

In the order of reading: State, init, act, update, loss. The settings are ``config.DQN``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.base import ActingParams
from skillweave.algorithms.batches import Sample
from skillweave.algorithms.config import DQN
from skillweave.algorithms.off_policy import OffPolicyAlgorithm, OffPolicyState, normal
from skillweave.algorithms.parameters import ParameterGroup
from skillweave.networks.qnet import QNet
from skillweave.networks.stacked import Inputs, Layout, Views
from skillweave.ops.device import FLOAT, Constant
from skillweave.ops.distributions import mask_logits
from skillweave.ops.losses import categorical_projection, td_loss, weighted_mean
from skillweave.ops.moments import scale_of
from skillweave.ops.returns import td_target

WIDEST = 10.0
"""Largest return on atoms without v_min and v_max, in units of the returns seen so far."""


@dataclass
class State(OffPolicyState):
    """Learnt numbers and counts of DQN."""

    target: Tensor  # (P, D), the slow copy of ``params``


class DQNAlgorithm(OffPolicyAlgorithm):
    """DQN on one pair of spaces; all that is learnt is in ``State``."""

    state_type = State

    def __init__(
        self, config: DQN, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        super().__init__(config, observation_space, action_space)
        self.interval = config.target_update_interval
        self.atoms: Constant | None = None
        """C51's atoms, (N,)."""
        if config.distributional:
            low = -WIDEST if config.v_min is None else config.v_min
            high = WIDEST if config.v_max is None else config.v_max
            self.atoms = Constant(torch.linspace(low, high, config.n_atoms, **FLOAT))
        self.net = QNet(
            self.obs,
            config.network,
            self.codec.size,
            atoms=config.n_atoms if config.distributional else 1,
            dueling=config.dueling,
            noisy=config.noisy,
        )
        self.layout = self.acting = Layout(self.net.shapes)

    @property
    def _has_fixed_atoms(self) -> bool:
        """Return whether the settings give the atoms' range, not the returns seen so far."""
        return self.config.v_min is not None

    @property
    def scales_rewards(self) -> bool:
        """Return whether learning needs the running moments of returns."""
        return super().scales_rewards or (self.atoms is not None and not self._has_fixed_atoms)

    def reward_scale(self, state: State) -> Tensor | None:
        """Return the factor of rewards, (P, 1), that brings them to the units of the atoms."""
        if self.atoms is None or self._has_fixed_atoms:
            return super().reward_scale(state)
        # The root of the mean square: the deviation of equal returns would be 0.
        square = state.return_var + state.return_mean.square()
        return scale_of(state.return_mean, square).reciprocal()

    def fresh_state(self, seeds: Sequence[Seeds]) -> State:
        """Create the state of fresh members, one for each seed."""
        params = torch.zeros(len(seeds), self.layout.size, **FLOAT)
        self.net.init_(self.layout.views(params), self.member_generators(seeds))
        return State(**self.fresh_fields(params), target=params.clone())

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return the groups of state fields that have the shape of networks."""
        return [ParameterGroup(self.layout, (("network", self.net),), ("params", "target"))]

    def exploration(self, state: State, progress: float) -> dict[str, Tensor]:
        """Return ε, (P, 1)."""
        cfg = self.config
        spent = min(1.0, progress / max(cfg.exploration_fraction, 1e-9))
        start = cfg.exploration_initial_eps
        final = cfg.exploration_final_eps
        eps = 0.0 if cfg.noisy else start + spent * (final - start)
        return {"epsilon": torch.full((len(state.params), 1), eps, **FLOAT)}

    def noise(
        self, generators: Sequence[torch.Generator], steps: int, batch: int
    ) -> list[tuple[Tensor, Tensor | None]]:
        """Draw uniform numbers (P, batch, A + 1) and the weights' noise (P, K) for each step."""
        shape = (steps, batch, self.codec.size + 1)
        inner = self.net.noise_size
        uniform = torch.stack([torch.rand(shape, generator=g, **FLOAT) for g in generators], dim=1)
        if not inner:
            return [(u, None) for u in uniform]
        normal = torch.stack(
            [torch.randn(steps, inner, generator=g, **FLOAT) for g in generators], dim=1
        )
        return list(zip(uniform, normal, strict=True))

    def act(
        self,
        params: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: tuple[Tensor, Tensor | None] | None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, None]:
        """Return actions (P, B) and values (P, B, A); see ``Algorithm.act``."""
        uniform, normal = noise or (None, None)
        views = params.views if normal is None else self.net.perturbed(params.views, normal)
        q = mask_logits(self._q(self.net(views, self.inputs(params, obs))), mask)
        action = q.argmax(-1)
        if uniform is not None:
            random_action = mask_logits(uniform[..., 1:], mask).argmax(-1)
            epsilon = params.extra.get("epsilon")
            final = self.config.exploration_final_eps * (not self.config.noisy)
            explore = uniform[..., 0] < (final if epsilon is None else epsilon)
            action = torch.where(explore, random_action, action)
        return action, q, None

    def value(self, state: State, obs: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return ``max Q`` over allowed actions (C51: of means), in units of reward, (P, B)."""
        params = self.learning_params(state)
        q = self._q(self.net(params.views, self.inputs(params, obs)))
        return self.in_rewards(state, mask_logits(q, mask).amax(-1))

    def learning_noise(self, rng: Sequence[torch.Generator], batch: int, due: bool) -> list[Tensor]:
        """Draw noise of the online, the target's and the choosing weights, (P, K) each."""
        if not self.config.noisy:
            return []
        return list(normal(rng, 3, self.net.noise_size).unbind(1))

    def learn(
        self, state: State, sample: Sample, rate: Tensor, noise: list[Tensor], due: bool
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Take one gradient step, in place; return metrics (P,) and errors (P, B)."""
        leaves = self.layout.leaves(state.params)
        loss, error, q = self.loss(leaves, state, sample, noise or [None] * 3)
        norm = self.step_(state, loss, leaves, rate)
        if due:
            state.target.lerp_(state.params, state.tau[:, None])
        metrics = {"loss": loss.detach(), "q": q, "grad_norm": norm, "learning_rate": rate}
        return metrics, error

    def loss(
        self, views: Views, state: State, sample: Sample, noises: Sequence[Tensor | None]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Compute loss (P,), each sample's error (P, B), mean value (P,); the last two detached."""
        params = ActingParams({}, *self.scaling(state))
        every = self.net(self._noisy(views, noises[0]), self.inputs(params, sample.obs))
        out = _of_action(every, sample.action)
        next_inputs = self.inputs(params, sample.next_obs)
        reward = self.rewards(state, sample)
        with torch.no_grad():
            target = self._target(views, state, sample, next_inputs, reward, noises)
        if self.atoms is None:
            value = out.squeeze(-1)
            error = (value - target).detach().abs()
            each = td_loss(value, target, self.config.loss)
        else:
            log_p = out.log_softmax(-1)
            each = -(target * log_p).sum(-1)
            value = (log_p.detach().exp() * self.atoms.on(log_p.device)).sum(-1)
            error = each.detach()
        loss = weighted_mean(each, sample.weight)
        cost = self.cost(every, sample)
        return loss if cost is None else loss + cost, error, value.detach().mean(1)

    def cost(self, out: Tensor, sample: Sample) -> Tensor | None:
        """Return a further cost of outputs (P, B, A, atoms), (P,); None: there is none."""
        return None

    def _target(
        self,
        views: Views,
        state: State,
        sample: Sample,
        inputs: Inputs,
        reward: Tensor,
        noises: Sequence[Tensor | None],
    ) -> Tensor:
        """Return ``r + discount·Q̄(s′, a′)``, (P, B); or its distribution on atoms, (P, B, N)."""
        slow = self.layout.views(state.target)
        out = self.net(self._noisy(slow, noises[1]), inputs)
        online = self.net(self._noisy(views, noises[2]), inputs) if self.config.double else out
        best = mask_logits(self._q(online), sample.next_mask).argmax(-1)
        chosen = _of_action(out, best)
        if self.atoms is None:
            return td_target(reward, sample.discount, chosen.squeeze(-1))
        atoms = self.atoms.on(reward.device)
        return categorical_projection(chosen.softmax(-1), atoms, reward, sample.discount)

    def _noisy(self, views: Views, noise: Tensor | None) -> Views:
        return views if noise is None else self.net.perturbed(views, noise)

    def _q(self, out: Tensor) -> Tensor:
        """Convert network outputs (P, B, A, atoms) to values (P, B, A)."""
        if self.atoms is None:
            return out.squeeze(-1)
        return (out.softmax(-1) * self.atoms.on(out.device)).sum(-1)


def _of_action(out: Tensor, action: Tensor) -> Tensor:
    """Select one action's outputs: (P, B, A, atoms), (P, B) to (P, B, atoms)."""
    index = action[..., None, None].expand(*action.shape, 1, out.shape[-1])
    return out.gather(2, index).squeeze(2)
