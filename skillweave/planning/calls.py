"""The calls of skills as arrays, with all steps inside each call."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.collecting.call_end import CallEnd
from skillweave.collecting.skill_set import SkillSet
from skillweave.errors import DeclarationError, RunError
from skillweave.messages import close_matches, shortened
from skillweave.planning.call_file import INFO, read_calls, write_calls
from skillweave.planning.skill_code import code_of
from skillweave.skills.foreign_policy import checksum, source_of
from skillweave.spaces import same_space
from skillweave.types import Array, Step

PER_CALL = (
    "start",
    "choice",
    "end_reason",
    "succeeded",
    "terminated",
    "truncated",
    "episode",
    "order",
    "age",
    "may_follow",
)
"""Columns with a row for each call."""
PER_STEP = ("next_obs", "action", "reward")
"""Columns with a row for each step."""


@dataclass(frozen=True, eq=False, repr=False)
class CallLog:
    """C calls of skills, in the order of their starts, and the T steps inside them.

    Attributes:
        skills: names of the skills.
        lengths: lengths that were chosen with the skills; empty: none were.
        checksums: of each skill, what decides its actions and its ends.
        sees: of each skill, the places in the flat observation that its network sees; None: all.
        recurrent: of each skill, whether its policy has a memory within a call.
        observation_space: of the environment.
        action_space: of the environment.
        start: (C, *obs_shape), the observation of the decision.
        choice: (C,) int64, the skill's place in ``skills``; with lengths, that times their number
            plus the length's place.
        end_reason: (C,) int8, ``CallEnd``: by itself, at a limit, interrupted, with the episode.
        succeeded: (C,) bool, the skill's ``success`` at the end; without one, ended by itself.
        terminated: (C,) bool, the episode ended in the call.
        truncated: (C,) bool, the episode's time limit cut the call.
        episode: (C,) int64, the number of the episode.
        order: (C,) int64, the call's number in its episode, from 0.
        age: (C,) int64, the steps of the episode before the call.
        may_follow: (C, choices) bool, the choices that may start at the call's end.
        offset: (C + 1,) int64, the first step of each call; its last one is before the next call's.
        next_obs: (T, *obs_shape), the observation after each step.
        action: (T, *action_shape).
        reward: (T,) float32, the environment's.
        info: by key, (T, …) values of the environment's ``info``.
    """

    skills: tuple[str, ...]
    lengths: tuple[int, ...]
    checksums: tuple[str, ...]
    sees: tuple[tuple[int, ...] | None, ...]
    recurrent: tuple[bool, ...]
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    start: Array
    choice: Array
    end_reason: Array
    succeeded: Array
    terminated: Array
    truncated: Array
    episode: Array
    order: Array
    age: Array
    may_follow: Array
    offset: Array
    next_obs: Array
    action: Array
    reward: Array
    info: dict[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.choice)

    def __repr__(self) -> str:
        counts = np.bincount(self.skill, minlength=len(self.skills)).tolist()
        each = ", ".join(f"{n} {c}" for n, c in zip(self.skills, counts, strict=True))
        return f"<CallLog: {len(self):,} calls ({shortened(each, 300)}), {self.steps:,} steps>"

    @property
    def steps(self) -> int:
        """The steps of all calls together, T."""
        return len(self.reward)

    @property
    def choices(self) -> int:
        """The number of choices: each skill with each length."""
        return len(self.skills) * max(1, len(self.lengths))

    @property
    def skill(self) -> Array:
        """The skill of each call, (C,) int64."""
        skill: Array = self.choice // max(1, len(self.lengths))
        return skill

    @property
    def tau(self) -> Array:
        """The steps of each call, (C,) int64."""
        return np.diff(self.offset)

    @property
    def end(self) -> Array:
        """The observation after each call, (C, *obs_shape), always the true successor."""
        end: Array = self.next_obs[self.offset[1:] - 1]
        return end

    @property
    def before(self) -> Array:
        """The observation before each step, (T, *obs_shape)."""
        before = np.roll(self.next_obs, 1, axis=0)
        before[self.offset[:-1]] = self.start
        return before

    @property
    def owner(self) -> Array:
        """The call of each step, (T,) int64."""
        return np.repeat(np.arange(len(self)), self.tau)

    @property
    def elapsed(self) -> Array:
        """The steps of its call until each step, this one included, (T,) int64."""
        elapsed: Array = np.arange(self.steps) - self.offset[self.owner] + 1
        return elapsed

    @property
    def was_cut(self) -> Array:
        """(C,) bool: the episode's time limit cut the call."""
        cut: Array = self.truncated & ~self.terminated & (self.end_reason == CallEnd.EPISODE)
        return cut

    @cached_property
    def followed_by(self) -> Array:
        """The next call of the same episode, (C,) int64; −1: none was logged."""
        following = np.full(len(self), -1)
        rows = np.lexsort((self.order, self.episode))
        a, b = rows[:-1], rows[1:]
        joined = (self.episode[a] == self.episode[b]) & (self.order[a] + 1 == self.order[b])
        following[a[joined]] = b[joined]
        return following

    def returns(self, gamma: float) -> Array:
        """Return Σ γᵏ rₖ of each call, (C,) float64."""
        weighted = self.reward.astype(np.float64) * gamma ** (self.elapsed - 1)
        sums: Array = np.add.reduceat(weighted, self.offset[:-1]) if len(self) else np.zeros(0)
        return sums

    def as_steps(self) -> Step:
        """Return all steps as one ``Step`` of T rows, to judge tasks by.

        ``elapsed`` counts the steps of the episode, as it does where a task is followed.
        """
        last = np.zeros(self.steps, bool)
        last[self.offset[1:] - 1] = True
        return Step(
            obs=self.before,
            action=self.action,
            next_obs=self.next_obs,
            reward=self.reward,
            terminated=last & self.terminated[self.owner],
            truncated=last & self.truncated[self.owner],
            timed_out=np.zeros(self.steps, bool),
            elapsed=self.age[self.owner] + self.elapsed,
            info=self.info,
        )

    def number(self, skill: str) -> int:
        """Return the place of a skill in ``skills``.

        Raises:
            DeclarationError: the log has no skill of this name; similar names are given.
        """
        if skill not in self.skills:
            raise DeclarationError(
                f"the log has no skill {skill!r}; its skills are: {', '.join(self.skills)}."
                f"{close_matches(str(skill), self.skills)}"
            )
        return self.skills.index(skill)

    def of(self, skill: str) -> CallLog:
        """Return the calls of one skill."""
        return self.take(np.flatnonzero(self.skill == self.number(skill)))

    def take(self, rows: Array) -> CallLog:
        """Return some calls, in the order of ``rows`` (k,), with their steps."""
        rows = np.asarray(rows, np.int64)
        tau = self.tau[rows]
        offset = np.concatenate([[0], np.cumsum(tau)]).astype(np.int64)
        # The k-th step of a call is k behind its first.
        steps = np.arange(offset[-1]) + np.repeat(self.offset[rows] - offset[:-1], tau)
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in PER_CALL},
            **{name: getattr(self, name)[steps] for name in PER_STEP},
            offset=offset,
            info={key: value[steps] for key, value in self.info.items()},
        )

    def within(self, steps: int) -> CallLog:
        """Return the first calls, as many as have at most ``steps`` steps in all."""
        return self.take(np.flatnonzero(self.offset[1:] <= steps))

    def latest(self, steps: int) -> CallLog:
        """Return the last calls, as many as have at most ``steps`` steps in all."""
        return self.take(np.flatnonzero(self.steps - self.offset[:-1] <= steps))

    def check_skills(self, skills: SkillSet) -> None:
        """Raise a RunError where the log is of other skills, spaces or limits of calls."""
        names, lengths = tuple(s.name for s in skills.skills), skills.lengths
        if names != self.skills:
            raise RunError(
                f"the log is of the skills {', '.join(self.skills)}, but these are "
                f"{', '.join(names)}; record a log of these skills"
            )
        if lengths != self.lengths:
            raise RunError(
                f"the log is of calls with {_shown_lengths(self.lengths)}, but these are with "
                f"{_shown_lengths(lengths)}; record a log of these calls"
            )
        for policy in skills.policies:
            self.check_spaces(policy.observation_space, policy.action_space)
        for name, now, then in zip(names, skill_checksums(skills), self.checksums, strict=True):
            if now != then:
                raise RunError(
                    f"the skill {name!r} has changed since the log was recorded (it has learnt on, "
                    "or its limits or its code are others), so its calls end elsewhere now; record "
                    "a new log"
                )

    def check_spaces(self, observation: gym.Space[Any], action: gym.Space[Any]) -> None:
        """Raise a RunError where the log is of other spaces."""
        for what, own, other in (
            ("observations", self.observation_space, observation),
            ("actions", self.action_space, action),
        ):
            if not same_space(own, other):
                raise RunError(
                    f"the log has {what} of {own}, but here they are of {other}; record a log in "
                    "this environment"
                )

    def save(self, path: str | Path) -> None:
        """Write the log into one file, ``.safetensors``.

        Raises:
            RunError: the file cannot be written.
        """
        write_calls(path, columns_of(self), vars(self))

    @staticmethod
    def load(path: str | Path) -> CallLog:
        """Read a log; nothing in the file is executed.

        Raises:
            RunError: the file is missing or damaged, or holds no log of calls.
        """
        return CallLog(**read_calls(path))


