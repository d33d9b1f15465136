"""Behaviour trees: by hand, and against a tree that is walked one environment at a time."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from ready_selectors.watching import watched

from skillweave import tree
from skillweave.errors import SkillError
from skillweave.policies.core import CallEnd
from skillweave.skills import LastCall
from skillweave.skills.selector import TreeSelector, ready_selector

ABC = ("a", "b", "c")


def flag(i: int) -> Any:
    """The condition that the i-th number of the observation is not 0."""
    return tree.Condition(lambda obs: obs[:, i] != 0, f"flag {i}")


def made(root: Any, names: tuple[str, ...] = ABC) -> TreeSelector:
    found = ready_selector(root, names)
    space = gym.spaces.Box(-9, 9, (3,), np.float32)
    return found.bind(space, gym.spaces.Discrete(len(names)), "selector")


def told(policy: Any, memory: Any, succeeded: Any) -> Any:
    """The memory after calls that ended so."""
    why = np.full(len(succeeded), CallEnd.OWN, np.int8)
    called = policy.in_place.skill_of[memory["leaf"]]
    return watched(policy, memory, None, LastCall(called, why, np.array(succeeded)))


def test_a_leaf_whose_skill_was_not_called_is_asked_for_again():
    policy = made(tree.Sequence("a", "b", "c"))
    memory, obs = policy.start(1), np.zeros((1, 3), np.float32)
    names = ""
    for instead in (None, 2, 2, None, None):
        skill, memory = policy.act(memory, obs)
        names += ABC[skill[0]]
        skill = skill if instead is None else np.array([instead])
        memory = watched(
            policy, memory, None, LastCall(skill, np.int8([CallEnd.OWN]), np.array([True]))
        )
    assert names == "abbbc"


def choose(root: Any, obs: Any = (0, 0, 0), mask: Any = (True, True, True)) -> Any:
    """The first choice of a tree."""
    policy = made(root)
    return policy.act(policy.start(1), np.float32([obs]), np.array([mask]))


def test_a_tree_that_ends_without_a_skill_says_where():
    with pytest.raises(SkillError, match=r"tree ended \(FAILURE\).*\[0. 7. 0.\]"):
        choose(tree.Sequence(flag(0), "a"), (0, 7, 0))
    with pytest.raises(SkillError, match=r"tree ended \(SUCCESS\).*Fallback"):
        choose(tree.Fallback(flag(0), "a"), (1, 0, 0))
    with pytest.raises(SkillError, match="without a skill that may start"):
        choose(tree.Sequence("a", "b"), mask=(False, True, True))


def test_a_condition_that_answers_wrongly_is_named():
    def tall(obs: Any) -> Any:
        return obs[0] > 1

    with pytest.raises(SkillError, match=r"selector: tree: tall\(\) returned shape \(3,\)"):
        choose(tree.Sequence(tall, "a"))
    with pytest.raises(SkillError, match=r"high.*yes or no"):
        made(tree.Sequence(tree.Condition(lambda obs: obs[:, 0] + 0.5, "high"), "a")).try_out()


class Plain:
    """A tree as it is defined, walked for one environment."""

    def __init__(self, root: Any) -> None:
        self.root, self.under_way, self.last = root, {}, None

    def choose(self, obs: Any, mask: Any, succeeded: bool) -> int | None:
        for _ in range(2):
            self.came_to: dict[tuple[int, ...], int] = {}
            status, leaf = self.tick(self.root, (), obs, mask, succeeded)
            self.under_way = self.came_to
            if status == "running":
                self.last = leaf
                return ABC.index(self.name_at(leaf))
            self.last = None
        return None

    def name_at(self, path: Any) -> str:
        node = self.root
        for i in path:
            node = node.children[i]
        return node

    def tick(self, node: Any, path: Any, obs: Any, mask: Any, succeeded: bool) -> Any:
        if isinstance(node, str):
            if self.last == path:
                self.last = None
                return ("success" if succeeded else "failure"), None
            return ("running", path) if mask[ABC.index(node)] else ("failure", None)
        if isinstance(node, tree.Condition):
            return ("success" if node.function(obs[None])[0] else "failure"), None
        first = self.under_way.get(path, 0) if node.memory else 0
        goes_on = "success" if isinstance(node, tree.Sequence) else "failure"
        for i in range(first, len(node.children)):
            status, leaf = self.tick(node.children[i], (*path, i), obs, mask, succeeded)
            if status == "running":
                self.came_to[path] = i
            if status != goes_on:
                return status, leaf
        return goes_on, None


def random_tree(rng: Any, depth: int = 0) -> Any:
    kind = tree.Sequence if rng.random() < 0.5 else tree.Fallback
    children = [
        random_tree(rng, depth + 1) if depth < 3 and rng.random() < 0.4
        else flag(int(rng.integers(3))) if rng.random() < 0.3
        else str(rng.choice(ABC))
        for _ in range(rng.integers(1, 4))
    ]  # fmt: skip
    return kind(*children, memory=bool(rng.random() < 0.6))


@pytest.mark.parametrize("seed", range(40))
def test_many_environments_at_once_are_each_as_the_definition_says(seed):
    rng = np.random.default_rng(seed)
    # The last resort lets every tree come to a skill.
    root = tree.Fallback(random_tree(rng), random_tree(rng), "a", memory=bool(seed % 2))
    n, policy = 5, made(root)
    plain, memory = [Plain(root) for _ in range(n)], policy.start(n)
    assert all(v.dtype.kind in "bi" for v in memory.values())
    ended = np.zeros(n, bool)
    for _ in range(30):
        obs = rng.integers(2, size=(n, 3)).astype(np.float32)
        mask = rng.random((n, 3)) < 0.8
        mask[:, 0] = True
        # Only some decide: their calls are over.
        rows = np.flatnonzero(rng.random(n) < 0.7) if memory["leaf"].min() >= 0 else np.arange(n)
        if not len(rows):
            continue
        wanted = [plain[i].choose(obs[i], mask[i], ended[i]) for i in rows]
        own = {k: v[rows] for k, v in memory.items()}
        if None in wanted:  # conditions that hold can bring a tree to its end without a skill
            with pytest.raises(SkillError, match="ended"):
                policy.act(own, obs[rows], mask[rows])
            return
        skill, own = policy.act(own, obs[rows], mask[rows])
        assert skill.tolist() == wanted
        for k, v in own.items():
            memory[k][rows] = v
        ended = rng.random(n) < 0.5
        memory = told(policy, memory, ended)
