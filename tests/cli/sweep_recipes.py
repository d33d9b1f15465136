"""Recipes for sweeps."""

from __future__ import annotations

RECIPE = '''
"""One skill on CartPole."""
from skillweave import Apart, EnvSpec, Network, PPO, Hierarchy, Skill, TrainDefaults

class Still(Skill):
    def reward(self, step):
        return -abs(step.next_obs[:, 1])

small = PPO(num_envs=2, n_steps=16, batch_size=16, update_epochs=1, network=Network(hidden=(8,)))
hierarchy = Hierarchy(
    EnvSpec("CartPole-v1", engine="sync"), [Still()],
    algorithm=small, selector=small, learn="apart",
    apart=Apart(skill_steps=64, selector_steps=64),
    train_defaults=TrainDefaults(checkpoint_every=32),
)
'''


DYING = """
import os

class Dying(Still):
    def reward(self, step):
        try:
            os.close(os.open(__file__ + ".once", os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            return super().reward(step)
        os._exit(3)
"""


DYING_RECIPE = RECIPE.replace("\nsmall", f"{DYING}\nsmall", 1).replace("[Still()]", "[Dying()]")
