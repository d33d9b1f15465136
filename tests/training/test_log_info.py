"""``train(log_info=...)``: numbers that the environment gives in ``info``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from small_runs import (
    OFF,
    ON,
    Heard,
    assert_same,
    interrupted,
    lines,
    new_run,
    plain_recipe,
    small_manifest,
    stage_entry,
)
from toys import Ledger

from skillweave import (
    Agent,
    Apart,
    EnvSpec,
    Hierarchy,
    Skill,
    SkillweaveError,
    Together,
    TrainDefaults,
)
from skillweave.cli import main
from skillweave.envs.engine import GymnasiumEngine
from skillweave.envs.env_infos import info_numbers
from skillweave.errors import EnvError
from skillweave.evolution import Evolution
from skillweave.hierarchy import training
from skillweave.reporting.curves import read_curves
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import identity, read_manifest
from skillweave.skills.outputs import info_keys

REPLAY = replace(OFF, update_ratio=0.1)


class Told(Ledger):
    """A ledger with more in its info: its steps are ``t``."""

    def step(self, action: int):
        obs, reward, terminated, truncated, info = super().step(action)
        info |= {"late": self.t - 0.5, "flag": self.t > 2, "word": "text", "two": np.zeros(2)}
        info |= {"one": np.array([2.0]), "none": None, "nan": np.nan, "far": np.inf}
        if self.t == 1:
            info["first"] = 1
        if self.t > 2:
            info["seldom"] = self.t
        return obs, reward, terminated, truncated, info


def spec(workers: int = 1) -> EnvSpec:
    return EnvSpec(Told, engine="sync", workers=workers, check_seed=False)  # it counts episodes


class Place(gym.Wrapper[Any, Any, Any, Any]):
    """Episodes that can be played again after a checkpoint."""

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        info = {"place": float(obs[0])} | ({"right": 1} if obs[0] > 0 else {})
        return obs, reward, terminated, truncated, info


def place() -> gym.Env[Any, Any]:
    return Place(gym.make("CartPole-v1"))


class Odd(Skill):
    """Acts for three steps at most."""

    max_steps = 3

    def reward(self, step):
        return step.next_obs[:, 2]


class Even(Odd):
    """Acts for two."""

    max_steps = 2


def hierarchy(learn: str, algorithm=ON, **how) -> Hierarchy:
    return Hierarchy(
        spec(),
        [Odd(), Even()],
        algorithm=algorithm,
        selector=ON,
        call_steps=2,
        learn=learn,
        apart=Apart(skill_steps=320, selector_steps=320),
        together=Together(steps=320),
        **how,
    )


def nested() -> Hierarchy:
    inner = Hierarchy(spec(), [Odd(), Even()], algorithm=ON, selector=ON, call_steps=1)
    return Hierarchy(
        spec(), [inner.as_skill("inner"), Odd()], algorithm=ON, selector=ON, call_steps=2, steps=320
    )


KINDS = {
    "ppo": lambda: Agent(spec(), ON, 320),
    "dqn": lambda: Agent(spec(), REPLAY, 1_100),
    "two processes": lambda: Agent(spec(2), ON, 320),
    "a population": lambda: Agent(spec(), ON, 2_000),
    "together": lambda: hierarchy("together"),
    "together, from replay": lambda: hierarchy("together", REPLAY),
    "selector apart": lambda: hierarchy("apart"),
    "nested": nested,
}


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "a population"])
def test_the_value_at_the_end_of_an_episode_is_logged_as_a_mean(kind, tmp_path):
    keys = ["t", "flag", "late"]
    KINDS[kind]().train(tmp_path / "run", quiet=True, log_info=keys)
    found = [x for x in lines(tmp_path / "run") if x["stage"] in ("agent", "selector", "together")]
    assert found
    for line in found:  # an episode's steps are its length
        assert line["info/t"] == line["length"]
        assert line["info/late"] == line["length"] - 0.5
        assert 0.0 < line["info/flag"] < 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "parts"), [(ON, 2), (REPLAY, 1)], ids=["two parts", "dqn"])
def test_populations_log_them(algorithm, parts, tmp_path):
    agent = Agent(spec(parts), algorithm, 1_200 if parts == 2 else 4_400)
    agent.train(tmp_path / "run", quiet=True, log_info=["t", "lat"], evolve=Evolution(2, 2, 4))
    assert lines(tmp_path / "run")
    for line in lines(tmp_path / "run"):
        assert line["info/t"] == line["length"]
        assert "info/lat" not in line


@pytest.mark.filterwarnings("ignore:.*precision lowered")
def test_pools_log_them(tmp_path):
    pytest.importorskip("envpool")
    agent = Agent(EnvSpec("CartPole-v1", engine="envpool", workers=1), ON, 640)
    agent.train(tmp_path / "run", quiet=True, log_info=["elapsed_step"])
    for line in lines(tmp_path / "run"):
        if "length" in line:
            assert line["info/elapsed_step"] == line["length"]


def test_in_a_skills_own_stage_the_end_of_its_call_counts(tmp_path):
    hierarchy("apart").train(tmp_path / "run", quiet=True, log_info=["t", "seldom"])
    even = [x for x in lines(tmp_path / "run") if x["stage"] == "even"]
    assert {x["info/t"] for x in even} == {2.0}
    assert all("info/seldom" not in x for x in even), "it comes in step 3"


def test_what_is_no_finite_number_is_left_out(tmp_path):
    Agent(spec(), ON, 320).train(
        tmp_path / "run", quiet=True, log_info=["seldom", "none", "nan", "far", "one"]
    )
    for line in lines(tmp_path / "run"):
        assert 3.0 <= line["info/seldom"] <= 4.0, "of the episodes in which it is"
        assert line["info/one"] == 2.0
        assert not {"info/none", "info/nan", "info/far"} & set(line)


def said(declared, path: Path, **how) -> list[str]:
    """Messages of a training."""
    heard = Heard()
    if isinstance(declared, Hierarchy):
        run = new_run(declared, path, how=TrainDefaults(**how))
    else:
        run = RunDirectory.create(path, declared.manifest(3, TrainDefaults(**how)))
    training.train(declared, run, (heard,))
    run.close()
    return [text for text in heard.said if "log_info" in text]


def test_a_key_that_never_occurs_is_said_once_with_those_that_do(tmp_path):
    found = said(hierarchy("apart"), tmp_path / "run", log_info=["lte", "t", "nan"])
    assert len(found) == 2
    keys = "far, flag, late, nested, none, one, seldom, t, two, word"
    assert found[0].startswith("odd: none of ")
    assert found[0].endswith("in info['lte'] (log_info): is 'late' meant?")
    assert found[1].endswith(f"in info['nan'] (log_info); there are: {keys}")
    agent = Agent(EnvSpec("CartPole-v1", engine="sync", workers=1), ON, 320)
    (found,) = said(agent, tmp_path / "empty", log_info=["fuel"])
    assert found.endswith("in info['fuel'] (log_info); it was empty there")


@pytest.mark.parametrize(
    ("key", "what"),
    [
        ("word", "of type str"),
        ("two", r"an array of shape \(2,\)"),
        ("nested", "of type dict"),
    ],
)
@pytest.mark.parametrize("workers", [1, 2])
def test_a_key_that_is_no_number_stops_the_training(workers, key, what, tmp_path):
    with pytest.raises(EnvError, match=rf"info\['{key}'\] is {what} at the end of an ep"):
        Agent(spec(workers), ON, 320).train(tmp_path / "run", quiet=True, log_info=[key])


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    "kind", ["ppo", "dqn", "two processes", "together", "selector apart", "a population"]
)
def test_a_resumed_run_logs_the_same(kind, tmp_path):
    def declare():
        declared = KINDS[kind]()
        declared.env = replace(declared.env, env=place)
        return declared

    how = {"log_info": ("place", "right"), "checkpoint_every": 70}
    how |= {"evolve": Evolution(2, 3, 4)} if kind == "a population" else {}
    declare().train(tmp_path / "whole", quiet=True, **how)
    with interrupted(2):
        declare().train(tmp_path / "run", quiet=True, **how)
    declare().resume(tmp_path / "run", quiet=True)
    assert_same(tmp_path / "run", tmp_path / "whole")
    assert {"info/place", "info/right"} <= set(lines(tmp_path / "run")[-1])


def test_logging_changes_no_weights_and_no_identity(tmp_path):
    runs = [
        Agent(spec(), ON, 320).train(tmp_path / f"{i}", quiet=True, log_info=keys)
        for i, keys in enumerate([(), ("t", "t")])
    ]
    assert runs[0].info()["id"] == runs[1].info()["id"]
    assert [run.info()["log_info"] for run in runs] == [[], ["t"]]
    files = [(run.path / "policies/agent.safetensors").read_bytes() for run in runs]
    assert files[0] == files[1]
    first, second = (lines(run.path) for run in runs)
    assert [{k: v for k, v in x.items() if k != "info/t"} | {"seconds": 0} for x in second] == [
        x | {"seconds": 0} for x in first
    ]


def test_identity_counts_what_is_kept():
    manifest = small_manifest(stage_entry("agent"), log_info=("a",))
    assert identity(manifest) == identity(replace(manifest, log_info=()))
    assert identity(manifest) != identity(replace(manifest, keep="best"))


def test_numbers_of_an_info():
    info = {"x": np.array([1, 2, 3]), "_x": np.array([True, False, True]), "_own": 1}
    assert info_keys(info) == ("x", "_own")
    np.testing.assert_array_equal(info_numbers(info, "x", np.array([2, 1]), 3), [3.0, np.nan])
    assert info_numbers(info, "x", np.array([1]), 3) is None
    assert info_numbers(info, "y", np.array([1]), 3) is None
    # A vector may give one number for all of its environments.
    np.testing.assert_array_equal(info_numbers({"x": 3}, "x", np.array([0, 2]), 3), [3.0, 3.0])
    with pytest.raises(SkillweaveError, match="of type str"):
        info_numbers({"x": "far"}, "x", np.array([0]), 3)


class Mixed(gym.Env[Any, Any]):
    """Its number is whole in some environments and not in others."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    made = 0

    def __init__(self, number: int):
        self.value = (False, 2, 0.5, None)[(number + Mixed.made) % 4]

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {"x": self.value}


