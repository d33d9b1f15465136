"""Environments small enough to know every number of by hand."""

from __future__ import annotations

import importlib.util
import pickle
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from skillweave.training.collector import Collector
from skillweave.training.off_policy import train_off_policy
from skillweave.training.on_policy import train_on_policy

from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.algorithms.policy import make_algorithm
from skillweave.seeding import Seeds
from skillweave.spaces import pack
from skillweave.types import Array, VecStep


def cartpole(obs: Array, action: int) -> Array:
    """CartPole's true successor of an observation."""
    env = gym.make("CartPole-v1").unwrapped
    env.reset()
    env.state = obs.astype(np.float64)
    return env.step(int(action))[0]


def actions(n: int, t: int) -> Array:
    """Left and right by turns."""
    return (np.arange(n) + t) % 2


class Ledger(gym.Env):
    """Its observation is (tag, episode, step, last action): a phantom step would be seen.

    Episode e lasts 2 + e % 3 steps; it terminates if e is even, else it is truncated. The tag is
    drawn at each reset; the reward is 10·step + action.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def __init__(self) -> None:
        self.episode = -1

    def _obs(self, action: int) -> Array:
        return np.array([self.tag, self.episode, self.t, action], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        self.tag = float(self.np_random.integers(1 << 20))
        return self._obs(-1), {}

    def step(self, action: int) -> Any:
        assert self.action_space.contains(action)
        assert self.t < self.length, "stepped after the end"
        self.t += 1
        ended, even = self.t == self.length, self.episode % 2 == 0
        info = {"t": self.t, "nested": {"t": self.t}}
        return self._obs(action), 10.0 * self.t + action, ended and even, ended and not even, info

    @property
    def length(self) -> int:
        return 2 + self.episode % 3


class Rememberer(gym.Env):
    """Keeps the array it was given as an action; the reward is how much the action changed."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.previous = np.zeros(1, np.float32)
        return np.zeros(1, np.float32), {}

    def step(self, action: Array) -> Any:
        change = float(np.abs(action - self.previous).sum())
        self.previous = action
        return np.zeros(1, np.float32), change, False, False, {}


class Toy:
    """A VecEnv whose N environments are written as one; subclasses say ``first`` and ``play``."""

    observation_space: gym.Space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space: gym.Space = gym.spaces.Discrete(2)

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.obs: Array = np.empty(0)
        self.steps_made = 0

    def renew(self, seeds: Seeds) -> Array:
        return np.arange(0)

    def set_gamma(self, gamma: Array) -> None:
        pass

    def state(self) -> dict[str, Array]:
        """Everything it has: a toy is copied, not played again."""
        return {"pickle": np.frombuffer(pickle.dumps(self.__dict__), np.uint8).copy()}

    def restore(self, state: dict[str, Array]) -> Array:
        made = self.steps_made
        self.__dict__ = pickle.loads(state["pickle"].tobytes())
        self.steps_made = made  # steps are counted where they are made
        return np.arange(0)

    def first(self, rows: Array) -> Array:
        """First observations of the environments ``rows``."""
        return np.zeros((len(rows), 1), np.float32)

    def play(self, action: Array) -> tuple[Array, Array, Array, Array, Array]:
        """next_obs, reward, terminated, truncated, steps."""
        raise NotImplementedError

    def mask(self) -> Array | None:
        return None

    def reset(self, seeds: Seeds) -> Array:
        self.rng = seeds.numpy()
        self.t = np.zeros(self.num_envs, np.int64)
        self.obs = self.first(np.arange(self.num_envs))
        return self.obs

    def step(self, action: Array) -> VecStep:
        self.t += 1
        next_obs, reward, terminated, truncated, steps = self.play(action)
        self.steps_made += int(steps.sum())
        self.obs = next_obs.copy()
        if (rows := np.flatnonzero(terminated | truncated)).size:
            self.obs[rows] = self.first(rows)
            self.t[rows] = 0
        reward = reward.astype(np.float32)
        return VecStep(next_obs, self.obs, reward, terminated, truncated, steps, self.mask(), {})

    def close(self) -> None:
        pass

    @property
    def ones(self) -> Array:
        return np.ones(self.num_envs, np.int64)

    @property
    def never(self) -> Array:
        return np.zeros(self.num_envs, bool)


class Identity(Toy):
    """The reward is 1 where the action equals the observation, else 0; episodes of 4 steps."""

    observation_space = gym.spaces.Discrete(4)
    action_space = gym.spaces.Discrete(4)

    def first(self, rows: Array) -> Array:
        return self.rng.integers(4, size=len(rows))

    def play(self, action: Array) -> Any:
        reward = action == self.obs
        return self.first(self.ones), reward, self.t == 4, self.never, self.ones


