"""Small declarations, drawn at random, for all users of calls; plain data, so that they print."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from hypothesis import strategies as st
from reference_calls import EPISODE, POSITION, TAG, Counting, T, Walk, scripted

from skillweave.algorithms.policy import AgentPolicy
from skillweave.policies.hierarchy import ActiveGuide, Interruption
from skillweave.skills import Automaton, Reflex, Skill, ready_selector
from skillweave.skills.lengths import Lengths
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet
from skillweave.types import Array, Memory, Step

# The environment --------------------------------------------------------------------------------


class Stroll(Walk):
    """A walk whose observations and rewards follow from the seed of the episode alone."""

    masked = False
    """Where the position divides by three, the step to the left is not allowed."""

    def _obs(self) -> Array:
        obs = super()._obs()
        obs[EPISODE] = 0
        return obs

    def reset(self, **how: Any) -> Any:
        obs, info = super().reset(**how)
        return obs, info | self._mask()

    def step(self, action: int) -> Any:
        *step, info = super().step(action)
        return *step, info | self._mask()

    def _mask(self) -> dict[str, Any]:
        if not self.masked:
            return {}
        return {"action_mask": np.array([self.position % 3 != 0, True, True])}


class MaskedStroll(Stroll):
    masked = True


ENVS: dict[str, Any] = {
    "stroll": Stroll,
    "masked": MaskedStroll,
    "CartPole": lambda: gym.make("CartPole-v1", max_episode_steps=12),
    "LunarLander": lambda: gym.make("LunarLander-v3", max_episode_steps=95),
}


@cache
def spaces(env: str) -> tuple[gym.Space[Any], gym.Space[Any]]:
    made = ENVS[env]()
    return made.observation_space, made.action_space


# What declarations are made of ------------------------------------------------------------------


class Net(AgentPolicy):
    """Stands for a network: keeps to masks; perhaps it counts how often it acted, and goes by that.

    Args:
        choices: among which it chooses.
        size: of its recurrent state: 0 or 1.
        env: whose observations it acts on.
    """

    def __init__(
        self, choices: int = 3, size: int = 0, turn: int = 1, env: str = "stroll"
    ) -> None:  # fmt: skip
        self.observation_space = spaces(env)[0]
        self.action_space = gym.spaces.Discrete(choices)
        self.size, self.turn = size, turn

    def start(self, n: int) -> Memory:
        return {"rnn": np.zeros((n, 1), np.float32)} if self.size else {}

    def act(
        self, memory: Any, obs: Array, mask: Any = None, *, deterministic: bool = True,
        rng: Any = None,
    ) -> Any:  # fmt: skip
        wish = obs[:, TAG] + 5 * obs[:, T] + 7 * self.turn * obs[:, POSITION] + (not deterministic)
        if memory:
            wish = wish + memory["rnn"][:, 0]
            memory = {"rnn": memory["rnn"] + np.float32(1)}
        if mask is None:
            mask = np.ones((len(obs), self.action_space.n), bool)
        rows = zip(wish.astype(np.int64).tolist(), mask, strict=True)
        return np.array([np.flatnonzero(may)[w % may.sum()] for w, may in rows], np.int64), memory


class Worth(AgentPolicy):
    """Stands for a critic: the values of skills, and last that of a new decision."""

    def __init__(self, skills: int) -> None:
        self.observation_space, self.skills = Walk.observation_space, skills

    def heads(self, obs: Array) -> Array:
        each = [(obs[:, POSITION] + i * obs[:, T]) % 3 for i in range(self.skills)]
        return np.stack([*each, 1 + obs[:, T] % 2], axis=1)


def zigzag(obs: Array) -> Array:
    return (obs[:, T].astype(np.int64) + obs[:, TAG].astype(np.int64)) % 3


@dataclass(frozen=True)
class OfReal:
    """A scripted policy for one of Gymnasium's environments, which is made when it is needed."""

    env: str
    acts: Any

    @cached_property
    def policy(self) -> ScriptedPolicy:
        return ScriptedPolicy(lambda obs: self.acts(obs).astype(np.int64), *spaces(self.env))


