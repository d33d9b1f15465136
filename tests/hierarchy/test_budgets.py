"""How the steps of a hierarchy are split, and what learns together by default."""

from __future__ import annotations

import copy
from itertools import product

import pytest

from skillweave import (
    DQN,
    PPO,
    Apart,
    Hierarchy,
    Lengths,
    Selection,
    Skill,
    SkillweaveError,
    Together,
)
from skillweave.cli.overrides import apply_overrides


class One(Skill):
    pass


class Two(Skill):
    pass


class Ready(Skill):
    @staticmethod
    def policy(obs):
        return obs[:, 0] > 0


def declare(*skills, **how) -> Hierarchy:
    return Hierarchy("CartPole-v1", skills or [One(), Two()], **how)


CASES = {
    "together": ({"steps": 900}, {"together": 900}),
    "by default, a million": ({}, {"together": 1_000_000}),
    "lengths": ({"call_steps": Lengths(4, 8), "selector": PPO()}, {"together": 1_000_000}),
    "a budget of its own": ({"together": Together(steps=50)}, {"together": 50}),
    "apart: a share for each skill, two for the selector": (
        {"steps": 400, "learn": "apart"},
        {"one": 100, "two": 100, "selector": 200},
    ),
    "apart: budgets replace their part": (
        {"steps": 400, "learn": "apart", "apart": Apart(skill_steps=7)},
        {"one": 7, "two": 7, "selector": 200},
    ),
    "both: half of the steps each": (
        {"steps": 801, "learn": "apart, then together"},
        {"one": 100, "two": 100, "selector": 200, "together": 401},
    ),
    "no skill learns": ({"skills": [Ready()], "steps": 300}, {"selector": 300}),
    "a ready selector takes none": (
        {"steps": 400, "learn": "apart", "selector": lambda obs: obs[:, 0] > 0},
        {"one": 200, "two": 200},
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_steps_are_split_as_the_hierarchy_learns(case):
    how, budgets = CASES[case]
    found = declare(*how.get("skills", ()), **{k: v for k, v in how.items() if k != "skills"})
    assert found.budgets() == budgets
    assert found.total_steps == sum(budgets.values())
    assert {s.name: s.budget for s in found.stages()} == budgets
    whole = [s for s in found.stages() if s.name in ("selector", "together")]
    assert all(s.kind == s.name for s in whole)
    assert found.plain_agent().steps == found.total_steps


PARTS = [
    {"together": Together(steps=50)},
    {"learn": "apart", "apart": Apart(skill_steps=7, selector_steps=8)},
]


@pytest.mark.parametrize("parts", PARTS)
def test_a_total_beside_all_its_parts_is_refused(parts):
    with pytest.raises(SkillweaveError, match="leave out steps"):
        declare(steps=900, **parts)
    found = declare(**parts)
    declare(steps=found.total_steps, **parts)
    found.scale(2.0)
    found.validate()
    with pytest.raises(SkillweaveError, match=r"apart\.skill_steps"):
        apply_overrides(declare(learn="apart"), ["steps=400", "apart.skill_steps=7"])
    apply_overrides(declare(learn="apart"), ["steps=400", "apart.skill_steps=100"])


@pytest.mark.parametrize("parts", [{}, *PARTS, {"learn": "apart", "apart": Apart(skill_steps=7)}])
def test_steps_set_by_name_are_the_total_and_keep_the_shares(parts):
    before, found = declare(**parts), declare(**parts)
    apply_overrides(found, ["steps=500_000"])
    assert found.total_steps == pytest.approx(500_000, abs=3)
    for name, steps in before.budgets().items():
        assert found.budgets()[name] == pytest.approx(steps * 5e5 / before.total_steps, abs=3)


def test_a_skills_own_steps_replace_its_part():
    class Long(Skill):
        steps = 1_000

    found = declare(One(), Long(), Ready(), steps=400, learn="apart")
    assert found.budgets() == {"one": 100, "long": 1_000, "selector": 200}
    own = declare(One(), Long(), learn="apart", apart=Apart(skill_steps=7, selector_steps=8))
    assert own.budgets() == {"one": 7, "long": 1_000, "selector": 8}
    found.scale(0.1)
    assert found.budgets() == {"one": 10, "long": 100, "selector": 20}
    assert Long.steps == 1_000, "scaling one declaration changed the class"
    for factor in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(SkillweaveError, match="scale"):
            found.scale(factor)


def test_a_hierarchy_below_takes_a_share_for_each_who_learns_in_it():
    inner = declare(One(), Two(), name="inner", learn="apart")
    found = declare(One(), inner, steps=700, learn="apart")
    assert found.budgets() == {
        "inner/one": 100,
        "inner/two": 100,
        "inner/selector": 200,
        "one": 100,
        "selector": 200,
    }
    inner.steps = 40
    assert found.budgets()["inner/selector"] == 20
    found.scale(0.5)
    assert (found.steps, inner.steps) == (350, 20)


def test_by_default_all_learn_together_and_skills_feel_the_task():
    (stage,) = declare().stages()
    assert stage.together == Together()
    assert stage.together.task_weight == 1.0
    assert list(stage.beside) == ["one", "two", "skill_critic"]
    assert stage.task_weights == {}
    (stage,) = declare(algorithm=DQN()).stages()
    assert list(stage.beside) == ["one", "two"], "who learns from replay does not feel it"


def test_a_skill_keeps_to_its_own_reward_where_it_says_so():
    own = type("Own", (Skill,), {"task_weight": 0.0})
    (stage,) = declare(One(), own()).stages()
    assert stage.task_weights == {"own": 0.0}
    assert stage.entry().task_weights == {"own": 0.0}
    alone = declare(own()).stages()[0]
    assert "skill_critic" not in alone.beside, "no skill needs what the critic says"
    # The weight of a hierarchy holds for the skills in it.
    how = {"policy": declare(One(), Two(), name="below"), "task_weight": 0.5}
    (stage,) = declare(One(), type("Inner", (Skill,), how)()).stages()
    assert stage.task_weights == {"inner/one": 0.5, "inner/two": 0.5}


def test_nothing_is_compared_where_nothing_is_left_open():
    def rule(obs):
        return obs[:, 0] > 0

    fixed = Selection(greedy_skills=True)
    assert not declare(selector=rule, selection=fixed).stages()[0].greedy_judged
    assert declare(selection=fixed).stages()[0].greedy_judged, "the selector's choice is open"
    assert declare(selector=rule).stages()[0].greedy_judged, "that of the skills is"


LEARN = ("together", "apart", "apart, then together")


def replaced_steps(declared: Hierarchy, steps: int) -> Hierarchy:
    """A copy with other steps."""
    other = copy.copy(declared)
    other.steps = steps
    return other


def own_budgets(learn: str, which: tuple[bool, ...], inner: str | None, ready: bool) -> Hierarchy:
    """A hierarchy, perhaps with another one in it, some of whose parts have their own steps."""
    skill_steps, selector_steps, together_steps, one_steps, inner_steps = which
    one = One()
    one.steps = 400 if one_steps else None
    skills: list[Skill | Hierarchy] = [one, Ready()]
    how: dict[str, object] = {
        "learn": learn,
        "apart": Apart(
            skill_steps=500 if skill_steps else None,
            selector_steps=600 if selector_steps else None,
        ),
        "together": Together(steps=700 if together_steps else None),
    }
    if inner is not None:
        below = Hierarchy("CartPole-v1", [Two(), Ready()], name="inner", **how | {"learn": inner})
        if inner_steps and below.budgets() != replaced_steps(below, 800).budgets():
            below.steps = 800
        skills[1] = below
    if ready:
        how["selector"] = lambda obs: obs[:, 0] > 0
    return Hierarchy("CartPole-v1", skills, **how)


@pytest.mark.fast_cases(4)
@pytest.mark.parametrize("learn", LEARN)
@pytest.mark.parametrize("inner", [None, *LEARN])
def test_steps_mean_something_where_a_part_has_none_of_its_own(learn, inner):
    seen = set()
    for which in product((True, False), repeat=5):
        declared = own_budgets(learn, which, inner, ready=which[0] != which[3])
        before = declared.budgets()
        declared = replaced_steps(declared, 7_000_000)
        changed = declared.budgets() != before
        seen.add(changed)
        if changed:
            declared.validate()
        else:
            with pytest.raises(SkillweaveError, match="all its parts have steps of their own"):
                declared.validate()
    assert seen == {True, False}
