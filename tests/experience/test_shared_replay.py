"""Steps that skills share, against a loop that repeats the recorded actions.

In each random world two or three skills learn together, or one after another. Every drawn row is
compared with a plain loop: another environment repeats the actions of the episode, and the skill
that learns is asked about the one step.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave.buffers.judged import JudgedStore
from skillweave.envs.make import EnvSpec
from skillweave.policies.core import Step

SMALL = sw.Network((8,), "relu")
MOVES = np.float32([[0.3, 0], [-0.3, 0], [0, 0.3], [0, -0.3]])


@dataclass
class World:
    """A random world, and everything that was done in it."""

    seed: int
    log: dict[float, list[Any]] = field(default_factory=dict)
    """By the code of an episode, its actions."""

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 7])
        self.together = bool(rng.random() < 0.5)
        self.discrete = bool(rng.random() < 0.4)
        self.limit = int(rng.integers(4, 12))  # of episodes
        self.wall = float(rng.uniform(0.5, 1.5))  # beyond it they are over
        self.call_steps = int(rng.integers(2, 6))
        self.goals = bool(rng.random() < 0.5)
        self.hindsight = self.goals and bool(rng.random() < 0.5)
        self.info = not self.hindsight and bool(rng.random() < 0.5)
        self.sees = bool(rng.random() < 0.5)
        self.acts = bool(rng.random() < 0.4)
        self.masks = self.discrete and bool(rng.random() < 0.5)
        self.reflex = bool(rng.random() < 0.3)
        self.ready = bool(rng.random() < 0.5)
        self.nested = self.together and bool(rng.random() < 0.3)
        self.buffer = int(rng.choice([40, 2_000]))
        self.share = float(rng.choice([0.3, 1.0]))
        self.normal = bool(rng.random() < 0.3)

    def make(self) -> Plane:
        return Plane(self)

    @property
    def everything(self) -> bool:
        """Every step of others is one that a skill could have made, and none is overwritten."""
        return not self.acts and self.buffer == 2_000


class Plane(gym.Env[Any, Any]):
    """A plane: an episode has a code, which is where it begins, and its actions are recorded."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.observation_space = gym.spaces.Box(-1e6, 1e6, (4,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        if world.discrete:
            self.action_space = gym.spaces.Discrete(4)

    def see(self) -> Any:
        return np.float32([*self.here, self.time, self.code])

    def told(self) -> dict[str, Any]:
        found = {"paid": float(self.here[1])}
        if self.world.masks:
            found["action_mask"] = np.int8([1, 1, self.here[1] < 1, 1])
        return found

    def begin(self, code: Any) -> Any:
        """Begin the episode with this code."""
        rng = np.random.default_rng(int(code))
        self.code, self.time = np.float32(code), 0
        self.here = rng.uniform(-1, 1, 2).astype(np.float32)
        return self.see()

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        seen = self.begin(len(self.world.log))
        self.world.log[float(self.code)] = []
        return seen, self.told()

    def step(self, action: Any) -> Any:
        w = self.world
        if float(self.code) in w.log:
            w.log[float(self.code)].append(np.array(action))
        move = MOVES[int(action)] if w.discrete else 0.3 * np.float32(action)
        self.here = (self.here + move).astype(np.float32)
        self.time += 1
        over = bool(self.here[0] > w.wall)
        return self.see(), float(self.here.sum()), over, self.time >= w.limit, self.told()