class BoxIdentity(Toy):
    """The reward is −(action − observation)²; actions span [−2, 2]."""

    action_space = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)

    def first(self, rows: Array) -> Array:
        return self.rng.uniform(-1.0, 1.0, (len(rows), 1)).astype(np.float32)

    def play(self, action: Array) -> Any:
        reward = -np.square(action - self.obs)[:, 0]
        return self.first(self.ones), reward, self.t == 4, self.never, self.ones


class Masked(Toy):
    """Action a pays a, so the forbidden one is often the best; records what was forbidden."""

    observation_space = gym.spaces.Discrete(3)
    action_space = gym.spaces.Discrete(3)

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self.taken_though_forbidden = 0

    def first(self, rows: Array) -> Array:
        return self.rng.integers(3, size=len(rows))

    def mask(self) -> Array:
        """The action that equals the observation is forbidden."""
        return np.arange(3)[None] != self.obs[:, None]

    def play(self, action: Array) -> Any:
        self.taken_though_forbidden += int((action == self.obs).sum())
        return self.first(self.ones), action, self.t == 1, self.never, self.ones


class Allowance(Toy):
    """Reward 1 a step, cut by a time limit of 5 steps; nothing tells the steps apart."""

    def play(self, action: Array) -> Any:
        return (
            np.zeros((self.num_envs, 1), np.float32),
            self.ones,
            self.never,
            self.t == 5,
            self.ones,
        )


class Countdown(Toy):
    """Reward 1 a step, terminated after 5; the observation is the step."""

    observation_space = gym.spaces.Discrete(6)

    def first(self, rows: Array) -> Array:
        return np.zeros(len(rows), np.int64)

    def play(self, action: Array) -> Any:
        return self.t.copy(), self.ones, self.t == 5, self.never, self.ones


class Calls(Toy):
    """A semi-MDP: action 0 lasts 1 step and pays 1, action 1 lasts 10 steps and pays 3."""

    def __init__(self, num_envs: int, allowed: tuple[bool, bool] = (True, True)) -> None:
        super().__init__(num_envs)
        self.allowed = allowed

    def mask(self) -> Array:
        return np.tile(self.allowed, (self.num_envs, 1))

    def play(self, action: Array) -> Any:
        still = np.zeros((self.num_envs, 1), np.float32)
        return still, 1 + 2 * action, self.never, self.never, 1 + 9 * action


class Clockwork(Toy):
    """Deterministic, each column by itself: obs' = 2·obs + action + column (mod 5)."""

    observation_space = gym.spaces.Discrete(5)
    action_space = gym.spaces.Discrete(3)

    def __init__(self, columns: range) -> None:
        super().__init__(len(columns))
        self.columns = np.array(columns)

    def first(self, rows: Array) -> Array:
        return self.columns[rows] % 5

    def play(self, action: Array) -> Any:
        next_obs = (2 * self.obs + action + self.columns) % 5
        reward, truncated = (action == self.obs % 3) * 1.0, self.t == 3 + self.columns % 4
        return next_obs, reward, (next_obs == 4) & ~truncated, truncated, self.ones


class Broken(Identity):
    """Pays NaN."""

    def play(self, action: Array) -> Any:
        next_obs, reward, *rest = super().play(action)
        return next_obs, reward * np.nan, *rest


_BITS = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])


def _lit(bits: Array) -> Array:
    """Pictures (n, 6, 8) with the left half lit by the first bit, the right by the second."""
    return np.repeat(bits[:, None, :], 6, 1).repeat(4, 2).astype(np.uint8) * 255


SHOWS: dict[str, gym.Space[Any]] = {
    "vector": gym.spaces.Box(-1.0, 1.0, (2,), np.float32),
    "discrete": gym.spaces.Discrete(4, start=-2),
    "multi-discrete": gym.spaces.MultiDiscrete([2, 3]),
    "multi-binary": gym.spaces.MultiBinary(2),
    "image, channels last": gym.spaces.Box(0, 255, (6, 8, 1), np.uint8),
    "image, channels first": gym.spaces.Box(0, 255, (1, 6, 8), np.uint8),
    "dict": gym.spaces.Dict(
        picture=gym.spaces.Box(0, 255, (6, 8, 1), np.uint8),
        number=gym.spaces.Box(-1.0, 1.0, (1,), np.float32),
    ),
    "tuple": gym.spaces.Tuple(
        (gym.spaces.Discrete(2), gym.spaces.Box(-1.0, 1.0, (1,), np.float32))
    ),
}
"""Kinds of observation that ``Echo`` can show its state in."""

ASKS: dict[str, tuple[gym.Space[Any], Array]] = {
    "Discrete": (gym.spaces.Discrete(4, start=3), np.array([4, 6, 3, 5])),
    "MultiDiscrete": (gym.spaces.MultiDiscrete([3, 2]), np.array([[0, 0], [1, 1], [2, 0], [0, 1]])),
    "MultiBinary": (gym.spaces.MultiBinary(2), _BITS),
    "Box": (
        gym.spaces.Box(np.float32([-3, 10]), np.float32([1, 10.5]), dtype=np.float32),
        np.float32([[-2, 10.375], [0, 10.125], [0, 10.375], [-2, 10.125]]),
    ),
}
"""Kinds of action that ``Echo`` can ask for, and the one it asks for in each state."""


