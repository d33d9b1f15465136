"""The numbers by which calls are compared by default."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from call_logs.logs import log_of

from skillweave.calls import CallLog
from skillweave.calls.compared import compared_places
from skillweave.planning import GoalTask, Planner


def walks(to_goal: bool, episodes: int = 60) -> CallLog:
    """Episodes with a goal of their own in column 1: "go" moves on, or towards the goal."""
    rng, made = np.random.default_rng(0), []
    for _ in range(episodes):
        place, goal = float(rng.integers(0, 10)), float(rng.integers(0, 10))
        first, calls = (place, goal), []
        for _ in range(2):
            inside = []
            for _ in range(3):
                place += np.sign(goal - place) if to_goal else 1.0
                inside.append((place, goal))
            calls.append((0, inside, True, "limit"))
        made.append((first, calls))
    return log_of(["go"], made, size=2)


def test_a_goal_that_skills_ignore_does_not_divide_the_log():
    log = walks(to_goal=False)
    assert compared_places(log) == ([0],)
    assert compared_places(walks(to_goal=False, episodes=10)) == (None,), "few calls say nothing"
    moved = log.next_obs.copy()
    moved[log.steps // 2 :, 1] += 1  # one episode's goal moves within a call
    assert compared_places(replace(log, next_obs=moved)) == (None,)


def test_a_goal_to_which_a_skill_goes_counts():
    assert compared_places(walks(to_goal=True)) == (None,)
    assert compared_places(replace(walks(to_goal=True), sees=((0,),))) == ([0],)
    assert compared_places(replace(walks(to_goal=True), sees=((0, 1),))) == ([0, 1],)


def reads_goal(obs):
    return obs[:, 0] == obs[:, 1]


def reads_place(obs):
    return obs[:, 0] == 8


def reads_goal_of_step(step):
    return step.next_obs[:, 0] == step.obs[:, 1]


@pytest.mark.parametrize(
    ("task", "wanted"),
    [
        (reads_place, [0]),
        (reads_goal, [0, 1]),
        (reads_goal_of_step, [0, 1]),
        (GoalTask(lambda obs, goal: obs[:, 0] == goal[..., 0], columns=(1,)), [0]),
    ],
)
def test_a_goal_that_the_task_reads_counts(task, wanted):
    planner = Planner(walks(to_goal=False), task)
    assert planner.compared == {"go": wanted}


@pytest.mark.parametrize("of_info", [False, True])
def test_a_goal_counts_where_the_environment_pays_for_it(of_info):
    """A task that reads the reward reads the goal without its number."""
    log = walks(to_goal=False)
    home = (log.next_obs[:, 0] == log.next_obs[:, 1]).astype(np.float32)
    column = home if of_info else np.zeros_like(home)
    log = replace(log, reward=home - column, info={"home": column, "luck": home[::-1].copy()})

    def pays(step):
        return step.info["home"] if of_info else step.reward

    assert Planner(log, pays).compared == {"go": [0, 1]}
    assert Planner(log, lambda step: step.next_obs[:, 0] == 8).compared == {"go": [0]}
    assert Planner(log, lambda step: step.info["luck"]).compared == {"go": [0]}


def test_parts_of_a_dict():
    """Observations with "observation", "achieved_goal" and "desired_goal"."""
    plain = walks(to_goal=False)
    box = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    names = ("observation", "achieved_goal", "desired_goal")
    space = gym.spaces.Dict(dict.fromkeys(names, box))

    def packed(obs):
        found = np.zeros(len(obs), [(name, np.float32, (1,)) for name in space.spaces])
        found["observation"] = found["achieved_goal"] = obs[:, :1]
        found["desired_goal"] = obs[:, 1:]
        return found

    log = replace(
        plain, observation_space=space, start=packed(plain.start), next_obs=packed(plain.next_obs)
    )
    place = list(space.spaces).index("desired_goal")
    assert compared_places(log) == ([i for i in range(3) if i != place],)
    reads = Planner(log, lambda obs: obs["achieved_goal"][:, 0] == obs["desired_goal"][:, 0])
    assert reads.compared == {"go": [0, 1, 2]}
    planner = Planner(log, lambda obs: obs["achieved_goal"][:, 0] == 8)
    assert planner.compared == {"go": [i for i in range(3) if i != place]}
    # A place is near its own calls, whatever the goal of its episode.
    q = planner.values(packed(np.float32([[5, 0], [5, 9], [12, 0]])))[:, 0]
    assert q[0] == pytest.approx(q[1])
    assert q[0] > 5 * q[2]
