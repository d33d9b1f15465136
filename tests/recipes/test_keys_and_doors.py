"""Keys and doors: where skills may start and end, by hand, and rooms beside each other."""

from __future__ import annotations

import numpy as np
import pytest
from single_step import step_of

from skillweave import Apart, Together
from skillweave.envs import envpool
from skillweave.recipes import _rooms as world, keys_and_doors as rooms

SKILLS = {s.name: s for s in (make() for make in rooms.SKILLS)}


def view(ahead=(world.EMPTY, 0, 0), hands=world.EMPTY, far=(world.EMPTY, 0, 0), sides=world.EMPTY):
    """What one agent sees: an empty room, but for these cells."""
    obs = np.zeros((1, 7, 7, 3), np.uint8)
    obs[..., 0] = world.EMPTY
    obs[0, 3, 5], obs[0, 3, 6, 0], obs[0, 1, 2] = ahead, hands, far
    obs[0, (2, 4), 6, 0] = sides
    return obs


KEY, BALL, BOX = (world.KEY, 0, 0), (world.BALL, 1, 0), (world.BOX, 2, 0)
OPEN, CLOSED, LOCKED = ((world.DOOR, 3, s) for s in (world.OPEN, world.CLOSED, world.LOCKED))
GOAL, WALL = (world.GOAL, 1, 0), (world.WALL, 5, 0)


@pytest.mark.parametrize(
    ("seen", "may"),
    [
        (view(), {"explore"}),
        (view(far=KEY), {"get_key"}),
        (view(far=BALL), {"pick_up"}),
        (view(far=BOX), {"pick_up", "open_box"}),
        (view(far=GOAL), {"reach_goal"}),
        (view(far=OPEN), {"explore", "next_room"}),
        (view(far=CLOSED), {"open_door"}),
        (view(far=LOCKED), {"explore"}),
        (view(hands=world.KEY), {"explore", "drop"}),  # what it holds is not in view
        (view(hands=world.KEY, far=LOCKED), {"drop", "open_door"}),
        (view(hands=world.BALL, far=LOCKED), {"explore", "drop"}),
        (view(hands=world.BALL, far=KEY), {"explore", "drop"}),
    ],
)
def test_a_skill_may_start_where_its_thing_is_in_view(seen, may):
    found = {n for n, s in SKILLS.items() if s.initiation(seen).all()}
    assert found == may


@pytest.mark.parametrize(
    ("name", "before", "action", "after", "done"),
    [
        ("get_key", view(KEY), world.PICK_UP, view(hands=world.KEY), True),
        ("get_key", view(BALL), world.PICK_UP, view(hands=world.BALL), False),
        ("pick_up", view(BOX), world.PICK_UP, view(hands=world.BOX), True),
        ("drop", view(hands=world.KEY), world.DROP, view(KEY), True),
        ("drop", view(WALL, hands=world.KEY), world.DROP, view(WALL, hands=world.KEY), False),
        ("open_box", view(BOX), world.TOGGLE, view(KEY), True),
        ("open_box", view(BOX), world.PICK_UP, view(hands=world.BOX), False),
        ("open_door", view(CLOSED), world.TOGGLE, view(OPEN), True),
        ("open_door", view(LOCKED, world.KEY), world.TOGGLE, view(OPEN, world.KEY), True),
        ("open_door", view(CLOSED), world.FORWARD, view(CLOSED), False),
        ("next_room", view(OPEN), world.FORWARD, view(sides=world.WALL), False),
        ("next_room", view(sides=world.WALL), world.FORWARD, view(), True),
        ("next_room", view(CLOSED, sides=world.WALL), world.FORWARD, view(), False),
        ("next_room", view(sides=world.WALL), world.LEFT, view(), False),
        ("reach_goal", view(GOAL), world.FORWARD, view(), True),
        ("reach_goal", view(GOAL), world.TOGGLE, view(GOAL), False),
    ],
)
def test_a_skill_ends_where_it_is_done_and_is_paid_for_it(name, before, action, after, done):
    skill, step = SKILLS[name], step_of(before, after, action)
    assert skill.success(step).all() == done
    assert skill.termination(step).all() == done
    if done or name in ("drop", "next_room"):  # the others are paid for coming nearer, too
        assert skill.reward(step) == pytest.approx(done - 0.02)


def test_a_skill_is_paid_for_each_cell_that_it_comes_nearer_and_pays_for_a_door_that_it_shuts():
    far, near = view(far=GOAL), view(ahead=GOAL)  # two to the left and four ahead; one ahead
    reward = SKILLS["reach_goal"].reward
    assert reward(step_of(far, near)) == pytest.approx(5 * 0.04 - 0.02)
    assert reward(step_of(near, far)) == pytest.approx(-5 * 0.04 - 0.02)
    assert reward(step_of(near, view())) == pytest.approx(-(world.FAR - 1) * 0.04 - 0.02)
    shuts = step_of(view(OPEN), view(CLOSED), world.TOGGLE)
    turns = step_of(view(OPEN), view(CLOSED), world.LEFT)  # to another door, which is shut
    sees = 0.04 * (world.FAR - 1)  # a shut door is one step away now, and none was in view
    assert SKILLS["open_door"].reward(shuts) == pytest.approx(-1.02)
    assert SKILLS["open_door"].reward(turns) == pytest.approx(sees - 0.02)


def test_explore_ends_where_there_is_something_to_do():
    ends = SKILLS["explore"].termination
    assert ends(step_of(view(), view(far=CLOSED)))
    assert not ends(step_of(view(), view(far=LOCKED)))
    assert not ends(step_of(view(), view(far=OPEN)))


