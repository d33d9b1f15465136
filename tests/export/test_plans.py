"""A plan, exported: the runner acts as the planner does, also where calls fail."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from goals.worlds import Rest, declared, go_to
from ready_selectors.chain import DOOR, PLACE, Corridor, GetKey, Leave, OpenDoor, Wait

from skillweave import EnvSpec, Lengths
from skillweave.api.player import Player
from skillweave.api.policies import load_policy
from skillweave.collecting.skill_set import SkillSet
from skillweave.errors import PolicyError
from skillweave.export.runner import Runner
from skillweave.export.write import write_export
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.planning import (
    CallLog,
    GoalTask,
    Mission,
    Planner,
    RewardMachine,
    held,
    record_calls,
)
from skillweave.skills import Skill
from skillweave.skills.scripted import ScriptedPolicy


def at_four(obs: Any) -> Any:
    return obs[:, PLACE] == 4


def opened(step: Any) -> Any:
    return step.info["door"] == 1


def far(step: Any) -> Any:
    return step.next_obs[:, PLACE] / 10


def near(obs: Any, goal: Any) -> Any:
    return obs[:, PLACE] == goal[0]


TASKS: dict[str, Any] = {
    "legs": Mission(at_four, opened, held(at_four, 3)),
    "reward": RewardMachine({("on", "open"): (opened, 1.0)}, each_step={"open": far}),
    "goal": GoalTask(near, goal=[6.0]),
}


class Noisy(Corridor):
    """A fourth number is chance, so that no two logged calls are equally near."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)

    def _obs(self) -> Any:
        return np.append(super()._obs(), np.float32(self.np_random.normal(0, 0.1)))


NOISY = EnvSpec(Noisy, engine="sync")


def going(action: int) -> ScriptedPolicy:
    return ScriptedPolicy(
        lambda obs: np.full(len(obs), action), Noisy.observation_space, Noisy.action_space
    )


class Go(Skill):
    policy = going(2)


class Back(Skill):
    policy = going(0)


def corridor(lengths: bool) -> SkillSet:
    skills: Any = (Go(), Back()) if lengths else (GetKey(), OpenDoor(), Leave(), Wait())
    policies = tuple(map(going, (2, 0) if lengths else (0, 2, 2, 1)))
    return SkillSet(skills, policies, call_steps=Lengths(1, 2, 4) if lengths else None)


class Walled(Noisy):
    """A wall behind place 3 stands for 14 steps: calls that the log knows fail."""

    def step(self, action: int) -> Any:
        before = self.place
        result = super().step(action)
        if before <= 3 < self.place and self.t < 14:
            self.place = before
            return self._obs(), *result[1:]
        return result


def played(env: Any, actor: Any, seed: int) -> list[int]:
    obs, info = env.reset(seed=seed)
    actor.reset()
    reward, actions, over = None, [], False
    while not over:
        actions.append(int(actor.act(obs, reward=reward, info=info)))
        obs, reward, terminated, truncated, info = env.step(actions[-1])
        over = terminated or truncated
    return actions


@pytest.fixture(scope="module")
def logs() -> dict[bool, CallLog]:
    return {
        lengths: record_calls(NOISY, corridor(lengths), 1_500, num_envs=4, info=("door",))
        for lengths in (False, True)
    }


@pytest.mark.parametrize(("task", "lengths"), [*((t, False) for t in TASKS), ("legs", True)])
def test_the_runner_acts_as_the_planner(
    task: str, lengths: bool, logs: dict[bool, CallLog], tmp_path: Path
) -> None:
    skills = corridor(lengths)
    planner = Planner(logs[lengths], TASKS[task], skills=skills)
    names = tuple(s.name for s in skills.skills)
    choices = gym.spaces.Discrete(skills.choices)
    bound = planner.among(names).bind(NOISY.spaces.observation, choices, "selector")
    policy = HierarchyPolicy(bound, skills)
    export = write_export(tmp_path, policy, "corridor")
    assert "selector.npz" in export.files
    runner, player = Runner(tmp_path, code=export.functions), Player(policy)
    calls_fail = 0
    for seed in range(3):
        for env in (Noisy, Walled):
            acted = played(env(), runner, seed)
            assert acted == played(env(), player, seed)
            calls_fail += acted != played(Noisy(), runner, seed)
    assert calls_fail, "the wall changes what is done"
    with pytest.raises(PolicyError, match="is a plan, which only the runner beside it acts by"):
        load_policy(tmp_path, code=export.functions)


def test_features_and_goals_of_an_export(logs: dict[bool, CallLog], tmp_path: Path) -> None:
    skills = corridor(lengths=False)

    def exported(planner: Planner) -> Any:
        names = tuple(s.name for s in skills.skills)
        bound = planner.among(names).bind(NOISY.spaces.observation, gym.spaces.Discrete(4), "s")
        return write_export(tmp_path, HierarchyPolicy(bound, skills), "corridor")

    columns = GoalTask(near, columns=(DOOR,))
    planner = Planner(logs[False], columns)
    with pytest.raises(PolicyError, match=r"plans again for each goal .* GoalTask"):
        exported(planner)
    planner = Planner(logs[False], at_four, features=lambda obs: np.stack([obs[:, PLACE] ** 2], 1))
    export = exported(planner)
    assert "selector.features.wait" in export.code
    played(Noisy(), Runner(tmp_path, code=export.functions), 1)


def test_a_plan_that_chooses_goals_is_refused(tmp_path: Path) -> None:
    """With many different goals, and with a few, each of which is as another skill."""

    def near_corner(obs: Any) -> Any:
        return (obs > 0.5).all(1)

    for goals in (None, lambda self, obs, rng: np.sign(rng.uniform(-1, 1, (len(obs), 2)))):
        own = {} if goals is None else {"goals": goals}
        walk = go_to(policy=lambda self, obs, goal: np.clip(5 * (goal - obs), -1, 1), **own)
        run = declared([walk, Rest()]).train(tmp_path / f"{goals is None}", quiet=True)
        planned = run.plan(near_corner, run.log_calls(600))
        with pytest.raises(
            PolicyError, match=r"a plan that chooses goals \(go_to\).*with_selector"
        ):
            planned.export(tmp_path / "x")
