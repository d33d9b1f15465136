"""A recipe of two skills on CartPole, as the text of a file."""

from __future__ import annotations

PLAIN = '''
"""Two skills on CartPole."""
from skillweave import (
    Apart, Network, PPO, EnvSpec, Hierarchy, Reflex, Selection, Skill, TrainDefaults,
)

class Left(Skill):
    max_steps = 10
    def reward(self, step):
        return -step.next_obs[:, 0]

class Balance(Skill):
    pass

small = PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=1, network=Network(hidden=(8,)))
hierarchy = Hierarchy(
    env=EnvSpec("CartPole-v1", engine="sync"),
    skills=[Left(), Balance()],
    call_steps=5,
    algorithm=small,
    selector=small,
    learn="apart",
    apart=Apart(skill_steps=256, selector_steps=512),
    train_defaults=TrainDefaults(checkpoint_every=128),
)
'''
