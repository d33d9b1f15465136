"""Chains of skills that nothing leads along: who may never start, or is never called, is told."""

from __future__ import annotations

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from declaring import declare
from ready_selectors.chain import DOOR, KEY, SPEC, GetKey, Leave, got_key
from small_runs import ON, Heard, assert_same, messages, new_run, stopped_run

from skillweave import Automaton, SkillweaveError, Together
from skillweave.envs.make import EnvSpec
from skillweave.experience import search
from skillweave.hierarchy import training
from skillweave.skills import Skill
from skillweave.training.stage_log import StageLog


class Beyond(Skill):
    """May start behind the door only."""

    max_steps = 3

    def initiation(self, obs):
        return obs[:, DOOR] == 1


class Unlock(Skill):
    """May start with the key."""

    max_steps = 8

    def initiation(self, obs):
        return obs[:, KEY] == 1


def chain(*skills, **how):
    options = {"env": SPEC, "together_steps": 500, "call_steps": 4} | how
    return declare(*skills, **options)


def test_a_skill_that_nobody_leads_to_is_told_with_who_was_tried(tmp_path, monkeypatch):
    monkeypatch.setattr(search, "PATIENCE", 60)
    hierarchy = chain(GetKey(), Beyond(), Unlock(), learn="apart", skill_steps=600)
    says = (
        r"'beyond': initiation\(\) was never true in 60 steps of calling 'get_key', so .*"
        r"observation was \[.*before it in skills"
    )
    with pytest.raises(SkillweaveError, match=says):
        hierarchy.train(tmp_path / "run", quiet=True)


def test_a_skill_that_found_no_start_in_all_its_steps_is_told_in_the_end(tmp_path):
    hierarchy = chain(GetKey(), Beyond(), Unlock(), learn="apart", skill_steps=300)
    hierarchy.apart = replace(hierarchy.apart, selector_steps=300)
    heard = messages(hierarchy, tmp_path / "run")
    (said,) = [text for text in heard if "learnt nothing" in text]
    assert said.startswith("beyond: it learnt nothing in 3"), said


@pytest.mark.parametrize("calls", [1, 3])
def test_its_second_call_begins_where_its_first_has_left_the_agent(tmp_path, calls):
    class Patient(Skill):
        max_steps = 3

        def reward(self, step):
            return np.where(step.obs[:, 2] >= 3, 1.0, 0.0)

    class Clock(gym.Env):
        observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        action_space = gym.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.t = 0
            return np.zeros(3, np.float32), {}

        def step(self, action):
            self.t += 1
            return np.array([0, 0, self.t], np.float32), 0.0, False, self.t >= 40, {}

    env = EnvSpec(Clock, engine="sync")
    how = {"env": env, "learn": "apart", "episode_calls": calls, "skill_steps": 400}
    run = chain(Patient(), selector=lambda obs: np.zeros(len(obs), int), **how).train(
        tmp_path / "run", quiet=True
    )
    rows = [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]
    best = max(row.get("return", 0.0) for row in rows)
    # Of three calls the second and the third are paid in each of their three steps.
    assert best == 0.0 if calls == 1 else best > 1.5


def never(selector=None):
    automaton = Automaton({"a": "get_key", "b": {"unlock", "leave"}, "c": "beyond"},
                          {("a", "b"): got_key})  # fmt: skip
    return chain(GetKey(), Unlock(), Leave(), Beyond(), selector=selector or automaton)


def test_a_skill_that_was_never_called_is_told_in_the_end_also_after_a_stop(tmp_path):
    again = Heard()
    heard = messages(never(), tmp_path / "whole")
    early = [text for text in heard if "was not called in the first" in text]
    assert early[0].startswith("together: skill 'beyond' was not called in the first 1")
    (said,) = [text for text in heard if "never called" in text]
    assert said.startswith("together: skill 'beyond' was never called in 5")
    run = stopped_run(never(), tmp_path / "run", 4)
    training.train(never(), run, (again,))
    run.close()
    assert [text for text in again.said if "never called" in text] == [said]
    assert_same(run.path, tmp_path / "whole")


def test_a_skill_that_acted_too_seldom_to_learn_is_told(tmp_path):
    often = replace(ON, learning_rate=1e-5)
    few = chain(
        GetKey(), Unlock(), Leave(), selector=often,
        together=Together(quota=1.0, epsilon=0.0, task_weight=0.0),
        together_steps=70,
    )  # fmt: skip
    heard = messages(few, tmp_path / "run")
    assert any("'unlock'" in text and "quota" in text for text in heard), heard


def test_a_run_killed_right_after_its_last_checkpoint_says_what_it_would_have_said(
    tmp_path, monkeypatch
):
    again, run = Heard(), new_run(never(), tmp_path / "run")
    heard = messages(never(), tmp_path / "whole")

    def killed(*told):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(StageLog, "done", killed)
        with pytest.raises(KeyboardInterrupt):
            training.train(never(), run)
    training.train(never(), run, (again,))
    later = [text for text in heard if "was not called in the first" not in text]
    assert again.said == later, "what is said early was said"
    assert_same(run.path, tmp_path / "whole")
    run.close()
