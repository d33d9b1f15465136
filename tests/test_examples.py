"""Every example runs."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from toys import example

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
BRIEFLY = """
import runpy, sys
from skillweave import Hierarchy

train = Hierarchy.train

def briefly(self, *args, **how):
    self.scale(0.02)
    return train(self, *args, **how)

Hierarchy.train = briefly
runpy.run_path(sys.argv[1], run_name="__main__")
"""
"""Runs an example that takes no arguments, with a fiftieth of its steps."""
SMALL = {
    "bridge.py": ("--steps", "3000", "--out", "{folder}/run"),
    "doorkey.py": ("--steps", "3000", "--episodes", "5", "--out", "{folder}/run"),
    "foreign_skills.py": ("--steps", "3000"),
    "go_to.py": ("--steps", "3000", "--grid", "1", "--out", "{folder}/run"),
    "four_rooms.py": ("--steps", "3000"),
    "nested.py": ("--steps", "5000", "--out", "{folder}/run"),
    "new_mission.py": ("left then land", "--steps", "3000", "--episodes", "1"),
    "own_algorithm.py": ("--steps", "2000", "--out", "{folder}/run"),
    "own_network.py": ("--steps", "2000", "--out", "{folder}/run"),
    "robot_dog.py": ("{folder}/walk.onnx", "--steps", "2000", "--episodes", "1"),
    "sb3_selector.py": ("--steps", "3000", "--episodes", "2"),
    "tutorial.py": ("--scale", "0.01", "--episodes", "2", "--out", "{folder}/run"),
    "yard.py": ("--steps", "5000", "--episodes", "5", "--out", "{folder}/run"),
}
"""Small budgets, for those that take long."""
NEEDS = {
    "doorkey.py": ("minigrid",),
    "key_door.py": ("PIL",),
    "foreign_skills.py": ("stable_baselines3", "onnx", "onnxruntime"),
    "go_to.py": ("Box2D",),
    "new_mission.py": ("Box2D",),
    "robot_dog.py": ("envpool", "onnx", "onnxruntime", "PIL"),
    "sb3_selector.py": ("stable_baselines3",),
    "tutorial.py": ("Box2D", "PIL"),
}
SAYS = {
    "bridge.py": "solved: ",
    "doorkey.py": "solved: ",
    "foreign_skills.py": "skills under the selector: ",
    "go_to.py": "goals reached and held",
    "four_rooms.py": "steps from the corner to the goal: ",
    "key_door.py": "over 100 episodes",
    "nested.py": "both errands done: ",
    "new_mission.py": "over 1 episodes",
    "own_algorithm.py": "mean return: ",
    "own_network.py": "mean return: ",
    "ready_selectors.py": "automaton  return 1.00",
    "robot_dog.py": "points reached: ",
    "sb3_selector.py": "skills under the selector: ",
    "tutorial.py": "the hierarchy: ",
    "yard.py": "solved: ",
}


def run(path: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    env = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    program = ["-c", BRIEFLY, str(path)] if path.name == "key_door.py" else [str(path), *arguments]
    return subprocess.run(
        [sys.executable, *program],
        capture_output=True, text=True, env=env, cwd=folder, timeout=600, check=False,
    )  # fmt: skip


def test_what_every_example_says_is_known():
    assert {p.name for p in EXAMPLES} == set(SAYS)


def clumsy_dog(path: Path) -> None:
    """Write a policy for the robot dog that falls soon, so that missions are short."""
    import onnx
    from onnx import TensorProto, helper

    weights = np.random.default_rng(0).normal(size=(48, 12)).astype(np.float32)
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["obs", "w"], ["action"])],
        "dog",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, 48])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, [1, 12])],
        [onnx.numpy_helper.from_array(weights, "w")],
    )
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=9), path)


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.name)
def test_an_example_runs_to_its_end(path, tmp_path):
    for module in NEEDS.get(path.name, ()):
        pytest.importorskip(module)
    if path.name == "robot_dog.py":
        clumsy_dog(tmp_path / "walk.onnx")
    done = run(path, tmp_path, *(word.format(folder=tmp_path) for word in SMALL.get(path.name, ())))
    assert done.returncode == 0, done.stderr
    assert SAYS[path.name] in done.stdout
    assert "Traceback" not in done.stderr


def test_stable_baselines3_is_told_final_observations_time_limits_and_environment_steps():
    pytest.importorskip("stable_baselines3")
    from skillweave import EnvSpec
    from skillweave.envs import OptionsEnv
    from skillweave.envs.make import make_engine
    from skillweave.skills.skill_set import SkillSet

    module = example("sb3_selector")
    budget = module.StepBudget(25)
    budget.locals = {"infos": [{"steps": 10}, {"steps": 2}]}
    assert [budget._on_step(), budget._on_step(), budget._on_step()] == [True, True, False]
    skills = (module.DriftLeft(), module.DriftRight())
    policies = tuple(s.policy for s in skills)
    spec = EnvSpec("CartPole-v1", kwargs={"max_episode_steps": 47}, engine="sync")

    def make() -> OptionsEnv:
        return OptionsEnv(make_engine(spec, 6), SkillSet(skills, policies, call_steps=10), 0.99)

    theirs, ours = module.SB3VecEnv(make(), seed=3), make()
    assert (theirs.num_envs, theirs.action_space.n) == (6, 2)
    obs, _ = ours.reset(seed=3)
    np.testing.assert_array_equal(theirs.reset(), obs)
    limits = 0
    for t in range(60):
        # half of them drift off the track or fall over, the others change about
        action = np.where(np.arange(6) < 3, 0, t % 2)
        obs, reward, done, infos = theirs.step(action)
        want, pay, terminated, truncated, info = ours.step(action)
        np.testing.assert_array_equal(obs, want)
        np.testing.assert_array_equal(reward, pay)
        np.testing.assert_array_equal(done, terminated | truncated)
        for i in range(6):
            assert infos[i]["steps"] == info["steps"][i]
            assert ("terminal_observation" in infos[i]) == done[i]
            if done[i]:
                final = infos[i]["terminal_observation"]
                np.testing.assert_array_equal(final, info["next_obs"][i])
                assert np.abs(final - obs[i]).max() > 0
                assert infos[i]["TimeLimit.truncated"] == (truncated[i] and not terminated[i])
        limits += int((truncated & ~terminated).sum())
    theirs.close()
    ours.close()
    assert limits > 5


def test_the_tutorials_job_takes_a_third_of_its_lines():
    old = (ROOT / "tests/compat/tutorial.txt").read_text().split("Full code\n")[1]
    new = (ROOT / "examples/tutorial.py").read_text()
    assert 3 * len(new.splitlines()) <= len(old.splitlines())
