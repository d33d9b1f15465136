"""The columns of a log of calls, and what follows from them.

Stands apart from ``CallLog``, so that what reads columns can be a method there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import shortened, suggest
from skillweave.algorithms.batches import INFO
from skillweave.calls.neighbors import Standard
from skillweave.errors import DeclarationError
from skillweave.policies.core import Array, CallEnd, Choices, Step
from skillweave.runs.user_code import Texts
from skillweave.spaces import obs_codec, obs_dtype, obs_shape, to_tensor

ENDS = {end: end.name.lower() for end in list(CallEnd)[1:]}
"""Names of the ends of calls."""
GOAL = "goal."
"""Prefix of the fields with the goals of a skill's calls."""
OF_CALL = (
    ("choice", np.int64),
    ("end_reason", np.int8),
    ("succeeded", np.bool_),
    ("terminated", np.bool_),
    ("truncated", np.bool_),
    ("episode", np.int64),
    ("seed", np.int64),
    ("order", np.int64),
    ("age", np.int64),
)
"""Fields of a call with one value each."""
PER_CALL = ("start", *(name for name, _ in OF_CALL), "may_follow")
"""Columns with a row for each call."""
PER_STEP = ("next_obs", "action", "reward")
"""Columns with a row for each step."""


def call_fields(
    observation: gym.Space[Any], choices: int, goals: Mapping[str, int], *, whole: bool = True
) -> list[tuple[Any, ...]]:
    """Return the fields of a call, a row of a log.

    Args:
        observation: the environment's space.
        choices: the number of choices.
        goals: by skill that has goals, the numbers of one.
        whole: with the observation of the decision, and the choices that may follow.
    """
    start = ("start", obs_dtype(observation), obs_shape(observation))
    large = [start, ("may_follow", np.bool_, (choices,))] if whole else []
    return [*OF_CALL, *large, *((GOAL + name, np.float64, (n,)) for name, n in goals.items())]