def join(logs: Iterable[CallLog]) -> CallLog:
    """Return one log of several, whose episodes are numbered one after another.

    Raises:
        DeclarationError: no log is given.
        RunError: the logs are of other skills, spaces or ``info`` keys.
    """
    if isinstance(logs, CallLog):
        raise DeclarationError("join() takes a list of logs: join([log, other])")
    logs = list(logs)
    if not logs:
        raise DeclarationError("join() needs at least one log")
    first = logs[0]
    for log in logs[1:]:
        if (log.skills, log.lengths) != (first.skills, first.lengths):
            raise RunError(
                f"one log is of the skills {', '.join(first.skills)}, another of "
                f"{', '.join(log.skills)}, or of other lengths; join logs of the same skills"
            )
        first.check_spaces(log.observation_space, log.action_space)
        for name, a, b in zip(first.skills, first.checksums, log.checksums, strict=True):
            if a != b:
                raise RunError(
                    f"the skill {name!r} differs between the logs: it has learnt in between, or "
                    "its limits or its code are others; join logs of the same skills"
                )
        if log.info.keys() != first.info.keys():
            raise RunError(
                f"one log has the info keys {', '.join(first.info) or 'none'}, another "
                f"{', '.join(log.info) or 'none'}; record the same keys"
            )
    episodes, offsets = [], [np.zeros(1, np.int64)]
    next_episode = steps = 0
    for log in logs:
        episodes.append(log.episode - log.episode.min(initial=0) + next_episode)
        next_episode = int(episodes[-1].max(initial=next_episode - 1)) + 1
        offsets.append(log.offset[1:] + steps)
        steps += log.steps
    whole: dict[str, Any] = {
        name: np.concatenate([getattr(log, name) for log in logs])
        for name in (*PER_CALL, *PER_STEP)
        if name != "episode"
    }
    info = {key: np.concatenate([log.info[key] for log in logs]) for key in first.info}
    return replace(
        first,
        **whole,
        episode=np.concatenate(episodes),
        offset=np.concatenate(offsets),
        info=info,
    )


