"""Missions against an interpreter of their parts, and as texts."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, strategies as st
from planning.steps import column, step_to

from skillweave.calls import Predicate, held
from skillweave.errors import DeclarationError
from skillweave.planning import (
    GoalTask,
    Mission,
    RewardMachine,
    as_task,
    either,
    in_any_order,
    reached,
)
from skillweave.recipes._missions import HALF, KINDS, POINTS, MissionState

P = [Predicate(column(i)) for i in range(4)]
NAMES = {"abcd"[i]: p for i, p in enumerate(P)}

# The reference: a mission is a nested tuple, and each part has its own progress.


class Part:
    """One part of a mission, followed step by step."""

    def __init__(self, tree):
        self.kind, self.tree, self.count, self.at = tree[0], tree, 0, 0
        self.parts = [Part(t) for t in tree[1]] if self.kind in ("then", "or", "and") else []
        self.done = False

    def step(self, row):
        if self.kind == "leg":
            self.count = self.count + 1 if row[self.tree[1]] else 0
            self.done = self.count >= self.tree[2]
        elif self.kind == "then":
            self.parts[self.at].step(row)
            self.at += self.parts[self.at].done
            self.done = self.at == len(self.parts)
        else:
            for part in self.parts:
                if not part.done:
                    part.step(row)
            over = any if self.kind == "or" else all
            self.done = over(p.done for p in self.parts)

    def worth(self) -> float:
        if self.done or self.kind == "leg":
            return float(self.done)
        shares = [p.worth() for p in self.parts]
        return max(shares) if self.kind == "or" else sum(shares) / len(shares)


def legs(tree):
    """A mission's part of a tree."""
    if tree[0] == "leg":
        return held(P[tree[1]], tree[2])
    parts = [legs(t) for t in tree[1]]
    return {"then": list, "or": lambda p: either(*p), "and": lambda p: in_any_order(*p)}[tree[0]](
        parts
    )


def text(tree) -> str:
    if tree[0] == "leg":
        return "abcd"[tree[1]] + (f" for {tree[2]} steps" if tree[2] > 1 else "")
    return "(" + f" {tree[0]} ".join(text(t) for t in tree[1]) + ")"


LEG = st.tuples(st.just("leg"), st.integers(0, 3), st.sampled_from([1, 1, 2, 3]))
TREE = st.recursive(
    LEG,
    lambda inner: st.tuples(
        st.sampled_from(["then", "then", "or", "and"]), st.lists(inner, min_size=2, max_size=3)
    ),
    max_leaves=5,
)


def flat(tree):
    """A tree whose sequences in sequences are joined, as missions join them."""
    if tree[0] == "leg":
        return tree
    parts = [flat(t) for t in tree[1]]
    if tree[0] == "then":
        parts = [p for part in parts for p in (part[1] if part[0] == "then" else [part])]
    return (tree[0], parts)


@given(TREE, st.booleans(), st.integers(0, 2**31))
def test_a_mission_is_followed_as_its_parts_are(tree, avoids, seed):
    how = {"avoid": column(4)} if avoids else {}
    task, reason = None, ""
    try:
        task = Mission(legs(tree), **how)
    except DeclarationError as error:
        reason = str(error)
    if task is None:
        assert "twice in a row" in reason
        return
    avoid = ", avoid e" if avoids else ""
    same = Mission.from_text(text(tree) + avoid, NAMES | {"e": column(4)})
    assert same.state_names == task.state_names
    n, rng = 4, np.random.default_rng(seed)
    tree = flat(tree)
    references = [Part(tree) for _ in range(n)]
    state, state_of_same = task.start(n), same.start(n)
    total, failed = np.zeros(n), np.zeros(n, bool)
    for _ in range(25):
        rows = rng.random((n, 5)) < [0.4, 0.3, 0.6, 0.5, 0.03]
        state, reward, done = task.step(state, step_to(rows))
        state_of_same, as_text, _ = same.step(state_of_same, step_to(rows))
        assert (state == state_of_same).all()
        np.testing.assert_allclose(reward, as_text)
        total += reward
        for i, reference in enumerate(references):
            failed[i] |= bool(avoids and rows[i, 4] and not reference.done)
            if not reference.done and not failed[i]:
                reference.step(rows[i])
        np.testing.assert_allclose(total, [r.worth() for r in references], atol=1e-9)
        assert task.has_succeeded(state).tolist() == [r.done for r in references]
        assert done.tolist() == [r.done or f for r, f in zip(references, failed, strict=True)]


