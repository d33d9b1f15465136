"""What a call means, in plain Python: one environment, one step after another.

Nothing here uses the player, the collectors or the policies that are compared with it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from calls.cases import (
    Case,
    Net,
    Worth,
    policy_of,
)

from skillweave.policies.core import CallEnd
from skillweave.types import Array, Memory

RUNNING, OWN, LIMIT, INTERRUPTED, EPISODE = CallEnd


def row(x: Any) -> Any:
    """One observation, action or goal as a batch of one; of a dict each part."""
    return {k: row(v) for k, v in x.items()} if isinstance(x, dict) else np.asarray(x)[None]


def only(x: Any) -> Any:
    """The only one of a batch of one."""
    return {k: only(v) for k, v in x.items()} if isinstance(x, dict) else x[0]


@dataclass
class Shown:
    """A step as skills and policies see it, in batches of one; of a Dict a dict of these."""

    obs: Any
    action: Any
    next_obs: Any
    reward: Array
    terminated: Array
    truncated: Array
    timed_out: Array
    elapsed: Array
    info: dict[str, Any]
    goal: Any = None
    """Of the call, where the skill has goals."""


@dataclass
class Moment:
    """One step of an episode."""

    obs: Any
    action: Any
    next_obs: Any
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

    @property
    def over(self) -> bool:
        """It is the episode's last."""
        return self.terminated or self.truncated


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

    def __init__(self, level: Any, kind: str) -> None:
        self.level, self.kind = level, kind
        self.state, self.last = 0, (-1, EPISODE, False)

    def allowed(self, obs: Array | None) -> list[int]:
        """The skills that it may choose, best first; ``obs`` None: as far as it knows before."""
        if self.kind == "automaton":
            return self.level.machine.states[self.state]
        if obs is None:
            return [*range(len(self.level.skills))]
        keys = ("skill", "why", "succeeded")
        last = SimpleNamespace(**dict(zip(keys, map(np.array, self.last), strict=True)))
        given = last if self.kind == "last" else None
        return [int(self.level.by_function(row(obs), given)[0])]

    def watch(self, step: Shown, last: tuple[int, int, bool]) -> None:
        self.last = last
        _, why, succeeded = last
        ended = {"success": succeeded, "failure": not succeeded}
        machine = self.level.machine
        for origin, target, name in machine.arrows:
            if origin != self.state:
                continue
            event = machine.events[name]
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

    def __init__(self, level: Any, choices: list[int] | None = None) -> None:
        self.level, self.choices = level, choices
        self.count = len(level.skills)
        self.lengths = level.lengths or (None,)
        self.skill, self.elapsed, self.end, self.length = -1, 0, EPISODE, None
        self.chances: list[float] | None = None
        self.part: Any = None  # of the running skill: a Life, or what its policy remembers
        self.ready = Ready(level, level.selector) if level.ready else None
        self.guide = None if level.guide is None else Ready(level, level.guide)
        self.net = None if level.ready else self.network()
        self.memory = {} if self.net is None else self.net.start(1)
        self.decision: Decision | None = None

    # What runs

    def network(self) -> Any:
        """The selector that is trained."""
        recurrent = int(self.level.selector == "counts")
        return Net(self.count * len(self.lengths), recurrent, turn=2)

    def fresh(self, skill: int) -> Life | Memory:
        """What a skill remembers where it has not acted."""
        case = self.level.skills[skill]
        return policy_of(case.policy).start(1) if case.below is None else Life(case.below)

    # May it start?

    @staticmethod
    def startable(level: Any, obs: Any) -> list[bool]:
        found = []
        for case in level.skills:
            starts = case.methods.get("initiation")
            may = starts is None or bool(starts(row(obs))[0])
            found.append(may and (case.below is None or any(Life.startable(case.below, obs))))
        return found

    # Acting

    def act(self, obs: Any, mask: Array | None, deterministic: bool) -> Any:
        self.decision, self.overridden = None, False
        if self.end != RUNNING:
            self.decide(obs, deterministic)
        if isinstance(self.part, Life):
            action = self.part.act(obs, mask, self.level.greedy)
            self.overridden = self.part.overridden
        else:
            action = self.act_skill(obs, mask)
        for reflex in self.level.rules:
            if reflex.condition(row(obs))[0]:
                self.overridden = True
                answer: Any = reflex.action
                action = only(answer(row(obs))) if callable(answer) else answer
        return action

    def act_skill(self, obs: Array, mask: Array | None) -> Any:
        allowed = None if mask is None else mask[None]
        policy = policy_of(self.level.skills[self.skill].policy)
        found, self.part = policy.act(
            self.part, obs[None], allowed, deterministic=self.level.greedy
        )  # fmt: skip
        return found[0]

    def decide(self, obs: Any, deterministic: bool) -> None:
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
            self.part = self.fresh(skill)
        self.begin(skill, length)

    def begin(self, skill: int, length: int) -> None:
        """Start a call."""
        self.skill, self.elapsed, self.end = skill, 0, RUNNING
        self.length = self.lengths[length]

    # After a step

    def observe(self, step: Shown) -> None:
        """Notice a step, whose time is the caller's."""
        self.elapsed += 1
        case = self.level.skills[self.skill]
        self.end = LIMIT if self.limited else RUNNING
        own = self.seen(step)
        next_obs = only(step.next_obs)
        if isinstance(self.part, Life):
            below = self.part
            below.observe(own)
            ended = below.end not in (RUNNING, EPISODE)
            if ended and not any(self.startable(case.below, next_obs)):
                self.end = LIMIT  # nothing below could follow
        else:
            self.watch_skill(own)
        if "termination" in case.methods and case.methods["termination"](own)[0]:
            self.end = OWN
        if self.level.margin is not None and self.end == RUNNING:
            worth = self.worth(step)
            gain = worth[-1] - worth[self.skill]
            if any(self.startable(self.level, next_obs)) and gain > self.level.margin:
                self.end = INTERRUPTED
        if (step.terminated[0] or step.truncated[0]) and self.end != OWN:
            self.end = EPISODE
        succeeded = self.end == OWN
        if "success" in case.methods and self.end != RUNNING:
            succeeded = bool(case.methods["success"](own)[0])
        for who in (self.guide, self.ready):
            if who is not None:
                who.watch(step, (self.skill, self.end, succeeded))

    @property
    def limited(self) -> bool:
        """The running call has reached a limit."""
        case = self.level.skills[self.skill]
        most = case.call_steps or self.level.call_steps
        limits = (self.length, case.max_steps, most if isinstance(most, int) else None)
        return any(limit is not None and self.elapsed >= limit for limit in limits)

    def watch_skill(self, own: Shown) -> None:
        """Let the policy of the running skill notice a step."""
        policy = policy_of(self.level.skills[self.skill].policy)
        self.part = policy.observe(self.part, own)

    def worth(self, step: Shown) -> Array:
        """What a critic says of the calls after a step, and last of a new decision."""
        return Worth(self.count).heads(step.next_obs)[0]

    def seen(self, step: Shown) -> Shown:
        """The step with the time as the running skill counts it."""
        limit = self.level.skills[self.skill].max_steps
        timed_out = limit is not None and self.elapsed >= limit and not step.terminated[0]
        return replace(
            step, timed_out=np.array([timed_out]), elapsed=np.array([self.elapsed]), goal=None
        )  # fmt: skip

    # What it remembers

    def remembered(self) -> dict[str, Any]:
        """What holds now, by the names in a player's memory: of what runs."""
        found = {"skill": self.skill, "elapsed": self.elapsed, "end": int(self.end)}
        if self.level.lengths:
            found["length"] = self.length
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

    def ahead(self, next_obs: Any) -> list[bool]:
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
    return lived(Life(case.level, choices), case, seed)


def lived(life: Life, case: Any, seed: int) -> Iterator[Moment]:
    """The steps of an episode."""
    env, choices = case.env(), life.choices
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
        step = Shown(
            row(obs), row(action), row(next_obs), np.array([reward], np.float32),
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
