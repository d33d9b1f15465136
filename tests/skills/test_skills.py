import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from skillweave.skills import Reflex, Skill, apply_reflexes, checked
from skillweave.types import SkillweaveError, Step


def step(n: int = 3) -> Step:
    zeros, never = np.zeros(n), np.zeros(n, bool)
    return Step(zeros, zeros, zeros, np.arange(n) * 1.0, never, never, never, zeros, {})


class LandSafely(Skill):
    pass


def test_a_skill_is_named_after_its_class_unless_it_says_otherwise():
    class Hover2Land(Skill):
        pass

    class Named(Skill):
        name = "touch-down"

    assert (LandSafely.name, Hover2Land.name, Named.name) == (
        "land_safely",
        "hover2_land",
        "touch-down",
    )


def test_by_default_a_skill_is_the_task_itself():
    skill = LandSafely()
    assert skill.reward(step()).tolist() == [0, 1, 2]
    assert skill.initiation(np.zeros((3, 8))).tolist() == [True] * 3
    assert skill.termination(step()).tolist() == [False] * 3
    assert skill.success(step()).tolist() == [False] * 3
    assert not any(skill.defines(m) for m in Skill.methods)
    skill.validate()


def test_a_skill_knows_which_methods_it_defines_also_by_inheritance():
    class Base(Skill):
        def termination(self, step):
            return step.reward > 1

    class Derived(Base):
        pass

    assert [m for m in Skill.methods if Derived().defines(m)] == ["termination"]


@pytest.mark.parametrize(
    ("attribute", "value", "says"),
    [
        ("name", "", "set the class attribute 'name'"),
        ("name", "../secret", "names files"),
        ("name", "a b", "names files"),
        ("name", "x" * 65, "at most 64"),
        ("max_steps", 0, "max_steps is 0"),
        ("max_steps", 2.5, r"max_steps is 2\.5"),
        ("steps", -1, "steps is -1"),
    ],
)
def test_a_wrong_declaration_names_the_class_and_the_field(attribute, value, says):
    skill = LandSafely()
    setattr(skill, attribute, value)
    with pytest.raises(SkillweaveError, match=f"LandSafely.*{says}"):
        skill.validate()


OBS = np.array([[0.0], [1.0], [2.0]])


def test_a_reflex_overrides_the_action_where_it_holds_and_leaves_its_argument_alone():
    action = np.array([5, 5, 5])
    overridden, holds = Reflex(lambda obs: obs[:, 0] > 0, 0).apply(OBS, action, Discrete(6))
    assert (overridden.tolist(), holds.tolist()) == ([5, 0, 0], [False, True, True])
    assert action.tolist() == [5, 5, 5]


def test_a_reflex_may_compute_its_actions_from_the_observations_where_it_holds():
    reflex = Reflex(lambda obs: obs[:, 0] > 0, lambda obs: 10 * obs)
    overridden, _ = reflex.apply(OBS, np.full((3, 1), 5.0), Box(-50, 50, (1,)))
    assert overridden.tolist() == [[5], [10], [20]]


def test_the_last_reflex_wins():
    reflexes = (Reflex(lambda o: o[:, 0] > 0, 1), Reflex(lambda o: o[:, 0] > 1, 2))
    assert apply_reflexes(reflexes, OBS, np.zeros(3, int), Discrete(3)).tolist() == [0, 1, 2]


def test_a_reflex_is_named_after_its_condition():
    def leg_touches(obs):
        return obs[:, 0, 0]

    assert Reflex(leg_touches, 0).name == "leg_touches"
    assert Reflex(leg_touches, 0, name="off").name == "off"
    reflex = Reflex(lambda obs: np.zeros(2, bool), 0, name="leg_touches")
    with pytest.raises(
        SkillweaveError, match=r"'leg_touches': condition\(\) returned shape \(2,\)"
    ):
        reflex.apply(OBS, np.zeros(3, int), Discrete(2))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_names_who_what_when_and_where(bad):
    with pytest.raises(
        SkillweaveError, match=rf"skill x: reward\(\).*{bad} at step 7.*environment 1"
    ):
        checked([0.0, bad], 2, np.float32, "skill x", "reward", 7)


@pytest.mark.filterwarnings("ignore:overflow")
def test_a_number_too_large_for_float32_is_not_finite_either():
    with pytest.raises(SkillweaveError, match=r"skill x: reward\(\)"):
        checked([0.0, 1e300], 2, np.float32, "skill x", "reward", 7)


@pytest.mark.parametrize("bad", [0.0, np.zeros(3), np.zeros((2, 1))], ids=["()", "(3,)", "(2, 1)"])
def test_a_wrong_shape_is_named(bad):
    with pytest.raises(SkillweaveError, match=r"reward\(\) returned shape \(.*at step 7.*\(2,\)"):
        checked(bad, 2, np.float32, "skill x", "reward", 7)


def test_numbers_are_cast():
    assert checked([1, 0], 2, np.float32, "", "").dtype == np.float32
    assert checked([1, 0], 2, bool, "", "").tolist() == [True, False]
