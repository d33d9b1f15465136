import dataclasses

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from skillweave._internal.messages import short
from skillweave.errors import SkillweaveError
from skillweave.policies.spaces import space_of
from skillweave.skills import Reflex, Skill, call_method, from_function
from skillweave.skills.outputs import checked
from skillweave.types import Step


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
    base = type("Base", (Skill,), {"termination": lambda self, step: step.reward > 1})
    derived = type("Derived", (base,), {})()
    assert [m for m in Skill.methods if derived.defines(m)] == ["termination"]


OBS = np.array([[0.0], [1.0], [2.0]])


def test_a_reflex_overrides_the_action_where_it_holds_and_leaves_its_argument_alone():
    action = np.array([5, 5, 5])
    space = space_of(Discrete(6))
    reflex = Reflex(lambda obs: obs[:, 0] > 0, 0).override(space)
    overridden, holds = reflex.apply(OBS, action, space)
    assert (overridden.tolist(), holds.tolist()) == ([5, 0, 0], [False, True, True])
    assert action.tolist() == [5, 5, 5]


def override(reflex, space):
    acts = space_of(space)
    reflex.override(acts).apply(OBS, acts.start(3), acts)


def test_a_reflex_is_named_after_its_condition():
    def leg_touches(obs):
        return obs[:, 0, 0]

    assert Reflex(leg_touches, 0).name == "leg_touches"
    assert Reflex(leg_touches, 0, name="off").name == "off"
    reflex = Reflex(lambda obs: np.zeros(2, bool), 0, name="leg_touches")
    with pytest.raises(
        SkillweaveError, match=r"'leg_touches': condition\(\) returned shape \(2,\)"
    ):
        override(reflex, Discrete(2))


@pytest.mark.filterwarnings("ignore:overflow")
def test_numbers_are_cast_and_bounded():
    assert checked([1, 0], 2, np.float32, "").dtype == np.float32
    assert checked([1, 0], 2, bool, "").tolist() == [True, False]
    with pytest.raises(SkillweaveError, match=r"skill x: reward\(\)"):  # not finite as a float32
        checked([0.0, 1e300], 2, np.float32, "skill x: reward()", 7)
    for bad in (2e15, -1e33):  # too large to be squared
        says = r"skill x: reward\(\).*environment 1.*at most 1e\+15"
        with pytest.raises(SkillweaveError, match=says):
            checked([1e15, bad], 2, np.float32, "skill x: reward()", 7)


# What users return -----------------------------------------------------------------------------


def step_of(last: int = 2) -> Step:
    n, elapsed = 2, np.full(2, last)
    never = np.zeros(n, bool)
    obs, action = np.zeros((n, 1)), np.zeros(n, int)
    reward = np.ones(n, np.float32)
    goal = np.zeros((n, 2))
    return Step(obs, action, obs.copy(), reward, never, never, never, elapsed, {}, goal)


def test_zeros_and_ones_of_any_kind_are_yes_and_no():
    for kind in (list, np.float32, bool, np.uint8):

        def termination(self, step, kind=kind):
            even = step.obs[:, 0] == 0
            return [int(x) for x in even] if kind is list else even.astype(kind)

        skill = type("Fine", (Skill,), {"termination": termination})()
        step = dataclasses.replace(step_of(), obs=np.array([[0.0], [1.0]]))
        found = call_method(skill, "termination", step)
        assert (found.dtype, found.tolist()) == (bool, [True, False])


def test_an_error_of_a_skill_is_told_with_its_step_and_line_and_is_its_cause():
    class Divides(Skill):
        def reward(self, step):
            return 1 // int(step.action[0])

    says = r"skill 'divides': reward\(\) raised ZeroDivisionError.*\(test_skills.py, line \d+\) at "
    with pytest.raises(SkillweaveError, match=f"{says}step 4") as raised:
        call_method(Divides(), "reward", step_of(4))
    assert isinstance(raised.value.__cause__, ZeroDivisionError)


ARRAYS = [f.name for f in dataclasses.fields(Step) if f.name != "info"]


@pytest.mark.parametrize("name", ARRAYS)
def test_a_skill_cannot_change_what_others_see(name):
    class Writes(Skill):
        def reward(self, step):
            getattr(step, name)[...] = 0
            return step.reward

    step = step_of()
    with pytest.raises(SkillweaveError, match=r"reward\(\) raised ValueError.*change a copy"):
        call_method(Writes(), "reward", step)
    elapsed = np.ones(2, np.int64)
    step = dataclasses.replace(step, elapsed=elapsed)
    elapsed += 1  # by its owner
    assert step.elapsed.tolist() == [2, 2]


@pytest.mark.parametrize("function", ["initiation", "condition", "policy"])
def test_observations_cannot_be_changed_either(function):
    def write(obs):
        obs[:] = 0
        return np.zeros(len(obs), bool)

    skill = type("Writes", (Skill,), {"initiation": lambda self, obs: write(obs)})()
    call = {
        "initiation": lambda obs: call_method(skill, "initiation", obs),
        "condition": lambda obs: Reflex(write, 0).holds(obs),
        "policy": lambda obs: from_function(write).act({}, obs),
    }[function]
    obs = OBS.copy()
    with pytest.raises(SkillweaveError, match="change a copy"):
        call(obs)
    assert obs.tolist() == OBS.tolist()


@pytest.mark.parametrize(
    ("action", "space", "says"),
    [
        ("up", Discrete(4), "whole numbers"),
        ([0.0, 1.0], Box(-1, 1, (3,)), r"shape \(1, 2\), but \(1, 3\)"),
        ([[0], [1, 2]], Box(-1, 1, (2,)), "no array"),
        (np.nan, Box(-1, 1, (1,)), "NaN"),
        (lambda obs: np.full(len(obs), 9), Discrete(4), r"action\(\) returned 9"),
        (lambda obs: np.zeros(1, int), Discrete(4), r"action\(\) returned shape \(1,\)"),
        (lambda obs: obs["x"], Discrete(4), r"action\(\) raised IndexError"),
    ],
)
def test_a_wrong_action_of_a_reflex_is_told(action, space, says):
    reflex = Reflex(lambda obs: obs[:, 0] > 0, action, "tilted")
    with pytest.raises(SkillweaveError, match=f"reflex 'tilted': .*{says}|{says}"):
        override(reflex, space)
    if not callable(action):
        with pytest.raises(SkillweaveError, match="reflex 'tilted'"):
            reflex.override(space_of(space))


# Words of messages -----------------------------------------------------------------------------


def test_long_values_are_shortened_and_what_cannot_be_shown_is_named():
    assert short("x" * 10_000, 20) == "'xxxxxxxxx ... xxxxxxxxx'"
    assert short([1, 2]) == "[1, 2]"

    class Shy:
        def __repr__(self):
            raise RuntimeError

    assert short(Shy()) == "a Shy"
