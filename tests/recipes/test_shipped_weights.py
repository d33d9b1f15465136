"""Weights that are shipped act as the documentation says, in Gymnasium's own environments."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from skillweave import Hierarchy, recipes

ROOT = Path(__file__).parents[2]

# By recipe, what its environment needs; how many episodes; whether the selector is greedy; and what
# their mean return reaches at least. Here they have 249, 1, 9,768, 1 and 1.
SHIPPED = {
    "lunar-lander": ("Box2D", 10, True, 200.0),
    "lander-missions": ("Box2D", 5, True, 0.8),
    "shuttle": ("mujoco", 2, True, 7_500.0),
    "pick-and-place": ("gymnasium_robotics", 10, True, 0.8),
    "mazes": ("gymnasium_robotics", 10, False, 0.7),
}


def test_every_recipe_with_weights_is_here_and_made_by_make_weights():
    found = [n for n in recipes.names() if recipes.source(n).with_suffix(".safetensors").exists()]
    assert sorted(SHIPPED) == found
    made = re.search("WITH_WEIGHTS := (.*)", (ROOT / "Makefile").read_text())
    assert made is not None
    assert sorted(made[1].split()) == found


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_weights_do_their_task(name):
    needs, episodes, greedy, bar = SHIPPED[name]
    pytest.importorskip(needs)
    run = Hierarchy.pretrained(name)
    assert run.policy.labels == tuple(s.name for s in recipes.load(name).skills)
    assert run.evaluate(episodes, deterministic=greedy).mean > bar
