"""Rows that are judged again, against a loop that repeats the recorded actions.

In each random world a skill, or a plain agent, collects. Then every drawn row is compared with a
plain loop: another environment repeats the actions of the episode, and the skill is asked about
the one step, under the goal that the row has.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.config import DQN, SAC, TD3, Hindsight
from skillweave.envs.make import EnvSpec
from skillweave.experience.acting import Acting
from skillweave.networks.config import Network
from skillweave.policies.core import Step
from skillweave.skills import Reflex, Skill
from skillweave.spaces import obs_dtype, pack
from skillweave.training.learner import Stack
from skillweave.training.learning_task import skill_task
from skillweave.training.replay_learner import judge_of
from skillweave.training.role import Role, agent_role
from skillweave.training.stack_learner import learner_of

SMALL = Network((8,), "relu")
MOVES = np.float32([[0.3, 0], [-0.3, 0], [0, 0.3], [0, -0.3]])


@dataclass
class World:
    """A random world, and everything that was done in it."""

    seed: int
    log: dict[float, list[tuple[Any, ...]]] = field(default_factory=dict)
    """By the code of an episode: where it began, and its actions."""

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self.agent = bool(rng.random() < 0.25)
        self.named = self.agent or bool(rng.random() < 0.5)
        self.discrete = bool(rng.random() < 0.4)
        self.strategy = rng.choice(["future", "final", "episode"])
        self.limit = int(rng.integers(3, 12))  # of episodes
        self.dies = bool(rng.random() < 0.4)
        self.wall = float(rng.uniform(0.5, 1.5))
        self.ends = bool(rng.random() < 0.6)  # reaching the goal ends the call, or the episode
        self.dense = bool(rng.random() < 0.5)
        self.late = bool(rng.random() < 0.3)  # rewards depend on the time of the call
        self.max_steps = [None, int(rng.integers(2, 7))][int(rng.random() < 0.5)]
        self.cells = bool(rng.random() < 0.3)  # goals are numbers of cells
        self.sees = bool(rng.random() < 0.5)
        self.acts = bool(rng.random() < 0.5)
        self.reflex = bool(rng.random() < 0.3)
        self.members = int(rng.choice([1, 1, 2]))
        self.num_envs = 2 * self.members
        self.buffer = int(rng.choice([12, 20, 300]))  # rows of two columns, or of four
        self.share = int(rng.choice([1, 4]))

    def make(self) -> Plane:
        return Plane(self)

    def skill(self) -> Skill:
        return GoTo(self)


class Plane(gym.Env[Any, Any]):
    """A plane: an episode has a code, which is where it begins, and its actions are recorded."""

    def __init__(self, world: World) -> None:
        self.world = w = world
        here = gym.spaces.Box(-9, 9, (2,), np.float32)
        one = gym.spaces.Box(-99, 99, (1,), np.float32)
        self.observation_space = gym.spaces.Box(-99, 99, (4,), np.float32)
        if w.named:
            parts = {"here": here, "time": one, "code": one}
            if w.agent:
                parts |= {"achieved_goal": here, "desired_goal": here}
            self.observation_space = gym.spaces.Dict(parts)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        if w.discrete:
            self.action_space = gym.spaces.Discrete(4)

    def see(self) -> Any:
        if not self.world.named:
            return np.float32([*self.here, self.time, self.code])
        seen = {"here": self.here.copy(), "time": np.float32([self.time]), "code": self.code[None]}
        if self.world.agent:
            seen |= {"achieved_goal": self.here.copy(), "desired_goal": self.goal.copy()}
        return seen

    def begin(self, code: Any) -> Any:
        """Begin the episode with this code."""
        rng = np.random.default_rng(int(code))
        self.code, self.time = np.float32(code), 0
        self.here = rng.uniform(-1, 1, 2).astype(np.float32)
        self.goal = rng.uniform(-1, 1, 2).astype(np.float32)
        return self.see()

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        seen = self.begin(self.np_random.integers(1 << 20))
        self.world.log[float(self.code)] = []
        return seen, {}

    def step(self, action: Any) -> Any:
        w = self.world
        if float(self.code) in w.log:
            w.log[float(self.code)].append(np.array(action))
        move = MOVES[int(action)] if w.discrete else 0.3 * np.float32(action)
        self.here = (self.here + move).astype(np.float32)
        self.time += 1
        died = w.dies and not w.agent and self.here[0] > w.wall
        paid = np.float32(self.here.sum())
        if w.agent:
            paid = self.compute_reward(self.here[None], self.goal[None], {})[0]
            died = bool(self.compute_terminated(self.here[None], self.goal[None], {})[0])
        return self.see(), paid, bool(died), self.time >= w.limit, {}

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        away = np.linalg.norm(achieved - desired, axis=-1)
        return -away if self.world.dense else (away < 0.5) - 1.0

    def compute_terminated(self, achieved: Any, desired: Any, info: Any) -> Any:
        return self.world.ends & (np.linalg.norm(achieved - desired, axis=-1) < 0.5)


class GoTo(Skill):
    """Go to a point, or to a cell."""

    name = "go"

    def __init__(self, world: World) -> None:
        super().__init__()
        self.world = w = world
        self.max_steps = w.max_steps
        self.goal_space = gym.spaces.Discrete(9) if w.cells else gym.spaces.Box(-1, 1, (2,))
        if w.sees:
            self.sees = "here" if w.named else (0, 1)
        if w.acts:
            self.acts = (0, 2) if w.discrete else (1,)

    def here(self, obs: Any) -> Any:
        return obs["here"] if self.world.named else obs[:, :2]

    def achieved_goal(self, obs: Any) -> Any:
        here = self.here(obs)
        if not self.world.cells:
            return here
        cell = np.clip(np.floor(here + 1.5), 0, 2).astype(np.int64)
        return 3 * cell[:, 0] + cell[:, 1]

    def near(self, step: Any) -> Any:
        reached = self.achieved_goal(step.next_obs)
        if self.world.cells:
            return reached == step.goal
        return np.linalg.norm(reached - step.goal, axis=1) < 0.4

    def reward(self, step: Any) -> Any:
        paid = self.near(step) - 1.0 + 0.1 * step.reward - 0.01 * step.terminated
        if self.world.dense:
            paid = paid - 0.1 * np.abs(step.goal).reshape(len(paid), -1).sum(1)
        if self.world.late:
            paid = paid - 0.1 * step.elapsed - step.timed_out
        return paid + 0.001 * np.abs(step.action).reshape(len(paid), -1).sum(1)

    def termination(self, step: Any) -> Any:
        return self.near(step) & self.world.ends


def config_of(world: World) -> Any:
    how = Hindsight(world.share, world.strategy)
    kind: Any = DQN if world.discrete else [SAC, TD3][world.seed % 2]
    return kind(
        num_envs=world.num_envs // world.members,
        buffer_size=world.buffer,
        learning_starts=0,
        network=SMALL,
        hindsight=how,
        n_step=1,
        action_repeat=0.0,
    )


def collected(world: World) -> Any:
    """Return the algorithm and its learner after some requests, and the role."""
    spec, config = EnvSpec(world.make, engine="sync"), config_of(world)
    role = agent_role(spec)
    if not world.agent:
        role = Role("go", "skill", spec, config, world.skill())
    reflexes = ()
    if world.reflex and not world.agent:
        still: Any = 0 if world.discrete else np.zeros(2, np.float32)
        seen = (lambda o: o["here"][:, 1] > 0.5) if world.named else (lambda o: o[:, 1] > 0.5)
        reflexes = (Reflex(seen, still, "high"),)
    algorithm = make_algorithm(config, *role.spaces)
    members = world.members
    stack = Stack(algorithm, algorithm.init([Seeds(i) for i in range(members)]))
    judge = judge_of(config, role)
    learner: Any = learner_of(stack, world.num_envs, Seeds(1), judge=judge)
    acting = Acting([(algorithm, members)], world.num_envs)
    collector = skill_task(role, reflexes).collector(world.num_envs, acting)
    collector.start(Seeds(world.seed))
    rng = np.random.default_rng(world.seed)
    for update in range(int(rng.integers(8, 40))):
        request = learner.request(update, update, 0.0)
        learner.take(collector.collect(request).batches)
    return learner, role


def field_of(obs: Any, space: Any, *path: str) -> Any:
    """Return a part of observations of a sample, tensors of bytes where they have parts."""
    found = obs.numpy()
    if isinstance(space, gym.spaces.Dict):
        found = found.view(obs_dtype(space)).reshape(found.shape[:2])
        for name in path:
            found = found[name]
    return found


@pytest.mark.parametrize(
    "seed", [*range(30), *(pytest.param(i, marks=pytest.mark.slow) for i in range(30, 230))]
)
def test_a_row_under_another_goal_is_what_a_plain_loop_finds(seed: int) -> None:
    world = World(seed)
    learner, role = collected(world)
    gamma = torch.full((world.members,), 0.9)
    rngs = [np.random.default_rng([seed, i]) for i in range(world.members)]
    store = learner.store
    sample = store.sample(60, gamma, rngs)
    raw = store._rows(sample.index % store._columns.slots)
    codes, times = (
        raw.obs[k].squeeze(-1) if world.named else raw.obs[..., i]
        for i, k in ((3, "code"), (2, "time"))
    )
    others = 0
    for at in np.ndindex(codes.shape):
        path = ("desired_goal",) if world.agent else ("goal",)
        goal = field_of(sample.obs, role.observation_space, *path)[at]
        step, reached = replayed(world, float(codes[at]), int(times[at]), role)
        again = field_of(sample.next_obs, role.observation_space, *path)[at]
        assert np.array_equal(goal, again)
        own = step["goal"] if world.agent else raw.columns["goal"][at]
        allowed = [x for x in reached if np.array_equal(x, goal)]
        assert allowed or np.array_equal(goal, own)
        others += not np.array_equal(goal, own)
        reward, ends = asked(world, step, goal)
        assert sample.reward[at].item() == pytest.approx(reward, abs=1e-5)
        assert sample.discount[at].item() == pytest.approx(0.0 if ends else 0.9)
        for found, seen in ((sample.obs, step["obs"]), (sample.next_obs, step["next_obs"])):
            if not world.agent:
                part = field_of(found, role.observation_space, "observation")[at]
                whole = GoTo(world).here(seen)[0] if world.sees else seen[0]
                assert np.array_equal(part, whole)
    assert others, "no row has another goal"


def replayed(world: World, code: float, time: int, role: Any) -> tuple[dict[str, Any], list[Any]]:
    """Repeat an episode up to the step after ``time``; return that step, and what was reached.

    Returns:
        The step, each value with an axis of one row; the goals that its call may have reached.
    """
    env, space = world.make(), EnvSpec(world.make).spaces.observation

    def packed(obs: Any) -> Any:
        batch = {k: v[None] for k, v in obs.items()} if world.named else obs[None]
        return pack(space, batch)

    actions = world.log[code]
    env.world = World(world.seed)  # it records nothing
    seen = [packed(env.begin(code))]
    found: dict[str, Any] = {}
    for t, action in enumerate(actions):
        obs, reward, terminated, truncated, _ = env.step(action)
        seen.append(packed(obs))
        if t == time:
            found = {
                "obs": seen[-2],
                "action": np.array([action]),
                "next_obs": seen[-1],
                "reward": np.float32([reward]),
                "terminated": np.array([terminated]),
                "truncated": np.array([truncated]),
                "elapsed": np.array([t + 1]),
                "goal": env.goal,
            }
    first = {"future": time, "episode": 0, "final": len(actions) - 1}[world.strategy]
    skill = GoTo(world)
    achieved = [
        x["achieved_goal"][0] if world.agent else skill.achieved_goal(x)[0] for x in seen[1:]
    ]
    return found, achieved[first:]


def asked(world: World, step: dict[str, Any], goal: Any) -> tuple[float, bool]:
    """Ask the environment, or the skill, about one step under a goal."""
    if world.agent:
        pair = step["next_obs"]["achieved_goal"], goal[None]
        env = world.make()
        return env.compute_reward(*pair, {})[0], env.compute_terminated(*pair, {})[0]
    late = world.max_steps is not None and step["elapsed"][0] >= world.max_steps
    one = Step(
        step["obs"],
        step["action"],
        step["next_obs"],
        step["reward"],
        step["terminated"],
        step["truncated"],
        np.array([late and not step["terminated"][0]]),
        step["elapsed"],
        {},
        np.array(goal)[None],
    )
    skill = GoTo(world)
    ends = bool(step["terminated"][0] or skill.termination(one)[0])
    return float(np.float32(skill.reward(one)[0])), ends
