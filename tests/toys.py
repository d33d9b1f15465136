"""Environments small enough to know every number of by hand."""

from __future__ import annotations

import contextlib
import copy
import importlib.util
import pickle
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm
from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.batches import Rollout, Sample
from skillweave.algorithms.config import PPO, AlgorithmConfig
from skillweave.envs.engine import RawStep
from skillweave.experience.acting import Acting
from skillweave.experience.collector import Collector
from skillweave.experience.group import Collectors
from skillweave.experience.learners import Alone, Calling
from skillweave.experience.search import Starts
from skillweave.networks.stacked import Layout
from skillweave.skills import Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet
from skillweave.spaces import pack
from skillweave.training.episodes import Episodes, Tick
from skillweave.training.learner import Learner, Stack
from skillweave.training.loop import Loop, LoopState, Saved
from skillweave.training.replay_learner import ReplayLearner, store_of
from skillweave.training.stack_learner import learner_of
from skillweave.types import Array


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


REALS = gym.spaces.Box(np.float32([-1, -3]), np.float32([1, 5]))


class World(gym.Env):
    """Has any spaces, and sees that each action is in its own; episodes of 5 steps that pay 1."""

    def __init__(
        self,
        observation_space: gym.Space[Any] = REALS,
        action_space: gym.Space[Any] = gym.spaces.Discrete(2),  # noqa: B008
    ) -> None:
        self.observation_space = copy.deepcopy(observation_space)  # which has a generator
        self.action_space = action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.t = 0
        return self.see(), {}

    def see(self) -> Any:
        return self.observation_space.sample()

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action), action
        self.t += 1
        return self.see(), 1.0, False, self.t == 5, {}


def skills_of(*skills: Any, **how: Any) -> SkillSet:
    """These skills, or those of these classes, each with its own policy."""
    made = tuple(s() if isinstance(s, type) else s for s in skills)
    return SkillSet(made, tuple(s.policy for s in made), **how)


def alone_in(
    engine: Any, acting: Any, skill: Any = None, reflexes: Any = (), *starts: Any, **more: Any
) -> Collector:
    """A collector of a plain agent, or of a skill that learns apart; ``starts``: of ``Starts``."""
    return Collector(engine, acting, Alone(skill, reflexes, starts=Starts(*starts, **more)))


def calling_in(
    engine: Any,
    acting: Any,
    skills: SkillSet,
    keep_rewards: bool = False,
    guide: Any = None,
    as_skill: Any = None,
    **learners: Any,
) -> Collector:
    """A collector of a selector that calls skills."""
    return Collector(engine, acting, Calling(skills, guide, as_skill, keep_rewards), **learners)


class Toy:
    """An engine whose N environments are written as one; subclasses say ``first`` and ``play``."""

    observation_space: gym.Space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space: gym.Space = gym.spaces.Discrete(2)
    row_steps = 1

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.obs: Array = np.empty(0)
        self.steps_made, self.time_limit = 0, None

    def first(self, rows: Array) -> Array:
        """First observations of the environments ``rows``."""
        return np.zeros((len(rows), 1), np.float32)

    def play(self, action: Array) -> tuple[Array, Array, Array, Array]:
        """next_obs, reward, terminated, truncated."""
        raise NotImplementedError

    def collector(self, acting: Acting | None, shared: bool = False) -> Collector:
        """A collector of its environments."""
        return alone_in(self, acting)

    def mask(self) -> Array | None:
        return None

    def reset(self, seed: int) -> Array:
        self.rng = Seeds(seed).numpy()
        self.t = np.zeros(self.num_envs, np.int64)
        self.obs = self.first(np.arange(self.num_envs))
        return self.obs

    def reset_some(self, ids: Array, seeds: Any = None) -> Array:
        self.obs = self.obs.copy()
        self.obs[ids] = self.first(ids)
        self.t[ids] = 0
        return self.obs[ids]

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        assert ids is None
        self.t += 1
        next_obs, reward, terminated, truncated = self.play(action)
        self.steps_made += self.num_envs
        self.obs = next_obs
        return RawStep(next_obs, reward.astype(np.float32), terminated, truncated, {})

    def state(self) -> dict[str, Array]:
        """Everything it has: a toy is copied, not played again."""
        return {"pickle": np.frombuffer(pickle.dumps(self.__dict__), np.uint8).copy()}

    def restore(self, state: dict[str, Array]) -> tuple[Array, Array]:
        made = self.steps_made
        self.__dict__ = pickle.loads(state["pickle"].tobytes())
        self.steps_made = made  # steps are counted where they are made
        return self.obs, np.arange(0)

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
        return self.first(self.ones), reward, self.t == 4, self.never


