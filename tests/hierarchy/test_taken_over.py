"""What a hierarchy takes over from a run, what it refuses, and what it tells."""

import json
from dataclasses import replace

import numpy as np
import pytest
from declaring import plainly
from small_runs import (
    ON,
    Balance,
    Left,
    Left as SmallLeft,
    Push,
    assert_same,
    interrupted,
)

from skillweave import Agent, EnvSpec, Hierarchy, Reflex, SkillweaveError
from skillweave.evolution import Evolution
from skillweave.runs.directory import RunDirectory

pytestmark = pytest.mark.filterwarnings("ignore:Overwriting")


def leans(obs):
    return obs[:, 2] > 0.1


def declare(**how):
    options = {
        "env": EnvSpec("CartPole-v1", engine="sync", workers=1),
        "skills": [Left(), Balance(), Push()],
        "call_steps": 6,
        "algorithm": ON,
        "selector": ON,
        "skill_steps": 200,
        "selector_steps": 200,
        "checkpoint_every": 100,
    }
    return Hierarchy(**plainly(options | how))


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    path = tmp_path_factory.mktemp("done") / "run"
    declare(reflexes=[Reflex(leans, 1, "tilt")]).train(path, seed=3, quiet=True)
    return path


def nested(call_steps, inner_steps):
    inner = declare(skills=[Left(), Push()], call_steps=inner_steps)
    skill = inner.as_skill("inner", max_steps=20)
    return declare(skills=[Balance(), skill], call_steps=call_steps)


def test_a_hierarchy_that_loads_a_run_stays_as_it_was_declared(tmp_path):
    nested(6, 3).train(tmp_path / "run", quiet=True)
    mine = nested(9, 5)
    with pytest.warns(match=r"call_steps is 6 .declared now: 9., call_steps of 'inner' is 3"):
        found = mine.load(tmp_path / "run").declaration
    assert found.call_steps == 6
    assert found.skills[1].policy.call_steps == 3
    assert mine.call_steps == 9
    assert mine.skills[1].policy.call_steps == 5
    assert mine.resume(tmp_path / "run", quiet=True).declaration.call_steps == 6
    assert mine.call_steps == 9
    mine.skills[0].steps = 200
    with pytest.warns(match="call_steps is 6"):
        mine.load(tmp_path / "run").declaration.scale(0.5)
    assert mine.skills[0].steps == 200, "it shares no skills"


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({}, "with the reflexes tilt, but this hierarchy has no reflexes"),
        ({"reflexes": [Reflex(leans, 1, "other")]}, "this hierarchy has the reflexes other"),
    ],
)
def test_other_reflexes_are_refused(done, how, says):
    for use in (declare(**how).load, declare(**how).resume):
        with pytest.raises(SkillweaveError, match=says):
            use(done)


def test_an_environment_that_was_made_otherwise_is_refused(tmp_path):
    def made(told):
        return Agent(EnvSpec("CartPole-v1", {"sutton_barto_reward": told}, engine="sync"), ON, 100)

    made(True).train(tmp_path / "run", quiet=True)
    made(True).load(tmp_path / "run")
    for use in (made(False).load, made(False).resume):
        with pytest.raises(SkillweaveError, match=r"made with .*True.*, but .*False.*evaluate\("):
            use(tmp_path / "run")


EVOLVE = Evolution(population=2, generations=2, episodes=2)


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize(
    ("first", "then", "says"),
    [
        ({}, {}, ""),
        (
            {},
            {"algorithm": replace(ON, gamma=0.9), "skill_steps": 300},
            "left.algorithm.gamma is 0.995 (declared now: 0.9)",
        ),
        ({}, {"call_steps": 7}, "call_steps is 6 (declared now: 7)"),
        ({}, {"start_calls": 3}, "start_calls is none (declared now: 3)"),
        ({}, {"episode_calls": 3}, "episode_calls is 1 (declared now: 3)"),
        ({}, {"deliberation_cost": 0.5}, "deliberation_cost is 0 (declared now: 0.5)"),
        ({"evolve": {"left": EVOLVE}}, {}, ""),
    ],
)
def test_settings_that_differ_are_told_where_a_run_goes_on(tmp_path, capsys, first, then, says):
    with interrupted(1):
        declare().train(tmp_path / "run", seed=3, **first)
    capsys.readouterr()
    run = declare(**then).resume(tmp_path / "run")
    told = "".join(capsys.readouterr())
    assert ("continues with its own settings" in told) == bool(says)
    assert says in told
    assert run.info()["stages"][0]["algorithm"]["gamma"] == ON.gamma
    assert run.hierarchy.selection.deliberation_cost == 0.0
    assert RunDirectory.open(tmp_path / "run").finished


