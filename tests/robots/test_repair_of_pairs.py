"""``MeasuredHandovers.repair``: a pair that always fails learns a correction on varied robots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots.owner import policies, up
from robots.test_handovers import VARY

import skillweave as sw
from skillweave.errors import DeclarationError
from skillweave.robots.learning_on import KINDS, Varied, declared, untrained
from skillweave.robots.measuring import MeasuredHandovers
from skillweave.robots.variation import Variation
from skillweave.toys.balancer import Balancer


def upright(step: sw.Step) -> Any:
    return 1.0 - 4.0 * np.abs(step.next_obs["tilt"][:, 0]) - 10.0 * step.terminated


def measured(calls: int) -> MeasuredHandovers:
    skills = {name: policy for name, policy in policies().items() if name != "slow"}
    return sw.handovers(Balancer, skills, steps=100, stays=up, calls=calls, vary=VARY, quiet=True)


@pytest.mark.slow
@pytest.mark.needs("repair")
def test_a_pair_that_always_fails_is_repaired(tmp_path: Path) -> None:
    found = measured(10)
    assert found.pair("fast", "wave").done == 0
    better = found.repair(
        "wave", after="fast", reward=upright, run_dir=tmp_path / "run", seed=1, quiet=True
    )
    assert better.pair("fast", "wave").rate > 0.5
    assert better.run.repairs[-1].kept
    for pair in better.pairs:
        assert pair.rate > found.pair(pair.after, pair.skill).rate - 0.11
    assert {e.robot for e in better.entries}.isdisjoint(e.robot for e in found.entries)


@pytest.mark.needs("repair")
def test_mistakes_end_in_a_sentence() -> None:
    found = measured(1)
    with pytest.raises(DeclarationError, match="reward"):
        found.repair("wave", after="fast", reward=3)  # type: ignore[arg-type]
    with pytest.raises(DeclarationError, match="'fsat'"):
        found.repair("wave", after="fsat", reward=upright)
    with pytest.raises(DeclarationError, match="handovers"):
        MeasuredHandovers(("a", "b"), (), 1, (1, 1)).repair("a", after="b", reward=upright)


@pytest.mark.needs("repair")
def test_what_is_repaired_is_what_was_measured(tmp_path: Path) -> None:
    skills = policies()

    class Fast(sw.Skill):
        policy = skills["fast"]
        fade = 5

        def termination(self, step: sw.Step) -> Any:
            return step.elapsed >= 15

    class Wave(sw.Skill):
        policy = skills["wave"]

        def initiation(self, obs: Any) -> Any:
            return np.abs(obs["tilt"][:, 0]) < 0.3

    found = sw.handovers(Balancer, [Fast(), Wave()], steps=60, stays=up, calls=2, quiet=True)
    fast, wave = (
        declared(aim, policy, residual, upright, 70)
        for aim, policy, residual in zip(
            found.trial.aims, found.trial.skills.policies, (None, 0.5), strict=True
        )
    )
    assert (fast.name, fast.fade, wave.name, wave.fade) == ("fast", 5, "wave", None)
    assert (fast.call_steps, wave.call_steps) == (70, 70)
    assert fast.defines("termination")
    assert wave.defines("initiation")
    assert wave.defines("success")
    assert wave.defines("reward")
    with pytest.raises(DeclarationError, match="fade"):
        declared(found.trial.aims[0], skills["fast"], 0.5, upright, 70)


def test_episodes_of_training_are_each_of_a_robot_that_was_drawn() -> None:
    env = Varied(sw.EnvSpec(Balancer), Variation({"latency": (0, 3), "grip": (0.5, 1.0)}))
    grips = []
    for seed in range(60):
        obs, _ = env.reset(seed=seed)
        again, _ = env.reset(seed=seed)
        assert all(np.array_equal(obs[key], again[key]) for key in obs)
        now: Any = env._now.unwrapped
        grips.append(now.grip)
        assert 0.5 <= now.grip <= 1.0
        env.step(np.zeros(2, np.float32))
    assert 5 < len(set(grips)) <= KINDS
    env.close()


@pytest.mark.needs("repair")
def test_a_correction_that_has_learnt_nothing_is_exactly_zero(tmp_path: Path) -> None:
    skills = policies()

    class Wave(sw.Skill):
        policy = sw.Residual(skills["wave"], scale=0.5)

        def reward(self, step: sw.Step) -> Any:
            return upright(step)

    class Plain(sw.Skill):
        name = "wave"
        policy = skills["wave"]

    def both(skill: sw.Skill) -> sw.Hierarchy:
        choose = lambda obs: ["wave"] * len(obs)  # noqa: E731
        return sw.Hierarchy(Balancer, [skill], selector=choose, learn="apart", steps=1)

    run = untrained(both(Wave()), "wave", tmp_path / "run", seed=0)
    assert run.info()["stages"][0]["steps"] == 0
    plain = both(Plain()).train(tmp_path / "plain", seed=0, quiet=True)
    one, other = (x.evaluate(10, seed=3) for x in (run, plain))
    assert one.returns == other.returns
    assert one.lengths == other.lengths
