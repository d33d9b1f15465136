"""Acting on one observation at a time: as in evaluations, with the memory that is due."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from random_networks import NESTED, agent, one_by_one
from reference_calls import Counter, Left, Walk

from skillweave import PPO, EnvSpec, Hierarchy, Lengths, Network, Reflex, Skill, from_function
from skillweave.api.player import Player
from skillweave.cli import main
from skillweave.errors import DeclarationError
from skillweave.export.runner import Runner
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.types import Array

torch.set_num_threads(1)


def test_a_run_acts_and_forgets_when_told(tmp_path: Path) -> None:
    class Up(Counter):
        policy = from_function(lambda obs: np.full(len(obs), 2))

    class Down(Left):
        max_steps = 3
        policy = from_function(lambda obs: np.zeros(len(obs), np.int64))

    hierarchy = Hierarchy(
        EnvSpec(Walk, engine="sync"),
        [Down(), Up()],
        selector=lambda obs, last: np.where(last.skill == 0, 1, 0),
        learn="apart",
    )
    run = hierarchy.train(tmp_path / "run", quiet=True)
    obs = np.zeros(4, np.float32)
    assert [run.act(obs) for _ in range(5)] == [0, 0, 0, 2, 2]
    run.reset()
    assert [run.act(obs) for _ in range(4)] == [0, 0, 0, 2]
    other = run.player()  # has a memory of its own
    assert [other.act(obs), run.act(obs)] == [0, 2]


class Up(Counter):
    policy = from_function(lambda obs: np.full(len(obs), 2))


class Down(Left):
    max_steps = 3
    policy = from_function(lambda obs: np.zeros(len(obs), np.int64))


def remote() -> Hierarchy:
    return Hierarchy(
        EnvSpec(Walk, engine="sync"),
        [Down(), Up()],
        selector=lambda obs: ["up"] * len(obs),
        learn="apart",
    )


@pytest.mark.parametrize("exported", [False, True])
def test_the_caller_names_the_skill(tmp_path: Path, exported: bool) -> None:
    run = remote().train(tmp_path / "run", quiet=True)
    obs = np.zeros(4, np.float32)
    player: Any = run.player()
    if exported:
        pytest.importorskip("onnxscript")
        run.export(tmp_path / "out")
        given = {
            "selector": lambda obs: ["up"] * len(obs),
            "down.policy": lambda obs: np.zeros(len(obs), np.int64),
            "up.policy": lambda obs: np.full(len(obs), 2),
            "up.termination": Up().termination,
        }
        player = Runner(tmp_path / "out", code=given)
    assert player.act(obs) == 2
    assert [player.act(obs, skill="down") for _ in range(2)] == [0, 0]
    assert player.memory["elapsed"].tolist() == [1]  # the same name goes on
    assert player.act(obs, skill="down") == 0
    assert player.memory["elapsed"].tolist() == [2]
    assert player.act(obs, skill="down") == 0  # it ended after 3 steps, and is called again
    assert player.memory["elapsed"].tolist() == [0]
    assert player.act(obs) == 0  # without a name, its call goes on until it ends
    assert [player.act(obs, skill="up"), player.act(obs)] == [2, 2]
    player.reset()
    assert player.act(obs, skill="down") == 0
    with pytest.raises(Exception, match="skill is 'dwon'; it must be one of 'down', 'up'"):
        player.act(obs, skill="dwon")
    alone = run.player(skill="up")
    with pytest.raises(DeclarationError, match="no skills to choose from"):
        alone.act(obs, skill="up")


@pytest.mark.parametrize("exported", [False, True])
def test_a_new_command_of_a_named_skill_starts_no_new_call(tmp_path: Path, exported: bool) -> None:
    def steer(obs: Array, goal: Array) -> Array:
        return (goal[:, 0] > 0).astype(np.int64)

    class Steer(Skill):
        policy = from_function(steer)
        goal_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        call_steps = 4

    def choose(obs: Array) -> list[str]:
        return ["down"] * len(obs)

    hierarchy = Hierarchy(
        EnvSpec(Walk, engine="sync", check_seed=False), [Down(), Steer()], selector=choose
    )
    run = hierarchy.train(tmp_path / "run", quiet=True)
    player: Any = run.player()
    if exported:
        pytest.importorskip("onnxscript")
        code = run.export(tmp_path / "out").functions
        player = Runner(tmp_path / "out", code=code)
    obs = np.zeros(4, np.float32)
    assert player.act(obs, skill="steer", goal=[0.5]) == 1
    assert player.act(obs, skill="steer", goal=[-0.5]) == 0
    assert player.memory["elapsed"].tolist() == [1]
    for wrong, says in (
        ({"skill": "steer"}, "has goals"),
        ({"skill": "down", "goal": [0.5]}, "has no goals"),
        ({"goal": [0.5]}, "no skill is named"),
        ({"skill": "steer", "goal": [0.5, 1.0]}, "goal does not fit"),
        ({"skill": "steer", "goal": [3.0]}, "out of goal_space"),
    ):
        with pytest.raises(Exception, match=says):
            player.act(obs, **wrong)


def test_a_named_skill_has_the_longest_length_and_reflexes_act(tmp_path: Path) -> None:
    still = Reflex(lambda obs: obs[:, 0] > 0.5, action=1)
    hierarchy = Hierarchy(
        EnvSpec(Walk, engine="sync", check_seed=False),
        [Down(), Up()],
        selector=PPO(num_envs=2, n_steps=8),
        call_steps=Lengths(2, 5),
        reflexes=[still],
        steps=64,
        learn="apart",
    )
    player = hierarchy.train(tmp_path / "run", quiet=True).player()
    obs = np.zeros(4, np.float32)
    assert player.act(obs, skill="up") == 2
    assert player.memory["length"].tolist() == [5]
    obs[0] = 1.0
    assert player.act(obs, skill="down") == 1
    assert player.memory["skill"].tolist() == [0]


def test_parts_of_an_observation_may_come_in_any_order() -> None:
    policy = agent(PPO(network=Network((8,))), NESTED, gym.spaces.Discrete(4))
    player = Player(policy)
    for obs in one_by_one(NESTED, 5):
        turned = dict(reversed(list(obs.items())))
        assert player.act(obs) == player.act(turned)


@pytest.mark.slow
def test_the_command_exports_and_its_runner_runs_without_the_library(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnxscript")
    run = Hierarchy.pretrained("lunar-lander")
    greedy = replace(run.policy.skills, greedy=True)  # by chance both would differ
    run.policy = HierarchyPolicy(run.policy.selector, greedy)
    weights, out = run.save_weights(tmp_path / "w.safetensors"), tmp_path / "out"
    ask = ["export", str(weights), "--recipe", "lunar-lander", "-o", str(out)]
    assert main(ask) == 1
    assert "--onnx" in capsys.readouterr().err
    assert main([*ask, "--onnx", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["code"] == {"engines off.condition": "observations (n, ...) to (n,) bool"}
    obs = np.random.default_rng(0).normal(size=(30, 8)).astype(np.float32)
    wanted = [int(run.act(x)) for x in obs]
    program = f"""