_POLICIES: dict[str, Any] = {
    "left": scripted(0),
    "right": scripted(2),
    "zigzag": scripted(zigzag),
    "net": Net(),
    "counts": Net(size=1),
    "paid": Counting(),  # remembers what it observes
    "balance": OfReal("CartPole", lambda obs: obs[:, 2] + obs[:, 3] > 0),
    "push": OfReal("CartPole", lambda obs: np.zeros(len(obs))),
    "hover": OfReal("LunarLander", lambda obs: np.where(obs[:, 3] < -0.1, 2, 0)),
    "turn": OfReal("LunarLander", lambda obs: np.where(obs[:, 4] > 0, 3, 1)),
}


def policy_of(name: str) -> AgentPolicy:
    found = _POLICIES[name]
    return found.policy if isinstance(found, OfReal) else found


WALKS = ("left", "right", "zigzag", "net", "counts", "paid")
WHERE: dict[str, Any] = {
    "even": lambda obs: obs[:, POSITION] % 2 == 0,
    "left": lambda obs: obs[:, POSITION] < 1,
    "early": lambda obs: obs[:, T] < 4,
    "mostly": lambda obs: obs[:, T] % 3 != 1,
}
STARTS = WHERE | {
    "left of the middle": lambda obs: obs[:, 0] < 0.05,  # CartPole
    "sinking": lambda obs: obs[:, 3] < 0,  # LunarLander
}
SEEN: list[tuple[Any, ...]] = []
"""What terminations that are "recorded" were shown, a row for each step and environment."""


def recorded(step: Step) -> Array:
    for i in range(len(step.reward)):
        SEEN.append((
            *step.obs[i].tolist(), int(step.action[i]), *step.next_obs[i].tolist(),
            float(step.reward[i]), bool(step.terminated[i]), bool(step.truncated[i]),
            bool(step.timed_out[i]), int(step.elapsed[i]), int(np.asarray(step.info["t"])[i]),
        ))  # fmt: skip
    return np.zeros(len(step.reward), bool)


WHEN: dict[str, Any] = {
    "passed": lambda step: step.next_obs[:, POSITION] >= 2,
    "home": lambda step: step.next_obs[:, POSITION] % 2 == 0,
    "unlucky": lambda step: (step.elapsed >= 2) & (step.reward < -0.5),
    "info": lambda step: step.timed_out | (step.info["t"] % 5 == 0),
    "acted": lambda step: (step.action == 0) & (step.obs[:, T] % 2 == 1),
    "over": lambda step: step.terminated | step.truncated,
}
STOPS = WHEN | {
    "fast": lambda step: np.abs(step.next_obs[:, 1]) > 0.4,  # CartPole
    "rising": lambda step: step.next_obs[:, 3] > 0,  # LunarLander
}
WINS: dict[str, Any] = {
    "rich": lambda step: step.reward > 0,
    "long": lambda step: step.elapsed > 1,
    "late": lambda step: step.timed_out,
}
REFLEXES = {
    "shy": Reflex(lambda obs: obs[:, POSITION] <= -2, 2, "shy"),
    "back": Reflex(lambda obs: obs[:, POSITION] > 1, 0, "back"),
    "clock": Reflex(
        lambda obs: obs[:, T] % 4 == 1, lambda obs: obs[:, POSITION].astype(np.int64) % 3, "clock"
    ),
    "edge": Reflex(lambda obs: np.abs(obs[:, POSITION]) == 2, 1, "edge"),
}
EVENTS: dict[str, Any] = {
    "far": lambda step: np.abs(step.next_obs[:, POSITION]) > 1,
    "third": lambda step: step.elapsed % 3 == 0,
    "success": "success",
    "failure": "failure",
}


# Declarations -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class SkillCase:
    """A skill; each text is a key of the tables above."""

    policy: str | LevelCase
    max_steps: int | None = None
    call_steps: int | None = None
    starts: str | None = None
    stops: str | None = None
    wins: str | None = None

    @property
    def methods(self) -> dict[str, Any]:
        """Its functions of observations and steps, by the names that a skill gives them."""
        found = {
            "initiation": STARTS.get(self.starts),
            "termination": recorded if self.stops == "recorded" else STOPS.get(self.stops),
            "success": WINS.get(self.wins),
        }
        return {name: function for name, function in found.items() if function is not None}

    @property
    def below(self) -> LevelCase | None:
        """The hierarchy that it is."""
        return self.policy if isinstance(self.policy, LevelCase) else None


