"""Logs of calls that training keeps: the calls of its collectors, and no other weights."""

from __future__ import annotations

import numpy as np
import pytest
from small_runs import (
    ON,
    Balance,
    Left,
    Push,
    assert_same,
    interrupted,
)

from skillweave import EnvSpec, Hierarchy, Lengths, Run, Skill, TrainDefaults
from skillweave.calls import CallLog
from skillweave.calls.columns import columns_of
from skillweave.calls.log import LEARNING
from skillweave.errors import DeclarationError, EnvError, RunError
from skillweave.evolution import Evolution
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.policies.core import CallEnd
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.workers import Ray, placement

CARTPOLE = EnvSpec("CartPole-v1", engine="sync", workers=1)


class Nod(Skill):
    """Pushes to the right for three steps; done if the pole then leans to the right."""

    max_steps = 3
    policy = ScriptedPolicy(
        lambda obs: np.ones(len(obs), np.int64), CARTPOLE.spaces.observation, CARTPOLE.spaces.action
    )

    def success(self, step):
        return step.next_obs[:, 2] > 0


def declare(learn="apart", **how) -> Hierarchy:
    given = {
        "env": CARTPOLE,
        "skills": [Left(), Nod(), Push()],
        "algorithm": ON,
        "selector": ON,
        "call_steps": 4,
        "steps": 900,
        "learn": learn,
    }
    return Hierarchy(**given | how)


def assert_whole(log: CallLog, policy, limits: dict[str, int]):
    """Every call is one that the skills make from its start, and follows the one before."""
    assert isinstance(policy, HierarchyPolicy)
    skills = policy.skills
    assert log.skills == tuple(s.name for s in skills.skills)
    step, tau = log.as_steps(), log.tau
    ended = step.terminated | step.truncated
    assert (log.end_reason == CallEnd.EPISODE).sum() == ended.sum() > 0
    for i, skill in enumerate(skills.skills):
        mine = log.skill[log.owner] == i
        if log.checksums[i] != LEARNING:
            actions, _ = skills.policies[i].act(skills.policies[i].start(1), step.obs[mine])
            assert (actions == log.action[mine]).all()
        calls = log.skill == i
        assert calls.any()
        assert tau[calls].max() <= limits[skill.name]
        limited = calls & (log.end_reason == CallEnd.LIMIT)
        if not log.lengths:
            assert (tau[limited] == limits[skill.name]).all()
        won = log.end_reason == CallEnd.OWN
        if skill.defines("success"):
            won = np.asarray(skill.success(step))[log.offset[1:] - 1]
        assert (log.succeeded[calls] == won[calls]).all()
    assert (log.may_follow == skills.hierarchy.may_start(log.end)).all()
    following = log.followed_by
    first = np.flatnonzero(following >= 0)
    assert len(first) > len(log) / 3
    assert (log.start[following[first]] == log.end[first]).all()
    assert (log.age[following[first]] == log.age[first] + tau[first]).all()
    assert (log.age[log.order == 0] == 0).all()
    assert (log.age[log.order > 0] > 0).all()
    over = log.terminated | log.truncated
    assert (following[over] == -1).all()


LIMITS = {"left": 4, "nod": 3, "push": 2}


@pytest.mark.needs("planning")
def test_a_selectors_training_logs_whole_calls_and_learns_the_same(tmp_path):
    without = declare().train(tmp_path / "a", seed=3, quiet=True)
    run = declare().train(tmp_path / "b", seed=3, quiet=True, log_calls=400)
    assert_same(tmp_path / "b", tmp_path / "a")
    log = run.calls
    assert 400 - 4 * 4 <= log.steps <= 400
    assert_whole(log, run.policy, LIMITS)
    assert (log.seed == -1).all()
    with pytest.raises(RunError, match="has no log of calls"):
        _ = without.calls
    # The skills were ready, so these calls are as good as those of log_calls.
    log.check_skills(run.policy.skills)
    assert run.plan(lambda step: step.next_obs[:, 0] > 0).explain()
    more = run.log_calls(100)
    assert run.calls.steps == log.steps + more.steps
    again = Hierarchy.load(declare(), tmp_path / "b")
    assert again.calls.steps == log.steps + more.steps


@pytest.mark.slow
def test_skills_that_learn_meanwhile_are_counted_and_not_planned_with(tmp_path):
    declared = declare("together", train_defaults=TrainDefaults(log_calls=500))
    run = declared.train(tmp_path / "run", seed=3, quiet=True)
    without = declare("together").train(tmp_path / "other", seed=3, quiet=True)
    assert_same(tmp_path / "run", tmp_path / "other")
    assert isinstance(without, Run)
    log = run.calls
    assert log.checksums[0] == LEARNING != log.checksums[1]
    assert_whole(log, run.policy, LIMITS)
    assert log.handover().calls.sum() > 20
    with pytest.raises(RunError, match="'left' has changed since the log was recorded"):
        run.plan(lambda step: step.next_obs[:, 0] > 0)


