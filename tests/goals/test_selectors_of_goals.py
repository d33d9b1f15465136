"""Selectors give goals: rules, automata and trees, and selectors that learn."""

import gymnasium as gym
import numpy as np
import pytest
from small_runs import goes_on
from worlds import OFF, OFTEN, ON, SELECTOR, SMALL, SPACES, Point, Rest, declared, go_to

import skillweave as sw
from skillweave.errors import DeclarationError, PolicyError, SkillError

HERE = (0.5, -0.5)
BYTES = gym.spaces.Box(0, 255, (2,), np.uint8)
BITS = gym.spaces.MultiBinary(2)
NESTED = gym.spaces.Dict({"at": gym.spaces.Box(-1, 1, (2,), np.float32), "byte": BYTES})


def toward_zero(obs):
    return -np.sign(obs) * 0.5


def right(obs):
    return obs[:, 0] > 0


READY = {
    "function": lambda obs: (np.full(len(obs), "go_to"), toward_zero(obs)),
    "function, by skill": lambda obs: (np.zeros(len(obs), int), {"go_to": toward_zero(obs)}),
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


@pytest.mark.fast_cases(2 * len(SPACE_NAMES))
@pytest.mark.parametrize("space", SPACE_NAMES)
@pytest.mark.parametrize("learn", ["apart", "together", "apart, then together"])
def test_a_selector_learns_skill_and_goal(space, learn):
    skills = [Rest(), go_to(space)]
    run = declared(skills, selector=SELECTOR, learn=learn, steps=700).train(quiet=True)
    report = run.evaluate(3)
    again = declared([Rest(), go_to(space)], selector=SELECTOR, learn=learn)
    assert sw.load(run.path, again).evaluate(3).returns == report.returns
    run.evaluate(3, deterministic=False)


@pytest.mark.fast_cases(4)
@pytest.mark.parametrize("learn", ["apart", "together"])
@pytest.mark.parametrize("space", ["box", "number", "numbers"])
def test_an_interrupted_run_ends_with_the_same_weights(learn, space, tmp_path):
    def hierarchy():
        return declared(
            [Rest(), go_to(space)], selector=SELECTOR, learn=learn, steps=1500, train_defaults=OFTEN
        )

    goes_on(hierarchy, tmp_path)


@pytest.mark.parametrize("learn", ["apart", "together"])
def test_skills_with_goals_inside(learn, tmp_path):
    def hierarchy():
        how = {"selector": SELECTOR, "learn": learn, "train_defaults": OFTEN}
        inner = declared([Rest(), go_to("number")], name="inner", **how)
        still = type("Still", (Rest,), {})()
        return declared([inner, still], steps=1500, **how)

    run = goes_on(hierarchy, tmp_path, 5)
    assert "inner/go_to" in run.evaluate(3).skills
    assert run.evaluate(2, skill="inner/go_to").skills["inner/go_to"].calls == 2


def test_chosen_lengths_and_goals():
    how = {"selector": SELECTOR, "call_steps": sw.Lengths(2, 4), "steps": 700}
    run = declared([Rest(), go_to()], **how).train(quiet=True)
    run.evaluate(3, deterministic=False)


@pytest.mark.fast_cases(6)
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
        return declared(skills, selector=selector, learn=learn, steps=900, train_defaults=OFTEN)

    whole = goes_on(hierarchy, tmp_path, 4)
    assert sw.load(whole.path, hierarchy()).evaluate(3).returns == whole.evaluate(3).returns
    hierarchy("together").train(seed=3, quiet=True)


@pytest.mark.parametrize(
    ("selector", "space", "says"),
    [
        (sw.DQN(), "box", r"selector: DQN cannot choose goals of Box.*'go_to' needs them"),
        (sw.TD3(), "number", "selector: TD3 cannot choose goals, but"),
        (sw.PPO(), "picture", "selector: PPO cannot choose goals of Box"),
    ],
)
def test_algorithms_say_which_goals_they_cannot_choose(selector, space, says):
    with pytest.raises(DeclarationError, match=says):
        declared([go_to(space)], algorithm=ON, selector=selector).check_spaces()


@pytest.mark.parametrize(
    ("selector", "says"),
    [
        (
            lambda obs: np.full(len(obs), "go_to"),
            r"chose skill 'go_to' without a goal .*return \(names, goals\)",
        ),
        (lambda obs: (np.full(len(obs), "go_to"), obs[0]), "gave goals of shape"),
        (lambda obs: (np.full(len(obs), "go_to"), obs + 9), "which is out of goal_space Box"),
        (lambda obs: (np.full(len(obs), "rest"), {"rest": obs}), "which has no goals"),
        (sw.Automaton({"a": "go_to"}, {}), r"without a goal .*write \('go_to', goal\)"),
        (sw.tree.Sequence(("go_to", (1.0, 2.0, 3.0))), "gave goals of shape"),
        (sw.Automaton({"a": ("go_to", (0.5, (0.5, 1)))}, {}), "which are no goals of Box"),
        (sw.Automaton({"a": ("go_to", lambda obs: None)}, {}), "returned None, but goals"),
    ],
)
def test_a_goal_that_is_not_right(selector, says):
    with pytest.raises(SkillError, match=says):
        evaluated(selector, SPACES["box"])


def test_goals_for_skills_without_goals():
    rule = lambda obs: (np.full(len(obs), "rest"), obs)  # noqa: E731
    with pytest.raises(SkillError, match="returned skills and goals, but no skill"):
        declared([Rest()], selector=rule).check_spaces()
    agent = sw.train_agent(Point, ON, 200, quiet=True)
    with pytest.raises(PolicyError, match="has goals, but its policy observes Box"):
        declared([go_to(policy=agent.policy)]).check_spaces()


@pytest.mark.parametrize(
    ("actions", "says"),
    [
        ([0, 1], "but skills have goals: give a dict with 'skill'.* goals for 'go_to'"),
        ({"skill": [0], "goal": {"go_to": np.zeros((2, 2))}}, r"the skills are \[0\]; .* 2 env"),
        ({"skill": [0, 2], "goal": {"go_to": np.zeros((2, 2))}}, "action 2 is no skill"),
        (
            {"skill": [0, 0], "goal": {"go_to": np.zeros((2, 3))}},
            r"shape \(2, 3\) for skill 'go_to'",
        ),
    ],
)
def test_an_environment_of_options_says_what_is_wrong(actions, says):
    env = sw.make_options_env(declared([go_to(), Rest()]).train(quiet=True), 2, 0.9)
    env.reset(seed=0)
    with pytest.raises(sw.SkillweaveError, match=says):
        env.step(actions)


def test_an_environment_of_options_does_not_change_goals():
    skill = go_to()
    type(skill).goal_space = BYTES
    run = declared([skill, Rest()], selector=sw.tree.Sequence(("go_to", (1, 2)))).train(quiet=True)
    env = sw.make_options_env(run, 2, 0.9)
    env.reset(seed=0)
    with pytest.raises(SkillError, match=r"gave the goal \[300, 1\], which is out of goal_space"):
        env.step({"skill": np.zeros(2, int), "goal": {"go_to": np.array([[1, 1], [300, 1]])}})


def test_what_goals_are_not_for_yet():
    guide = sw.Guide(sw.Automaton({"a": {("go_to", HERE), "rest"}}, {}))
    with pytest.raises(DeclarationError, match="guide: it gives a goal"):
        declared([go_to(), Rest()], selector=SELECTOR, guide=guide).check_spaces()


def test_spaces_of_goals():
    with pytest.raises(DeclarationError, match="goal_space is 3; it must be a Gymnasium space"):
        declared([type("GoTo", (sw.Skill,), {"goal_space": 3})()])
    with pytest.raises(DeclarationError, match=r"has clip_goal.., but no goals: set goal_space"):
        declared([type("GoTo", (sw.Skill,), {"clip_goal": lambda self, obs, goal: goal})()])
    graph = gym.spaces.Graph(gym.spaces.Discrete(2), None)
    with pytest.raises(DeclarationError, match=r"goal_space Graph.* is not supported"):
        declared([type("GoTo", (sw.Skill,), {"goal_space": graph})()]).check_spaces()


def skill_of(space):
    """A skill with goals of a space."""
    skill = go_to()
    type(skill).goal_space = space
    if space.shape is None:
        type(skill).reward = lambda self, step: step.goal["at"].sum(1)
        type(skill).termination = type(skill).success = lambda self, step: step.goal["at"][:, 0] > 9
    return skill


def evaluated(selector, space):
    """Evaluate a selector of a skill with goals of a space."""
    hierarchy = declared([skill_of(space), Rest()], selector=selector)
    return hierarchy.train(quiet=True).evaluate(2)


@pytest.mark.parametrize(
    ("goal", "space"),
    [((300, 300), BYTES), ((-1, 7), BYTES), ((257, 0), BITS), ((3, 2**40), SPACES["numbers"])],
)
@pytest.mark.parametrize("form", ["function", "automaton", "tree", "by function"])
def test_whole_goals_do_not_wrap_around(goal, space, form):
    selector = {
        "function": lambda obs: (["go_to"] * len(obs), np.tile(goal, (len(obs), 1))),
        "automaton": sw.Automaton({"a": ("go_to", goal)}, {}),
        "tree": sw.tree.Sequence(("go_to", goal)),
        "by function": sw.tree.Sequence(("go_to", lambda obs: np.tile(goal, (len(obs), 1)))),
    }[form]
    says = rf"gave the goal \[{goal[0]}, {goal[1]}\], which is out of goal_space .*skill 'go_to'"
    with pytest.raises(SkillError, match=says):
        evaluated(selector, space)


@pytest.mark.parametrize(
    ("byte", "says"),
    [
        ((300, 1), r"gave the goal \[300, 1\], .* of the part 'byte' of skill 'go_to'"),
        ((1.5, 1.0), "gave goals of float64 for the part 'byte' of .* are whole numbers"),
        ((1, 2, 3), "gave goals of shape"),
    ],
)
def test_parts_of_goals_do_not_change(byte, says):
    selector = sw.tree.Sequence(("go_to", {"at": (0.5, 0.5), "byte": byte}))
    with pytest.raises(SkillError, match=says):
        evaluated(selector, NESTED)


def test_goals_of_other_rows_may_be_anything():
    def rule(obs):
        goes = obs[:, 0] > 0
        goals = np.where(goes[:, None], [200, 3], -1)
        return np.where(goes, "go_to", "rest"), goals

    assert len(evaluated(rule, BYTES).returns) == 2


def test_goals_of_unequal_shapes():
    """Fixed goals are checked before training: those of all states, whichever come to pass."""
    selector = sw.Automaton({"a": ("go_to", HERE), "b": ("go_to", (1.0, 2.0, 3.0))}, {})
    with pytest.raises(SkillError, match=r"gave goals of shape \(1, 3\) for skill 'go_to'"):
        declared([go_to(), Rest()], selector=selector).check_spaces()


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
    skill = go_to("tuple") if space is None else skill_of(space)
    run = declared([skill, Rest()], selector=rule).train(quiet=True)
    player = run.player()
    player.act(np.ones(2, np.float32))
    goal = run.policy.goal_now(player.memory)
    assert all(np.allclose(goal[name], part) for name, part in wanted.items())


@pytest.mark.parametrize(
    "rule",
    [
        lambda obs: ("go_to", HERE),
        lambda obs: [("go_to", HERE) for _ in obs],
        lambda obs: (["go_to"] * len(obs), None),
        lambda obs: (["go_to"] * len(obs), obs / 4, 1),
    ],
)
def test_another_form_of_skills_and_goals(rule):
    with pytest.raises(SkillError, match=r"return \(names, goals\), one of each per environment"):
        evaluated(rule, SPACES["box"])
    with pytest.raises(
        SkillError, match=r"no skill that it selects has goals|names 'go_to'|no arr"
    ):
        declared([Rest()], selector=rule).check_spaces()


@pytest.mark.parametrize("names", [("rest", "rest"), (1, 1), (np.str_("rest"), np.str_("rest"))])
def test_a_tuple_of_two_skills_is_no_skill_with_a_goal(names):
    two = lambda obs: names if len(obs) == 2 else list(names)[:1] * len(obs)  # noqa: E731
    declared([go_to(), Rest()], selector=two).check_spaces()
