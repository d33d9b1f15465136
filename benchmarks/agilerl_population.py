"""Steps/s of AgileRL's population of 8 by its own training function; run by benchmarks.population.

It needs an interpreter with ``pip install agilerl peft "gymnasium[box2d]"``, and nothing of ours.
"""

from __future__ import annotations

import sys
import time

import gymnasium as gym
import torch
from agilerl.training.train_on_policy import train_on_policy
from agilerl.utils.utils import create_population, make_vect_envs

MEMBERS, ENVS = 8, 16
SETTINGS = {  # its defaults
    "BATCH_SIZE": 64,
    "LR": 1e-4,
    "LEARN_STEP": 4096,
    "GAMMA": 0.99,
    "GAE_LAMBDA": 0.95,
    "ACTION_STD_INIT": 0.6,
    "CLIP_COEF": 0.2,
    "ENT_COEF": 0.01,
    "VF_COEF": 0.5,
    "MAX_GRAD_NORM": 0.5,
    "TARGET_KL": None,
    "UPDATE_EPOCHS": 4,
}


def main() -> None:
    steps = int(sys.argv[1])  # of all members together
    torch.set_num_threads(1)
    reference = gym.make("LunarLander-v3")
    env = make_vect_envs("LunarLander-v3", num_envs=ENVS, should_async_vector=False)
    population = create_population(
        algo="PPO",
        net_config={"encoder_config": {"hidden_size": [64]}, "head_config": {"hidden_size": [64]}},
        INIT_HP=SETTINGS,
        observation_space=reference.observation_space,
        action_space=reference.action_space,
        population_size=MEMBERS,
        num_envs=ENVS,
        device="cpu",
    )
    each = steps // MEMBERS
    started = time.perf_counter()
    train_on_policy(
        env,
        "LunarLander-v3",
        "PPO",
        population,
        max_steps=each,
        evo_steps=each,
        eval_steps=1,  # as little evaluation as it lets us
        verbose=False,
    )
    seconds = time.perf_counter() - started
    print(each * MEMBERS / seconds)


if __name__ == "__main__":
    main()
