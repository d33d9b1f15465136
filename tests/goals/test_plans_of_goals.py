"""Plans on logged calls of skills with goals: which skill, and which goal."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from call_logs.logs import jumps, log_of
from goals.worlds import Point, Rest, declared, go_to, place_of, ready
from planning.steps import assert_not_repeated, at

import skillweave as sw
from skillweave.calls import Predicate
from skillweave.errors import DeclarationError, RunError
from skillweave.planning import Explorer, Mission, Planner
from skillweave.planning.graph import CallGraph
from skillweave.skills.goal_spaces import choice_space

GAMMA = 0.9
LINE = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)


def near(*place: float) -> Predicate:
    """The predicate that the point is at a place."""

    def there(obs):
        return np.abs(obs - np.float32(place)).max(1) < 0.3

    return Predicate(there, f"near {place}", "obs")


MISSION = Mission(near(1.4, 0.3), near(0.3, 1.4))


def bound(planner: Planner, space) -> Planner:
    """The planner for a skill ``go`` with goals of a space."""
    choices = choice_space(1, {"go": space}, ["go"])
    return planner.among(("go",)).bind(planner.log.observation_space, choices, "selector")


@pytest.mark.parametrize("goals", [(0, 10), range(11)])
def test_values_are_those_of_a_skill_for_each_goal(goals):
    """With few goals and with many: the best goal from each start is known on a line."""
    log = jumps(goals, np.repeat(np.arange(11), 3))  # every call three times
    planner = Planner(log, Mission(at(9), at(1)), neighbors=1, gamma=GAMMA, caution=0.0)
    obs = np.float32([[p] for p in range(11)])
    reached = GAMMA ** (np.abs(9 - np.arange(11)) - 1.0)
    there_and_back = (reached + reached * GAMMA**8) / 2
    values = planner.values(obs)[:, 0]
    for place in (0, 3, 6):  # where three steps end at 9
        assert values[place] == pytest.approx(there_and_back[place], abs=3e-3)
    acting = bound(planner, LINE)
    choice, _ = acting.act(acting.start(11), obs)
    assert (choice["skill"] == 0).all()
    aims = choice["goal"]["go"][:, 0]
    assert (aims[:9] > np.arange(9)).all()
    assert aims[10] < 10


def test_calls_count_for_one_another_by_start_and_goal():
    """At the same start, the goal that leads to 5 is worth most, and near goals a part of it."""
    goals = np.linspace(-1, 1, 40)
    ends = np.where(goals > 0.5, 5, -5)
    log = log_of(["go"], [(0, [(0, [end], True, "end")]) for end in ends.tolist()])
    log.goals["go"] = goals[:, None]
    planner = Planner(log, at(5), neighbors=3, caution=0.0)
    assert planner.values(np.zeros((1, 1), np.float32))[0, 0] == pytest.approx(1.0, abs=1e-3)
    option = planner.graph.near(np.zeros((1, 1), np.float32))
    aims = goals[option.goal[0]]
    worth = (planner.plan[option.pieces[0], 0] * option.weights[0]).sum(1)
    assert (worth[aims > 0.7] > 0.99).all()
    assert (worth[aims < 0.3] < 0.01).all()
    assert ((worth > 0.01) & (worth < 0.99)).any()  # beside the edge, where a neighbor differs


def test_fewer_calls_than_options():
    """Options without a call are worth nothing, and are never chosen."""
    log = log_of(["go"], [(p, [(0, [p + 1], True, "end")]) for p in range(5)])
    log.goals["go"] = np.arange(1.0, 6.0)[:, None]
    planner = bound(Planner(log, at(1), neighbors=2, caution=0.0), LINE)
    obs = np.float32([[4], [0]])
    near, corners = planner.graph.near(obs), planner.states.corners(planner.machine.start(2))
    assert np.isfinite(planner.in_place.valued(near, obs, corners)).sum() == 10
    q = planner.values(obs)[:, 0]
    assert q[1] > q[0]
    choice, _ = planner.act(planner.start(2), obs)
    assert choice["goal"]["go"][1, 0] == 1


def test_goals_of_a_log_of_which_every_so_many_th_call_counts(monkeypatch):
    monkeypatch.setattr("skillweave.planning.graph.MOST_CALLS", 50)
    log = jumps((0, 10), np.repeat(np.arange(11), 20))
    obs = np.float32([[2], [7]])
    aims = []
    for task in (at(9), at(1)):
        with pytest.warns(UserWarning, match="the plan uses 50 of them"):
            planner = bound(Planner(log, task, neighbors=1, gamma=GAMMA), LINE)
        choice, _ = planner.act(planner.start(2), obs)
        aims.append(choice["goal"]["go"][:, 0].tolist())
    assert aims == [[10, 10], [0, 0]]


def test_a_logged_goal_has_no_distance_to_itself():
    """Not even by rounding, where its numbers are large beside their differences."""
    log = log_of(["go"], [(0, [(0, [i], True, "end")]) for i in range(40)])
    log.goals["go"] = np.random.default_rng(0).normal(size=(40, 2))
    # So few calls cannot do without a goal's own one.
    near = CallGraph(log, neighbors=5).near(np.zeros((1, 1), np.float32))
    assert (near.distance == 0).all()


def test_a_goal_that_failed_is_not_repeated_forever():
    """The log says that goals above lead to 3; now there is a wall."""
    log = jumps((0, 10), np.repeat(np.arange(11), 3))
    planner = bound(Planner(log, at(9), neighbors=1, gamma=GAMMA), LINE)
    assert_not_repeated(planner, lambda choice: choice["goal"]["go"][:, 0] > 2)


LEARNS = sw.PPO(num_envs=2, n_steps=16, batch_size=8, update_epochs=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "task"),
    [({}, MISSION), ({"selector": LEARNS, "call_steps": sw.Lengths(2, 4, 8)}, near(1.4, 0.3))],
)
def test_places_that_no_training_saw(how, task):
    run = ready(**how)
    log = run.log_calls(4_000, num_envs=8)
    assert log.lengths == ((2, 4, 8) if how else ())
    found = run.plan(task, log).evaluate(20, quiet=True)
    assert np.mean(np.array(found.returns) > 0.99) >= 0.9
    if not how:
        random = run.evaluate(20, quiet=True)
        assert np.mean(np.array(random.returns) > 0.99) < 0.5


@pytest.mark.slow
def test_a_planner_is_declared_as_a_selector():
    run = ready()
    log = run.log_calls(1_500, num_envs=8)
    skills = run.hierarchy.skills
    other = declared(skills, selector=Planner(log, near(1.4, 0.3)))
    played = other.train(quiet=True)
    calls = played.log_calls(300, choose=played.policy.selector, num_envs=2)
    there = near(1.4, 0.3).at(calls.next_obs)
    arrived = [there[calls.episode[calls.owner] == e].any() for e in np.unique(calls.episode)]
    assert len(arrived) >= 10
    assert np.mean(arrived) >= 0.9


def test_another_log_s_goals_are_refused():
    log = ready().log_calls(300, num_envs=4)
    run = ready("number")
    with pytest.raises(RunError, match="changed since the log"):
        run.plan(near(1.4, 0.3), log)
    other = declared(run.hierarchy.skills, selector=Planner(log, near(1.4, 0.3)))
    with pytest.raises(RunError, match=r"goals of go_to \(2 numbers\).*go_to \(1 number\)"):
        other.train(quiet=True)


def test_a_guide_of_one_skill_with_goals_is_refused():
    skills = [go_to(policy=ready().hierarchy.skills[0].policy)]
    run = declared(skills).train(quiet=True)
    log = run.log_calls(300, num_envs=4)
    guide = sw.Guide(Planner(log, near(1.4, 0.3)), restrict=False, target_kl=0.1)
    with pytest.raises(DeclarationError, match="says nothing about goals"):
        declared(skills, selector=sw.PPO(), guide=guide).train(quiet=True)


@pytest.mark.parametrize(
    "space",
    [
        "number",
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("numbers", "dict", "tuple", "bits")),
    ],
)
def test_plans_with_goals_of_other_kinds(space):
    run = ready(space)
    log = run.log_calls(1_500, num_envs=8)
    mine = log.end[log.succeeded & (log.skill == 0)]
    place = mine[len(mine) // 2]  # a goal leads there
    found = run.plan(near(*place.tolist()), log).evaluate(10, quiet=True)
    assert np.mean(np.array(found.returns) > 0.99) >= 0.8


def test_exploring_draws_goals_for_new_calls():
    run = ready()
    log = run.log_calls(600, choose=Explorer(every=150), num_envs=4)
    mine = log.skill == 0
    assert (np.abs(log.goals["go_to"][mine]) <= 1).all()
    # Calls that are not new repeat goals of the log.
    assert 10 < len(np.unique(log.goals["go_to"][mine], axis=0)) < mine.sum()


@pytest.mark.slow
def test_a_trained_selector_starts_from_a_plan_with_goals():
    run = ready()
    log = run.log_calls(3_000, num_envs=8, seed=1)
    planned = run.plan(near(1.4, 0.3), log)
    config = replace(LEARNS, learning_rate=1e-9)
    declared_again = planned.with_selector(config, steps=32)
    trained = declared_again.train(quiet=True)
    rate = trained.evaluate(20, quiet=True).success_rate
    untaught = planned.with_selector(config, steps=32)
    untaught._starts = type(untaught)._starts
    other = untaught.train(quiet=True).evaluate(20, quiet=True).success_rate
    assert rate is not None
    assert other is not None
    assert rate >= 0.6
    assert other <= 0.2
    again = declared_again.load(trained.path)
    assert again.evaluate(3, quiet=True).returns == trained.evaluate(3, quiet=True).returns


@pytest.mark.parametrize(
    ("as_dict", "sees"), [(False, (1, 0, "goal")), (True, ("observation.place", "goal"))]
)
def test_calls_are_compared_by_the_numbers_of_the_observation_that_a_network_sees(as_dict, sees):
    algorithm = sw.PPO(num_envs=4, n_steps=16, network=sw.Network((8,), sees=sees))
    env = sw.EnvSpec(lambda: Point(as_dict=as_dict), engine="sync", workers=1)
    run = declared([go_to(algorithm=algorithm), Rest()], env=env, steps=64).train(quiet=True)
    log = run.log_calls(80)
    assert log.sees == ((0, 1) if as_dict else (1, 0), None)
    there = Predicate(lambda obs: place_of(obs)[:, 0] > 0.4, "there", "obs")
    planned = run.plan(there, log, features={"rest": [0, 1]} if as_dict else None)
    assert planned.evaluate(1, quiet=True).returns


@pytest.mark.parametrize("declares", [{"sees": (1, 0)}, {"policy": sw.Residual(lambda o: -o)}])
def test_calls_of_a_part_or_a_correction_are_compared_by_all(declares):
    algorithm = sw.PPO(num_envs=4, n_steps=16, network=sw.Network((8,), sees=(0,)))
    own = type("Own", (sw.Skill,), {"algorithm": algorithm, "max_steps": 3, **declares})
    rule = {"selector": lambda obs: ["own"] * len(obs)}
    env = sw.EnvSpec(Point, engine="sync", workers=1)
    run = declared([own()], env=env, steps=64, **rule).train(quiet=True)
    assert run.log_calls(60).sees == (None,)
