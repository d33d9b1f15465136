"""Semi-MDP values by hand, and what the library's decisions say of the same skills."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.four_rooms import (
    GAMMA,
    SETS,
    VALUES,
    Counted,
    collector_of,
    exact,
    option_of,
    process_of,
)
from benchmarks.semi_mdp import Option, Process, model_of, optimal, value_of
from examples.four_rooms import AFTER, CORNER, EAST, G1, G2, NORTH, PLACES, FourRooms
from skillweave._internal.seeding import Seeds
from skillweave.experience.acting import Request

EVERYWHERE, NOWHERE = np.ones(3, bool), np.zeros(3, bool)


def corridor(stays: float = 0.0) -> Process:
    """Three cells in a row; a step to the right out of the last one pays 1 and ends the episode.

    Action 0 goes right, or stays with the probability ``stays``; action 1 stays.
    """
    chance = np.zeros((3, 2, 3))
    chance[[0, 1], 0, [1, 2]] = 1.0 - stays
    chance[range(3), 0, range(3)] += stays
    chance[range(3), 1, range(3)] = 1.0
    reward = np.zeros((3, 2))
    reward[2, 0] = 1.0 - stays
    return Process(chance, reward)


def to_the_last(action: int = 0) -> Option:
    """Goes on in the first two cells, and stops in the last."""
    return Option(np.full(3, action), EVERYWHERE, np.array([True, True, False]))


def test_the_model_of_a_corridor_is_known_by_hand():
    model = model_of(corridor(), [to_the_last()], gamma=0.5)
    # Two steps from the first cell, one from the second; from the last, one step ends it all.
    np.testing.assert_allclose(model.reward[:, 0], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(model.after[:, 0], [[0, 0, 0.25], [0, 0, 0.5], [0, 0, 0]])
    np.testing.assert_allclose(optimal(model)[:, 0], [0.25, 0.5, 1.0])


def test_a_step_that_may_fail_is_a_geometric_series():
    model = model_of(corridor(stays=0.5), [to_the_last()], gamma=0.8)
    # Σ (0.8·0.5)ᵏ = 0.4 / 0.6 for each cell that is to be left; in the last, a call is one step.
    left = 0.4 / 0.6
    np.testing.assert_allclose(model.after[:, 0, 2], [left**2, left, 0.4])
    np.testing.assert_allclose(model.reward[:, 0], [0, 0, 0.5])
    # V(last) = 0.5 + 0.4·V(last)
    np.testing.assert_allclose(optimal(model)[:, 0], np.array([left**2, left, 1.0]) * (0.5 / 0.6))


def test_the_value_of_a_policy_and_the_best_value_of_two_states():
    # Skill 0 is a step to the right, skill 1 stays; γ = 0.5, each with probability 1/2:
    # V(2) = 1/2·1 + 1/2·0.5·V(2) = 2/3, V(1) = 1/2·0.5·V(2) + 1/2·0.5·V(1) = 2/9.
    step, stay = (Option(np.full(3, a), EVERYWHERE, NOWHERE) for a in (0, 1))
    model = model_of(corridor(), [step, stay], gamma=0.5)
    value = value_of(model, np.full((3, 2), 0.5))
    np.testing.assert_allclose(value, [2 / 27, 2 / 9, 2 / 3])
    np.testing.assert_allclose(optimal(model), [[0.25, 0.125], [0.5, 0.25], [1.0, 0.5]])


def test_a_skill_that_may_not_start_has_no_value():
    step = Option(np.zeros(3, int), np.array([True, False, True]), NOWHERE)
    stay = Option(np.ones(3, int), EVERYWHERE, NOWHERE)
    best = optimal(model_of(corridor(), [step, stay], gamma=0.5))
    np.testing.assert_allclose(best, [[0, 0], [-np.inf, 0], [1.0, 0.5]])


def test_the_rooms_are_those_of_the_paper():
    assert len(PLACES) == 104
    skills = SETS["H"]()
    assert sorted(s.room.sum() for s in skills) == [20, 20, 25, 25, 25, 25, 30, 30]
    starts = np.stack([s.starts for s in skills], 1)
    assert (starts.sum(1) == 2).all()  # two skills in each room, and in each hallway
    first = skills[0]
    assert first.name == "upper_left_to_north"
    assert (first.starts[NORTH], first.starts[EAST], first.starts[CORNER]) == (False, False, True)
    # A shortest path from the corner: 2 down and 5 to the right, and the last step is in the door.
    cell, path = CORNER, 0
    while first.room[cell]:
        cell, path = AFTER[cell, first.moves[cell]], path + 1
    assert (cell, path) == (NORTH, 7)


def test_the_environment_moves_as_the_exact_process_says():
    process, env = process_of(G1), FourRooms(G1)
    env.reset(seed=0)
    above = PLACES.index((6, 9))
    np.testing.assert_allclose(process.reward[above] * 9, [1, 1, 6, 1])
    for cell, action in ((CORNER, 1), (NORTH, 0), (above, 2)):
        met, paid, n = np.zeros(len(PLACES)), 0.0, 4_000
        for _ in range(n):
            env.cell = cell
            after, reward, there, _, _ = env.step(action)
            met[after] += not there
            paid += reward
        right = np.append(process.chance[cell, action], process.reward[cell, action])
        found = np.append(met, paid) / n
        assert (np.abs(found - right) <= 5.0 * np.sqrt(right * (1.0 - right) / n)).all()


@pytest.mark.slow
@pytest.mark.parametrize(("goal", "which"), [(G1, "H"), (G2, "A+H")])
def test_decisions_have_the_exact_multi_time_model(goal, which):
    """Means of Σ γᵏ rₖ and of γ^τ by successor, whose variances are known exactly, too."""
    skills = SETS[which]()
    config = dataclasses.replace(VALUES, num_envs=1_024)
    collector, _ = collector_of(skills, config, goal)
    collector.start(Seeds(3))
    counted = Counted(len(skills))
    for i in range(4):
        request = Request(100, (), np.array([GAMMA]), Seeds(3) / i, at_random=True)
        found = collector.collect(request).batches[""]
        counted.add(found)
        assert found.get("mask") is not None
    model = exact(goal, skills)
    calls, here = counted.calls, np.arange(len(PLACES)) != goal
    assert not calls[~model.allowed].any()
    assert calls[model.allowed & here[:, None]].min() >= 20
    # Rewards come at the end of a call, so those of γ² are the second moments of those of γ.
    squares = exact(goal, skills, GAMMA**2)
    counts = counted.model()
    for mean, first, second in (
        (counts.reward, model.reward, squares.reward),
        (counts.after, model.after, squares.after),
    ):
        n = calls.reshape(*calls.shape, *[1] * (first.ndim - 2))
        error, variance = mean - first, (second - first**2) / np.maximum(n, 1)
        never = second < 1e-12
        assert not mean[never].any()
        # Of all, weighted by calls: what is wrong everywhere by a little is seen here.
        total = (n * error)[~never & (n > 0)].sum()
        spread = np.sqrt((n**2 * variance)[~never & (n > 0)].sum())
        assert abs(total) < 4.0 * spread
        likely = ~never & (n * second > 25)
        z = error[likely] / np.sqrt(variance[likely])
        assert np.abs(z).max() < 5.0
        assert np.mean(z**2) == pytest.approx(1.0, abs=0.3)


def test_options_are_read_from_the_skills():
    for skill in SETS["A+H"]():
        option = option_of(skill)
        assert (option.goes_on <= option.starts).all()
        cells = np.arange(len(PLACES))
        np.testing.assert_array_equal(skill.policy(cells), option.action)
        np.testing.assert_array_equal(skill.initiation(cells), option.starts)