def test_a_cost_of_calls_below_that_differs_is_told(tmp_path, capsys):
    def whole(cost):
        inner = declare(skills=[Left(), Push()], deliberation_cost=cost, name="inner")
        return declare(skills=[Balance(), inner])

    with interrupted(1):
        whole(0.0).train(tmp_path / "run", quiet=True)
    capsys.readouterr()
    whole(0.5).resume(tmp_path / "run")
    told = "".join(capsys.readouterr())
    assert "skills.inner.hierarchy.deliberation_cost is 0 (declared now: 0.5)" in told


def test_what_is_told_to_count_is_what_counts(tmp_path, monkeypatch, capsys):
    class Left(SmallLeft):
        pass

    whole = declare(skills=[Left(), Balance()], deliberation_cost=0.5)
    whole.train(tmp_path / "whole", seed=3, quiet=True)
    with interrupted(1):
        whole.train(tmp_path / "run", seed=3, quiet=True)
    monkeypatch.setattr(Left, "max_steps", 4)
    monkeypatch.setattr(Left, "call_steps", 3)
    capsys.readouterr()
    other = declare(skills=[Left(), Balance()], deliberation_cost=0.1)
    other.resume(tmp_path / "run")
    told = "".join(capsys.readouterr())
    assert "skills.left.max_steps is 15 (declared now: 4)" in told
    assert "deliberation_cost is 0.5 (declared now: 0.1)" in told
    assert (other.skills[0].max_steps, other.selection.deliberation_cost) == (4, 0.1)
    assert_same(tmp_path / "run", tmp_path / "whole")


def test_a_recipe_is_not_asked_for_what_the_command_line_changed(tmp_path, capsys):
    one, other = declare(skill_steps=300), declare()
    one.recipe = other.recipe = "mine.py"
    with interrupted(1):
        one.train(tmp_path / "run")
    capsys.readouterr()
    other.resume(tmp_path / "run")
    assert "own settings" not in "".join(capsys.readouterr())


@pytest.mark.slow
def test_a_run_without_its_code_tells_of_no_settings(tmp_path, capsys):
    agent = Agent("CartPole-v1", ON, 300, target_return=1e6)
    with interrupted(1):
        agent.train(tmp_path / "run", checkpoint_every=100, eval_every=100)
    capsys.readouterr()
    path = tmp_path / "run"
    Agent.from_manifest(json.loads((path / "run.json").read_text())).resume(path)
    assert "own settings" not in "".join(capsys.readouterr())


def test_ctrl_c_says_how_far_it_is_saved_and_how_to_go_on(tmp_path, monkeypatch):
    path = tmp_path / "run"
    with interrupted(1) as stop:
        declare().train(path, seed=3)
    line = f'hierarchy.train("{path}", seed=3, resume=True)'
    assert str(stop.value) == f"saved at 128 steps of left. Continue: {line}"

    def stop_at_once(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("skillweave.training.stage_log.StageLog.tick", stop_at_once)
    with pytest.raises(
        KeyboardInterrupt, match=r"^saved at 128 steps of left\. Continue: hierarchy"
    ):
        declare().resume(path)
    with pytest.raises(KeyboardInterrupt, match=r"^saved at the start\. Continue: hierarchy"):
        declare().train(tmp_path / "other")


NO_COLORS = [
    "red", (1, 2), (1, 2, 300), (0.1, 0.2, 0.3), 7, [[1], [1, 2]], [1, [2, 3], 4], np.array(7)
]  # fmt: skip


def test_a_color_is_a_row_of_any_kind():
    def painted(color):
        return declare(skills=[type("Painted", (Left,), {"color": color})()])

    for color in ((1, 2, 3), [255, 0, 0], np.array([1, 2, 3], np.uint8)):
        assert painted(color).skills[0].color is color
    for color in NO_COLORS:
        with pytest.raises(SkillweaveError, match=r"'painted' .*color is .*red, green and blue"):
            painted(color)
