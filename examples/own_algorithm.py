"""An algorithm of your own: advantage actor-critic (Mnih et al. 2016) in one file.

It trains plain agents, skills, selectors and populations, as the library's own algorithms do.
Everything is stacked: tensors begin with the member axis P, and a single agent is P = 1.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from skillweave import train_agent
from skillweave.algorithms import (
    ActingParams,
    ActionHead,
    AgentState,
    Algorithm,
    Layout,
    Net,
    OnPolicy,
    ParameterGroup,
    Report,
    Rollout,
    adam_,
    clip_grad_norm_,
    gae,
    mask_logits,
    masked_mean,
    normalize,
    register_algorithm,
)
from skillweave.types import Seeds


@dataclass(frozen=True)
class A2C(OnPolicy):
    """Settings of the algorithm: three numbers beside the common ones of on-policy algorithms."""

    n_steps: int = 16
    overlap: bool = False  # its gradient is right only for rows of the latest policy
    gae_lambda: float = 0.95
    ent_coef: float = 0.01
    max_grad_norm: float = 0.5


@dataclass
class State(AgentState):
    """Weights and counts, and a hyperparameter with a value for each member."""

    ent_coef: Tensor  # (P,)


class A2CAlgorithm(Algorithm):
    """One gradient step for each rollout, of policy, value and entropy together."""

    store = "rollout"
    action_spaces = (gym.spaces.Discrete, gym.spaces.Box)
    state_type = State
    member_hyperparameters = ("learning_rate", "gamma", "ent_coef")

    def __init__(self, config: A2C, observation_space: Any, action_space: Any) -> None:
        super().__init__(config, observation_space, action_space)
        self.head = ActionHead(self.codec, "state")  # logits, or mean and log deviation
        self.actor = Net("actor", self.obs, config.network, self.head.width)
        self.critic = Net("critic", self.obs, config.network, 1)
        self.acting = Layout(self.actor.shapes)
        self.layout = Layout(self.actor.shapes | self.critic.shapes)

    def fresh_state(self, seeds: Sequence[Seeds]) -> State:
        """Return a state with one member for each seed."""
        params = torch.zeros(len(seeds), self.layout.size)
        views = self.layout.views(params)
        generators = self.member_generators(seeds)
        self.actor.init_(views, 0.01, generators)
        self.critic.init_(views, 1.0, generators)
        return State(**self.fresh_fields(params))

    def parameter_groups(self) -> list[ParameterGroup]:
        """Both networks have the shape that ``config.network`` says."""
        return [ParameterGroup(self.layout, (("network", self.actor), ("network", self.critic)))]

    def act(
        self,
        params: ActingParams,
        obs: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, None]:
        """Return actions (P, B, …), the head that they come from, and no memory."""
        head = self.actor(params.views, self.inputs(params, obs))
        if self.head.discrete:
            head = mask_logits(head, mask)
        return self.head.act(head, None, noise), head, None

    def value(self, state: State, obs: Tensor, mask: Tensor | None = None) -> Tensor:
        """V of observations, (P, B)."""
        params = self.learning_params(state)
        return self.critic(params.views, self.inputs(params, obs)).squeeze(-1)

    def update(
        self, state: State, rollout: Rollout, rng: Sequence[torch.Generator]
    ) -> tuple[State, Report]:
        """Make one gradient step on all rows of the rollout that are this learner's own."""
        lead, valid = rollout.reward.shape[1:], rollout.valid
        obs = rollout.obs.flatten(1, 2)
        next_obs = rollout.next_obs.flatten(1, 2)
        flat_valid = None if valid is None else valid.flatten(1, 2)
        self.update_obs_stats(state, obs, flat_valid)
        leaves = self.layout.leaves(state.params)
        inputs = self.inputs(self.learning_params(state), obs)
        value = self.critic(leaves, inputs).squeeze(-1).unflatten(1, lead)
        with torch.no_grad():
            following = self.value(state, next_obs).unflatten(1, lead)
            advantage = gae(
                rollout.reward,
                rollout.discount,
                value,
                following,
                rollout.last,
                torch.full_like(state.gamma, self.config.gae_lambda),
            )
            returns = advantage + value
        mask = None if rollout.mask is None else rollout.mask.flatten(1, 2)
        head = self.actor(leaves, inputs)
        log_prob, entropy = self.head.stats(head, None, mask, rollout.action.flatten(1, 2))
        gain = log_prob.unflatten(1, lead) * normalize(advantage, valid)
        policy_loss = -masked_mean(gain, valid)
        value_loss = 0.5 * masked_mean((value - returns).square(), valid)
        bonus = masked_mean(entropy, flat_valid)
        loss = policy_loss + 0.5 * value_loss - state.ent_coef * bonus
        grad = self.layout.gradient(loss, leaves)
        clip_grad_norm_(grad, torch.full_like(state.gamma, self.config.max_grad_norm))
        rate = state.learning_rate * (1.0 - rollout.progress)
        adam_(state.params, grad, state.mu, state.nu, state.count, rate)
        metrics = {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": bonus}
        return state, Report({name: x.detach() for name, x in metrics.items()})


register_algorithm(A2C, A2CAlgorithm)


def main() -> None:
    """Train it on CartPole, and say how well it does."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--out", default="runs/own_algorithm")
    asked = parser.parse_args()
    config = A2C(num_envs=32, learning_rate=3e-3)
    run = train_agent("CartPole-v1", config, asked.steps, asked.out)
    print("mean return:", run.evaluate(20).mean)


if __name__ == "__main__":
    main()
