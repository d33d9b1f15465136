"""The critic of skills: Q(s, skill) of the task's return, learnt from every step.

The skills, which may add the task's advantage to their own (Zhang & Whiteson 2019, "DAC"), and
interruption use one critic. A call is interrupted where Q of its skill is less than V(s) =
Σ π(k | s) Q(s, k), the value of deciding again (Sutton, Precup & Singh 1999, sec. 4). π is the
selector's policy while it learns, so V is learnt from its decisions. The best Q in place of V would
be too high: the selector does not always call that skill, and the maximum of several estimates is
biased upwards.

A skill with another goal is another option, so where skills have goals, Q sees the goal of the
call. V(s) must not depend on it: for V the inputs of goals are 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.base import ActingParams, AgentState, Algorithm
from skillweave.algorithms.batches import Report, Rollout
from skillweave.algorithms.config import SkillCritic
from skillweave.algorithms.parameters import ParameterGroup, epsilon_now, rate_now
from skillweave.algorithms.rollouts import values_after
from skillweave.networks.net import Net
from skillweave.networks.stacked import Inputs, Layout, take_rows
from skillweave.ops.device import FLOAT, Constant
from skillweave.ops.losses import value_loss
from skillweave.ops.moments import explained_variance
from skillweave.ops.returns import gae
from skillweave.spaces import obs_codec


class SkillCriticAlgorithm(Algorithm):
    """The algorithm that learns the task's return from a state and the skill that acts there.

    Rows are steps of all skills, in the order of time; a row's action is the skill that acted.
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
        outputs = self.skills + config.deciding  # the last one: the value of deciding again
        self.net = Net("critic", self.obs, config.network, outputs)
        self.acting = self.layout = Layout(self.net.shapes)
        self._keeps: dict[str, Constant] = {}
        """By the name of an input, 0 where it is of goals, else 1."""
        if config.sees_goals:
            assert isinstance(observation_space, gym.spaces.Dict)
            goals = obs_codec(observation_space["goal"])
            keeps = torch.ones(self.obs.size, **FLOAT)
            keeps[self.obs.size - goals.size :] = 0.0
            self._keeps["vector"] = Constant(keeps)
            for i in range(len(self.obs.images) - len(goals.images), len(self.obs.images)):
                self._keeps[f"image.{i}"] = Constant(torch.zeros(1, **FLOAT))

    def fresh_state(self, seeds: Sequence[Seeds]) -> AgentState:
        """Create the state of fresh members, in which all skills have the same value."""
        params = torch.zeros(len(seeds), self.layout.size, **FLOAT)
        self.net.init_(self.layout.views(params), 0.0, self.member_generators(seeds))
        return AgentState(**self.fresh_fields(params))

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return the groups of state fields that have the shape of the network."""
        return [ParameterGroup(self.layout, (("network", self.net),))]

    def act(
        self,
        params: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Any,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, None]:
        """Return the skill of highest value, and all values in deviations of the return.

        With ``deciding``, the last value is the one of a new decision. While the selector still
        draws skills at random, values are scaled down, so few calls are interrupted.
        """
        inputs = self.inputs(params, obs)
        q = self._values(params.views, inputs) * params.extra.get("trust", 1.0)
        return q[..., : self.skills].argmax(-1), q, None

    def _values(self, views: Any, inputs: Inputs) -> Tensor:
        """Return the values of skills, and of a new decision, (P, B, S + 1)."""
        q = self.net(views, inputs)
        if not self._keeps or not self.config.deciding:
            return q
        blank = {k: self._without_goals(k, x) for k, x in inputs.items()}
        return torch.cat([q[..., : self.skills], self.net(views, blank)[..., self.skills :]], -1)

    def _without_goals(self, name: str, x: Tensor) -> Tensor:
        keeps = self._keeps.get(name)
        return x if keeps is None else x * keeps.on(x.device).to(x.dtype)

    def exploration(self, state: AgentState, progress: float) -> dict[str, Tensor]:
        """Return ``trust``, which multiplies values while skills learn, (P, 1, 1)."""
        epsilon = epsilon_now(self.config, progress, state.learning_rate)
        # At the end, values count in full.
        return {} if epsilon is None or progress >= 1.0 else {"trust": 1.0 - epsilon}

    def noise(self, generators: Sequence[torch.Generator], steps: int, batch: int) -> Any:
        """Return None for each step: the critic is deterministic."""
        return [None] * steps

    def value(self, state: AgentState, obs: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the value of the best skill, (P, B), in units of reward."""
        params = self.learning_params(state)
        q = self.net(params.views, self.inputs(params, obs))[..., : self.skills].amax(-1)
        return q * state.return_scale + state.return_mean

    def advantage(self, state: AgentState, rollout: Rollout) -> Tensor:
        """Compute GAE(λ) of the task's reward, (P, T, B), in deviations of the return."""
        advantage, _ = self._advantage_and_q(state, rollout)
        return advantage / state.return_scale[..., None]

    def update(
        self, state: AgentState, batch: Rollout, rng: Sequence[torch.Generator]
    ) -> tuple[AgentState, Report]:
        """Learn λ-returns of the skills that acted, in place; ``rng`` orders the minibatches."""
        cfg = self.config
        obs = _valid(batch, batch.obs)
        self.update_obs_stats(state, obs)
        advantage, value = (_valid(batch, x) for x in self._advantage_and_q(state, batch))
        returns = advantage + value
        self.update_return_stats(state, returns)
        target = (returns - state.return_mean) / state.return_scale
        leaves = self.layout.leaves(state.params)
        inputs = self.inputs(self.learning_params(state), obs)
        action = _valid(batch, batch.action)
        size = target.shape[1]
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
                q = self._values(leaves, {k: take_rows(v, rows) for k, v in inputs.items()})
                goal = take_rows(target, rows)
                chosen = q.gather(2, take_rows(action, rows)[..., None])
                loss = value_loss(chosen.squeeze(-1), goal)
                if call_start is not None:  # V(s) = Σ π(k | s) Q(s, k), learnt at decisions
                    # A row weighs as much as one of Q, however few decisions the batch has.
                    decided = torch.where(take_rows(call_start, rows), q[..., -1], goal)
                    loss = loss + value_loss(decided, goal)
                self.step_(state, loss, leaves, rate, torch.full_like(rate, cfg.max_grad_norm))
        explained = explained_variance(value, returns)
        return state, Report({"value_loss": loss.detach(), "explained_variance": explained})

    @torch.no_grad()
    def _advantage_and_q(self, state: AgentState, rollout: Rollout) -> tuple[Tensor, Tensor]:
        """Compute advantage and Q(s, the skill that acted), (P, T, B), in units of reward.

        The value after a step is Q of the skill that acts next; at ends, of the one that acted.
        """
        value = self._q(state, rollout.obs, rollout.action).view_as(rollout.reward)

        def at_ends(rows: Tensor) -> Tensor:
            obs = rollout.next_obs.flatten(1, 2)
            action = rollout.action.flatten(1)
            return self._q(state, take_rows(obs, rows)[:, None], take_rows(action, rows))

        following = values_after(value, rollout.last, at_ends)
        decay = torch.full_like(state.gamma, self.config.gae_lambda)
        advantage = gae(rollout.reward, rollout.discount, value, following, rollout.last, decay)
        return advantage, value

    def _q(self, state: AgentState, obs: Tensor, skill: Tensor) -> Tensor:
        """Return Q(s, skill) in units of reward, (P, N), of observations (P, a, b, …), N = a·b."""
        params = self.learning_params(state)
        raw = self.net(params.views, self.inputs(params, obs.flatten(1, 2)))
        chosen = raw.gather(2, skill.flatten(1)[..., None]).squeeze(-1)
        return chosen * state.return_scale + state.return_mean


def _valid(batch: Rollout, rows: Tensor) -> Tensor:
    """Select the valid rows of (P, T, B, …), as (P, K, …); P must be 1 if some are invalid."""
    flat = rows.flatten(1, 2)
    return flat if batch.valid is None else flat[:, batch.valid[0].flatten()]
