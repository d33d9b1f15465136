"""Functions of users that keep a state: an error where asking twice shows it, else one notice."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable
from functools import cached_property
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from skillweave import tree
from skillweave._internal.notices import collected_notices
from skillweave.calls import Predicate
from skillweave.data.dataset import Dataset
from skillweave.data.segmenting import _Cuts
from skillweave.errors import DeclarationError, PolicyError, SkillError
from skillweave.experience.judges import SkillJudge
from skillweave.planning import GoalTask, RewardMachine
from skillweave.policies.core import LastCall, Turn, World
from skillweave.policies.spaces import space_of
from skillweave.skills import Automaton, Reflex, Skill, call_method, from_function, ready_selector
from skillweave.skills.foreign_policy import check_spaces
from skillweave.skills.goal_spaces import choice_space
from skillweave.skills.goals import Goals
from skillweave.skills.outputs import call_checked, call_user
from skillweave.skills.probing import look_at
from skillweave.types import Memoryless, Step


def step(n: int = 4) -> Step:
    obs = np.arange(n, dtype=np.float32)[:, None]
    never = np.zeros(n, bool)
    one = np.ones(n)
    return Step(obs, one, obs + 1, one, never, never, never, one, {})


class Counts(Skill):
    calls = 0

    def reward(self, step):
        self.calls += 1
        return step.reward * self.calls


class Progress(Skill):
    """Pays what the best value so far grows by: nothing, when it sees the same again."""

    best = -np.inf

    def reward(self, step):
        gain = np.maximum(step.next_obs[:, 0] - max(self.best, -1.0), 0.0)
        self.best = max(self.best, float(step.next_obs.max()))
        return gain


class Patient(Skill):
    """Stops at the second time."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def termination(self, step):
        self.seen.append(len(step.reward))
        return np.full(len(step.reward), len(self.seen) > 1)


class Shy(Skill):
    waits = 3

    def initiation(self, obs):
        self.waits -= 1
        return np.full(len(obs), self.waits < 2)


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        (Counts, "reward"),
        (Progress, "reward"),
        (Patient, "termination"),
        (Shy, "initiation"),
    ],
)
def test_a_skill_that_answers_otherwise_when_asked_twice_is_named(kind, method):
    about = step().obs if method == "initiation" else step()
    message = rf"skill '{kind.name}': {method}\(\) answers .* keeps a state of its own.*info"
    with pytest.raises(SkillError, match=message):
        call_method(kind(), method, about)


class Noisy(Skill):
    """Pays random numbers, of every kind of generator."""

    def __init__(self):
        super().__init__()
        self.numbers = np.random.default_rng(0)
        self.python = random.Random(0)

    def reward(self, step):
        n = len(step.reward)
        return (
            self.numbers.random(n)
            + np.random.rand(n)  # noqa: NPY002
            + random.random()
            + self.python.random()
        )


def test_random_rewards_are_no_state():
    skill, twin = Noisy(), Noisy()
    np.random.seed(1)  # noqa: NPY002
    random.seed(1)
    first = call_method(skill, "reward", step())
    after = np.random.rand(), random.random()  # noqa: NPY002
    np.random.seed(1)  # noqa: NPY002
    random.seed(1)
    assert first.tolist() == twin.reward(step()).astype(np.float32).tolist()
    assert after == (np.random.rand(), random.random()), "the checks draw no numbers of their own"  # noqa: NPY002
    assert len(call_method(skill, "reward", step())) == 4


def test_a_reflex_that_keeps_a_state_is_named():
    seen = []

    def second_time(obs):
        seen.append(1)
        return np.full(len(obs), len(seen) > 1)

    with pytest.raises(SkillError, match=r"reflex 'second_time': condition\(\) answers 0, and 1"):
        Reflex(second_time, 0).holds(step().obs)


def test_a_reward_that_is_meant_to_change_says_so():
    class Bonus(Counts):
        reward_changes = True

    class Wrong(Counts):
        reward_changes = "yes"

    assert call_method(Bonus(), "reward", step()).tolist() == [1] * 4
    with pytest.raises(DeclarationError, match="reward_changes is 'yes'; it must be True or False"):
        Wrong().validate()


# Notices

OBS = step().next_obs
SPACES = Box(-10, 10, (1,)), Discrete(2)


class Best:
    """Keeps the best so far, so it answers the same when it is called twice in a row."""

    best = 0.0

    def __call__(self, about):
        obs = getattr(about, "next_obs", about)
        self.best = max(self.best, float(obs.max()))
        return np.full(len(obs), int(self.best > 1))


class Two(Best):
    def __call__(self, about, other):
        return super().__call__(about)


class Goal(Best):
    def __call__(self, obs, other):
        return super().__call__(obs)[:, None]


class OfObservations(Best):
    def __call__(self, obs):
        return super().__call__(obs)[:, None]


class Own(Memoryless):
    observation_space, action_space = SPACES

    def __init__(self):
        self.inner = Best()

    def act(self, memory, obs):
        return self.inner(obs), memory


def acts(**how):
    policy = from_function(Best(), **how).bind(*SPACES, "it")

    def tried() -> None:
        policy.try_out()
        policy.act({}, OBS)

    return tried


def reads(function):
    def bound() -> None:
        policy = from_function(lambda x: np.zeros(len(x), int), sees=function)
        policy.bind(*SPACES, "it").act({}, OBS)

    return bound


def chooses(value):
    selector = ready_selector(value, ("a", "b"))
    assert selector is not None
    rule, last = selector.in_place, LastCall(*np.zeros((3, 4), int))
    rows, turn = np.arange(4), Turn(World())

    def chosen() -> None:
        rule.act(rule.start(4), rows, OBS, turn)
        rule.watch(rule.start(4), rows, step(), last)

    return chosen