@dataclass(frozen=True, eq=False, repr=False)
class CallColumns(Choices):
    """C calls and the T steps inside them; ``CallLog`` describes the columns."""

    skills: tuple[str, ...]
    lengths: tuple[int, ...]
    checksums: tuple[str, ...]
    sees: tuple[tuple[int, ...] | None, ...]
    recurrent: tuple[bool, ...]
    own_success: tuple[bool, ...]
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    start: Array
    choice: Array
    end_reason: Array
    succeeded: Array
    terminated: Array
    truncated: Array
    episode: Array
    seed: Array
    order: Array
    age: Array
    may_follow: Array
    offset: Array
    next_obs: Array
    action: Array
    reward: Array
    info: dict[str, Array] = field(default_factory=dict)
    goals: dict[str, Array] = field(default_factory=dict)
    code: Texts = field(default_factory=dict)
    limits: tuple[int | None, ...] = ()
    known_time_limit: int | None = None
    features: Any = None

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
    def skill(self) -> Array:
        """The skill of each call, (C,) int64."""
        skill: Array = self.skill_of(self.choice)
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
    def time_limit(self) -> int:
        """The steps after which a time limit ends episodes; 0: none is seen.

        It is the age of the oldest step, if an episode was truncated there. An episode that was
        truncated at another age was so for another reason.
        """
        if self.known_time_limit is not None:
            return self.known_time_limit
        return time_limit_of(self.age + self.tau, self.truncated & ~self.terminated)

    @cached_property
    def whole_steps(self) -> Array:
        """The steps of a whole call of each choice, (choices,) int64; see ``whole_steps``."""
        limits = limits_of_choices(self, self.limits or (None,) * len(self.skills))
        complete = (self.end_reason == CallEnd.OWN) | self.terminated
        return whole_steps(self.choice, self.tau, complete, self.was_cut, limits)

    @cached_property
    def began_late(self) -> Array:
        """(C,) bool: the call began too late to run its whole length, so it counts nowhere."""
        return began_late(self.age, self.whole_steps[self.choice], self.time_limit)

    @cached_property
    def change_rate(self) -> Array:
        """The share of steps in which each number of the flat observation changes, (F,)."""
        share: Array = (self.flat(self.before) != self.flat(self.next_obs)).mean(0)
        return share

    @cached_property
    def varies(self) -> Array:
        """(F,) bool: the number of the flat observation is not the same in all steps."""
        return Standard(self.flat(self.before)).varies

    @cached_property
    def followed_by(self) -> Array:
        """The next call of the same episode, (C,) int64; −1: none was logged."""
        following = np.full(len(self), -1)
        rows = np.lexsort((self.order, self.episode))
        a = rows[:-1]
        b = rows[1:]
        joined = (self.episode[a] == self.episode[b]) & (self.order[a] + 1 == self.order[b])
        # In a nested hierarchy other skills may act between two of its calls.
        joined &= self.age[a] + self.tau[a] == self.age[b]
        following[a[joined]] = b[joined]
        return following

    @property
    def reasons(self) -> dict[str, int]:
        """The number of calls by the reason of their end: own, limit, interrupted, episode."""
        return {name: int((self.end_reason == end).sum()) for end, name in ENDS.items()}

    def flat(self, obs: Array) -> Array:
        """Return the numbers of observations (n, …) without images, (n, F)."""
        vector = obs_codec(self.observation_space).split(to_tensor(obs))[0]
        flat: Array = vector.reshape(len(obs), -1).numpy()
        return flat

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
            DeclarationError: the log has no skill of this name; a similar one is given.
        """
        if skill not in self.skills:
            raise DeclarationError(f"the log has no skill {skill!r}{suggest(skill, self.skills)}")
        return self.skills.index(skill)

    def of(self, skill: str) -> Self:
        """Return the calls of one skill."""
        return self.take(np.flatnonzero(self.skill == self.number(skill)))

    def take(self, rows: Array) -> Self:
        """Return some calls, in the order of ``rows`` (k,), with their steps."""
        rows = np.asarray(rows, np.int64)
        tau = self.tau[rows]
        offset = np.concatenate([[0], np.cumsum(tau)]).astype(np.int64)
        # The k-th step of a call is k behind its first.
        steps = np.arange(offset[-1]) + np.repeat(self.offset[rows] - offset[:-1], tau)
        per_step = (*PER_STEP, *(INFO + key for key in self.info))
        columns = {k: x[steps if k in per_step else rows] for k, x in columns_of(self).items()}
        part = replace(self, **fields_of(columns) | {"offset": offset})
        return replace(part, known_time_limit=self.time_limit)

    def within(self, steps: int) -> Self:
        """Return the first calls, as many as have at most ``steps`` steps in all."""
        return self.take(np.flatnonzero(self.offset[1:] <= steps))

    def latest(self, steps: int) -> Self:
        """Return the last calls, as many as have at most ``steps`` steps in all."""
        return self.take(np.flatnonzero(self.steps - self.offset[:-1] <= steps))


def time_limit_of(age_after: Array, truncated: Array) -> int:
    """Return the steps after which a time limit ends episodes; 0: none is seen.

    Args:
        age_after: (C,) the steps of the episode until the end of each call.
        truncated: (C,) bool, the episode was truncated, and not terminated, at the call's end.
    """
    limit = int(age_after[truncated].max(initial=0))
    return limit if age_after.max(initial=0) <= limit else 0


def limits_of_choices(choices: Choices, limits: Sequence[int | None]) -> Array:
    """Return the most steps of a call of each choice, (choices,) int64; 0: it has no limit.

    Args:
        choices: skills, perhaps with lengths.
        limits: of each skill; None: it has none.
    """
    of_skill = [limits[choices.skill_of(choice)] for choice in range(choices.choices)]
    lengths = (choices.lengths or (None,)) * len(choices.skills)
    both = zip(of_skill, lengths, strict=True)
    return np.array([min((x for x in pair if x is not None), default=0) for pair in both], np.int64)


def whole_steps(
    choice: Array, steps: Array, complete: Array, was_cut: Array, limits: Array
) -> Array:
    """Return the steps of a whole call of each choice, (choices,) int64.

    They are its limit. Without one, they are those of the longest call that came to its own end, or
    of the longest of all where none did; and 0 where no call was cut, as nothing is unknown then.

    Args:
        choice: (C,) of each call.
        steps: (C,) of each call.
        complete: (C,) bool, the call ended by itself, or the episode terminated.
        was_cut: (C,) bool, the episode's time limit cut the call.
        limits: see ``limits_of_choices``.
    """
    longest, longest_complete = (np.zeros(len(limits), np.int64) for _ in range(2))
    np.maximum.at(longest, choice, steps)
    np.maximum.at(longest_complete, choice[complete], steps[complete])
    unlimited = np.where(longest_complete > 0, longest_complete, longest)
    unlimited[np.bincount(choice[was_cut], minlength=len(limits)) == 0] = 0
    return np.where(limits > 0, limits, unlimited)


def began_late(age: Array, whole: Array, time_limit: int) -> Array:
    """Return the calls that began too late to run their whole length, (C,) bool.

    These count nowhere, whatever their end and outcome: else those that are over soon would count
    more than others. A call that began with its episode was never too late.

    Args:
        age: (C,) the steps of the episode before each call.
        whole: (C,) the steps of a whole call.
        time_limit: of ``time_limit_of``.
    """
    late: Array = (age > 0) & (age + whole > time_limit) & (time_limit > 0)
    return late


def columns_of(log: CallColumns) -> dict[str, Array]:
    """Return all arrays of a log by name."""
    named = {name: getattr(log, name) for name in (*PER_CALL, "offset", *PER_STEP)}
    named |= {INFO + key: value for key, value in log.info.items()}
    return named | {GOAL + name: value for name, value in log.goals.items()}


def fields_of(columns: Mapping[str, Array]) -> dict[str, Any]:
    """Return the fields of a log from its arrays; the inverse of ``columns_of``."""
    plain = dict[str, Array]()
    info = dict[str, Array]()
    goals = dict[str, Array]()
    for name, column in columns.items():
        if name.startswith(INFO):
            info[name.removeprefix(INFO)] = column
        elif name.startswith(GOAL):
            goals[name.removeprefix(GOAL)] = column
        else:
            plain[name] = column
    return {**plain, "info": info, "goals": goals}
