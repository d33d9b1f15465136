"""A plan, exported: the runner acts as the planner does, also where calls fail."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from goals.worlds import ON, SPACES, Point, Rest, declared
from playing import episode, loaded_of, runner_of
from ready_selectors.chain import DOOR, PLACE, Corridor, GetKey, Leave, OpenDoor, Wait, at_four

from skillweave import EnvSpec, Lengths
from skillweave.api.player import Player
from skillweave.calls import CallLog, held, record_calls
from skillweave.errors import PolicyError, SkillError
from skillweave.export.write import write_export
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.planning import GoalTask, Mission, Planner, RewardMachine
from skillweave.policies.codec import read_folder
from skillweave.policies.core import Turn, World
from skillweave.policies.hierarchy import ActiveGuide
from skillweave.skills import Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet


def opened(step: Any) -> Any:
    return step.info["door"] == 1


def far(step: Any) -> Any:
    return step.next_obs[:, PLACE] / 10


def near(obs: Any, goal: Any) -> Any:
    return obs[:, PLACE] == goal[0]


TASKS: dict[str, Any] = {
    "legs": Mission(at_four, opened, held(at_four, 3)),
    "reward": RewardMachine({("on", "open"): (opened, 1.0)}, each_step={"open": far}),
    "goal": GoalTask(near, goal=[6.0]),
}


class Noisy(Corridor):
    """A fourth number is chance, so that no two logged calls are equally near."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)

    def _obs(self) -> Any:
        return np.append(super()._obs(), np.float32(self.np_random.normal(0, 0.1)))


NOISY = EnvSpec(Noisy, engine="sync")


def going(action: int) -> ScriptedPolicy:
    return ScriptedPolicy(
        lambda obs: np.full(len(obs), action), Noisy.observation_space, Noisy.action_space
    )


class Go(Skill):
    policy = going(2)


class Back(Skill):
    policy = going(0)


def corridor(lengths: bool) -> SkillSet:
    skills: Any = (Go(), Back()) if lengths else (GetKey(), OpenDoor(), Leave(), Wait())
    policies = tuple(map(going, (2, 0) if lengths else (0, 2, 2, 1)))
    return SkillSet(skills, policies, call_steps=Lengths(1, 2, 4) if lengths else None)


def bound(planner: Planner, skills: SkillSet, sees: Any) -> Any:
    """A planner as the selector of skills."""
    names = tuple(skill.name for skill in skills.skills)
    return planner.among(names).bind(sees, gym.spaces.Discrete(skills.choices), "selector")


class Walled(Noisy):
    """A wall behind place 3 stands for 14 steps: calls that the log knows fail."""

    def step(self, action: int) -> Any:
        before = self.place
        result = super().step(action)
        if before <= 3 < self.place and self.t < 14:
            self.place = before
            return self._obs(), *result[1:]
        return result


def played(env: Any, actor: Any, seed: int) -> list[int]:
    return [int(action) for (action,) in episode(env, actor, seed=seed)]


@pytest.fixture(scope="module")
def logs() -> dict[bool, CallLog]:
    return {
        lengths: record_calls(NOISY, corridor(lengths), 1_500, num_envs=4, info=("door",))
        for lengths in (False, True)
    }


@pytest.mark.parametrize(("task", "lengths"), [*((t, False) for t in TASKS), ("legs", True)])
def test_the_runner_acts_as_the_planner(
    task: str, lengths: bool, logs: dict[bool, CallLog], tmp_path: Path
) -> None:
    skills = corridor(lengths)
    planner = Planner(logs[lengths], TASKS[task], skills=skills)
    policy = HierarchyPolicy(bound(planner, skills, NOISY.spaces.observation), skills)
    export = write_export(tmp_path, policy, "corridor")
    assert "arrays.npz" in export.files
    runner, player = runner_of(export), Player(policy)
    calls_fail = 0
    for seed in range(3):
        for env in (Noisy, Walled):
            acted = played(env(), runner, seed)
            assert acted == played(env(), player, seed)
            calls_fail += acted != played(Noisy(), runner, seed)
    assert calls_fail, "the wall changes what is done"
    loaded = Player(loaded_of(export))
    assert played(Walled(), loaded, 0) == played(Walled(), player, 0)


def test_features_and_goals_of_an_export(logs: dict[bool, CallLog], tmp_path: Path) -> None:
    skills = corridor(lengths=False)

    def exported(planner: Planner) -> Any:
        selector = bound(planner, skills, NOISY.spaces.observation)
        return write_export(tmp_path, HierarchyPolicy(selector, skills), "corridor")

    columns = GoalTask(near, columns=(DOOR,))
    planner = Planner(logs[False], columns)
    with pytest.raises(PolicyError, match=r"plans again for each goal .* GoalTask"):
        exported(planner)
    planner = Planner(logs[False], at_four, features=lambda obs: np.stack([obs[:, PLACE] ** 2], 1))
    export = exported(planner)
    assert export.code["selector.features"] == "observations (n, ...) to features (n, F)"
    played(Noisy(), runner_of(export), 1)


GOAL_SPACES: dict[str, Any] = {
    "box": SPACES["box"],
    "dict": SPACES["dict"],
    "nested": gym.spaces.Dict({"to": SPACES["dict"], "how": SPACES["bits"]}),
    "number": gym.spaces.Discrete(9, start=2),
}


