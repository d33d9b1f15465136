"""Mapped policies act in an export as they act here: the runner applies the mapping itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from skills.mapped_models import ACTION, CASES, SPACE, observations

from skillweave.api.player import Player
from skillweave.export.runner import Runner
from skillweave.export.write import write_export
from skillweave.types import Array

pytest.importorskip("onnxscript")
pytest.importorskip("stable_baselines3")
torch.set_num_threads(1)


def one(obs: Array, i: int) -> dict[str, Any]:
    """An observation as an environment returns it."""
    return {
        "gyro": obs["gyro"][i],
        "state": obs["state"][i],
        "arm": {"joints": obs["arm"]["joints"][i], "grip": obs["arm"]["grip"][i]},
    }


def compare(policy: Any, folder: Path, code: Any) -> None:
    """Let a player and the runner act in episodes of 7 and more steps."""
    player, runner, told = Player(policy), Runner(folder, code), []
    for i, obs in enumerate(observations(1, 40, seed=4)):
        if i in (7, 20):
            player.reset(), runner.reset()
        action = player.act(one(obs, 0))
        np.testing.assert_allclose(runner.act(one(obs, 0)), action, atol=1e-5)
        told.append(np.round(action, 3))
    assert len(np.unique(told)) > 3


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("name", CASES)
def test_the_runner_applies_the_mapping(name: str, tmp_path: Path) -> None:
    policy = CASES[name](tmp_path).policy.bind(SPACE, ACTION, "it")
    export = write_export(tmp_path / "out", policy, "robot")
    compare(policy, tmp_path / "out", export.functions)