class Mover(sw.Skill):
    """Moves in its own direction, or to a goal; its own end is where it has come far."""

    def __init__(self, world: World, name: str, way: int) -> None:
        super().__init__()
        self.world, self.name, self.way = world, name, np.float32([way, -1])
        if world.goals:
            self.goal_space = gym.spaces.Box(-1, 1, (2,))
        if world.sees:
            self.sees = (0, 1)
        if world.acts:
            self.acts = ((0, 2) if way > 0 else (0, 1, 3)) if world.discrete else (int(way < 0),)
        kind: Any = sw.DQN if world.discrete else sw.SAC if way > 0 else sw.TD3
        self.algorithm = kind(
            num_envs=3,
            buffer_size=world.buffer,
            learning_starts=20,
            batch_size=16,
            network=SMALL,
            n_step=1,
            action_repeat=0.0,
            hindsight=world.hindsight,
            shared_replay=world.share,
            normalize_obs=world.normal,
        )

    def reward(self, step: Any) -> Any:
        paid = step.next_obs[:, :2] @ self.way + 0.1 * step.reward - 0.01 * step.terminated
        if self.world.goals:
            paid = paid - np.linalg.norm(step.next_obs[:, :2] - step.goal, axis=1)
        if self.world.info:
            paid = paid + step.info["paid"]
        return paid + 0.001 * np.abs(step.action).reshape(len(paid), -1).sum(1)

    def termination(self, step: Any) -> Any:
        far = step.next_obs[:, 0] * self.way[0] > 1.2
        if self.world.goals:
            far |= np.linalg.norm(step.next_obs[:, :2] - step.goal, axis=1) < 0.3
        return far


class Reacher(Mover):
    """One that says which goals it has reached."""

    def achieved_goal(self, obs: Any) -> Any:
        return obs[:, :2]


class Stays(sw.Skill):
    """A ready skill that moves a little."""

    max_steps = 3

    def __init__(self, discrete: bool) -> None:
        super().__init__()
        self.discrete = discrete

    def policy(self, obs: Any) -> Any:
        return np.zeros(len(obs), int) if self.discrete else np.full((len(obs), 2), 0.1)


def hierarchy_of(world: World) -> sw.Hierarchy:
    """The skills that share, and perhaps a ready one."""
    kind = Reacher if world.goals else Mover
    skills: list[Any] = [kind(world, "right", 1), kind(world, "left", -1)]
    if world.goals or not world.together:
        selector: Any = sw.PPO(num_envs=3, n_steps=8, network=SMALL)
    else:
        selector = sw.DQN(num_envs=3, learning_starts=20, batch_size=8, network=SMALL)
    others: list[Any] = [Stays(world.discrete)] if world.ready else []
    how: dict[str, Any] = {"call_steps": world.call_steps, "selector": selector}
    spec = EnvSpec(world.make, engine="sync", workers=1)
    if world.reflex:
        still: Any = 0 if world.discrete else np.zeros(2, np.float32)
        how["reflexes"] = [sw.Reflex(lambda obs: obs[:, 1] > 0.5, still, "high")]
    if world.nested:
        inner = sw.Hierarchy(spec, [*skills, *others], name="inner", **how)
        skills, others = [inner.as_skill(max_steps=7), kind(world, "outer", 1)], []
    together = {"learn": "together", "together": sw.Together(steps=240)}
    apart = {"learn": "apart", "apart": sw.Apart(skill_steps=120, selector_steps=48)}
    return sw.Hierarchy(spec, [*skills, *others], **how, **(together if world.together else apart))


@contextmanager
def watched(monkeypatch: Any) -> Iterator[list[tuple[Any, Any, Any]]]:
    """Yield the stores, samples and raw rows that are drawn."""
    found: list[tuple[Any, Any, Any]] = []
    plain = JudgedStore.sample

    def sample(store: Any, *args: Any, **named: Any) -> Any:
        drawn = plain(store, *args, **named)
        found.append((store, drawn, store._rows((drawn.index % store._columns.slots).ravel())))
        return drawn

    with monkeypatch.context() as patch:
        patch.setattr(JudgedStore, "sample", sample)
        yield found


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "seed", [*range(24), *(pytest.param(i, marks=pytest.mark.slow) for i in range(24, 100))]
)
def test_a_shared_row_is_what_a_plain_loop_finds(
    seed: int, tmp_path: Path, monkeypatch: Any
) -> None:
    world = World(seed)
    hierarchy = hierarchy_of(world)
    with watched(monkeypatch) as drawn:
        hierarchy.train(tmp_path / "run", seed=seed, quiet=True)
    assert drawn
    rng = np.random.default_rng(seed)
    others = 0
    for i in rng.choice(len(drawn), min(len(drawn), 12), replace=False):
        store, sample, raw = drawn[i]
        for at in range(min(24, sample.reward.shape[1])):
            others += not raw.columns["own"][at]
            check_row(world, store._judge, sample, raw, at)
    if world.everything:
        assert others, "no row of another skill was drawn"
        check_counts(world, drawn)