class BoxIdentity(Toy):
    """The reward is −(action − observation)²; actions span [−2, 2]."""

    action_space = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)

    def first(self, rows: Array) -> Array:
        return self.rng.uniform(-1.0, 1.0, (len(rows), 1)).astype(np.float32)

    def play(self, action: Array) -> Any:
        reward = -np.square(action - self.obs)[:, 0]
        return self.first(self.ones), reward, self.t == 4, self.never


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
        return self.first(self.ones), action, self.t == 1, self.never


class Allowance(Toy):
    """Reward 1 a step, cut by a time limit of 5 steps; nothing tells the steps apart."""

    def play(self, action: Array) -> Any:
        return (
            np.zeros((self.num_envs, 1), np.float32),
            self.ones,
            self.never,
            self.t == 5,
        )


class Countdown(Toy):
    """Reward 1 a step, terminated after 5; the observation is the step."""

    observation_space = gym.spaces.Discrete(6)

    def first(self, rows: Array) -> Array:
        return np.zeros(len(rows), np.int64)

    def play(self, action: Array) -> Any:
        return self.t.copy(), self.ones, self.t == 5, self.never


class Call(Skill):
    """Takes one action for so many steps; perhaps it may never start."""

    def __init__(self, action: int, steps: int, allowed: bool) -> None:
        self.max_steps, self.allowed = steps, allowed
        self.policy = ScriptedPolicy(lambda obs: np.full(len(obs), action))

    def initiation(self, obs: Array) -> Array:
        return np.full(len(obs), self.allowed)


class Calls(Toy):
    """A selector's world: skill 0 lasts 1 step and pays 1, skill 1 lasts 10 and pays 3 at once."""

    row_steps = 10

    def __init__(self, num_envs: int, allowed: tuple[bool, bool] = (True, True)) -> None:
        super().__init__(num_envs)
        self.allowed = allowed
        self.under_way = np.zeros(num_envs, np.int64)  # steps of the open long call

    def collector(self, acting: Acting | None, shared: bool = False) -> Collector:
        calls = tuple(Call(i, (1, 10)[i], self.allowed[i]) for i in range(2))
        return calling_in(self, acting, skills_of(*calls), shared)

    def play(self, action: Array) -> Any:
        reward = np.where(action == 1, 3 * (self.under_way == 0), 1)
        self.under_way = (self.under_way + action) % 10
        return np.zeros((self.num_envs, 1), np.float32), reward, self.never, self.never


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
        return next_obs, reward, (next_obs == 4) & ~truncated, truncated


class Steady(Calls):
    """Every step of a call of ten pays 1."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, (False, True))

    def play(self, action: Array) -> Any:
        return np.zeros((self.num_envs, 1), np.float32), self.ones, self.never, self.never


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

    def reset(self, seed: int) -> Array:
        self.rngs = [(Seeds(seed) / c).numpy() for c in self.columns]
        return super().reset(seed)

    def first(self, rows: Array) -> Array:
        self.shown[rows] = [self.rngs[i].integers(4) for i in rows]
        return self.show(self.shown[rows])

    def play(self, action: Array) -> Any:
        assert all(self.action_space.contains(a) for a in action)
        reward = -self.error(self.shown, action)
        truncated = (self.t == 3) & (np.array(self.columns) % 2 == 0)
        everywhere = np.arange(self.num_envs)
        return self.first(everywhere), reward, self.t == 4, truncated


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
        return after, last & (action == self.sign), last, self.never


@dataclass(frozen=True)
class SeedsOfMember:
    """A seed tree in which the only member, 0, has the streams of member ``member``."""

    seeds: Seeds
    member: int

    def __truediv__(self, name: str | int) -> Any:
        node = self.seeds / name
        kind = _Renumbered if name in ("act", "learn") else SeedsOfMember
        return kind(node, self.member)

    def integer(self) -> int:
        return self.seeds.integer()

    def numpy(self) -> Any:
        return self.seeds.numpy()


@dataclass(frozen=True)
class _Renumbered:
    node: Seeds
    member: int

    def __truediv__(self, member: int) -> Seeds:
        assert member == 0
        return self.node / self.member


def example(name: str) -> Any:
    """A program of ``examples/`` as a module, made once."""
    if name not in sys.modules:
        path = Path(__file__).parents[1] / f"examples/{name}.py"
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[name]


def own_algorithm() -> Any:
    """The example of an algorithm of one's own; it registers A2C."""
    return example("own_algorithm")


@dataclass
class Training:
    """A learner in an environment, to be trained."""

    learner: Learner
    collectors: Collectors
    seeds: Any
    episodes: Episodes

    @property
    def state(self) -> Any:
        """Of its only stack."""
        return self.learner.stacks[0].state

    def run(self, budget: int, **how: Any) -> LoopState:
        """Train it by a ``Loop``."""
        return Loop(self.learner, self.collectors, self.episodes, self.seeds, budget, **how).run()

    def resume(self, extra: dict[str, Any], at: LoopState) -> Array:
        """Stand where a checkpoint was written, at these steps."""
        parts = self.learner, self.collectors, self.episodes, self.seeds
        return Loop(*parts, at.steps, at).restore(extra)


