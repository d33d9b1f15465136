"""Lander missions: legs, hovering and gusts by hand, over flights that are written down."""

from __future__ import annotations

import itertools

import gymnasium as gym
import numpy as np
import pytest
from single_step import step_of
from toys import SideBySide

from benchmarks.pay.lander_missions import suite
from skillweave import Apart, EnvSpec, Selection
from skillweave.recipes import _missions as world, lander_missions as missions

LEFT, RIGHT, ABOVE, PAD = (-0.5, 0.75), (0.5, 0.75), (0.0, 0.6), (0.1, 0.0)
SKY = (0.0, 1.2)
ONE = np.zeros(1, np.int64)


def lander(place, speed=(0.0, 0.0), legs=(0.0, 0.0)):
    return np.array([*place, *speed, 0.0, 0.0, *legs], np.float32)


def fly(mission, places, rested=False):
    """What is paid in each step, and the progress after all; it may rest in the last step."""
    progress = world.MissionState(1, [mission], gusts=False)
    progress.begin(ONE, [np.random.default_rng(0)])
    paid = []
    for i, place in enumerate(places):
        last = rested and i == len(places) - 1
        reward, ended = np.array([100.0 if last else 1.0]), np.array([last])
        paid.append(float(progress.advance(lander(place)[None], reward, ended, ONE)[0]))
    return paid, progress


def test_each_leg_of_a_tour_pays_a_third_in_its_order():
    tour = ("left", "right", "land")
    third = pytest.approx(1 / 3)
    paid, progress = fly(tour, [SKY, RIGHT, LEFT, LEFT, SKY, RIGHT, PAD], rested=True)
    assert paid == [0, 0, third, 0, 0, third, third]
    assert progress.done(ONE)
    paid, progress = fly(tour, [LEFT, PAD], rested=True)  # landed too early: the tour is not done
    assert paid == [third, 0]
    assert not progress.done(ONE)


def test_hovering_takes_two_seconds_without_leaving_the_box():
    enough = world.HOVER_STEPS
    paid, _ = fly(("hover", "land"), [ABOVE] * enough + [ABOVE])
    assert paid == [0] * (enough - 1) + [0.5, 0]
    paid, progress = fly(("hover", "land"), [ABOVE] * (enough - 1) + [SKY] + [ABOVE] * 3)
    assert sum(paid) == 0
    assert progress.held == [3]


@pytest.mark.parametrize(
    ("mission", "places", "rested", "paid"),
    [
        (("left", "land"), [(-0.35, 0.75)], False, [0.5]),  # the edge of a box belongs to it
        (("left", "land"), [(-0.34, 0.75)], False, [0.0]),
        (("left", "land"), [(-0.5, 0.91)], False, [0.0]),
        (("land",), [PAD, PAD], False, [0, 0]),  # a landing counts only at rest
        (("land",), [SKY, PAD], True, [0, 1]),
        (("land",), [SKY, (0.21, 0.0)], True, [0, 0]),
    ],
)
def test_a_leg_is_done_in_its_box_and_a_landing_at_rest(mission, places, rested, paid):
    assert fly(mission, places, rested)[0] == paid


def test_what_is_still_to_be_done_stands_in_the_observation():
    _, progress = fly(("hover", "right"), [ABOVE] * 25)
    seen = progress.seen(lander(ABOVE)[None], ONE)[0]
    np.testing.assert_array_equal(seen[:8], lander(ABOVE))
    np.testing.assert_array_equal(seen[8:20], [0, 0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0])
    assert seen[20] == 0.25


def test_gusts_fire_the_engines_of_alternating_sides():
    progress = world.MissionState(1, [("land",)], gusts=True)
    progress.begin(ONE, [np.random.default_rng(0)])
    progress._time[:] = 0
    fired = []
    for _ in range(2 * world.GUST_EVERY):
        fired.append(int(progress.blown(np.array([2]), ONE)[0]))
        progress.advance(lander(SKY)[None], np.zeros(1), np.zeros(1, bool), ONE)
    calm = [2] * (world.GUST_EVERY - world.GUST_STEPS)
    assert fired == [3] * world.GUST_STEPS + calm + [1] * world.GUST_STEPS + calm


