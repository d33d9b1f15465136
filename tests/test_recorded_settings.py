"""Settings are recorded in a run as JSON: NumPy's numbers are converted, anything else is named."""

import dataclasses
import enum
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from toys import World

import skillweave as sw
from skillweave.algorithms import register_algorithm
from skillweave.errors import DeclarationError

SMALL = sw.PPO(num_envs=2, n_steps=8)


class Arena(World):
    """Is made with anything; pays if it was."""

    def __init__(self, sizes=None):
        super().__init__()
        self.sizes = sizes

    def step(self, action):
        obs, _, *end = super().step(action)
        return obs, float(self.sizes is not None), *end


class Stay(sw.Skill):
    pass


class Colour(enum.Enum):
    RED = 1


def train(path, value, kind):
    spec = sw.EnvSpec(Arena, kwargs={"sizes": value}, workers=1)
    if kind == "agent":
        return sw.train_agent(spec, SMALL, 16, path, quiet=True)
    how = {"algorithm": SMALL, "selector": SMALL, "steps": 16}
    return sw.Hierarchy(spec, [Stay()], **how).train(path, quiet=True)


ODD = {
    "object": object(),
    "array": np.zeros(2),
    "class": Arena,
    "lambda": lambda: 1,
    "path": Path("maps"),
    "set": {1},
    "enum": Colour.RED,
    "bytes": b"a",
    "nan": float("nan"),
    "infinity": np.float32("inf"),
    "key": {1: 2},
    "inside": {"a": [1, (2, object())]},
}


@pytest.mark.parametrize("name", ODD)
def test_what_no_run_can_record_is_named_before_training(tmp_path, name):
    value, kind = ODD[name], "hierarchy" if name in ("object", "nan") else "agent"
    with pytest.raises(DeclarationError) as error:
        train(tmp_path / "run", value, kind)
    place = "kwargs['sizes']['a'][1][1] is" if isinstance(value, dict) and "a" in value else ""
    assert f"Arena: {place or 'kwargs[' + repr('sizes') + '] is'}" in str(error.value)
    assert "pass that as env: def make(): return Arena(sizes=...)" in str(error.value)
    assert not (tmp_path / "run").exists()


def test_the_function_that_is_proposed_trains_and_to_evaluate_anything_may_be_given(tmp_path):
    def make():
        return Arena(sizes={1: object()})

    run = sw.train_agent(make, SMALL, 16, tmp_path / "run", quiet=True)
    assert run.evaluate(1, quiet=True).mean == 5
    spec = sw.EnvSpec(Arena, kwargs={"sizes": object()})
    assert sw.evaluate(run.policy, spec, episodes=1).mean == 5
    registered = sw.EnvSpec("CartPole-v1", kwargs={"max_episode_steps": np.array(7)})
    with pytest.raises(DeclarationError, match=r"return gymnasium.make\('CartPole-v1', max_ep"):
        sw.train_agent(registered, SMALL, 16, tmp_path / "other", quiet=True)


SAME = {
    "whole": (np.int64(3), 3),
    "real": (np.float32(0.1), float(np.float32(0.1))),
    "flag": (np.bool_(True), True),
    "text": (np.str_("a"), "a"),
    "tuple": ((1, 2), [1, 2]),
    "inside": ({"a": (1, np.int32(2))}, {"a": [1, 2]}),
    "none": (None, None),
}


def test_what_json_can_hold_is_recorded_and_is_the_same_environment(tmp_path):
    given = {name: value for name, (value, _) in SAME.items()}
    train(tmp_path / "run", given, "agent")
    manifest = json.loads((tmp_path / "run" / "run.json").read_text())
    assert manifest["env_kwargs"] == {"sizes": {name: kept for name, (_, kept) in SAME.items()}}
    spec = sw.EnvSpec(Arena, kwargs={"sizes": given}, workers=1)
    sw.Agent(spec, SMALL, 16).load(tmp_path / "run")


def test_settings_take_numpys_numbers(tmp_path):
    how = sw.PPO(num_envs=np.int64(2), n_steps=np.int32(8), gamma=np.float32(0.5))

    class Counted(sw.Skill):
        max_steps = np.int64(5)
        steps = np.int64(16)
        task_weight = np.float32(0.5)

    declared = sw.Hierarchy(
        "CartPole-v1", [Counted()], call_steps=np.int64(3), steps=np.int64(32), algorithm=how,
        selector=how, learn="apart", together=sw.Together(task_weight=np.float64(0.5)),
    )  # fmt: skip
    run = declared.train(tmp_path / "run", seed=np.int64(1), quiet=True)
    assert run.info()["stages"][0]["budget"] == 16


@dataclasses.dataclass(frozen=True)
class Own(sw.PPO):
    """Settings of an algorithm of the user's own."""

    table: Any = ()


def test_a_setting_of_an_own_algorithm_is_named(tmp_path):
    from skillweave.algorithms.ppo import PPOAlgorithm

    own = type("OwnAlgorithm", (PPOAlgorithm,), {"action_spaces": (gym.spaces.Discrete,)})
    register_algorithm(Own, own)
    how = Own(num_envs=2, n_steps=8, table=np.zeros(3))
    with pytest.raises(DeclarationError, match=r"Own.table is array\(.*record a name"):
        sw.train_agent("CartPole-v1", how, 16, tmp_path / "run", quiet=True)
    how = dataclasses.replace(how, table=(np.int64(1), 2))
    sw.train_agent("CartPole-v1", how, 16, tmp_path / "run", quiet=True)