@dataclass(frozen=True)
class LevelCase:
    """Skills below one selector."""

    skills: tuple[SkillCase, ...]
    call_steps: int | tuple[int, ...] | None = None
    reflexes: tuple[str, ...] = ()
    selector: str = "net"
    """"net", "counts"; "automaton", "function", "last": a ready one."""
    guide: str | None = None
    """The same, of the ready ones."""
    guide_restricts: bool = True
    margin: float | None = None
    """Of interruption."""
    greedy: bool = True
    greedy_selector: bool = True
    env: str = "stroll"
    """Of the first level."""

    @property
    def lengths(self) -> tuple[int, ...]:
        return self.call_steps if isinstance(self.call_steps, tuple) else ()

    @property
    def below(self) -> Iterator[LevelCase]:
        """The levels of skills that are hierarchies."""
        return (s.below for s in self.skills if s.below is not None)

    @property
    def all(self) -> Iterator[LevelCase]:
        yield self
        for level in self.below:
            yield from level.all

    @property
    def ready(self) -> bool:
        """The selector is not trained."""
        return self.selector in ("automaton", "function", "last")

    @property
    def free(self) -> list[int]:
        """The skills that may start everywhere."""
        plain = (s.starts is None and s.below is None for s in self.skills)
        return [i for i, yes in enumerate(plain) if yes]

    @property
    def rules(self) -> tuple[Reflex, ...]:
        return tuple(REFLEXES[name] for name in self.reflexes)

    @property
    def machine(self) -> Machine:
        return machine(self)

    def by_function(self, obs: Array, last: Any = None) -> Array:
        """What a function as a selector returns."""
        return chosen_by_function(self, obs, last)


@dataclass(frozen=True)
class Case:
    """A declaration, and how it is played."""

    level: LevelCase
    deterministic: bool = True
    rows: int = 1
    """Of a request to a collector."""
    resumed: bool = False
    """Half way, another collector goes on from the first one's state."""

    @property
    def env(self) -> Any:
        return ENVS[self.level.env]

    @property
    def steps(self) -> int:
        """How far collectors go."""
        return 120 if self.level.env == "LunarLander" else 32


# What they become -------------------------------------------------------------------------------


@dataclass
class Machine:
    """An automaton as plain data: skills of each state, best first; (from, to, event)."""

    states: list[list[int]]
    arrows: list[tuple[int, int, str]]
    events: dict[str, Any] = field(default_factory=lambda: EVENTS)

    def declared(self) -> Automaton:
        arrows = {(f"q{a}", f"q{b}"): self.events[event] for a, b, event in self.arrows}
        states = {f"q{i}": [f"s{k}" for k in skills] for i, skills in enumerate(self.states)}
        return Automaton(states, arrows)


@cache
def machine(level: LevelCase) -> Machine:
    """The automaton of a level: in each state some skill may start everywhere."""
    count, free = len(level.skills), level.free
    states = [[*range(count - 1, -1, -1)], [*range(0, count, 2)], [*range(1, count, 2)]]
    states = [[*skills, *(k for k in free[:1] if k not in skills)] for skills in states]
    arrows = [(0, 1, "far"), (0, 2, "failure"), (1, 2, "success"), (1, 0, "third"), (2, 0, "third")]
    return Machine(states, arrows)


def chosen_by_function(level: LevelCase, obs: Array, last: Any = None) -> Array:
    """The skill, (n,), one that may start everywhere."""
    turn = obs[:, T].astype(np.int64)
    if last is not None:
        turn = turn + last.skill + last.why + 2 * last.succeeded
    return np.array(level.free)[turn % len(level.free)]


def ready(level: LevelCase, kind: str) -> Any:
    """A ready selector."""
    functions = {
        "function": lambda obs: chosen_by_function(level, obs),
        "last": lambda obs, last: chosen_by_function(level, obs, last),
    }
    value = machine(level).declared() if kind == "automaton" else functions[kind]
    found = ready_selector(value, tuple(f"s{i}" for i in range(len(level.skills))))
    assert found is not None
    choices = gym.spaces.Discrete(len(level.skills))
    return found.bind(Walk.observation_space, choices, "selector")


