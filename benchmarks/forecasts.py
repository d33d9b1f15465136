"""The chance that a plan promises, with its interval, beside what 200 played episodes do.

    python -m benchmarks.forecasts [--worlds 0 2 4] [--steps 10000 30000 100000] [--episodes 200]

Twelve worlds of functions: rooms with doors, couriers, keys, slippery floors, pits, one-way doors,
inertia, discrete goals. In each, three or four missions are planned twice: by a mover with goals,
and by a mover for each of a few fixed places; 40 missions each. Nothing is trained. The figures:
the share of 95 % intervals that hold the share of the played episodes, their width, the mean
of promised − done and of its absolute value, and what is done with more log.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium as gym
import numpy as np

import skillweave as sw
from benchmarks.common import report, table
from skillweave.envs.make import make_engine
from skillweave.errors import RunError
from skillweave.experience.play import SeededEpisodes, play
from skillweave.types import Array, Step

LOGS = (10_000, 30_000, 100_000)
X, Y, VX, VY, HAS, IX, IY = range(7)
REACH = 0.3
Point = tuple[float, float]
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class World:
    """A plane with walls; something may be carried: a parcel, or a key that opens doors.

    Attributes:
        walls: (axis, place, from, to, kind): what crosses this line between these ends goes through
            a door, which is "open", needs the "key", or leads "up" or "down" alone.
        places: the fixed places, with names, of the movers without goals, and words of missions.
        starts: boxes (x, y, width, height), one of which is drawn.
        items: boxes of the thing that can be carried, or ().
        depot: the place to which a parcel is brought; None: a key is kept.
        pits: boxes in which the episode ends.
        missions: texts.
        slip: the share of steps in which it moves at random.
        inertia: the share of the velocity that stays.
        discrete: goals are numbers of a grid with so many columns and rows; None: they are points.
    """

    size: Point
    walls: tuple[tuple[int, float, float, float, str], ...]
    places: dict[str, Point]
    starts: tuple[Box, ...]
    missions: tuple[str, ...]
    items: tuple[Box, ...] = ()
    depot: Point | None = None
    pits: tuple[Box, ...] = ()
    slip: float = 0.0
    inertia: float = 0.0
    speed: float = 0.2
    limit: int = 100
    discrete: tuple[int, int] | None = None


ROOM = (0.2, 0.2, 2.6, 3.6)
DOORS = ((0, 3.0, 0.55, 1.45, "open"), (0, 6.0, 2.55, 3.45, "open"))
THREE = {"a": (2.5, 1.0), "b": (3.6, 1.0), "c": (5.5, 3.0), "d": (6.6, 3.0), "e": (8.3, 0.7)}
WORLDS = (
    World(  # 0: a courier in three rooms
        (9.0, 4.0), DOORS, THREE, (ROOM,),
        ("pick", "pick then bring", "pick then bring then pick", "e then a"),
        items=((0.4, 0.4, 2.2, 3.2), (3.4, 0.4, 2.2, 3.2)), depot=(8.3, 0.7), inertia=0.5,
        limit=120,
    ),
    World(  # 1: four rooms, starts anywhere
        (6.0, 6.0),
        ((0, 3.0, 1.0, 1.8, "open"), (0, 3.0, 4.0, 4.8, "open"), (1, 3.0, 1.0, 1.8, "open"),
         (1, 3.0, 4.2, 5.0, "open")),
        {"a": (1.4, 1.4), "b": (4.6, 1.4), "c": (4.6, 4.6), "d": (1.4, 4.4)},
        ((0.2, 0.2, 5.6, 5.6),),
        ("a then c", "c then b then d", "(a and d) then b", "b, avoid c"),
        slip=0.1,
    ),
    World(  # 2: a key at random opens the door
        (6.0, 4.0), ((0, 3.0, 1.5, 2.5, "key"),),
        {"a": (2.5, 2.0), "b": (3.6, 2.0), "c": (5.5, 3.5), "d": (0.5, 0.5)},
        ((0.2, 0.2, 2.6, 3.6),),
        ("get then c", "c then d", "b for 5 steps"), items=((0.3, 0.3, 2.4, 3.4),),
    ),
    World(  # 3: a slippery corridor between pits
        (8.0, 3.0), (), {"a": (1.0, 1.5), "b": (4.0, 1.5), "c": (7.0, 1.5), "d": (4.0, 2.6)},
        ((0.2, 0.2, 1.0, 2.6),),
        ("c", "b then c", "c then a", "d or c"),
        pits=((2.2, 0.0, 1.2, 1.0), (5.0, 2.0, 1.2, 1.0)), slip=0.35,
    ),
    World(  # 4: one-way doors; the last room has no way back
        (9.0, 3.0),
        ((0, 3.0, 1.0, 2.0, "up"), (0, 6.0, 1.0, 2.0, "up"), (0, 6.0, 2.2, 2.9, "down")),
        {"a": (2.5, 1.5), "b": (3.6, 1.5), "c": (5.5, 1.5), "d": (7.5, 1.5), "e": (5.0, 2.6)},
        ((0.2, 0.2, 8.6, 2.6),),
        ("d then b", "a", "a or d", "e then d then e"),
    ),
    World(  # 5: discrete goals, walls, a slippery floor
        (8.0, 4.0), ((0, 2.7, 0.4, 1.3, "open"), (0, 5.3, 2.5, 3.6, "open")),
        {"a": (1.0, 0.5), "b": (3.0, 0.5), "c": (5.0, 3.5), "d": (7.0, 2.5)},
        ((0.2, 0.2, 2.2, 3.6),), ("b", "d", "d then a"), slip=0.1, discrete=(4, 4), limit=120,
    ),
    World(  # 6: a far courier: one fixed start, long ways round walls
        (7.0, 5.0), ((1, 1.7, 5.9, 6.8, "open"), (1, 3.3, 0.2, 1.1, "open")),
        {"a": (6.4, 1.2), "b": (6.4, 2.2), "c": (0.6, 2.9), "d": (0.6, 3.8), "e": (5.0, 4.4)},
        ((0.5, 0.5, 0.0, 0.0),), ("b", "d", "pick then bring"),
        items=((0.5, 2.0, 5.5, 1.0),), depot=(5.0, 4.4), limit=150,
    ),
    World(  # 7: pits beside narrow doors, inertia
        (6.0, 4.0), ((0, 3.0, 1.6, 2.4, "open"),),
        {"a": (2.3, 2.0), "b": (3.7, 2.0), "c": (5.3, 3.5), "d": (5.3, 0.5)},
        ((0.2, 0.2, 1.2, 3.6),), ("c", "d then c", "b then a then b"),
        pits=((2.6, 0.2, 0.4, 1.0), (2.6, 2.9, 0.4, 0.9)), inertia=0.6, speed=0.1,
    ),
    World(  # 8: an open field, random starts: nearly all can be done
        (5.0, 5.0), (), {"a": (0.8, 0.8), "b": (4.2, 0.8), "c": (4.2, 4.2), "d": (0.8, 4.2)},
        ((0.2, 0.2, 4.6, 4.6),), ("a then c", "a then b then c then d", "b for 8 steps"),
        inertia=0.3, limit=80,
    ),
    World(  # 9: a key behind one door opens another one
        (9.0, 4.0), ((0, 3.0, 0.6, 1.5, "open"), (0, 6.0, 2.4, 3.4, "key")),
        {"a": (2.5, 1.0), "b": (3.6, 1.0), "c": (5.4, 2.9), "d": (6.6, 2.9), "e": (8.3, 1.0)},
        ((0.2, 0.2, 2.5, 3.6),), ("get", "get then e", "d then a"),
        items=((3.6, 0.6, 2.0, 2.8),), slip=0.05, limit=150,
    ),
    World(  # 10: very slippery, short episodes: much is chance
        (6.0, 2.0), (), {"a": (0.6, 1.0), "b": (3.0, 1.0), "c": (5.4, 1.0)},
        ((0.2, 0.2, 5.6, 1.6),), ("c then a", "b then c then b", "a then c then a"),
        slip=0.5, limit=60,
    ),
    World(  # 11: one long maze of five rooms
        (10.0, 3.0),
        ((0, 2.0, 0.2, 1.1, "open"), (0, 4.0, 1.9, 2.8, "open"), (0, 6.0, 0.2, 1.1, "open"),
         (0, 8.0, 1.9, 2.8, "open")),
        {"a": (1.6, 0.6), "b": (3.6, 2.3), "c": (4.4, 2.3), "d": (6.4, 0.6), "e": (9.4, 2.3)},
        ((0.2, 0.2, 1.6, 2.6), (4.2, 0.2, 1.6, 2.6)), ("c", "e", "d then a"), limit=150,
    ),
)  # fmt: skip
assert sum(len(world.missions) for world in WORLDS) == 40


class Plane(gym.Env[Array, Array]):
    """The environment of a ``World``."""

    world: World
    observation_space = gym.spaces.Box(-np.inf, np.inf, (7,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _in(self, box: Box) -> Point:
        u, v = self.np_random.random(2).tolist()
        return box[0] + u * box[2], box[1] + v * box[3]

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, Any]:
        """Start somewhere."""
        super().reset(seed=seed)
        world = self.world
        self.at = self._in(world.starts[int(self.np_random.integers(len(world.starts)))])
        self.speed, self.has, self.steps, self.item = (0.0, 0.0), False, 0, (0.0, 0.0)
        if world.items:
            self.item = self._in(world.items[int(self.np_random.integers(len(world.items)))])
        return self._obs(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, Any]:
        """Move, unless a wall is in the way."""
        world, push = self.world, action.tolist()
        if world.slip and self.np_random.random() < world.slip:
            push = self.np_random.uniform(-1, 1, 2).tolist()
        u, v = (world.inertia * s + world.speed * p for s, p in zip(self.speed, push, strict=True))
        place = [
            min(max(x + d, 0.05), most - 0.05)
            for x, d, most in zip(self.at, (u, v), world.size, strict=True)
        ]
        speed = [u, v]
        for axis, line, low, high, kind in world.walls:
            old, new, beside = self.at[axis], place[axis], place[1 - axis]
            if (old < line) == (new < line):
                continue
            goes = kind == "open" or kind == ("up" if new > old else "down")
            goes = goes or (kind == "key" and self.has)
            doors = [w for w in world.walls if w[:2] == (axis, line)]
            if not goes or not low < beside < high:
                others = [w for w in doors if w[2] < beside < w[3]]
                passes = any(
                    w[4] == "open"
                    or w[4] == ("up" if new > old else "down")
                    or (w[4] == "key" and self.has)
                    for w in others
                )
                if not passes:
                    place[axis], speed[axis] = old, 0.0
        self.at, self.speed = (place[0], place[1]), (speed[0], speed[1])
        self.steps += 1
        if world.items and not self.has and math.dist(self.at, self.item) < REACH:
            self.has = True
        if self.has and world.depot is not None:
            self.item = self.at
            if math.dist(self.at, world.depot) < 0.4:
                self.has = False
                self.item = self._in(world.items[int(self.np_random.integers(len(world.items)))])
        x, y = self.at
        fell = any(a <= x <= a + w and b <= y <= b + h for a, b, w, h in world.pits)
        return self._obs(), 0.0, fell, not fell and self.steps >= world.limit, {}

    def _obs(self) -> Array:
        return np.array([*self.at, *self.speed, self.has, *self.item], np.float32)


def straight(obs: Array, to: Any) -> Array:
    """Return actions that go straight to places."""
    way: Array = np.clip(3 * (to - obs[:, [X, Y]]), -1, 1)
    return way


def _near(obs: Array, to: Any) -> Array:
    there: Array = np.linalg.norm(obs[:, [X, Y]] - to, axis=1) < REACH
    return there


class Mover(sw.Skill):
    """Go straight to a place."""

    max_steps = 40

    def to(self, obs: Array, goal: Any = None) -> Any:
        """Return the place, (n, 2) or (2,)."""
        raise NotImplementedError

    def termination(self, step: Step) -> Array:
        """Return whether it is there."""
        return _near(step.next_obs, self.to(step.obs, step.goal))

    def success(self, step: Step) -> Array:
        """Return the same."""
        return self.termination(step)


def with_goals(world: World) -> list[sw.Skill]:
    """Return one mover, to any place."""
    if world.discrete is None:
        low, high = np.full(2, 0.2, np.float32), np.array(world.size, np.float32) - np.float32(0.2)
        space: gym.Space[Any] = gym.spaces.Box(low, high)
        grid = None
    else:
        columns, rows = world.discrete
        space = gym.spaces.Discrete(columns * rows)
        cell = np.array(world.size) / [columns, rows]
        grid = np.array([[(i + 0.5) * cell[0], (j + 0.5) * cell[1]]
                         for j in range(rows) for i in range(columns)])  # fmt: skip

    class GoTo(Mover):
        goal_space = space

        def to(self, obs: Array, goal: Any = None) -> Any:
            return goal if grid is None else grid[np.asarray(goal).astype(int)]

        def policy(self, obs: Array, goal: Any) -> Array:
            return straight(obs, self.to(obs, goal))

    return [GoTo()]


def to_places(world: World) -> list[sw.Skill]:
    """Return a mover for each of the fixed places."""

    def mover(label: str, place: Point) -> sw.Skill:
        class To(Mover):
            name = f"to_{label}"

            def to(self, obs: Array, goal: Any = None) -> Any:
                return np.array(place)

            def policy(self, obs: Array) -> Array:
                return straight(obs, np.array(place))

        return To()

    return [mover(label, place) for label, place in world.places.items()]


class Pick(Mover):
    """Go straight to the thing that can be carried."""

    def initiation(self, obs: Array) -> Array:
        """Return whether it is not carried yet."""
        free: Array = obs[:, HAS] == 0
        return free

    def policy(self, obs: Array) -> Array:
        """Go there."""
        return straight(obs, obs[:, [IX, IY]])

    def termination(self, step: Step) -> Array:
        """Return whether it is carried now."""
        has: Array = step.next_obs[:, HAS] == 1
        return has


def words_of(world: World) -> dict[str, Callable[[Any], Array]]:
    """Return the words of missions."""

    def at(place: Point) -> Callable[[Any], Array]:
        return lambda obs: np.linalg.norm(obs[:, [X, Y]] - np.array(place), axis=1) < 0.4

    def brought(step: Step) -> Array:
        was: Array = (step.obs[:, HAS] == 1) & (step.next_obs[:, HAS] == 0)
        return was

    def carried(step: Step) -> Array:
        now: Array = (step.obs[:, HAS] == 0) & (step.next_obs[:, HAS] == 1)
        return now

    words = {name: at(place) for name, place in world.places.items()}
    return words | {"pick": carried, "get": carried, "bring": brought}


def run_of(world: World, goals: bool) -> sw.Run:
    """Return the skills of a world, which learn nothing."""
    skills = with_goals(world) if goals else to_places(world)
    if world.items:
        skills.append(Pick())
    if world.depot is not None:
        depot = np.array(world.depot)

        class Bring(Mover):
            def initiation(self, obs: Array) -> Array:
                carries: Array = obs[:, HAS] == 1
                return carries

            def policy(self, obs: Array) -> Array:
                return straight(obs, depot)

            def termination(self, step: Step) -> Array:
                free: Array = step.next_obs[:, HAS] == 0
                return free

        skills.append(Bring())
    env = type("Plane", (Plane,), {"world": world})
    name = skills[0].name if len(skills) > 1 and not goals else skills[-1].name

    def selector(obs: Array) -> Any:
        return [name] * len(obs)

    def goal_too(obs: Array) -> Any:
        point = np.zeros(len(obs), int) if world.discrete else np.ones((len(obs), 2))
        return ["go_to"] * len(obs), point

    how = goal_too if goals else selector
    return sw.Hierarchy(sw.EnvSpec(env, workers=1), skills, call_steps=None, selector=how).train(
        quiet=True
    )


@dataclass
class Row:
    """A plan: what it promises, and what it does."""

    world: int
    goals: bool
    mission: str
    steps: int
    chance: float
    low: float
    high: float
    done: float
    plan_s: float
    forecast_s: float

    @property
    def holds(self) -> bool:
        """Whether the interval, in whole percent as it is printed, holds what was done."""
        return round(self.low, 2) <= self.done <= round(self.high, 2)


def measured(run: sw.Run, log: Any, row: Row, episodes: int) -> Row:
    """Return a row with what is promised and done."""
    words, start = words_of(WORLDS[row.world]), time.process_time()
    try:
        planned = run.plan(row.mission, log, predicates=words)
    except RunError:  # it says so: no step of the log does a part
        row.high = 0.05
        return row
    row.plan_s = time.process_time() - start
    start = time.process_time()
    expected = planned.explain()
    row.forecast_s = time.process_time() - start
    row.chance, (row.low, row.high) = expected.chance or 0.0, expected.interval
    row.done = share_done(run, planned, episodes)
    return row


def share_done(run: sw.Run, planned: Any, episodes: int) -> float:
    """Return the share of episodes that do a plan's task; all are played side by side."""
    machine, spec = planned.hierarchy.selector.machine, run.hierarchy.spec
    with closing(make_engine(spec, episodes)) as engine:
        seeds = np.random.default_rng(0).integers(2**31, size=episodes).tolist()
        state = machine.start(episodes)
        for played in play(planned.policy, SeededEpisodes(engine, seeds, 1_000)):
            state[played.rows], _, over = machine.step(state[played.rows], played.step)
            played.cut |= over
    done: float = machine.has_succeeded(state).mean()
    return done


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the figures of some rows."""
    off = np.array([row.chance - row.done for row in rows])
    most = max(row.steps for row in rows)
    done = {steps: np.mean([r.done for r in rows if r.steps == steps]) for steps in LOGS}
    seconds = [row.plan_s + row.forecast_s for row in rows if row.steps == most]
    return {
        "held": float(np.mean([row.holds for row in rows])),
        "width": float(np.mean([r.high - r.low for r in rows if r.steps == most])),
        "promised − done": float(off.mean()),
        "|promised − done|": float(np.abs(off).mean()),
        **{f"done at {steps:,}": float(share) for steps, share in done.items()},
        "seconds": float(np.median(seconds)),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print each plan, and the figures."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.forecasts")
    parser.add_argument("--worlds", type=int, nargs="+", default=list(range(len(WORLDS))))
    parser.add_argument("--steps", type=int, nargs="+", default=list(LOGS))
    parser.add_argument("--episodes", type=int, default=200)
    given: Any = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    rows: list[Row] = []
    for number in given.worlds:
        for goals in (True, False):
            run = run_of(WORLDS[number], goals)
            log = run.log_calls(max(given.steps), num_envs=8)
            for steps in given.steps:
                part = log.within(steps)
                for mission in WORLDS[number].missions:
                    row = Row(number, goals, mission, steps, 0, 0, 0, 0, 0, 0)
                    row = measured(run, part, row, given.episodes)
                    rows.append(row)
                    print(
                        f"{number:2} {'goals' if goals else 'fixed'} {steps:7,} {row.chance:4.0%} "
                        f"({row.low:.0%} to {row.high:.0%}) done {row.done:4.0%} "
                        f"{'' if row.holds else '×':1} {row.plan_s:5.1f} s + {row.forecast_s:.1f} s"
                        f"  {mission}",
                        flush=True,
                    )
    kinds = {"goals": True, "fixed": False}
    found = {name: figures([r for r in rows if r.goals == kind]) for name, kind in kinds.items()}
    cells = [(name, *(f"{of[name]:.2f}" for of in found.values())) for name in found["goals"]]
    print(table(("", *found), cells))
    report("forecasts", {"figures": found, "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main()
