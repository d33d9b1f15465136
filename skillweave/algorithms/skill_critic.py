"""What each skill's call is worth to the task: Q(s, skill), learnt from every step.

One critic serves the skills, which may count the task's advantage beside their own (Zhang &
Whiteson 2019, "DAC"), and interruption. A call is cut where its skill is worth less than V(s) =
Σ π(k | s) Q(s, k), which is what it is worth to decide anew (Sutton, Precup & Singh 1999, sec. 4).
π is what the selector does while it learns, so V is learnt from its decisions. The best Q in place
of V would be too much: the selector does not always call that skill, and the best of several
estimates is mostly one that is too high.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave.algorithms.base import ActingParams, AgentState, Algorithm, Device
from skillweave.algorithms.config import SkillCritic
from skillweave.algorithms.parameters import ParameterGroup, rate_now
from skillweave.algorithms.ppo_samples import epsilon_now
from skillweave.algorithms.rollouts import values_after
from skillweave.experience import Report, Rollout
from skillweave.networks.net import Net
from skillweave.networks.stacked import Layout, take_rows
from skillweave.ops.device import FLOAT
from skillweave.ops.losses import value_loss
from skillweave.ops.moments import explained_variance
from skillweave.ops.optim import adam_, clip_grad_norm_
from skillweave.ops.returns import gae
from skillweave.seeding import Seeds


class SkillCriticAlgorithm(Algorithm):
    """Learns the return of the task, while a skill is called and then whoever follows.

    Rows are steps of all skills, in the order of time; an action is the skill that acted.
    """

    store = "rollout"
    follows_schedules = True
    action_spaces = (gym.spaces.Discrete,)

    def __init__(
        self,
        config: SkillCritic,
        observation_space: gym.Space[Any],
        action_space: gym.spaces.Discrete,
    ) -> None:
        super().__init__(config, observation_space, action_space)
        self.skills = int(action_space.n)
        outputs = self.skills + config.deciding  # the last one: deciding anew
        self.net = Net("critic", self.obs, config.network, outputs)
        self.acting = self.layout = Layout(self.net.shapes)

    def fresh_state(self, seeds: Sequence[Seeds]) -> AgentState:
        """A state of fresh members, to which all skills are worth the same."""
        params = torch.zeros(len(seeds), self.layout.size, **FLOAT)
        self.net.init_(self.layout.views(params), 0.0, self.member_generators(seeds))
        return AgentState(**self.fresh_fields(params))

    def parameter_groups(self) -> list[ParameterGroup]:
        """Everything in the state that has the shape of the network."""
        return [ParameterGroup(self.layout, (("network", self.net),))]

    def act(
        self,
        params: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Any,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, None]:
        """The skill that is worth most, and what each is worth in deviations of the return; last
        what it is worth to decide anew, with ``deciding``.

        Where the selector still draws calls to try them, worths differ less: few calls are cut.
        """
        worth = self.net(params.views, self.inputs(params, obs)) * params.extra.get("trust", 1.0)
        return worth[..., : self.skills].argmax(-1), worth, None

    def acting_params(
        self, state: AgentState, progress: float = 1.0, device: Device = "cpu"
    ) -> ActingParams:
        """A copy of what acting needs; ``trust`` multiplies worths while skills learn."""
        found = super().acting_params(state, progress, device)
        epsilon = epsilon_now(self.config, progress, state.learning_rate)
        if epsilon is not None and progress < 1.0:  # at the end calls are cut as they will be
            found.extra["trust"] = 1.0 - epsilon.to(device)
        return found

    def noise(self, generators: Sequence[torch.Generator], steps: int, batch: int) -> Any:
        """None: there is no chance in what it says."""
        return [None] * steps

    def value(self, state: AgentState, obs: Tensor, mask: Tensor | None = None) -> Tensor:
        """What the best skill is worth, (P, B), in units of reward."""
        params = self.learning_params(state)
        worth = self.net(params.views, self.inputs(params, obs))[..., : self.skills].amax(-1)
        return worth * state.return_scale + state.return_mean

    def advantage(self, state: AgentState, rollout: Rollout) -> Tensor:
        """GAE(λ) of the task's reward, (P, T, B), in deviations of the return."""
        found, _ = self._judged(state, rollout)
        return found / state.return_scale[..., None]

    def update(
        self, state: AgentState, batch: Rollout, rng: Sequence[torch.Generator]
    ) -> tuple[AgentState, Report]:
        """Learn λ-returns of the skills that acted, in place; ``rng`` orders the minibatches."""
        cfg = self.config
        obs = _valid(batch, batch.obs)
        self.update_obs_stats(state, obs)
        advantage, value = (_valid(batch, x) for x in self._judged(state, batch))
        returns = advantage + value
        self.update_return_stats(state, returns)
        target = (returns - state.return_mean) / state.return_scale
        leaves = self.layout.leaves(state.params)
        inputs = self.inputs(self.learning_params(state), obs)
        action, size = _valid(batch, batch.action), target.shape[1]
        call_start = None
        if cfg.deciding:
            assert batch.call_start is not None
            call_start = _valid(batch, batch.call_start)
        rate = rate_now(cfg, state.learning_rate, batch.progress)
        loss = target.new_zeros(len(target))
        parts = max(1, round(size / cfg.batch_size))
        for _ in range(cfg.update_epochs):
            order = torch.stack([torch.randperm(size, generator=g, device="cpu") for g in rng]).to(
                target.device
            )
            for rows in order.chunk(parts, dim=1):
                own = {k: take_rows(v, rows) for k, v in inputs.items()}
                worth, goal = self.net(leaves, own), take_rows(target, rows)
                chosen = worth.gather(2, take_rows(action, rows)[..., None])
                loss = value_loss(chosen.squeeze(-1), goal)
                if call_start is not None:  # V(s) = Σ π(k | s) Q(s, k), learnt where one decided
                    # A row counts as much as one of Q, however few decisions there are.
                    anew = torch.where(take_rows(call_start, rows), worth[..., -1], goal)
                    loss = loss + value_loss(anew, goal)
                grad = self.layout.gradient(loss, leaves)
                clip_grad_norm_(grad, torch.full_like(rate, cfg.max_grad_norm))
                adam_(state.params, grad, state.mu, state.nu, state.count, rate, eps=cfg.adam_eps)
        explained = explained_variance(value, returns)
        return state, Report({"value_loss": loss.detach(), "explained_variance": explained})

    @torch.no_grad()
    def _judged(self, state: AgentState, rollout: Rollout) -> tuple[Tensor, Tensor]:
        """Advantage and Q(s, the skill that acted), (P, T, B) each, in units of reward.

        What follows a step is worth Q of whoever acts next; at ends, of who acted.
        """
        value = self._worth(state, rollout.obs, rollout.action).view_as(rollout.reward)

        def at_ends(rows: Tensor) -> Tensor:
            obs, action = rollout.next_obs.flatten(1, 2), rollout.action.flatten(1)
            return self._worth(state, take_rows(obs, rows)[:, None], take_rows(action, rows))

        following = values_after(value, rollout.last, at_ends)
        decay = torch.full_like(state.gamma, self.config.gae_lambda)
        found = gae(rollout.reward, rollout.discount, value, following, rollout.last, decay)
        return found, value

    def _worth(self, state: AgentState, obs: Tensor, skill: Tensor) -> Tensor:
        """Q(s, skill) in units of reward, (P, N), of (P, …) observations on two axes."""
        params = self.learning_params(state)
        raw = self.net(params.views, self.inputs(params, obs.flatten(1, 2)))
        chosen = raw.gather(2, skill.flatten(1)[..., None]).squeeze(-1)
        return chosen * state.return_scale + state.return_mean


def _valid(batch: Rollout, rows: Tensor) -> Tensor:
    """The valid ones of rows (P, T, B, …), as (P, K, …); of one member where some are not."""
    flat = rows.flatten(1, 2)
    return flat if batch.valid is None else flat[:, batch.valid[0].flatten()]
