"""The cases of ``benchmarks.together``: all are declared, and flat agents are what they claim."""

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.chains import TASKS, Task
from benchmarks.pay.flat import Flat
from benchmarks.together import CASES, check_case, one, without_selector
from examples.bridge import AXE, BRIDGE, RIVER, WIDTH, WOOD, WORK, GetAxe, River, declare
from examples.doorkey import ROOM
from skillweave import PPO, Hierarchy, SkillweaveError, Step, recipes
from skillweave.algorithms import SelfImitationPPO
from skillweave.hierarchy.training import manifest

OF_ALL_ALIKE = ("no imitation", "limit ends", "one advantage scale")


@pytest.mark.parametrize(
    ("task", "case"),
    [("bridge", case) for case in CASES]
    + [("lander", case) for case in CASES if case not in OF_ALL_ALIKE],
)
def test_every_case_has_the_steps_that_are_asked(task, case):
    learner = CASES[case](TASKS[task], 10_000)
    steps = learner.total_steps if isinstance(learner, Hierarchy) else learner.steps
    assert 9_980 <= steps <= 10_000


@pytest.mark.parametrize("task", ["8x8", "16x16", "bridge"])
def test_with_one_scale_nobody_divides_advantages_by_their_own_deviation(task):
    found = CASES["one advantage scale"](TASKS[task], 10_000)
    learning = [found.algorithm, found.selector, *(s.algorithm for s in found.skills)]
    assert not any(each.normalize_advantage for each in learning if isinstance(each, PPO))
    usual = CASES["together"](TASKS[task], 10_000)
    assert manifest(found, seed=0, flat=False) != manifest(usual, seed=0, flat=False)


CHAINS = ("8x8", "bridge", "yard")
EVERY = (*CHAINS, "lander")


@pytest.mark.parametrize(
    ("case", "tasks", "usual", "changed"),
    [
        ("low epsilon", CHAINS, "together", {"epsilon": 0.3, "epsilon_final": 0.02}),
        ("no epsilon", EVERY, "together", {"epsilon": 0.0, "epsilon_final": 0.0}),
        ("task advantage", EVERY, "together", {"task_weight": 1.0}),
        ("no task advantage", ("lander",), "together", {"task_weight": 0.0}),
        ("anchor", ("lander",), "together", {"reference_kl": 0.05}),
        ("then, no anchor", CHAINS, "then", {"reference_kl": None}),
    ],
)
def test_a_case_changes_what_it_names_and_nothing_else(case, tasks, usual, changed):
    for task in tasks:
        before, after = (CASES[name](TASKS[task], 1_000) for name in (usual, case))
        assert before.together != after.together
        before.together = replace(before.together, **changed)
        assert manifest(after, seed=0, flat=False) == manifest(before, seed=0, flat=False)


@pytest.mark.parametrize(
    ("task", "case", "says"),
    [
        ("8x8", "anchor", "'anchor' is the same as 'together' on 8x8"),
        ("16x16", "no call cost", "'no call cost' is the same as 'together' on 16x16"),
        ("lander", "low epsilon", "'low epsilon' is the same as 'together' on lander"),
        ("lander", "then, no anchor", "is the same as 'then' on lander"),
        ("lander", "no imitation", "'landing' has an algorithm of its own"),
        ("lander", "limit ends", "skills that learn apart have no calls"),
        ("lander", "one advantage scale", "the task's advantage keeps one of its own"),
    ],
)
def test_a_case_that_says_nothing_on_a_task_is_refused(task, case, says):
    with pytest.raises(SkillweaveError, match=says):
        check_case(case, task)
    for other in ("together", "limit ends", "then, no anchor", "flat", "bonus"):
        check_case(other, "bridge")


def test_a_skills_value_ends_at_the_limit_of_its_calls():
    usual, ended = (CASES[case](TASKS["bridge"], 1_000) for case in ("together", "limit ends"))
    limit = usual.skills[0].max_steps
    before, _ = River().reset(seed=0)
    for skill, same in zip(usual.skills, ended.skills, strict=True):
        assert same.name == skill.name
        at = [
            replace(step_of(before, before, 0.0), elapsed=np.array([n])) for n in (limit - 1, limit)
        ]
        assert [bool(skill.termination(step)) for step in at] == [False, False]
        assert [bool(same.termination(step)) for step in at] == [False, True]
        assert not any(same.success(step) for step in at), "it has not done its work"


def passes(found: Hierarchy | Flat) -> list[tuple[int, int]]:
    """Over each rollout, and rows of a minibatch, of all skills and of ``landing``."""
    who = found.algorithm, found.skill("landing").algorithm
    return [(a.update_epochs, a.batch_size) for a in who if isinstance(a, PPO)]


def test_the_lander_is_what_the_measured_table_says():
    steps = 1_620_000
    found = CASES["together"](TASKS["lander"], steps)
    assert passes(found) == [(3, 1024), (3, 1024)]
    assert passes(CASES["apart"](TASKS["lander"], steps)) == [(6, 512), (4, 1024)]
    assert [s.steps or found.apart.skill_steps for s in found.skills] == [10_000, 10_000, 50_000]
    assert (found.apart.selector_steps, found.together.steps) == (50_000, 1_500_000)
    assert found.together.task_weight == 100
    same = replace(recipes.load("lunar-lander"), env=found.env)  # but for how many workers step it
    assert manifest(same, seed=0, flat=False) == manifest(found, seed=0, flat=False)
    then = CASES["then"](TASKS["lander"], steps)
    assert then.selector == found.selector, "budgets alone differ"