@pytest.mark.slow
def test_chosen_lengths_interruption_and_keys_of_info(tmp_path):
    import gymnasium as gym

    class Leaning(gym.Wrapper):
        def step(self, action):
            obs, reward, terminated, truncated, info = self.env.step(action)
            return obs, reward, terminated, truncated, info | {"lean": obs[2]}

    env = EnvSpec("CartPole-v1", engine="sync", workers=1, wrappers=(Leaning,))
    declared = declare(env=env, skills=[Nod(), Push(), Balanced()], call_steps=Lengths(1, 3))
    run = declared.train(tmp_path / "a", quiet=True, log_calls=300, log_calls_info=["lean"])
    log = run.calls
    assert log.lengths == (1, 3)
    limited = log.end_reason == CallEnd.LIMIT
    most = np.minimum(np.array([1, 3])[log.choice % 2], np.array([3, 2, 3])[log.skill])
    assert (log.tau[limited] == most[limited]).all()
    assert (log.info["lean"] == log.next_obs[:, 2]).all()
    assert not log.may_follow.all()
    with pytest.raises(EnvError, match=r"info\['height'\] is to be recorded"):
        declared.train(tmp_path / "b", quiet=True, log_calls=300, log_calls_info=["height"])

    from skillweave import Together

    declared = declare(
        "together", skills=[Nod(), Left()], together=Together(interrupt=True, margin=0.0)
    )
    run = declared.train(tmp_path / "c", quiet=True, log_calls=300)
    cut = run.calls.end_reason == CallEnd.INTERRUPTED
    assert 0 < cut.sum() < len(run.calls)


class Balanced(Balance):
    """Stays where it is."""

    max_steps = 3

    def policy(self, obs):
        return (obs[:, 3] > 0).astype(np.int64)


@pytest.mark.slow
def test_a_run_that_continues_keeps_its_settings(tmp_path, capsys):
    declare().train(tmp_path / "run", quiet=True)
    capsys.readouterr()
    declare(steps=1_200).train(tmp_path / "run", resume=True, log_calls=200)
    assert "continues as it began, with no log of calls" in capsys.readouterr().err


def test_a_log_without_a_call_says_so(tmp_path):
    with pytest.warns(UserWarning, match="no whole call was recorded in the latest 1 steps"):
        declare(skills=[Nod(), Nodding()]).train(tmp_path / "run", quiet=True, log_calls=1)


class Nodding(Nod):
    """The same again."""


@pytest.mark.slow
def test_a_resumed_run_ends_with_the_same_weights(tmp_path):
    declare().train(tmp_path / "a", seed=3, quiet=True, checkpoint_every=100)
    with interrupted(4):
        declare().train(tmp_path / "b", seed=3, quiet=True, log_calls=500, checkpoint_every=100)
    run = declare().resume(tmp_path / "b", quiet=True)
    assert_same(tmp_path / "b", tmp_path / "a")
    assert 100 < run.calls.steps <= 500
    assert_whole(run.calls, run.policy, LIMITS)


def assert_equal(a: CallLog, b: CallLog):
    assert columns_of(a).keys() == columns_of(b).keys()
    for name, column in columns_of(a).items():
        assert np.array_equal(column, columns_of(b)[name]), name


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning")
@pytest.mark.filterwarnings("ignore:CartPole-v1. its 2 collectors work in this process")
def test_collectors_elsewhere_log_the_same(tmp_path, monkeypatch):
    """In two processes, in two actors of Ray, and one after the other in this thread."""
    two = declare(env=EnvSpec("CartPole-v1", engine="sync", workers=2))
    there = two.train(tmp_path / "a", seed=3, quiet=True, log_calls=400).calls
    monkeypatch.setattr(placement, "why_no_processes", lambda: "it is a test")
    run = two.train(tmp_path / "b", seed=3, quiet=True, log_calls=400)
    assert_whole(run.calls, run.policy, LIMITS)
    assert_equal(run.calls, there)
    monkeypatch.undo()
    pytest.importorskip("ray")
    on_ray = declare().train(
        tmp_path / "c", seed=3, quiet=True, log_calls=400, cluster=Ray(collectors=2)
    )
    assert_equal(on_ray.calls, there)


@pytest.mark.slow
def test_environments_in_a_pool(tmp_path):
    pytest.importorskip("envpool")
    pool = declare(env=EnvSpec("CartPole-v1", engine="envpool"))
    run = pool.train(tmp_path / "run", seed=3, quiet=True, log_calls=400)
    assert_whole(run.calls, run.policy, LIMITS)
    score = run.evaluate(20, engine="envpool", log_calls=True)
    assert score.calls.steps == sum(score.lengths)
    assert np.unique(score.calls.episode).tolist() == list(range(20))


REFUSED = [
    ({}, {"log_calls": 0}, "log_calls is 0"),
    ({}, {"log_calls": 10**10}, "at most 4 GiB are recorded"),
    ({}, {"log_calls_info": ["lean"]}, "set log_calls, too"),
    ({}, {"log_calls": 50, "log_calls_info": "lean"}, "log_calls_info is 'lean'"),
    ({}, {"log_calls": 50, "flat": True}, "flat trains one plain agent"),
    ({}, {"log_calls": 50, "evolve": Evolution(population=2, generations=2)}, "of a population"),
    (
        {"selector": lambda obs: np.full(len(obs), "left")},
        {"log_calls": 50},
        "no selector acts while this hierarchy trains",
    ),
]


@pytest.mark.parametrize(("declared", "how", "message"), REFUSED)
def test_what_cannot_be_logged_is_refused(declared, how, message, tmp_path):
    with pytest.raises(DeclarationError, match=message):
        declare(**declared).train(tmp_path / "run", quiet=True, **how)
    assert not (tmp_path / "run").exists()