def training(
    algorithm: Algorithm,
    env: Any,
    seeds: Any = 0,
    members: Any = (0,),
    *,
    state: Any = None,
    shared: bool = False,
    goes_on_at: int = 0,
) -> Training:
    """An algorithm's members, each with its seed, in an environment.

    Args:
        env: a toy, or an engine.
        shared: members learn from what all did.
        goes_on_at: environment steps that were made before.
    """
    seeds = Seeds(seeds) if isinstance(seeds, int) else seeds
    stack = Stack(algorithm, state or algorithm.init([Seeds(m) for m in members]))
    p, n, row_steps = stack.members, env.num_envs, getattr(env, "row_steps", 1)
    learner: Any
    if shared:
        store = store_of(algorithm, n, p, shared=True)
        learner = ReplayLearner([stack], store, seeds, row_steps=row_steps)
    else:
        learner = learner_of(stack, n, seeds, row_steps=row_steps, goes_on_at=goes_on_at)
    acting = Acting([(algorithm, p)], n)
    own = isinstance(env, Toy)
    collector = env.collector(acting, shared) if own else alone_in(env, acting)
    return Training(learner, Collectors([collector], p), seeds, Episodes())


def copied(state: Any) -> Any:
    """A state with tensors of its own."""
    return type(state)(**{name: value.clone() for name, value in vars(state).items()})


def learn(
    config: AlgorithmConfig,
    env: Any,
    budget: int,
    seeds: Any = 0,
    members: Any = (0,),
    *,
    state: Any = None,
    shared: bool = False,
    **how: Any,
) -> tuple[Any, Any]:
    """Any algorithm, trained in an environment: it and its state, whose members have seeds."""
    algorithm = make_algorithm(config, env.observation_space, env.action_space)
    made = training(algorithm, env, seeds, members, state=state, shared=shared)
    made.run(budget, **how)
    return algorithm, made.state


class Cut(Exception):
    """What interrupts a training here."""


def goes_on(
    algorithm: Algorithm, make: Callable[[], Toy], budget: int, every: int
) -> tuple[Training, Saved, Callable[..., Training]]:
    """What is cut at its second checkpoint, and resumed, learns and tells what a whole run does.

    Returns:
        The whole run, the second checkpoint, and a function of what is saved beside the state,
        which resumes from there.
    """
    told: list[Tick] = []
    whole = training(algorithm, make())
    whole.run(budget, on_tick=told.append)
    saved: list[Saved] = []
    ticks: list[Tick] = []

    states: list[Any] = []
    cut = training(algorithm, make())

    def cut_at_second(found: Saved) -> None:
        saved.append(replace(found, at=replace(found.at)))
        states.append(copied(cut.state))
        if len(saved) == 2:
            raise Cut

    how: dict[str, Any] = {"checkpoint_every": every, "on_tick": ticks.append}
    with contextlib.suppress(Cut):
        cut.run(budget, on_checkpoint=cut_at_second, **how)

    def resumed(extra: dict[str, Any]) -> Training:
        at, state = saved[1].at, copied(states[1])
        now = LoopState(at.update, at.steps)
        found = training(algorithm, make(), state=state, goes_on_at=at.steps)
        assert not len(found.resume(extra, now))
        found.run(budget, at=now, on_checkpoint=lambda saved: None, **how)
        return found

    state = resumed(saved[1].extra).state
    for f in fields(state):
        assert torch.equal(getattr(state, f.name), getattr(whole.state, f.name)), f.name
        assert getattr(state, f.name).dtype == getattr(whole.state, f.name).dtype, f.name
    said = [[(t.update, t.steps, t.metrics) for t in each] for each in (ticks, told)]
    assert said[0] == said[1]
    return whole, saved[1], resumed


def random_critic(algorithm: Any, state: Any) -> None:
    """Give PPO's critic, which begins at 0, values of its own: the same to each member."""
    weight = algorithm.layout.views(state.params)[f"{algorithm.critic_net.head}.weight"]
    drawn = torch.randn(weight.shape[1:], generator=torch.Generator().manual_seed(0))
    weight.copy_(drawn / len(drawn) ** 0.5)


