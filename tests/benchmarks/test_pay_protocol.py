"""The protocol on two tiny tasks: all agents, results that are kept, trainings that go on."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from declaring import plainly
from line_world import TINY, Line

from benchmarks.pay import __main__ as command, agents
from benchmarks.pay.agents import CHAINS, FLAT, HIERARCHY, SHAPED, TUNED, TUNING_SEED, Bench
from benchmarks.pay.figures import draw, make_table, reported
from benchmarks.pay.flat import Flat
from benchmarks.pay.results import (
    CODE,
    Results,
    checksum,
    curve_of,
    hours,
    of_other_code,
    read,
)
from benchmarks.pay.suite import Seldom, Shaped, Suite, Task
from skillweave import EnvSpec, Hierarchy, Run, Skill, SkillweaveError, Step
from skillweave.hierarchy import select_best
from skillweave.types import Evaluation


class Right(Skill):
    """To the right."""

    max_steps = 6

    def reward(self, step):
        return (step.next_obs - step.obs)[:, 0]


class Left(Right):
    """To the left."""

    def reward(self, step):
        return -super().reward(step)


def declare(task, **how):
    options = {"call_steps": 2, "algorithm": TINY, "selector": TINY} | how
    return Hierarchy(task.env, [Right(), Left()], **plainly(options))


def ready(task, skills, **how):
    found = declare(task, **how)
    for skill in found.skills:
        skill.policy = skills[skill.name]
    return found


def suite():
    return Suite(
        name="line",
        tasks=[Task("right", spec(3), 0.5), Task("left", spec(-3), 0.5)],
        unit=1.0,
        source=lambda task: declare(task, skill_steps=128, selector_steps=256),
        further=partial(ready, selector_steps=192),
        skills=lambda: [Right(), Left()],
        flat=TINY,
        weights=({"right": 1.0, "left": 1.0}, {"right": 1.0, "left": 0.0}),
        cells=lambda obs: obs.astype(int),
        variants={"long-calls": partial(ready, selector_steps=192, call_steps=4)},
        fixed={"always-right": partial(ready, selector=lambda obs: np.zeros(len(obs), np.int64))},
        episodes=4,
    )


def spec(goal):
    return EnvSpec(lambda: Line(goal), workers=1)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    results = Results(tmp_path_factory.mktemp("pay"))
    for chain in CHAINS:
        Bench(suite(), results, seed=0).run(chain, ["right", "left"])
    return results


def test_every_agent_has_a_result_on_every_task_and_its_steps_are_counted(done):
    found = [r for r in done.all("line") if r.seed == 0]
    by_agent = Counter(r.agent for r in found)
    assert set(by_agent.values()) == {2}
    expected = {"hierarchy", "F0-flat", "F1-skill-rewards", "F2-bonus", "F3-fine-tuned"}
    assert set(by_agent) == expected | {
        "F4-random-skills",
        "F4-best-skill",
        "always-right",
        "long-calls",
    }
    assert all(len(r.scores) == 4 and np.mean(r.scores) == r.score for r in found)
    for r in done.all("line"):
        rollout = TINY.num_envs * TINY.n_steps
        assert r.budget <= r.steps < r.budget + 3 * rollout + 1
    of = {(r.agent, r.task): r.score for r in found}
    for task in ("right", "left"):  # the best skill goes to the side that pays
        assert of["F4-best-skill", task] >= of["always-right", task]
    found = reported(done.all("line"), [0])
    own = [r for r in found if (r.task, r.agent) != ("right", TUNED)]  # of F3 the first is F0's
    assert hours(found) == pytest.approx(sum(r.seconds for r in own) / 3600.0)


def test_budgets_are_equal_or_in_favour_of_the_flat_agents():
    # 128 for each of two skills and 256 for the selector, then 192.
    assert suite().steps() == [512, 192]
    assert suite().steps_flat() == [512, 192]
    assert suite().scaled(0.5).steps() == [256, 96]
    assert suite().scaled(0.5).steps_flat() == [256, 96]
    alone = replace(suite(), tasks=[suite().tasks[0], replace(suite().tasks[1], alone=True)])
    assert alone.steps_flat() == [512, 704]
    assert [t.name for t in suite().headlines] == ["right"]
    assert alone.headlines == alone.tasks


def test_what_flat_agents_learn_alone_is_fine_tuned_in_the_hierarchys_steps(tmp_path):
    alone = replace(suite(), tasks=[suite().tasks[0], replace(suite().tasks[1], alone=True)])
    Bench(alone, Results(tmp_path), seed=0).run("flat")
    budgets = {r.agent: r.budget for r in Results(tmp_path).all("line") if r.task == "left"}
    assert budgets == {FLAT: 704, TUNED: 192}


@pytest.mark.parametrize("chain", ["shaped", "bonus"])
def test_f1_and_f2_learn_the_first_task_and_those_that_are_named(tmp_path, chain):
    results = Results(tmp_path)
    Bench(suite(), results, seed=0).run(chain)
    assert {r.task for r in results.all("line")} == {"right"}
    Bench(suite(), results, seed=0).run(chain, ["left"])
    assert {r.task for r in results.all("line")} == {"right", "left"}


def test_what_is_there_is_not_run_again(done, monkeypatch):
    before = {r.task + r.agent: r for r in done.all("line")}

    def no(*args, **kwargs):
        raise AssertionError("trained again")

    monkeypatch.setattr(Hierarchy, "train", no)
    monkeypatch.setattr(Flat, "run", no)
    for chain in CHAINS:
        Bench(suite(), done, seed=0).run(chain)
    assert {r.task + r.agent: r for r in done.all("line")} == before


def test_a_result_of_other_budgets_is_not_taken_for_this_one_and_a_damaged_one_is_named(
    done, tmp_path
):
    with pytest.raises(SkillweaveError, match="give another folder with --out"):
        Bench(suite().scaled(2.0), done, seed=0).run("flat")
    folder = tmp_path / "line" / "right" / "hierarchy"
    folder.mkdir(parents=True)
    (folder / "0.json").write_text(json.dumps({"suite": "line"}))
    with pytest.raises(SkillweaveError, match=r"0\.json is damaged"):
        Results(tmp_path).all("line")


@pytest.mark.slow
def test_results_of_other_code_are_named(done, tmp_path, capsys, monkeypatch):
    results = reported(done.all("line"), [0])
    assert {r.code for r in results} == {CODE}
    assert of_other_code(results) == ""
    older = [replace(r, code="1f") if r.agent == HIERARCHY else r for r in results]
    told = of_other_code(older)
    assert told.startswith(f"2 of these {len(results)} results were made by other code")
    assert "left hierarchy 0" in told
    assert "right hierarchy 0" in told
    monkeypatch.setitem(command.SUITES, "line", suite)
    for result in older:
        Results(tmp_path).save(result)
    command.main(["line", "--only-figures", "--seeds", "0", "--out", str(tmp_path)])
    assert told in capsys.readouterr().out


def test_the_checksum_of_code_is_of_every_file_and_its_place(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "one.py").write_text("x = 1")
    first = checksum(tmp_path)
    assert checksum(tmp_path) == first
    (tmp_path / "a" / "one.py").write_text("x = 2")
    second = checksum(tmp_path)
    (tmp_path / "a" / "one.py").rename(tmp_path / "a" / "two.py")
    assert len({first, second, checksum(tmp_path)}) == 3


def test_what_is_built_on_other_code_is_of_other_code(done, tmp_path):
    shutil.copytree(done.folder, tmp_path / "pay")
    results = Results(tmp_path / "pay")
    source, last = (results.file("line", task, HIERARCHY, 0) for task in ("right", "left"))
    told = json.loads(last.read_text())
    results.save(replace(read(source), code="1f"))  # its skills
    last.unlink()
    Bench(suite(), results, seed=0).run("hierarchy", ["left"])
    assert read(last).code == ""
    run = Results(tmp_path).run_path("line", "left", HIERARCHY, 0)
    Results(tmp_path).begin(run)
    assert Results(tmp_path).begun_by(run) == CODE
    run.mkdir()
    Results(tmp_path).begin(run)  # it goes on, and nobody noted who began it
    assert Results(tmp_path).begun_by(run) == ""
    del told["code"]
    (tmp_path / "0.json").write_text(json.dumps(told))
    assert "1 of these 1 results" in of_other_code([read(tmp_path / "0.json")])


@pytest.mark.slow
def test_who_was_killed_goes_on_and_comes_to_the_same(done, tmp_path, monkeypatch):
    results = Results(tmp_path)
    score = agents.Bench._score

    def killed(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(agents.Bench, "_score", killed)
    with pytest.raises(KeyboardInterrupt):
        Bench(suite(), results, seed=0).run("hierarchy", ["left"])
    assert results.all("line") == []
    assert results.run_path("line", "right", HIERARCHY, 0).exists()
    monkeypatch.setattr(agents.Bench, "_score", score)
    Bench(suite(), results, seed=0).run("hierarchy", ["left"])
    for task in ("right", "left"):
        again = results.find("line", task, HIERARCHY, 0, suite().steps()[task == "left"])
        first = done.find("line", task, HIERARCHY, 0, suite().steps()[task == "left"])
        assert (again.scores, again.curve) == (first.scores, first.curve)


@pytest.mark.filterwarnings("ignore:.*the code of the environment has changed")
def test_fine_tuning_begins_with_what_the_flat_agent_was_on_the_first_task(done, tmp_path):
    bench = Bench(suite(), done, seed=0)
    task = suite().tasks[1]
    source = bench._before(task)
    agent = Flat(task.env, replace(TINY, learning_rate=1e-12), 64, starts_from=source)
    run = agent.run(tmp_path / "run", seed=0)
    for name, value in agent.load(source).policy.weights.items():
        if not name.startswith("obs"):
            np.testing.assert_allclose(run.policy.weights[name], value, atol=1e-6)
    found = {r.agent: r for r in done.all("line") if r.task == "right" and r.seed == 0}
    assert found[TUNED] == replace(found[FLAT], agent=TUNED)


@pytest.mark.filterwarnings("ignore:.*the code of the environment has changed")
def test_skills_that_go_on_begin_with_what_they_were_and_f4_acts_with_those(tmp_path, monkeypatch):
    tasks = [
        Task("right", spec(3), 0.5),
        Task("left", spec(-3), 0.5, "right"),
        Task("again", spec(-3), 0.5, "left"),  # so the run of "left" is kept
    ]

    def again(task, skills):
        return declare(task, learn="together", together_steps=192)

    goes_on = replace(suite(), tasks=tasks, further=again, variants={}, fixed={})
    acting, bench = [], Bench(goes_on, Results(tmp_path), seed=0)
    by_lot = agents.by_lot

    def noted(hierarchy, seed):
        acting.append([s.policy for s in hierarchy.skills])
        return by_lot(hierarchy, seed)

    monkeypatch.setattr(agents, "by_lot", noted)
    bench.run("hierarchy", ["left"])
    (stage,) = json.loads((bench._path(tasks[1], HIERARCHY) / "run.json").read_text())["stages"]
    source = bench._path(tasks[0], HIERARCHY)
    learnt = {s["name"]: s for s in json.loads((source / "run.json").read_text())["stages"]}
    begun = {name: told["sha256"] for name, told in stage["starts"].items()}
    assert begun == {name: learnt[name]["sha256"] for name in ("right", "left", "selector")}
    skills = bench._skills()
    assert len(acting) == 2  # for chance, and for the best single skill
    for right, left in acting:
        for policy, name in ((right, "right"), (left, "left")):
            for k, value in policy.weights.items():
                np.testing.assert_array_equal(value, skills[name].weights[k])


@pytest.mark.slow
@pytest.mark.parametrize("greedy", [True, False])
@pytest.mark.parametrize("found_out", [True, False])
def test_skills_act_on_every_task_as_they_did_where_they_were_learnt(
    tmp_path, monkeypatch, greedy, found_out
):
    found, alone = {}, []
    score, evaluate = Bench._score, Run.evaluate

    def noted(bench, run, task, agent, *args, **how):
        found[task.name, agent] = run.policy.skills.greedy
        return score(bench, run, task, agent, *args, **how)

    def asked(run, *args, skill=None, **how):
        if skill is not None:
            alone.append(how["deterministic"])
        return evaluate(run, *args, skill=skill, **how)

    def source(task):
        if not found_out:
            return declare(task, skill_steps=128, selector_steps=256, greedy_skills=greedy)
        return declare(task, learn="together", together_steps=256)

    def judged(policy, *args, **how):
        return Evaluation((float(policy.skills.greedy == greedy),), (1,), None)

    monkeypatch.setattr(Bench, "_score", noted)
    monkeypatch.setattr(Run, "evaluate", asked)
    if found_out:
        monkeypatch.setattr(select_best, "evaluate", judged)
    Bench(replace(suite(), source=source), Results(tmp_path), seed=0).run("hierarchy")
    assert len(found) == 8  # hierarchy, long calls, F4 and always right, on two tasks
    assert set(found.values()) == {greedy}
    assert alone == [greedy] * 6  # on two tasks: two skills, and the better one again


def test_weights_are_chosen_by_score_on_a_seed_that_is_not_reported(done, monkeypatch):
    tuned = [r for r in done.all("line") if r.seed == TUNING_SEED]
    assert {r.agent for r in tuned} == {"tuning-0", "tuning-1"}
    assert {r.budget for r in tuned} == {512 // 3}
    assert not [r for r in reported(done.all("line"), [0, TUNING_SEED]) if r in tuned]
    best = max(tuned, key=lambda r: r.score).agent
    number = int(best.removeprefix("tuning-"))
    if tuned[0].score != tuned[1].score:
        assert Bench(suite(), done, 0).tuned_weights() == suite().weights[number]


def test_curves_are_of_the_tasks_own_reward_whatever_is_learnt(done):
    found = [r for r in done.all("line") if r.agent in (SHAPED, FLAT, HIERARCHY)]
    for r in found:
        steps = [s for s, _ in r.curve]
        assert len(r.curve) > 1
        assert steps == sorted(steps)
        assert all(0.0 <= score <= 1.0 for _, score in r.curve)  # F1's own reward goes beyond
    path = done.run_path("line", "right", HIERARCHY, 0)
    curve = curve_of(path, 1.0, ("selector",))
    assert curve[0][0] > 2 * 128  # skills came first


def test_rewards_of_skills_are_added_by_weight():
    no, one = np.zeros(2, bool), np.ones(2, np.int64)
    obs, after = np.array([[0.0], [1.0]]), np.array([[2.0], [0.0]])
    step = Step(obs, one, after, np.array([0.0, 1.0]), no, no, no, one, {})
    shaped = Shaped([Right(), Left()], {"right": 0.5, "left": 0.1}, task_weight=10.0)
    # Moves are +2 and −1: 0.5·2 − 0.1·2, and 10 − 0.5 + 0.1.
    np.testing.assert_allclose(shaped.reward(step), [0.8, 9.6])


def test_the_bonus_falls_with_the_visits_of_all_environments():
    no, one = np.zeros(3, bool), np.ones(3, np.int64)
    after, reward = np.array([[1.0], [1.2], [2.0]]), np.array([0.0, 1.0, 0.0])
    step = Step(np.zeros((3, 1)), one, after, reward, no, no, no, one, {})
    seldom = Seldom(lambda obs: obs.astype(int), 3.0)
    second, third, fourth = (3.0 / np.sqrt(n) for n in (2, 3, 4))
    np.testing.assert_allclose(seldom.reward(step), [3.0, 1.0 + second, 3.0])
    np.testing.assert_allclose(seldom.reward(step), [third, 1.0 + fourth, second])


def test_which_skill_is_best_is_found_out_in_other_episodes_than_those_of_its_score(
    tmp_path, monkeypatch
):
    asked, evaluate = [], Run.evaluate

    def noted(run, episodes, *, seed=0, skill=None, **how):
        if skill is not None:
            asked.append((skill, episodes, seed))
        return evaluate(run, episodes, seed=seed, skill=skill, **how)

    monkeypatch.setattr(Run, "evaluate", noted)
    Bench(suite(), Results(tmp_path), seed=0).run("hierarchy", ["right"])
    *tried, final = asked
    assert tried == [("right", 2, TUNING_SEED), ("left", 2, TUNING_SEED)]
    assert final[1:] == (4, 0)


def test_long_trainings_of_flat_agents_are_compiled_where_that_is_possible(tmp_path, monkeypatch):
    bench = Bench(suite(), Results(tmp_path), seed=0)
    asked = [bench._agent(suite().tasks[0]).algorithm.compile]
    monkeypatch.setattr(agents, "LONG", 500)
    asked += [bench._agent(task).algorithm.compile for task in suite().tasks]
    assert asked == [False, "auto", False]


def test_where_a_run_is_needed_its_result_does_not_count_before_it_is_over(tmp_path, monkeypatch):
    bench = Bench(suite(), Results(tmp_path), seed=0)
    bench.run("flat", ["right"])
    first = suite().tasks[0]
    assert bench._found(first, FLAT, 512, keep=True) is not None
    stages = [SimpleNamespace(done=True), SimpleNamespace(done=False)]
    half = SimpleNamespace(manifest=SimpleNamespace(stages=stages))
    with monkeypatch.context() as changed:
        changed.setattr(agents.RunDirectory, "open", lambda path: half)
        assert bench._found(first, FLAT, 512, keep=True) is None
    shutil.rmtree(bench._path(first, FLAT))
    assert bench._found(first, FLAT, 512) is not None
    assert bench._found(first, FLAT, 512, keep=True) is None
    bench.run("flat", ["left"])
    assert {(r.task, r.agent) for r in Results(tmp_path).all("line")} == {
        ("right", FLAT), ("right", TUNED), ("left", FLAT), ("left", TUNED),
    }  # fmt: skip


def test_f3_follows_the_hierarchy_from_task_to_task(tmp_path):
    after = [
        Task("right", spec(3), 0.5),
        Task("left", spec(-3), 0.5),
        Task("again", spec(-3), 0.5, "left"),
    ]
    bench = Bench(replace(suite(), tasks=after), Results(tmp_path), seed=0)
    bench.run("flat", ["again"])
    found = {(r.task, r.agent) for r in Results(tmp_path).all("line")}
    assert found == {("right", FLAT), ("left", TUNED), ("again", TUNED), ("again", FLAT)}
    assert bench._before(after[2]) == bench._path(after[1], TUNED)
    assert bench._before(after[1]) == bench._path(after[0], FLAT)
    assert bench._path(after[1], TUNED).exists()


@pytest.mark.slow
def test_figures_and_the_table_are_made_from_the_files(done, tmp_path):
    pytest.importorskip("matplotlib")
    results = reported(done.all("line"), [0])
    files = draw(suite(), results, tmp_path)
    assert sorted(f.name for f in files) == [
        "line-curves.png", "line-curves.svg", "line-solved.png", "line-solved.svg",
    ]  # fmt: skip
    assert all(f.stat().st_size > 1000 for f in files)
    text = make_table(suite(), results)
    assert text.count("F1-skill-rewards") == 3  # two tasks, and both together
    assert "tuning" not in text


def test_a_task_that_is_not_there_is_named_with_those_that_are():
    with pytest.raises(SkillweaveError, match="no suite 'shuttl'; there are: shuttle"):
        command.chosen(["shuttl"])
    with pytest.raises(SkillweaveError, match="no task 'x' in shuttle; there are: shuttle-2"):
        command.chosen(["shuttle/x"])
    assert command.chosen(["shuttle/shuttle-4"]) == {"shuttle": ["shuttle-4"]}
    assert set(command.chosen([])) == set(command.SUITES)


@pytest.mark.slow
def test_jobs_of_the_command_run_in_processes_of_their_own(tmp_path):
    """What a process is sent must be importable there: nothing of a package's ``__main__`` is."""
    pytest.importorskip("Box2D")
    folder = tmp_path / "lander-missions" / "any" / "hierarchy"
    folder.mkdir(parents=True)
    (folder / "0.json").write_text("{}")
    asked = ["lander-missions/any", "--agents", "hierarchy", "--seeds", "0", "--out", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.pay", *asked],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "0.json is damaged" in line  # a job read it, and told
