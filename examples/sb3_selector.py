"""Train a selector with Stable-Baselines3's PPO, unchanged, on Skillweave's ``OptionsEnv``.

Two skills balance CartPole's pole, both written by hand: one lets the cart drift left, the other
right. Neither lasts: the cart leaves the track. The selector learns when to change between them.

    pip install 'skillweave' stable-baselines3
    python examples/sb3_selector.py --steps 50000
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from skillweave import Hierarchy, Skill, evaluate, from_function
from skillweave.envs import OptionsEnv, make_options_env
from skillweave.types import Array, Evaluation, HierarchyPolicy, Policy

GAMMA = 0.999  # of one environment step
CALL_STEPS = 10


def leaning(sign: float) -> Policy:
    """Balance the pole a little aside of upright, so that the cart drifts."""

    def act(obs: Array) -> Array:
        angle, turning = obs[:, 2], obs[:, 3]
        return (angle - sign * 0.1 + 0.5 * turning > 0).astype(np.int64)

    return from_function(act)


class DriftLeft(Skill):
    """Keeps the pole up while the cart drifts to the left."""

    policy = leaning(-1.0)


class DriftRight(Skill):
    """Keeps the pole up while the cart drifts to the right."""

    policy = leaning(1.0)


class SB3VecEnv(VecEnv):
    """A Gymnasium vector that resets in the same step, as Stable-Baselines3's ``VecEnv``.

    What Stable-Baselines3 does not know: how long a call lasted. Rewards inside a call are
    discounted step by step (Σ γᵏ rₖ, by OptionsEnv), but between decisions it discounts by its own
    constant γ once a decision, not by γ^τ (``info["discount"]``). Where calls last about equally
    long, as here, γ to the power of that length comes close. Skillweave's own PPO takes γ^τ.
    """

    def __init__(self, env: OptionsEnv, seed: int) -> None:
        self.env, self.next_seed = env, seed
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Array:
        """Return the first observations."""
        obs, _ = self.env.reset(seed=self.next_seed)
        self.next_seed += 1
        return obs

    def step_async(self, actions: Array) -> None:
        """Remember which skills to call."""
        self.actions = actions

    def step_wait(self) -> Any:
        """Make one call in each environment."""
        obs, reward, terminated, truncated, info = self.env.step(self.actions)
        infos: list[dict[str, Any]] = [{"steps": int(tau)} for tau in info["steps"]]
        for i in np.flatnonzero(terminated | truncated):
            # obs[i] begins the next episode; where a time limit ended this one, Stable-Baselines3
            # bootstraps from the observation given here.
            infos[i]["terminal_observation"] = info["final_obs"][i]
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        return obs, reward, terminated | truncated, infos

    def close(self) -> None:
        """Close the environments."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the vector, once for each environment."""
        return [getattr(self.env, attr_name, None)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not supported: the environments stand in an engine."""
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Not supported: the environments stand in an engine."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No environment is wrapped by Stable-Baselines3."""
        return [False] * len(list(self._get_indices(indices)))


class StepBudget(BaseCallback):
    """A stop after a number of environment steps; Stable-Baselines3 itself counts decisions."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.left = steps

    def _on_step(self) -> bool:
        self.left -= sum(info["steps"] for info in self.locals["infos"])
        return self.left > 0


def score(model: PPO, env: OptionsEnv, episodes: int) -> Evaluation:
    """Evaluate the selector with its skills as one policy, on Gymnasium's environment."""

    def choose(obs: Array) -> Array:
        return model.predict(obs, deterministic=True)[0]

    spaces = {"observation_space": model.observation_space, "action_space": model.action_space}
    hierarchy = HierarchyPolicy(from_function(choose, **spaces), env.skills)
    return evaluate(hierarchy, "CartPole-v1", episodes=episodes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=50_000, help="training, environment steps")
    parser.add_argument("--episodes", type=int, default=20, help="of each evaluation")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)

    hierarchy = Hierarchy("CartPole-v1", [DriftLeft(), DriftRight()], call_steps=CALL_STEPS)
    options = make_options_env(hierarchy, 8, GAMMA)
    env = SB3VecEnv(options, args.seed)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=32,
        batch_size=64,
        learning_rate=1e-3,
        gamma=GAMMA**CALL_STEPS,
        seed=args.seed,
        device="cpu",
    )
    for skill in hierarchy.skills:
        assert skill.policy is not None
        alone = evaluate(skill.policy, "CartPole-v1", episodes=args.episodes)
        print(f"{skill.name} alone: {alone}")
    model.learn(total_timesteps=args.steps, callback=StepBudget(args.steps))
    print(f"skills under the selector: {score(model, options, args.episodes)}")
    env.close()


if __name__ == "__main__":
    main()
