"""Trainings with hindsight: skills with goals, and plain agents in environments of goals."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from declaring import declare
from small_runs import goes_on, reports_every, stopped_run

import skillweave as sw
from skillweave.buffers.judged import JudgedStore
from skillweave.errors import DeclarationError, EnvError, TrainingError
from skillweave.evolution import Evolution

often = reports_every(75)
SMALL = sw.Network((16,), "relu")
HER = sw.SAC(
    num_envs=4, learning_starts=60, batch_size=32, buffer_size=2_000, network=SMALL, hindsight=True
)


class Plane(gym.Env):
    """A point on a square, which actions push; nothing is paid."""

    size = 4.0
    observation_space = gym.spaces.Box(0, 10, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(0, self.size, 2).astype(np.float32)
        self.time = 0
        return self.place.copy(), {}

    def step(self, action: Any) -> Any:
        self.place = np.clip(self.place + 0.5 * np.float32(action), 0, self.size).astype(np.float32)
        self.time += 1
        return self.place.copy(), 0.0, False, self.time >= 30, {"time": self.time}


class GoTo(sw.Skill):
    """Go to a point: −1 for each step until it is there."""

    goal_space = gym.spaces.Box(0, 4, (2,), np.float32)
    max_steps = 20
    algorithm = HER

    def near(self, step: Any) -> Any:
        return np.linalg.norm(step.next_obs - step.goal, axis=1) < 0.4

    def reward(self, step: Any) -> Any:
        return self.near(step) - 1.0

    def termination(self, step: Any) -> Any:
        return self.near(step)

    def success(self, step: Any) -> Any:
        return self.near(step)

    def achieved_goal(self, obs: Any) -> Any:
        return obs


class Stay(sw.Skill):
    """Stay."""

    max_steps = 2

    def policy(self, obs: Any) -> Any:
        return np.zeros((len(obs), 2), np.float32)


def going(skill: Any = GoTo, **how: Any) -> sw.Hierarchy:
    """A skill that goes to points, and one that stays, in one small hierarchy."""
    plain = {"learn": "apart", "selector": sw.PPO(num_envs=4, n_steps=16, network=SMALL)}
    plain |= {"skill_steps": 300, "selector_steps": 64, "together_steps": 300}
    return declare(skill(), Stay(), **plain | {"env": Plane} | how)


class Bits(gym.Env):
    """Flip bits until they are as the goal has them (Andrychowicz et al. 2017, section 3.1)."""

    size = 5
    one_by_one = False

    def __init__(self) -> None:
        bits = gym.spaces.Box(0, 1, (self.size,), np.float32)
        names = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = gym.spaces.Dict(dict.fromkeys(names, bits))
        self.action_space = gym.spaces.Discrete(self.size)

    def see(self) -> Any:
        bits = self.bits.copy()
        return {"observation": bits, "achieved_goal": bits, "desired_goal": self.goal.copy()}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.bits, self.goal = self.np_random.integers(2, size=(2, self.size)).astype(np.float32)
        self.time = 0
        return self.see(), {}

    def step(self, action: Any) -> Any:
        self.bits[action] = 1 - self.bits[action]
        self.time += 1
        paid = self.compute_reward(self.bits, self.goal, {})
        done = bool(self.compute_terminated(self.bits, self.goal, {}))
        return self.see(), float(paid), done, self.time >= self.size, {"is_success": paid == 0}

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        if self.one_by_one:
            return 0.0 if list(achieved) == list(desired) else -1.0
        return (achieved == desired).all(axis=-1) - 1.0

    def compute_terminated(self, achieved: Any, desired: Any, info: Any) -> Any:
        return (achieved == desired).all(axis=-1)


BITS = sw.DQN(
    num_envs=8, learning_starts=500, network=sw.Network((64,), "relu"), hindsight=True, gamma=0.95
)


@pytest.mark.parametrize("one_by_one", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_plain_agent_learns_to_flip_bits(one_by_one, tmp_path, monkeypatch):
    monkeypatch.setattr(Bits, "one_by_one", one_by_one)
    run = sw.train_agent(Bits, BITS, 5_000, tmp_path / "run", seed=0, quiet=True)
    assert run.evaluate(100, quiet=True).succeeded > 90


@pytest.mark.slow
def test_without_hindsight_it_does_not(tmp_path):
    config = replace(BITS, hindsight=False)
    sizes = {"size": 9}
    kind = type("Bits9", (Bits,), sizes)
    run = sw.train_agent(kind, config, 5_000, tmp_path / "run", seed=0, quiet=True)
    assert run.evaluate(100, quiet=True).succeeded < 30


@pytest.mark.slow
def test_a_skill_learns_to_go_to_points_that_pay_at_the_goal_alone(tmp_path):
    wide = type("Wide", (Plane,), {"size": 10.0})

    def reached(hindsight: bool) -> float:
        class Learns(GoTo):
            name = "go"
            goal_space = gym.spaces.Box(0, 10, (2,), np.float32)
            max_steps = 40
            algorithm = sw.SAC(
                learning_starts=500, network=sw.Network((64, 64), "relu"), hindsight=hindsight
            )

        run = going(Learns, env=wide, skill_steps=6_000).train(
            tmp_path / str(hindsight), seed=0, quiet=True
        )
        return run.evaluate(50, skill="go", seed=3, quiet=True).reached.mean()

    assert reached(True) > 0.8  # of one seed, on any machine
    assert reached(False) < 0.5


@pytest.mark.parametrize("learn", ["apart", "together"])
def test_a_run_that_is_resumed_ends_with_the_same_weights(learn, tmp_path):
    goes_on(lambda: going(learn=learn), tmp_path, tick=3)


def test_members_of_a_population_have_hindsight(tmp_path):
    evolve = Evolution(population=2, generations=2)
    run = sw.train_agent(
        Bits,
        replace(BITS, num_envs=2, learning_starts=40),
        600,
        tmp_path / "run",
        seed=0,
        evolve=evolve,
        quiet=True,
    )
    assert run.evaluate(5, quiet=True).mean <= 0


def test_calls_that_follow_one_another_with_the_same_goal_stay_two(tmp_path, monkeypatch):
    left: list[Any] = []

    def look(store: JudgedStore) -> None:
        filled = np.flatnonzero(store._columns.data["kind"])
        left.append(store._columns.rows_left(filled))

    monkeypatch.setattr(JudgedStore, "_check", look)

    def always(obs: Any) -> Any:
        return np.full(len(obs), "go_to"), np.full((len(obs), 2), 9.0)

    class Far(GoTo):
        name = "go_to"
        goal_space = gym.spaces.Box(0, 9, (2,), np.float32)

    hierarchy = going(Far, learn="together", call_steps=4, selector=always)
    hierarchy.train(tmp_path / "run", seed=0, quiet=True)
    assert set(np.concatenate(left).tolist()) == {0, 1, 2, 3}


@pytest.mark.filterwarnings("ignore:the reward of skill")
def test_a_reward_that_has_changed_since_stops_a_resumed_run(tmp_path):
    stopped_run(going(), tmp_path / "run", 3)

    class Other(GoTo):
        name = "go_to"

        def reward(self, step: Any) -> Any:
            return 2.0 * self.near(step) - 1.0

    with pytest.raises(TrainingError, match="the reward of one is now"):
        going(Other).resume(tmp_path / "run", quiet=True)


def test_an_environment_that_ends_by_its_goal_must_say_where(tmp_path):
    class Silent(Bits):
        compute_terminated = None  # type: ignore[assignment]

        def step(self, action: Any) -> Any:
            self.bits[action] = 1 - self.bits[action]
            done = bool((self.bits == self.goal).all())
            return self.see(), float(done) - 1.0, done, True, {}

    with pytest.raises(TrainingError, match="no compute_terminated"):
        sw.train_agent(Silent, BITS, 2_000, tmp_path / "run", seed=0, quiet=True)


def test_a_reward_that_needs_info_is_refused_before_steps_are_spent(tmp_path):
    class Needy(Bits):
        def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
            return info["paid"]

        def step(self, action: Any) -> Any:
            return self.see(), 0.0, False, True, {"paid": 0.0}

    with pytest.raises(EnvError, match="KeyError: 'paid'"):
        sw.train_agent(Needy, BITS, 2_000, tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("methods", "kind", "words"),
    [
        ({"achieved_goal": sw.Skill.achieved_goal}, DeclarationError, "define achieved_goal"),
        ({"achieved_goal": lambda self, obs: obs[:, 0]}, sw.errors.SkillError, "of shape"),
        ({"achieved_goal": lambda self, obs: obs * np.nan}, sw.errors.SkillError, "NaN"),
        ({"reward": lambda self, step: step.info["time"]}, DeclarationError, "info['time']"),
        ({"success": lambda self, step: step.info["time"] > 3}, DeclarationError, "info['time']"),
        ({"reward_changes": True}, DeclarationError, "reward_changes"),
        (
            {"goal_space": None, "achieved_goal": sw.Skill.achieved_goal},
            DeclarationError,
            "no goals",
        ),
    ],
)
def test_a_skill_that_cannot_be_judged_again_is_refused_before_steps_are_spent(
    methods, kind, words, tmp_path
):
    wrong = type("Wrong", (GoTo,), methods)
    with pytest.raises(kind, match=words.replace("[", r"\[")):
        going(wrong).train(tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


@pytest.mark.filterwarnings("ignore:.*are the same for every goal")
def test_goals_that_change_nothing_are_refused(tmp_path):
    class Same(GoTo):
        def near(self, step: Any) -> Any:
            return step.next_obs[:, 0] > 3

    with pytest.raises(DeclarationError, match="are the same for every goal"):
        going(Same).train(tmp_path / "run", quiet=True)


class Falls(Bits):
    """Ends where the first bits are set, of which ``compute_terminated`` knows nothing."""

    late = 200

    def step(self, action: Any) -> Any:
        seen, paid, _, limit, info = super().step(action)
        self.late -= 1
        return seen, paid, self.late < 0 and bool(self.bits[:2].all()), limit, info

    def compute_terminated(self, achieved: Any, desired: Any, info: Any) -> Any:
        return np.zeros(achieved.shape[:-1], bool)


class Differ(Bits):
    """Achieved and desired goals are of different spaces."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space["desired_goal"] = gym.spaces.MultiBinary(self.size)


