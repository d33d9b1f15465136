"""Chances of plans before they are played, on logs whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from call_logs.logs import jumps, log_of
from planning.steps import at

from skillweave.calls import CallLog, held
from skillweave.planning import GoalTask, Mission, Planner, RewardMachine, either
from skillweave.planning.forecast import forecast
from skillweave.planning.lacking import asks_nothing

pytestmark = pytest.mark.usefixtures("usual_forecasts")
EPISODES = "skillweave.planning.forecast.EPISODES"
A, B = 0, 1
NINE, NOT_NINE = at(9), ~at(9)


def goes_right(share: float, episodes: int = 100) -> CallLog:
    """From 0, "a" walks to 1 in two steps, or ends the episode; from there "b" to 2."""
    way = [(A, [0.5, 1], True, "own"), (B, [2], True, "own")]
    lost = [(A, [-1], False, "end")]
    won = round(share * episodes)
    return log_of(["a", "b"], [(0, way)] * won + [(0, lost)] * (episodes - won))


@pytest.mark.parametrize("share", [0.1, 0.6, 1.0])
def test_the_chance_is_that_of_the_logged_calls(share):
    expected = forecast(Planner(goes_right(share), Mission(at(1), at(2))))
    assert expected.chance == pytest.approx(share, abs=0.1)
    assert expected.interval[0] < expected.chance <= expected.interval[1] + 1e-9
    assert expected.calls == (("a", 2.0), ("b", 1.0))
    assert expected.steps == 3
    assert ("-1" in expected.reason or "state" in expected.reason) == (share < 0.2)
    assert str(expected).startswith("a (2 steps) -> b (1 steps): a chance of ")
    if share == 0.6:  # few starts make a wide interval
        low, high = forecast(Planner(goes_right(share, 10), Mission(at(1)))).interval
        assert high - low > 0.4


def test_what_never_changes_in_an_episode_stays():
    """ "a" goes to the place that number 1 holds, "b" back to 0, in half of the episodes to 1."""
    rng, episodes = np.random.default_rng(0), []
    for i in range(120):
        key, here, calls = i % 2, 0.0, []
        for _ in range(4):
            skill = int(rng.integers(2))
            here = [key, 0.0][skill] + rng.normal(0, 0.01)
            calls.append((skill, [[here, key]], True, "own"))
        episodes.append(([rng.normal(0, 0.01), key], [*calls[:-1], (*calls[-1][:3], "cut")]))
    log = log_of(["a", "b"], episodes, size=2)
    planner = Planner(log, Mission(lambda obs: obs[:, 0] > 0.5))
    assert forecast(planner).chance == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(
    ("task", "words"),
    [
        (Mission(at(1), at(0)), ["at 0", "after", "at 1"]),
        (Mission(at(2), avoid=at(0.5)), ["at 2", "unless", "at 0.5"]),
        (Mission(at(1), at(2), held(at(0.5), 2)), ["at 0.5", "at 2"]),
    ],
)
def test_an_order_that_never_comes_is_named(task, words, monkeypatch):
    monkeypatch.setattr(EPISODES, 20)
    steps = [(0, [(A, [0, 1], True, "own"), (B, [0.5, 2], True, "own")])]
    planner = Planner(log_of(["a", "b"], steps * 5), task)
    assert all(word in planner.obstacle for word in words)
    assert (forecast(planner).chance, forecast(planner).reason) == (0.0, planner.obstacle)


@pytest.mark.parametrize(
    "task",
    [
        Mission(at(1), at(2), at(3)),  # the log has it in two parts
        Mission(held(at(1), 5), at(2)),  # calls may be repeated
        Mission(at(3), at(2), repeat=None),
        RewardMachine({("x", "y"): (at(3), 1.0)}),
        GoalTask(lambda obs, goal: obs[:, 0] == goal[0], goal=[3]),
    ],
)
def test_what_the_log_allows_is_not_named(task, monkeypatch):
    monkeypatch.setattr(EPISODES, 20)
    episodes = [
        (0, [(A, [1], True, "own"), (A, [1], True, "own"), (B, [2], True, "own")]),
        (1, [(B, [2], True, "own"), (A, [3], True, "own")]),
    ]
    planner = Planner(log_of(["a", "b"], episodes * 5), task)
    assert not planner.obstacle
    assert forecast(planner).calls
    can_succeed = planner.machine.accepting.any()
    assert (forecast(planner).chance is None) == (not can_succeed)


def test_calls_that_change_nothing_are_repeated_only_where_that_counts():
    walk = [(A, [1], True, "own"), (A, [1], True, "own"), (B, [2], True, "own")]
    log = log_of(["a", "b"], [(0, walk), (0, [(B, [0], False, "own"), *walk])] * 9)
    for task in (Mission(held(at(1), 5), at(2)), Mission(at(2))):
        assert forecast(Planner(log, task)).chance == 1.0


def test_goals_of_each_episode_are_judged_by_themselves():
    ends = [(1, 1)] * 8 + [(2, 1)] * 7 + [(2, 2)]
    calls = [(goal, [(A, [[end, goal]], True, "end")]) for goal, end in ends]
    log = log_of(["a"], [([0, goal], call) for goal, call in calls], size=2)
    task = GoalTask(lambda obs, goal: obs[:, 0] == goal[..., 0], columns=(1,))
    assert forecast(Planner(log, task)).chance == pytest.approx(9 / 16, abs=0.15)


def test_what_is_avoided_and_holds_at_the_start_is_named():
    slow = [(A, [0.5, 1], True, "own")]
    log = log_of(["a"], [(0, slow)] * 18 + [(0, [(A, [1], True, "own")])] * 2)
    expected = forecast(Planner(log, Mission(at(1), avoid=at(0.5))))
    assert expected.chance < 0.2
    assert "'at 0.5'" in expected.reason
    assert "first steps" in expected.reason


def lucky(share: float, seed: int, calls: int = 400) -> CallLog:
    """Calls of a skill with goals from about 0, of which a share ends at 5, whatever the goal."""
    rng = np.random.default_rng(seed)
    starts, ends = rng.normal(0, 0.1, calls), np.where(rng.random(calls) < share, 5, -5)
    log = log_of(["go"], [(x, [(A, [y], True, "end")]) for x, y in zip(starts, ends, strict=True)])
    log.goals["go"] = rng.uniform(-1, 1, (calls, 2))
    return log


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_luckiest_of_many_goals_promises_no_more_than_others(share, seed):
    expected = forecast(Planner(lucky(share, seed), Mission(at(5))))
    assert share - 0.15 < expected.chance < share + 0.3  # all calls say nearly 1
    assert expected.interval[0] <= share <= expected.interval[1]


def test_goals_that_matter_are_promised():
    """From 0 to 10, three steps at a time: the goal says which way."""
    rng = np.random.default_rng(0)
    log = jumps(np.sort(rng.uniform(0, 10, 80)).tolist())
    expected = forecast(Planner(log, Mission(lambda obs: obs[:, 0] > 8)))
    assert expected.chance > 0.8
    assert expected.interval[1] >= expected.chance
    # The last call goes right, and its goal is shown: a number, or a range of them.
    assert expected.goals[-1].startswith("(")
    assert f"go {expected.goals[0]} (" in str(expected)


@pytest.mark.parametrize("episodes", [1, 3])
def test_a_log_of_few_episodes_gives_no_chance_of_goals(episodes):
    log = lucky(0.6, 0)
    calls = np.arange(len(log))
    few = replace(log, episode=calls % episodes, order=calls // episodes)
    expected = forecast(Planner(few, Mission(at(5))))
    assert expected.chance is None
    assert expected.interval == (0.0, 1.0)
    assert f"{episodes} episode" in expected.reason


def test_calls_that_began_too_late_are_no_evidence():
    """A call takes up to four steps; those that succeed at once began in the last step."""
    late = [(A, [0, 0, 0, 0], False, "limit")] * 3 + [(A, [1], True, "own")]
    log = log_of(["a"], [(0, [*late, (A, [1], False, "cut")])] * 30, limits=[4])
    assert log.began_late.sum() == 60
    assert forecast(Planner(log, Mission(at(1)))).chance == 0.0


@pytest.mark.parametrize(
    ("task", "words"),
    [
        (Mission(at(0)), ["'at 0'", "100%"]),
        (Mission(at(0), either(at(0) & at(0), at(7))), ["'at 0'"]),
        (Mission(NOT_NINE, at(2)), ["'not at 9'", "nearly all logged steps"]),
        (Mission(either(at(0), at(2))), ["'at 0'"]),
        (Mission(at(1)), []),
        (Mission(at(0), at(2)), []),  # "home, then key" asks for the key
        (Mission(at(2), avoid=NINE), []),
        (Mission(held(NOT_NINE, 3), at(2)), []),
        (Mission(at(0) & at(1), at(2)), []),
        (Mission(at(1), at(2), repeat=None), []),
    ],
)
def test_words_that_hold_before_anything_is_done_are_said(task, words):
    way = [(A, [0, 0, 0, 1], True, "own"), (B, [2], True, "own")]
    log = log_of(["a", "b"], [(0, way)] * 20)
    said = asks_nothing(task, log)
    assert bool(said) == bool(words)
    assert all(word in said for word in words)
