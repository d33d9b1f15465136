"""What users import: the list of names, and that README and examples need nothing else."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from installed import HOMES

import skillweave as sw

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
NAMES = """
Acts Agent Apart Automaton CQL DQN Dataset Elapsed EnvSpec Goal Guide Hierarchy IQL LastAction
Lengths Network PPO Part Player Reflex Residual Run SAC Selection Skill SkillweaveError Step TD3
Table Together TrainDefaults evaluate from_deploy from_function from_hub from_metadata from_onnx
from_sb3 from_torch handovers inputs load load_policy record reference_motion save_policy
train_agent tree
"""


SHIPPED = (*HOMES, "skillweave.toys", "skillweave.calls", "skillweave.planning")
"""Modules that users import from."""


def test_the_public_names_are_these():
    assert sorted(sw.__all__) == sorted(NAMES.split())
    assert len(sw.__all__) == 48
    assert dir(sw) == sorted(sw.__all__)


def imported_deeper(source: str) -> list[str]:
    """Modules within the library that a program of a user's imports from."""
    found: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            found.append(node.module or "")
        elif isinstance(node, ast.Import):
            found += [a.name for a in node.names]
    return [name for name in found if name.startswith("skillweave.") and name not in SHIPPED]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_import_from_the_package_alone(path):
    assert imported_deeper(path.read_text()) == []


class Left(sw.Skill):
    policy = sw.from_function(lambda obs: np.zeros(len(obs), np.int64))


class Right(sw.Skill):
    policy = sw.from_function(lambda obs: (obs[:, 2] > 0).astype(np.int64))


def test_a_policy_is_evaluated_on_an_environment_by_its_id():
    found = sw.evaluate(Right.policy, "CartPole-v1", episodes=3)
    spec = sw.EnvSpec("CartPole-v1")
    bound = Right.policy.bind(spec.make().observation_space, spec.make().action_space, "right")
    assert found == sw.evaluate(bound, spec, episodes=3)
    assert found.mean > sw.evaluate(Left.policy, "CartPole-v1", episodes=3).mean


def test_an_options_env_is_made_of_a_declaration_and_of_a_run(tmp_path):
    hierarchy = sw.Hierarchy(
        "CartPole-v1",
        [Left(), Right()],
        call_steps=3,
        selector=lambda obs: np.zeros(len(obs), int),
        learn="apart",
    )
    run = hierarchy.train(tmp_path / "run", quiet=True)
    seen = []
    for source in (hierarchy, run):
        env = sw.envs.make_options_env(source, 2, 0.9)
        env.reset(seed=4)
        assert env.single_action_space.n == 2
        seen.append(env.step(np.array([1, 0])))
        env.close()
    assert (seen[0][0] == seen[1][0]).all()
    assert seen[0][1] == pytest.approx([1 + 0.9 + 0.81] * 2)
