"""Corrections that are learnt on ready policies: ``Residual``."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from crane import SMALL, Crane, acted, crane, goes_on_and_loads, greedy
from small_runs import reports_every
from torch import nn

import skillweave as sw

often = reports_every(40)
OFTEN = sw.TrainDefaults(checkpoint_every=60)
SAC = sw.SAC(num_envs=4, batch_size=16, learning_starts=20, buffer_size=500, network=SMALL)


def middle(obs: Any) -> Any:
    """Return the push of arm and hook to the middle."""
    return np.concatenate([-0.5 * obs["arm"], -0.25 * obs["hook"]], axis=1)


class Better(sw.Skill):
    """Does better than ``middle``."""

    policy = sw.Residual(middle, scale=0.5)

    def reward(self, step: sw.Step) -> Any:
        return -np.abs(step.next_obs["arm"]).sum(axis=1)


class Linear(nn.Module):
    """A recurrent module: it adds up what it sees."""

    def forward(self, x: Any, state: Any) -> Any:
        after = 0.5 * state + x
        return -after, after


def counted(obs: Any) -> Any:
    """Return another action in each step: it is held where ``every`` says so."""
    return 0.1 * obs["camera"][:, 0, 0, :1].astype(np.float32) * np.ones((1, 3), np.float32)


def declared(policy: Any, scale: Any = 0.5, **attributes: Any) -> sw.Skill:
    return type("Better", (Better,), {"policy": sw.Residual(policy, scale)} | attributes)()


def bases() -> dict[str, Any]:
    recurrent = sw.from_torch(Linear(), sees={"": None} and ("arm", "hook"), state=(None, 3))
    return {
        "function": middle,
        "scaled function": sw.from_function(middle, acts=sw.Acts(scale=0.5)),
        "every third step": sw.from_function(counted, every=3),
        "recurrent": recurrent,
        "module": sw.from_torch(nn.Linear(3, 3), sees=("arm", "hook")),
    }


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", bases())
@pytest.mark.parametrize("how", ["together", "apart", "SAC"])
def test_a_stopped_run_ends_with_the_same_weights(name, how, tmp_path):
    base = bases()[name]
    settings = {"learn": "together"} if how == "together" else {"learn": "apart"}
    settings |= {"algorithm": SAC} if how == "SAC" else {}

    def hierarchy() -> sw.Hierarchy:
        skills = [declared(copy.deepcopy(base)), type("Other", (sw.Skill,), {})()]
        return crane(skills, train_defaults=OFTEN, **settings)

    goes_on_and_loads(hierarchy, tmp_path)


def test_training_starts_at_the_ready_policy():
    skill = declared(middle, scale=0.2)
    one = sw.PPO(num_envs=4, n_steps=16, batch_size=32, learning_rate=1e-12, network=SMALL)
    run = greedy([skill], steps=64, algorithm=one, selector=one)
    ready = sw.from_function(middle).bind(Crane.observation_space, Crane().action_space, "base")
    assert np.abs(acted(run.player()) - acted(sw.Player(ready))).max() < 0.02


def test_the_skill_alone_acts_as_in_the_hierarchy():
    skill = declared(sw.from_function(counted, every=3))
    run = greedy([skill])
    alone = run._policy("better")
    assert (acted(sw.Player(alone)) == acted(run.player())).all()
    assert run.evaluate(2, skill="better").skills["better"].calls == 2


@pytest.mark.slow
def test_the_ready_policy_of_a_run_is_kept(tmp_path):
    class Module(nn.Linear):
        pass

    skill = declared(sw.from_torch(Module(3, 3), sees=("arm", "hook")))
    run = crane([skill]).train(tmp_path / "run", quiet=True)
    returns = run.evaluate(3).returns
    other = declared(sw.from_torch(Module(3, 3), sees=("arm", "hook")))  # other weights
    file = run.save_weights(tmp_path / "weights.safetensors")
    assert crane([copy.copy(other)]).load(run.path).evaluate(3).returns == returns
    assert crane([copy.copy(other)]).load_weights(file).evaluate(3).returns == returns


def test_another_correction_is_not_loaded(tmp_path):
    run = crane([declared(middle)], steps=130).train(tmp_path / "run", quiet=True)
    for policy, says in ((sw.Residual(middle, 0.25), "0.25"), (None, "None")):
        other = crane([type("Better", (Better,), {"policy": policy})()])
        with pytest.raises(sw.SkillweaveError, match=f"with residual 0.5, but now it is {says}"):
            other.load(run.path)


@pytest.mark.slow
def test_a_hierarchy_is_corrected():
    def turns(obs: Any) -> Any:
        return np.where(obs["camera"][:, 0, 0, 0] // 4 % 2 == 0, "swing", "lift")

    swing = type("Swing", (sw.Skill,), {"acts": (0, 1), "policy": staticmethod(two)})()
    lift = type("Lift", (sw.Skill,), {"acts": 2, "policy": staticmethod(one)})()
    ready = crane([swing, lift], selector=turns, rest="hold").train(quiet=True).policy
    skill = declared(ready, scale=1e-6)
    for learn in ("together", "apart"):
        run = crane([skill], learn=learn).train(quiet=True)
        actions = acted(run.player())
        assert np.allclose(actions, acted(sw.Player(ready)), atol=1e-5)
        assert np.allclose(actions[5], [0.25, 0.25, -0.5], atol=1e-5)


def two(obs: Any) -> Any:
    return np.full((len(obs), 2), 0.25, np.float32)


def one(obs: Any) -> Any:
    return np.full((len(obs), 1), -0.5, np.float32)


def test_an_action_without_bounds_is_corrected_in_its_own_unit():
    class Free(Crane):
        def __init__(self) -> None:
            super().__init__()
            self.action_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)

    world = sw.EnvSpec(Free, engine="sync", workers=1)
    skill = declared(middle, 0.5)
    run = greedy([skill], env=world)
    env, player = Free(), run.player()
    obs, _ = env.reset(seed=0)
    seen = player._seen(obs)
    more, _ = run.policy.skills.policies[0].act({}, seen)
    assert np.allclose(player.act(obs), (middle(seen) + 0.5 * more)[0], atol=1e-6)
