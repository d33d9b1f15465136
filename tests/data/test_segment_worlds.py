"""``Hierarchy.segment`` in random worlds: calls as plain Python finds them, one step at a time."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from calls.worlds import OBSERVATIONS, crane, leaves, numbers

import skillweave as sw
from skillweave.policies.core import EPISODE, LIMIT, OWN
from skillweave.types import Array

ACTION = gym.spaces.Box(np.float32([-1, -1, -1]), np.float32([1, 1, 3]))
GOAL = gym.spaces.Box(-1, 1, (1,), np.float32)


def drawn(seed: int) -> tuple[sw.Hierarchy, dict[str, Any], int]:
    """A hierarchy, the functions of its goals, and the shortest length."""
    rng = np.random.default_rng(seed)

    def holds(name: str, obs: Any, share: float, more: Any = 0.0) -> Array:
        found = numbers(f"{seed} {name}", leaves(obs, "obs"), 1)[:, 0] + more
        return (np.abs(found) % 1.0) < share

    def skill(name: str) -> sw.Skill:
        kinds = rng.random(6)
        shares = rng.uniform(0.1, 0.9, 3)
        methods: dict[str, Any] = {}
        if kinds[0] < 0.7:
            methods["initiation"] = lambda self, obs: holds(f"{name} starts", obs, shares[0])
        if kinds[1] < 0.8:

            def termination(self: Any, step: Any) -> Array:
                more: Any = step.elapsed / 3 + step.info["x"] / 7
                more = more if step.goal is None else more + step.goal[:, 0]
                return holds(f"{name} ends", step.next_obs, shares[1] / 2, more) | step.timed_out

            methods["termination"] = termination
        if kinds[2] < 0.6:
            methods["success"] = lambda self, step: holds(
                f"{name} succeeds", step.next_obs, shares[2], step.elapsed / 5
            )
        methods["reward"] = lambda self, step: step.reward
        if kinds[3] < 0.4:
            methods["max_steps"] = int(rng.integers(1, 6))
        if kinds[4] < 0.3:
            methods["call_steps"] = int(rng.integers(1, 6))
        if kinds[5] < 0.25:
            methods["goal_space"] = GOAL
        made: sw.Skill = type(name, (sw.Skill,), methods)()
        return made

    skills = [skill(name) for name in ("a", "b", "c")[: int(rng.integers(1, 4))]]
    ready = sw.from_function(lambda obs: np.zeros((len(obs), 3), np.float32))
    for one in skills:
        if one.goal_space is None:
            one.policy = ready
    goals = {
        one.name: lambda obs: np.clip(obs["hook"], -1, 1)
        for one in skills
        if one.goal_space is not None and rng.random() < 0.8
    }
    endless = any(
        not (one.max_steps or one.call_steps or one.defines("termination")) for one in skills
    )
    limit = None if rng.random() < 0.5 and not endless else int(rng.integers(2, 8))
    made = sw.Hierarchy(
        crane("box", False), skills, call_steps=limit, steps=100, algorithm=sw.SAC(),
        selector=sw.PPO(),
    )  # fmt: skip
    return made, goals, int(rng.integers(1, 3))


def episodes(seed: int) -> sw.Dataset:
    """Episodes of drawn observations; of some the last one is not known."""
    rng = np.random.default_rng([seed, 1])
    found = []
    for _ in range(int(rng.integers(1, 5))):
        steps = int(rng.integers(1, 40))
        end = int(rng.integers(3))
        known = rng.random() < 0.7 or end != 0
        seen = steps + int(known)
        ends = np.zeros(steps, bool)
        ends[-1] = True
        found.append(
            {
                "observations": {
                    "arm": rng.uniform(-2, 2, (seen, 2)).astype(np.float32),
                    "hook": rng.uniform(-2, 2, (seen, 1)).astype(np.float32),
                    "mode": rng.integers(3, size=seen),
                },
                "actions": rng.uniform(-1, 1, (steps, 3)).astype(np.float32),
                "rewards": rng.normal(size=steps),
                "terminations": ends & (end == 0),
                "truncations": ends & (end == 1),
                "infos": {"x": rng.integers(7, size=steps)},
            }
        )
    return sw.Dataset(found, observation_space=OBSERVATIONS, action_space=ACTION)


class Shown:
    """A step of one environment, as a skill sees it in its call."""

    def __init__(self, data: sw.Dataset, t: int, first: int, age: int, skill: Any, goal: Any):
        row = slice(t, t + 1)
        self.obs, self.next_obs, self.action = data.obs[row], data.next_obs[row], data.action[row]
        self.reward = data.reward[row]
        self.terminated, self.truncated = data.terminated[row], data.truncated[row]
        self.elapsed = np.array([t - first + 1])
        late = skill.max_steps is not None and t - first + 1 >= skill.max_steps
        self.timed_out = np.array([late and not data.terminated[t]])
        self.info, self.goal = {"x": data.info["x"][row]}, goal


def plainly(
    made: sw.Hierarchy, data: sw.Dataset, goals: dict[str, Any], shortest: int
) -> list[tuple[int, int, int, int]]:
    """The calls: skill, first step, last step, and why it ended."""
    found = []
    for episode in range(len(data)):
        t, over = int(data.offset[episode]), int(data.offset[episode + 1])
        while t < over:
            best = None
            for i, skill in enumerate(made.skills):
                call = ended(made, data, goals, skill, t, over, bool(data.whole[episode]))
                if call is None or call[0] - t + 1 < shortest:
                    continue
                if best is None or call[0] < best[1]:
                    best = (i, *call)
            if best is None:
                t += 1
                continue
            found.append((best[0], t, best[1], best[2]))
            t = best[1] + 1
    return found


def ended(
    made: Any, data: Any, goals: Any, skill: Any, first: int, over: int, whole: bool
) -> tuple[int, int] | None:
    """The last step of a skill's call that ends with success, and why; None: it does not."""
    goal = None
    if skill.goal_space is not None:
        if skill.name not in goals:
            return None
        goal = goals[skill.name](data.obs[first : first + 1])
    if skill.defines("initiation") and not skill.initiation(data.obs[first : first + 1])[0]:
        return None
    limits = [skill.max_steps, skill.call_steps or made.call_steps]
    most = min(x for x in (*limits, 10**9) if x is not None)
    for t in range(first, over):
        step: Any = Shown(data, t, first, 0, skill, goal)
        known = whole or t < over - 1
        own = skill.defines("termination") and known and bool(skill.termination(step)[0])
        why = OWN if own else EPISODE if t == over - 1 else LIMIT if t - first + 1 >= most else 0
        if not why:
            continue
        good = why == OWN
        if skill.defines("success"):
            good = known and bool(skill.success(step)[0])
        return (t, int(why)) if good else None
    return None