def method(name: str):
    base = Goal if name in Skill.of_goals else Best
    declared = {name: base.__call__, "goal_space": Box(0, 9, (1,))}
    goals = Goals(type("Kind", (base, Skill), declared)())
    about = OBS if name == "initiation" else step()
    ways = {
        "goals": lambda: goals.draw(OBS, np.random.default_rng(0)),
        "clip_goal": lambda: goals.fitted(OBS, OBS, "it"),
    }
    return ways.get(name, lambda: call_method(goals.skill, name, about))


def achieves():
    declared = {"achieved_goal": OfObservations.__call__, "goal_space": Box(0, 9, (1,))}
    judge = SkillJudge(type("Kind", (OfObservations, Skill), declared)(), None, *SPACES)
    return lambda: judge.achieved(OBS)


def cuts():
    """Goals of calls in data, by a function of the user."""
    episode = {"observations": np.ones((5, 1), np.float32), "actions": np.zeros(4, int)}
    spaces = {"observation_space": SPACES[0], "action_space": SPACES[1]}
    found = cast(Any, object.__new__(_Cuts))
    found.data = Dataset([episode], **spaces)
    found.skills = SimpleNamespace(skills=[SimpleNamespace(name="a")])
    found.given = [OfObservations()]
    declared = {"goal_space": Box(0, 9, (1,))}
    goals = Goals(type("Kind", (Goal, Skill), declared)())
    return lambda: found._goals(0, goals)


def places() -> dict[str, list[Callable[[], Any]]]:
    """Return uses of functions of the user, by the modules that call them."""
    never = Predicate(lambda obs: obs[:, 0] > 9)
    machine = RewardMachine({("a", "b"): (never, Best())}, accepting={"b"})
    task, inverse = GoalTask(Two(), goal=[1.0]), ~Predicate(Best())
    own = cast(Any, Own())
    choices = choice_space(1, {"a": Box(0, 9, (1,))}, ["a"])
    by_function = Automaton({"x": ("a", OfObservations())}, {}).among(("a",))
    with_goals = by_function.bind(SPACES[0], choices, "it")
    condition, reflex = Reflex(Best(), 0), Reflex(lambda obs: obs[:, 0] > -1, Best())
    actions = space_of(SPACES[1])
    return {
        "experience.judges": [achieves()],
        "planning.goal": [lambda: task.holds(OBS, OBS)],
        "calls.predicates": [lambda: inverse.at(OBS)],
        "skills.selector": [
            chooses(Automaton({"x": "a", "y": "b"}, {("x", "y"): Best()})),
            chooses(tree.Fallback(tree.Sequence(Best(), "a"), "b")),
            lambda: with_goals.act({"state": np.zeros(4, int)}, OBS),
            lambda: machine.acts.read(step()),
            chooses(Best()),
            chooses(Two()),
        ],
        "skills.base": [
            lambda: condition.holds(OBS),
            lambda: reflex.override(actions).apply(OBS, actions.start(4), actions),
            *map(method, Skill.methods),
        ],
        "data.segmenting": [cuts()],
        "skills.foreign_policy": [lambda: check_spaces(own, *SPACES, "it", "env")],
        "skills.goals": [method("goals"), method("clip_goal")],
        "skills.scripted": [acts(), acts(sees={"about": slice(0, 1)}), reads(Best())],
    }


@pytest.mark.parametrize("place", sorted(places()))
def test_each_function_that_keeps_a_state_gets_one_notice(place):
    for act in places()[place]:
        with collected_notices() as notices:
            for _ in range(4):
                act()
        assert len(notices.take()) == 1


def test_every_module_that_calls_functions_of_the_user_is_tested():
    others = ("outputs", "probing")  # of all, or before them
    calls = {
        name.removeprefix("skillweave.")
        for name, module in sys.modules.items()
        if name.startswith("skillweave.") and not name.endswith(others)
        for rule in (call_user, call_checked, look_at)
        if vars(module).get(rule.__name__) is rule
    }
    assert calls == set(places())


class Fine:
    """Writes what is written once, or what no answer depends on."""

    table = None
    calls = 0

    def __init__(self):
        self.known = {}
        self.buffer, self.rng, self.python = np.zeros(0), np.random.default_rng(0), random.Random(0)

    @cached_property
    def scale(self) -> float:
        return 2.0

    def __call__(self, obs):
        self.calls += 1
        self.table = np.arange(3.0) if self.table is None else self.table
        self.buffer = self.buffer if len(self.buffer) == len(obs) else np.ones(len(obs))
        values = [self.known.setdefault(x, x * self.scale) for x in obs[:, 0].tolist()]
        self.last = self.rng.random(len(obs)) + self.python.random() + random.random()
        return self.last + values + self.table[1] + self.buffer


def test_caches_generators_and_unread_attributes_are_no_state():
    fine = Fine()
    for _ in range(4):  # a notice would be an error here
        call_user(fine, OBS, "it")
    assert fine.calls == 4, "the calls to find a state leave no trace"


class Shaped:
    last = None

    def __call__(self, obs):
        self.last = obs[:, 0] if self.last is None else self.last + obs[:, 0]
        return (self.last > 1).astype(int)


def test_a_state_of_the_shape_of_the_first_call_is_named():
    with pytest.raises(PolicyError, match=r"for 3 it raised .* last, .*state="):
        from_function(Shaped()).bind(*SPACES, "it").try_out()