class Film(gym.Env):
    """Shows what is written down, episode after episode; keeps the actions."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (8,), np.float32)
    action_space = gym.spaces.Discrete(4)

    def __init__(self, number):
        self.rng, self.actions = np.random.default_rng(number), []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return lander(SKY), {}

    def step(self, action):
        self.actions.append(action)
        end = self.rng.random() < 0.05
        places = [*[LEFT, RIGHT, ABOVE, ABOVE], PAD] if end else [LEFT, RIGHT, ABOVE, ABOVE]
        reward = 100.0 if end and self.rng.random() < 0.7 else -1.0
        place = places[int(self.rng.integers(len(places)))]
        return lander(place), reward, end and reward > 0, end and reward < 0, {}


def test_a_pool_and_single_landers_are_the_same_for_the_same_flights():
    n, legs, rng = 6, missions.MISSIONS["any"], np.random.default_rng(1)
    pool = world.MissionPool(SideBySide([Film(i) for i in range(n)]), legs, True, n, seed=0)
    pool._rngs = [np.random.default_rng(100 + i) for i in range(n)]
    alone = [world.MissionTask(Film(i), legs, gusts=True) for i in range(n)]
    obs, _ = pool.reset(np.arange(n))
    mine = [env.reset(seed=100 + i)[0] for i, env in enumerate(alone)]
    np.testing.assert_array_equal(obs, mine)
    paid = 0.0
    for _ in range(300):
        ids = np.flatnonzero(rng.random(n) < 0.8)  # the others stand still
        if not len(ids):
            continue
        action = rng.integers(4, size=len(ids))
        obs, reward, terminated, truncated, info = pool.step(action, ids)
        for row, (i, act) in enumerate(zip(ids, action, strict=True)):
            one = alone[i].step(int(act))
            np.testing.assert_array_equal(obs[row], one[0])
            assert (reward[row], terminated[row], truncated[row]) == one[1:4]
            assert info["success"][row] == one[4]["success"]
            paid += one[1]
        ended = ids[terminated | truncated]
        if len(ended):
            begun = pool.reset(ended)[0]
            np.testing.assert_array_equal(begun, [alone[i].reset()[0] for i in ended])
    assert paid > 3.0
    assert [film.actions for film in pool.pool.envs] == [env.env.actions for env in alone]


def flown(before, after, action=0, terminated=False):
    return step_of(before[None], after[None], action, terminated)


def test_skills_are_paid_for_the_speed_that_is_wanted_where_they_are():
    # 0.2 to the left of the point wants 0.5 to the right; it is 0.1 too fast.
    going = flown(lander(SKY), lander((0.3, 0.75), speed=(0.6, 0.0)))
    assert missions.GoRight().reward(going) == pytest.approx(0.9, abs=1e-6)
    assert not missions.GoRight().termination(going)
    # Far away no more than 1 is wanted, and 0.5 downwards.
    far = flown(lander(SKY), lander((0.5, 1.75)))
    assert missions.GoLeft().reward(far) == pytest.approx(1.0 - np.hypot(1.0, 0.5), abs=1e-6)
    there = flown(lander(SKY), lander(LEFT, speed=(0.1, 0.0)))
    assert missions.GoLeft().termination(there)
    # 0.1 too fast, as 0 is wanted at the point; the prize is 300.
    assert missions.GoLeft().reward(there) == pytest.approx(300.9, abs=1e-4)
    crashed = flown(lander(SKY), lander(LEFT, speed=(0.1, 0.0)), terminated=True)
    assert missions.GoLeft().reward(crashed) == missions.CRASH
    assert not missions.GoLeft().success(crashed)


def test_hovering_is_paid_for_its_place_and_not_for_its_speed_alone():
    # Without it a skill stayed just beside the box, and no leg was done.
    x, y = world.POINTS[world.HOVER]
    hover = missions.Hover()

    def paid(place, speed=(0.0, 0.0)):
        return hover.reward(flown(lander(SKY), lander(place, speed)))

    # At rest: 2.5 times as far as it is beside, and as far as it is above, slower than is wanted.
    assert paid((x + 0.19, y)) == pytest.approx(2.0 - 2.5 * 0.19, abs=1e-5)
    assert paid((x + 0.21, y)) == pytest.approx(1.0 - 2.5 * 0.21, abs=1e-5)
    assert paid((x, y + 0.19)) == pytest.approx(2.0 - 0.19, abs=1e-5)
    assert paid((x, y + 0.21)) == pytest.approx(1.0 - 0.21, abs=1e-5)
    assert paid((x, y), speed=(0.9, 0.0)) == pytest.approx(2.0 - 0.9, abs=1e-5)  # fast, inside
    end = flown(lander(SKY), lander((x, y)), terminated=True)
    assert hover.reward(end) == missions.CRASH


@pytest.mark.parametrize("skill", [missions.GoLeft(), missions.GoRight(), missions.Hover()])
def test_a_skill_has_arrived_only_where_the_missions_leg_is_done(skill):
    # Else the selector would call it again, and it would end at once, for ever.
    rng = np.random.default_rng(0)
    for place in skill.point + rng.uniform(-0.3, 0.3, (200, 2)):
        inside = (np.abs(place - skill.point) <= skill.half).all()
        assert skill.success(flown(lander(SKY), lander(place)))[0] == inside


@pytest.mark.parametrize("skill", [missions.GoLeft(), missions.GoRight()])
def test_a_skill_may_not_start_where_it_would_end_at_once(skill):
    rng = np.random.default_rng(0)
    ends = []
    for place in skill.point + rng.uniform(-0.3, 0.3, (200, 2)):
        step = flown(lander(SKY), lander(place, speed=rng.uniform(-0.6, 0.6, 2)))
        ends.append(skill.termination(step)[0])
        assert skill.initiation(step.next_obs)[0] == (not ends[-1])
    assert 20 < sum(ends) < 180


@pytest.mark.parametrize("skill", [missions.GoLeft(), missions.GoRight()])
def test_going_on_is_never_worth_as_much_as_arriving(skill):
    best = 1.0 / (1 - missions.PILOT.gamma)  # the best step, for ever
    assert missions.CRASH < 0 < best < skill.prize


@pytest.mark.parametrize("start", [(0.0, 1.4), *map(tuple, world.POINTS[:2]), (0.9, 1.4)])
def test_one_call_of_hover_may_last_for_the_way_there_and_the_leg_itself(start):
    # Several calls in a row are hardly ever drawn by lot, so a selector would not find out.
    hover, place, way = missions.Hover(), np.array(start), 0
    while not hover.in_box(lander(place)[None])[0] and way < 1_000:  # else it is never there
        # Of the lander's view a speed of 1 is 0.01 of its width and 0.0225 of its height a step.
        place = place + hover.wanted(lander(place)[None])[0] * (0.01, 0.0225)
        way += 1
    assert 10 < way <= hover.call_steps - world.HOVER_STEPS


def test_landing_is_paid_for_what_is_better_than_before():
    land = missions.Land()
    before, after = lander((0.3, 0.4), speed=(0.6, -0.8)), lander((0.0, 0.3), speed=(0.0, -0.3))
    # 0.2 nearer, 0.7 slower; no engine, one at the side, the main one.
    for action, fuel in ((0, 0.0), (1, 0.03), (2, 0.3), (3, 0.03)):
        paid = land.reward(flown(before, after, action))
        assert paid == pytest.approx(90.0 - fuel, abs=1e-4)
    tilted = after.copy()
    tilted[missions.ANGLE], tilted[missions.LEGS] = -0.2, (1.0, 1.0)  # 20 less, 20 more
    assert land.reward(flown(after, tilted)) == pytest.approx(0.0, abs=1e-4)


def test_only_rest_on_the_pad_is_a_landing():
    land, ground = missions.Land(), lander(PAD, speed=(0.0, -0.1), legs=(1.0, 1.0))
    rest = flown(ground, lander(PAD, legs=(1.0, 1.0)), terminated=True)
    off = flown(ground, lander((0.3, 0.0), legs=(1.0, 1.0)), terminated=True)
    crash = flown(lander(SKY), ground, terminated=True)
    under_way = flown(ground, lander(PAD, legs=(1.0, 1.0)))
    found = [land.reward(step)[0] for step in (rest, off, crash)]
    assert found == [100.0, -100.0, -100.0]
    assert [land.success(step)[0] for step in (rest, off, crash, under_way)] == [
        True, False, False, False,
    ]  # fmt: skip


def test_what_landing_pays_is_what_lunar_lander_pays():
    """On the ways of random engines; a landing off the pad is the one thing that differs."""
    env, land, rng = gym.make("LunarLander-v3"), missions.Land(), np.random.default_rng(0)
    steps = 0
    for seed in range(5):
        before, _ = env.reset(seed=seed)
        over = False
        while not over:
            action = int(rng.integers(4))
            after, paid, over, _, _ = env.step(action)
            assert land.reward(flown(before, after, action, over)) == pytest.approx(paid, abs=2e-3)
            before, steps = after, steps + 1
    assert steps > 300


def test_a_skill_does_not_see_the_mission_and_the_selector_and_flat_agents_do():
    found, flat = missions.declare(), suite().flat
    assert found.plain_agent().algorithm.network.sees is None
    assert {skill.algorithm for skill in found.skills} == {None}
    assert found.algorithm.network.sees == tuple(range(8))
    assert found.selector.network.sees is None
    assert flat.network.sees is None


def test_skills_sample_and_a_selector_over_given_skills_takes_fewer_steps():
    skills = {skill().name: lambda obs: np.zeros(len(obs), int) for skill in missions.SKILLS}
    first, further = missions.declare(), missions.with_skills("tour", skills)
    assert first.selection.greedy_skills is further.selection.greedy_skills is False
    assert (first.apart.selector_steps, further.apart.selector_steps) == (600_000, 300_000)
    how = {"selection": Selection(greedy_skills=True), "apart": Apart(selector_steps=500_000)}
    longer = missions.with_skills("tour", skills, **how)
    assert (longer.selection.greedy_skills, longer.apart.selector_steps) == (True, 500_000)


def test_the_selector_by_hand_chooses_a_skill_that_may_start_on_any_mission():
    every = [m for n in (1, 2, 3) for m in itertools.product(world.KINDS, repeat=n)]
    skills = {skill().name: skill() for skill in missions.SKILLS}
    for mission in every:
        progress = world.MissionState(1, [mission], gusts=False)
        progress.begin(ONE, [np.random.default_rng(0)])
        for done in range(len(mission) + 1):
            progress.left[0] = [*progress.left[0, 1:], -1] if done else progress.left[0]
            for place in (SKY, LEFT, RIGHT, ABOVE, PAD):
                obs = progress.seen(lander(place)[None], ONE)
                (chosen,) = missions.by_leg(obs)
                assert skills[chosen].initiation(obs).all(), (mission, done, place)
                leg = mission[done] if done < len(mission) else "hover"
                there = {"left": LEFT, "right": RIGHT}.get(leg) == place
                assert there or chosen.endswith(leg)


class Glider(gym.Env):
    """Flies level, and lands where it is told to on the pad."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (8,), np.float32)
    action_space = gym.spaces.Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = self.np_random.uniform(-0.1, 0.1), 0
        return lander((self.x, 0.7)), {}

    def step(self, action):
        self.x += {1: -0.05, 3: 0.05}.get(int(action), 0.0)
        self.t += 1
        rests = action == 2
        obs = lander((self.x, 0.0 if rests else 0.7))
        return obs, world.RESTED if rests else 0.0, bool(rests), self.t == 400, {}