def check(seed: int) -> int:
    made, goals, shortest = drawn(seed)
    data = episodes(seed)
    found = made.segment(data, shortest=shortest, goals=goals)
    wanted = plainly(made, data, goals, shortest)
    log = found.log
    first = [int(np.flatnonzero(found.call == c)[0]) for c in range(len(log))]
    got = [
        (int(log.skill[c]), first[c], first[c] + int(log.tau[c]) - 1, int(log.end_reason[c]))
        for c in range(len(log))
    ]
    assert got == wanted
    for c, (i, begin, last, _) in enumerate(wanted):
        rows = slice(begin, last + 1)
        assert (found.skill[rows] == i).all()
        assert (found.call[rows] == c).all()
        assert log.start[c] == data.obs[begin]
        assert (log.next_obs[log.offset[c] : log.offset[c + 1]] == data.next_obs[rows]).all()
        assert log.age[c] == begin - data.offset[log.episode[c]]
        assert log.terminated[c] == data.terminated[last]
    assert log.succeeded.all()
    claimed = sum(last - begin + 1 for _, begin, last, _ in wanted)
    assert (found.skill >= 0).sum() == claimed
    str(found)
    return len(wanted)


def test_calls_are_those_that_plain_python_finds() -> None:
    assert sum(check(seed) for seed in range(60)) > 150


@pytest.mark.slow
def test_they_are_in_three_hundred_worlds() -> None:
    for seed in range(60, 360):
        check(seed)