class Echo(Toy):
    """Shows one of four states and pays for the action that belongs to it.

    Choices: the share of them that are right. A Box: minus the mean squared distance, in units of
    half its ranges. Columns have streams of their own, so that a stack sees what singles see.
    """

    def __init__(self, columns: int | range, shows: str = "vector", asks: str = "Discrete") -> None:
        self.columns = columns if isinstance(columns, range) else range(columns)
        super().__init__(len(self.columns))
        self.shows, self.observation_space = shows, SHOWS[shows]
        self.action_space, self.wanted = ASKS[asks]
        self.shown = np.zeros(self.num_envs, np.int64)

    def show(self, state: Array) -> Array:
        """States (n,) as observations."""
        bits = _BITS[state]
        signs = 2.0 * bits.astype(np.float32) - 1.0
        picture = _lit(bits)
        batched = {
            "vector": signs,
            "discrete": state - 2,
            "multi-discrete": bits * [1, 2],
            "multi-binary": bits.astype(np.int8),
            "image, channels last": picture[..., None],
            "image, channels first": picture[:, None],
            "dict": {"number": signs[:, 1:], "picture": _lit(bits * [1, 0])[..., None]},
            "tuple": (bits[:, 0], signs[:, 1:]),
        }[self.shows]
        return pack(self.observation_space, batched)

    def error(self, state: Array, action: Array) -> Array:
        """How wrong actions are, (n,)."""
        if not isinstance(self.action_space, gym.spaces.Box):
            return (action != self.wanted[state]).reshape(len(state), -1).mean(1)
        half = (self.action_space.high - self.action_space.low) / 2
        return np.square((action - self.wanted[state]) / half).mean(1)

    def reset(self, seeds: Seeds) -> Array:
        self.rngs = [(seeds / c).numpy() for c in self.columns]
        return super().reset(seeds)

    def first(self, rows: Array) -> Array:
        self.shown[rows] = [self.rngs[i].integers(4) for i in rows]
        return self.show(self.shown[rows])

    def play(self, action: Array) -> Any:
        assert all(self.action_space.contains(a) for a in action)
        reward = -self.error(self.shown, action)
        truncated = (self.t == 3) & (np.array(self.columns) % 2 == 0)
        everywhere = np.arange(self.num_envs)
        return self.first(everywhere), reward, self.t == 4, truncated, self.ones


class Recall(Toy):
    """A sign is shown at the first of four steps; at the last, naming it pays 1."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def first(self, rows: Array) -> Array:
        if len(rows) == self.num_envs:
            self.sign = np.zeros(self.num_envs, np.int64)
        self.sign[rows] = self.rng.integers(2, size=len(rows))
        return np.stack([2.0 * self.sign[rows] - 1.0, 0.0 * rows], 1).astype(np.float32)

    def play(self, action: Array) -> Any:
        last = self.t == 4
        after = np.stack([0.0 * self.t, self.t == 3], 1).astype(np.float32)
        return after, last & (action == self.sign), last, self.never, self.ones


@dataclass(frozen=True)
class SeedsOfMember:
    """A seed tree in which the only member, 0, has the streams of member ``member``."""

    seeds: Seeds
    member: int

    def __truediv__(self, name: str) -> Any:
        node = self.seeds / name
        return _Renumbered(node, self.member) if name in ("act", "learn") else node


@dataclass(frozen=True)
class _Renumbered:
    node: Seeds
    member: int

    def __truediv__(self, member: int) -> Seeds:
        assert member == 0
        return self.node / self.member


def own_algorithm() -> Any:
    """The example of an algorithm of one's own as a module; made once, it registers A2C."""
    if "own_algorithm" not in sys.modules:
        path = Path(__file__).parents[1] / "examples/own_algorithm.py"
        spec = importlib.util.spec_from_file_location("own_algorithm", path)
        assert spec is not None
        assert spec.loader is not None
        sys.modules["own_algorithm"] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules["own_algorithm"]


def learn(
    config: AlgorithmConfig,
    env: Toy,
    budget: int,
    seeds: Any = 0,
    members: Any = (0,),
    **where: Any,
) -> tuple[Any, Any]:
    """Any algorithm, trained in an environment: it and its state, whose members have seeds."""
    algorithm: Algorithm = make_algorithm(config, env.observation_space, env.action_space)
    seeds = Seeds(seeds) if isinstance(seeds, int) else seeds
    state = where.pop("state", None) or algorithm.init([Seeds(m) for m in members])
    train: Any = train_on_policy if algorithm.store == "rollout" else train_off_policy
    collector = where.pop("collector", None) or Collector(env)
    return algorithm, train(algorithm, collector, state, seeds, budget, **where)
