"""The calls of episodes that are played, for evaluations and reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.collecting.skill_set import SkillSet, skills_below
from skillweave.envs.make import EnvSpec
from skillweave.paths import AGENT
from skillweave.planning.calls import CallLog
from skillweave.planning.recorder import Recorder, TraceFeed, calls_in, goals_in, levels_below
from skillweave.policies.core import EPISODE, RUNNING
from skillweave.skills import Skill
from skillweave.training.play import Played
from skillweave.types import Array, Memory, Policy


class PlayedCalls:
    """Recorders of the calls in episodes of ``play``: one for each level of a hierarchy.

    Where nothing but the step limit of ``play`` ends an episode, the call is cut as by the
    environment's time limit. Of a plain agent each episode is one call of ``agent``.

    Args:
        policy: that plays.
        spaces: of the environments' observations and actions.
        info: keys of ``info`` to record.
        own_rewards, inside, spec: see ``Recorder``.
    """

    def __init__(
        self,
        policy: Policy,
        spaces: tuple[gym.Space[Any], gym.Space[Any]],
        *,
        info: Sequence[str] = (),
        own_rewards: bool = False,
        inside: bool = True,
        spec: EnvSpec | None = None,
    ) -> None:
        skills = skills_below(policy)
        self.plain = skills is None
        """The policy has no skills."""
        self.cut: set[int] = set()
        """The episodes that were cut at the step limit."""
        agent: Skill = type(AGENT, (Skill,), {"name": AGENT})()
        self._levels = levels_below(SkillSet((agent,), (policy,)) if skills is None else skills)
        self._places = {
            path: [*map(str, above.values())] for path, (_, above) in self._levels.items()
        }
        self._goals = {path: goals_in(below) for path, (below, _) in self._levels.items()}
        self._spaces = spaces
        self._how: dict[str, Any] = {
            "info": info, "own_rewards": own_rewards, "inside": inside, "spec": spec,
        }  # fmt: skip
        self._feed: TraceFeed | None = None

    def add(self, played: Played) -> None:
        """Record a step of each environment; the first one is of all of them."""
        if self._feed is None:
            self._feed = TraceFeed(list(self._recorders(len(played.rows)).values()))
        step, over = played.step, played.over
        if played.cut.any():
            step = replace(step, truncated=step.truncated | played.cut)
            self.cut |= set(played.episode[played.cut].tolist())
        levels = {path: self._calls(path, played, over) for path in self._levels}
        self._feed.add(played.rows, step, levels)

    def recorders(self) -> dict[str, Recorder]:
        """Return the recorder of each level, by its path; all steps so far are recorded."""
        if self._feed is None:
            return self._recorders(0)
        self._feed.flush()
        return {recorder.path: recorder for recorder in self._feed.recorders}

    def logs(self, seeds: Sequence[int]) -> dict[str, CallLog]:
        """Return the log of each level, by its path; "": the outermost.

        Args:
            seeds: of the episodes, in order.
        """
        logs = {path: recorder.log() for path, recorder in self.recorders().items()}
        by_episode = np.array(seeds, np.int64)
        return {path: replace(log, seed=by_episode[log.episode]) for path, log in logs.items()}

    def _recorders(self, num_envs: int) -> dict[str, Recorder]:
        return {
            path: Recorder(skills, self._spaces, num_envs, path=path, above=above, **self._how)
            for path, (skills, above) in self._levels.items()
        }

    def _calls(self, path: str, played: Played, over: Array) -> Memory:
        """Return what a level's calls did in a step."""
        if self.plain:
            nothing = np.zeros(len(over), np.int64)
            end = np.where(over, np.int8(EPISODE), np.int8(RUNNING))
            return {"skill": nothing, "elapsed": played.step.elapsed, "end": end}
        memory = played.memory
        for place in self._places[path]:
            memory = memory[place]
        calls = calls_in(memory, self._goals[path], played.rows)
        if played.cut.any():  # the player sees the environment's own ends
            cut = played.cut & (calls["end"] == RUNNING)
            calls["end"] = np.where(cut, np.int8(EPISODE), calls["end"])
        return calls
