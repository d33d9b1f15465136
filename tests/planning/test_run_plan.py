"""A run plans new tasks on the calls of its skills, and is scored by the task."""

from __future__ import annotations

import numpy as np
import pytest
from call_logs.untrained import run_of
from ready_selectors.chain import (
    PLACE,
    SPEC,
    Corridor,
    GetKey,
    InDict,
    Leave,
    Wait,
    always,
    at_four,
)

import skillweave as sw
from skillweave.api import Run
from skillweave.calls import CallLog, held, join
from skillweave.errors import DeclarationError, RunError, SkillweaveError
from skillweave.planning import Explorer, GoalTask, Mission, RewardMachine, reached
from skillweave.planning.mission import as_task
from skillweave.planning.task_env import Tasked, TaskEnv


def door_open(step):
    return step.info["door"] == 1


@pytest.fixture(scope="module")
def run() -> Run:
    return run_of()


@pytest.fixture(scope="module")
def log(run) -> CallLog:
    return run.log_calls(6_000, seed=1, info=("door",))


def test_a_new_task_is_planned_and_scored_by_itself(run, log):
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


def test_explain_may_play_the_plan(run, log):
    planned = run.plan(Mission(at_four, door_open), log)
    expected, found = planned.explain(), planned.explain(episodes=8)
    assert (expected.episodes, found.episodes) == (0, 8)
    assert found.chance == planned.evaluate(8, quiet=True).success_rate
    assert found.interval[0] < found.chance <= found.interval[1] + 1e-9
    assert "of 8 played episodes" in str(found)
    assert planned.explain() == expected
    with pytest.raises(DeclarationError, match="episodes"):
        planned.explain(episodes=-1)


def test_a_mission_that_is_done_already_is_said_before_it_is_played(run, log):
    with pytest.warns(UserWarning, match="'somewhere' holds already in 100% of the logged starts"):
        planned = run.plan("somewhere", log, predicates={"somewhere": lambda obs: obs[:, 0] > -9})
    assert planned.explain().already in str(planned.explain())


def test_a_reward_alone_has_no_success(run, log):
    def far(step):
        return step.next_obs[:, PLACE] / 100

    planned = run.plan(far, log)
    assert repr(planned) == repr(run).replace("<Run", "<PlannedRun of")
    score = planned.evaluate(4, quiet=True)
    assert score.success_rate is None
    assert score.mean > 1.2 * run.plan(at_four, log).evaluate(1, quiet=True).mean


def test_what_cannot_be_planned_is_refused(run, log, tmp_path):
    def at_nine(obs):
        return obs[:, PLACE] == 9

    with pytest.raises(RunError, match="at_nine"):
        run.plan(at_nine, log)
    with pytest.raises(DeclarationError, match="featurs"):
        run.plan(at_four, log, featurs=[0])
    planned = run.plan(at_four, log)
    for written in (
        lambda: planned.evaluate(1, save=True, quiet=True),
        lambda: planned.report(tmp_path / "report.html"),
        lambda: planned.save_weights(tmp_path / "weights.safetensors"),
        lambda: planned.info(),
    ):
        with pytest.raises(RunError, match="this run was planned, so nothing of it is written"):
            written()
    with pytest.raises(DeclarationError, match="has no argument 'skills'"):
        run.plan(at_four, log, skills=run.policy)
    with pytest.raises(DeclarationError, match="'four' is no known predicate; there are: open"):
        run.plan("four", log)
    nothing = {("on", "there"): at_four}
    with pytest.raises(DeclarationError, match="pays nothing"):
        run.plan(RewardMachine(nothing), log)
    assert (
        run.plan(RewardMachine(nothing, accepting={"there"}), log).evaluate(5, quiet=True).mean == 1
    )
    agent = Run(sw.Agent(SPEC, sw.PPO(), 10), tmp_path, run.policy)
    with pytest.raises(DeclarationError, match="no hierarchy"):
        agent.log_calls(10)
    with pytest.raises(DeclarationError, match="plain agent"):
        agent.calls  # noqa: B018


def test_the_environment_of_a_task_by_hand():
    """Each step is judged on the observation before and after; a goal, and parts of a dict."""

    def came_to_six(step):
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

    def there(obs, goal):
        return np.abs(obs[:, :1] - goal).max(1) < 0.5

    env = Tasked(GoalTask(there, goal=[6.0]))(Corridor())
    env.reset(seed=4)
    while not env.step(2)[2]:
        pass
    assert env._state[0, 0] == 1
    assert reached(there, [6.0]).at(np.array([[6.0, 0, 0]])).tolist() == [True]


def test_tasks_and_skills_go_by_the_environments_own_reward_and_success():
    """The score of a planned run is the task's; what is planned and played is not judged by it."""

    class Paying(Corridor):
        def step(self, action: int):
            obs, _, _, cut, info = super().step(action)
            self.door = 1  # there is a way behind the wall
            info["success"] = self.place == 4
            return obs, 10.0 * (self.place == 2), False, cut, info

    class ToPay(Leave):
        max_steps = 9

        def termination(self, step):
            return step.reward > 5

    class Back(ToPay):
        policy = GetKey.policy

    def paid(step):
        return step.reward > 5

    def won(step):
        return step.info["success"]

    rule = lambda obs: ["wait"] * len(obs)  # noqa: E731
    run = run_of(ToPay(), Back(), Wait(), spec=sw.EnvSpec(Paying), selector=rule)
    log = run.log_calls(5_000, info=("success",))
    planned = run.plan(Mission(won, paid, won, paid), log)
    assert planned.evaluate(20, quiet=True).success_rate == 1.0
    reasons = log.call_ends("back").reasons
    again = planned.log_calls(3_000).call_ends("back").reasons
    assert again["own"] / sum(again.values()) == pytest.approx(
        reasons["own"] / sum(reasons.values()), abs=0.1
    )


def test_functions_choose_and_what_cannot_choose_is_refused(run):
    log = run.log_calls(50, choose=lambda obs: ["wait"] * len(obs))
    assert set(log.choice) == {3}
    for choose, says in (
        (Explorer, "'random', 'explore', an Explorer"),
        (always(1), "among 4 skills"),
        (lambda obs: ["nobody"] * len(obs), "nobody"),
    ):
        with pytest.raises(SkillweaveError, match=says):
            run.log_calls(50, choose=choose)
    with pytest.raises(DeclarationError, match=r"info is 'door'; it must be a list"):
        run.log_calls(50, info="door")
    with pytest.raises(DeclarationError, match=r"join\(\[log"):
        join(log)
