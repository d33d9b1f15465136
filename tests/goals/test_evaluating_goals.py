"""A skill with goals is scored, filmed and shown for one goal, or for goals that it draws."""

import json

import numpy as np
import pytest
from worlds import SPACES, Rest, declared

from skillweave.cli import main

EAST = (0.9, 0.0)


class Walk(Rest):
    """Walk to the goal, if it is in the west."""

    name = "go_to"
    goal_space = SPACES["box"]
    max_steps = 20

    def policy(self, obs, goal):
        return np.where(goal[:, :1] < 0, np.clip(5 * (goal - obs), -1, 1), 0).astype(np.float32)

    def success(self, step):
        return np.abs(step.next_obs - step.goal).max(axis=1) < 0.1


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return declared([Walk(), Rest()]).train(tmp_path_factory.mktemp("goals") / "run", quiet=True)


def test_one_goal_in_all_episodes(run):
    west = run.evaluate(6, skill="go_to", goal=(-0.5, 0.5), quiet=True)
    assert west.goals.tolist() == [[-0.5, 0.5]] * 6
    assert west.reached.tolist() == [True] * 6
    assert west.skills["go_to"].success_rate == 1
    east = run.evaluate(6, skill="go_to", goal=EAST, quiet=True)
    assert east.skills["go_to"].succeeded == int(east.reached.sum()) < 6


def test_each_episode_has_its_goal_and_its_result(run):
    score = run.evaluate(30, skill="go_to", quiet=True, num_envs=4)
    assert score.goals.shape == (30, 2)
    assert len(np.unique(score.goals, axis=0)) == 30
    in_the_west = score.goals[:, 0] < 0
    assert 0 < in_the_west.sum() < 30
    assert score.reached[in_the_west].all()
    assert not score.reached[~in_the_west].all()
    again = run.evaluate(30, skill="go_to", quiet=True, num_envs=7)
    assert np.array_equal(score.goals, again.goals)
    assert np.array_equal(score.reached, again.reached)


def test_the_command_takes_a_goal_as_json(run, tmp_path, capsys):
    recipe = tmp_path / "walks.py"
    recipe.write_text(
        "from test_evaluating_goals import Walk\nfrom worlds import Rest, declared\n\n"
        "hierarchy = declared([Walk(), Rest()])\n"
    )
    given = ["evaluate", str(run.path), "--recipe", str(recipe), "--skill", "go_to", "--json"]
    assert main([*given, "--episodes", "2", "--goal", "[-0.5, 0.5]"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["goal"] == [-0.5, 0.5]
    assert result["skills"]["go_to"]["success_rate"] == 1
    assert main([*given, "--goal", "0.5, 0.5"]) != 0
    assert "--goal 0.5, 0.5 is no JSON" in capsys.readouterr().err
