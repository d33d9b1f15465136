"""Hierarchies drawn by seed, of all that can be declared, in the world of a crane; plain data.

Networks are stand-ins: what they answer follows from the numbers that they are given, and from
their names. Each number that reaches them, or a function of the user, thus counts to the last bit.
"""

from __future__ import annotations

import functools
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete

import skillweave as sw
from skillweave.algorithms.agent_policy import AgentPolicy, TrainedNetwork
from skillweave.hierarchy.assembly import assembled, learning_set
from skillweave.hierarchy.fitting import active_guide, ready_policies, ready_selectors
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.roles import Roles, roles_of
from skillweave.policies.core import Turn
from skillweave.policies.functional import Functional
from skillweave.policies.hierarchy import ActiveGuide
from skillweave.skills.goal_spaces import blank_choices
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.spaces import obs_dtype
from skillweave.types import Array, Memory, Step

# The environment --------------------------------------------------------------------------------

OBSERVATIONS = Dict(
    {"arm": Box(-2, 2, (2,), np.float32), "hook": Box(-2, 2, (1,), np.float32), "mode": Discrete(3)}
)
ACTIONS: dict[str, Any] = {
    "box": Box(np.float32([-1, -1, -1]), np.float32([1, 1, 3])),
    "several": MultiDiscrete([3, 3, 2]),
    "one": Discrete(4, start=1),
    "named": Dict({"grip": Discrete(2), "move": Box(-1, 1, (2,), np.float32)}),
}
GOALS: dict[str, Any] = {
    "place": Box(-1, 1, (2,), np.float32),
    "number": Discrete(3, start=2),
    "both": Dict({"at": Box(-1, 1, (2,), np.float32), "side": Discrete(2)}),
}


class Crane(gym.Env):
    """A crane that drifts; after 5 to 14 steps an episode is terminated, truncated, or both."""

    observation_space = OBSERVATIONS

    def __init__(self, kind: str, masked: bool) -> None:
        self.kind, self.masked, self.action_space = kind, masked, ACTIONS[kind]

    def _answer(self) -> tuple[dict[str, Any], dict[str, Any]]:
        obs = {"arm": self.place[:2].copy(), "hook": self.place[2:].copy(), "mode": self.t % 3}
        info: dict[str, Any] = {"t": self.t}
        if self.masked:
            mask = np.ones({"several": 8, "one": 4}[self.kind], bool)
            mask[self.t % 2] = False
            info["action_mask"] = mask
        return obs, info

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t, self.length = 0, int(self.np_random.integers(5, 15))
        self.end = int(self.np_random.integers(3))
        self.place = self.np_random.uniform(-1, 1, 3).astype(np.float32)
        return self._answer()

    def step(self, action: Any) -> Any:
        push = np.zeros(3, np.float32)
        if self.kind == "one":
            push[action % 3] = 1.0 if action < 4 else -1.0
        elif self.kind == "named":
            push[:] = *action["move"], action["grip"]
        else:
            push[:] = action
        self.place = np.clip(0.9 * self.place + 0.3 * (push - 0.3), -2, 2).astype(np.float32)
        self.t += 1
        over = self.t == self.length
        obs, info = self._answer()
        ends = over and self.end != 1, over and self.end != 0
        return obs, float(-np.abs(self.place).sum()), *ends, info


@functools.cache
def crane(kind: str, masked: bool) -> Any:
    """The function that makes the environment: the same one, for all levels of a hierarchy."""
    return functools.partial(Crane, kind, masked)


# What answers follow from ------------------------------------------------------------------------


def leaves(x: Any, name: str) -> Iterator[tuple[str, Array]]:
    """The parts of n observations, goals or actions by their names, each as (n, k) numbers.

    Args:
        x: an array, perhaps with named fields; or a dict of arrays.
    """
    keys = x.keys() if isinstance(x, dict) else x.dtype.names
    for key in keys or ():
        yield from leaves(x[key], f"{name}.{key}")
    if not keys:
        yield name, x.reshape(len(x), -1).astype(np.float64)


