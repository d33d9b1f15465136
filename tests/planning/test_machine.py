"""Reward machines by hand."""

from __future__ import annotations

import numpy as np
import pytest
from planning.steps import column, step_to
from ready_selectors.watching import watched

from skillweave.calls import Predicate, held, successes
from skillweave.errors import DeclarationError, SkillError
from skillweave.planning import Mission, RewardMachine, in_any_order
from skillweave.skills import LastCall, Skill

A, B, C = (column(i) for i in range(3))


def states(task: RewardMachine, state) -> list[str]:
    return [task.state_names[i] for i in state[:, 0]]


def test_transitions_rewards_and_ends_by_hand():
    task = RewardMachine(
        {
            ("one", "two"): (A, 0.25),
            ("one", "bad"): B,
            ("two", "done"): (C, 0.75),
            ("two", "one"): (B, -1.0),
        },
        accepting={"done"},
        failing={"bad"},
    )
    state = task.start(4)
    assert states(task, state) == ["one"] * 4
    # The first declared counts where two hold; at most one transition is taken in a step.
    state, reward, done = task.step(state, step_to([[1, 1, 1], [0, 1, 0], [0, 0, 1], [1, 0, 0]]))
    assert states(task, state) == ["two", "bad", "one", "two"]
    assert reward.tolist() == [0.25, 0.0, 0.0, 0.25]
    assert done.tolist() == [False, True, False, False]
    state, reward, done = task.step(state, step_to([[0, 0, 1], [1, 1, 1], [0, 1, 0], [0, 1, 0]]))
    assert states(task, state) == ["done", "bad", "bad", "one"]
    assert reward.tolist() == [0.75, 0.0, 0.0, -1.0]
    assert done.tolist() == [True, True, True, False]
    assert task.has_succeeded(state).tolist() == [True, False, False, False]


def test_counters_count_steps_without_a_gap_and_only_in_their_state():
    task = RewardMachine({("a", "b"): A, ("b", "c"): held(B, 3)}, accepting={"c"})
    state = task.start(1)
    seen = []
    for row in ([0, 1], [1, 1], [0, 1], [0, 1], [0, 0], [0, 1], [0, 1], [0, 1]):
        state, _, done = task.step(state, step_to([row]))
        seen.append((states(task, state)[0], int(state[0, 1]), bool(done[0])))
    # The steps in b before its state was entered do not count.
    assert seen == [
        ("a", 0, False), ("b", 0, False), ("b", 1, False), ("b", 2, False), ("b", 0, False),
        ("b", 1, False), ("b", 2, False), ("c", 0, True),
    ]  # fmt: skip
    # Several of one state
    task = RewardMachine({("a", "x"): held(A, 2), ("a", "y"): held(B, 3)}, accepting={"x", "y"})
    state = task.start(3)
    for rows in ([[1, 1], [0, 1], [1, 0]], [[0, 1], [0, 1], [0, 1]], [[1, 1], [1, 1], [1, 1]]):
        state, _, done = task.step(state, step_to(rows))
    assert states(task, state) == ["y", "y", "a"]
    assert state[2].tolist() == [0, 1, 2]
    assert done.tolist() == [True, True, False]


def test_rewards_may_be_functions_of_a_step():
    def fast(step):
        return step.next_obs[:, 0] - step.obs[:, 0]

    task = RewardMachine(
        {("go", "rest"): (B, fast), ("rest", "end"): C},
        accepting={"end"},
        each_step={"go": -1.0, "rest": fast},
    )
    state = task.start(2)
    state, reward, _ = task.step(state, step_to([[3, 0, 0], [3, 1, 0]]))
    assert reward.tolist() == [-1.0, 2.0]
    state, reward, _ = task.step(state, step_to([[5, 1, 1], [5, 0, 1]], [[1, 0, 0]] * 2))
    assert reward.tolist() == [3.0, 4.0]
    assert states(task, state) == ["rest", "end"]
    _, reward, _ = task.step(state, step_to([[5, 0, 0]] * 2))
    assert reward.tolist() == [5.0, 0.0]  # a task that is over pays nothing


def test_predicates_of_steps_and_of_observations():
    def moved(step):
        return step.next_obs[:, 0] != step.obs[:, 0]

    class Stand(Skill):
        def success(self, step):
            return step.next_obs[:, 1] == 1

    step = step_to([[1, 1], [0, 1]])
    assert Predicate(moved).reads == "step"
    assert Predicate(A).reads == "obs"
    assert Predicate(lambda x: x.terminated, "end", "step").holds(step).tolist() == [False] * 2
    stands = successes([Stand(), Skill()])
    assert list(stands) == ["stand"]
    assert (Predicate(A) & moved).holds(step).tolist() == [True, False]
    assert (Predicate(A) | stands["stand"]).holds(step).tolist() == [True, True]
    assert (~Predicate(A)).at(step.next_obs).tolist() == [False, True]
    assert (Predicate(A) & ~Predicate(B)).name == "(a and not b)"
    with pytest.raises(DeclarationError, match="reads a step, but only an observation is known"):
        Predicate(moved).at(step.obs)


def test_what_a_policy_sees_of_a_task():
    task = RewardMachine({("a", "b"): held(A, 4), ("b", "c"): held(B, 2)}, accepting={"c"})
    seen = task.observe(np.array([[0, 3], [1, 1], [2, 0]]))
    assert seen.tolist() == [[1, 0, 0, 0.75], [0, 1, 0, 0.5], [0, 0, 1, 0]]
    assert all(task.observation_space.contains(row) for row in seen)