def test_a_mission_that_repeats():
    twice = Mission(P[0], P[1], repeat=2)
    assert twice.state_names == ("a", "b", "a #2", "b #2", "done")
    forever = Mission(P[0], P[1], repeat=None, avoid=P[2])
    assert forever.state_names == ("a", "b", "failed")
    state, paid = forever.start(1), []
    for row in ([1, 0, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]):
        state, reward, done = forever.step(state, step_to([row]))
        paid.append(float(reward[0]))
    assert paid == [0.5, 0.5, 0.5, 0.5, 0.0]
    assert done[0]
    # A mission may be a leg.
    assert Mission(twice, P[2]).state_names == ("a", "b", "a #2", "b #2", "c", "done")


def test_it_pays_as_the_landers_missions_do():
    def box(kind: int):
        def inside(obs):
            return (np.abs(obs[:, :2] - POINTS[kind]) <= HALF[kind] + 1e-6).all(axis=1)

        inside.__name__ = KINDS[kind]
        return inside

    left, right, hover = (box(k) for k in range(3))
    for names in (("left", "right", "hover"), ("hover", "left")):
        by_name = {"left": left, "right": right, "hover": held(hover, 100)}
        task = Mission(*(by_name[n] for n in names))
        n, rng = 8, np.random.default_rng(1)
        progress, ids = MissionState(n, [names], gusts=False), np.arange(n)
        progress.begin(ids, [rng] * n)
        state, place = task.start(n), np.zeros((n, 8))
        goal = np.zeros((n, 2))
        total = np.zeros(n)
        for t in range(900):
            if t % 130 == 0:
                goal = POINTS[rng.integers(3, size=n)] + rng.normal(0, 0.05, (n, 2))
            place[:, :2] += 0.1 * (goal - place[:, :2]) + rng.normal(0, 0.01, (n, 2))
            paid = progress.advance(place, np.zeros(n), np.zeros(n, bool), ids)
            state, reward, done = task.step(state, step_to(place))
            np.testing.assert_allclose(reward, paid, atol=1e-6)
            assert (done == progress.done(ids)).all()
            total += reward
        assert total.max() > 0.99
        assert total.min() < 0.99


def test_texts_and_what_they_mean():
    assert Mission.from_text("a then b or c and d", NAMES).state_names == (
        "a", "b or c and d", "b or d", "b or c", "done",
    )  # fmt: skip
    task = Mission.from_text("a for 3 steps then not b, repeat 2", NAMES)
    assert task.state_names[:2] == ("a for 3 steps", "not b")
    assert len(task.state_names) == 5
    task = Mission.from_text("(a then b) repeat 2 then c, avoid d or not a", NAMES)
    assert task.state_names == ("a", "b", "a #2", "b #2", "c", "done", "failed")
    assert [p.name for p in task.avoid] == ["d", "not a"]
    assert Mission.from_text("a then b, repeat forever", NAMES).repeat is None
    task = Mission.from_text("stay then a", {"stay": held(P[1], 5), "a": P[0]})
    assert task.counter_steps[0, 0] == 5
    # One of several ways may be avoided.
    assert Mission(either(P[1], P[0]), avoid=P[0]).avoid == (P[0],)


@pytest.mark.parametrize(
    ("text", "reason", "word"),
    [
        ("a then bb then c", "'bb' is no known predicate: is 'b' meant", "bb"),
        ("a then", "the name of a predicate is expected", ""),
        ("a b", "'then', 'or', 'and', or a comma is expected", "b"),
        ("(a then b", r"'\)', 'then'", ""),
        ("a then then b", "the name of a predicate is expected", "then"),
        ("a, b", "'avoid' or 'repeat' is expected after a comma", "b"),
        ("a, avoid", "the name of a predicate is expected", ""),
        ("a repeat 2", "in parentheses, or a comma before 'repeat'", "repeat"),
        ("a, repeat 99999999999999999999", "from 1 to 1,000", "99999999999999999999"),
        ("a, repeat twice", "a whole number is expected", "twice"),
        ("a then b, repeat 2, repeat 2", "repeats twice", "repeat"),
        ("a for b", "a whole number is expected", "b"),
        ("a; b", "this sign has no meaning", ";"),
        ("stay for 3 steps", "has its number of steps already", "stay"),
        ("not stay", "before a predicate without a number of steps", "not"),
        ("a, avoid stay", "what is avoided must be a predicate of one step", "stay"),
        ("a or b or c or d or a or b or c", "at most 6 parts", "a"),
        ("x" * 80 + " then a", "no known predicate", "x" * 80),
        (" then ".join(["a", "b"] * 40 + ["bb"]), "is 'b' meant", "bb"),
    ],
)
def test_an_error_points_at_the_word(text, reason, word):
    with pytest.raises(DeclarationError, match=reason) as caught:
        Mission.from_text(text, NAMES | {"stay": held(P[0], 5)})
    _, line, pointer = str(caught.value).split("\n")
    at = pointer.index("^")
    assert pointer.strip() == "^" * max(1, len(word))
    assert line[at : at + len(word)] == word[: len(line) - at]
    assert len(line) < 100