@functools.cache
def weights(salt: str, columns: int, size: int) -> Array:
    rng = np.random.default_rng(zlib.crc32(salt.encode()))
    return rng.uniform(-1.5, 1.5, (columns, size))


def numbers(salt: str, named: Iterable[tuple[str, Array]], size: int) -> Array:
    """(n, size) numbers from −1 to 1 that follow from named ones; a row's from this row alone.

    No sum is left to a library, which may add up other numbers of rows in another order.
    """
    total: Any = 0.0
    for name, x in sorted(named, key=lambda pair: pair[0]):
        for column, each in zip(x.T, weights(f"{salt} {name}", x.shape[1], size), strict=True):
            total = total + column[:, None] * each
    return 4 * np.abs(total - np.floor(total + 0.5)) - 1


def choice_counts(space: Any) -> list[int]:
    """The numbers of choices of an action of a Discrete or MultiDiscrete."""
    return [int(space.n)] if isinstance(space, Discrete) else space.nvec.tolist()


def width(space: Any) -> int:
    """The numbers from which ``as_action`` makes an action."""
    if isinstance(space, Dict):
        return sum(map(width, space.spaces.values()))
    return int(np.prod(space.shape)) if isinstance(space, Box) else sum(choice_counts(space))


def as_action(x: Array, space: Any, mask: Array | None = None) -> Any:
    """Actions of numbers (n, width), among those that a mask allows; of a Dict a dict."""
    if isinstance(space, Dict):
        found, first = {}, 0
        for name, part in space.spaces.items():
            found[name] = as_action(x[:, first : first + width(part)], part)
            first += width(part)
        return found
    if isinstance(space, Box):
        return (1.3 * x).clip(space.low, space.high).astype(np.float32)
    counts = choice_counts(space)
    scores = x if mask is None else np.where(mask, x, -np.inf)
    parts = np.split(scores, np.cumsum(counts)[:-1], axis=1)
    chosen = np.stack([part.argmax(axis=1) for part in parts], axis=1)
    return chosen[:, 0] + space.start if isinstance(space, Discrete) else chosen


def as_goal(x: Array, kind: str) -> Any:
    """Goals of numbers (n, 3); of a Dict a dict."""
    place, side = (0.9 * x[:, :2]).astype(np.float32), (x[:, 2] > 0).astype(np.int64)
    number = 2 + np.floor(np.abs(x[:, 0]) * 2.99).astype(np.int64)
    return {"place": place, "number": number, "both": {"at": place, "side": side}}[kind]


def packed(x: Any, space: Any) -> Array:
    """Actions, goals or choices as one array, as the library has them."""
    if not isinstance(space, Dict):
        return x
    found = np.zeros(len(next(leaves(x, ""))[1]), obs_dtype(space))
    for name, part in space.spaces.items():
        found[name] = packed(x[name], part)
    return found


def about(step: Step, whole: bool) -> list[tuple[str, Array]]:
    """What a step says; not ``whole``: what also a step that stands still would say."""
    said = {"elapsed": step.elapsed, "timed out": step.timed_out}
    if whole:
        said |= {"reward": step.reward, "t": np.asarray(step.info["t"])}
    found = [*leaves(step.next_obs, "next"), *((k, v[:, None] * 1.0) for k, v in said.items())]
    if step.goal is not None:
        found += leaves(step.goal, "goal")
    return [*found, *leaves(step.obs, "obs"), *leaves(step.action, "action")] if whole else found


# Declarations -----------------------------------------------------------------------------------


@dataclass
class Machine:
    """An automaton as plain data: skills of each state, best first; (from, to, event)."""

    states: list[list[int]]
    arrows: list[tuple[int, int, str]]
    events: dict[str, Any]


def half_hook(obs: Any) -> Any:
    return 0.5 * obs["hook"]


