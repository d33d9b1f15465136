"""Wrong goals are named, a goal that nothing reads is said, and goals are shown."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from worlds import ON, SMALL, SPACES, GoTo, Point, Rest, declared, go_to

import skillweave as sw
from skillweave.errors import PolicyError, RunError, SkillError
from skillweave.evolution import Evolution
from skillweave.skills.goal_spaces import draw_from, shown_goal, with_goal
from skillweave.skills.goals import goals_of
from skillweave.spaces import obs_dtype


def test_a_reward_that_ignores_the_goal_is_said(capsys):
    class Blind(sw.Skill):
        name = "go_to"
        goal_space = SPACES["box"]
        max_steps = 5

        def reward(self, step):
            return step.next_obs[:, 0]

    declared([Blind()], steps=64).train()
    said = capsys.readouterr()
    assert "none reads step.goal" in said.out + said.err
    declared([go_to()], steps=64).train()
    said = capsys.readouterr()
    assert "none reads step.goal" not in said.out + said.err


class Walk(Rest):
    name = "go_to"
    goal_space = SPACES["box"]

    def policy(self, obs, goal):
        return np.clip(goal - obs, -1, 1)


ZERO = np.zeros(2, np.float32)


@pytest.fixture(scope="module")
def walks():
    return declared([Walk()]).train(quiet=True)


def test_a_player_takes_a_goal_and_keeps_its_own(walks):
    goal = np.array([0.5, -0.5], np.float32)
    player = walks.player(skill="go_to", goal=goal)
    goal[:] = 0.1
    assert np.allclose(player.act(ZERO), (0.5, -0.5))
    player.reset()
    assert np.allclose(player.act(ZERO), (0.5, -0.5))
    player.reset(goal=(0.25, 0.0))
    assert np.allclose(player.act(ZERO), (0.25, 0.0))
    for refused in ((5, 5), (1, 2, 3), "x", (0.1, (0.2, 0.3)), {"at": 1}, np.nan):
        with pytest.raises(SkillError, match="the player gave"):
            player.reset(goal=refused)
        assert np.allclose(player.act(ZERO), (0.25, 0.0)), "it is as it was"
        player.reset()


def test_a_player_never_acts_without_its_goal():
    """Whether clip_goal moves a goal into the space shows where the episode starts."""

    class Stuck(Walk):
        name = "go_to"

        def clip_goal(self, obs, goal):
            return np.where(obs[:, :1] > 0, goal.clip(-1, 1), goal)

    run = declared([Stuck()]).train(quiet=True)
    player = run.player(skill="go_to", goal=(5, 5))
    for _ in range(2):
        with pytest.raises(SkillError, match=r"clip_goal\(\) gave the goal \[5.0, 5.0\]"):
            player.act(ZERO)
    assert np.allclose(player.act(np.float32([0.5, 0])), (0.5, 1))


def test_goals_beyond_the_range_of_a_policy_are_said(recwarn):
    def said(**bounds):
        class Steered(Rest):
            name = "go_to"
            goal_space = SPACES["box"]  # from -1 to 1
            policy = sw.from_torch(torch.nn.Linear(4, 2), sees=(0, 1, sw.Goal(**bounds)))

        recwarn.clear()
        declared([Steered()]).train(quiet=True)
        return [str(w.message) for w in recwarn if "Goal.low" in str(w.message)]

    assert said() == said(low=-1, high=(1, 2)) == []
    assert "skill 'go_to'" in said(low=-0.5)[0]
    assert "Goal.high (1.0, 0.5)" in said(low=-1, high=(1, 0.5))[0]


def test_policies_from_elsewhere_take_the_goal():
    torch.manual_seed(0)
    network = torch.nn.Linear(4, 2)

    class Foreign(Rest):
        name = "go_to"
        goal_space = SPACES["box"]
        policy = sw.from_torch(network, sees=(0, 1, sw.Goal()))

    run = declared([Foreign()]).train(quiet=True)
    obs, goal = np.float32([0.1, -0.2]), np.float32([0.5, -0.5])
    action = run.player(skill="go_to", goal=goal).act(obs)
    with torch.no_grad():
        expected = network(torch.from_numpy(np.concatenate([obs, goal])))
    assert np.allclose(action, expected.clamp(-1, 1), atol=1e-5)


WIDER = gym.spaces.Box(-2, 2, (2,), np.float32)


def wider(**attributes):
    return type("GoTo", (GoTo,), {"goal_space": WIDER, **attributes})()


def constant(obs):
    return np.full((len(obs), 2), 0.1)


def chosen(obs, goal):
    return constant(obs) if goal is None else constant(obs) * 0 + goal


class Called:
    def __call__(self, obs, goal=None):
        return chosen(obs, goal)


class Methods:
    def default(self, obs, goal=None):
        return chosen(obs, goal)

    def place(self, obs, goal=(0.8, 0.8)):
        return chosen(obs, goal)

    def by_name(self, obs, *, goal):
        return chosen(obs, goal)

    def later(self, obs, scale=1.0, goal=None):
        return chosen(obs, goal) * scale

    def any_number(self, *given):
        return chosen(*given)

    def any_name(self, obs, **given):
        return chosen(obs, given.get("goal"))

    def other_self(skill, obs, goal=None):
        return chosen(obs, goal)

    def by_place(self, obs, goal=None, /):
        return chosen(obs, goal)


TAKE_GOALS = {
    **{k: v for k, v in vars(Methods).items() if not k.startswith("_")},
    "function": lambda obs, goal=None: chosen(obs, goal),
    "function, later": lambda obs, scale=1.0, goal=None: chosen(obs, goal) * scale,
    "static": staticmethod(lambda obs, goal=None: chosen(obs, goal)),
    "static, other names": staticmethod(lambda o, g: chosen(o, g)),
    "object": Called(),
    "from_function": sw.from_function(lambda obs, goal=None: chosen(obs, goal)),
}


@pytest.mark.parametrize("name", TAKE_GOALS)
def test_functions_get_the_goal_where_a_parameter_takes_it(name):
    skill = go_to(policy=TAKE_GOALS[name])
    run = declared([skill]).train(quiet=True)
    player = run.player(skill="go_to", goal=(0.5, -0.5))
    assert np.allclose(player.act(ZERO), (0.5, -0.5))


def test_weights_of_another_goal_space_are_refused(tmp_path):
    run = declared().train(tmp_path / "run", quiet=True)
    says = r"was trained for goals of Box\(-1.0, 1.0.* now its goal_space is Box\(-2.0, 2.0"
    with pytest.raises(RunError, match=f"'go_to' {says}"):
        sw.load(run.path, declared([wider()]))
    before = (run.path / "run.json").read_bytes()
    with pytest.raises(RunError, match=f"'go_to' {says}"):
        declared([wider()], steps=400).train(run.path, resume=True, quiet=True)
    assert (run.path / "run.json").read_bytes() == before
    for start_from in (run.path, {"go_to": run.path}):
        with pytest.raises(RunError, match=f"'go_to' cannot start .*: it {says}"):
            declared([wider()]).train(tmp_path / "next", start_from=start_from, quiet=True)
    trained = run.policy.skills.policies[0]
    with pytest.raises(PolicyError, match=f"skill 'go_to': its policy {says}"):
        declared([wider(policy=trained)]).check_spaces()
    sw.save_policy(trained, tmp_path / "policy")
    with pytest.raises(PolicyError, match=f"skill 'go_to': its policy {says}"):
        declared([wider(policy=sw.load_policy(tmp_path / "policy"))]).check_spaces()


def test_a_selector_of_other_goals_is_refused():
    """Its skill is ready, so that only the selector has learnt."""
    small = sw.PPO(num_envs=4, n_steps=64, batch_size=16, update_epochs=2, network=ON.network)
    hierarchy = declared([go_to(policy=Walk.policy)], selector=small)
    run = hierarchy.train(quiet=True)
    other = declared([wider(policy=Walk.policy)], selector=small)
    with pytest.raises(RunError, match="'go_to' was trained for goals of"):
        sw.load(run.path, other)
    with pytest.raises(RunError, match="'go_to' was trained for goals of"):
        other.train(run.path, resume=True, quiet=True)
    with pytest.raises(RunError, match=r"'selector' cannot start .*: its actions are others here"):
        other.train(start_from=run.path, quiet=True)


@pytest.mark.parametrize("name", SPACES)
def test_goals_are_drawn_and_joined(name):
    skill = go_to(name)
    goals = goals_of(skill)
    rng = np.random.default_rng(0)
    obs = rng.normal(size=(50, 2)).astype(np.float32)
    drawn = goals.draw(obs, rng)
    assert len(drawn) == 50
    assert not np.array_equal(drawn[0], drawn[1]) or name in ("number", "bits", "numbers")
    joint = goals.join(obs, drawn)
    assert joint.dtype == obs_dtype(with_goal(Point.observation_space, skill.goal_space))
    assert np.array_equal(joint["observation"], obs)
    assert np.array_equal(joint["goal"], drawn)
    assert goals.space.flat(drawn).shape == (50, goals.space.size)
    back = goals.space.of_numbers(goals.space.flat(drawn))
    assert (back.dtype, back.tobytes()) == (drawn.dtype, drawn.tobytes())
    assert np.array_equal(
        draw_from(skill.goal_space, 9, np.random.default_rng(3)),
        draw_from(skill.goal_space, 9, np.random.default_rng(3)),
    )
    goals.fitted(obs[:2], goals.start(2), "test")


def test_captions_show_the_goal():
    assert shown_goal(np.float32([0.25, -1])) == "(0.25, -1)"
    assert shown_goal(np.int64(3)) == "3"
    assert shown_goal(np.zeros((8, 8, 3))) == "(192 numbers)"
    one = draw_from(SPACES["dict"], 1, np.random.default_rng(0))[0]
    assert shown_goal(one).startswith("(at (")


def test_the_policy_of_a_skill_with_goals_is_saved_and_loaded(tmp_path):
    pytest.importorskip("onnxruntime")
    run = declared(algorithm=ON).train(tmp_path / "run", quiet=True)
    sw.save_policy(run.policy.skills.policies[0], tmp_path / "policy")
    loaded = go_to(policy=sw.load_policy(tmp_path / "policy"))
    other = declared([loaded]).train(tmp_path / "other", quiet=True)
    obs = np.float32([0.3, -0.2])
    mine, theirs = (r.player(skill="go_to", goal=(0.5, 0.5)).act(obs) for r in (run, other))
    assert np.allclose(mine, theirs, atol=1e-5)


SELECTORS = {
    "PPO": sw.PPO(num_envs=4, n_steps=32, batch_size=16, network=SMALL),
    "DQN": sw.DQN(num_envs=4, batch_size=16, learning_starts=20, buffer_size=500, network=SMALL),
}


@pytest.mark.parametrize(
    ("stage", "learns_by"), [("go_to", "PPO"), ("selector", "PPO"), ("selector", "DQN")]
)
def test_evolution_with_goals(stage, learns_by):
    evolution = Evolution(population=2, generations=2, episodes=1)
    late = type("Late", (Rest,), {"initiation": lambda self, obs: obs[:, 0] > 0})()
    how = {"selector": SELECTORS[learns_by], "steps": 600}
    run = declared([go_to("number"), late], **how).train(
        evolve={stage: evolution}, eval_every=200, quiet=True
    )
    assert run.evaluate(2, skill="go_to").skills["go_to"].calls == 2
