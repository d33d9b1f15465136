"""Ready selectors: a function, an automaton and a behaviour tree choose skills; nothing is trained.

In the end an automaton guides a selector that is trained: it says what may be called in each state.

The task is a corridor: get the key at its left end, open the door at its right end, leave. Skills
may be trained as in any hierarchy; here they are short functions, so the example takes a second.

    python examples/ready_selectors.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import skillweave as sw
from skillweave.types import Array

PLACE, KEY, DOOR = range(3)


class Corridor(gym.Env[Array, np.int64]):
    """Places 0 to 6: the key lies at 0; with it the door at 6 opens; place 7 is outside."""

    observation_space = gym.spaces.Box(0.0, 7.0, (3,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place = int(self.np_random.integers(1, 6))
        self.key = 0
        self.door = 0
        self.steps = 0
        return self._obs(), {}

    def step(self, action: np.int64) -> Any:
        self.steps += 1
        self.place = int(np.clip(self.place + (1 if action else -1), 0, 6 + self.door))
        self.key |= self.place == 0
        self.door |= self.place == 6 and self.key
        outside = self.place == 7
        return self._obs(), float(outside), outside, self.steps == 50, {}

    def _obs(self) -> Array:
        return np.array([self.place, self.key, self.door], np.float32)


class GetKey(sw.Skill):
    """To the left, until the key is there."""

    def policy(self, obs: Array) -> Array:
        return np.zeros(len(obs), np.int64)

    def termination(self, step: sw.Step) -> Array:
        return step.next_obs[:, KEY] == 1


class OpenDoor(sw.Skill):
    """To the right, until the end; it succeeds if the door is open then. It starts with the key."""

    def policy(self, obs: Array) -> Array:
        return np.ones(len(obs), np.int64)

    def initiation(self, obs: Array) -> Array:
        return obs[:, KEY] == 1

    def termination(self, step: sw.Step) -> Array:
        return step.next_obs[:, PLACE] == 6

    def success(self, step: sw.Step) -> Array:
        return step.next_obs[:, DOOR] == 1


class Leave(sw.Skill):
    """A step to the right."""

    max_steps = 1

    def policy(self, obs: Array) -> Array:
        return np.ones(len(obs), np.int64)


# 1. A function of observations (n, 3) to skills (n,), by name or by number. One with a second
#    argument receives the last call, too: its skill, how it ended, and its success.
def rule(obs: Array) -> Array:
    with_key = np.where(obs[:, DOOR] == 1, "leave", "open_door")
    return np.where(obs[:, KEY] == 1, with_key, "get_key")


# 2. An automaton: events are read from every step, or are the success or failure of a call.
def got_key(step: sw.Step) -> Array:
    return step.next_obs[:, KEY] == 1


automaton = sw.Automaton(
    states={"no key": "get_key", "key": "open_door", "open": "leave"},
    transitions={("no key", "key"): got_key, ("key", "open"): "success"},
)


# 3. A behaviour tree: text is a skill, a function of observations is a condition.
def has_key(obs: Array) -> Array:
    return obs[:, KEY] == 1


tree = sw.tree.Sequence(
    sw.tree.Fallback(has_key, "get_key"),
    "open_door",
    "leave",
)


# 4. A guide: what the automaton leaves open, a selector learns.
guide = sw.Automaton(
    states={"no key": {"get_key", "leave"}, "key": {"open_door", "leave"}, "open": "leave"},
    transitions={("no key", "key"): got_key, ("key", "open"): "success"},
)
guided = sw.Hierarchy(
    Corridor,
    [GetKey(), OpenDoor(), Leave()],
    selector=sw.PPO(num_envs=8, n_steps=32),
    guide=sw.Guide(guide),
    apart=sw.Apart(selector_steps=4_000),
)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        for name, selector in {"function": rule, "automaton": automaton, "tree": tree}.items():
            hierarchy = sw.Hierarchy(Corridor, [GetKey(), OpenDoor(), Leave()], selector=selector)
            run = hierarchy.train(Path(folder) / name, quiet=True)  # skills that learn learn here
            score = run.evaluate(50)
            print(f"{name:<10} return {score.mean:.2f}, {np.mean(score.lengths):.1f} steps")
        score = guided.train(Path(folder) / "guided", quiet=True).evaluate(50)
        print(f"guided     return {score.mean:.2f}, {np.mean(score.lengths):.1f} steps")


if __name__ == "__main__":
    main()