def test_numbers_of_several_types_keep_their_values():
    info = GymnasiumEngine(Mixed, 3, "mixed").step(np.zeros(3, np.int64)).info
    np.testing.assert_array_equal(info["x"], [0.0, 2.0, 0.5])
    Mixed.made = 1
    info = GymnasiumEngine(Mixed, 3, "mixed").step(np.zeros(3, np.int64)).info
    assert info["x"].tolist() == [2, 0.5, None]
    np.testing.assert_array_equal(info_numbers(info, "x", np.arange(3), 3), [2, 0.5, np.nan])


def test_the_command_line_logs_and_keeps(tmp_path):
    (tmp_path / "recipe.py").write_text(plain_recipe(320))
    words = ["train", str(tmp_path / "recipe.py"), "--evaluate", "0", "--quiet"]
    often = ["--set", "train.eval_every=100", "--set", "train.eval_episodes=2"]
    first, second = tmp_path / "first", tmp_path / "second"
    best = ["--log-info", "place", "--keep", "best"]
    assert main([*words, "-o", str(first), *best, *often]) == 0
    more = ["--set", "train.keep=best", "--set", "train.log_info=place, other"]
    assert main([*words, "-o", str(second), *often, *more]) == 0
    told = read_manifest(first), read_manifest(second)
    assert [one.log_info for one in told] == [("place",), ("place", "other")]
    assert [one.keep for one in told] == ["best", "best"]
    (stage,) = told[0].stages
    assert stage.best.steps <= stage.steps
    assert main([*words, "-o", str(tmp_path / "third"), "--keep", "best"]) != 0


def test_progress_and_curves_show_them(tmp_path, capsys):
    run = Agent(spec(), ON, 320).train(tmp_path / "run", log_info=["t"])
    assert "info/t 3" in capsys.readouterr().err
    directory = RunDirectory.open(run.path)
    directory.log({"stage": "agent", "steps": 321, "info/one.usage": 0.5})
    directory.close()
    (curves,) = read_curves(directory)
    assert {"info/t", "info/one.usage"} <= set(curves.points)
