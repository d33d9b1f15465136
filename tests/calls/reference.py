"""What a call means, in plain Python: one environment, one step after another.

Nothing here uses the player, the collectors or the policies that are compared with it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from calls.cases import (
    EVENTS,
    REFLEXES,
    STARTS,
    STOPS,
    WINS,
    Case,
    LevelCase,
    Net,
    Worth,
    chosen_by_function,
    machine,
    policy_of,
    recorded,
)

from skillweave.policies.core import CallEnd
from skillweave.types import Array, Step

RUNNING, OWN, LIMIT, INTERRUPTED, EPISODE = CallEnd


@dataclass
class Moment:
    """One step of an episode."""

    obs: Array
    action: int
    next_obs: Array
    reward: float
    terminated: bool
    truncated: bool
    acted: dict[str, Any]
    """By the names in a player's memory, what holds after the action."""
    observed: dict[str, Any]
    """The same after the step."""
    decision: Decision | None
    """Of the first selector."""
    ahead: list[bool]
    """The choices that may be made next, as far as is known before the next observation counts."""
    overridden: bool
    """A reflex acted, here or below."""


@dataclass
class Decision:
    choice: int
    mask: list[bool]
    before: dict[str, Any]
    """What the selector remembered."""
    chances: list[float] | None
    """The probabilities of the guide's choices."""


class Ready:
    """A ready selector."""

    def __init__(self, level: LevelCase, kind: str) -> None:
        self.level, self.kind = level, kind
        self.state, self.last = 0, (-1, EPISODE, False)

    def allowed(self, obs: Array | None) -> list[int]:
        """The skills that it may choose, best first; ``obs`` None: as far as it knows before."""
        if self.kind == "automaton":
            return machine(self.level).states[self.state]
        if obs is None:
            return [*range(len(self.level.skills))]
        keys = ("skill", "why", "succeeded")
        last = SimpleNamespace(**dict(zip(keys, map(np.array, self.last), strict=True)))
        given = last if self.kind == "last" else None
        return [int(chosen_by_function(self.level, obs[None], given)[0])]

    def watch(self, step: Step, last: tuple[int, int, bool]) -> None:
        self.last = last
        _, why, succeeded = last
        ended = {"success": succeeded, "failure": not succeeded}
        for origin, target, name in machine(self.level).arrows:
            if origin != self.state:
                continue
            event = EVENTS[name]
            if bool(event(step)[0]) if callable(event) else (why != RUNNING and ended[event]):
                self.state = target
                return

    def remembered(self) -> dict[str, Any]:
        if self.kind == "automaton":
            return {"state": self.state}
        keys = ("skill", "why", "succeeded")
        return dict(zip(keys, self.last, strict=True)) if self.kind == "last" else {}


