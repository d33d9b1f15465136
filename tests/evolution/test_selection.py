"""Who is parent to whom, by hand; and settings that are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skillweave import DQN, PPO, SAC
from skillweave.errors import DeclarationError, TrainingError
from skillweave.evolution import Evolution, Heir, Mutations, Range, Tournament, Truncation
from skillweave.evolution.config import evolution_from_json, evolution_to_json
from skillweave.evolution.selection import select

FITNESS = np.array([1.0, 5.0, -np.inf, 3.0, 2.0, 4.0])


def chosen(selection: Any, fitness: Any = FITNESS, seed: int = 0) -> list[Heir]:
    evolution = Evolution(population=len(fitness), selection=selection)
    return select(evolution, np.asarray(fitness), np.random.default_rng(seed))


def test_a_tournament_of_all_is_won_by_the_best_and_of_one_by_anybody_sound():
    assert chosen(Tournament(6)) == [Heir(1, False)] + [Heir(1, True)] * 5
    drawn = {h.parent for s in range(50) for h in chosen(Tournament(1, elitism=False), seed=s)}
    assert drawn == {0, 1, 3, 4, 5}


def test_tournaments_prefer_the_better_by_the_share_that_theory_says():
    heirs = [h for s in range(500) for h in chosen(Tournament(2, elitism=False), [1, 2, 3], s)]
    share = np.bincount([h.parent for h in heirs], minlength=3) / len(heirs)
    # Of the three pairs, the best wins two, the second one, the worst none.
    assert share == pytest.approx([0.0, 1 / 3, 2 / 3], abs=0.04)


def test_truncation_replaces_the_worst_by_heirs_of_the_best_and_all_others_go_on():
    heirs = chosen(Truncation(1 / 3))  # 2 and 0 go; 1 and 5 are their parents
    assert [h for i, h in enumerate(heirs) if i not in (0, 2)] == [
        Heir(1, False), Heir(3, False), Heir(4, False), Heir(5, False),
    ]  # fmt: skip
    assert heirs[0].mutates
    assert heirs[2].mutates
    parents = {chosen(Truncation(1 / 3), seed=s)[0].parent for s in range(40)}
    assert parents == {1, 5}


def test_all_that_diverged_are_replaced_whatever_the_share():
    heirs = chosen(Truncation(0.25), [-np.inf, -np.inf, 1.0, -np.inf])
    assert [h.parent for h in heirs] == [2] * 4
    assert [h.mutates for h in heirs] == [True, True, False, True]


@pytest.mark.parametrize("selection", [Tournament(), Truncation()])
def test_when_all_have_diverged_it_says_so(selection):
    with pytest.raises(TrainingError, match="every member has diverged"):
        chosen(selection, [-np.inf] * 4)


class Own:
    """A selection of the user's own: everybody descends from member ``parent``."""

    def __init__(self, parent: int = 1) -> None:
        self.parent = parent

    def select(self, fitness: Any, rng: Any) -> list[Heir]:
        return [Heir(self.parent, True) for _ in fitness]


def test_a_selection_of_ones_own_is_used_and_checked():
    assert chosen(Own()) == [Heir(1, True)] * 6
    with pytest.raises(TrainingError, match=r"Own\.select\(\) must return"):
        chosen(Own(2))
    with pytest.raises(TrainingError, match=r"Own\.select\(\) must return"):
        chosen(Own(9))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Mutations(none=0.5), "sum to 1.3"),
        (lambda: Range(1.0, 0.5), "Range.high"),
        (lambda: Range(0.0, 0.5), "Range.low"),
        (lambda: Range(0.5, 1.0, "complement"), "Range.high"),
        (lambda: Evolution(population=1), "Evolution.population is 1.*elitism"),
        (lambda: Evolution(population=3, selection=Tournament(4)), "Evolution.population is 3"),
        (
            lambda: Mutations(ranges={"learning_rate": Range(0.1, 1)}).ranges_of(SAC()),
            r"excludes the start value SAC.learning_rate = 0.001",
        ),
        (lambda: Mutations(ranges={"target_kl": Range(0.1, 1)}).ranges_of(PPO()), "= None"),
    ],
)
def test_what_cannot_be_is_refused_by_name(make, said):
    with pytest.raises(DeclarationError, match=said):
        make()


@pytest.mark.parametrize("scale", ["linear", "log", "complement"])
def test_a_range_and_its_unit_are_each_others_inverse(scale):
    within = Range(0.1, 0.9, scale)
    for value in (0.1, 0.25, 0.9):
        assert within.from_unit(within.to_unit(value)) == pytest.approx(value)
    assert within.from_unit(-3.0) == pytest.approx(0.1)
    assert within.from_unit(3.0) == pytest.approx(0.9)
    middle = {"linear": 0.5, "log": 0.3, "complement": 0.7}[scale]  # 0.1 and 0.9 have the ratio 9
    assert within.from_unit(0.5) == pytest.approx(middle)


def test_the_usual_ranges_leave_out_what_does_not_fit():
    assert "ent_coef" not in Mutations().ranges_of(PPO(ent_coef=0.0))
    assert set(Mutations().ranges_of(DQN())) == {"learning_rate", "gamma", "tau"}


@pytest.mark.parametrize("selection", [Tournament(3, False), Truncation(0.4)])
def test_json_holds_all_of_it(selection):
    ranges = {"gamma": Range(0.9, 0.999, "complement")}
    told = Evolution(5, 7, 3, 200.0, "random", selection, Mutations(units=(4, 8), ranges=ranges))
    assert evolution_from_json(evolution_to_json(told), "here") == told


def test_json_knows_a_selection_of_ones_own_by_name_only():
    told = evolution_to_json(Evolution(selection=Own()))
    with pytest.raises(DeclarationError, match="selection of your own, Own"):
        evolution_from_json(told, "run x")
    mine = Own()
    assert evolution_from_json(told, "run x", mine).selection is mine
