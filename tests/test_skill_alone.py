"""``evaluate(skill=)``: a skill alone, by the task's reward and by its own reward and success."""

import json

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave.cli import main

GOAL = 4


class Corridor(gym.Env):
    """Walk to the right, a cell a step, from a random cell; an episode has ten steps."""

    observation_space = gym.spaces.Box(-20, 20, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = int(self.np_random.integers(-2, 3)), 0
        return np.array([self.x], np.float32), {}

    def step(self, action):
        self.x, self.t = self.x + (1 if action else -1), self.t + 1
        return np.array([self.x], np.float32), 0.25, False, self.t == 10, {}


def right(obs):
    return np.ones(len(obs), np.int64)


class Reach(sw.Skill):
    """Go to the goal, and stop there."""

    policy = right

    def reward(self, step):
        return step.next_obs[:, 0] - step.obs[:, 0] - 2.0

    def termination(self, step):
        return step.next_obs[:, 0] >= GOAL

    def success(self, step):
        return step.next_obs[:, 0] == GOAL


class Short(Reach):
    max_steps = 3


class Later(Reach):
    def initiation(self, obs):
        return obs[:, 0] >= 1


class Nowhere(Reach):
    def initiation(self, obs):
        return obs[:, 0] > 1000


class Plain(sw.Skill):
    policy = right


SKILLS = [Reach(), Short(), Later(), Nowhere(), Plain()]


def first(obs, last):
    return np.zeros(len(obs), np.int64)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    class Learns(sw.Skill):
        max_steps = 4

        def reward(self, step):
            return -np.abs(step.next_obs[:, 0])

    settings = sw.PPO(num_envs=2, n_steps=8)
    declared = sw.Hierarchy(
        Corridor, [*SKILLS, Learns()], selector=first, algorithm=settings, steps=16, call_steps=2
    )
    return declared.train(tmp_path_factory.mktemp("alone") / "run", quiet=True)


def starts(episodes):
    """The first cells of an evaluation's episodes."""
    env = Corridor()
    return np.array([env.reset(seed=1_000_000 + i)[0][0] for i in range(episodes)])


X = starts(30)
SHORT = np.minimum(3, GOAL - X).sum()
ALONE = {  # steps of all calls, the own reward, the share that succeeds, why calls end
    "reach": ((GOAL - X).sum(), -(GOAL - X).sum(), 1.0, {"own": 30}),
    "short": (SHORT, -SHORT, (X >= 1).mean(), {"own": (X >= 1).sum(), "limit": (X < 1).sum()}),
    "later": ((GOAL - np.maximum(X, 1)).sum(), None, 1.0, {"own": 30}),
    "plain": (300, 75.0, None, {"episode": 30}),
    "learns": (120, None, None, {"limit": 30}),
}


@pytest.mark.parametrize("name", ALONE)
def test_each_episode_has_a_call_from_where_the_skill_may_start_to_its_own_end(run, name):
    """``call_steps`` of the hierarchy is the selector's; without a reward it is the task's."""
    steps, own, rate, ended = ALONE[name]
    found = run.evaluate(30, skill=name, quiet=True)
    assert found.returns == (2.5,) * 30  # the task's, to the end of the episode
    assert found.lengths == (10,) * 30
    (report,) = found.skills.values()
    assert (report.calls, report.steps) == (30, steps)
    assert {k: n for k, n in report.ended.items() if n} == ended
    assert report.success_rate == (rate if rate is None else pytest.approx(rate))
    if own is None:
        assert report.return_sum < 0
    else:
        assert report.return_sum == pytest.approx(own)


def test_a_skill_that_may_start_nowhere_says_so(run):
    found = run.evaluate(3, skill="nowhere", quiet=True)
    assert found.skills["nowhere"].calls == 0
    assert found.mean == 2.5
    assert "nowhere could start nowhere by its initiation()" in str(found)
    json.dumps(found.to_json(), allow_nan=False)


def test_line_table_and_json_have_both_scores(run, capsys):
    found = run.evaluate(30, skill="short", quiet=True)
    share = f"{(X >= 1).mean():.0%}"
    own = f"{-SHORT / 30:.1f}"
    line = f"short alone: 30 calls of 3 steps, {own} by its own reward, {share} succeed"
    assert str(found).startswith("2.50")
    assert line in str(found)
    assert line in found.for_people()
    told = found.to_json()
    assert told["skill"] == "short"
    assert told["skills"]["short"]["success_rate"] == pytest.approx((X >= 1).mean())
    assert [type(v) for v in told["ci95"]] == [float, float]
    assert json.loads(json.dumps(told)) == told
    assert "skill" not in run.evaluate(3, quiet=True).to_json()


def test_the_command_line_has_both_scores(tmp_path, capsys):
    recipe = tmp_path / "recipe.py"
    recipe.write_text(
        "import numpy as np\nimport skillweave as sw\n\n\n"
        "class Up(sw.Skill):\n    max_steps = 4\n\n"
        "    def reward(self, step):\n        return 3.0 * np.ones(len(step.reward))\n\n"
        "    def success(self, step):\n        return step.next_obs[:, 0] < 9\n\n\n"
        "settings = sw.PPO(num_envs=2, n_steps=8)\n"
        'hierarchy = sw.Hierarchy("CartPole-v1", [Up()], algorithm=settings, selector=settings, '
        "steps=32)\n"
    )
    train = ["train", str(recipe), "--out", str(tmp_path / "run"), "--quiet", "--evaluate", "0"]
    assert main(train) == 0
    ask = ["evaluate", str(tmp_path / "run"), "--recipe", str(recipe), "--episodes", "3"]
    capsys.readouterr()
    assert main([*ask, "--skill", "up"]) == 0
    line = "up alone: 3 calls of 4 steps, 12.0 by its own reward, 100% succeed"
    assert line in capsys.readouterr().out
    assert main([*ask, "--skill", "up", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["skill"], told["skills"]["up"]["return_mean"]) == ("up", 12.0)
    found = sw.load(tmp_path / "run").evaluate(3, skill="up", quiet=True)
    assert found.skills["up"].return_mean is None, "without its code"
    assert "own reward" not in str(found)
    assert found.mean > 0