class Life:
    """The calls of one level, from the start of an episode, or of a call of the whole."""

    def __init__(self, level: LevelCase, choices: list[int] | None = None) -> None:
        self.level, self.choices = level, choices
        self.count = len(level.skills)
        self.lengths = level.lengths or (None,)
        self.skill, self.elapsed, self.end, self.limit = -1, 0, EPISODE, None
        self.chances: list[float] | None = None
        self.part: Any = None  # of the running skill: a Life, or what its policy remembers
        self.ready = Ready(level, level.selector) if level.ready else None
        self.guide = None if level.guide is None else Ready(level, level.guide)
        self.net = None if level.ready else Net(
            self.count * len(self.lengths), int(level.selector == "counts"), turn=2
        )  # fmt: skip
        self.memory = {} if self.net is None else self.net.start(1)
        self.decision: Decision | None = None

    # May it start?

    @staticmethod
    def startable(level: LevelCase, obs: Array) -> list[bool]:
        found = []
        for case in level.skills:
            may = case.starts is None or bool(STARTS[case.starts](obs[None])[0])
            if isinstance(case.policy, LevelCase):
                may = may and any(Life.startable(case.policy, obs))
            found.append(may)
        return found

    # Acting

    def act(self, obs: Array, mask: Array | None, deterministic: bool) -> int:
        self.decision, self.overridden = None, False
        if self.end != RUNNING:
            self.decide(obs, deterministic)
        case = self.level.skills[self.skill]
        if isinstance(case.policy, LevelCase):
            action = self.part.act(obs, mask, self.level.greedy)
            self.overridden = self.part.overridden
        else:
            allowed = None if mask is None else mask[None]
            found, self.part = policy_of(case.policy).act(
                self.part, obs[None], allowed, deterministic=self.level.greedy
            )
            action = int(found[0])
        for name in self.level.reflexes:
            reflex = REFLEXES[name]
            if reflex.condition(obs[None])[0]:
                self.overridden = True
                answer: Any = reflex.action
                action = int(answer(obs[None])[0]) if callable(answer) else answer
        return action

    def decide(self, obs: Array, deterministic: bool) -> None:
        may = self.startable(self.level, obs)
        if self.guide is not None:
            wanted = [k for k in self.guide.allowed(obs) if may[k]]
            share = [(k in wanted) / len(wanted) for k in range(self.count)]
            self.chances = [x / len(self.lengths) for x in share for _ in self.lengths]
            if self.level.guide_restricts:
                may = [k in wanted for k in range(self.count)]
        mask = [yes for yes in may for _ in self.lengths]
        before = {k: v[0].tolist() for k, v in self.memory.items()}
        if self.choices is not None:
            choice = self.choices.pop(0)
        elif self.ready is not None:
            choice = next(k for k in self.ready.allowed(obs) if may[k])
        else:
            found, self.memory = self.net.act(
                self.memory, obs[None], np.array([mask]),
                deterministic=deterministic and self.level.greedy_selector,
            )  # fmt: skip
            choice = int(found[0])
        assert mask[choice], "the user of the player chose what may not start"
        self.decision = Decision(choice, mask, before, self.chances)
        skill, length = divmod(choice, len(self.lengths))
        if skill != self.skill:
            policy = self.level.skills[skill].policy
            self.part = (
                Life(policy) if isinstance(policy, LevelCase) else policy_of(policy).start(1)
            )
        self.skill, self.elapsed, self.end = skill, 0, RUNNING
        self.limit = self.lengths[length]

    # After a step

    def observe(self, step: Step) -> None:
        """Notice a step, whose time is the caller's."""
        self.elapsed += 1
        case = self.level.skills[self.skill]
        most = case.call_steps or self.level.call_steps
        limits = (self.limit, case.max_steps, most if isinstance(most, int) else None)
        self.end = RUNNING
        if any(limit is not None and self.elapsed >= limit for limit in limits):
            self.end = LIMIT
        own = self.seen(step)
        if isinstance(case.policy, LevelCase):
            below = self.part
            below.observe(own)
            ended = below.end not in (RUNNING, EPISODE)
            if ended and not any(self.startable(case.policy, step.next_obs[0])):
                self.end = LIMIT  # nothing below could follow
        else:
            self.part = policy_of(case.policy).observe(self.part, own)
        if case.stops == "recorded":
            recorded(own)
        elif case.stops is not None and STOPS[case.stops](own)[0]:
            self.end = OWN
        if self.level.margin is not None and self.end == RUNNING:
            worth = Worth(self.count).heads(step.next_obs)[0]
            gain = worth[-1] - worth[self.skill]
            if any(self.startable(self.level, step.next_obs[0])) and gain > self.level.margin:
                self.end = INTERRUPTED
        if (step.terminated[0] or step.truncated[0]) and self.end != OWN:
            self.end = EPISODE
        succeeded = self.end == OWN
        if case.wins is not None and self.end != RUNNING:
            succeeded = bool(WINS[case.wins](own)[0])
        for who in (self.guide, self.ready):
            if who is not None:
                who.watch(step, (self.skill, self.end, succeeded))

    def seen(self, step: Step) -> Step:
        """The step with the time as the running skill counts it."""
        limit = self.level.skills[self.skill].max_steps
        timed_out = limit is not None and self.elapsed >= limit and not step.terminated[0]
        return Step(
            step.obs, step.action, step.next_obs, step.reward, step.terminated, step.truncated,
            np.array([timed_out]), np.array([self.elapsed]), step.info,
        )  # fmt: skip

    # What it remembers

    def remembered(self) -> dict[str, Any]:
        """What holds now, by the names in a player's memory: of what runs."""
        found = {"skill": self.skill, "elapsed": self.elapsed, "end": int(self.end)}
        if self.level.lengths:
            found["limit"] = self.limit
        if isinstance(self.part, Life):
            below = self.part.remembered()
        else:
            below = {k: v[0].tolist() for k, v in self.part.items()}
        found |= {f"{self.skill}.{k}": v for k, v in below.items()}
        if self.choices is None:
            selector = {k: v[0].tolist() for k, v in self.memory.items()}
            if self.ready is not None:
                selector = self.ready.remembered()
            found |= {f"selector.{k}": v for k, v in selector.items()}
        if self.guide is not None:
            found |= {f"guide.{k}": v for k, v in self.guide.remembered().items()}
            found["chances"] = self.chances
        return found

    def ahead(self, next_obs: Array) -> list[bool]:
        may = self.startable(self.level, next_obs)
        if self.guide is not None and self.level.guide_restricts:
            may = [yes and k in self.guide.allowed(None) for k, yes in enumerate(may)]
        if not any(may):
            may = [True] * self.count
        return [yes for yes in may for _ in self.lengths]