def test_explore_goes_in_looks_to_all_sides_goes_on_and_looks_again():
    policy = SKILLS["explore"].policy
    corner = view(WALL)
    corner[0, 4, 6] = WALL
    seen = [*[view()] * 16, view(OPEN), *[view(WALL)] * 4, corner]
    memory, did = policy.start(1), []
    for obs in seen:
        action, memory = policy.act(memory, obs)
        did.append(int(action[0]))
    looks, goes = [world.RIGHT] * 4, [world.FORWARD]
    assert did == [*goes * 3, *looks, *goes * 5, *looks, *goes, *looks, world.LEFT]


def test_explore_looks_to_all_sides_and_then_goes_on_as_it_came():
    policy = rooms.Explore.policy
    memory, heading, place, seen_to = policy.start(1), 0, np.zeros(2, int), set()
    ways = np.array([[0, 1], [1, 0], [0, -1], [-1, 0]])
    for _ in range(3 + 4 * (4 + 5)):
        (action,), memory = policy.act(memory, view())
        if action == world.FORWARD:
            place += ways[heading]
        else:
            heading = (heading + (1 if action == world.RIGHT else -1)) % 4
        seen_to.add(heading)
    assert seen_to == {0, 1, 2, 3}  # with three turns, too, but then it walks in a square
    assert place.tolist() == [0, 3 + 4 * 5]


def test_a_pool_draws_rooms_for_each_agent_and_repeats_itself():
    pytest.importorskip("envpool")
    names, n = ("DoorKey-5x5", "Empty-5x5"), 7
    ids = np.arange(n, dtype=np.int32)
    played = []
    for some in (ids, ids[::-1]):  # the order in which they are named does not count
        pool = world.RoomPool(names, n, 1, seed=3)
        seen = np.empty((5, 2, n, 7, 7, 3), np.uint8)
        for episode in seen:
            episode[0, some] = pool.reset(some)[0]
            episode[1, some] = pool.step(np.full(n, world.LEFT), some)[0]
        played.append(seen)
    np.testing.assert_array_equal(*played)
    doors = (played[0][..., 0] == world.DOOR).any(axis=(1, 3, 4))  # Empty has none
    assert all(set(agent) == {False, True} for agent in doors.T)


def test_a_step_is_what_each_agents_room_makes_of_it():
    pytest.importorskip("envpool")
    names, n, rng = ("DoorKey-5x5", "Empty-5x5"), 8, np.random.default_rng(0)
    pool, ids = world.RoomPool(names, n, 1, seed=3), np.arange(n, dtype=np.int32)
    alone = [envpool(f"MiniGrid-{name}-v0", n, 1, 3 + k) for k, name in enumerate(names)]
    obs, _ = pool.reset(ids)
    room = pool._room.copy()
    assert set(room) == {0, 1}
    for k, own in enumerate(alone):
        np.testing.assert_array_equal(own.reset(ids[room == k])[0]["image"], obs[room == k])
    seen, done = set(), False
    for _ in range(60):
        action = rng.choice([world.LEFT, world.FORWARD], len(ids)).astype(np.int32)
        obs, reward, terminated, truncated, _ = pool.step(action, ids)
        for k, own in enumerate(alone):
            mine = room[ids] == k
            if mine.any():
                wants, pays, *ends, _ = own.step(action[mine], ids[mine])
                np.testing.assert_array_equal(obs[mine], wants["image"])
                np.testing.assert_array_equal(reward[mine], pays > 0)
                np.testing.assert_array_equal([terminated[mine], truncated[mine]], ends)
        seen |= {row.tobytes() for row in obs}
        assert (obs <= world.HIGHEST).all()
        done |= bool(reward.any())
        ids = ids[~(terminated | truncated)]
    assert done
    assert len(seen) > 30


def test_rooms_are_drawn_anew_for_each_episode_and_pay_one_however_long_it_took():
    pytest.importorskip("minigrid")
    env = world.Rooms(("Empty-5x5",))
    env.reset(seed=0)
    paid = [env.step(a) for a in (2, 2, 1, 2, 2)]
    assert [p[1] for p in paid] == [0.0, 0.0, 0.0, 0.0, 1.0]
    assert paid[-1][2]
    env = world.Rooms(world.SMALL)
    drawn = [env.reset(seed=s)[0] for s in (0, *[None] * 40)]
    assert drawn[0].shape == world.SPACE.shape
    again = world.Rooms(world.SMALL)
    same = [again.reset(seed=s)[0] for s in (0, *[None] * 40)]
    np.testing.assert_array_equal(drawn, same)
    assert all(world.SPACE.contains(obs) for obs in drawn)
    seen = set(np.unique([d[..., 0] for d in drawn]))
    assert {world.KEY, world.BALL, world.DOOR} <= seen


@pytest.mark.slow
def test_skills_that_are_there_learn_nothing_more():
    ready = {name: lambda obs: np.zeros(len(obs), np.int64) for name in SKILLS}
    found = rooms.with_skills("multi-room", ready, apart=Apart(selector_steps=4096))
    assert found.total_steps == 4096
    assert [s.name for s in found.skills] == list(SKILLS)


def test_who_goes_on_learns_together_by_the_advantage_of_the_task_too():
    found = rooms.going_on("multi-room")
    assert (found.learn, found.total_steps) == ("together", 750_000)
    how = found.together
    assert (how.task_weight, how.epsilon, how.epsilon_final) == (1.0, 0.1, 0.0)
    assert rooms.going_on("multi-room", together=Together(steps=4096)).total_steps == 4096
    assert [s.name for s in found.skills if s.policy is not None] == ["explore"]
