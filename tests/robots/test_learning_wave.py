"""A ready ONNX file that falls after another skill learns on by ``Run.repair``, and goes home."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots.learning_wave import robot, slippery, wave_file
from robots.owner import driving

from skillweave.policies.core import Array

ort = pytest.importorskip("onnxruntime")


def stays_up(session: Any, seed: int) -> bool:
    """Play a fast drive and then the wave in a plain loop, the wave by onnxruntime alone."""
    env = slippery()
    obs, _ = env.reset(seed=seed)
    for step in range(120):
        x = np.concatenate([obs["tilt"], obs["gyro"], obs["speed"]])[None].astype(np.float32)
        if step < 60:
            action: Array = driving(np.concatenate([x, [[1.5]]], axis=1))
        else:
            action = session.run(["actions"], {"obs": x})[0]
        obs, _, fell, _, _ = env.step(np.clip(action[0], -1, 1))
        if fell:
            return False
    return True


@pytest.mark.slow
@pytest.mark.needs("repair")
def test_a_file_learns_on_after_another_skill_and_goes_home(tmp_path: Path) -> None:
    before = ort.InferenceSession(str(wave_file(tmp_path / "wave.onnx")))
    run = robot(tmp_path).train(tmp_path / "run", seed=0, quiet=True)
    better = run.repair(
        "wave", after="fast", steps=40_000, calls=60, run_dir=tmp_path / "better", quiet=True
    )
    repair = better.repairs[-1]
    assert repair.kept
    assert repair.later.of("wave", "fast")[0] - repair.before.of("wave", "fast")[0] > 0.5
    (tmp_path / "wave.onnx").unlink()  # the repaired run has its own copy
    path = better.save_onnx("wave", tmp_path / "wave-2.onnx")
    after = ort.InferenceSession(str(path))
    player = better.player(skill="wave")
    rng = np.random.default_rng(0)
    for _ in range(50):
        obs = {name: rng.normal(size=1).astype(np.float32) for name in ("tilt", "gyro", "speed")}
        numbers = np.concatenate([obs["tilt"], obs["gyro"], obs["speed"]])[None]
        wanted = np.clip(after.run(["actions"], {"obs": numbers})[0][0], -1, 1)
        np.testing.assert_allclose(player.act(obs), wanted, atol=1e-5, rtol=1e-5)
    assert sum(stays_up(before, seed) for seed in range(20)) <= 2
    assert sum(stays_up(after, seed) for seed in range(20)) >= 15