def twice_arm(obs: Any) -> Any:
    return 2 * obs["arm"]


SEES: dict[str, Any] = {
    "arm": "arm",
    "two": ("hook", "mode"),
    "named": {"a": ("arm", half_hook), "b": "mode"},
    "computed": twice_arm,
    "scaled": (sw.Part("arm", places=(1, 0), scale=2.0, offset=0.5, clip=(-1, 1)), "hook"),
}
ACTS: dict[str, list[tuple[Any, ...]]] = {
    "box": [(0, 1), (2, 0)],
    "several": [(0, 1), (2, 0)],
    "one": [(0, 2, 3), (3, 1)],
    "named": [("move",), ("grip",), ("move", "grip")],
}
RESTS: dict[str, list[Any]] = {
    "box": ["hold", "zero", 0.25, [0.5, "hold", -0.5]],
    "several": ["hold", "zero", [1, "hold", 1]],
    "one": ["zero"],
    "named": ["hold", "zero", {"move": "hold"}, {"move": [0.5, "hold"], "grip": 1}],
}
FIXED: dict[str, Any] = {
    "box": [0.125, -0.25, 0.5],
    "several": [1, 0, 1],
    "one": 3,
    "named": {"move": [0.5, -0.5], "grip": 1},
}
"""The actions of reflexes."""
SELECTORS = ("network", "recurrent", "function", "last", "automaton")
"""The first two are trained."""


def own_space(kind: str, acts: tuple[Any, ...] | None) -> Any:
    """The space of the part of actions that a skill writes."""
    whole = ACTIONS[kind]
    if acts is None:
        return whole
    if kind == "one":
        return Discrete(len(acts))
    if kind == "several":
        return MultiDiscrete(whole.nvec[list(acts)])
    if kind == "box":
        return Box(whole.low[list(acts)], whole.high[list(acts)])
    return whole[acts[0]] if len(acts) == 1 else Dict([(name, whole[name]) for name in acts])


@dataclass(frozen=True)
class WorldSkill:
    """A skill."""

    path: str
    """With the seed; all that it answers follows from it."""
    kind: str
    """Of the environment's actions."""
    policy: str
    """"network", "recurrent"; "function", "watching": ready ones; "hierarchy"."""
    below: WorldLevel | None = None
    goal: str | None = None
    clips: bool = False
    goal_by_name: bool = True
    """How a function takes it."""
    sees: str | None = None
    acts: tuple[Any, ...] | None = None
    corrects: str | None = None
    """The ready policy that it corrects: "function" or "watching"."""
    scale: Any = 0.3
    max_steps: int | None = None
    call_steps: int | None = None
    starts: bool = False
    stops: str = ""
    """"still": also for a step that stands still; "often": for most; "whole": it needs all that a
    step says."""
    wins: bool = False

    @property
    def name(self) -> str:
        return self.path.rpartition("/")[2]

    @property
    def action_space(self) -> Any:
        """Of its own actions, after its correction."""
        return own_space(self.kind, self.acts)

    @property
    def learnt_space(self) -> Any:
        space = self.action_space
        return space if self.corrects is None else Box(-1, 1, space.shape, np.float32)

    @property
    def methods(self) -> dict[str, Any]:
        def says(what: str, least: float, named: Any) -> Any:
            return lambda x: numbers(f"{self.path} {what}", named(x), 1)[:, 0] > least

        whole, least = self.stops == "whole", -0.9 if self.stops == "often" else 0.4
        declared = {
            "initiation": (self.starts, 0.2, lambda obs: leaves(obs, "obs")),
            "termination": (self.stops, least, lambda step: about(step, whole)),
            "success": (self.wins, 0.0, lambda step: about(step, True)),
        }
        return {name: says(name, *how) for name, (defined, *how) in declared.items() if defined}

    def clip_goal(self, obs: Any, goal: Any) -> Any:
        return np.clip(goal, -np.abs(obs["arm"]), np.abs(obs["arm"]))

    def function(self, what: str, space: Any) -> Any:
        """A function as a policy."""

        def acts(obs: Any, goal: Any = None) -> Any:
            given = [*leaves(obs, "obs"), *(() if goal is None else leaves(goal, "goal"))]
            return as_action(numbers(f"{self.path} {what}", given, width(space)), space)

        if self.goal is None:
            return lambda obs: acts(obs)
        by_name = self.goal_by_name
        return (lambda obs, goal: acts(obs, goal)) if by_name else (lambda obs, g: acts(obs, g))