def check_row(world: World, judge: Any, sample: Any, raw: Any, at: int) -> None:
    """Compare one drawn row with the step of the episode that it is of."""
    skill = judge._skill
    step, mask = replayed(world, float(raw.obs[at, 3]), int(raw.obs[at, 2]))
    assert np.array_equal(step["obs"][0], raw.obs[at])
    assert np.array_equal(step["next_obs"][0], raw.next_obs[at])
    seen, after = (x[0, at].numpy() for x in (sample.obs, sample.next_obs))
    goal = None
    if world.goals:
        seen, after = (joint(x, world) for x in (seen, after))
        goal = seen["goal"][None]
        assert np.array_equal(goal[0], after["goal"])
        assert np.abs(goal).max() <= 1 or world.hindsight
        seen, after = seen["observation"], after["observation"]
    size = 2 if world.sees else 4
    assert np.array_equal(seen, step["obs"][0, :size])
    assert np.array_equal(after, step["next_obs"][0, :size])
    elapsed = np.array([99])
    one = Step(**step, timed_out=np.array([False]), elapsed=elapsed, goal=goal)
    ends = bool(step["terminated"][0] or skill.termination(one)[0])
    assert sample.reward[0, at].item() == pytest.approx(float(skill.reward(one)[0]), abs=1e-4)
    gamma = skill.algorithm.gamma
    assert sample.discount[0, at].item() == pytest.approx(0.0 if ends else gamma)
    if world.masks:
        mine = list(skill.acts) if world.acts else list(range(4))
        allowed = mask[mine] if mask[mine].any() else np.ones(len(mine), bool)
        assert np.array_equal(sample.mask[0, at].numpy(), allowed)
    if not raw.columns["own"][at]:
        check_action(world, skill, step["action"][0], sample.action[0, at].numpy())


def check_action(world: World, skill: Any, done: Any, found: Any) -> None:
    """Check that what another skill did is in the learner's own form."""
    if world.discrete:
        mine = list(skill.acts) if world.acts else list(range(4))
        assert mine[int(found)] == int(done)
    elif world.acts:
        (place,) = skill.acts
        assert done[1 - place] == 0, "the skill could not have done so"
        assert found == pytest.approx(done[[place]])
    else:
        assert found == pytest.approx(done)


def check_counts(world: World, drawn: list[tuple[Any, Any, Any]]) -> None:
    """Check that a store has each step once: its own, and those of the others."""
    stores = {id(store): store for store, _, _ in drawn}.values()
    for store in stores:
        stored = np.flatnonzero(store._columns.data["kind"])
        seen = store._columns.data["obs"][stored]
        assert len(np.unique(seen[:, 2:], axis=0)) == len(stored)
    lengths = [int((store._columns.data["kind"] != 0).sum()) for store in stores]
    if world.together and not world.nested:
        assert len(set(lengths)) == 1
        assert lengths[0] >= 240
    elif not world.together:
        assert lengths == [120, 240]


def joint(row: Any, world: World) -> Any:
    """A drawn observation with its goal, as a record."""
    seen = 2 if world.sees else 4
    kind = [("observation", np.float32, (seen,)), ("goal", np.float32, (2,))]
    return row.view(np.dtype(kind, align=True))[0] if row.dtype == np.uint8 else row


def replayed(world: World, code: float, time: int) -> tuple[dict[str, Any], Any]:
    """Repeat an episode up to the step after ``time``; return that step, and its mask."""
    env = world.make()
    env.world = World(world.seed)  # it records nothing
    seen = env.begin(code)
    for t, action in enumerate(world.log[code]):
        mask = env.told().get("action_mask")
        before, (seen, reward, terminated, truncated, info) = seen, env.step(action)
        if t == time:
            step = {
                "obs": before[None],
                "action": np.array([action]),
                "next_obs": seen[None],
                "reward": np.float32([reward]),
                "terminated": np.array([terminated]),
                "truncated": np.array([truncated]),
                "info": {"paid": np.array([info["paid"]])},
            }
            return step, None if mask is None else mask.astype(bool)
    raise AssertionError("there is no such step")
