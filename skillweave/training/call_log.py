"""What happened in each episode of an evaluation, call by call, for reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from skillweave.collecting.calls import SkillSet, Why
from skillweave.skills.base import RecordedSkill
from skillweave.training.plain_agent import AGENT
from skillweave.training.play import Played
from skillweave.training.skill_report import ENDS, Judged, judge
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

    Args:
        seeds: of the episodes, in order.
    """

    def __init__(self, policy: Policy, seeds: Sequence[int]) -> None:
        self.labels = policy.labels or (AGENT,)
        found = getattr(policy, "skills", None)
        self._skills = found if isinstance(found, SkillSet) else None
        self.skills = () if self._skills is None else self._skills.skills
        self.episodes = [EpisodeLog(seed) for seed in seeds]

    def add(self, played: Played) -> None:
        """Write down one step of each environment."""
        judged = None
        if self._skills is not None and played.acting is not None:
            judged = judge(self._skills, played)
        for j, number in enumerate(played.episode):
            episode = self.episodes[number]
            # A policy of another kind does not say where calls begin.
            if not episode.calls or (played.begun is not None and played.begun[j]):
                skill = 0 if played.acting is None else int(played.acting[j])
                start = len(episode.rewards)
                episode.calls.append(Call(skill, start, np.array(played.step.obs[j])))
            call, reward = episode.calls[-1], float(played.reward[j])
            episode.actions.append(np.array(played.step.action[j]))
            episode.rewards.append(reward)
            episode.cut = bool(played.cut[j])
            call.steps += 1
            call.reward += reward
            if judged is not None:
                self._add_judged(call, judged, j)
            elif played.over[j]:
                call.why = ENDS[Why.EPISODE]

    def _add_judged(self, call: Call, judged: Judged, j: int) -> None:
        """Write down what the running skill says of a step."""
        assert self._skills is not None
        skill = self._skills.skills[call.skill]
        if not isinstance(skill, RecordedSkill):
            call.own = (call.own or 0.0) + float(judged.reward[j])
        if judged.why[j] != Why.RUNNING:
            call.why = ENDS[Why(int(judged.why[j]))]
            if skill.defines("success"):
                call.succeeded = bool(judged.succeeded[j])