@dataclass(frozen=True)
class WorldLevel:
    """Skills below one selector."""

    path: str
    kind: str
    skills: tuple[WorldSkill, ...]
    selector: str
    """One of ``SELECTORS``."""
    call_steps: int | tuple[int, ...] | None
    rest: Any = "zero"
    reflexes: tuple[str, ...] = ()
    """"fixed", "computed"."""
    greedy: bool = True
    greedy_selector: bool = True
    margin: float | None = None
    guide: str | None = None
    """A ready selector beside one that is trained: "last" or "automaton"."""
    guide_restricts: bool = True
    guide_tells: bool = False
    """What it would choose is recorded where the selector learns."""

    @property
    def lengths(self) -> tuple[int, ...]:
        return self.call_steps if isinstance(self.call_steps, tuple) else ()

    @property
    def choices(self) -> int:
        return len(self.skills) * max(1, len(self.lengths))

    @property
    def ready(self) -> bool:
        return self.selector not in SELECTORS[:2]

    @property
    def below(self) -> Iterator[WorldLevel]:
        """The levels of skills that are hierarchies."""
        return (s.below for s in self.skills if s.below is not None)

    @property
    def all(self) -> Iterator[WorldLevel]:
        yield self
        for level in self.below:
            yield from level.all

    @property
    def goals(self) -> dict[str, str]:
        """The kinds of goals of its skills, by their names."""
        return {s.name: s.goal for s in self.skills if s.goal is not None}

    @property
    def free(self) -> list[int]:
        """The skills that may start everywhere."""
        return [i for i, s in enumerate(self.skills) if not s.starts and s.below is None]

    @property
    def rules(self) -> tuple[sw.Reflex, ...]:
        space = ACTIONS[self.kind]

        def answer(what: str, size: int) -> Any:
            return lambda obs: numbers(f"{self.path} {what}", leaves(obs, "obs"), size)

        def rule(name: str) -> sw.Reflex:
            holds, acts = answer(f"{name} holds", 1), answer(name, width(space))
            fixed = FIXED[self.kind]
            action = fixed if name == "fixed" else (lambda obs: as_action(acts(obs), space))
            return sw.Reflex(lambda obs: holds(obs)[:, 0] > 0.6, action, name)

        return tuple(map(rule, self.reflexes))

    def given_goals(self, obs: Any, names: Iterable[str], what: str) -> dict[str, Any]:
        """The goals that a ready selector gives, by the names of skills."""
        found = {}
        for name in names:
            x = numbers(f"{self.path} {what} {name}", leaves(obs, "obs"), 3)
            found[name] = as_goal(x, self.goals[name])
        return found

    def by_function(self, obs: Any, last: Any = None) -> Array:
        turn = numbers(f"{self.path} selector", leaves(obs, "obs"), 1)[:, 0] * 50
        if last is not None:
            turn = turn + last.skill + last.why + 2 * last.succeeded
        return np.array(self.free)[np.floor(turn).astype(np.int64) % len(self.free)]

    @property
    def machine(self) -> Machine:
        """The automaton: in its first state goals are fixed, in others functions give them."""
        count, free = len(self.skills), self.free[0]
        others = [k for k in range(count) if k != free]
        states = [[*range(count - 1, -1, -1)], [free, *others], [*others[-1:], free]]

        def event(step: Step) -> Any:
            return numbers(f"{self.path} event", about(step, True), 1)[:, 0] > 0.3

        arrows = [(0, 1, "event"), (0, 2, "failure"), (1, 0, "success"), (2, 0, "event")]
        events = {"event": event, "success": "success", "failure": "failure"}
        return Machine(states, arrows, events)

    def goal_in_state(self, state: int, name: str) -> Any:
        """The goal of a skill in a state of the automaton: fixed, or a function."""
        if state == 0:
            x = as_goal(np.full((1, 3), 0.4), self.goals[name])
            return {k: v[0].tolist() for k, v in x.items()} if isinstance(x, dict) else x[0]
        return lambda obs: self.given_goals(obs, [name], "state")[name]