def skill_checksums(skills: SkillSet) -> tuple[str, ...]:
    """Return a checksum of each skill: its policy, the limit of its calls, and the reflexes.

    The user's classes and functions enter by their code, where Python has it, else by their names.
    """
    checksums = []
    for i, policy in enumerate(skills.policies):
        source = source_of(policy)
        acts = source.get("sha256") or source.get("name")
        reflexes = [reflex.name for reflex in skills.reflexes]
        code = code_of(skills.skills[i], policy, skills.reflexes)
        whole = repr([acts, skills.limit(i), skills.greedy, reflexes, code])
        checksums.append(checksum(whole.encode()))
    return tuple(checksums)


def seen_places(skills: SkillSet) -> tuple[tuple[int, ...] | None, ...]:
    """Return the places that each skill's network sees; None: all, or the policy is no network."""
    networks = (
        getattr(getattr(getattr(p, "algorithm", None), "config", None), "network", None)
        for p in skills.policies
    )
    places = (getattr(network, "sees", None) for network in networks)
    return tuple(None if p is None else tuple(p) for p in places)


def columns_of(log: CallLog) -> Mapping[str, Array]:
    """Return all arrays of a log by name."""
    named = {name: getattr(log, name) for name in (*PER_CALL, "offset", *PER_STEP)}
    return named | {INFO + key: value for key, value in log.info.items()}


def _shown_lengths(lengths: Sequence[int]) -> str:
    return f"the lengths {', '.join(map(str, lengths))}" if lengths else "no chosen lengths"