def glides(point, last):
    """A policy that flies to a point, and then takes the action ``last``."""

    def policy(obs):
        way = point - obs[:, missions.X]
        return np.where(np.abs(way) < 0.06, last, np.where(way < 0, 1, 3))

    return policy


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize(
    "mission",
    [("hover", "right"), ("right", "left", "hover"), ("left", "left"), ("hover",),
     ("left", "right", "left"), ("left", "right", "land")],
    ids="-".join,
)  # fmt: skip
def test_any_mission_is_flown_by_hand(mission, tmp_path):
    policies = {
        "hover": glides(0.0, 0), "go_left": glides(-0.5, 0), "go_right": glides(0.5, 0),
        "land": glides(0.0, 2),
    }  # fmt: skip
    found = missions.with_skills("tour", policies, selector=missions.by_leg)
    found.env = EnvSpec(lambda: world.MissionTask(Glider(), [mission]))
    score = found.train(tmp_path / "run", quiet=True).evaluate(3, quiet=True)
    assert score.success_rate == 1.0
    assert score.mean == pytest.approx(1.0)


def test_landers_in_envpool_and_in_gymnasium_have_the_same_missions():
    pytest.importorskip("envpool")
    pool, one = world.many(missions.MISSIONS["tour"], False, 2, 1, 0), missions.environment("tour")
    obs, _ = pool.reset(np.arange(2, dtype=np.int32))
    env = one.make()
    single, _ = env.reset(seed=0)
    assert obs.shape == (2, 21)
    np.testing.assert_array_equal(obs[0, 8:], single[8:])
    assert np.abs(obs[:, :8] - single[:8]).max() < 2.0
    for _ in range(200):
        obs, reward, terminated, _, info = env.step(0)
        if terminated:
            break
    assert terminated
    assert not info["success"]
    assert reward == 0.0
