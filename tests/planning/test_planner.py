"""Plans on logged calls: against dynamic programming, and played."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from call_logs.logs import log_of
from call_logs.untrained import SKILLS, skill_set
from goals.worlds import Point
from planning.steps import assert_not_repeated, at, step_to
from ready_selectors.chain import (
    DOOR,
    KEY,
    PLACE,
    SPEC,
    Corridor,
    InDict,
    has_key,
)
from ready_selectors.watching import watched
from toys import skills_of

from skillweave import EnvSpec, Hierarchy, evaluate
from skillweave.calls import CallLog, Predicate, held, record_calls
from skillweave.calls.neighbors import nearest, tie_order
from skillweave.errors import DeclarationError, RunError, SkillError
from skillweave.planning import Explorer, GoalTask, Mission, Planner, RewardMachine, either
from skillweave.planning.graph import LEVELS, exact_states, planning_states
from skillweave.policies.core import CallEnd
from skillweave.policies.plan import nearest_corner
from skillweave.skills import LastCall, Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet
from skillweave.types import Array, HierarchyPolicy

GAMMA = 0.9
LINE = 10


def moved(place: int, by: int) -> list[int]:
    """Three steps on a line from 0 to 10."""
    inside = []
    for _ in range(3):
        place = int(np.clip(place + by, 0, LINE))
        inside.append(place)
    return inside


def line() -> CallLog:
    """A call of both skills from each place: three steps to the left, or to the right."""
    calls = [(p, [(i, moved(p, by), True, "limit")]) for p in range(LINE + 1) for i, by in
             enumerate((-1, 1))]  # fmt: skip
    return log_of(["left", "right"], calls)


def by_dynamic_programming(task: RewardMachine, sweeps: int = 200) -> dict[Any, list[float]]:
    """Q of both skills by (place, state of the task), as a tuple of whole numbers."""

    def outcome(place: int, state, by: int):
        paid, now = 0.0, np.array([state])
        for k, there in enumerate(moved(place, by)):
            now, reward, _ = task.step(now, step_to([[there]]))
            paid += GAMMA**k * reward[0]
        return paid, there, tuple(now[0].tolist())

    places = range(LINE + 1)
    start = tuple(task.start(1)[0].tolist())
    states, queue, results = {start}, [start], {}
    while queue:
        state = queue.pop()
        for place in places:
            for i, by in enumerate((-1, 1)):
                results[place, state, i] = outcome(place, state, by)
                after = results[place, state, i][2]
                if after not in states:
                    states.add(after)
                    queue.append(after)
    q = {(p, s): [0.0, 0.0] for p in places for s in states}
    for _ in range(sweeps):
        q = {
            (p, s): [
                r + GAMMA**3 * max(q[there, after])
                for r, there, after in (results[p, s, i] for i in range(2))
            ]
            for p, s in q
        }
    return q


TASKS = {
    "there and back": Mission(at(9), at(1)),
    "choice": Mission(at(5), either(at(0), at(10)), at(5)),
    "avoid": Mission(at(0), at(10), avoid=at(4)),
    "costs": RewardMachine(
        {("on", "off"): (at(7), 5.0)}, accepting={"off"}, each_step=lambda s: -s.next_obs[:, 0]
    ),
    "held": Mission(held(at(10), 5), at(0)),
    "forever": Mission(at(2), at(8), repeat=None),
}


@pytest.mark.parametrize("name", TASKS)
def test_values_are_those_of_dynamic_programming(name):
    task = TASKS[name]
    planner = Planner(line(), task, neighbors=1, gamma=GAMMA, caution=0.0)
    for (place, state), wanted in by_dynamic_programming(task).items():
        got = planner.values(np.array([[place]], np.float32), np.array([state]))[0]
        np.testing.assert_allclose(got, wanted, atol=2e-3, err_msg=f"{place} {state}")


def test_values_are_weighted_means_of_the_nearest_calls():
    # From about 0, "jump" reached 5 in one of two logged calls.
    log = log_of(
        ["jump", "sit"],
        [(-0.01, [(0, [5], True, "own")]), (0.03, [(0, [0], True, "own")]),
         (0, [(1, [0], True, "own")])],
    )  # fmt: skip
    planner = Planner(log, at(5), neighbors=2, gamma=0.5, caution=0.0)
    scale = 1 / np.concatenate([log.start, log.end]).std()
    w = np.array([1 / (0.01 * scale + 0.01), 1 / (0.03 * scale + 0.01)])
    share = w[0] / w.sum()
    q = planner.values(np.zeros((1, 1), np.float32))[0]
    assert 0.5 < share <= q[0] < 1
    assert q[1] < q[0]
    # With one neighbor, the nearer one alone counts.
    sure = Planner(log, at(5), neighbors=1, gamma=0.5, caution=0.0)
    assert sure.values(np.zeros((1, 1), np.float32))[0, 0] == pytest.approx(1.0)
    # A distance costs a share of the value; the two calls are 0.04 apart, which is usual.
    careful = Planner(log, at(5), neighbors=1, gamma=0.5, caution=1.0)
    far = careful.values(np.float32([[-0.01], [-0.5]]))[:, 0]
    assert far[0] == pytest.approx(1.0, abs=1e-3)
    assert far[1] == pytest.approx(1 / (1 + 0.49 / 0.04), abs=1e-3)


def test_nothing_follows_where_the_episode_terminated():
    log = log_of(
        ["go"],
        [
            (0, [(0, [1], True, "end")]),
            (2, [(0, [3], True, "limit")]),
            (1, [(0, [3], True, "own")]),
        ],
    )
    planner = Planner(log, at(3), neighbors=1, gamma=GAMMA, caution=0.0)
    assert planner.values(np.float32([[0], [1], [2]]))[:, 0].tolist() == pytest.approx([0, 1, 1])
    cut = Planner(
        replace(log, terminated=log.terminated & False, truncated=log.terminated),
        at(3), neighbors=1, gamma=GAMMA, caution=0.0,
    )  # fmt: skip
    assert cut.values(np.float32([[0]]))[0, 0] == pytest.approx(GAMMA)


@pytest.mark.parametrize("why", ["cut", "interrupted"])
def test_a_call_that_was_cut_would_have_gone_on(why):
    """From 3 "back" leads to the goal, but "go", which was cut there, goes on to where all ends."""
    log = log_of(
        ["go", "back"],
        [
            (0, [(0, [1, 2, 3], True, "cut")]),
            (3, [(0, [4, 5, 6], True, "end")]),
            (3, [(1, [-1], True, "own")]),
        ],
    )
    if why == "interrupted":
        first = np.arange(len(log)) == 0
        reason = np.where(first, CallEnd.INTERRUPTED, log.end_reason).astype(np.int8)
        log = replace(log, end_reason=reason, truncated=np.zeros(len(log), bool))
    planner = Planner(log, at(-1), neighbors=1, gamma=GAMMA, caution=0.0)
    q = planner.values(np.float32([[0], [3]]))
    assert q[:, 0].tolist() == [0, 0]
    assert q[1, 1] == pytest.approx(1.0)


def test_a_position_that_a_skill_does_not_see_counts():
    """A number that changes in most steps says where a call ends; the skill sees another one."""
    calls = [
        ((p, p % 2), [(0, [(p + 1, (p + 1) % 2), (p + 2, p % 2)], True, "own")]) for p in range(9)
    ]
    log = replace(log_of(["go"], calls, size=2), sees=((1,),))
    planner = Planner(log, at(5), neighbors=1, gamma=GAMMA, caution=0.0)
    q = planner.values(np.float32([[3, 1], [8, 0]]))[:, 0]
    assert q[0] > q[1] == 0.0


def test_only_what_may_follow_counts():
    log = line()
    may = np.ones((len(log), 2), bool)
    may[log.end[:, 0] == 6, 1] = False  # at 6 "right" may not start
    planner = Planner(replace(log, may_follow=may), at(9), neighbors=1, gamma=GAMMA, caution=0.0)
    q = planner.values(np.float32([[3], [4]]))
    free = Planner(log, at(9), neighbors=1, gamma=GAMMA, caution=0.0)
    q_free = free.values(np.float32([[3], [4]]))
    assert q[0, 1] < q_free[0, 1]
    assert q[1, 1] == pytest.approx(q_free[1, 1])
    bound = planner.among(("left", "right"))
    memory = bound.start(1)
    choice, _ = bound.act(memory, np.float32([[4]]), np.array([[True, False]]))
    assert choice.tolist() == [0]


def test_a_counter_that_is_longer_than_a_call_leads_on():
    """The levels of a long counter lie several steps apart, and a call has 3."""
    at_end = np.float32([[10]] * 4)
    for steps in (100, 1_000):
        task = Mission(held(at(10), steps))
        planner = Planner(line(), task, neighbors=1, gamma=0.999, caution=0.0)
        assert planning_states(task).count == min(steps, LEVELS) + 1
        counted = np.array([0, steps // 3, steps // 2, steps - 3])
        q = planner.values(at_end, np.stack([0 * counted, counted], 1))
        assert (q[:, 1] > q[:, 0]).all()
        np.testing.assert_allclose(q[:, 1], 0.999 ** (steps - 1 - counted), rtol=0.03)


def test_levels_of_counters():
    task = RewardMachine(
        {("a", "b"): held(at(1), 4), ("b", "c"): [held(at(1), 100), held(at(2), 3)]},
        accepting={"c"},
    )
    states = planning_states(task)
    exact = exact_states(states)
    assert states.count == 4 + 64 * 3 + 1  # fewer levels, as there would be too many
    assert exact[:5].tolist() == [[0, 0, 0], [0, 1, 0], [0, 2, 0], [0, 3, 0], [1, 0, 0]]
    rng = np.random.default_rng(0)
    state = np.stack([np.ones(50, int), rng.integers(100, size=50), rng.integers(3, size=50)], 1)
    places, weights = states.corners(state)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    mean = (exact[places] * weights[..., None]).sum(1)
    np.testing.assert_allclose(mean, state, atol=0.51)  # a level is a whole number
    assert (nearest_corner(*states.corners(exact)) == np.arange(states.count)).all()


def test_every_length_is_learnt_from_the_longest():
    """A call of three steps also says what one and two steps would have done."""
    plain = line()
    lengths = (1, 2, 3)
    log = replace(
        plain,
        lengths=lengths,
        choice=plain.skill * 3 + 2,
        may_follow=np.ones((len(plain), 6), bool),
    )
    planner = Planner(log, Mission(at(4), at(5), at(4)), neighbors=1, gamma=GAMMA, caution=0.0)
    q = planner.values(np.float32([[3]]))[0]
    # Right for two steps: 4, 5; then left for one.
    assert q[3] == q[4] == q.max()
    assert q[4] == pytest.approx((1 + GAMMA + GAMMA**2) / 3, abs=2e-3)
    # Of a call that was chosen short, nothing is known about longer ones.
    short = replace(log, choice=plain.skill * 3)
    assert (
        Planner(short, at(9), neighbors=1).values(np.float32([[3]]))[0].tolist()[1:3]
        == [-np.inf] * 2
    )


def test_goals_that_observations_hold():
    def near(obs: Array, goal: Array) -> Array:
        return obs[:, 0] == goal[..., 0]

    calls = []
    for p in range(LINE + 1):
        for i, by in enumerate((-1, 1)):
            inside = [(x, 3) for x in moved(p, by)]
            stops = next((k for k, x in enumerate(inside) if x[0] == 3), None)
            why = "limit" if stops is None else "end"  # the log's own goal is 3
            calls.append(
                ((p, 3), [(i, inside[: None if stops is None else stops + 1], False, why)])
            )
    log = log_of(["left", "right"], calls, size=2)
    task = GoalTask(near, columns=(1,))
    planner = Planner(log, task, features=[0], neighbors=1, gamma=GAMMA, caution=0.0)
    for goal in (0, 3, 8, 10):
        q = planner.values(np.float32([[p, goal] for p in range(LINE + 1)]))
        for p in range(LINE + 1):
            if p != goal:
                assert q[p].argmax() == int(goal > p), (p, goal)
                wanted = GAMMA ** (abs(goal - p) - 1)
                assert q[p].max() == pytest.approx(wanted, rel=0.02), (p, goal)
    bound = planner.among(log.skills)
    obs = np.float32([[5, 0], [5, 10], [5, 3]])
    choice, memory = bound.act(bound.start(3), obs)
    assert choice.tolist() == [0, 1, 0]
    last = LastCall(choice, np.full(3, CallEnd.RUNNING, np.int8), np.zeros(3, bool))
    memory = watched(bound, memory, step_to([[4, 0], [6, 10], [3, 3]], obs), last)
    assert memory["state"].tolist() == [0, 0, 1]


def test_a_call_that_failed_is_not_repeated_forever():
    """The log says that "right" leads from 2 to 3; now there is a wall."""
    log = line()
    planner = Planner(log, at(9), neighbors=1, gamma=GAMMA).among(log.skills)
    assert_not_repeated(planner, lambda choice: choice == 1)
    # A new episode has none of it.
    assert planner.act(planner.start(1), np.float32([[2]]))[0].tolist() == [1]


# Played


def open_door(obs: Array) -> Array:
    return obs[:, DOOR] == 1


def at_end(obs: Array) -> Array:
    return obs[:, PLACE] > 6


def at_three(obs: Array) -> Array:
    return obs[:, PLACE] == 3


@pytest.fixture(scope="module")
def log() -> CallLog:
    return record_calls(SPEC, skill_set(), 3_000, num_envs=8)


def policy_of(planner: Planner, skills: SkillSet) -> HierarchyPolicy:
    choices = gym.spaces.Discrete(skills.choices)
    selector = planner.among(tuple(s.name for s in skills.skills))
    return HierarchyPolicy(selector.bind(SPEC.spaces.observation, choices, "selector"), skills)


def test_it_plays_new_tasks_in_the_corridor(log):
    named = {"key": has_key, "open": open_door, "end": at_end, "three": at_three}
    planner = Planner(log, "key then open then end", predicates=named, skills=skill_set())
    played = evaluate(policy_of(planner, skill_set()), SPEC, episodes=20)
    assert np.mean(played.returns) == 1.0
    # Wait at 3 with the key: only single steps lead there, which "leave" takes.
    task = Mission.from_text("key then three for 4 steps, avoid open", named)
    policy = policy_of(Planner(log, task, skills=skill_set()), skill_set())
    for seed in range(5):
        env, memory = Corridor(), policy.start(1)
        obs, _ = env.reset(seed=seed)
        state = task.start(1)
        for t in range(40):
            action, memory = policy.act(memory, obs[None])
            before, (obs, *_) = obs, env.step(int(action[0]))
            step = step_to(obs[None], before[None], elapsed=np.array([t + 1]))
            memory = policy.observe(memory, step)
            state, _, _ = task.step(state, step)
        assert task.has_succeeded(state)[0]


class Field(gym.Env):
    """A long line: at random a walk does not leave its middle."""

    observation_space = gym.spaces.Box(-99, 99, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.t = 0.0, 0
        return np.float32([self.place]), {}

    def step(self, action: int):
        self.place, self.t = float(np.clip(self.place + 2 * action - 1, -50, 50)), self.t + 1
        return np.float32([self.place]), 0.0, False, self.t == 60, {}


def pair_in(spec: EnvSpec, left, right) -> SkillSet:
    """Skills of two steps that always take the same action."""

    def go(name: str, action):
        policy = ScriptedPolicy(lambda obs: np.repeat([action], len(obs), 0), *spec.spaces)
        return type(name, (Skill,), {"max_steps": 2, "policy": policy})()

    return skills_of(go("left", left), go("right", right))


def test_exploring_reaches_further_than_chance():
    spec = EnvSpec(Field, engine="sync")
    skills = pair_in(spec, 0, 1)
    explorer = Explorer(0.1, every=200, temperature=0.01)
    assert explorer.new_share() == 1.0
    seen = record_calls(spec, skills, 2_400, num_envs=4, choose=explorer)
    chance = record_calls(spec, skills, 2_400, num_envs=4)
    assert np.abs(seen.next_obs).max() > 1.5 * np.abs(chance.next_obs).max()
    assert explorer.new_share() < 0.3
    assert record_calls(spec, skills, 40, choose="explore").steps >= 40


def test_more_calls_than_a_graph_holds(log, monkeypatch):
    monkeypatch.setattr("skillweave.planning.graph.MOST_CALLS", 50)
    with pytest.warns(UserWarning, match="the plan uses 50 of them"):
        planner = Planner(log, has_key)
    assert len(planner.graph.log) == 50


def long_calls() -> CallLog:
    """Two calls that cross the whole line, and sit there."""
    right = [*range(1, LINE + 1), *[LINE] * 30]
    left = [LINE - x for x in right]
    return log_of(
        ["left", "right"], [(0, [(1, right, True, "limit")]), (LINE, [(0, left, True, "limit")])]
    )


def test_a_call_says_what_its_skill_does_from_everywhere_that_it_passed():
    log = long_calls()
    planner = Planner(log, Mission(at(8), at(2)), neighbors=1, gamma=GAMMA, caution=0.0)
    # From 5, which is passed in the middle of both calls: "right" reaches 8 after 3 steps, the end
    # of the call after 30 more, and from there "left" reaches 2 after 8.
    pieces = planner.graph.pieces
    assert (pieces.choice == 1).sum() == 8
    q = planner.values(np.float32([[5], [10]]), np.array([[0], [1]]))
    assert q[0, 1] == pytest.approx(GAMMA**2 / 2 + GAMMA ** (35 + 7) / 2, rel=1e-3)
    assert q[1, 0] == pytest.approx(GAMMA**7 / 2, rel=1e-3)
    # The counters of a task go on from piece to piece.
    sits = Planner(log, Mission(held(at(10), 20)), neighbors=1, gamma=GAMMA, caution=0.0)
    assert sits.values(np.float32([[0]]))[0, 1] == pytest.approx(GAMMA**28, rel=1e-3)
    # A skill with a memory does something else if it is called in the middle.
    with pytest.warns(UserWarning, match="these skills have a memory: left. The planner"):
        whole = Planner(replace(log, recurrent=(True, False)), at(8))
    assert np.bincount(whole.graph.pieces.choice).tolist() == [1, 8]


def test_neighbors_are_of_other_calls_each_and_of_equally_near_ones_the_same():
    points = np.float32([[0], [0.1], [0.2], [1], [5], [6]])
    group = np.array([7, 7, 7, 8, 9, 9])
    near, far = nearest(points, np.float32([[0.12], [5.9]]), 4, group)
    assert near[:, :3].tolist() == [[1, 3, 4], [5, 3, 0]] or near[1, 2] == 2
    np.testing.assert_allclose(far[0, :3], [0.02, 0.88, 4.88], atol=1e-6)
    assert np.isinf(far[:, 3]).all()
    # However equally near ones are searched: an export's runner must find the same ones.
    points = np.float32([[x] for x in (2, *[1] * 12, *[0.999_999_9] * 12)])
    order = tie_order(len(points))
    found = order[np.isin(order, range(1, 13))][:5]
    for to in ([[1]], [[1], [0.3], [5]]):
        near, far = nearest(points, np.float32(to), 5, np.arange(len(points)))
        assert near[0].tolist() == found.tolist()
        assert (far[0] == 0).all()


def test_a_skill_without_a_call_is_never_called(log):
    some = log.take(np.flatnonzero(log.skill != 3))
    with pytest.warns(UserWarning, match="no call of 'wait', so the planner never calls it"):
        planner = Planner(some, has_key)
    assert planner.values(log.start[:5])[:, 3].tolist() == [-np.inf] * 5
    with pytest.warns(UserWarning, match="never calls it"):
        bold = Planner(some, has_key, caution=0.0)
    assert bold.values(log.start[:5])[:, 3].tolist() == [-np.inf] * 5
    assert np.isfinite(bold.values(log.start[:5])[:, :3]).all()


def test_a_log_that_does_not_lead_there_says_so(log):
    def beyond(obs: Array) -> Array:
        return obs[:, PLACE] > 9

    with pytest.raises(RunError, match=r"'beyond' never holds in the 3,\d+ steps.*'leave' comes"):
        Planner(log, Mission(has_key, beyond, at_three))

    def never(step):
        return step.reward > 5

    with pytest.raises(RunError, match=r"'never' and .* never hold in .*check the predicate"):
        Planner(log, either(never, Predicate(beyond) & at_three))
    # What is avoided need not happen, and neither need one part of a choice.
    Planner(log, Mission(either(never, has_key), avoid=beyond))


def test_what_a_predicate_cannot_read_is_named(log):
    def opened(step):
        return step.info["door"] == 1

    with pytest.raises(RunError, match=r"reads info\['door'\].*record it: .*info=\['door'\]"):
        Planner(log, Predicate(opened))
    with pytest.raises(RunError, match="which the log does not have"):
        log.handover({"wait": opened})
    known = record_calls(SPEC, skill_set(), 500, info=["door"])
    assert Planner(known, Predicate(opened)).values(known.start[:1]).max() > 0
    # A function of a step that is given observations
    with pytest.raises(SkillError, match="its argument is not named 'step': write lambda step"):
        Planner(log, lambda s: s.reward > 0)
    Planner(log, lambda step: step.next_obs[:, KEY] == 1.0)


def test_other_skills_and_spaces_and_a_log_of_one_call_are_refused(log):
    planner = Planner(log, has_key)
    with pytest.raises(RunError, match="the hierarchy has a, b; record a log"):
        planner.among(("a", "b"))
    box = gym.spaces.Box(-1, 1, (5,), np.float32)
    with pytest.raises(RunError, match="the log has observations of"):
        planner.among(log.skills).bind(box, gym.spaces.Discrete(4), "selector")
    with pytest.raises(RunError, match="'get_key' has changed since the log was recorded"):
        Planner(log, has_key, skills=skill_set(call_steps=3))
    with pytest.raises(RunError, match="the log has 1 call, and nothing can be planned"):
        Planner(log.take(np.array([0])), has_key)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"log": 3}, "log is 3; it must be .*CallLog"),
        ({"task": 3}, "the task is 3"),
        ({"task": "key"}, "'key' is no known predicate"),
        ({"gamma": 1.1}, "gamma is 1.1; it must be between 0 and 1"),
        ({"neighbors": 0}, "neighbors is 0"),
        ({"temperature": -1}, "temperature is -1"),
        ({"skills": 3}, "skills is 3; give a policy"),
        ({"features": [7]}, r"of skill 'get_key' are \[7\]; give places"),
        ({"features": {"walk": [0]}}, "names 'walk', which is no skill"),
        ({"features": lambda obs: obs[:, 9]}, "raised IndexError"),
        ({"features": lambda obs: obs[:2]}, r"returned shape \(2, 3\)"),
        ({"features": "place"}, r"features is 'place'; give places"),
        (
            {"features": lambda obs: obs * np.nan},
            "feature 0 of skill 'get_key' is not finite in the log",
        ),
        (
            {"features": lambda obs: obs[:, :1] * 0},
            "all features of skill 'get_key' are constant",
        ),
    ],
)  # fmt: skip
def test_wrong_arguments_of_a_planner(log, how, message):
    with pytest.raises(DeclarationError, match=message):
        Planner(**({"log": log, "task": has_key} | how))


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"features": 3}, "Explorer: features is 3; give places"),
        ({"gamma": 2}, "Explorer: gamma is 2; it must be between 0 and 1"),
        ({"temperature": 0}, "Explorer: temperature is 0"),
        ({"radius": 0}, "radius is 0; it must be positive"),
    ],
)
def test_wrong_arguments_of_an_explorer(how, message):
    with pytest.raises(DeclarationError, match=message):
        Explorer(**how)


def test_observations_in_a_dict_are_planned_on():
    spec = EnvSpec(lambda: InDict(Corridor()), engine="sync")
    skills = pair_in(spec, 0, 2)
    log = record_calls(spec, skills, 1_500, num_envs=4)
    task = Mission(lambda obs: obs["at"][:, 0] == 0, lambda obs: obs["at"][:, 0] == 4)
    planner = Planner(log, task, skills=skills).among(("left", "right"))
    here = log.start[:1].copy()
    here["at"] = 2.0
    assert planner.act(planner.start(1), here)[0].tolist() == [0]
    with pytest.raises(SkillError, match="Dict with the keys 'at', 'door'"):
        Planner(log, lambda obs: obs[:, 0] > 3)
    near = GoalTask(lambda obs, goal: obs["at"][:, 0] == goal[..., 0], columns=(0,))
    with pytest.raises(DeclarationError, match="columns are places in vectors"):
        Planner(log, near).values(here)


def test_images_need_features():
    spec = EnvSpec(lambda: Point(as_dict=True), engine="sync")
    log = record_calls(spec, pair_in(spec, *np.float32([[-1, 0], [1, 0]])), 600, num_envs=4)
    task = Mission(lambda obs: obs["place"][:, 0] > 1.5)
    with pytest.raises(DeclarationError, match=r"sees images, .*features="):
        Planner(log, task)
    planner = Planner(log, task, features=lambda obs: obs["place"][:, 0]).among(("left", "right"))
    assert planner.act(planner.start(1), log.start[:1])[0].tolist() == [1]


def test_its_checksum_is_of_log_and_task(log):
    def source(*arguments, **how) -> str:
        return Planner(*arguments, **how).source()["sha256"]

    first = source(log, has_key)
    assert first == source(log, has_key)
    others = [
        source(log, at_three),
        source(log.within(500), has_key),
        source(log, has_key, gamma=0.5),
    ]
    assert len({first, *others}) == 4


def test_it_is_declared_as_a_selector(log):
    def declared(task) -> Hierarchy:
        return Hierarchy(SPEC, list(SKILLS), selector=Planner(log, task), call_steps=None)

    task = Mission(has_key, at_end)
    run = declared(task).train(seed=0, quiet=True)
    assert np.mean(run.evaluate(5).returns) == 1.0
    assert declared(task).load(run.path).policy is not None
    with pytest.raises(RunError, match="the selector had the policy planner"):
        declared(has_key).load(run.path)


def test_calls_behind_a_wall_do_not_count():
    """Before a wall "try" leads nowhere; behind it, much further than usual, to the goal."""
    before = [*np.arange(0, 0.6, 0.02).tolist(), 1.0, 1.01, 0.99]
    calls = [(p, [(0, [p], False, "own")]) for p in before]
    calls += [(p, [(0, [9], True, "own")]) for p in (1.2, 1.21, 1.22, 1.23, 1.24)]
    planner = Planner(log_of(["try"], calls), at(9), neighbors=5, gamma=GAMMA, caution=0.0)
    q = planner.values(np.float32([[1.0], [1.2]]))[:, 0]
    # Else each call that is tried again before the wall would have a chance.
    assert q.tolist() == pytest.approx([0.0, 1.0], abs=1e-3)
