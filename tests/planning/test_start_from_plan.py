"""Selectors that are trained on a task that was planned: by its plan as a start, and as a guide."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from call_logs.logs import log_of
from call_logs.untrained import run_of
from planning.steps import step_to
from ready_selectors.chain import (
    DOOR,
    KEY,
    PLACE,
    SPEC,
    Corridor,
    GetKey,
    InDict,
    Leave,
    OpenDoor,
    Wait,
    always,
    at_four,
    has_key,
    hierarchy,
)
from ready_selectors.watching import watched
from small_runs import lines

import skillweave as sw
from skillweave.api import Run
from skillweave.calls import held
from skillweave.errors import DeclarationError, EnvError, SkillweaveError
from skillweave.networks.config import RNN, Network
from skillweave.planning import GoalTask, Mission, Planner
from skillweave.planning.mission import as_task
from skillweave.planning.task_env import OwnView, Tasked
from skillweave.policies.core import CallEnd
from skillweave.skills import LastCall
from skillweave.skills.foreign_policy import made_up

QUICK = {"num_envs": 4, "n_steps": 32, "batch_size": 32, "update_epochs": 2}


def door_open(obs):
    return obs[:, DOOR] == 1


TASK = Mission(at_four, door_open, held(at_four, 2))


@pytest.fixture(scope="module")
def planned() -> Run:
    run = run_of()
    return run.plan(TASK, run.log_calls(1_500, seed=1))


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Less to imitate, as the tasks are small."""
    monkeypatch.setattr("skillweave.training.imitation.GRADIENT_STEPS", 200)
    monkeypatch.setattr("skillweave.planning.planned_run.PAIRS", 1_000)


def test_a_selector_starts_as_the_plan(planned):
    """Before any training it chooses as the plan does where the plan is played."""
    declared = planned.with_selector(sw.PPO(**QUICK), steps=500)
    start = declared._starts()["selector"]
    assert start.steps == planned.hierarchy.selector.log.steps
    view = OwnView(Corridor.observation_space)
    obs = np.float32([[2, 0, 0], [4, 0, 0], [0, 1, 0], [5, 1, 0], [6, 1, 1]])
    state = np.array([[0, 0], [1, 0], [1, 0], [1, 0], [2, 0]])
    seen = view.joined(obs, TASK.observe(state))
    may = planned.policy.skills.hierarchy.may_start(obs)
    chosen, _ = start.policy.act({}, seen, may)
    q = np.where(may, planned.hierarchy.selector.values(obs, state), -np.inf)
    assert (q[np.arange(len(q)), chosen] >= 0.95 * q.max(1)).all()


def test_only_a_new_run_learns_to_choose_as_the_plan(planned, monkeypatch):
    declared = planned.with_selector(sw.PPO(**QUICK), steps=128)
    run = declared.train(quiet=True)

    def again(*given):
        raise AssertionError("it learnt the plan's choices again")

    monkeypatch.setattr("skillweave.planning.planned_run.imitate", again)
    assert declared.train(run.path, quiet=True, resume=True).policy is not None
    with pytest.raises(AssertionError, match="again"):
        declared.train(quiet=True)


@pytest.mark.slow
def test_it_is_trained_and_loaded(planned):
    declared = planned.with_selector(sw.PPO(**QUICK), steps=400)
    run = declared.train(seed=3, quiet=True, checkpoint_every=128)
    score = run.evaluate(20, quiet=True)
    assert score.success_rate is not None
    assert score.success_rate > 0.9
    assert score.mean == pytest.approx(score.success_rate, abs=0.1), "the reward is the task's"
    loaded = planned.with_selector(sw.PPO(**QUICK), steps=400).load(run.path)
    assert loaded.evaluate(20, quiet=True).returns == score.returns
    assert any("reference_kl" in row for row in lines(run.path)), "the plan guides it"
    more = planned.with_selector(sw.PPO(**QUICK), steps=600)
    assert more.train(run.path, seed=3, quiet=True, resume=True).policy is not None
    free = planned.with_selector(sw.PPO(**QUICK), steps=100, target_kl=None)
    assert free.guide is None


def test_what_cannot_start_from_a_plan_is_refused(planned):
    with pytest.raises(DeclarationError, match="only a selector that learns by PPO can start"):
        planned.with_selector(sw.DQN())
    with pytest.raises(DeclarationError, match="steps is 0"):
        planned.with_selector(steps=0)
    with pytest.raises(DeclarationError, match="target_kl"):
        planned.with_selector(target_kl=-1.0)
    network = Network(rnn=RNN())
    recurrent = planned.with_selector(sw.PPO(network=network), steps=100)
    with pytest.raises(DeclarationError, match="recurrent network cannot start from a plan"):
        recurrent.train(quiet=True)


# Observations with the task's state


class Renamed(InDict):
    observation_space = gym.spaces.Dict({"task": gym.spaces.Box(0, 9, (1,))})


