"""PPO (Schulman et al. 2017) for P members at once; a single agent is P = 1.

Read down the page: State, init, act, value, update, learn, loss; then ``ppo_samples``. The settings
are ``config.PPO``. What acted may be an update old: the objective is the decoupled one of Hilton,
Cobbe & Schulman 2022.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import torch
from torch import Tensor

from skillweave.algorithms.base import ActingParams, AgentState, Algorithm, Device
from skillweave.algorithms.compiled import Compiled
from skillweave.algorithms.config import PPO
from skillweave.algorithms.parameters import ParameterGroup
from skillweave.algorithms.ppo_samples import Terms, epsilon_now, samples_of
from skillweave.algorithms.rollouts import Samples, minibatches
from skillweave.errors import DeclarationError
from skillweave.experience import Report, Rollout
from skillweave.networks.encoders import Inputs
from skillweave.networks.heads import ActionHead
from skillweave.networks.net import Net
from skillweave.networks.stacked import Layout, Views
from skillweave.ops.device import FLOAT, all_false
from skillweave.ops.distributions import mask_logits, with_epsilon
from skillweave.ops.losses import approximate_kl, ppo_policy_loss, value_loss
from skillweave.ops.moments import masked_mean
from skillweave.ops.optim import adam_, clip_grad_norm_, kl_adapted_rate
from skillweave.seeding import Seeds
from skillweave.types import Array

REPORT = ("policy_loss", "value_loss", "entropy", "kl", "grad_norm")
"""Metrics of a minibatch."""
_LR_RANGE = (1e-5, 1e-2)  # of the schedule 'kl', as in rl_games


@dataclass
class State(AgentState):
    """Everything PPO learns and counts; ``params`` is the actor first, then the critic."""

    gae_lambda: Tensor  # (P,), as all below a hyperparameter of each member
    clip_coef: Tensor  # (P,)
    ent_coef: Tensor  # (P,)
    vf_coef: Tensor  # (P,)
    max_grad_norm: Tensor  # (P,)


class PPOAlgorithm(Algorithm):
    """PPO on one pair of spaces. Holds no learnt state: that is in ``State``."""

    store = "rollout"
    follows_schedules = True
    state_type: ClassVar[type[State]] = State
    member_hyperparameters = (
        "learning_rate", "gamma", "gae_lambda", "clip_coef", "ent_coef", "vf_coef",
        "max_grad_norm",
    )  # fmt: skip

    def __init__(
        self, config: PPO, observation_space: gym.Space[Any], action_space: gym.Space[Any]
    ) -> None:
        super().__init__(config, observation_space, action_space)
        if max(config.epsilon, config.epsilon_final or 0.0) and not isinstance(
            action_space, gym.spaces.Discrete
        ):
            raise DeclarationError(f"epsilon needs discrete actions, but they are {action_space}")
        self.head = ActionHead(self.codec, config.action_std, config.squash_actions)
        self.actor_net = Net("actor", self.obs, config.network, self.head.width)
        self.critic_net = Net("critic", self.obs, config.critic or config.network, 1)
        acting = dict(self.actor_net.shapes)
        if not self.head.discrete and not self.head.std_in_head:
            acting["actor.log_std"] = (1, self.codec.size)
        self.layout = Layout(acting | self.critic_net.shapes)
        self.memory_size = self.actor_net.memory_size + self.critic_net.memory_size
        # With memory the critic runs along while acting: its memory must be known, too.
        self.acting = self.layout if self.memory_size else Layout(acting)

    def fresh_state(self, seeds: Sequence[Seeds]) -> State:
        """A state of fresh members, one for each seed."""
        params = torch.zeros(len(seeds), self.layout.size, **FLOAT)
        views, generators = self.layout.views(params), self.member_generators(seeds)
        self.actor_net.init_(views, 0.01, generators)
        # All values begin at 0. A random critic's errors are the only advantages until something
        # is paid for the first time, and they can lead the policy away from where that would be.
        self.critic_net.init_(views, 0.0, generators)
        if self.head.std_in_head:
            bias = views[f"{self.actor_net.head}.bias"]
            bias[..., self.codec.size :].fill_(self.config.action_std_init).log_()
        elif not self.head.discrete:
            views["actor.log_std"].fill_(self.config.action_std_init).log_()
        return State(**self.fresh_fields(params))

    def parameter_groups(self) -> list[ParameterGroup]:
        """Everything in the state that has the shape of networks."""
        nets = ("network", self.actor_net), ("critic", self.critic_net)
        return [ParameterGroup(self.layout, nets)]

    def act(
        self,
        params: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Actions in policy units, the head they came from, and the memory; `Algorithm.act`."""
        inputs, views = self.inputs(params, obs), params.views
        if memory is None:
            head = self.actor_net(views, inputs)
        else:
            own, other = memory.tensor_split([self.actor_net.memory_size], dim=-1)
            head, own = self.actor_net.step(views, inputs, own)
            _, other = self.critic_net.step(views, inputs, other)
            memory = torch.cat([own, other], dim=-1)
        if self.head.discrete:
            epsilon = params.extra.get("epsilon")
            head = mask_logits(head, mask) if epsilon is None else with_epsilon(head, mask, epsilon)
        return self.head.act(head, views.get("actor.log_std"), noise), head, memory

    def acting_params(
        self, state: State, progress: float = 1.0, device: Device = "cpu"
    ) -> ActingParams:
        """A copy of what acting needs; see ``Algorithm.acting_params``."""
        found = super().acting_params(state, progress, device)
        if (epsilon := epsilon_now(self.config, progress, state.learning_rate)) is not None:
            found.extra["epsilon"] = epsilon.to(device)
        return found

    def to_env(self, action: Array) -> Array:
        """Policy units (n, …) to the environment's."""
        return self.head.to_env(action)

    def value(self, state: State, obs: Tensor, mask: Tensor | None = None) -> Tensor:
        """V in units of reward, (P, B); with a memory, that of an episode's first observation."""
        params = self.learning_params(state)
        inputs, size = self.inputs(params, obs), self.critic_net.memory_size
        if not size:
            return self.in_rewards(state, self.critic_net(params.views, inputs))
        empty = state.params.new_zeros(*obs.shape[:2], size)
        return self.in_rewards(state, self.critic_net.step(params.views, inputs, empty)[0])

    def update(
        self, state: State, batch: Rollout, rng: Sequence[torch.Generator]
    ) -> tuple[State, Report]:
        """Learn from the valid rows of a rollout, in place; ``rng`` orders the minibatches."""
        cfg = self.config
        now = Terms.of(cfg, state, batch)
        samples, metrics = samples_of(self, state, batch, now)
        rate, count, limited = now.rate, samples.count, self._kl_limit is not None
        names = REPORT if now.reference is None else (*REPORT, "reference_kl")
        taken, sums = torch.zeros_like(rate), rate.new_zeros(len(names), len(rate))
        compiles = cfg.compile and not self.memory_size
        # A compiled step makes its leaves itself; others share these.
        leaves = None if compiles else self.layout.leaves(state.params)
        learn = self._compiled if compiles else self.learn
        active, all_learn = count > 0, not limited and samples.valid is None
        for minibatch in minibatches(samples, rng, cfg.update_epochs, cfg.batch_size):
            found, learns = learn(state, leaves, minibatch, now, None if all_learn else active)
            taken = taken + active
            sums.addcmul_(torch.stack([found[k] for k in names]), active.float())
            active = active if learns is None else learns
            if limited and all_false(active):
                break
        metrics |= dict(zip(names, sums / taken.clamp_min(1.0), strict=True))
        if cfg.learning_rate_schedule == "kl":
            target = torch.full_like(rate, cfg.target_kl or 0.0)
            state.learning_rate = kl_adapted_rate(rate, metrics["kl"], target, *_LR_RANGE)
        return state, Report(metrics | {"learning_rate": rate, "samples": count})

    @property
    def _kl_limit(self) -> float | None:
        """The KL beyond which a member learns no more from this rollout; None: there is none."""
        cfg = self.config
        if cfg.target_kl is None or cfg.learning_rate_schedule == "kl":
            return None
        return 1.5 * float(cfg.target_kl)  # as in Stable-Baselines3

    @functools.cached_property
    def _compiled(self) -> Compiled:
        # Skills that learn together have as many rows as they acted in: each time others.
        return Compiled(self.learn, self.config, sizes_vary=True)

    def learn(
        self,
        state: State,
        leaves: Views | None,
        batch: Samples,
        now: Terms,
        active: Tensor | None,
    ) -> tuple[dict[str, Tensor], Tensor | None]:
        """One gradient step, in place: nothing but tensor operations, so that it can be compiled.

        Args:
            leaves: of ``state.params``; None: they are made here.
            active: (P,) bool, members that learn; None: all, always.

        Returns:
            Metrics (P,), and who has learnt: a member stops before a step that oversteps the KL.
        """
        leaves = self.layout.leaves(state.params) if leaves is None else leaves
        loss, report = self.loss(leaves, state, batch, now)
        grad = self.layout.gradient(loss, leaves)
        report["grad_norm"] = clip_grad_norm_(grad, state.max_grad_norm)
        if active is not None and self._kl_limit is not None:
            active = active & (report["kl"] <= self._kl_limit)
        adam_(
            state.params, grad, state.mu, state.nu, state.count, now.rate,
            eps=self.config.adam_eps, active=active,
        )  # fmt: skip
        return report, active

    def loss(
        self, views: Views, state: State, batch: Samples, now: Terms
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Policy, value and entropy loss of one minibatch, (P,), and detached metrics (P,)."""
        head, _ = self.run(self.actor_net, views, batch.inputs, batch.memory, batch.starts)
        raw, _ = self.run(self.critic_net, views, batch.inputs, batch.memory, batch.starts)
        if batch.memory is not None:
            batch = batch.changed(lambda x: x.flatten(1, 2))
        log_std, valid, acted = views.get("actor.log_std"), batch.valid, batch.own
        log_prob, entropy = self.head.stats(head, log_std, batch.mask, batch.action)
        old, weight = batch.log_prob, batch.importance
        policy = ppo_policy_loss(log_prob, old, batch.advantage, state.clip_coef, weight, acted)
        clip = self.config.clip_value
        bound = None if clip is None else torch.full_like(state.clip_coef, clip)
        value = value_loss(raw.squeeze(-1), batch.target, batch.old_value, bound, valid)
        mean_entropy = bonus = masked_mean(entropy, acted)
        if (surplus := self.head.surplus(head, log_std)) is not None:
            bonus = mean_entropy - masked_mean(surplus, acted)
        total = policy + state.vf_coef * value - now.ent_coef * bonus
        with torch.no_grad():
            kl = approximate_kl(log_prob, old, weight, acted)
        report = {"policy_loss": policy, "value_loss": value, "entropy": mean_entropy, "kl": kl}
        if now.reference is not None:
            near = now.reference.params
            other = None if near is None else near.views.get("actor.log_std")
            assert batch.reference is not None
            away = self.head.kl(head, log_std, batch.reference, other, batch.mask)
            report["reference_kl"] = masked_mean(away, acted)
            total = total + now.reference.coef * report["reference_kl"]
        return total, {k: v.detach() for k, v in report.items()}

    def run(
        self,
        net: Net,
        views: Views,
        inputs: Inputs,
        memory: Tensor | None,
        starts: Tensor | None,
    ) -> tuple[Tensor, Tensor | None]:
        """A network's outputs (P, N, out) and memories (P, N, M); sequences are laid end to end."""
        if memory is None or starts is None:
            return net(views, inputs), None
        own, other = memory.tensor_split([self.actor_net.memory_size], dim=-1)
        memory = own if net is self.actor_net else other
        out, after = net.sequence(views, inputs, memory, starts)
        return out.flatten(1, 2), after.flatten(1, 2)

    def in_rewards(self, state: State, raw: Tensor) -> Tensor:
        """The critic's outputs (P, N, 1) in units of reward, (P, N)."""
        return raw.squeeze(-1) * state.return_scale + state.return_mean
