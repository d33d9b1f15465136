"""Skills with parts, and corrections, act in an export as they act here."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from crane import GREEDY, ON, Arm, Crane, Hook, crane, greedy
from playing import alike, episode, loaded_of, runner_of
from torch import nn

import skillweave as sw
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.export.write import write_export
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.skills.mapping import Part

pytest.importorskip("onnxscript")


def compare(policy: Any, export: Any) -> None:
    """Let a player, the runner, and the policy that is read back act in two episodes."""
    actors = sw.Player(policy), runner_of(export), sw.Player(loaded_of(export))
    actions = [a for seed in range(2) for a in alike(Crane(), *actors, seed=seed)]
    assert len(np.unique(np.round(actions, 4), axis=0)) > 3


def exported(run: Any, folder: Any) -> None:
    compare(run.policy, run.export(folder))


def in_turn(obs: Any) -> Any:
    return np.array(["arm", "hook"])[obs["camera"][:, 0, 0, 0] // 4 % 2]


def half(hook: Any) -> Any:
    return 0.5 * hook["hook"]


def skills(sees: Any) -> Any:
    return [Arm(), type("Hook", (Hook,), {"sees": sees})()]


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    "sees",
    [
        ("hook", "mode"),
        {"picture": "camera", "numbers": (Part("hook", scale=2.0), "arm")},
        ("arm", half),
        "camera",
    ],
    ids=["numbers", "inputs", "function", "image"],
)
def test_learnt_skills_with_parts(sees, tmp_path):
    run = greedy(skills(sees), selector=in_turn, rest=(0.0, 0.5, "hold"))
    exported(run, tmp_path / "out")


def middle(obs: Any) -> Any:
    return np.concatenate([-0.5 * obs["arm"], -0.25 * obs["hook"]], axis=1)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", ["module", "every", "hierarchy"])
def test_corrections(name, tmp_path):
    torch.manual_seed(0)
    base = {
        "every": lambda: sw.from_function(lambda obs: middle(obs)[:, :2], every=3),
        "module": lambda: sw.from_torch(nn.Linear(3, 2), sees=("arm", "hook")),
        "hierarchy": lambda: greedy().policy,
    }[name]()
    whole = name == "hierarchy"
    how = {"policy": sw.Residual(base, 0.5), "acts": None if whole else (0, 2)}
    skill = type("Better", (sw.Skill,), how)()
    exported(greedy([skill], rest="zero" if whole else (0.0, 0.25, 0.0)), tmp_path / "out")


ARM: Any = gym.spaces.Box(-1, 1, (2,), np.float32)
AIM: Any = gym.spaces.Dict({"at": ARM, "high": gym.spaces.Discrete(2)})


class Reach(Arm):
    """Brings the arm to its goal."""

    goal_space = ARM

    def reward(self, step):
        return -np.abs(step.next_obs["arm"] - aim_of(step.goal)).sum(axis=1)

    def termination(self, step):
        return np.abs(step.next_obs["arm"] - aim_of(step.goal)).max(axis=1) < 0.1


def aim_of(goal: Any) -> Any:
    return goal["at"] if goal.dtype.fields else goal


def to_the_goal(obs: Any, goal: Any) -> Any:
    arm = obs["arm"] if obs.dtype.fields else obs
    return np.clip(3 * (aim_of(goal) - arm), -1, 1)


def there_and_up(obs: Any, *, skill: str = "reach") -> Any:
    """A selector: a goal that depends on the observation, now and then the hook."""
    names = np.where(obs["camera"][:, 0, 0, 0] // 4 % 3 < 2, skill, "hook")
    return names, {skill: np.tanh(obs["hook"] + obs["arm"][:, ::-1])}


def in_parts(obs: Any) -> Any:
    names, goals = there_and_up(obs)
    high = (obs["hook"][:, 0] > 0).astype(int)
    return names, {"reach": {"at": goals["reach"].astype(np.float32), "high": high}}


def reach(**attributes: Any) -> sw.Skill:
    return type("Reach", (Reach,), attributes)()


def linear(inputs: int, outputs: int) -> Any:
    torch.manual_seed(0)
    return nn.Linear(inputs, outputs)


def trained() -> Any:
    """The policy of a skill with a goal that was trained before: it sees both as one."""
    return greedy([reach(), Hook()]).policy.skills.policies[0]


def far(selector: Any, rest: Any) -> sw.Skill:
    """A hierarchy with a goal, of a skill with a goal and a part."""
    how = {"selector": selector, "rest": rest, "call_steps": 2, "selection": GREEDY}
    inner = crane([reach(), Hook()], name="inner", **how)
    return reach(name="far", policy=inner, sees=None, acts=None, max_steps=5)


TWO = {"picture": "camera", "arm": "arm"}
OF_TWO = sw.from_torch(linear(4, 2), sees=(0, sw.Goal(), 1))
FIXED = (0.0, 0.5, "hold")
RULE, LEARNT = there_and_up, ON
WITH_GOALS: dict[str, Any] = {
    "learnt": (LEARNT, "hold", lambda: reach()),
    "corrected": (LEARNT, FIXED, lambda: reach(policy=sw.Residual(to_the_goal, 0.5))),
    "nested": (LEARNT, "hold", lambda: far(ON, "hold")),
    "two inputs": (RULE, FIXED, lambda: reach(sees=TWO, goal_space=AIM)),
    "parts": (LEARNT, FIXED, lambda: reach(policy=sw.Residual(to_the_goal, 0.5), goal_space=AIM)),
    "a module": (LEARNT, "hold", lambda: reach(policy=sw.Residual(OF_TWO, 0.5))),
    "a network": (RULE, "hold", lambda: reach(policy=sw.Residual(trained(), 0.5))),
}


def louder(policy: Any) -> Any:
    """The policy with larger outputs: those of a network that has hardly learnt are about zero."""
    if isinstance(policy, AgentPolicy):
        last = "actor.1.weight"
        return AgentPolicy(policy.algorithm, policy.weights | {last: 150 * policy.weights[last]})
    if not isinstance(policy, HierarchyPolicy):
        return policy
    below = replace(policy.skills, policies=tuple(map(louder, policy.skills.policies)))
    return HierarchyPolicy(louder(policy.selector), below, None, policy.goals)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("case", WITH_GOALS)
def test_skills_with_goals_and_parts(case: str, tmp_path: Any) -> None:
    selector, rest, make = WITH_GOALS[case]
    skill = make()
    if selector is RULE:
        selector = in_parts if skill.goal_space is AIM else partial(there_and_up, skill=skill.name)
    policy = louder(greedy([skill, Hook()], selector=selector, rest=rest).policy)
    export = write_export(tmp_path / "out", policy, "crane")
    compare(policy, export)
    runner = runner_of(export)
    goals = {str(policy.goal_now(runner.memory)) for _ in episode(Crane(), runner, seed=3)}
    assert len(goals) > 2


@pytest.mark.needs("planning")
def test_a_plan_of_skills_with_goals_and_parts(tmp_path: Any) -> None:
    """Skill, goal and action are the policy's, where observations are a Dict."""
    skill = reach(policy=sw.Residual(to_the_goal, 0.5))
    run = greedy([skill, Hook()], rest=FIXED)
    log = run.log_calls(1_000, num_envs=4)
    planned = run.plan(lambda obs: (obs["arm"] > 0.3).all(1), log, features=[0, 1, 2])
    export = planned.export(tmp_path / "out")
    assert "observations (n, ...) to features (n, F)" in export.code.values()
    runner, player, goals = runner_of(export), planned.player(), set()
    for seed in range(3):
        for _ in alike(Crane(), player, runner, seed=seed):
            goals.add(str(planned.policy.goal_now(runner.memory)))
    assert len(goals) > 5
