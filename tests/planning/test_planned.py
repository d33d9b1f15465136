"""A plan as data: it acts in some of many environments, and needs nothing else."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from call_logs.logs import log_of
from planning.steps import at, step_to

from skillweave.calls import CallLog, held
from skillweave.errors import PolicyError, SkillError
from skillweave.planning import GoalTask, Mission, Planner, RewardMachine
from skillweave.policies.core import LastCall, Turn, World, flat
from skillweave.policies.planned import Planned
from skillweave.skills.goal_spaces import choice_space
from skillweave.spaces import obs_dtype

LINE = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)


def line(lengths: tuple[int, ...] = ()) -> CallLog:
    """From each place a call of both skills, three steps to the left or to the right, and noise."""
    rng = np.random.default_rng(0)
    calls = []
    for place in np.arange(0, 10, 0.5):
        for skill, by in enumerate((-1, 1)):
            inside = np.clip(place + by * np.arange(1, 4), 0, 10)
            noise = rng.normal(0, 0.01, 4)
            rows = [(float(x), float(e)) for x, e in zip(inside, noise[1:], strict=True)]
            calls.append(((float(place), float(noise[0])), [(skill, rows, True, "limit")]))
    log = log_of(["left", "right"], calls, size=2)
    may = np.ones((len(log), 2 * max(1, len(lengths))), bool)
    choice = log.skill * len(lengths) + len(lengths) - 1 if lengths else log.choice
    return replace(log, lengths=lengths, choice=choice, may_follow=may)


def aimed() -> CallLog:
    """One skill with goals: a call goes three steps towards its goal."""
    rng = np.random.default_rng(1)
    starts, goals = np.repeat(np.arange(11), 12), rng.uniform(0, 10, 132)
    calls = []
    for start, goal in zip(starts.tolist(), goals.tolist(), strict=True):
        inside = np.clip(np.arange(1, 4) * np.sign(goal - start), *sorted((0, goal - start)))
        calls.append((start, [(0, (start + inside).tolist(), True, "limit")]))
    log = log_of(["go"], calls)
    log.goals["go"] = goals[:, None]
    return log


def reward(step):
    return step.next_obs[:, 0] / 10


def columns_near(obs, goal):
    return np.abs(obs[:, 0] - np.round(np.abs(goal[..., 0]))) < 0.3


def bound(space=LINE) -> Planner:
    planner = Planner(aimed(), Mission(at(9), at(1)), neighbors=2).among(("go",))
    choices = choice_space(1, {"go": space}, ["go"])
    return planner.bind(planner.log.observation_space, choices, "selector")


PLANS = {
    "mission": lambda: Planner(line(), Mission(at(9), held(at(1), 3), at(9))),
    "reward": lambda: Planner(
        line(), RewardMachine({("on", "there"): (at(9), 1.0)}, each_step={"there": reward})
    ),
    "function": lambda: Planner(line(), at(9), features=lambda obs: obs[:, 0]),
    "lengths": lambda: Planner(line((1, 2, 3)), at(9)),
    "goals": bound,
    "goals of a guide": lambda: Planner(aimed(), at(9)),
    "goals that observations hold": lambda: Planner(line(), GoalTask(columns_near, columns=(1,))),
}


def course(plans: Planned, log: CallLog, rows_of, n: int = 5) -> list[Any]:
    """What it chooses and remembers in ``n`` environments, where calls often lead nowhere.

    Args:
        rows_of: of rows that decide, the groups in which they are asked.
    """
    rng, memory, found = np.random.default_rng(0), plans.start(n), []
    obs = log.next_obs[rng.integers(log.steps, size=n)]
    skill = np.zeros(n, np.int64)
    for _ in range(30):
        may = rng.random((n, plans.options.choices)) < 0.9
        may[:, 0] |= ~may.any(1)
        chosen = np.full(n, -1)
        for rows in rows_of(np.flatnonzero(rng.random(n) < 0.6)):
            choice = plans.act(memory, rows, obs[rows], Turn(World(), may[rows]))
            chosen[rows] = choice if choice.dtype.fields is None else choice["skill"]
            skill[rows] = plans.options.skill_of[chosen[rows]]
            found += choice.tolist()
        moved = log.next_obs[rng.integers(log.steps, size=n)]
        after = np.where(rng.random((n, 1)) < 0.6, obs, moved).astype(np.float32)
        why = rng.integers(3, size=n).astype(np.int8)
        other = np.where(rng.random(n) < 0.1, 0, skill)  # perhaps it only guides
        for rows in rows_of(np.arange(n)):
            last = LastCall(other[rows], why[rows], np.zeros(len(rows), bool))
            plans.watch(memory, rows, step_to(after[rows], obs[rows]), last)
        obs = after
    return [found, {name: value.tolist() for name, value in flat(memory).items()}]


def together(rows) -> list[Any]:
    return [rows] if len(rows) else []


@pytest.mark.parametrize("name", PLANS)
def test_rows_are_as_one_environment_each(name):
    planner = PLANS[name]()
    plans, log = planner.in_place, planner.log
    many = course(plans, log, together)
    assert str(many) == str(course(plans, log, lambda rows: rows[:, None]))  # a NaN is itself
    assert len({str(choice) for choice in many[0]}) > (name != "goals of a guide")


def test_choices_with_goals_are_records_of_a_choice_space():
    planner = bound()
    plans = planner.in_place
    choice = plans.act(plans.start(3), np.arange(3), np.float32([[2], [5], [9]]), Turn(World()))
    assert choice.dtype == obs_dtype(planner.action_space)
    assert (choice["goal"]["go"][:2, 0] > 2).all()
    with pytest.raises(SkillError, match=r"chose skill 'go' without a goal .* so record some"):
        plans.record(np.array([0]), np.array([-1]), np.float32([[2]]))


def test_how_likely_choices_are():
    plans = PLANS["mission"]().in_place
    may = np.ones((1, 6), bool)  # with three lengths, which it does not choose
    chances = plans.chances(plans.start(1), np.arange(1), np.float32([[2, 0]]), may)
    assert chances[0].tolist() == pytest.approx([0, 0, 0, 1 / 3, 1 / 3, 1 / 3])


def changed(x, path: str, value):
    """A copy of data in which the part at a path has another value, or a function's of it."""
    name, _, rest = path.partition(".")
    old = (
        x[int(name)]
        if isinstance(x, tuple)
        else x[name]
        if isinstance(x, dict)
        else getattr(x, name)
    )
    new = changed(old, rest, value) if rest else value(old) if callable(value) else value
    if isinstance(x, tuple):
        return (*x[: int(name)], new, *x[int(name) + 1 :])
    return x | {name: new} if isinstance(x, dict) else replace(x, **{name: new})


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("skills", ("go", "on"), "has features of 1"),
        ("goals", lambda goals: {"walk": goals["go"]}, "goals of 'walk'"),
        ("numbers", {}, "numbers of a plan"),
        ("numbers.go", lambda x: x[:5], "numbers of a plan"),
        ("worth", lambda x: x[:, :1], "values of 1 planning states"),
        ("worth", lambda x: x * np.nan, "worth of a plan"),
        ("features.0.places", lambda x: x - 1, "places of a plan"),
        ("features.0.mean", lambda x: x[:0], "mean of a plan"),
        ("options.neighbors", 0, "0 neighbors"),
        ("options.lengths", (1, 3), r"options of the choices \[0\]"),
        ("options.aims", (None,), "but no goals"),
        ("options.aims.0", lambda x: x[:3], "of a plan"),
        ("options.groups", (), r"options of the choices \[\]"),
        ("options.groups.0.options", 10**9, "1000000000 options"),
        ("options.groups.0.rows", lambda x: x + 9_999, "rows of a plan"),
        ("options.groups.0.call", lambda x: x + 9_999, "call of a plan"),
        ("options.groups.0.goal", lambda x: x - 9_999, "goal of a plan"),
        ("options.groups.0.starts", lambda x: x.repeat(2, 1), "starts of a plan"),
        ("task.first", 7, "starts in state 7"),
        ("task.target", lambda x: x + 7, "target of a plan"),
        ("task.atoms", lambda x: x + 7, "atoms of a plan"),
        ("task.paid_by", lambda x: x + 1, "paid_by of a plan"),
        ("task.each", lambda x: x[1:], "each of a plan"),
        ("task.keeps", lambda x: x[..., None], "keeps of a plan"),
        ("levels.first", lambda x: x + 7, "levels of"),
        ("levels.levels", lambda x: np.ones((len(x), 9), int), "spacing of a plan"),
    ],
)
def test_data_that_contradict_one_another_are_refused(path, value, message):
    with pytest.raises(PolicyError, match=message):
        changed(bound().in_place, path, value)