def skill_of(case: SkillCase, name: str) -> Skill:
    methods = {method: lambda self, x, said=said: said(x) for method, said in case.methods.items()}
    fields = {"name": name, "max_steps": case.max_steps, "call_steps": case.call_steps}
    return type("Drawn", (Skill,), fields | methods)()


def skill_set(level: LevelCase, policies: tuple[Any, ...]) -> SkillSet:
    """The skills of a level with these policies."""
    interruption = None
    if level.margin is not None:
        critic = Worth(len(level.skills))
        interruption = Interruption(critic.heads, level.margin, critic)
    return SkillSet(
        tuple(skill_of(s, f"s{i}") for i, s in enumerate(level.skills)),
        policies,
        level.rules,
        Lengths(*level.lengths) if level.lengths else level.call_steps,
        greedy=level.greedy,
        interruption=interruption,
        greedy_selector=level.greedy_selector,
    )


def selector_of(level: LevelCase) -> Any:
    if level.ready:
        return ready(level, level.selector)
    choices = len(level.skills) * max(1, len(level.lengths))
    return Net(choices, int(level.selector == "counts"), 2, level.env)


def guide_of(level: LevelCase) -> ActiveGuide | None:
    if level.guide is None:
        return None
    keeps = level.guide == "automaton"
    return ActiveGuide(ready(level, level.guide), level.guide_restricts, tells=keeps)


# Cases by hand ----------------------------------------------------------------------------------

LEFT = SkillCase("left", max_steps=3, wins="late")
RIGHT = SkillCase("right", starts="left", stops="passed")
ZIGZAG = SkillCase("zigzag")
PAID = SkillCase("paid", max_steps=6, stops="unlucky", wins="rich")
COUNTS = SkillCase("counts", call_steps=2, starts="mostly")
NET = SkillCase("net", stops="info", wins="long")
EVEN = SkillCase("net", max_steps=1, starts="even")
STEADY = SkillCase("net", starts="even", stops="home")  # elsewhere none could follow
FOUR = (LEFT, RIGHT, ZIGZAG, PAID)
PUSH, FALL = SkillCase("push", max_steps=2), SkillCase("hover", max_steps=5)
BALANCE = SkillCase("balance", starts="left of the middle", stops="fast")
HOVER, TURN = SkillCase("hover", starts="sinking", stops="rising"), SkillCase("turn")
OVER, ENDING = SkillCase("net", stops="over"), SkillCase("right", stops="over", wins="rich")
BELOW = LevelCase((COUNTS, RIGHT, LEFT), 2, ("edge",), "counts")
MIDDLE = LevelCase((SkillCase(BELOW, max_steps=3), ZIGZAG), 5)
BY_HAND: dict[str, Case] = {
    "four skills": Case(LevelCase(FOUR, 5)),
    "no limit": Case(LevelCase((LEFT, PAID, NET)), rows=4),
    "memories": Case(
        LevelCase((COUNTS, PAID, LEFT), 4, selector="counts", env="masked"), resumed=True
    ),
    "lengths": Case(LevelCase((LEFT, COUNTS, NET), (1, 3, 8)), resumed=True),
    "reflexes": Case(LevelCase((LEFT, PAID), 3, ("clock", "shy", "back"))),
    "sampling": Case(
        LevelCase((NET, COUNTS, ZIGZAG), 3, greedy=False, greedy_selector=False), deterministic=True
    ),
    "in three levels": Case(
        LevelCase((SkillCase(MIDDLE, stops="passed", wins="rich"), LEFT), 7, ("shy",)), resumed=True
    ),
    "own ends with the episode": Case(LevelCase((OVER, ENDING, COUNTS), 4), resumed=True),
    "own ends with the episode, below": Case(
        LevelCase((SkillCase(LevelCase((OVER, COUNTS), 3), stops="over"), ENDING), 5), rows=4
    ),
    "own ends with the episode, of an automaton": Case(
        LevelCase((OVER, ENDING, SkillCase(LevelCase((OVER,)))), 2, selector="automaton")
    ),
    "stuck": Case(LevelCase((SkillCase(LevelCase((EVEN,))), ZIGZAG), 6)),
    "interrupted": Case(LevelCase((COUNTS, LEFT, NET), 9, margin=0.5)),
    "interrupted where one may start": Case(
        LevelCase((STEADY, replace(STEADY, policy="counts")), margin=-100.0)
    ),
    "interrupted below": Case(
        LevelCase((SkillCase(LevelCase((EVEN, COUNTS), 9, margin=-0.5)), ZIGZAG), 6, env="masked")
    ),
    "CartPole": Case(LevelCase((PUSH, BALANCE), 7, env="CartPole")),
    "LunarLander": Case(LevelCase((FALL, HOVER, TURN), 7, env="LunarLander"), rows=4),
    "an automaton": Case(LevelCase(FOUR, 3, selector="automaton"), resumed=True),
    "a function of the last call": Case(LevelCase((LEFT, PAID, NET), 4, selector="last")),
    "a guide": Case(LevelCase((NET, LEFT, COUNTS), (1, 4), guide="automaton")),
    "a function as a guide": Case(LevelCase((NET, LEFT, COUNTS), 3, guide="last")),
    "a guide that restricts nothing": Case(
        LevelCase(FOUR, 4, selector="counts", guide="automaton", guide_restricts=False),
        resumed=True,
    ),
}


