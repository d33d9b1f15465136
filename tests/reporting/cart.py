"""A small hierarchy on CartPole as a recipe, for reports that need a real run."""

from cli.plain_recipe import PLAIN

SUCCESS = """
    def success(self, step):
        return step.next_obs[:, 0] < 0
"""
RECIPE = PLAIN.replace("\n\nclass Balance", f"{SUCCESS}\nclass Balance")
