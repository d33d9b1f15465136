"""Selectors give goals: rules, automata and trees, and selectors that learn."""

import gymnasium as gym
import numpy as np
import pytest
from small_runs import goes_on
from worlds import OFF, OFTEN, SELECTOR, SMALL, SPACES, Rest, declared, go_to

import skillweave as sw

HERE = (0.5, -0.5)
BYTES = gym.spaces.Box(0, 255, (2,), np.uint8)
NESTED = gym.spaces.Dict({"at": gym.spaces.Box(-1, 1, (2,), np.float32), "byte": BYTES})


def toward_zero(obs):
    return -np.sign(obs) * 0.5


def right(obs):
    return obs[:, 0] > 0


READY = {
    "automaton": sw.Automaton(
        {"a": ("go_to", HERE), "b": ["rest", ("go_to", toward_zero)]},
        {("a", "b"): "success", ("b", "a"): "success"},
    ),
    "tree": sw.tree.Fallback(
        sw.tree.Sequence(right, ("go_to", HERE)), ("go_to", toward_zero), "rest"
    ),
}


@pytest.mark.parametrize("name", READY)
def test_ready_selectors_give_goals(name):
    def hierarchy():
        learn = "together" if name == "tree" else "apart"
        return declared([go_to(), Rest()], selector=READY[name], learn=learn)

    run = hierarchy().train(quiet=True)
    report = run.evaluate(4)
    assert report.skills["go_to"].calls > 0
    assert sw.load(run.path, hierarchy()).evaluate(4).returns == report.returns


SPACE_NAMES = [name for name in SPACES if name != "picture"]


@pytest.mark.fast_cases(len(SPACE_NAMES))
@pytest.mark.parametrize("space", SPACE_NAMES)
@pytest.mark.parametrize("learn", ["apart", "together", "apart, then together"])
def test_a_selector_learns_skill_and_goal(space, learn):
    skills = [Rest(), go_to(space)]
    run = declared(skills, selector=SELECTOR, learn=learn, steps=700).train(quiet=True)
    report = run.evaluate(3)
    again = declared([Rest(), go_to(space)], selector=SELECTOR, learn=learn)
    assert sw.load(run.path, again).evaluate(3).returns == report.returns
    run.evaluate(3, deterministic=False)


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("learn", ["apart", "together"])
@pytest.mark.parametrize("space", ["box", "number", "numbers"])
def test_an_interrupted_run_ends_with_the_same_weights(learn, space, tmp_path):
    def hierarchy():
        how = {"learn": learn, "steps": 900, "train_defaults": OFTEN}
        how |= {"call_steps": sw.Lengths(2, 4)} if space == "box" else {}
        return declared([Rest(), go_to(space)], selector=SELECTOR, **how)

    goes_on(hierarchy, tmp_path)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("learn", ["together", "apart"])
def test_skills_with_goals_inside(learn, tmp_path):
    def hierarchy():
        how = {"selector": SELECTOR, "learn": learn, "train_defaults": OFTEN}
        inner = declared([Rest(), go_to("number")], name="inner", **how)
        still = type("Still", (Rest,), {})()
        return declared([inner, still], steps=1500, **how)

    run = goes_on(hierarchy, tmp_path, 5)
    assert "inner/go_to" in run.evaluate(3).skills
    assert run.evaluate(2, skill="inner/go_to").skills["inner/go_to"].calls == 2


@pytest.mark.fast_cases(3)
@pytest.mark.parametrize(
    "selector",
    [
        sw.DQN(**OFF, train_freq=2, network=SMALL),
        sw.DQN.rainbow(**OFF, train_freq=2, network=SMALL),
        sw.SAC(**OFF, network=SMALL),
    ],
    ids=["DQN", "Rainbow", "SAC"],
)
@pytest.mark.parametrize("space", ["number", "numbers", "bits", "whole"])
def test_a_selector_with_values_chooses_discrete_goals(selector, space, tmp_path):
    class Sometimes(Rest):
        def initiation(self, obs):
            return obs[:, 0] > 0

    def hierarchy(learn="apart"):
        skills = [Sometimes(), go_to(space)]
        return declared(skills, selector=selector, learn=learn, steps=400, train_defaults=OFTEN)

    whole = goes_on(hierarchy, tmp_path, 4)
    assert sw.load(whole.path, hierarchy()).evaluate(3).returns == whole.evaluate(3).returns
    hierarchy("together").train(seed=3, quiet=True)


def test_goals_of_other_rows_may_be_anything():
    def rule(obs):
        goes = obs[:, 0] > 0
        goals = np.where(goes[:, None], [200, 3], -1)
        return np.where(goes, "go_to", "rest"), goals

    run = declared([go_to(goal_space=BYTES), Rest()], selector=rule).train(quiet=True)
    assert len(run.evaluate(2).returns) == 2


def never(self, step):
    return step.goal["at"][:, 0] > 9


def nested():
    """A skill with goals of parts, some of whole numbers."""
    how = {"reward": lambda self, step: step.goal["at"].sum(1), "termination": never}
    return go_to(goal_space=NESTED, success=never, **how)


AT = {"at": (0.5, -0.5), "byte": (1, 2)}


def rows_of(goal, n):
    return {name: np.tile(part, (n, 1)) for name, part in goal.items()}


@pytest.mark.parametrize(
    ("goals", "space", "wanted"),
    [
        (lambda obs: rows_of(AT, len(obs)), NESTED, AT),
        (lambda obs: {"go_to": rows_of(AT, len(obs))}, NESTED, AT),
        (lambda obs: (obs / 4, np.ones(len(obs), int)), None, {"0": 0.25, "1": 1}),
    ],
    ids=["bare", "named", "tuple"],
)
def test_a_function_gives_goals_of_several_parts(goals, space, wanted):
    rule = lambda obs: (["go_to"] * len(obs), goals(obs))  # noqa: E731
    skill = go_to("tuple") if space is None else nested()
    run = declared([skill, Rest()], selector=rule).train(quiet=True)
    player = run.player()
    player.act(np.ones(2, np.float32))
    goal = run.policy.goal_now(player.memory)
    assert all(np.allclose(goal[name], part) for name, part in wanted.items())


@pytest.mark.parametrize("names", [("rest", "rest"), (1, 1), (np.str_("rest"), np.str_("rest"))])
def test_a_tuple_of_two_skills_is_no_skill_with_a_goal(names):
    two = lambda obs: names if len(obs) == 2 else list(names)[:1] * len(obs)  # noqa: E731
    declared([go_to(), Rest()], selector=two).check_spaces()