def test_who_learns_is_the_same_but_for_what_a_case_names():
    usual, plain, skills, errors = (
        CASES[case](TASKS["unlock-pickup"], 1_000)
        for case in ("together", "no imitation", "selector does not imitate", "no least deviation")
    )
    assert type(usual.algorithm) is type(usual.selector) is SelfImitationPPO
    assert type(plain.algorithm) is type(plain.selector) is PPO
    for own, without in (
        (usual.algorithm, plain.algorithm),
        (usual.selector, plain.selector),
        (usual.selector, skills.selector),
    ):
        assert vars(without) == {k: vars(own)[k] for k in vars(PPO())}
    assert skills.algorithm == usual.algorithm
    assert errors.algorithm == replace(usual.algorithm, min_advantage_std=0.0)
    assert errors.selector == replace(usual.selector, min_advantage_std=0.0)


def test_calls_cost_something_where_successes_come_early_or_skills_learn_apart():
    costs = {
        (task, case): CASES[case](TASKS[task], 1_000).selection.deliberation_cost  # type: ignore[union-attr]
        for task in ("8x8", "16x16")
        for case in ("together", "apart", "then")
    }
    assert [key for key, cost in costs.items() if not cost] == [("16x16", "together")]
    for case in ("apart", "then"):
        learner = CASES[case](TASKS["16x16"], 1_000)
        assert type(learner.algorithm) is type(learner.selector) is PPO


@pytest.mark.parametrize(
    ("task", "room"),
    [
        ("8x8", "DoorKey-8x8"),
        ("16x16", "DoorKey-16x16"),
        ("unlock-pickup", "UnlockPickup"),
    ],
)
def test_a_room_is_scored_in_itself(task, room):
    for case in ("together", "apart", "flat", "bonus"):
        spec = CASES[case](TASKS[task], 10_000).spec
        assert spec.kwargs.get("room", ROOM) == room
        if importlib.util.find_spec("minigrid"):
            assert spec.make().unwrapped.spec.id == f"MiniGrid-{room}-v0"


def step_of(before: np.ndarray, after: np.ndarray, reward: float) -> Step:
    no, one = np.zeros(1, bool), np.ones(1, np.int64)
    return Step(before[None], one, after[None], np.array([reward]), no, no, no, one, {})


def test_skill_rewards_are_the_tasks_and_the_weighted_sum_of_the_skills():
    learner = CASES["skill rewards x 0.1"](TASKS["bridge"], 100)
    assert isinstance(learner, Flat)
    before, _ = River().reset(seed=0)
    after = before.copy()
    after[2] = 1  # the axe
    step = step_of(before, after, reward=0.25)
    # Each of the four skills pays 0.02 for the step, and GetAxe gets 1.
    assert learner.learns.reward(step) == pytest.approx(0.25 + 0.1 * (1.0 - 4 * 0.02))
    assert GetAxe().reward(step) == pytest.approx(0.98)


@pytest.mark.parametrize("case", ["flat", "bonus", "skill rewards x 1.0"])
def test_flat_agents_are_scored_by_the_task(case):
    found = one(case, "bridge", 2_000, "auto", f4=True, seed=0)
    assert found["score"] <= 0.05
    assert found["usage"] == {}
    assert 2_000 <= found["steps"] <= 3_024
    assert "f4" not in found


def walker(goal: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    """Walks to the cell that ``goal`` reads from observations, x first, and works there."""

    def act(obs: np.ndarray) -> np.ndarray:
        dx, dy = (goal(obs) - obs[:, :2]).T
        ways = [dx > 0, dx < 0, dy > 0, dy < 0]
        return np.select(ways, range(4), default=WORK)

    return act


def test_skills_are_scored_without_their_selector(tmp_path):
    def at_river(obs: np.ndarray) -> np.ndarray:
        return np.stack([np.full(len(obs), RIVER - 1.0), obs[:, 1]], axis=1)

    def far_bank(obs: np.ndarray) -> np.ndarray:
        # First the bridge's row, then across.
        there = obs[:, 1] == obs[:, 9]
        return np.stack([np.where(there, WIDTH - 1, obs[:, 0]), obs[:, 9]], axis=1)

    def needed(obs: np.ndarray) -> np.ndarray:
        flags = obs[:, [BRIDGE, WOOD, AXE]].T == 1
        return np.select(list(flags), [3, 2, 1], default=0)

    ready = declare(selector=needed, learn="apart")
    goals = [lambda obs: obs[:, 5:7], lambda obs: obs[:, 7:9], at_river, far_bank]
    for skill, goal in zip(ready.skills, goals, strict=True):
        skill.policy = walker(goal)
    run = ready.train(tmp_path / "run", quiet=True)
    found = without_selector(run, declare(), TASKS["bridge"], tmp_path / "lot", seed=0)
    assert list(found) == ["at random", "get_axe", "chop", "build", "cross"]
    # Who calls any skill that may start crosses sooner or later; no skill gets there alone.
    assert found.pop("at random") >= 0.5
    assert set(found.values()) == {0.0}


@pytest.mark.slow
@pytest.mark.parametrize("task", ["bridge", "lander"])
def test_skills_alone_are_scored_as_the_run_plays_them(task, monkeypatch):
    asked = []

    def score(task: Task, run: Any, greedy: bool | None = None, **how: Any) -> tuple[float, Any]:
        asked.append((greedy, how.get("skill")))
        return 0.0, {}

    monkeypatch.setattr(Task, "score", score)
    found = one("together", task, 4_000, "auto", f4=True, seed=0)
    # Those of `lander` are declared to sample; for `bridge` it is found out.
    greedy = task == "bridge"
    assert found["kept"]["kept"] != "skills_sample", "else the two say the same"
    skills = CASES["together"](TASKS[task], 4_000).skills
    assert asked[1:] == [*((greedy, s.name) for s in skills), (None, None)]
    assert list(found["f4"]) == ["at random", *(s.name for s in skills)]