# Drawing ----------------------------------------------------------------------------------------


def of(*values: Any) -> Any:
    return st.sampled_from(values)


@st.composite
def skill_cases(draw: Any, depth: int, greedy: bool) -> SkillCase:
    policy: Any = draw(of(*WALKS))
    if depth and draw(of(False, True, True)):
        policy = draw(level_cases(depth - 1, greedy))
    return SkillCase(
        policy,
        max_steps=draw(of(None, 1, 2, 3, 5)),
        call_steps=draw(of(None, None, 1, 2, 4)),
        starts=draw(of(None, None, *WHERE)),
        stops=draw(of(None, *WHEN)),
        wins=draw(of(None, *WINS)),
    )


@st.composite
def level_cases(draw: Any, depth: int, sampled_by: bool) -> LevelCase:
    """A level; ``sampled_by``: its caller wants greedy actions."""
    greedy, selector_greedy = draw(of(True, True, False)), draw(of(True, True, False))
    kinds = ["net", "counts", "function", "last"]
    if sampled_by and selector_greedy:  # else it draws its choices
        kinds.append("automaton")
    selector = draw(of(*kinds))
    guide = None if selector in kinds[2:] else draw(of(None, None, *("automaton", "last")))
    skills = draw(st.lists(skill_cases(depth, greedy), min_size=1, max_size=3))
    free = SkillCase(
        draw(of(*WALKS)), draw(of(None, 2, 3)), stops=draw(of(None, *WHEN)),
        wins=draw(of(None, *WINS)),
    )  # fmt: skip
    if draw(st.booleans()):
        skills.append(free)
    else:
        skills.insert(0, free)
    steps: list[Any] = [None, 1, 2, 3, 5, 40]
    if selector in ("net", "counts"):
        steps += [(1, 3), (2, 4, 5)]
    return LevelCase(
        tuple(skills),
        draw(of(*steps)),
        tuple(draw(st.lists(of(*REFLEXES), max_size=2, unique=True))),
        selector,
        guide,
        draw(of(True, True, False)),
        draw(of(None, None, -0.5, 0.5)),
        greedy,
        selector_greedy,
    )


def confined(level: LevelCase) -> LevelCase:
    """The same, where a trained selector without guide has no skill that may start everywhere."""
    if level.ready or level.guide is not None:
        return level
    skills = tuple(replace(s, starts=s.starts or "mostly") for s in level.skills)
    return replace(level, skills=skills)


@st.composite
def cases(draw: Any) -> Case:
    deterministic = draw(of(True, True, False))
    level = draw(level_cases(draw(of(0, 1, 1, 2)), deterministic))
    if draw(st.booleans()):  # so that hierarchies below get stuck
        below = (
            s if s.below is None else replace(s, policy=confined(s.below)) for s in level.skills
        )
        level = replace(level, skills=tuple(below))
    level = replace(level, env=draw(of("stroll", "masked")))
    return Case(level, deterministic, draw(of(1, 1, 4)), draw(st.booleans()))
