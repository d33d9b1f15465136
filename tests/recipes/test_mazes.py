"""Mazes: what skills are paid and where they end by hand, the map, and the way through a maze."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from single_step import step_of

from skillweave.recipes import _mazes as world, mazes

CORNER = np.array(
    [[1, 1, 1, 1, 1], [1, 0, 0, 0, 1], [1, 1, 1, 0, 1], [1, 0, 0, 0, 1], [1] * 5], bool
)


DIRECTIONS = [skill() for skill in mazes.SKILLS[:4]]


def ball(place=(0.0, 0.0), speed=(0.0, 0.0), goal=(3.0, 4.0)):
    return np.array([[*place, *speed, *goal]], np.float32)


def test_directions_are_paid_for_speed_along_less_speed_across():
    rolling = step_of(ball(), ball(speed=(-1.0, 3.0)))
    paid = {s.name: float(s.reward(rolling)[0]) for s in DIRECTIONS}
    assert paid == {"north": 2.0, "east": -4.0, "south": -4.0, "west": -2.0}


@pytest.mark.parametrize(
    ("before", "after", "ends"),
    [
        (5.0, -0.6, True),  # it has hit a wall
        (0.0, 0.0, True),  # it stands at one
        (0.0, 0.24, False),  # it begins
        (-5.0, -4.76, False),  # it turns
        (5.0, 5.0, False),
    ],
)
def test_a_direction_ends_where_a_wall_is_in_the_way(before, after, ends):
    for skill in DIRECTIONS:
        step = step_of(ball(speed=before * skill.way), ball(speed=after * skill.way))
        assert not skill.termination(step), "a call has just begun"
        assert skill.termination(replace(step, elapsed=np.array([mazes.TRY]))) == ends


def test_approach_is_paid_for_each_metre_and_for_the_goal():
    # From 5 metres away to 4, as 3-4-5 triangles have it.
    nearer = step_of(ball(), ball(place=(3.0, 0.0)))
    assert mazes.Approach().reward(nearer) == pytest.approx(100.0, abs=1e-4)
    there = step_of(ball(), ball(place=(3.0, 0.0)), terminated=True)
    assert mazes.Approach().reward(there) == pytest.approx(200.0, abs=1e-4)
    assert mazes.Approach().success(there)


def encoded(encoder, obs):
    return encoder({}, {"vector": torch.as_tensor(obs)[None]})[0].numpy()


def test_the_map_says_where_ball_and_goal_are_between_its_points():
    encoder = mazes.Map(None)
    seen = encoded(encoder, ball(place=(0.25, -5.0), speed=(5.0, 0.0), goal=(-6.0, 5.0)))
    assert seen.shape == (1, encoder.size)
    width, height = 2 * encoder.east + 1, 2 * encoder.north + 1
    place, goal = seen[0, :-4].reshape(2, width, height)
    # A quarter of the way from the middle to the next point in the east, in the row furthest south.
    assert place[6, 0] == pytest.approx(0.75)
    assert place[7, 0] == pytest.approx(0.25)
    assert place.sum() == pytest.approx(1.0)
    assert goal[0, -1] == 1.0
    assert goal.sum() == 1.0
    np.testing.assert_allclose(seen[0, -4:], [1.0, 0.0, -1.25, 2.0], atol=1e-6)
    # Skills see the same wherever the maze is.
    here, there = ball(), ball(place=(2.0, -1.0), goal=(5.0, 3.0))
    np.testing.assert_array_equal(
        encoded(mazes.Motion(None), here), encoded(mazes.Motion(None), there)
    )


def test_the_shortest_way_through_a_corner():
    ways = world.ways_to(CORNER, (3, 1))
    assert ways[1, 1] == ways[1, 2] == "east"
    assert ways[1, 3] == ways[2, 3] == "south"
    assert ways[3, 3] == ways[3, 2] == "west"
    assert ways[3, 1] == "approach"
    assert len(ways) == 7


def test_the_way_out_of_a_wall_or_to_one_is_the_goals_own():
    pytest.importorskip("gymnasium_robotics")
    selector = world.ShortestPath("umaze")
    obs = np.concatenate([ball(place=(9.0, 9.0)), ball(place=(-1.0, 1.0), goal=(0.0, 0.0))])
    assert selector(obs).tolist() == ["approach", "approach"]
    # From the end of one arm to that of the other: first along the arm.
    assert selector(ball(place=(-1.0, 1.0), goal=(-1.0, -1.0))).tolist() == ["east"]


def test_the_picture_shows_walls_the_goal_and_the_ball_where_they_are():
    pytest.importorskip("gymnasium_robotics")
    env = world.spec("umaze").make(render_mode="rgb_array")
    obs, _ = env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (5 * world.PIXELS, 5 * world.PIXELS, 3)
    assert tuple(picture[0, 0]) == world.WALL

    def at(place):  # the middle of the maze is that of the picture
        east, south = 2.5 + place[0], 2.5 - place[1]
        return tuple(picture[int(south * world.PIXELS), int(east * world.PIXELS)])

    assert at(obs[world.PLACE]) == world.ORANGE
    assert at(obs[world.GOAL]) == world.GREEN
    assert at(obs[world.GOAL] + [0.0, 0.4]) == world.GREEN
    assert at(obs[world.GOAL] + [0.0, -0.49]) != world.GREEN
    assert env.render_mode == "rgb_array"


def rolled(selector, env, episodes):
    """The share of episodes that end at the goal under skills that know how to roll."""
    found = []
    for seed in range(episodes):
        obs, _ = env.reset(seed=seed)
        over = False
        while not over:
            name = selector(obs[None])[0]
            if name == "approach":
                wanted = np.clip(4.0 * (obs[world.GOAL] - obs[world.PLACE]), -3.0, 3.0)
            else:
                wanted = 3.0 * {s.name: s.way for s in DIRECTIONS}[name]
            action = np.clip((wanted - obs[world.SPEED]) / 0.24, -1.0, 1.0).astype(np.float32)
            obs, reward, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        assert terminated == (reward == 1.0) == info["success"]
        found.append(terminated)
    return np.mean(found)


@pytest.mark.parametrize("maze", ["umaze", "medium"])
def test_who_rolls_the_shortest_path_reaches_every_goal_and_is_paid_one(maze):
    pytest.importorskip("gymnasium_robotics")
    env = world.spec(maze).make()
    assert rolled(world.ShortestPath(maze), env, 3) == 1.0


def test_balls_in_envpool_roll_as_gymnasium_robotics_has_them_where_no_wall_is():
    pytest.importorskip("envpool")
    pytest.importorskip("gymnasium_robotics")
    pool, env = world.many("large", 1, 1, 0), world.spec("large").make()
    ids = np.zeros(1, np.int32)
    begun, _ = pool.reset(ids)
    env.reset(seed=0)
    told = env.unwrapped
    told.goal = begun[0, world.GOAL].astype(float)
    told.point_env.set_state(begun[0, world.PLACE].astype(float), np.zeros(2))
    for way in (0.5, -0.5) * 2:  # to and fro: it leaves the cell that it begins in nowhere
        action = np.array([way, -way], np.float32)
        theirs, paid, _, _, _ = pool.step(action[None], ids)
        ours, reward, _, _, _ = env.step(action)
        np.testing.assert_allclose(theirs[0], ours, atol=1e-5)
        assert paid[0] == reward
