"""Environments whose actions have several parts, or are whole numbers: trained and acted in."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from reach import ON, SMALL, SPACES, Arm, Grip, Reach, Ready, Whole, by_hand, on, reach
from small_runs import goes_on, reports_every
from torch import nn

import skillweave as sw
from skillweave.calls import CallLog
from skillweave.export.runner import Runner
from skillweave.runs.directory import RunDirectory
from skillweave.training.plain_agent import load_agent_of

often = reports_every(40)
RECURRENT = sw.Network((8,), rnn=sw.algorithms.RNN("gru", 6))
IMITATES = sw.algorithms.SelfImitationPPO(num_envs=4, n_steps=16, network=SMALL)
OFTEN = sw.TrainDefaults(checkpoint_every=60)
LEARNS = sw.PPO(num_envs=8, n_steps=64, learning_rate=3e-3, ent_coef=0.0, network=sw.Network((32,)))


def played(policy, kind: str = "dict", steps: int = 10) -> list[Any]:
    """Return the actions of an episode, each of which the environment has checked."""
    env, player = Reach(kind), sw.Player(policy)
    obs, _ = env.reset(seed=0)
    for _ in range(steps):
        obs, *_ = env.step(player.act(obs))
    return env.actions


@pytest.mark.slow
@pytest.mark.parametrize("kind", SPACES)
def test_a_plain_agent_learns(kind, tmp_path):
    run = sw.train_agent(on(kind), LEARNS, 12_000, tmp_path / "run", quiet=True)
    assert run.evaluate(10, quiet=True).mean > 7  # the best: 10; random actions: about 0


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("squash", [False, True])
@pytest.mark.parametrize("kind", SPACES)
def test_a_plain_agent_acts_as_it_is_evaluated(kind, squash, tmp_path):
    algorithm = sw.PPO(num_envs=4, n_steps=16, squash_actions=squash, network=SMALL)
    run = sw.train_agent(on(kind), algorithm, 100, tmp_path / "run", quiet=True)
    stored = load_agent_of(RunDirectory.open(run.path))
    returns = sw.evaluate(stored, on(kind), episodes=3).returns
    assert run.evaluate(3, quiet=True).returns == returns
    assert len(played(run.policy, kind)) == 10


def test_an_export_acts_as_here(tmp_path):
    pytest.importorskip("onnxscript")
    run = sw.train_agent(on("dict"), ON, 64, tmp_path / "run", quiet=True)
    export, env = run.export(tmp_path / "export"), Reach("dict")
    assert export.code == {}
    actors = [run.player(), Runner(export.path), sw.Player(sw.load_policy(export.path))]
    told = set()
    obs, _ = env.reset(seed=0)
    for _ in range(20):
        action, *others = (actor.act(obs) for actor in actors)
        assert env.action_space.contains(action)
        for other in others:
            assert {k: np.round(x, 4).tolist() for k, x in other.items()} == {
                k: np.round(x, 4).tolist() for k, x in action.items()
            }
        told.add(str(action))
        obs, *_ = env.step(action)
    assert len(told) > 5


def declared(name: str) -> sw.Hierarchy:
    how = {
        "together": {"learn": "together"},
        "apart": {"learn": "apart"},
        "held": {"rest": {"arm": ("hold", 0.5), "grip": "hold"}},
        "recurrent": {"algorithm": replace(ON, network=RECURRENT)},
        "self-imitation": {"algorithm": IMITATES},
        "nested": {},
    }[name]
    skills = None
    if name == "nested":
        inner = reach([Arm(), Ready()], name="inner", call_steps=2)
        skills = [inner, Grip(), Whole()]
    return reach(skills, train_defaults=OFTEN, **how)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    "name", ["together", "held", "apart", "recurrent", "self-imitation", "nested"]
)
def test_a_stopped_run_ends_with_the_same_weights(name, tmp_path):
    whole = goes_on(lambda: declared(name), tmp_path)
    returns = whole.evaluate(3).returns
    assert declared(name).load(whole.path).evaluate(3).returns == returns


@pytest.mark.parametrize("kind", ["dict", "tuple"])
def test_a_script_holds_actions_of_several_parts(kind, tmp_path):
    def act(obs):
        return by_hand(obs) if kind == "dict" else tuple(by_hand(obs).values())

    class Slow(sw.Skill):
        policy = sw.from_function(act, every=3)

    def declared() -> sw.Hierarchy:
        return reach([Slow(), Whole()], env=on(kind), call_steps=6, train_defaults=OFTEN)

    goes_on(declared, tmp_path)
    alone = reach([Slow()], env=on(kind), call_steps=6).train(quiet=True)
    grips = [a["grip"] if kind == "dict" else a[1] for a in played(alone.policy, kind)]
    assert grips[:6] == [g for g in grips[:6:3] for _ in range(3)]
    assert set(grips) == {3, 4}


def test_whole_numbers_of_a_policy_from_elsewhere_are_rounded(tmp_path):
    pytest.importorskip("onnxscript")

    class Near(sw.Skill):
        policy = sw.from_torch(nn.Linear(3, 2), acts=sw.Acts(scale=3.0, offset=(0.0, 2.5)))

    run = reach([Near()], env=on("whole")).train(tmp_path / "run", quiet=True)
    actions, env = played(run.policy, "whole"), Reach("whole")
    export = run.export(tmp_path / "export")
    runner, (obs, _) = Runner(tmp_path / "export", export.functions), env.reset(seed=0)
    for action in actions:
        with torch.no_grad():
            output = Near.policy.module(torch.from_numpy(obs)).numpy().astype(np.float64)
        nearest = np.rint(output * 3.0 + [0.0, 2.5]).clip([-1, 0], [1, 5])
        assert (action.reshape(-1) == nearest).all()
        assert (runner.act(obs) == action).all()
        obs, *_ = env.step(action)


def test_a_tuple_is_written_by_its_places():
    class Second(sw.Skill):
        acts = "1"

        def reward(self, step: sw.Step):
            return (step.action["1"] == 4).astype(np.float32)

    class Both(sw.Skill):
        def policy(self, obs):
            return obs[:, :2], np.full(len(obs), 3)

    run = reach([Second(), Both()], env=on("tuple")).train(quiet=True)
    assert all(type(action) is tuple for action in played(run.policy, "tuple"))


def test_calls_are_logged_and_planned_with_their_actions(tmp_path):
    run = reach().train(tmp_path / "run", quiet=True)
    log = run.log_calls(200, num_envs=2)
    assert log.action.dtype.names == ("arm", "grip")
    assert set(np.unique(log.action["grip"])) == {3, 4}
    log.save(tmp_path / "calls.safetensors")
    again = CallLog.load(tmp_path / "calls.safetensors")
    assert (again.action == log.action).all()


@pytest.mark.slow
def test_a_film_and_a_report_play_again(tmp_path):
    run = reach(env=Reach).train(tmp_path / "run", quiet=True)
    run.render(tmp_path / "film.gif")
    assert (tmp_path / "film.gif").stat().st_size > 1000
    run.report(tmp_path / "report.html")
    assert (tmp_path / "report.html").stat().st_size > 10_000
