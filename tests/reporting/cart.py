"""A small hierarchy on CartPole as a recipe, for reports that need a real run."""

RECIPE = """
from skillweave import PPO, Apart, EnvSpec, Hierarchy, Network, Skill

class Left(Skill):
    max_steps = 10
    def reward(self, step):
        return -step.next_obs[:, 0]
    def success(self, step):
        return step.next_obs[:, 0] < 0

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
)
"""
