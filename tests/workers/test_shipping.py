"""What is sent to other processes arrives as it was, whatever it is made of."""

import importlib
import subprocess
import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave import from_onnx, recipes
from skillweave.algorithms.config import _REGISTERED, config_to_json
from skillweave.workers import shipping
from skillweave.workers.shipping import packed, unpacked

SPACES = gym.spaces.Box(-1.0, 1.0, (4,), np.float32), gym.spaces.Discrete(2)

RECIPE = '''
"""Nothing here can be imported elsewhere."""
import gymnasium as gym
from gymnasium.envs.classic_control import CartPoleEnv
from helper_of_recipe import half
from skillweave import Hierarchy, Skill

class Own(CartPoleEnv):
    pass

gym.register("OwnPole-v0", Own, max_episode_steps=20)

class Still(Skill):
    def reward(self, step):
        return half(step.reward)

hierarchy = Hierarchy("OwnPole-v0", [Still()])
'''


def printed_elsewhere(code):
    """The words that ``code`` prints in a new Python."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()


@pytest.fixture
def recipe(tmp_path, monkeypatch):
    (tmp_path / "helper_of_recipe.py").write_text("def half(x):\n    return x / 2\n")
    file = tmp_path / "own_pole.py"
    file.write_text(RECIPE)
    monkeypatch.syspath_prepend(tmp_path)
    yield str(file)
    gym.registry.pop("OwnPole-v0", None)
    for name in ("helper_of_recipe", "skillweave_recipe_own_pole"):
        sys.modules.pop(name, None)


SPAWNS = """
import multiprocessing

class Own:
    answer = 7

def send():
    from skillweave.workers.shipping import packed, unpacked

    for _ in range(2):
        print(unpacked(packed(Own(), "it")).answer)

if __name__ == "__main__":
    child = multiprocessing.get_context("spawn").Process(target=send)
    child.start()
    child.join()
    raise SystemExit(child.exitcode)
"""


def test_a_script_sends_its_own_classes_from_a_process_that_it_spawned(tmp_path):
    (tmp_path / "script.py").write_text(SPAWNS)
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout.split()) == (0, ["7", "7"]), done.stderr


@pytest.mark.slow
def test_a_recipe_arrives_where_neither_it_nor_what_it_imports_is(recipe, tmp_path):
    file = tmp_path / "packed"
    file.write_bytes(packed(recipes.load(recipe), "it"))
    code = (
        "import sys; from types import SimpleNamespace as S\n"
        "from skillweave.workers.shipping import unpacked\n"
        f"own = unpacked(open({str(file)!r}, 'rb').read())\n"
        "print(type(own.spec.make().unwrapped).__name__, own.skills[0].reward(S(reward=3.0)))\n"
    )
    assert printed_elsewhere(code) == ["Own", "1.5"]


@pytest.mark.slow
def test_a_recipe_that_lies_where_packages_are_installed_is_sent_as_well(tmp_path, monkeypatch):
    places = (*shipping._INSTALLED, recipes.source("lunar-lander").parent.resolve())
    monkeypatch.setattr(shipping, "_INSTALLED", places)
    monkeypatch.setattr(shipping, "_is_installed", shipping._is_installed.__wrapped__)
    file = tmp_path / "packed"
    file.write_bytes(packed(recipes.load("lunar-lander"), "it"))
    code = (
        "from skillweave.workers.shipping import unpacked\n"
        f"print(*[s.name for s in unpacked(open({str(file)!r}, 'rb').read()).skills])\n"
    )
    assert printed_elsewhere(code) == ["stabilize", "center", "landing"]


@pytest.mark.parametrize("folder", ["site-packages", "dist-packages"])
def test_packages_of_other_places_are_only_named(folder, tmp_path, monkeypatch):
    (tmp_path / folder).mkdir()
    (tmp_path / folder / "a_package_elsewhere.py").write_text("class Thing: pass\n")
    monkeypatch.syspath_prepend(tmp_path / folder)
    module = importlib.import_module("a_package_elsewhere")
    try:
        data = packed(module.Thing(), "it")
        assert b"a_package_elsewhere" in data
        del sys.modules["a_package_elsewhere"], module
        monkeypatch.undo()
        with pytest.raises(ModuleNotFoundError):
            unpacked(data)
    finally:
        sys.modules.pop("a_package_elsewhere", None)


@pytest.mark.slow
def test_environments_arrive_as_they_are_registered_here_whatever_they_are_called(tmp_path):
    known, kind = gym.registry["CartPole-v1"], "gymnasium.envs.classic_control:CartPoleEnv"
    file = tmp_path / "packed"
    try:
        gym.register("ShortPole-v0", kind, max_episode_steps=7)
        gym.registry["CartPole-v1"] = replace(known, max_episode_steps=20)
        file.write_bytes(packed(None, "it"))
    finally:
        del gym.registry["ShortPole-v0"]
        gym.registry["CartPole-v1"] = known
    code = (
        "import gymnasium as gym\n"
        "from skillweave.workers.shipping import unpacked\n"
        f"unpacked(open({str(file)!r}, 'rb').read())\n"
        "print(*[gym.spec(n).max_episode_steps for n in ('ShortPole-v0', 'CartPole-v1')])\n"
    )
    assert printed_elsewhere(code) == ["7", "20"]


OWN_ALGORITHM = """
from dataclasses import dataclass
import gymnasium as gym
from skillweave import PPO
from skillweave.algorithms import register_algorithm
from skillweave.algorithms.ppo import PPOAlgorithm

@dataclass(frozen=True)
class Mine(PPO):
    pass

class MineAlgorithm(PPOAlgorithm):
    action_spaces = (gym.spaces.Discrete,)

register_algorithm(Mine, MineAlgorithm)
"""


@pytest.mark.slow
def test_an_algorithm_of_the_users_own_is_known_where_it_arrives(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(OWN_ALGORITHM)
    monkeypatch.syspath_prepend(tmp_path)
    mine = importlib.import_module("mine")
    file = tmp_path / "packed"
    file.write_bytes(packed(SPACES, "they"))
    code = (
        "from skillweave.algorithms.config import config_from_json\n"
        "from skillweave.algorithms.registry import make_algorithm\n"
        "from skillweave.workers.shipping import unpacked\n"
        f"spaces = unpacked(open({str(file)!r}, 'rb').read())\n"
        f"config = config_from_json({config_to_json(mine.Mine())!r})\n"
        "print(type(make_algorithm(config, *spaces)).__name__)\n"
    )
    try:
        assert printed_elsewhere(code) == ["MineAlgorithm"]
    finally:
        del _REGISTERED["Mine"], sys.modules["mine"]


def test_an_onnx_file_arrives_as_the_same_policy(tmp_path):
    pytest.importorskip("onnxruntime")
    torch.manual_seed(0)
    path = tmp_path / "net.onnx"
    torch.onnx.export(
        torch.nn.Linear(4, 2), (torch.zeros(1, 4),), str(path), dynamo=False,
        input_names=["x"], dynamic_axes={"x": {0: "batch"}},
    )  # fmt: skip
    policy = from_onnx(path).bind(*SPACES, "skill x")
    obs = np.random.default_rng(0).normal(size=(8, 4)).astype(np.float32)
    arrived = unpacked(packed(policy, "it"))
    np.testing.assert_array_equal(arrived.act({}, obs)[0], policy.act({}, obs)[0])