@pytest.mark.parametrize(
    ("text", "noun"),
    [
        ("(" * 250 + "a" + ")" * 250, "parentheses"),
        ("(((a then b) repeat 1000) repeat 1000)", "states"),
        (" and ".join(["(a or b or a or b or a or b)"] * 4), "transitions"),
        ("((a or b or c or d) and (a or b or c or d)) repeat 1000", "transitions"),
    ],
)
def test_a_text_that_means_too_much_is_refused_before_it_is_built(text, noun):
    with pytest.raises(DeclarationError, match=noun):
        Mission.from_text(text, NAMES)


def test_equal_names_are_numbered_in_linear_time():
    start = time.process_time()
    names = Mission.from_text("(a then b) repeat 1000", NAMES).state_names
    assert time.process_time() - start < 2
    assert names[:3] + names[-3:] == ("a", "b", "a #2", "a #1000", "b #1000", "done")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Mission(), "has no legs"),
        (lambda: Mission("left"), "'left' is no predicate"),
        (lambda: Mission([]), "a leg is an empty list"),
        (lambda: Mission(P[0], P[0]), "has 'a' twice in a row.*~a for example"),
        (lambda: Mission(P[0], repeat=0), "repeat is 0"),
        (lambda: Mission(P[0], avoid=held(P[1], 3)), "event over several steps"),
        (lambda: either(P[0]), "has 1 part; give 2 to 6"),
        (lambda: Mission(Mission(P[0], P[1], repeat=None)), "say it of the whole mission"),
        (lambda: Mission.from_text(3, {}), "a mission is 3; it must be a text"),
        (lambda: Mission.from_text("a", [P[0]]), "it must be a dict"),
        (lambda: Mission.from_text("a", {"a b": P[0]}), "a name is one word"),
        (lambda: Mission.from_text("a", {"then": P[0]}), "a word of missions"),
        (
            lambda: Mission(in_any_order(*(Mission(P[0], P[1], repeat=60) for _ in range(2)))),
            "more than 10,000 states",
        ),
        (lambda: as_task(3), "the task is 3; give a Mission"),
        (lambda: GoalTask(3, goal=[1]), "reached is 3"),
        (lambda: GoalTask(column(0)), "needs either goal= or columns="),
        (lambda: GoalTask(column(0), goal=[np.nan]), "one row of finite numbers"),
        (lambda: GoalTask(column(0), goal="x"), "give numbers"),
        *(
            (lambda goal=goal: GoalTask(column(0), goal=goal), "a goal is")
            for goal in ("3", ["3"], [True], [[1.0]], [])
        ),
        *(
            (
                lambda legs=legs: Mission(*legs, avoid=P[0]),
                "must be done and must be avoided",
            )
            for legs in ((P[0],), (P[1], [P[2], held(P[0], 3)]), (in_any_order(P[1], P[0]),))
        ),
        (lambda: GoalTask(column(0), columns=(7,)).of(np.zeros((1, 3))), "have 3 numbers"),
    ],
)
def test_a_wrong_mission_is_refused(make, message):
    with pytest.raises(DeclarationError, match=message):
        make()


def test_a_task_of_anything_that_means_one():
    task = Mission(P[0])
    assert as_task(task) is task
    assert as_task("a then b", NAMES).state_names == ("a", "b", "done")
    assert as_task(P[0]).state_names == ("a", "done")
    assert as_task(either(P[0], P[1])).state_names == ("a or b", "done")
    assert as_task(column(0)).state_names == ("a", "done")
    paid = as_task(lambda step: step.next_obs[:, 0])
    assert isinstance(paid, RewardMachine)
    state, reward, done = paid.step(paid.start(2), step_to([[3], [4]]))
    assert (reward.tolist(), done.tolist(), state.tolist()) == ([3, 4], [False] * 2, [[0], [0]])


def near(obs, goal):
    return np.abs(obs[:, 0] - goal[..., 0]) < 0.5


def test_goals():
    own = GoalTask(near, columns=(1,))
    obs = np.array([[0, 3], [0, 0]], np.float32)
    assert own.of(obs).tolist() == [[3], [0]]
    assert own.put(obs, np.array([7])).tolist() == [[0, 7], [0, 7]]
    assert own.arrives(step_to(obs, obs)).tolist() == [False, True]
    machine = own.at(None)
    _, reward, done = machine.step(machine.start(2), step_to(obs, obs))
    assert (reward.tolist(), done.tolist()) == ([0, 1], [False, True])
    fixed = GoalTask(near, goal=[4])
    assert fixed.of(obs).tolist() == [[4], [4]]
    task = fixed.at(np.array([0.0]))
    assert task.step(task.start(2), step_to(obs))[2].tolist() == [True, True]
    assert Mission(reached(near, [4])).state_names == ("near(4)", "done")
