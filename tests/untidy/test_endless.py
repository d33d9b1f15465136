"""Environments that never say that an episode is over."""

import gymnasium as gym
import numpy as np
import pytest
from timed import Timed

import skillweave as sw
from skillweave.envs import checked
from skillweave.training import evaluation, stage_log

SMALL = sw.PPO(num_envs=2, n_steps=32, batch_size=32, update_epochs=1, network=sw.Network((8,)))


class Endless(Timed):
    length = None


class Limited(Timed):
    length = 50


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    for module in (checked, stage_log):
        monkeypatch.setattr(module, "LONG_EPISODE", 100)


def said(capsys) -> int:
    return capsys.readouterr().err.count("steps without an end")


class Go(sw.Skill):
    max_steps = 8

    def reward(self, step):
        return step.reward


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("learn", ["apart", "together"])
def test_it_is_said_once_in_a_run(learn, workers, capsys):
    spec = sw.EnvSpec(Endless, workers=workers)
    how = {"algorithm": SMALL, "selector": SMALL, "learn": learn}
    sw.Hierarchy(spec, [Go()], steps=400 * (1 + (learn == "apart")), **how).train()
    assert said(capsys) == 1


@pytest.mark.parametrize(
    "spec",
    [
        sw.EnvSpec(Limited, workers=1),
        sw.EnvSpec(Endless, wrappers=(lambda e: gym.wrappers.TimeLimit(e, 300),), workers=1),
    ],
    ids=["its own", "a longer one of a wrapper"],
)
def test_a_limit_of_any_kind_counts(spec, capsys):
    sw.train_agent(spec, SMALL, 1200)
    assert said(capsys) == 0


def test_evaluations_have_a_limit_of_their_own():
    with pytest.warns(UserWarning, match="steps without an end"):  # a quiet run says it so
        run = sw.train_agent(sw.EnvSpec(Endless, workers=1), SMALL, 400, quiet=True)
    found = run.evaluate(3)
    assert (found.lengths, found.cut) == ((100,) * 3, 3)
    assert "3 never ended and were cut after 100 steps (max_steps)" in str(found)
    assert run.evaluate(2, max_steps=130).lengths == (130, 130)


def test_an_evaluation_says_early_and_once_where_episodes_are_cut(monkeypatch):
    monkeypatch.setattr(evaluation, "SEEMS_ENDLESS", 40)
    policy = sw.from_function(lambda obs: np.zeros(len(obs), int))
    at = []
    message = (
        r"Endless: an episode has run 40 steps without an end, and no time limit is known: the "
        r"evaluation cuts episodes after 100 steps\. Give it a smaller number, "
        r"evaluate\(max_steps=1000\)"
    )

    def watch(played):
        at.append(len(told))

    with pytest.warns(UserWarning, match=message) as told:
        sw.evaluate(policy, Endless, episodes=3, num_envs=1, watch=watch)
    assert len(told) == 1
    assert at[:42] == [0] * 40 + [1] * 2  # while it is played


def test_an_evaluation_with_a_limit_or_ends_says_nothing(monkeypatch):
    monkeypatch.setattr(evaluation, "SEEMS_ENDLESS", 50)
    policy = sw.from_function(lambda obs: np.zeros(len(obs), int))
    limited = sw.EnvSpec(Endless, wrappers=(lambda e: gym.wrappers.TimeLimit(e, 80),))
    assert sw.evaluate(policy, Endless, episodes=1, max_steps=80).lengths == (80,)
    assert sw.evaluate(policy, limited, episodes=1).lengths == (80,)
    assert sw.evaluate(policy, Limited, episodes=1).lengths == (50,)
    longer = sw.EnvSpec(Endless, wrappers=(lambda e: gym.wrappers.TimeLimit(e, 300),))
    monkeypatch.undo()
    assert sw.evaluate(policy, longer, episodes=2).lengths == (300, 300)


def test_evaluations_that_take_longer_than_training_are_said_once(capsys, monkeypatch):
    monkeypatch.setattr(stage_log, "SLOW_SECONDS", 0.0)
    spec = sw.EnvSpec(Endless, workers=1)
    sw.train_agent(spec, SMALL, 256, eval_every=64, eval_episodes=20)
    assert capsys.readouterr().err.count("a larger eval_every") == 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*steps without an end")
def test_evaluations_during_training_and_after_it_end():
    """Choosing between greedy and sampling plays no episode longer than those of training."""
    how = {"algorithm": SMALL, "selector": SMALL, "learn": "together"}
    hierarchy = sw.Hierarchy(sw.EnvSpec(Endless, workers=1), [Go()], steps=640, **how)
    run = hierarchy.train(eval_every=320, eval_episodes=2, quiet=True)
    (stage,) = run.info()["stages"]
    assert stage["final"]["eval_return"] == 100.0
    assert stage["evaluation_steps"] <= 3 * 200 + 4 * 20 * 640 // SMALL.num_envs
