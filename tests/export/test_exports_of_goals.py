"""Hierarchies whose skills have goals act the same after export: the runner, and `load_policy`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from goals.worlds import GoTo, Point, Rest, go_to, place_of
from playing import alike, loaded_of, runner_of
from random_networks import agent

import skillweave as sw
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.algorithms.config import SkillCritic
from skillweave.api.player import Player
from skillweave.errors import RunError
from skillweave.export.runner import Runner
from skillweave.export.write import write_export
from skillweave.hierarchy.policy import HierarchyPolicy, with_interruption
from skillweave.skills import ready_selector
from skillweave.skills.goal_spaces import choice_space, with_goal
from skillweave.skills.goals import goals_of
from skillweave.skills.skill_set import SkillSet

pytest.importorskip("onnxscript")
torch.set_num_threads(1)
SMALL = sw.Network(hidden=(8,))
PPO = sw.PPO(network=SMALL, normalize_obs=False)
RECURRENT = sw.PPO(network=sw.Network(hidden=(8,), rnn=sw.algorithms.RNN("gru", 4)))


def mild(config: Any, *spaces: Any, seed: int) -> AgentPolicy:
    """A random network that is seldom at the bounds of its actions."""
    policy = agent(config, *spaces, seed=seed)
    return AgentPolicy(
        policy.algorithm, {k: v * (0.05 if "bias" in k else 0.6) for k, v in policy.weights.items()}
    )


def skills_of(env: Point, *skills: sw.Skill, config: Any = PPO, **how: Any) -> SkillSet:
    """Skills with policies: their own, or random networks."""
    policies = []
    for i, skill in enumerate(skills):
        goals = goals_of(skill)
        seen: Any = env.observation_space
        if goals is not None:
            seen = with_goal(seen, goals.goal_space)
        declared = getattr(skill, "policy", None)
        if declared is None:
            policies.append(mild(config, seen, env.action_space, seed=i))
            continue
        own = declared if hasattr(declared, "bind") else sw.from_function(declared)
        spaces = env.observation_space, env.action_space, f"skill {skill.name!r}"
        policies.append(own.bind(*spaces) if goals is None else own.bind_with_goals(*spaces, goals))
    return SkillSet(skills, tuple(policies), **{"call_steps": 4, **how})


def selected(env: Point, skills: SkillSet, selector: Any, space: Any = None) -> HierarchyPolicy:
    seen = env.observation_space if space is None else space
    names = tuple(skill.name for skill in skills.skills)
    spaces = {s.name: s.goal_space for s in skills.skills if s.goal_space is not None}
    choices = choice_space(skills.choices, spaces, names)
    ready = None if hasattr(selector, "learning_rate") else ready_selector(selector, names)
    if ready is None:
        return HierarchyPolicy(mild(selector, seen, choices, seed=2), skills)
    return HierarchyPolicy(ready.bind(seen, choices, "selector"), skills)


class Reaching(GoTo):
    """Moves goals into reach."""

    def initiation(self, obs):
        return place_of(obs)[:, 0] > -1.5

    def clip_goal(self, obs, goal):
        return np.clip(goal, place_of(obs) - 0.3, place_of(obs) + 0.3).clip(-1, 1)


class Elsewhere(GoTo):
    """A network of the observation and the goal, made elsewhere."""

    torch.manual_seed(0)
    policy = sw.from_torch(torch.nn.Linear(4, 2), sees=(0, sw.Goal(low=-0.5), 1))


def made(*skills: Any, selector: Any = PPO, env: Any = None, **how: Any) -> Any:
    env = env or Point()
    skills = tuple(s if isinstance(s, sw.Skill) else s() for s in skills)
    for skill in skills:
        if isinstance(skill, GoTo) and type(skill).__name__ != "GoTo":
            skill.name = "go_to"
    return env, selected(env, skills_of(env, *skills, **how), selector)


def interrupted() -> Any:
    env = Point()
    skills = skills_of(env, go_to(), Rest(), go_to("number", name="side"), call_steps=9)
    spaces = {s.name: s.goal_space for s in skills.skills if s.goal_space is not None}
    seen = with_goal(env.observation_space, gym.spaces.Dict(list(spaces.items())))
    config = SkillCritic(network=SMALL, normalize_obs=False, deciding=True, sees_goals=True)
    critic = mild(config, seen, gym.spaces.Discrete(3), seed=1)
    return env, selected(env, with_interruption(skills, critic, 0.02), PPO)


CASES: dict[str, Any] = {
    "ppo": lambda: made(go_to(), Rest),
    "recurrent": lambda: made(go_to(), Rest, selector=RECURRENT, config=RECURRENT),
    "squashed": lambda: made(
        go_to("box of float64"), Rest, selector=sw.PPO(network=SMALL, squash_actions=True)
    ),
    "numbers": lambda: made(go_to("numbers"), Rest, go_to("bits", name="bits")),
    "number": lambda: made(go_to("number"), Rest, selector=RECURRENT),
    "dqn": lambda: made(go_to("number"), Rest, selector=sw.DQN(network=SMALL)),
    "elsewhere": lambda: made(Elsewhere, Rest),
    "interrupted": interrupted,
}  # fmt: skip


def numbers_of(goal: Any) -> list[Any]:
    if goal is None:
        return []
    return [np.ravel(goal[k]) for k in goal.dtype.names] if goal.dtype.names else [np.ravel(goal)]


def episodes(env: Point, policy: HierarchyPolicy, runner: Runner, other: Any) -> list[Any]:
    """Whole episodes, in which all three act alike; of each step the skill, goal and action."""
    player, loaded, told = Player(policy), Player(other), []
    for seed in range(3):
        for action in alike(env, player, loaded, runner, seed=seed):
            memory = player.memory
            goal, its = policy.goal_now(memory), policy.goal_now(runner.memory)
            assert (goal is None) == (its is None)
            for mine, theirs in zip(*map(numbers_of, (goal, its)), strict=True):
                np.testing.assert_allclose(theirs, mine, atol=1e-5)
            told.append((int(memory["skill"][0]), str(goal), np.round(action, 3).tolist()))
    return told


@pytest.mark.filterwarnings("ignore:.*Goal.low")  # it clips goals
@pytest.mark.fast_cases(3)
@pytest.mark.parametrize("make", CASES.values(), ids=CASES)
def test_a_hierarchy_with_goals_acts_the_same_elsewhere(make: Any, tmp_path: Path) -> None:
    env, policy = make()
    export = write_export(tmp_path / "a", policy, "point")
    loaded = loaded_of(export)
    told = episodes(env, policy, runner_of(export), loaded)
    assert len({goal for _, goal, _ in told}) > 2  # so that goals are compared
    assert len({str(action) for _, _, action in told}) > 2
    again = write_export(tmp_path / "b", loaded, "point")
    assert episodes(env, policy, runner_of(again), loaded) == told


def test_a_selector_that_samples_draws_goals_too(tmp_path: Path) -> None:
    env, policy = made(go_to(), Rest, greedy_selector=False)
    export = write_export(tmp_path, policy, "point")
    entry = json.loads((tmp_path / "policy.json").read_text())["policy"]["policy"]
    assert entry["selector"]["noise"] == [["gumbel", 2], ["standard_normal", 2]]
    obs, goals = env.reset(seed=0)[0], []
    for seed in range(20):
        runner = runner_of(export, seed=seed)
        runner.act(obs)
        goals.append(str(policy.goal_now(runner.memory)))
    assert len(set(goals)) > 2  # the other skill, and several goals


def test_a_selector_that_samples_chooses_goals_that_do_not_hold(tmp_path: Path) -> None:
    """At 0 the goals 2 and 4 hold, and 3 does not; the selector remembers one decision."""
    policy = made(go_to("number"), selector=RECURRENT, greedy_selector=False)[1]
    runner = runner_of(write_export(tmp_path, policy, "point"), seed=0)
    obs, seen = np.zeros(2, np.float32), []
    for seed in range(8):
        player = Player(policy, seed=seed)
        runner.reset()
        assert len({str(p.act(obs)) for p in (player, runner)}) == 1
        assert player.memory["goal"]["0"][0] == runner.memory["goal"]["0"][0] == 3
        seen += [player.memory["selector"].get("rnn"), runner.memory["selector"].get("rnn")]
    for memory in seen[1:]:
        np.testing.assert_allclose(memory, seen[0], atol=1e-5)


def test_the_range_of_goals_is_in_the_file(tmp_path: Path) -> None:
    _, policy = made(Reaching, Rest)
    export = write_export(tmp_path, policy, "point")
    assert "go_to.clip_goal" in export.code
    file = tmp_path / "policy.json"
    content = json.loads(file.read_text())
    goal = content["policy"]["policy"]["skills"][0]["goals"]
    low, high = ({"array": x, "dtype": "float32"} for x in (-1.0, 1.0))
    assert goal["space"] == {
        "type": "Space", "kind": "Box", "dtype": "float32", "shape": [2], "low": low, "high": high
    }  # fmt: skip
    loaded = loaded_of(export)
    assert loaded.skills.skills[0].goal_space == GoTo.goal_space
    goal["space"]["low"]["array"] = 3.0
    file.write_text(json.dumps(content))
    with pytest.raises(RunError, match=r"policy.skills\[0\].goals.space: .* is no space"):
        loaded_of(export)