def rollout_of(
    algorithm: Any,
    state: Any,
    seed: int = 0,
    steps: int = 8,
    columns: int = 6,
    *,
    around: float = 2.0,
    masked: bool = False,
    **more: Any,
) -> Rollout:
    """Random trajectories that hang together, acted on by PPO's members, after any memory."""
    g, p = torch.Generator().manual_seed(seed), len(state.params)
    lead, width = (p, steps, columns), algorithm.obs.size
    last = torch.rand(lead, generator=g) < 0.2
    terminated = last & (torch.rand(lead, generator=g) < 0.5)
    last[:, -1] = True
    obs = around + torch.randn(*lead, width, generator=g)
    next_obs = torch.randn(*lead, width, generator=g)
    next_obs[:, :-1] = torch.where(last[:, :-1, :, None], next_obs[:, :-1], obs[:, 1:])
    mask = None
    if masked:
        mask = torch.rand(*lead, algorithm.codec.size, generator=g) < 0.5
        mask[..., 2] = True
    starts = torch.zeros_like(last)
    starts[:, 1:] = last[:, :-1]
    size, acted = algorithm.memory_size, []
    memory = first = torch.randn(p, columns, size, generator=g) if size else None
    params = algorithm.acting_params(state, 0.0)
    chance = [torch.Generator().manual_seed(100 * seed + m) for m in range(p)]
    noise = algorithm.noise(chance, steps, columns)
    for t in range(steps):
        allowed = None if mask is None else mask[:, t]
        if memory is not None:
            memory = torch.where(starts[:, t, :, None], 0.0, memory)
        *found, memory = algorithm.act(params, obs[:, t], allowed, noise[t], memory)
        acted.append(found)
    action, dist_params = (torch.stack(x, 1) for x in zip(*acted, strict=True))
    log_std = params.views.get("actor.log_std")
    return Rollout(
        obs, action, torch.randn(lead, generator=g), 0.9 * ~terminated, next_obs, last, mask,
        dist_params=dist_params, log_std=None if log_std is None else log_std[:, None],
        recurrent_state=first, episode_start=starts if size else None, **more,
    )  # fmt: skip


def transitions(
    space: gym.Space[Any],
    lead: tuple[int, int],
    width: int = 3,
    *,
    masked: bool = False,
    weighted: bool = True,
    seed: int = 0,
) -> Sample:
    """Random ones, ``lead`` of them: the first of each member ends its episode."""
    g = torch.Generator().manual_seed(seed)
    choices = getattr(space, "n", 0)
    allowed = torch.rand(2, *lead, choices, generator=g) < 0.5
    allowed[..., 1:2] = True
    masks = allowed if masked else (None, None)
    discount = torch.full(lead, 0.9)
    discount[:, 0] = 0.0
    forces = torch.rand(*lead, *(space.shape or ()), generator=g) * 2 - 1
    return Sample(
        obs=torch.randn(*lead, width, generator=g),
        action=torch.randint(choices, lead, generator=g) if choices else forces,
        reward=torch.randn(lead, generator=g), discount=discount,
        next_obs=torch.randn(*lead, width, generator=g), mask=masks[0], next_mask=masks[1],
        weight=torch.rand(lead, generator=g) if weighted else None, index=np.zeros(lead, np.int64),
    )  # fmt: skip


def network_of(
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
    seed: int = 0,
    **settings: Any,
) -> AgentPolicy:
    """A fresh network, its weights made large enough to act in more than one way."""
    config = PPO(num_envs=1, n_steps=1, batch_size=1, **settings)
    algorithm = make_algorithm(config, observation_space, action_space)
    state = algorithm.init([Seeds(seed)])
    with torch.no_grad():
        state.params[:] = 5 * state.params
        state.obs_mean[:], state.obs_var[:] = 0.3, 2.0
    return AgentPolicy.of(algorithm, state)


def drawn(net: Any, members: int, *args: Any) -> tuple[Layout, torch.Tensor]:
    """The layout of a network, and weights of its members (members, size)."""
    layout = Layout(net.shapes)
    flat = torch.zeros(members, layout.size)
    generators = [torch.Generator().manual_seed(m) for m in range(members)]
    net.init_(layout.views(flat), *args, generators)
    return layout, flat


def members_of(x: Any, rows: slice) -> Any:
    """The members ``rows`` of a state or a rollout, as a copy."""
    values = {f.name: getattr(x, f.name) for f in fields(x)}
    copied = {k: v[rows].clone() for k, v in values.items() if isinstance(v, torch.Tensor)}
    return type(x)(**{**values, **copied})


class SideBySide:
    """Environments as a pool, for tests that play them one by one as well."""

    def __init__(self, envs: list[Any]) -> None:
        self.envs = envs
        self.observation_space = envs[0].observation_space
        self.action_space = envs[0].action_space

    def reset(self, ids: Any) -> Any:
        return np.stack([self.envs[i].reset()[0] for i in ids]), {}

    def step(self, action: Any, ids: Any) -> Any:
        told = [self.envs[i].step(a) for i, a in zip(ids, action, strict=True)]
        obs, reward, terminated, truncated, infos = zip(*told, strict=True)
        info = {k: np.array([i[k] for i in infos]) for k in infos[0]}
        return np.stack(obs), *map(np.array, (reward, terminated, truncated)), info