TASKS = {
    "several transitions": RewardMachine(
        {
            ("a", "bad"): C,
            ("a", "b"): A,
            ("b", "a"): held(B, 3),
            ("b", "done"): [column(3), column(4)],
        },
        accepting={"done"},
        failing={"bad"},
    ),
    "a counter that goes on": Mission(in_any_order(A, held(B, 6)), column(3), avoid=C),
}


@pytest.mark.parametrize("name", TASKS)
def test_its_automaton_is_in_the_same_states(name):
    task = TASKS[name]
    skills = {"a": "go_a", "b": ["go_b", "wait"], "c": "no", "d": "go_d", "e": "go_d"}
    declared = task.automaton(skills)
    automaton = declared.among(("go_a", "go_b", "wait", "no", "go_d"))
    n = 200
    rng = np.random.default_rng(0)
    state, memory = task.start(n), automaton.start(n)
    last = LastCall(np.zeros(n, int), np.zeros(n, np.int8), np.zeros(n, bool))
    seen = set()
    for _ in range(40):
        step = step_to(rng.random((n, 5)) < [0.3, 0.8, 0.03, 0.05, 0.05])
        state, _, _ = task.step(state, step)
        memory = watched(automaton, memory, step, last)
        names = [automaton.state_names[i] for i in memory["state"]]
        wanted = [
            name if not count else f"{name} ({count} steps held)"
            for name, count in zip(states(task, state), state[:, 1], strict=True)
        ]
        assert names == wanted
        seen.update(names)
    assert len(seen) > 5
    if name == "several transitions":
        assert declared.states["a"] == ("go_a",)
        held_b = ("go_b", "wait", "go_d")
        assert declared.states["b"] == declared.states["b (2 steps held)"] == held_b
        assert declared.states["done"] == ("go_a", "go_b", "wait", "no", "go_d")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RewardMachine([A]), "transitions are"),
        (lambda: RewardMachine({"a": A}), "transition is from 'a'; write"),
        (lambda: RewardMachine({("a", 3): A}), "state is 3; it must be a text"),
        (lambda: RewardMachine({("a", "b"): "x"}), "'x' is no predicate"),
        (lambda: RewardMachine({("a", "b"): (A, "x")}), "reward is 'x'"),
        (lambda: RewardMachine({("a", "b"): (A, np.nan)}), "reward is nan"),
        (lambda: RewardMachine({("a", "b"): (A, 10**400)}), "reward is 1000"),
        (lambda: RewardMachine({("a", "b"): A}, each_step=-1e39), "each_step"),
        (
            lambda: RewardMachine({("go", f"to {i}"): A for i in range(9_000)}),
            "9,000 transitions",
        ),
        (lambda: RewardMachine({("a", "b"): (A, 1, 2)}), r"write an event, or \(event"),
        (lambda: RewardMachine({("a", "b"): A}, start="c"), "start names the state 'c'"),
        (lambda: RewardMachine({("a", "b"): A}, accepting={"c"}), "states are: a, b"),
        (lambda: RewardMachine({("a", "b"): A}, accepting="b"), "give a set of states"),
        (
            lambda: RewardMachine({("a", "b"): A}, accepting={"b"}, failing={"b"}),
            "both accepting and failing",
        ),
        (
            lambda: RewardMachine({("a", "b"): A, ("b", "a"): A}, accepting={"b"}),
            "ends the task, so it has no transition",
        ),
        (lambda: RewardMachine({("a", "b"): A}, acepting={"b"}), "is 'accepting' meant"),
        (lambda: held(A, 0), "must be at least 1"),
        (lambda: held(A, 10**6), "an episode has at most"),
        (lambda: held(held(A, 3), 3), "event over several steps; give a predicate"),
        (lambda: held(A, 3) & A, r"combine predicates inside it: held\(a & b"),
        (lambda: Predicate(A) | held(A, 3), "is an event over several steps"),
        (lambda: Predicate(3), "a predicate is 3"),
        (lambda: Predicate(A, reads="steps"), "must be one of obs, step"),
        (
            lambda: RewardMachine({("a", "b"): A}).automaton({"b": "x"}),
            r"event 'a' has no skill; give one",
        ),
        (
            lambda: RewardMachine({("a", "b"): held(A, 3000)}).automaton({"a": "x"}),
            "more than 2,000 states",
        ),
        (
            lambda: RewardMachine({("a", "b"): held(A, 3), ("a", "c"): held(B, 3)}).automaton(
                {"a": "x", "b": "x"}
            ),
            "plan the task instead",
        ),
    ],
)
def test_a_wrong_machine_is_refused(make, message):
    with pytest.raises(DeclarationError, match=message):
        make()


def test_control_characters_in_names_of_states_are_escaped():
    assert "\x1b" not in repr(RewardMachine({("a\x1b[2J", "b\n"): A}))


def test_a_predicate_that_answers_wrongly_is_named():
    def bad(obs):
        return obs

    task = RewardMachine({("a", "b"): bad})
    with pytest.raises(SkillError, match=r"task: bad\(\) returned shape \(2, 2\)"):
        task.step(task.start(2), step_to([[1, 1], [0, 1]]))
    task = RewardMachine({}, each_step=lambda step: step.next_obs[:, 9])
    with pytest.raises(SkillError, match="IndexError"):
        task.step(task.start(2), step_to([[1, 1], [0, 1]]))
