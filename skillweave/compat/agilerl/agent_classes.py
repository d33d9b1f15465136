"""The agents: AgileRL's names and signatures, on the native API."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch

from skillweave.algorithms import config
from skillweave.algorithms.batches import Rollout
from skillweave.compat.agilerl.agent import MLP, AgilerlAgent, Setting, tensor_of
from skillweave.compat.numpy_actor import NumpyActor
from skillweave.errors import DeclarationError
from skillweave.evolution.stacks import Member
from skillweave.policies.core import Array
from skillweave.spaces import to_tensor


class PPO(AgilerlAgent):
    """A PPO agent."""

    algo = "PPO"
    kind = config.PPO
    fixed: ClassVar[dict[str, Any]] = {
        "learning_rate_schedule": "constant",
        "num_envs": 1,
        "n_steps": 65_536,  # learn() takes any number; this only limits batch_size
        "min_advantage_std": 0.0,  # AgileRL has no such limit
    }
    lr, gae_lambda, clip_coef = map(Setting, ("learning_rate", "gae_lambda", "clip_coef"))
    ent_coef, vf_coef, max_grad_norm = map(Setting, ("ent_coef", "vf_coef", "max_grad_norm"))
    target_kl = Setting("target_kl")
    update_epochs = Setting("update_epochs")
    action_std_init = Setting("action_std_init")

    def __init__(
        self,
        state_dim: Any,
        action_dim: int,
        one_hot: bool,
        discrete_actions: bool,
        index: int = 0,
        net_config: Any = MLP,
        batch_size: int = 64,
        lr: float = 1e-4,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        mut: str | None = None,
        action_std_init: float = 0.6,
        clip_coef: float = 0.2,
        ent_coef: float = 0.01,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
        target_kl: float | None = None,
        update_epochs: int = 4,
        actor_network: Any = None,
        critic_network: Any = None,
        device: Any = "cpu",
        accelerator: Any = None,
        wrap: bool = True,
    ) -> None:
        actions: gym.Space[Any] = gym.spaces.Box(-np.inf, np.inf, (action_dim,), np.float32)
        actions = gym.spaces.Discrete(action_dim) if discrete_actions else actions
        self._start(locals(), actions, adam_eps=1e-8)

    def become(self, member: Member) -> None:
        """Continue as another member; see the base."""
        super().become(member)
        self.numpy_actor = NumpyActor(self.learner, member.state)

    def getAction(self, state: Any, action: Any = None, grad: bool = False) -> tuple[Array, ...]:
        """Sample actions int64 (B,) or float32 (B, A); log-probabilities, entropies, values."""
        if action is not None or grad:
            raise DeclarationError("getAction(action=, grad=) is a part of learning: use learn()")
        return self.numpy_actor.sample(self.rows(state), self.rng)

    def learn(self, experiences: Any, noise_clip: float = 0.5, policy_noise: float = 0.2) -> float:
        """Learn from T states, actions, log-probabilities, rewards, terminations and values.

        Last come the observations (N, ...) after the last step. Returns the loss.
        """
        self.updates += 1
        rng = [(self.seeds / "update" / self.updates).torch()]
        _, report = self.learner.update(self.member.state, self.rollout(experiences), rng)
        self.numpy_actor = NumpyActor(self.learner, self.member.state)
        losses = {k: float(v) for k, v in report.metrics.items()}
        value_part = self.vf_coef * losses["value_loss"] - self.ent_coef * losses["entropy"]
        return float(losses["policy_loss"] + value_part)

    def rollout(self, experiences: Any) -> Rollout:
        """Return the experiences of N environments that ``learn`` takes as a rollout.

        The successor of a step is the next entry of the states. Actions are in policy units, and
        count as drawn with the log-probabilities given.
        """
        states, action, log_prob, reward, ended, _, after = experiences
        learner = self.learner
        state = self.member.state
        rewards = tensor_of(reward, np.float32)
        lead = 1, len(rewards), max(1, rewards[0].numel())
        obs = to_tensor(self.rows(states)).unflatten(0, lead)
        ends = tensor_of(ended, bool).view(lead)
        last = ends.clone()
        last[:, -1] = True
        kind = np.int64 if learner.codec.discrete else np.float32
        actions = tensor_of(action, kind).view(*lead, *(self.spaces[1].shape or ()))
        log_std = learner.layout.views(state.params).get("actor.log_std")
        log_std = None if log_std is None else log_std[:, None].clone()
        log_probs = tensor_of(log_prob, np.float32).view(lead)
        return Rollout(
            obs,
            actions,
            rewards.view(lead),
            state.gamma[:, None, None] * ~ends,
            torch.cat([obs[:, 1:], to_tensor(self.rows(after))[None, None]], 1),
            last,
            dist_params=learner.head.with_log_prob(actions, log_probs, log_std),
            log_std=log_std,
        )


class DQN(AgilerlAgent):
    """A DQN agent."""

    algo = "DQN"
    kind = config.DQN
    lr = Setting("learning_rate")
    double = Setting("double")
    tau = Setting("tau")
    learn_step = Setting("update_ratio", inverse=True)

    def __init__(
        self,
        state_dim: Any,
        action_dim: int,
        one_hot: bool,
        index: int = 0,
        net_config: Any = MLP,
        batch_size: int = 64,
        lr: float = 1e-4,
        learn_step: int = 5,
        gamma: float = 0.99,
        tau: float = 1e-3,
        mut: str | None = None,
        double: bool = False,
        actor_network: Any = None,
        device: Any = "cpu",
        accelerator: Any = None,
        wrap: bool = True,
    ) -> None:
        self._start(locals(), gym.spaces.Discrete(action_dim), loss="mse")

    def getAction(self, state: Any, epsilon: float = 0, action_mask: Any = None) -> Array:
        """Return actions (B,) int64: any allowed one with probability ``epsilon``, or the best."""
        return self.act(state, explore=False, epsilon=epsilon, mask=action_mask)

    def learn(self, experiences: Any) -> float:
        """Make one gradient step; return the loss."""
        return self.learn_sample(self.gamma, experiences[:5])[0]["loss"]


class RainbowDQN(AgilerlAgent):
    """A DQN agent with every extension of Rainbow."""

    algo = "Rainbow DQN"
    kind = config.DQN
    beta = 0.4
    prior_eps = 1e-6
    lr = Setting("learning_rate")
    num_atoms = Setting("n_atoms")
    n_step = Setting("n_step")
    tau = Setting("tau")
    learn_step = Setting("update_ratio", inverse=True)
    v_min = Setting("v_min")
    v_max = Setting("v_max")

    def __init__(
        self,
        state_dim: Any,
        action_dim: int,
        one_hot: bool,
        index: int = 0,
        net_config: Any = MLP,
        batch_size: int = 64,
        lr: float = 1e-4,
        learn_step: int = 5,
        gamma: float = 0.99,
        tau: float = 1e-3,
        beta: float = 0.4,
        prior_eps: float = 1e-6,
        num_atoms: int = 51,
        v_min: float = -10,
        v_max: float = 10,
        n_step: int = 3,
        mut: str | None = None,
        actor_network: Any = None,
        device: Any = "cpu",
        accelerator: Any = None,
        wrap: bool = True,
    ) -> None:
        self._start(locals(), gym.spaces.Discrete(action_dim), config.DQN.rainbow)
        self.beta = beta
        self.prior_eps = prior_eps

    def getAction(self, state: Any, action_mask: Any = None, training: bool = True) -> Array:
        """Return the best actions (B,) int64; with noise in the weights while ``training``."""
        return self.act(state, explore=training, mask=action_mask)

    def learn(self, experiences: Any, n_step: bool = False, per: bool = False) -> Any:
        """Make one gradient step; return the loss, the samples' indices and their new priorities.

        After the five of every sample come, with ``per``, weights and indices; with ``n_step``
        the five again, summed over n steps: only these are learnt from then.
        """
        used = experiences[-5:] if n_step else experiences[:5]
        gamma = self.gamma**self.n_step if n_step else self.gamma
        weights = experiences[5] if per else None
        metrics, errors = self.learn_sample(gamma, used, weights)
        if not per:
            return metrics["loss"], None, None
        return metrics["loss"], experiences[6], errors + self.prior_eps


class TD3(AgilerlAgent):
    """A TD3 agent."""

    algo = "TD3"
    kind = config.TD3
    fixed: ClassVar[dict[str, Any]] = {"twin": True, "n_step": 1, "action_l2": 0.0}
    lr_critic = Setting("learning_rate")
    policy_freq = Setting("policy_delay")
    tau = Setting("tau")
    learn_step = Setting("update_ratio", inverse=True)

    def __init__(
        self,
        state_dim: Any,
        action_dim: int,
        one_hot: bool,
        max_action: float = 1,
        min_action: float = -1,
        expl_noise: float = 0.1,
        index: int = 0,
        net_config: Any = MLP,
        batch_size: int = 64,
        lr_actor: float = 1e-4,
        lr_critic: float = 1e-3,
        learn_step: int = 5,
        gamma: float = 0.99,
        tau: float = 0.005,
        mut: str | None = None,
        policy_freq: int = 2,
        actor_network: Any = None,
        critic_networks: Any = None,
        device: Any = "cpu",
        accelerator: Any = None,
        wrap: bool = True,
    ) -> None:
        actions = gym.spaces.Box(min_action, max_action, (action_dim,), np.float32)
        noise = 2.0 * expl_noise / (max_action - min_action)
        rate = lr_actor / lr_critic
        self._start(locals(), actions, exploration_noise=noise, actor_rate=rate)

    @property
    def lr_actor(self) -> float:
        """Return the actor's learning rate."""
        return float(self.lr_critic * self.member.config.actor_rate)

    @lr_actor.setter
    def lr_actor(self, value: float) -> None:
        self.set(actor_rate=value / self.lr_critic)

    def getAction(self, state: Any, epsilon: float = 0) -> Array:
        """Return actions (B, A) float32: random with probability ``epsilon``, or noisy."""
        return self.act(state, epsilon=epsilon)

    def learn(self, experiences: Any, noise_clip: float = 0.5, policy_noise: float = 0.2) -> Any:
        """Make one gradient step; return the losses of actor (or None) and critics."""
        state = self.member.state
        state.target_noise.fill_(policy_noise)
        state.target_noise_clip.fill_(noise_clip)
        metrics, _ = self.learn_sample(self.gamma, experiences[:5])
        due = int(state.updates[0]) % self.policy_freq == 0
        return metrics["policy_loss"] if due else None, metrics["critic_loss"]


class DDPG(TD3):
    """A DDPG agent: one critic."""

    algo = "DDPG"
    fixed = TD3.fixed | {"twin": False}

    def __init__(
        self,
        state_dim: Any,
        action_dim: int,
        one_hot: bool,
        max_action: float = 1,
        min_action: float = -1,
        expl_noise: float = 0.1,
        index: int = 0,
        net_config: Any = MLP,
        batch_size: int = 64,
        lr_actor: float = 1e-4,
        lr_critic: float = 1e-3,
        learn_step: int = 5,
        gamma: float = 0.99,
        tau: float = 0.001,
        mut: str | None = None,
        policy_freq: int = 2,
        actor_network: Any = None,
        critic_network: Any = None,
        device: Any = "cpu",
        accelerator: Any = None,
        wrap: bool = True,
    ) -> None:
        given = {k: v for k, v in locals().items() if k not in ("self", "__class__")}
        super().__init__(**{k.replace("c_network", "c_networks"): v for k, v in given.items()})


KINDS: dict[str, Any] = {kind.algo: kind for kind in (PPO, DQN, RainbowDQN, DDPG, TD3)}
"""The agents, by their names in AgileRL."""