def episode(case: Case, seed: int, choices: tuple[int, ...] | None = None) -> list[Moment]:
    """A whole episode, from its seed.

    Args:
        choices: of the first selector; those that it did not come to are left out.
    """
    if choices is None:
        return _episode(case, seed)
    return [*moments_of(case, seed, [*choices])]


@lru_cache(5_000)
def _episode(case: Case, seed: int) -> list[Moment]:
    return [*moments_of(case, seed, None)]


def moments_of(case: Case, seed: int, choices: list[int] | None) -> Iterator[Moment]:
    """As ``episode``; nothing is remembered of earlier episodes."""
    env, life = case.env(), Life(case.level, choices)
    obs, info = env.reset(seed=seed)
    over, t = False, 0
    while not over:
        if choices is not None and not choices and life.end != RUNNING:
            return  # the user has come no further
        action = life.act(obs, info.get("action_mask"), case.deterministic)
        acted, decision = life.remembered(), life.decision
        next_obs, reward, terminated, truncated, info = env.step(action)
        over, t = terminated or truncated, t + 1
        truncated = truncated and not terminated  # as engines say it
        step = Step(
            obs[None], np.array([action]), next_obs[None], np.array([reward], np.float32),
            np.array([terminated]), np.array([truncated]), np.zeros(1, bool), np.array([t]),
            {k: np.array([v]) for k, v in info.items() if k == "t"},
        )  # fmt: skip
        life.observe(step)
        yield Moment(
            obs, action, next_obs, float(step.reward[0]), terminated, truncated, acted,
            life.remembered(), decision, life.ahead(next_obs),
            life.overridden,
        )  # fmt: skip
        obs = next_obs


@dataclass
class Call:
    """A decision of the first selector and the call that followed."""

    obs: Array
    next_obs: Array
    decision: Decision
    first: bool
    """Of its episode."""
    rewards: list[float]
    terminated: bool
    truncated: bool
    ahead: list[bool]


def calls(moments: list[Moment]) -> list[Call]:
    """The calls of an episode that is over."""
    found: list[Call] = []
    for moment in moments:
        if moment.decision is not None:
            found.append(Call(moment.obs, moment.obs, moment.decision, not found, [], False, False,
                              []))  # fmt: skip
        call = found[-1]
        call.rewards.append(moment.reward)
        call.next_obs, call.ahead = moment.next_obs, moment.ahead
        call.terminated = moment.terminated
        call.truncated = moment.truncated
    return found