class Keyed(Corridor):
    key_name = "env_reward"

    def step(self, action: int):
        *rest, info = super().step(action)
        return *rest, info | {self.key_name: 1.0}


def test_an_environment_shows_the_state_of_its_task():
    task = Mission(at_four, door_open)
    env = Tasked(task, observe=True)(Corridor())
    obs, _ = env.reset(seed=1)
    assert env.observation_space.contains(obs)
    assert obs["observation"][PLACE] != 4
    assert obs["task"].tolist() == [1, 0, 0]
    while obs["observation"][PLACE] != 4:
        obs, *_ = env.step(2 if obs["observation"][PLACE] < 4 else 0)
    assert obs["task"].tolist() == [0, 1, 0]
    inside = as_task(Mission(lambda obs: obs["door"] == 1))
    env = Tasked(inside, observe=True)(InDict(Corridor()))
    obs, _ = env.reset(seed=4)
    assert set(obs) == {"door", "at", "task"}
    assert env.observation_space.contains(obs)
    view = OwnView(InDict.observation_space)
    joined = view.joined(
        own := made_up(InDict.observation_space, 3), np.eye(3, 2, dtype=np.float32)
    )
    np.testing.assert_array_equal(view.obs(joined), own)


def test_names_that_a_task_would_hide_are_refused():
    with pytest.raises(EnvError, match="have a part 'task', and the task's state"):
        Tasked(TASK, observe=True)(Renamed(Corridor()))
    for key in ("env_reward", "env_success"):
        env = Tasked(TASK)(Keyed())
        env.unwrapped.key_name = key
        env.reset(seed=0)
        with pytest.raises(EnvError, match=f"info has the key '{key}'"):
            env.step(1)


class Watching(GetKey):
    """Its policy, its end and its initiation see three numbers, and the corridor's own reward."""

    max_steps = 5

    def policy(self, obs):
        assert obs.shape[1:] == (3,)
        return np.zeros(len(obs), int)

    def initiation(self, obs):
        assert obs.shape[1:] == (3,)
        return obs[:, KEY] == 0

    def termination(self, step):
        assert step.obs.shape[1:] == step.next_obs.shape[1:] == (3,)
        assert not step.reward.any()
        return step.next_obs[:, KEY] == 1

    def success(self, step):
        assert "env_reward" not in step.info
        return step.next_obs[:, KEY] == 1

    def reward(self, step):
        return step.next_obs[:, KEY]


def test_skills_see_what_they_saw():
    """Also reflexes, and the skills, masks and selectors of a hierarchy that is a skill."""
    asked = []

    def stays(obs):
        asked.append(obs.shape[1:])
        return obs[:, PLACE] == 99

    pair = (OpenDoor(), Leave())
    inner = hierarchy(
        sw.Automaton({"on": ["open_door", "leave"], "off": ["leave"]}, {("on", "off"): "success"}),
        skills=pair,
    )

    class Right(sw.Skill):
        policy = inner
        max_steps = 6

    skills = [Watching(), Right(), Wait()]
    reflexes = [sw.Reflex(stays, 1, "stays")]
    run = run_of(*skills, reflexes=reflexes, selector=lambda obs: ["wait"] * len(obs))
    with pytest.warns(UserWarning, match="these skills have a memory: right"):
        first = run.plan(Mission(has_key, door_open), run.log_calls(1_500, seed=1))
    assert first.evaluate(10, quiet=True).success_rate == 1.0
    trained = first.with_selector(sw.PPO(**QUICK), steps=200).train(quiet=True)
    score = trained.evaluate(10, quiet=True)
    assert score.success_rate is not None
    assert set(asked) == {(3,)}


# As a guide


@pytest.mark.slow
def test_a_planner_guides_a_selector_that_is_trained():
    run = run_of()
    planner = Planner(run.log_calls(1_500, seed=1), TASK, skills=run.policy)
    guided = sw.Hierarchy(
        SPEC,
        run.hierarchy.skills,
        call_steps=None,
        steps=400,
        selector=sw.PPO(**QUICK),
        guide=sw.Guide(planner, restrict=False, target_kl=0.1),
    )
    trained = guided.train(quiet=True, checkpoint_every=128)
    rows = lines(trained.path)
    assert all(np.isfinite(row["reference_kl"]) for row in rows if "reference_kl" in row)
    assert guided.load(trained.path).policy.source() == trained.policy.source()
    restricts = sw.Guide(planner)
    with pytest.raises(DeclarationError, match="has nothing to choose"):
        sw.Hierarchy(SPEC, run.hierarchy.skills, call_steps=None, guide=restricts)


