"""The calls of played episodes, for evaluations and reports, and these episodes themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.paths import AGENT, join, level_of, names_in
from skillweave._internal.policy_protocol import Memory, Policy
from skillweave.calls.columns import GOAL, OF_CALL
from skillweave.calls.log import CallLog
from skillweave.calls.recorder import SUMS, Recorder, TraceFeed, calls_in, goals_in, levels_below
from skillweave.envs.make import EnvSpec
from skillweave.experience.play import PlayedStep
from skillweave.experience.views import seen_by, stops
from skillweave.policies.core import EPISODE, LIMIT, OWN, RUNNING, Array, end_with_episode
from skillweave.policies.parts import OWN_GOAL
from skillweave.skills import Reflex, Skill, call_method
from skillweave.skills.base import RecordedSkill
from skillweave.skills.goal_spaces import shown_goal
from skillweave.skills.skill_set import SkillSet, skills_below

WAITS, IS_DONE = -1, -2
"""In place of the steps of the call of a skill that acts alone."""


class PlayedCalls:
    """Recorders of the calls in episodes of ``play``: one for each level of a hierarchy.

    Where nothing but the step limit of ``play`` ends an episode, the call is cut as by the
    environment's time limit. Of a plain agent each episode is one call of ``agent``.

    A skill that acts alone has one call in each episode. It starts where the skill may start,
    usually at the episode's start, and ends by its ``termination``, at its ``max_steps``, or with
    the episode. The skill acts on after it, but only the call counts: a skill that is called again
    where its work is done would succeed each time.

    Args:
        policy: the policy that plays.
        spaces: of the environments' observations and actions.
        info: keys of ``info`` to record.
        own_rewards, inside, steps, spec: see ``Recorder``.
    """

    def __init__(
        self,
        policy: Policy,
        spaces: tuple[gym.Space[Any], gym.Space[Any]],
        *,
        info: Sequence[str] = (),
        own_rewards: bool = False,
        inside: bool = True,
        steps: bool = True,
        spec: EnvSpec | None = None,
    ) -> None:
        acts: Any = policy
        skills = skills_below(policy)
        skill = getattr(policy, "skill", None)
        self.alone: Skill | None = None
        """The skill that acts alone; None: the whole policy acts."""
        self.prefix = ""
        """The level of the skill that acts alone."""
        if isinstance(skill, Skill):
            self.alone = skill
            skills = SkillSet((skill,), (acts.policy,), acts.reflexes)
            self.prefix = level_of(acts.path)
        self.declared = skills is not None
        """The declarations of its skills are known."""
        if skills is None:  # it may still say by names what acts in it
            names = policy.labels or (AGENT,)
            named = tuple(type(name, (RecordedSkill,), {"name": name})() for name in names)
            skills = SkillSet(named, (policy,) * len(named))
        self._named = bool(policy.labels)
        self.steps = np.zeros(len(skills.skills), np.int64)
        """Steps of each skill of which nothing is declared: not all may be in calls."""
        self.cut: set[int] = set()
        """The episodes that were cut at the step limit."""
        self._levels = levels_below(skills)
        self._goals = {path: goals_in(below) for path, (below, _) in self._levels.items()}
        self._spaces = spaces
        self._how: dict[str, Any] = {"info": info, "own_rewards": own_rewards, "spec": spec}
        self._how |= {"inside": inside, "steps": steps}
        self._feed: TraceFeed | None = None
        self._tau = np.zeros(0, np.int64)  # of the call of a skill that acts alone, (N,)
        levels = self._levels.items()
        self.reflexes = {
            self._named_at(p, r): 0 for p, (level, _) in levels for r in level.reflexes
        }
        """Steps in which each reflex acted, by its path."""

    def add(self, played: PlayedStep) -> None:
        """Record a step of each environment; the first one is of all of them."""
        if self._feed is None:
            self._feed = TraceFeed(list(self._recorders(len(played.rows)).values()))
            self._tau = np.zeros(len(played.rows), np.int64)
        step = played.step
        if played.cut.any():
            step = replace(step, truncated=step.truncated | played.cut)
            self.cut |= set(played.episode[played.cut].tolist())
        levels = {path: self._calls(path, played) for path in self._levels}
        self._count_reflexes(played, levels)
        if self.alone is not None:  # calls below it that ran before count from there
            starts = levels[""]["elapsed"] == 1
            for calls in levels.values():
                calls["start"] = starts | (calls["elapsed"] == 1)
        self._feed.add(played.rows, step, levels)

    def skills(self, path: str = "") -> dict[str, Skill]:
        """Return the skills of a level and of those below it, by path: each before its own."""
        found = {}
        for skill in self._levels[path][0].skills:
            found[name := join(path, skill.name)] = skill
            found |= self.skills(name) if name in self._levels else {}
        return found

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
        limit = logs[""].time_limit
        return {
            path: replace(log, seed=by_episode[log.episode], known_time_limit=limit)
            for path, log in logs.items()
        }

    def _recorders(self, num_envs: int) -> dict[str, Recorder]:
        """Return a recorder for each level, by its path."""
        recorders = {
            path: Recorder(skills, self._spaces, num_envs, path=path, above=above, **self._how)
            for path, (skills, above) in self._levels.items()
        }
        if self.alone is not None:
            recorders[""].endless[:] = False
            recorders[""].limits = (self.alone.max_steps,)
        return recorders

    def _calls(self, path: str, played: PlayedStep) -> Memory:
        """Return the calls of a level in a step, by columns of a recorder."""
        if self.alone is not None and not path:
            return self._of_alone(self.alone, played)
        if not self.declared:
            end = np.where(played.over, np.int8(EPISODE), np.int8(RUNNING))
            calls = {"skill": np.zeros(len(end), np.int64), "elapsed": played.step.elapsed}
            if self._named and (acting := played.acting) is not None:
                calls |= {"skill": acting, "start": played.call_start}
                self.steps += np.bincount(acting, minlength=len(self.steps))
            return calls | {"end": end}
        memory = played.memory
        for level, place in self._levels[path][1].items():
            if level or self.alone is None:
                memory = memory[str(place)]
        calls = calls_in(memory, self._goals[path], played.rows)
        if played.cut.any():  # the player sees the environment's own ends
            cut = played.cut & (calls["end"] == RUNNING)
            calls["end"] = np.where(cut, np.int8(EPISODE), calls["end"])
        return calls

    def _of_alone(self, skill: Skill, played: PlayedStep) -> Memory:
        """Return the calls of a skill that acts alone, by columns of a recorder."""
        rows, step = played.rows, played.step
        tau = self._tau[rows]
        tau[step.elapsed == 1] = WAITS
        if len(waiting := np.flatnonzero(tau == WAITS)):
            may = call_method(skill, "initiation", step.obs[waiting], rows[waiting])
            tau[waiting[may]] = 0
        runs = np.flatnonzero(tau >= 0)
        tau[runs] += 1
        end = np.full(len(rows), RUNNING, np.int8)
        goal = None
        if skill.goal_space is not None:
            goal = played.memory[OWN_GOAL][rows]
        if skill.max_steps is not None:
            end[tau >= skill.max_steps] = LIMIT
        if len(runs):
            own = None if goal is None else goal[runs]
            seen = seen_by(skill, step, tau[runs], runs, own)
            end[runs[stops(skill, seen, rows[runs])]] = OWN
        end_with_episode(end, played.over & ~played.cut)
        end[played.cut & (end == RUNNING)] = EPISODE
        self._tau[rows] = np.where(end == RUNNING, tau, IS_DONE)
        calls = {"skill": np.where(tau >= 0, 0, -1), "elapsed": tau, "end": end}
        return calls if goal is None else calls | {f"{skill.name}/goal": goal}

    def _named_at(self, path: str, reflex: Reflex) -> str:
        """Return the path of a reflex: a skill that acts alone is no level of it."""
        return join(*names_in(path)[self.alone is not None :], str(reflex.name))

    def _count_reflexes(self, played: PlayedStep, levels: dict[str, Memory]) -> None:
        """Count the reflexes that acted: where several hold, the last of the outermost level."""
        if not self.reflexes:
            return
        acted = np.zeros(len(played.rows), bool)
        for path, (skills, above) in self._levels.items():
            here = np.ones(len(acted), bool)
            for level, place in above.items():
                if level or self.alone is None:
                    here &= levels[level]["skill"] == place
            for reflex in reversed(skills.reflexes):
                rows = np.flatnonzero(here)
                holds = np.flatnonzero(reflex.holds(played.step.obs[rows]) & ~acted[rows])
                self.reflexes[self._named_at(path, reflex)] += len(holds)
                acted[rows[holds]] = True


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
        leaves = {k: skill for k, skill in played.skills().items() if k not in recorders}
        self.labels = tuple(leaves)
        self.skills = tuple(leaves.values()) if played.declared else ()
        self.judged = tuple(skill.defines("success") for skill in leaves.values())
        """Of each label, whether its skill defines ``success``."""
        log = recorders[""].log()
        episode = log.episode[log.owner]
        rows = np.lexsort((log.age[log.owner] + log.elapsed, episode))
        numbers = np.arange(1, len(seeds))
        steps = np.split(rows, np.searchsorted(episode[rows], numbers))
        calls = np.concatenate([_level_calls(*level, self.labels) for level in recorders.items()])
        calls = calls[np.lexsort((calls["age"], calls["episode"]))]
        split = np.split(calls, np.searchsorted(calls["episode"], numbers))
        self.episodes = [
            Episode(seed, log.action[of], log.reward[of], split[i], i in played.cut)
            for i, (seed, of) in enumerate(zip(seeds, steps, strict=True))
        ]


def _level_calls(path: str, recorder: Recorder, labels: Sequence[str]) -> Array:
    """Return the calls of one level, as in ``PlayedEpisodes``."""
    rows = recorder.rows()
    kept = [(name, rows.dtype[name]) for name in (*dict((*SUMS, *OF_CALL)), "start")]
    calls = np.zeros(len(rows), [*kept, ("skill", np.int64), ("goal", object)])
    for name, _ in kept:
        calls[name] = rows[name]
    calls["skill"] = -1
    calls["goal"] = ""
    for i, skill in enumerate(recorder.skills.skills):
        if (name := join(path, skill.name)) in labels:
            mine = np.flatnonzero(recorder.skills.skill_of(rows["choice"]) == i)
            calls["skill"][mine] = labels.index(name)
            if (goals := recorder.goals.get(skill.name)) is not None:
                numbers = rows[GOAL + skill.name][mine]
                calls["goal"][mine] = [*map(shown_goal, goals.space.of_numbers(numbers))]
    return calls[calls["skill"] >= 0]