@dataclass(frozen=True)
class World:
    """A hierarchy, and how it is played."""

    seed: int
    level: WorldLevel
    masked: bool
    rows: int
    resumed: bool
    deterministic: bool
    """The first selector is asked for greedy choices."""
    steps = 16

    @property
    def env(self) -> Any:
        return crane(self.level.kind, self.masked)


# Drawing ----------------------------------------------------------------------------------------


class Dice:
    """Draws worlds."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.kind = self.of("box", "box", "several", "one", "named")
        self.watches = self.of(True, False, False)
        self.masked = self.kind in ("several", "one") and self.of(True, False)

    def of(self, *values: Any) -> Any:
        return values[int(self.rng.integers(len(values)))]

    def level(self, path: str, depth: int, greedy: bool) -> WorldLevel:
        """A level; ``greedy``: so it is asked to act."""
        selector = self.of("network", *SELECTORS)
        learns = selector in SELECTORS[:2]
        greedy_selector = not learns or self.of(True, True, False)
        if selector == "automaton" and not greedy:  # it would draw its choices
            selector = "function"
        greedy_skills = self.of(True, True, False)
        confined = "/" in path and learns and self.of(True, True, False)  # it may get stuck
        skills = tuple(
            self.skill(
                f"{path}/s{i}", depth * (i > 0), greedy_skills,
                starts=confined or (i > 0 and self.of(True, False)),
            )
            for i in range(self.of(2, 3))
        )  # fmt: skip
        call_steps = self.of(None, 2, 5, *([(1, 3, 5)] if learns else []))
        if call_steps is None and not all(s.max_steps or s.call_steps or s.stops for s in skills):
            call_steps = 6
        owns = any(s.acts is not None for s in skills)
        margin = self.of(None, 0.2) if learns else None
        guided = learns and not confined  # a guide needs a skill that may start everywhere
        guide = self.of(None, "last", "automaton") if guided else None
        leaves_some = guide == "automaton" or isinstance(call_steps, tuple)
        restricts = leaves_some and margin is None and self.of(True, True, False)
        return WorldLevel(
            path, self.kind, skills, selector, call_steps,
            rest=self.of(*RESTS[self.kind]) if owns else "zero",
            reflexes=self.of((), (), ("fixed",), ("fixed", "computed"), ("computed",)),
            greedy=greedy_skills, greedy_selector=greedy_selector,
            margin=margin, guide=guide, guide_restricts=restricts,
            guide_tells=not restricts or self.of(True, False),
        )  # fmt: skip

    def skill(self, path: str, depth: int, greedy: bool, starts: bool) -> WorldSkill:
        """A skill; ``starts``: not everywhere."""
        goal = self.of(None, None, None, *GOALS)
        about_calls: dict[str, Any] = {
            "goal": goal,
            "clips": goal == "place" and self.of(True, False),
            "max_steps": self.of(None, 1, 2, 4),
            "call_steps": self.of(None, None, 1, 3),
            "starts": starts,
            "stops": self.of("", "still", "whole", *(["often"] if goal else [])),
            "wins": self.of(True, False),
        }
        if depth and self.of(True, True, False):
            below = self.level(path, depth - 1, greedy)
            longer = {"max_steps": self.of(None, None, 5), "call_steps": self.of(None, 6)}
            return WorldSkill(path, self.kind, "hierarchy", below, **about_calls | longer)
        watching = ["watching"] if self.watches and goal is None else []
        policy = self.of("network", "recurrent", "function", *watching)
        sees, acts = self.of(None, *SEES), self.of(None, *ACTS[self.kind])
        corrects, scale = None, 0.3
        if isinstance(space := own_space(self.kind, acts), Box):
            corrects = self.of(None, "function", *watching, *watching)
            scale = self.of(0.3, [0.2, 1.5, 0.5][: space.shape[0]])
        if corrects is not None:
            policy = self.of("network", "recurrent")  # what corrects is learnt
        return WorldSkill(
            path, self.kind, policy, goal_by_name=self.of(True, False), sees=sees, acts=acts,
            corrects=corrects, scale=scale, **about_calls,
        )  # fmt: skip


@functools.lru_cache(64)
def world(seed: int) -> World:
    """The world of a seed."""
    dice = Dice(seed)
    greedy = dice.of(True, True, False)
    level = dice.level(str(seed), dice.of(0, 1, 1, 2), greedy)
    return World(seed, level, dice.masked, dice.of(1, 4), dice.of(True, False), greedy)


# Networks ---------------------------------------------------------------------------------------


class Network(AgentPolicy):
    """Stands for a network.

    Args:
        salt: what it answers follows from it.
        acts: the space of its actions.
    """

    def __init__(self, salt: str, acts: Any, recurrent: bool) -> None:
        self.salt, self.acts, self.size = salt, acts, int(recurrent)
        Functional.__init__(self, InPlace(self), None, acts)

    def answer(self, memory: Memory, named: Any, deterministic: bool, size: int) -> Any:
        """(n, size) numbers that follow from what it is given, and what it then remembers."""
        given = [*named, *leaves(memory, "memory")] if memory else [*named]
        x = numbers(self.salt if deterministic else f"{self.salt}, drawn", given, size)
        return x, {k: v + np.float32(1) for k, v in memory.items()}

    def named(
        self, memory: Memory, named: Any, mask: Array | None, deterministic: bool
    ) -> tuple[Any, Memory]:
        """Act on named numbers."""
        x, after = self.answer(memory, named, deterministic, width(self.acts))
        return as_action(x, self.acts, mask), after

    def packed(self, found: Any) -> Array:
        """What ``named`` returned, as the library has it."""
        return packed(found, self.action_space)


class InPlace(TrainedNetwork):
    """How a stand-in acts."""

    agent: Network

    def start(self, n: int) -> Memory:
        return {"rnn": np.zeros((n, 1), np.float32)} if self.agent.size else {}

    def act(self, memory: Memory, rows: Array, obs: Any, turn: Turn) -> Any:
        own = {"rnn": memory["rnn"][rows]} if self.agent.size else {}
        found, after = self.agent.named(own, leaves(obs, "obs"), turn.mask, turn.greedy)
        for name, value in after.items():
            memory[name][rows] = value
        return self.agent.packed(found)


class Chooser(Network):
    """Stands for a selector that is trained: it chooses skills, lengths and goals.

    Where it is asked again about the same, it answers otherwise, as one that samples.
    """

    def __init__(self, level: WorldLevel) -> None:
        recurrent = level.selector == "recurrent"
        super().__init__(f"{level.path} selector", Discrete(level.choices), recurrent)
        self.goals, self.asked = level.goals, Counter[bytes]()

    def named(
        self, memory: Memory, named: Any, mask: Array | None, deterministic: bool
    ) -> tuple[Any, Memory]:
        named = [*named]
        keys = [b"".join(x[i].tobytes() for _, x in named) for i in range(len(named[0][1]))]
        again = np.array([[self.asked[key]] for key in keys], np.float64)
        self.asked.update(keys)
        size = self.acts.n + 3 * len(self.goals)
        x, after = self.answer(memory, [*named, ("again", again)], deterministic, size)
        number = as_action(x[:, : self.acts.n], self.acts, mask)
        thirds = np.split(x[:, self.acts.n :], max(1, len(self.goals)), axis=1)
        goals = {
            name: as_goal(part, kind)
            for (name, kind), part in zip(self.goals.items(), thirds, strict=False)
        }
        return (number, goals), after

    def packed(self, found: Any) -> Array:
        number, goals = found
        choice = blank_choices(self.action_space, number)
        for name, goal in goals.items():
            choice["goal"][name] = packed(goal, GOALS[self.goals[name]])
        return choice


class Worths(AgentPolicy):
    """Stands for a critic: the values of skills, and last that of a new decision."""

    def __init__(self, level: WorldLevel) -> None:
        self.salt, self.size = f"{level.path} critic", len(level.skills) + 1

    def named(self, named: Any) -> Array:
        return numbers(self.salt, named, self.size)

    def heads(self, obs: Any) -> Array:
        return self.named(leaves(obs, "obs"))


class Watching(ScriptedPolicy):
    """A ready policy that acts by what it has observed.

    Args:
        salt: what it answers follows from it.
        acts: the space of its actions.
    """

    def __init__(self, salt: str, acts: Any) -> None:
        super().__init__(lambda obs: self.act(self.start(len(obs)), obs)[0])
        self.salt, self.acts = salt, acts

    def start(self, n: int) -> Memory:
        return {"seen": np.zeros((n, 1))}

    def answer(self, memory: Memory, obs: Any) -> Any:
        given = [*leaves(obs, "obs"), *leaves(memory, "memory")]
        return as_action(numbers(self.salt, given, width(self.acts)), self.acts)

    def act(self, memory: Memory, obs: Any, mask: Any = None, **how: Any) -> Any:
        return packed(self.answer(memory, obs), self.acts), memory

    def observe(self, memory: Memory, step: Step) -> Memory:
        return {"seen": numbers(f"{self.salt}, seen", [*about(step, True), *leaves(memory, "")], 1)}


# What they become -------------------------------------------------------------------------------


def watching(skill: WorldSkill, what: str) -> Watching:
    return Watching(f"{skill.path} {what}", skill.action_space)


def network(skill: WorldSkill) -> Network:
    return Network(f"{skill.path} network", skill.learnt_space, skill.policy == "recurrent")


def declared_skill(skill: WorldSkill, env: Any) -> sw.Skill:
    acts: dict[Any, Any] = {
        "function": lambda what: sw.from_function(skill.function(what, skill.action_space)),
        "watching": lambda what: watching(skill, what),
    }
    policy: Any = None
    if skill.below is not None:
        policy = declared(skill.below, env)
    elif skill.corrects is not None:
        policy = sw.Residual(acts[skill.corrects]("base"), skill.scale)
    elif skill.policy in acts:
        policy = acts[skill.policy]("policy")
    attributes: dict[str, Any] = {
        name: lambda self, x, said=said: said(x) for name, said in skill.methods.items()
    }
    if skill.clips:
        attributes["clip_goal"] = lambda self, obs, goal: skill.clip_goal(obs, goal)
    if skill.goal is not None:  # else a notice says that nothing reads the goal
        attributes["reward"] = lambda self, step: next(leaves(step.goal, "goal"))[1][:, 0]
    attributes |= {
        "name": skill.name,
        "policy": policy,
        "max_steps": skill.max_steps,
        "call_steps": skill.call_steps,
        "goal_space": None if skill.goal is None else GOALS[skill.goal],
        "acts": skill.acts,
    }
    made: sw.Skill = type("Drawn", (sw.Skill,), attributes)()
    made.sees = None if skill.sees is None else SEES[skill.sees]
    return made


def declared(level: WorldLevel, env: Any) -> sw.Hierarchy:
    selector: Any = sw.PPO()
    if level.selector == "automaton":
        selector = automaton(level)
    elif level.ready:

        def chosen(obs: Any, last: Any = None) -> Any:
            skill = level.by_function(obs, last)
            goals = level.given_goals(obs, level.goals, "function")
            return (skill, goals) if level.goals else skill

        takes_last = level.selector == "last"
        selector = (lambda obs, last: chosen(obs, last)) if takes_last else lambda obs: chosen(obs)
    guide: Any = None
    if level.guide is not None:
        by_function: Any = lambda obs, last: level.by_function(obs, last)  # noqa: E731
        beside = automaton(level, goals=False) if level.guide == "automaton" else by_function
        guide = sw.Guide(beside, level.guide_restricts, 0.1 if level.guide_tells else None)
    return sw.Hierarchy(
        env,
        [declared_skill(skill, env) for skill in level.skills],
        call_steps=sw.Lengths(*level.lengths) if level.lengths else level.call_steps,
        selector=selector,
        reflexes=level.rules,
        rest=level.rest,
        guide=guide,
        selection=sw.Selection(greedy_skills=level.greedy, greedy_selector=level.greedy_selector),
        together=sw.Together(interrupt=level.margin is not None, margin=level.margin or 0.2),
    )


def automaton(level: WorldLevel, goals: bool = True) -> sw.Automaton:
    """The automaton of a level; ``goals``: it gives them."""

    def chosen(state: int, k: int) -> Any:
        name = level.skills[k].name
        given = goals and name in level.goals
        return (name, level.goal_in_state(state, name)) if given else name

    machine = level.machine
    return sw.Automaton(
        {f"q{i}": [chosen(i, k) for k in ks] for i, ks in enumerate(machine.states)},
        {(f"q{a}", f"q{b}"): machine.events[event] for a, b, event in machine.arrows},
    )


@dataclass
class Made:
    """A world in the library's terms."""

    roles: Roles
    policies: dict[str, Any]
    """By path; networks are stand-ins."""
    deterministic: bool
    """The first selector is asked for greedy choices."""

    def hierarchy(self) -> HierarchyPolicy:
        return assembled(self.roles, self.policies)

    def learning(self) -> Any:
        """The skills where all learn together."""
        return learning_set(self.roles, self.roles.outermost, self.policies)

    def greedy(self, path: str) -> bool:
        """Whether a stand-in, of a skill or a selector, is asked for greedy actions."""
        role = self.roles[path]
        if role.kind != "selector":
            return role.greedy
        return role.greedy and (self.roles[role.level].greedy if role.level else self.deterministic)

    def margins(self) -> dict[str, float]:
        """By the paths of critics, how much more a new decision must be worth."""
        levels = self.roles.levels.values()
        return {x.critic_path: x.together.margin for x in levels if x.together.interrupt}

    def guide(self) -> ActiveGuide | None:
        """What is beside the first selector where it learns, or decides in its place."""
        return active_guide(self.roles, self.roles.outermost)


@functools.lru_cache(4)
def ready(seed: int) -> tuple[Roles, dict[str, Any]]:
    """What is ready in a world, for all that play it one after another."""
    drawn = world(seed)
    roles = roles_of(declared(drawn.level, drawn.env))
    return roles, {**ready_policies(roles), **ready_selectors(roles)}


def made(world: World) -> Made:
    roles, policies = ready(world.seed)
    policies = dict(policies)
    for level in world.level.all:
        path = level.path.partition("/")[2]
        stands = {s.path.partition("/")[2]: network(s) for s in level.skills if s.below is None}
        prefix = f"{path}/" if path else ""
        stands |= {} if level.ready else {f"{prefix}selector": Chooser(level)}
        stands |= {} if level.margin is None else {f"{prefix}skill_critic": Worths(level)}
        for name, stand in stands.items():
            role = roles[name]
            if role.config is None and role.kind != "critic":
                continue  # it is ready
            assert role.kind != "skill" or role.action_space == stand.acts
            stand.observation_space, stand.action_space = role.observation_space, role.action_space
            policies[name] = stand
    return Made(roles, policies, world.deterministic)
