"""Episodes that were played, with their calls at all levels, for reports."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from skillweave.paths import join
from skillweave.planning.columns import ENDS, GOAL
from skillweave.planning.recorder import Recorder
from skillweave.policies.core import CallEnd
from skillweave.skills import Skill
from skillweave.skills.base import RecordedSkill
from skillweave.skills.goal_spaces import shown_goal
from skillweave.training.played_calls import PlayedCalls
from skillweave.types import Array


@dataclass(frozen=True)
class Call:
    """One call of a skill; the whole episode for a plain agent."""

    skill: int
    """A row of ``PlayedEpisodes.labels``."""
    start: int
    """Steps of the episode before it."""
    obs: Array
    """The observation of the selector's decision, (*obs_shape)."""
    steps: int
    why: str
    """``own``, ``limit``, ``interrupted`` or ``episode``, as in ``ENDS``."""
    reward: float
    """Sum of the environment's reward, not discounted."""
    own: float | None
    """Sum of the skill's own reward; None: unknown."""
    succeeded: bool | None
    """Result of the skill's ``success`` for the last step; None: it defines none."""
    goal: str = ""
    """Its goal in words; empty: it has none."""


@dataclass(frozen=True)
class Episode:
    """One episode, with all that it takes to play it again."""

    seed: int
    actions: Array  # (T, *action_shape)
    rewards: Array  # (T,) float32, the environment's
    calls: list[Call] = field(default_factory=list)
    """In the order of their starts."""
    cut: bool = False
    """True if it was cut at the step limit without an end."""

    @property
    def total(self) -> float:
        """Its return."""
        return float(self.rewards.sum(dtype=np.float64))


class PlayedEpisodes:
    """Episodes that were played, call by call: those of the skills that are no hierarchies.

    Args:
        played: with the skills' own rewards.
        seeds: of the episodes, in order.
    """

    def __init__(self, played: PlayedCalls, seeds: Sequence[int]) -> None:
        recorders = played.recorders()
        leaves = dict(_leaves(recorders))
        self.labels = tuple(leaves)
        self.skills = tuple(leaves.values()) if played.declared else ()
        log = recorders[""].log()
        episode = log.episode[log.owner]
        rows = np.lexsort((log.age[log.owner] + log.elapsed, episode))
        first = np.searchsorted(episode[rows], np.arange(len(seeds) + 1))
        self.episodes = [
            Episode(
                seed,
                log.action[rows[first[i] : first[i + 1]]],
                log.reward[rows[first[i] : first[i + 1]]],
                cut=i in played.cut,
            )
            for i, seed in enumerate(seeds)
        ]
        for path, recorder in recorders.items():
            self._add(path, recorder, leaves)
        for shown in self.episodes:
            shown.calls.sort(key=lambda call: call.start)

    def _add(self, path: str, recorder: Recorder, leaves: Mapping[str, Skill]) -> None:
        """Add the calls of one level."""
        skills, numbers = recorder.skills, list(leaves)
        for row in recorder.rows():
            skill = skills.skills[row["choice"] // max(1, len(skills.lengths))]
            if (name := join(path, skill.name)) not in leaves:
                continue
            judged = bool(self.skills) and not isinstance(skill, RecordedSkill)
            episode, start = self.episodes[row["episode"]], int(row["age"])
            goal = ""
            if (goals := recorder.goals.get(skill.name)) is not None:
                goal = shown_goal(goals.space.of_numbers(row[GOAL + skill.name][None])[0])
            steps = int(row["steps"])
            call = Call(
                numbers.index(name),
                start,
                row["start"],
                steps,
                ENDS[CallEnd(int(row["end_reason"]))],
                float(episode.rewards[start : start + steps].sum(dtype=np.float64)),
                float(row["own_return"]) if judged else None,
                bool(row["succeeded"]) if skill.defines("success") else None,
                goal,
            )
            episode.calls.append(call)


def _leaves(recorders: Mapping[str, Recorder], path: str = "") -> Iterator[tuple[str, Skill]]:
    """Yield the skills that are no hierarchies, by their paths."""
    for skill in recorders[path].skills.skills:
        name = join(path, skill.name)
        if name in recorders:
            yield from _leaves(recorders, name)
        else:
            yield name, skill
