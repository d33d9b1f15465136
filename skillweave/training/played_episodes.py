"""Episodes that were played, with their calls at all levels, for reports."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from skillweave.paths import join
from skillweave.planning.columns import GOAL, OF_CALL
from skillweave.planning.recorder import SUMS, Recorder
from skillweave.skills import Skill
from skillweave.skills.goal_spaces import shown_goal
from skillweave.training.played_calls import PlayedCalls
from skillweave.types import Array


@dataclass(frozen=True)
class Episode:
    """One episode, with all that it takes to play it again."""

    seed: int
    actions: Array  # (T, *action_shape)
    rewards: Array  # (T,) float32, the environment's
    calls: Array
    """(C,) rows in the order of their starts; see ``PlayedEpisodes``."""
    cut: bool = False
    """True if it was cut at the step limit without an end."""

    @property
    def total(self) -> float:
        """Its return."""
        return float(self.rewards.sum(dtype=np.float64))


class PlayedEpisodes:
    """Episodes that were played, call by call: those of the skills that are no hierarchies.

    A call is a row of its recorder, with ``skill``, a row of ``labels``, and ``goal``, its goal in
    words, empty where it has none; without the numbers of goals and ``may_follow``. The whole
    episode of a plain agent is a call.

    Args:
        played: with the skills' own rewards.
        seeds: of the episodes, in order.
    """

    def __init__(self, played: PlayedCalls, seeds: Sequence[int]) -> None:
        recorders = played.recorders()
        leaves = dict(_leaves(recorders))
        self.labels = tuple(leaves)
        self.skills = tuple(leaves.values()) if played.declared else ()
        self.judged = tuple(skill.defines("success") for skill in leaves.values())
        """Of each label, whether its skill defines ``success``."""
        log = recorders[""].log()
        episode = log.episode[log.owner]
        rows = np.lexsort((log.age[log.owner] + log.elapsed, episode))
        numbers = np.arange(1, len(seeds))
        steps = np.split(rows, np.searchsorted(episode[rows], numbers))
        calls = np.concatenate([_calls(*level, self.labels) for level in recorders.items()])
        calls = calls[np.lexsort((calls["age"], calls["episode"]))]
        split = np.split(calls, np.searchsorted(calls["episode"], numbers))
        self.episodes = [
            Episode(seed, log.action[of], log.reward[of], split[i], i in played.cut)
            for i, (seed, of) in enumerate(zip(seeds, steps, strict=True))
        ]


def _calls(path: str, recorder: Recorder, labels: Sequence[str]) -> Array:
    """Return the calls of one level, as in ``PlayedEpisodes``."""
    rows = recorder.rows()
    kept = [(name, rows.dtype[name]) for name in (*dict((*SUMS, *OF_CALL)), "start")]
    calls = np.zeros(len(rows), [*kept, ("skill", np.int64), ("goal", object)])
    for name, _ in kept:
        calls[name] = rows[name]
    calls["skill"], calls["goal"] = -1, ""
    for i, skill in enumerate(recorder.skills.skills):
        if (name := join(path, skill.name)) in labels:
            mine = np.flatnonzero(recorder.skills.skill_of(rows["choice"]) == i)
            calls["skill"][mine] = labels.index(name)
            if (goals := recorder.goals.get(skill.name)) is not None:
                numbers = rows[GOAL + skill.name][mine]
                calls["goal"][mine] = [*map(shown_goal, goals.space.of_numbers(numbers))]
    return calls[calls["skill"] >= 0]


def _leaves(recorders: Mapping[str, Recorder], path: str = "") -> Iterator[tuple[str, Skill]]:
    """Yield the skills that are no hierarchies, by their paths."""
    for skill in recorders[path].skills.skills:
        name = join(path, skill.name)
        if name in recorders:
            yield from _leaves(recorders, name)
        else:
            yield name, skill