class Cosine(Bits):
    """The reward is not a number where the goal is reached."""

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        away = np.abs(achieved - desired).sum(axis=-1)
        with np.errstate(invalid="ignore"):
            return -away * (away / away)

    def step(self, action: Any) -> Any:
        return self.see(), 0.0, False, True, {}


class Pair(Bits):
    """The reward comes with something else."""

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return 0.0, {}

    def step(self, action: Any) -> Any:
        return self.see(), 0.0, False, True, {}


@pytest.mark.filterwarnings("ignore:.*does not repeat itself")
@pytest.mark.parametrize(
    ("env", "kind", "words"),
    [
        (Falls, TrainingError, "the end of one is now 0, and was 1"),
        (Differ, DeclarationError, "both must have one space"),
        (Cosine, EnvError, r"compute_reward\(\) returned nan"),
        (Pair, EnvError, r"compute_reward\(\) returned"),
    ],
)
def test_an_environment_that_judges_oddly_is_told(env, kind, words, tmp_path):
    config = replace(BITS, learning_starts=60)
    with pytest.raises(kind, match=words):
        sw.train_agent(env, config, 2_000, tmp_path / "run", seed=0, quiet=True)


class Parts(Bits):
    """Goals have parts; what is near is set by a reset."""

    def __init__(self) -> None:
        super().__init__()
        bits = self.observation_space["observation"]
        goal = gym.spaces.Dict({"all": bits})
        parts = {"observation": bits, "achieved_goal": goal, "desired_goal": goal}
        self.observation_space = gym.spaces.Dict(parts)

    def see(self) -> Any:
        seen = super().see()
        return {k: v if k == "observation" else {"all": v} for k, v in seen.items()}

    def reset(self, **how: Any) -> Any:
        self.near = 0
        return super().reset(**how)

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        pair = (x["all"] if isinstance(x, dict) else x for x in (achieved, desired))
        return 0.0 - (np.abs(np.subtract(*pair)).sum(axis=-1) > self.near)

    def compute_terminated(self, achieved: Any, desired: Any, info: Any) -> Any:
        return self.compute_reward(achieved, desired, info) == 0