@pytest.mark.slow
def test_a_guide_that_is_a_planner_also_chooses_lengths():
    class Go(sw.Skill):
        policy = always(2)

    class Back(sw.Skill):
        policy = always(0)

    def declared(**how) -> sw.Hierarchy:
        return sw.Hierarchy(SPEC, [Go(), Back()], call_steps=sw.Lengths(1, 2, 4), **how)

    chance = declared(steps=64, selector=sw.PPO(**QUICK)).train(quiet=True)
    log = chance.log_calls(1_500, seed=0)
    assert log.lengths == (1, 2, 4)
    task = Mission(door_open, at_four)
    planner = Planner(log, task, skills=chance.policy)
    planned = chance.plan(task, log)
    assert planned.evaluate(10, quiet=True).success_rate == 1.0
    guided = declared(
        steps=200, selector=sw.PPO(**QUICK), guide=sw.Guide(planner, restrict=False, target_kl=0.1)
    )
    guided.train(quiet=True)
    with pytest.raises(SkillweaveError, match="chooses the lengths 1, 2, 4, so write call_steps"):
        sw.Hierarchy(SPEC, [Go(), Back()], selector=planner)


def test_a_planner_that_guides_remembers_the_calls_that_were_made():
    """Another selector calls "right", and there is a wall: "left" has not failed."""
    calls = [(p, [(1, [p + 1], True, "limit")]) for p in range(9)]
    calls += [(p, [(0, [p - 1], True, "limit")]) for p in range(1, 9)]
    log = log_of(["left", "right"], calls)
    task = Mission(lambda obs: obs[:, 0] == 0)
    planner = Planner(log, task, neighbors=1, gamma=0.9).among(log.skills)
    obs = np.float32([[2]])
    memory = planner.start(1)
    choice, memory = planner.act(memory, obs)
    assert choice.tolist() == [0]
    last = LastCall(np.array([1]), np.full(1, CallEnd.LIMIT, np.int8), np.zeros(1, bool))
    memory = watched(planner, memory, step_to(obs, obs), last)
    assert memory["tried.choice"][0, 0] == 1
    choice, memory = planner.act(memory, obs)
    assert choice.tolist() == [0], "what failed was not the plan's choice"


@pytest.mark.parametrize("steps", [1, 3])
def test_a_planner_that_guides_knows_the_length_that_another_chose_by_its_end(steps):
    calls = [(p, [(2, [p + 1], True, "limit")]) for p in range(9)]
    calls += [(p, [(0, [p - 1], True, "limit")]) for p in range(1, 9)]
    log = log_of(["left", "right"], calls, lengths=(1, 3))
    planner = Planner(log, Mission(lambda obs: obs[:, 0] == 0), neighbors=1, gamma=0.9)
    planner = planner.among(log.skills)
    obs = np.float32([[2]])
    choice, memory = planner.act(planner.start(1), obs)
    assert choice.tolist() == [0]  # left, one step
    for step in range(1, steps + 1):
        why = CallEnd.LIMIT if step == steps else CallEnd.RUNNING
        last = LastCall(np.array([1]), np.full(1, why, np.int8), np.zeros(1, bool))
        memory = watched(planner, memory, step_to(obs, obs), last)
    skill, length = divmod(int(memory["tried.choice"][0, 0]), 2)
    assert (log.skills[skill], log.lengths[length]) == ("right", steps)


@pytest.mark.slow
def test_goals_that_observations_hold_are_learnt():
    """A selector that starts from a plan starts with many goals."""

    class Aim(gym.Wrapper):
        observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)

        def reset(self, *, seed=None, options=None):
            obs, info = self.env.reset(seed=seed)
            self.goal = np.float32(self.env.unwrapped.np_random.integers(0, 7))
            return np.array([obs[PLACE], self.goal]), info

        def step(self, action):
            obs, *rest = self.env.step(action)
            return np.array([obs[PLACE], self.goal]), *rest

    def near(obs, goal):
        return np.abs(obs[:, :1] - goal).max(1) < 0.5

    class Left(sw.Skill):
        max_steps = 1
        policy = staticmethod(lambda obs: np.zeros(len(obs), int))

    class Right(sw.Skill):
        max_steps = 1
        policy = staticmethod(lambda obs: np.full(len(obs), 2))

    spec = sw.EnvSpec(lambda: Aim(Corridor()), engine="sync")
    declared = sw.Hierarchy(
        spec, [Left(), Right()], call_steps=None, selector=lambda obs: ["left"] * len(obs)
    )
    run = declared.train(quiet=True)
    log = run.log_calls(3_000)
    planned = run.plan(GoalTask(near, columns=(1,)), log, features=[0])
    assert planned.evaluate(20, quiet=True).success_rate == 1.0
    start = planned.with_selector(sw.PPO(**QUICK), steps=100)._starts()["selector"]
    view = OwnView(spec.spaces.observation)
    obs = np.float32([[1, 5], [5, 1], [3, 6], [3, 0]])
    seen = view.joined(obs, np.float32([[1, 0]] * 4))
    assert start.policy.act({}, seen, np.ones((4, 2), bool))[0].tolist() == [1, 0, 1, 0]
