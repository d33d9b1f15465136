"""A run plans new tasks on the calls of its skills, and is scored by the task."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from ready_selectors.chain import (
    DOOR,
    PLACE,
    SPEC,
    Corridor,
    GetKey,
    Leave,
    OpenDoor,
    Wait,
    hierarchy,
)

import skillweave as sw
from skillweave.api import Run
from skillweave.errors import DeclarationError, RunError
from skillweave.planning import CallLog, GoalTask, Mission, held, reached
from skillweave.planning.task import as_task
from skillweave.planning.task_env import Tasked, TaskEnv


def at_four(obs: Any) -> Any:
    return obs[:, PLACE] == 4


def door_open(step: Any) -> Any:
    return step.info["door"] == 1


@pytest.fixture(scope="module")
def run() -> Run:
    """Skills that nothing trained, under a selector that always calls the first."""
    skills = [GetKey(), OpenDoor(), Leave(), Wait()]
    declared = sw.Hierarchy(
        SPEC, skills, call_steps=None, selector=lambda obs: ["get_key"] * len(obs)
    )
    return Run(declared, Path("runs/corridor"), hierarchy(declared.selector))


@pytest.fixture(scope="module")
def log(run: Run) -> CallLog:
    return run.log_calls(6_000, seed=1, info=("door",))


def test_a_new_task_is_planned_and_scored_by_itself(run: Run, log: CallLog) -> None:
    assert run.evaluate(10, quiet=True).mean == 0.0
    planned = run.plan(Mission(at_four, door_open, held(at_four, 2)), log)
    score = planned.evaluate(20, quiet=True)
    assert score.mean == pytest.approx(1.0)
    assert score.success_rate == 1.0
    assert run.hierarchy.spec == SPEC, "the run itself does not change"
    player = planned.player()
    env = planned.declaration.spec.make()
    obs, info = env.reset(seed=3)
    paid, done = 0.0, False
    while not done:
        obs, reward, ended, cut, info = env.step(player.act(obs, info=info))
        paid += reward
        done = ended or cut
    assert (round(paid, 6), info["success"], info["env_reward"]) == (1.0, True, 0.0)


def test_a_text_is_a_task(run: Run, log: CallLog) -> None:
    words = {"four": at_four, "door": door_open}
    planned = run.plan("four then door then four", log, predicates=words)
    assert planned.evaluate(20, quiet=True).success_rate == 1.0


def test_a_reward_alone_has_no_success(run: Run, log: CallLog) -> None:
    def far(step: Any) -> Any:
        return step.next_obs[:, PLACE] / 100

    planned = run.plan(far, log)
    score = planned.evaluate(4, quiet=True)
    assert score.success_rate is None
    assert score.mean > 1.2 * run.plan(at_four, log).evaluate(1, quiet=True).mean


def test_what_cannot_be_planned_is_refused(run: Run, log: CallLog, tmp_path: Path) -> None:
    def at_nine(obs: Any) -> Any:
        return obs[:, PLACE] == 9

    with pytest.raises(RunError, match="at_nine"):
        run.plan(at_nine, log)
    with pytest.raises(DeclarationError, match="featurs"):
        run.plan(at_four, log, featurs=[0])
    planned = run.plan(at_four, log)
    for written in (
        lambda: planned.evaluate(1, save=True, quiet=True),
        lambda: planned.report(tmp_path / "report.html"),
    ):
        with pytest.raises(RunError):
            written()
    agent = Run(sw.Agent(SPEC, sw.PPO(), 10), tmp_path, run.policy)
    with pytest.raises(DeclarationError, match="no hierarchy"):
        agent.log_calls(10)


class InDict(gym.ObservationWrapper):  # type: ignore[type-arg]
    observation_space = gym.spaces.Dict(
        {"door": gym.spaces.Discrete(2), "at": gym.spaces.Box(0, 9, (1,))}
    )

    def observation(self, obs: Any) -> Any:
        return {"at": obs[:1], "door": int(obs[DOOR])}


def test_the_environment_of_a_task_by_hand() -> None:
    """Each step is judged on the observation before and after; a goal, and parts of a dict."""

    def came_to_six(step: Any) -> Any:
        return (step.obs["at"][:, 0] == 5) & (step.next_obs["at"][:, 0] == 6)

    env = Tasked(as_task(Mission(came_to_six)))(InDict(Corridor()))
    assert isinstance(env, TaskEnv)
    for _ in range(2):  # a reset starts the task again
        obs, _ = env.reset(seed=4)
        start = int(obs["at"][0])
        rewards = []
        for _ in range(6 - start):
            obs, reward, over, cut, info = env.step(2)
            rewards.append(reward)
            assert not cut
            assert over == info["success"] == (len(rewards) == 6 - start)
        assert rewards == [0.0] * (5 - start) + [1.0]

    def there(obs: Any, goal: Any) -> Any:
        return np.abs(obs[:, :1] - goal).max(1) < 0.5

    env = Tasked(GoalTask(there, goal=[6.0]))(Corridor())
    env.reset(seed=4)
    while not env.step(2)[2]:
        pass
    assert env._state[0, 0] == 1
    assert reached(there, [6.0]).at(np.array([[6.0, 0, 0]])).tolist() == [True]