def test_goals_with_parts_reach_the_environment_as_dicts(tmp_path):
    config = replace(BITS, learning_starts=60, num_envs=2)
    sw.train_agent(Parts, config, 300, tmp_path / "run", seed=0, quiet=True)


@pytest.mark.parametrize("case", ["time", "still"])
def test_a_legal_reward_is_no_mistake(case, tmp_path):
    class Legal(GoTo):
        def near(self, step: Any) -> Any:
            there = super().near(step)
            if case == "still":  # it is never true of a policy that has not learnt
                there &= (step.obs == step.next_obs).all(axis=1)
            return there

        def reward(self, step: Any) -> Any:
            return self.near(step) - 1.0 - (case == "time") / step.elapsed

    how = pytest.warns(UserWarning, match="success.. is false in all")
    with how if case == "still" else nullcontext():
        algorithm = replace(HER, learning_starts=120)
        Legal.algorithm = algorithm
        going(Legal).train(tmp_path / "run", quiet=True)


def test_a_choice_that_is_no_goal_is_refused(tmp_path):
    class Corner(GoTo):
        goal_space = gym.spaces.Discrete(3)

        def achieved_goal(self, obs: Any) -> Any:
            return np.full(len(obs), -1)

        def near(self, step: Any) -> Any:
            return step.goal == 1

    with pytest.raises(sw.errors.SkillError, match=r"gave the goal -1, which is out of goal_space"):
        going(Corner).train(tmp_path / "run", quiet=True)


def test_goals_in_other_units_are_told(tmp_path):
    class Degrees(GoTo):
        algorithm = replace(HER, learning_starts=120)

        def achieved_goal(self, obs: Any) -> Any:
            return 57.3 * obs + 10

        def near(self, step: Any) -> Any:
            return np.linalg.norm(self.achieved_goal(step.next_obs) - step.goal, axis=1) < 9

    with pytest.warns(UserWarning, match="are they in the same units"):
        going(Degrees).train(tmp_path / "run", quiet=True)


def test_a_selector_has_no_hindsight(tmp_path):
    selector = sw.DQN(num_envs=4, learning_starts=20, network=SMALL, hindsight=True)
    goals = gym.spaces.Discrete(3)

    class Cell(GoTo):
        goal_space = goals

        def achieved_goal(self, obs: Any) -> Any:
            return obs[:, 0].astype(int) % 3

        def near(self, step: Any) -> Any:
            return self.achieved_goal(step.next_obs) == step.goal

    with pytest.raises(DeclarationError, match="selector 'selector' cannot learn with hindsight"):
        going(Cell, selector=selector).train(tmp_path / "run", quiet=True)
