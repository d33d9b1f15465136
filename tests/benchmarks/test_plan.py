"""The benchmark of planning, on a line with two skills: cells, tables, chains."""

from __future__ import annotations

import numpy as np
import pytest
from call_logs.logs import log_of
from line_world import TINY, Line

from benchmarks.pay.results import Result
from benchmarks.plan import __main__ as command
from benchmarks.plan.cells import BY_HAND, PLANNER, SELECTOR, Cells
from benchmarks.plan.chains import InOrder, did_all
from benchmarks.plan.families import FAMILIES, Family, NewTask, in_box, share_done
from skillweave import Apart, EnvSpec, Hierarchy, Skill, SkillweaveError
from skillweave.planning import Mission

LINE = EnvSpec(Line, {"goal": -3, "first": 3, "length": 20})


class Right(Skill):
    """To the right end."""

    max_steps = 6

    def policy(self, obs):
        return np.ones(len(obs), np.int64)

    def termination(self, step):
        return step.next_obs[:, 0] == 3


class Left(Skill):
    """To the left end."""

    max_steps = 6

    def policy(self, obs):
        return np.zeros(len(obs), np.int64)

    def termination(self, step):
        return step.next_obs[:, 0] == -3


def right(obs):
    return obs[:, 0] == 3


def left(obs):
    return obs[:, 0] == -3


def nowhere(obs):
    return obs[:, 0] == 9


def declare(**how):
    settings = {"algorithm": TINY, "selector": TINY, "call_steps": None, "learn": "apart"} | how
    return Hierarchy(LINE, [Right(), Left()], **settings)


def family(event=left):
    return Family(
        name="line",
        tasks=[NewTask("there-and-back", LINE, Mission(right, event), 400, "line")],
        source=lambda: declare(selector=lambda obs: ["right"] * len(obs)),
        over=lambda task, skills, **how: declare(**how),
        planner={"gamma": 0.9},
        score=share_done,
        by_hand=lambda task: lambda obs: np.where(obs[:, 0] == 3, "left", "right"),
    )


def test_the_planner_does_the_task_and_its_result_is_kept(tmp_path):
    said = []
    cells = Cells(family(), tmp_path, 0, 4, said.append)
    task = cells.family.tasks[0]
    result = cells.run(task, PLANNER, 1)
    assert result.score == 1.0
    assert len(result.scores) == 4
    assert 0 < result.steps <= 400
    assert len(said) == 1
    assert Cells(family(), tmp_path, 0, 4, said.append).run(task, PLANNER, 1) == result
    assert len(said) == 1


def test_a_log_without_the_task_scores_nothing_and_says_why(tmp_path):
    said = []
    cells = Cells(family(nowhere), tmp_path, 0, 4, said.append)
    result = cells.run(cells.family.tasks[0], PLANNER, 1)
    assert (result.score, result.scores) == (0.0, [])
    assert "nowhere" in said[0]


@pytest.mark.slow
def test_the_rule_and_a_selector_with_as_many_steps_stand_beside_it(tmp_path):
    cells = Cells(family(), tmp_path, 0, 4, lambda text: None)
    task = cells.family.tasks[0]
    rule, trained = cells.run(task, BY_HAND), cells.run(task, SELECTOR)
    assert (rule.budget, rule.score) == (0, 1.0)
    assert trained.budget == 400
    cells.results.file("line", task.name, SELECTOR, 0).unlink()  # as if it was killed just before
    assert Cells(family(), tmp_path, 0, 4, lambda text: None).run(task, SELECTOR).scores


def test_the_table_has_a_line_for_each_agent_and_one_for_all_tasks():
    def result(task, agent, seed, score):
        return Result("line", task, agent, seed, score, 400, 400, 1.0)

    tasks = [NewTask(name, LINE, None, 400, "line") for name in ("a", "b")]
    results = [result("a", f"planner-{log}", 0, score) for log, score in ((1, 1.0), (2, 0.9))]
    results += [result("b", "planner-1", 1, 0.2), result("b", "selector", 1, 0.5)]
    lines = command.make_table(family(), tasks, results).splitlines()[2:]
    rows = [[cell.strip() for cell in line.split("|")] for line in lines]
    assert rows == [
        ["a", "planner", "400", "2", "0.95", "0.90", "2"],
        ["b", "planner", "400", "1", "0.20", "0.20", "0"],
        ["b", "selector", "400", "1", "0.50", "0.50", "0"],
        ["all", "planner", "", "3", "0.90", "0.20", "2"],
    ]


@pytest.mark.parametrize(("word", "message"), [("maze", "no family"), ("mazes/x", "no task 'x'")])
def test_an_unknown_family_or_task_is_named(word, message):
    with pytest.raises(SkillweaveError, match=message):
        command.chosen([word])


def test_every_family_is_declared():
    for make in FAMILIES.values():
        found = make()
        assert len({t.name for t in found.tasks}) == len(found.tasks)
        names = [s.name for s in found.source().skills]
        stand_in = dict.fromkeys(names, lambda obs: np.zeros(len(obs)))
        for task in found.tasks:
            over = found.over(task, stand_in, apart=Apart(selector_steps=1000))
            assert over.total_steps == 1000
            assert over.spec.name == task.env.name


def test_boxes_are_those_of_the_legs():
    obs = np.array([[-0.5, 0.75], [-0.34, 0.75], [0.0, 0.6]], np.float32)
    assert in_box("left")(obs).tolist() == [True, False, False]
    assert in_box("hover")(obs).tolist() == [False, False, True]


def test_a_chain_is_done_where_each_call_did_its_leg():
    box = [-0.5, 0.75], [0.5, 0.75]

    def episode(*ends):
        calls = [(choice, [place], False, "own") for choice, place in ends]
        return [0.0, 1.4], calls

    skills = ("hover", "go_left", "go_right")
    log = log_of(
        skills,
        [
            episode((1, box[0]), (2, box[1])),
            episode((1, box[0]), (2, box[0])),
            episode((2, box[1]), (1, box[0])),
            episode((1, box[0])),
        ],
        size=2,
    )
    assert did_all(log, ("go_left", "go_right"), 4).tolist() == [True, False, False, False]


def test_skills_are_called_in_their_order_where_they_may_start():
    selector = InOrder([1, 2])
    memory = selector.start(2)
    mask = np.array([[True, True, True], [True, False, True]])
    first, memory = selector.act(memory, np.zeros((2, 1)), mask)
    second, memory = selector.act(memory, np.zeros((2, 1)))
    third, _ = selector.act(memory, np.zeros((2, 1)))
    assert (first.tolist(), second.tolist(), third.tolist()) == ([1, 0], [2, 2], [2, 2])
