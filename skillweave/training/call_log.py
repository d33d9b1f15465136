"""What happened in each episode of an evaluation, call by call, for reports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from skillweave.collecting.calls import skills_below
from skillweave.collecting.ends import CallEnd
from skillweave.skills import Skill
from skillweave.skills.base import RecordedSkill
from skillweave.training.plain_agent import AGENT
from skillweave.training.play import Played
from skillweave.training.skill_report import ENDS, Judged, judged_step, played_below
from skillweave.types import Array, Policy


@dataclass
class Call:
    """One call of a skill; of a plain agent, the whole episode is one."""

    skill: int
    """A row of ``CallLog.labels``."""
    start: int
    """Steps of the episode before it."""
    obs: Array
    """What the selector saw when it decided, (*obs_shape)."""
    steps: int = 0
    why: str | None = None
    """``own``, ``limit``, ``interrupted`` or ``episode``, as in ``ENDS``; None: not known."""
    reward: float = 0.0
    """Sum of the environment's reward, not discounted."""
    own: float | None = None
    """Sum of the skill's own reward; None: not known."""
    succeeded: bool | None = None
    """What its ``success`` says of its last step; None: it defines none."""


@dataclass
class EpisodeLog:
    """One episode."""

    seed: int
    """Given the same actions, it can be played again."""
    calls: list[Call] = field(default_factory=list)
    actions: list[Array] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    """The environment's, of each step."""
    cut: bool = False
    """Nothing had ended it when it became too long."""

    @property
    def total(self) -> float:
        """Its return."""
        return float(sum(self.rewards))


class CallLog:
    """Writes down the calls of episodes as ``evaluate(..., watch=log.add)`` plays them.

    Where a skill is a hierarchy, the calls are those of its own skills, by their paths.

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
        """Write down one step of each environment."""
        if played.acting is None:
            self._write(played, np.zeros(len(played.episode), np.int64), None)
        else:
            self._add(played, self._root)

    def _add(self, played: Played, level: _Level) -> None:
        """Write down a step of environments in which the skills of a level act."""
        assert played.acting is not None
        judged = None if level.skills is None else judged_step(level.skills, played)
        leaf = np.array([level.numbers.get(i, 0) for i in range(len(level.labels))])[played.acting]
        here = ~np.isin(played.acting, list(level.below))
        self._write(played, leaf, judged, np.flatnonzero(here))
        for i, below in level.below.items():
            if len(rows := np.flatnonzero(played.acting == i)):
                self._add(played_below(played, i, rows), below)

    def _write(
        self, played: Played, leaf: Array, judged: Judged | None, rows: Array | None = None
    ) -> None:
        """Write down a step of ``rows`` (m,), None: all; ``leaf`` (k,) acts in it."""
        for j in range(len(played.episode)) if rows is None else rows:
            episode = self.episodes[played.episode[j]]
            last = episode.calls[-1] if episode.calls else None
            # A policy of another kind does not say where calls begin.
            begun = played.begun is not None and bool(played.begun[j])
            if last is None or begun or last.skill != leaf[j]:
                if last is not None and judged is not None and last.why is None:
                    last.why = ENDS[CallEnd.LIMIT]  # its hierarchy was called no more
                start = len(episode.rewards)
                episode.calls.append(Call(int(leaf[j]), start, np.array(played.step.obs[j])))
            call, reward = episode.calls[-1], float(played.reward[j])
            episode.actions.append(np.array(played.step.action[j]))
            episode.rewards.append(reward)
            episode.cut = bool(played.cut[j])
            call.steps += 1
            call.reward += reward
            if judged is not None:
                self._add_judged(call, judged, int(j))
            elif played.over[j]:
                call.why = ENDS[CallEnd.EPISODE]

    def _add_judged(self, call: Call, judged: Judged, j: int) -> None:
        """Write down what the running skill says of a step."""
        skill = self.skills[call.skill]
        if not isinstance(skill, RecordedSkill):
            call.own = (call.own or 0.0) + float(judged.reward[j])
        if judged.why[j] != CallEnd.RUNNING:
            call.why = ENDS[CallEnd(int(judged.why[j]))]
            if skill.defines("success"):
                call.succeeded = bool(judged.succeeded[j])


class _Level:
    """The skills of a policy, and of hierarchies among them.

    Args:
        path: of the skills: empty, or ``inner/`` for example.
        first: the number of the first of them that is no hierarchy, among all.
    """

    def __init__(self, policy: Policy, path: str = "", first: int = 0) -> None:
        self.labels, self._path, self.skills = policy.labels, path, skills_below(policy)
        self.numbers: dict[int, int] = {}
        """By a skill's number, its number among all."""
        self.below: dict[int, _Level] = {}
        for i, name in enumerate(self.labels):
            own = None if self.skills is None else self.skills.policies[i]
            if own is not None and skills_below(own) is not None:
                self.below[i] = _Level(own, f"{path}{name}/", first)
                first += len(list(self.below[i].leaves()))
            else:
                self.numbers[i], first = first, first + 1

    def leaves(self) -> Iterator[tuple[str, Skill | None]]:
        """The skills that act, by their paths; None: of a policy of another kind."""
        for i, name in enumerate(self.labels):
            if i in self.below:
                yield from self.below[i].leaves()
            else:
                yield self._path + name, None if self.skills is None else self.skills.skills[i]
