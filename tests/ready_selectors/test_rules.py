"""Rules of ``policies.selectors`` as plain data, which may be from a file: refused, and by hand."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from skillweave.policies.acting_errors import PolicyError, SkillError
from skillweave.policies.core import LIMIT, OWN, RUNNING, LastCall, Turn, World
from skillweave.policies.selectors import (
    Branch,
    FunctionRule,
    Leaf,
    Rule,
    StateMachine,
    Tree,
    TreeCondition,
)
from skillweave.policies.spaces import Space
from skillweave.skills.goal_spaces import choice_space
from skillweave.spaces import obs_dtype

ABC = ("a", "b", "c")
NEAR = Space("Box", "float32", (2,), np.array(-1.0), np.array(1.0))
HERE = np.array([0.5, -0.5])


def first(obs: Any) -> Any:
    return np.zeros(len(obs), int)


def flag(obs: Any) -> Any:
    return obs[:, 0] > 0


def asked(skills: Any = ABC, goals: Any = None) -> Rule:
    return FunctionRule("it", skills, goals or {}, first)


def automaton(states: Any, arrows: Any = (), start: str = "x", goals: Any = ()) -> Rule:
    return StateMachine("it", ABC, {"a": NEAR}, states, start, arrows, goals)


def tree(root: Any) -> Rule:
    return Tree("it", ABC, {"a": NEAR}, root)


TWICE = Leaf("a")
X = {"x": ("a", "b")}
WRONG = {
    "no skill": (lambda: asked(()), r"different names, not \(\)"),
    "goals of no skill": (lambda: asked(ABC, {"d": NEAR}), "goals names 'd', which is no skill"),
    "no state": (lambda: automaton({}), "start names the state 'x', which does not exist"),
    "a state without a skill": (lambda: automaton({"x": ()}), "state 'x' has no skill"),
    "a state's skill": (lambda: automaton({"x": ("d",)}), "state 'x' names 'd', which is no"),
    "from no state": (
        lambda: automaton(X, (("y", "x", "success"),)),
        r"transition \('y', 'x'\) names the state 'y', which does not exist; the states are: x",
    ),
    "an event": (
        lambda: automaton(X, (("x", "x", "won"),)),
        "has the event 'won'; give a function",
    ),
    "a goal of no state": (lambda: automaton(X, goals=(("y", "a", HERE),)), "the state 'y'"),
    "a goal without goals": (lambda: automaton(X, goals=(("x", "b", HERE),)), "which has no goals"),
    "another goal": (lambda: automaton(X, goals=(("x", "a", HERE[:1]),)), r"'a' has shape \(1,\)"),
    "a tree without a skill": (lambda: tree(TreeCondition("flag", flag)), "has no skill"),
    "a leaf": (lambda: tree(Leaf("d")), "a leaf names 'd', which is no skill"),
    "a leaf's goal": (lambda: tree(Leaf("b", HERE)), "'b', which has no goals"),
    "no children": (lambda: tree(Branch("Sequence", ())), "a Sequence of 0 children"),
    "a kind": (lambda: tree(Branch("All", (Leaf("a"),))), "a All of 1 children"),  # type: ignore[arg-type]
    "a node twice": (lambda: tree(Branch("Fallback", (TWICE, TWICE))), "stands in two places"),
}


@pytest.mark.parametrize("case", WRONG)
def test_contradictory_data_are_refused(case: str) -> None:
    make, message = WRONG[case]
    with pytest.raises(PolicyError, match=f"it.*{message}"):
        make()


def turn(mask: Any = None) -> Turn:
    return Turn(World(), None if mask is None else np.array(mask, bool))


def test_a_tree_acts_in_some_of_the_environments_by_hand() -> None:
    fallback = Branch("Fallback", (TreeCondition("flag", flag), Leaf("a", HERE)))
    rule = tree(Branch("Sequence", (fallback, Leaf("b"), Leaf("c"))))
    memory, rows = rule.start(4), np.array([3, 1])
    # In environment 3 the flag is set, so b is called; in environment 1 it is not, so a is.
    choice = rule.act(memory, rows, np.array([[1.0], [0.0]]), turn())
    assert choice["skill"].tolist() == [1, 0]
    assert choice["goal"]["a"].tolist() == [[0, 0], [0.5, -0.5]]
    goals = choice_space(3, {"a": gym.spaces.Box(-1, 1, (2,), np.float32)}, ABC)
    assert choice.dtype == obs_dtype(goals)
    assert memory["leaf"].tolist() == [-1, 0, -1, 1]
    # The running child of the Sequence, and of the Fallback in it.
    assert memory["child"].tolist() == [[0, 0], [0, 1], [0, 0], [1, 0]]
    # The call of b succeeds, so c follows; that of a goes on.
    ends = np.int8([OWN, RUNNING])
    last = LastCall(np.array([1, 0]), ends, np.array([True, False]))
    rule.watch(memory, rows, None, last)  # type: ignore[arg-type]
    assert memory["succeeded"].tolist() == [False, False, False, True]
    choice = rule.act(memory, rows[:1], np.array([[0.0]]), turn())
    assert choice["skill"].tolist() == [2]
    # The call of a fails, so the tree starts again; where a may not start, it ends.
    last = LastCall(np.array([0]), np.int8([LIMIT]), np.array([False]))
    rule.watch(memory, rows[1:], None, last)  # type: ignore[arg-type]
    again = {name: values.copy() for name, values in memory.items()}
    assert rule.act(again, rows[1:], np.array([[0.0]]), turn())["skill"].tolist() == [0]
    with pytest.raises(SkillError, match=r"it ended \(FAILURE\) in observation \[0\.\]"):
        rule.act(memory, rows[1:], np.array([[0.0]]), turn([[False, True, True]]))
    assert memory["leaf"].tolist() == [-1, 0, -1, 2]
    # As a guide of choices with two lengths, of which both are equally likely.
    may = np.ones((1, 6), bool)
    chances = rule.chances(again, rows[1:], np.array([[1.0]]), may)
    assert chances.tolist() == [[0, 0, 0.5, 0.5, 0, 0]]