import sys
sys.modules["skillweave"] = sys.modules["torch"] = None
import numpy as np
from runner import Runner
landed = lambda obs: (obs[:, 6] > 0) | (obs[:, 7] > 0)
runner = Runner(".", code={{"engines off.condition": landed}})
print([int(runner.act(x)) for x in {obs.tolist()}])
"""
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=out, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == wanted
    assert len(set(wanted)) > 1


def test_a_nan_is_an_error_unless_it_is_to_be_a_zero() -> None:
    policy = agent(PPO(network=Network((8,))), NESTED, gym.spaces.Discrete(4))
    for good in one_by_one(NESTED, 20):
        kind, place = good["inner"]
        bad, zero = ({**good, "inner": (kind, np.array([place[0], x]))} for x in (np.nan, 0.0))
        with pytest.raises(
            DeclarationError, match=r"with NaN in obs\['inner'\]\['1'\].*nan=\"zero"
        ):
            Player(policy).act(bad)
        assert Player(policy, nan="zero").act(bad) == Player(policy).act(zero)
    with pytest.raises(DeclarationError, match=r"nan is 'mean'; it must be"):
        Player(policy, nan="mean")  # type: ignore[arg-type]


@pytest.mark.usefixtures("no_trials")
def test_a_player_batches_infos_as_training_does() -> None:
    """A dict within a dict stays one, and lists of unequal lengths are no error."""
    seen: list[object] = []

    class Right(Left):
        policy = from_function(lambda obs: np.full(len(obs), 2))

        def termination(self, step):
            if "game" not in step.info:
                return np.zeros(len(step.obs), bool)
            seen.append(step.info["game"]["score"][0])
            return step.info["game"]["score"] > 1

    rule = {"selector": lambda obs: ["right"] * len(obs)}
    player = Hierarchy(EnvSpec(Walk, engine="sync"), [Right()], **rule).train(quiet=True).player()
    for score in range(3):
        player.act(np.zeros(4, np.float32), info={"game": {"score": score}, "of": [[1, 2], [3]]})
    assert list(dict.fromkeys(seen)) == [1, 2]


@pytest.mark.filterwarnings("error")
def test_actions_are_as_the_environment_takes_them() -> None:
    """Gymnasium warns where an action of a Box without axes is no array."""
    seen = gym.spaces.Box(-1, 1, (3,))
    for space in (gym.spaces.Box(1, 3, (), np.int64), gym.spaces.Box(-1, 1, (), np.float32)):
        action = Player(agent(PPO(network=Network((8,))), seen, space)).act(np.zeros(3))
        assert space.contains(action)
