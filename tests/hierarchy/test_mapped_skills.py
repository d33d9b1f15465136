"""Skills behind mappings in a hierarchy: trained, stopped, resumed, loaded and exported."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import torch
from declaring import plainly
from small_runs import goes_on
from torch import nn

import skillweave as sw
from skillweave import PPO, EnvSpec, Hierarchy, Network, Skill, TrainDefaults

pytestmark = pytest.mark.slow  # quick ones: tests/skills/test_mapped.py
SELECTOR = PPO(num_envs=3, n_steps=8, batch_size=24, network=Network((8,)))


class Recurrent(nn.Module):
    """A network with a state."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.cell, self.head = nn.GRUCell(4, 6), nn.Linear(6, 1)

    def forward(self, x: torch.Tensor, state: torch.Tensor):
        after = self.cell(x, state)
        return 3.0 * self.head(after), after


class Swing(Skill):
    """Remembers its last action, and acts in each second step."""

    policy = sw.from_torch(
        Recurrent(), sees=(slice(0, 3), sw.LastAction(scale=0.5)), state=(None, 6), every=2
    )


def plan(x: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.stack([x[:, :1] * k for k in (-1.0, 0.5, 2.0)], axis=1)


class Planned(Skill):
    """Three actions of each inference, against the speed."""

    policy = sw.from_function(plan, sees=sw.Part(places=(2,), scale=0.2), chunk=3)


def declare() -> Hierarchy:
    return Hierarchy(
        EnvSpec("Pendulum-v1", engine="sync", workers=1),
        [Swing(), Planned()],
        call_steps=5,
        selector=SELECTOR,
        train_defaults=TrainDefaults(checkpoint_every=75),
        **plainly({"selector_steps": 900}),
    )


def test_a_run_that_is_stopped_in_the_middle_of_calls_goes_on_bit_for_bit(tmp_path):
    whole = goes_on(declare, tmp_path)
    recorded = json.loads((whole.path / "run.json").read_text())["skills"][0]["policy"]
    assert recorded["mapping"]["every"] == 2
    assert recorded["mapping"]["sees"][""][1] == {"source": "last_action", "scale": 0.5}


def test_a_loaded_run_acts_by_its_recorded_mapping(tmp_path, monkeypatch):
    run = declare().train(tmp_path / "run", seed=3, quiet=True)
    weights = run.save_weights(tmp_path / "weights.safetensors")
    other = sw.from_torch(Recurrent(), sees=(slice(0, 3), 0), state=(None, 6))
    monkeypatch.setattr(Swing, "policy", other)
    wanted = run.evaluate(2, skill="swing").returns
    for load, place in ((declare().load, run.path), (declare().load_weights, weights)):
        with pytest.warns(UserWarning, match="otherwise now"):
            loaded = load(place)
        assert loaded.evaluate(2, skill="swing").returns == wanted
    assert sw.evaluate(other, "Pendulum-v1", episodes=2).returns != wanted
