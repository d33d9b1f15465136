"""Acting on one observation at a time, as a deployed policy does, against Stable-Baselines3.

    python -m benchmarks.acting [--rounds 5] [--steps 2000]

The networks are untrained and all of the same size. A ratio is the median over rounds of a
policy's actions per second, divided by those of Stable-Baselines3's ``predict`` in the same round.
Then two hierarchies with goals, beside the same without.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import skillweave as sw
from benchmarks.common import median, report, table
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm
from skillweave.hierarchy.fitting import ready_policies
from skillweave.hierarchy.roles import roles_of
from skillweave.skills.goal_spaces import with_goal
from skillweave.skills.skill_set import SkillSet
from skillweave.types import Array, HierarchyPolicy

ENV = "CartPole-v1"
NETWORK = sw.Network((64, 64))


class Left(sw.Skill):
    """Ends by itself."""

    def termination(self, step: sw.Step) -> Array:
        ended: Array = step.next_obs[:, 0] < -0.1
        return ended


class Right(sw.Skill):
    """May start only in some places."""

    def initiation(self, obs: Array) -> Array:
        may: Array = obs[:, 0] < 1.0
        return may


class Center(sw.Skill):
    """Lasts as long as calls do."""


class Inner(sw.Skill):
    """A hierarchy of the others."""


POINT = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)


class LeftOf(Left):
    """Has a goal; ends by itself."""

    goal_space = POINT


class RightOf(Right):
    """Has a goal; may start only in some places."""

    goal_space = POINT


class CenterOf(Center):
    """Has a goal; lasts as long as calls do."""

    goal_space = POINT


def network(observations: Any, actions: Any, seed: int) -> AgentPolicy:
    """Return an untrained policy."""
    algorithm = make_algorithm(sw.PPO(network=NETWORK), observations, actions)
    return AgentPolicy.of(algorithm, algorithm.init([Seeds(seed)]))


def policies() -> dict[str, Any]:
    """Return a flat policy, one over three skills, and one over a hierarchy of these."""
    env = gym.make(ENV)
    seen, taken = env.observation_space, env.action_space
    skills = (Left(), Right(), Center())
    act = tuple(network(seen, taken, i) for i in range(3))
    selector = network(seen, gym.spaces.Discrete(3), 3)
    inner = HierarchyPolicy(selector, SkillSet(skills, act, call_steps=20))
    over = SkillSet((Inner(), Center()), (inner, act[2]), call_steps=40)
    nested = HierarchyPolicy(network(seen, gym.spaces.Discrete(2), 4), over)
    return {"flat": act[0], "hierarchy": inner, "nested": nested}


def policies_with_goals(plain: Any) -> dict[str, tuple[Any, Any]]:
    """Return policies with goals, each beside the one without; ``plain`` is one of networks.

    The second pair is of modules from elsewhere: two actions are swapped by a mapping, and the
    inputs are the observation's last two numbers, its first two, and the goal.
    """
    env = gym.make(ENV)
    skills = (LeftOf(), RightOf(), CenterOf())
    seen = with_goal(env.observation_space, POINT)
    act = tuple(network(seen, env.action_space, i) for i in range(3))
    choices = SkillSet(skills, act).choice_space
    selector = network(env.observation_space, choices, 3)
    goals = HierarchyPolicy(selector, SkillSet(skills, act, call_steps=20))
    mapping = {"sees": (2, 3, 0, 1, sw.Goal()), "acts": sw.Acts(to=(1, 0))}
    modules = of_modules((Left(), Right(), Center()), plain.selector, 4, {})
    mapped = of_modules(skills, selector, 6, mapping)
    return {"goals": (goals, plain), "modules, goals and a mapping": (mapped, modules)}


def of_modules(
    skills: Sequence[sw.Skill], selector: Any, inputs: int, mapping: dict[str, Any]
) -> HierarchyPolicy:
    """Return a hierarchy of modules that have this number of inputs."""
    for skill in skills:
        wide, narrow = torch.nn.Linear(inputs, 64), torch.nn.Linear(64, 2)
        layers = wide, torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh(), narrow
        skill.policy = sw.from_torch(torch.nn.Sequential(*layers), **mapping)
    act = ready_policies(roles_of(sw.Hierarchy(ENV, skills)))
    ready = SkillSet(tuple(skills), tuple(act[s.name] for s in skills), call_steps=20)
    return HierarchyPolicy(selector, ready)


def acts_per_second(policy: Any, steps: int) -> float:
    """Play episodes with a player; only acting is timed."""
    env, player, seconds = gym.make(ENV), sw.Player(policy), 0.0
    obs, info = env.reset(seed=0)
    for _ in range(steps):
        before = time.process_time()
        action = player.act(obs, info=info)
        seconds += time.process_time() - before
        obs, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            obs, info = env.reset()
            player.reset()
    return steps / seconds


def stable_baselines3(steps: int) -> float:
    """Do the same with a PPO of Stable-Baselines3."""
    import stable_baselines3 as sb3

    env = gym.make(ENV)
    model = sb3.PPO("MlpPolicy", env, device="cpu", policy_kwargs={"net_arch": [64, 64]})
    obs, _ = env.reset(seed=0)
    seconds = 0.0
    for _ in range(steps):
        before = time.process_time()
        action, _ = model.predict(obs, deterministic=True)
        seconds += time.process_time() - before
        obs, _, terminated, truncated, _ = env.step(int(np.asarray(action)))
        if terminated or truncated:
            obs, _ = env.reset()
    return steps / seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=2_000)
    given = parser.parse_args()
    torch.set_num_threads(1)
    made = policies()
    speeds: dict[str, list[float]] = {name: [] for name in ("Stable-Baselines3", *made)}
    for _ in range(given.rounds):
        speeds["Stable-Baselines3"].append(stable_baselines3(given.steps))
        for name, policy in made.items():
            speeds[name].append(acts_per_second(policy, given.steps))
    pairs = policies_with_goals(made["hierarchy"])
    beside: dict[str, list[float]] = {name: [] for name in pairs}
    for _ in range(given.rounds):
        for name, pair in pairs.items():
            with_goals, without = (acts_per_second(policy, given.steps) for policy in pair)
            beside[name].append(without / with_goals)
    baseline = speeds["Stable-Baselines3"]
    ratios = {
        name: median(a / b for a, b in zip(own, baseline, strict=True))
        for name, own in speeds.items()
    }
    rows = [[name, f"{median(own):,.0f}", f"{ratios[name]:.2f}"] for name, own in speeds.items()]
    print(table(["policy", "actions per second", "ratio"], rows))
    times = {name: median(own) for name, own in beside.items()}
    print(
        table(["with", "time of an action ÷ without"], [[k, f"{v:.2f}"] for k, v in times.items()])
    )
    each = {name: median(own) for name, own in speeds.items()}
    report("acting", {"actions per second": each, "ratio": ratios, "time with goals": times})


if __name__ == "__main__":
    main()