def way_to(obs: Any, goal: Any) -> Any:
    if goal.dtype.fields and "to" in goal.dtype.names:
        goal = goal["to"]
    if goal.dtype.kind == "i":
        goal = np.stack([(goal - 2) % 3 - 1, (goal - 2) // 3 - 1], 1)
    return np.clip(5 * ((goal["at"] if goal.dtype.fields else goal) - obs), -1, 1)


class Fenced(Point):
    """The point cannot pass x = 0.2 to the right for 14 steps: calls that the log knows fail."""

    def step(self, action: Any) -> Any:
        before = self.place.copy()
        result = super().step(action)
        if before[0] <= 0.2 < self.place[0] and self.steps < 14:
            self.place[0] = before[0]
        return self._obs(), *result[1:]


def corners(skill: Any, obs: Any, rng: Any) -> Any:
    return np.sign(rng.uniform(-1, 1, (len(obs), 2)))


def in_corner(obs: Any) -> Any:
    return (obs > 0.4).all(1)


def left_low(obs: Any) -> Any:
    return (obs < -0.3).all(1)


THERE_AND_BACK = Mission(in_corner, held(left_low, 3))
GOING: dict[str, Any] = {
    "box": ("box", {}),
    "few goals": ("box", {"goals": corners}),
    "dict": ("dict", {}),
    "dict in a dict": ("nested", {}),
    "few numbers": ("number", {}),
    "two skills": ("box", {"more": True}),
    "lengths": ("box", {"call_steps": Lengths(2, 5)}),
    "more neighbors than options": ("box", {"neighbors": 40}),
}


def with_goals(space: str, seed: int = 0, **how: Any) -> Any:
    """A run of ready skills with goals, and a log of it."""
    call_steps = how.pop("call_steps", 8)
    own = {"policy": lambda self, obs, goal: way_to(obs, goal), "goal_space": GOAL_SPACES[space]}
    own |= {"goals": how.pop("goals")} if "goals" in how else {}
    skills = [type("GoTo", (Skill,), own)(), Rest()]
    if how.pop("more", False):
        picks = {"name": "pick", "goal_space": GOAL_SPACES["number"]}
        skills.append(type("Pick", (Skill,), own | picks)())
    run = declared(skills, selector=ON, call_steps=call_steps).train(quiet=True)
    return run, run.log_calls(2_000, num_envs=4, seed=seed), how


def acted_in(env: Any, policy: Any, actor: Any, seed: int) -> list[Any]:
    """Of each step of an episode the running skill, its goal, and the action."""
    return [
        (int(actor.memory["skill"][0]), str(policy.goal_now(actor.memory)), action.tolist())
        for (action,) in episode(env, actor, seed=seed)
    ]


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("case", GOING)
def test_the_runner_chooses_the_goals_of_a_plan(case: str, tmp_path: Path) -> None:
    space, how = GOING[case]
    run, log, settings = with_goals(space, **how)
    policy = run.plan(THERE_AND_BACK, log, **settings).policy
    export = write_export(tmp_path, policy, "point")
    runner, player = runner_of(export), Player(policy)
    goals, calls_fail = set(), 0
    for seed in range(6):
        plain, fenced = ([acted_in(e(), policy, a, seed) for a in (player, runner)] for e in WORLDS)
        assert plain[0] == plain[1]
        assert fenced[0] == fenced[1]
        goals |= {goal for _, goal, _ in plain[0] + fenced[0]}
        calls_fail += plain[0] != fenced[0]
    assert len(goals) > 2
    assert calls_fail, "the fence changes what is done"
    is_apart = [group.options == 1 for group in policy.selector.in_place.options.groups]
    assert all(is_apart) == (case in ("few goals", "few numbers"))


WORLDS = (Point, Fenced)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("how", [{"more": True}, {"call_steps": Lengths(2, 5)}])
def test_a_plan_with_goals_that_guides_is_exported(how: Any, tmp_path: Path) -> None:
    """A guide says which skill and length, and the selector beside it which goal."""
    run, log, _ = with_goals("box", **how)
    skills = run.policy.skills
    planner = Planner(log, THERE_AND_BACK, skills=skills)
    guide = bound(planner, skills, Point.observation_space)
    policy = HierarchyPolicy(run.policy.selector, skills, ActiveGuide(guide))
    export = write_export(tmp_path, policy, "point")
    runner, player, skills_of = runner_of(export), Player(policy), set()
    for seed in range(6):
        for world in WORLDS:
            a, b = (acted_in(world(), policy, actor, seed) for actor in (player, runner))
            assert [(skill, action) for skill, _, action in a] == close(b)
            skills_of |= {skill for skill, _, _ in a}
    assert len(skills_of) > 1 or "call_steps" in how  # there one skill does it all


def close(steps: list[Any]) -> list[Any]:
    """Steps of the skill and the action, which is compared to 1e-5."""
    return [(skill, pytest.approx(action, abs=1e-5)) for skill, _, action in steps]


def test_a_plan_that_must_call_a_skill_that_was_never_called_says_so(tmp_path: Path) -> None:
    run, log, _ = with_goals("box")
    rests = log.take(np.flatnonzero(log.skill == 1))
    nothing = pytest.warns(UserWarning, match="asks for nothing")
    with pytest.warns(UserWarning, match="no call of 'go_to'"), nothing:
        policy = run.plan(lambda obs: obs[:, 0] > -5, rests).policy
    export = write_export(tmp_path, policy, "point")
    runner = runner_of(export)
    obs, _ = Point().reset(seed=0)
    runner.act(obs)
    assert runner.memory["skill"].tolist() == [1]
    planned = read_folder(tmp_path, export.functions)[0].policy.selector
    only = Turn(World(), np.array([[True, False]]))
    with pytest.raises(SkillError, match=r"chose skill 'go_to' without a goal .* so record some"):
        planned.act(planned.start(1), np.arange(1), obs[None], only)
