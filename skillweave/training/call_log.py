"""Log of each episode of an evaluation, call by call, for reports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from skillweave.collecting.call_end import CallEnd
from skillweave.collecting.skill_set import skills_below
from skillweave.paths import AGENT
from skillweave.skills import Skill
from skillweave.skills.base import RecordedSkill
from skillweave.training.play import Played
from skillweave.training.skill_report import ENDS, StepOutcome, judge_step, played_below
from skillweave.types import Array, Policy


@dataclass
class Call:
    """One call of a skill; the whole episode for a plain agent."""

    skill: int
    """A row of ``CallLog.labels``."""
    start: int
    """Steps of the episode before it."""
    obs: Array
    """The observation of the selector's decision, (*obs_shape)."""
    steps: int = 0
    why: str | None = None
    """``own``, ``limit``, ``interrupted`` or ``episode``, as in ``ENDS``; None: unknown."""
    reward: float = 0.0
    """Sum of the environment's reward, not discounted."""
    own: float | None = None
    """Sum of the skill's own reward; None: unknown."""
    succeeded: bool | None = None
    """Result of the skill's ``success`` for the last step; None: it defines none."""


@dataclass
class EpisodeLog:
    """One episode."""

    seed: int
    """The episode's seed; with the same actions it can be played again."""
    calls: list[Call] = field(default_factory=list)
    actions: list[Array] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    """The environment's reward of each step."""
    cut: bool = False
    """True if it was cut at the step limit without an end."""

    @property
    def total(self) -> float:
        """Its return."""
        return float(sum(self.rewards))


class CallLog:
    """Recorder of the calls of episodes: ``evaluate(..., watch=log.add)``.

    Where a skill is a hierarchy, the calls of its own skills are recorded, by their paths.

    Args:
        seeds: of the episodes, in order.
    """

    def __init__(self, policy: Policy, seeds: Sequence[int]) -> None:
        self._root = _Level(policy)
        leaves = list(self._root.leaves())
        self.labels = tuple(path for path, _ in leaves) or (AGENT,)
        self.skills = tuple(skill for _, skill in leaves if skill is not None)
        self.episodes = [EpisodeLog(seed) for seed in seeds]

    def add(self, played: Played) -> None:
        """Record one step of each environment."""
        if played.acting is None:
            self._write(played, np.zeros(len(played.episode), np.int64), None)
        else:
            self._add(played, self._root)

    def _add(self, played: Played, level: _Level) -> None:
        """Record a step of environments in which the skills of a level act."""
        assert played.acting is not None
        outcome = None if level.skills is None else judge_step(level.skills, played)
        leaf = np.array([level.numbers.get(i, 0) for i in range(len(level.labels))])[played.acting]
        is_leaf = ~np.isin(played.acting, list(level.below))
        self._write(played, leaf, outcome, np.flatnonzero(is_leaf))
        for i, below in level.below.items():
            if len(rows := np.flatnonzero(played.acting == i)):
                self._add(played_below(played, i, rows), below)

    def _write(
        self, played: Played, leaf: Array, outcome: StepOutcome | None, rows: Array | None = None
    ) -> None:
        """Record a step of ``rows`` (m,), None: all; ``leaf`` (k,) are the acting skills."""
        for j in range(len(played.episode)) if rows is None else rows:
            episode = self.episodes[played.episode[j]]
            last = episode.calls[-1] if episode.calls else None
            # A policy of another kind does not report starts of calls.
            starts = played.call_start is not None and bool(played.call_start[j])
            if last is None or starts or last.skill != leaf[j]:
                if last is not None and outcome is not None and last.why is None:
                    last.why = ENDS[CallEnd.LIMIT]  # its hierarchy was not called again
                start = len(episode.rewards)
                episode.calls.append(Call(int(leaf[j]), start, np.array(played.step.obs[j])))
            call = episode.calls[-1]
            reward = float(played.reward[j])
            episode.actions.append(np.array(played.step.action[j]))
            episode.rewards.append(reward)
            episode.cut = bool(played.cut[j])
            call.steps += 1
            call.reward += reward
            if outcome is not None:
                self._add_outcome(call, outcome, int(j))
            elif played.over[j]:
                call.why = ENDS[CallEnd.EPISODE]

    def _add_outcome(self, call: Call, outcome: StepOutcome, j: int) -> None:
        """Add a step's outcome to the running call."""
        skill = self.skills[call.skill]
        if not isinstance(skill, RecordedSkill):
            call.own = (call.own or 0.0) + float(outcome.reward[j])
        if outcome.why[j] != CallEnd.RUNNING:
            call.why = ENDS[CallEnd(int(outcome.why[j]))]
            if skill.defines("success"):
                call.succeeded = bool(outcome.succeeded[j])


class _Level:
    """The skills of a policy, and of hierarchies among them.

    Args:
        path: of the skills: empty, or ``inner/`` for example.
        first: the number, among all leaves, of this level's first.
    """

    def __init__(self, policy: Policy, path: str = "", first: int = 0) -> None:
        self.labels = policy.labels
        self._path = path
        self.skills = skills_below(policy)
        self.numbers: dict[int, int] = {}
        """Numbers among all leaves, by the number at this level."""
        self.below: dict[int, _Level] = {}
        for i, name in enumerate(self.labels):
            inner = None if self.skills is None else self.skills.policies[i]
            if inner is not None and skills_below(inner) is not None:
                self.below[i] = _Level(inner, f"{path}{name}/", first)
                first += len(list(self.below[i].leaves()))
            else:
                self.numbers[i] = first
                first += 1

    def leaves(self) -> Iterator[tuple[str, Skill | None]]:
        """Yield the acting skills with their paths; None: the policy is of another kind."""
        for i, name in enumerate(self.labels):
            if i in self.below:
                yield from self.below[i].leaves()
            else:
                yield self._path + name, None if self.skills is None else self.skills.skills[i]
