"""Policies of users with memories and methods of their own act as they do alone."""

from __future__ import annotations

from inspect import signature
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave.errors import SkillweaveError
from skillweave.hierarchy.policy import HierarchyPolicy, SkillAlone
from skillweave.policies.core import Around, RowPolicy
from skillweave.skills.goal_spaces import with_goal
from skillweave.skills.skill_set import SkillSet
from skillweave.types import Memoryless


class Pays(gym.Env):
    """Five steps; each pays the action."""

    observation_space = gym.spaces.Box(-1, 9, (1,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        return np.full(1, self.t, np.float32), float(action), self.t == 5, False, {}


class Fixed(Memoryless):
    observation_space, action_space = Pays.observation_space, Pays.action_space

    def __init__(self, action: int = 0) -> None:
        self.action = action

    def act(self, memory: Any, obs: Any, mask: Any = None, **how: Any) -> Any:
        return np.full(len(obs), self.action), memory


class Counts(Fixed):
    """Acts by how many steps it has seen; has a method that selectors have, too."""

    fresh: Any = staticmethod(lambda n: np.zeros(n, np.int64))

    def start(self, n: int) -> Any:
        return {"seen": self.fresh(n)}

    def act(self, memory: Any, obs: Any, mask: Any = None, **how: Any) -> Any:
        return np.minimum(memory["seen"].reshape(len(obs), -1)[:, 0], 2).astype(np.int64), memory

    def observe(self, memory: Any, step: sw.Step) -> Any:
        return {"seen": memory["seen"] + 1}

    def watch(self) -> None: ...


class First(sw.Skill):
    """The first of two."""


class Second(sw.Skill):
    """The other one."""


def pair(first: Any, second: Any = None) -> HierarchyPolicy:
    """Two skills, of which the first is called."""
    selector = Fixed()
    selector.action_space = gym.spaces.Discrete(2)
    return HierarchyPolicy(selector, SkillSet((First(), Second()), (first, second or Fixed(1))))


def paid(policy: Any) -> Any:
    returns = sw.evaluate(policy, Pays, episodes=2).returns
    player = sw.Player(policy)
    assert [int(player.act(np.full(1, t, np.float32))) for t in range(5)] == [
        int(a) for a in actions_of(policy)
    ]
    return returns


def actions_of(policy: Any) -> list[int]:
    """By ``skillweave.types.Policy``'s own protocol."""
    memory, found = policy.start(1), []
    for t in range(5):
        obs, no = np.full((1, 1), t, np.float32), np.zeros(1, bool)
        action, memory = policy.act(memory, obs)
        found.append(int(action[0]))
        step = sw.Step(obs, action, obs + 1, np.zeros(1), no, no, no, np.full(1, t + 1), {})
        memory = policy.observe(memory, step)
    return found


class Twice:
    """A wrapper that changes what a hierarchy does."""

    def __init__(self, policy: Any) -> None:
        self.policy = policy

    def __getattr__(self, name: str) -> Any:
        return getattr(self.policy, name)

    def act(self, *given: Any, **how: Any) -> Any:
        action, memory = self.policy.act(*given, **how)
        return 2 * action, memory


class Other(HierarchyPolicy):
    def act(self, *given: Any, **how: Any) -> Any:
        action, memory = super().act(*given, **how)
        return action + 1, memory


def test_wrappers_and_subclasses_of_hierarchies_act_as_they_say() -> None:
    assert paid(Twice(pair(Fixed(1)))) == (10.0, 10.0)
    inside = pair(Fixed(1))
    assert paid(Other(inside.selector, inside.skills)) == (10.0, 10.0)
    assert paid(pair(Twice(pair(Fixed(1))))) == (10.0, 10.0)


OWN = np.zeros(9, np.int64)
STARTS = {
    "zeros": Counts.fresh,
    "stacked": lambda n: np.stack([np.zeros(3) for _ in range(n)]),
    "a view that cannot be written to": lambda n: np.broadcast_to(np.int64(0), (n,)),
    "the policy's own array": lambda n: OWN[:n],
}


@pytest.mark.parametrize("name", STARTS)
def test_whatever_a_memory_begins_with_a_policy_watches(name: str) -> None:
    policy = Counts()
    policy.fresh = STARTS[name]
    for one in (policy, pair(policy), SkillAlone(pair(policy).skills, "first")):
        assert paid(one) == (7.0, 7.0)
        assert paid(one) == (7.0, 7.0), "nothing is left of the episodes before"


@pytest.mark.parametrize(
    ("after", "said"),
    [
        ({"seen": np.full(1, 0.5)}, "'seen' is float64 (1,), but by start() it would be int64"),
        ({"seen": np.zeros((1, 2), np.int64)}, "'seen' is int64 (1, 2)"),
        ({"other": np.zeros(1)}, "has ['other'], but start() gave ['seen']"),
    ],
)
def test_a_memory_that_would_be_cut_is_refused(after: Any, said: str) -> None:
    policy = Counts()
    policy.observe = lambda memory, step: after  # type: ignore[method-assign]
    player = sw.Player(policy)
    player.act(np.zeros(1, np.float32))
    with pytest.raises(SkillweaveError) as error:
        player.act(np.ones(1, np.float32))
    assert said in str(error.value)


def test_a_hierarchy_that_observes_goals_itself_can_be_a_skill_that_has_some() -> None:
    class Aims(sw.Skill):
        goal_space = gym.spaces.Box(0, 2, (1,), np.float32)

        def goals(self, obs: Any, rng: Any) -> Any:
            return np.full((len(obs), 1), 2, np.float32)

    class Follows(Fixed):
        observation_space = with_goal(Pays.observation_space, Aims.goal_space)

        def act(self, memory: Any, obs: Any, mask: Any = None, **how: Any) -> Any:
            return obs["goal"][:, 0].astype(np.int64), memory

    inside = pair(Follows(), Follows())
    inside.observation_space = Follows.observation_space
    alone = SkillAlone(SkillSet((Aims(),), (inside,)), "aims")
    assert sw.evaluate(alone, Pays, episodes=2).returns == (10.0, 10.0)


def test_a_policy_with_labels_says_itself_what_acts_in_it() -> None:
    policy = Counts()
    policy.labels = ("few", "many")
    policy.acting = lambda memory: (memory["seen"] > 2).astype(np.int64)  # type: ignore[method-assign]
    alone = SkillAlone(pair(policy).skills, "first")
    skills = sw.evaluate(alone, Pays, episodes=2).skills
    assert sw.evaluate(policy, Pays, episodes=2).skills["many"].steps == 4
    assert set(skills) == {"first"}


@pytest.mark.parametrize("choice", [-1, 2])
def test_a_choice_that_is_none_is_refused(choice: int) -> None:
    policy = pair(Fixed())
    policy.selector.action = choice  # type: ignore[attr-defined]
    with pytest.raises(SkillweaveError, match="but there are 2 choices, from 0 to 1"):
        sw.evaluate(policy, Pays, episodes=1)


METHODS = [name for name, value in vars(RowPolicy).items() if callable(value)]


@pytest.mark.parametrize("name", METHODS)
def test_a_combinator_forwards_all_that_a_policy_has(name: str) -> None:
    calls = []

    def method(self: RowPolicy, *given: object) -> str:
        calls.append(given)
        return "answer"

    whole = Around(type("Probe", (RowPolicy,), {name: method})())
    assert signature(vars(Around)[name]) == signature(vars(RowPolicy)[name])
    given = tuple(object() for _ in signature(getattr(whole, name)).parameters)
    answer = getattr(whole, name)(*given)
    assert calls == [given]
    assert answer == (None if name in ("observe", "check", "again") else "answer")


class Turns(Memoryless):
    """A user's own selector, which remembers its calls."""

    observation_space, action_space = Pays.observation_space, gym.spaces.Discrete(2)

    def start(self, n: int) -> Any:
        return {"calls": np.zeros(n, np.int64)}

    def act(self, memory: Any, obs: Any, mask: Any = None, **how: Any) -> Any:
        return memory["calls"] % 2, {"calls": memory["calls"] + 1}


def test_a_selector_of_the_users_own_is_a_policy() -> None:
    skills = SkillSet((First(), Second()), (Fixed(0), Fixed(2)), call_steps=1)
    assert sw.evaluate(HierarchyPolicy(Turns(), skills), Pays, episodes=2).returns == (4.0, 4.0)
