"""Learners of a collector's steps, and the rows of each: a plain agent, a skill, or levels.

``OneLearner`` and ``LevelLearners`` have the same methods.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.paths import CRITIC, SELECTOR
from skillweave.algorithms.batches import INFO, OF_STEP, Batch, Trace
from skillweave.envs.checked import LONGEST_EPISODE
from skillweave.envs.engine import Engine
from skillweave.experience.acting import Acting, Request
from skillweave.experience.decisions import OpenCalls
from skillweave.experience.levels import LearningLevel, own_memory, with_learners
from skillweave.experience.search import Starts
from skillweave.experience.views import (
    OwnSteps,
    call_successes,
    info_numbers_of,
    rows_of,
    with_others,
)
from skillweave.experience.writer import TraceWriter
from skillweave.policies.core import EPISODE, LIMIT, RUNNING, Array, RowPolicy, end_with_episode
from skillweave.policies.hierarchy import ActiveGuide
from skillweave.policies.leaves import Learning
from skillweave.skills import Reflex, Skill
from skillweave.skills.goals import Goals, goals_of
from skillweave.skills.own_part import OwnPart
from skillweave.skills.skill_set import SkillSet, acting_apart, acting_policy, within
from skillweave.spaces import action_codec

CALLS = (*OF_STEP, "elapsed", "skill", "call_elapsed", "call_end", "call_length")
"""The columns of a trace from which calls are logged."""


@dataclass(frozen=True)
class Alone:
    """One acting policy: of a plain agent, or of a skill that learns apart; a row is a step.

    A skill's ``termination`` terminates the episode (nothing is worth anything after it), its
    limit truncates it (its value goes on). Then comes a real reset, but for a call that ended at
    the limit where an episode has several.
    """

    skill: Skill | None = None
    """None: the task itself, the environment's own reward and ends."""
    reflexes: tuple[Reflex, ...] = ()
    """In force while it acts."""
    part: OwnPart | None = None
    """The skill's own part of observations and actions; None: it has all."""
    starts: Starts = field(default_factory=Starts)
    """Start of the skill's calls. Rows in which others act until it may start are not valid."""
    limit: int | None = None
    """The most steps of a call of the skill; None: its ``max_steps``."""


@dataclass(frozen=True)
class Calling:
    """A selector that calls skills, which may learn from the same steps; see ``LevelLearners``.

    No environment waits for another: where a call is over, the selector decides again, while the
    other calls go on. A call that is open when the rows are full goes on in the next request.
    """

    skills: SkillSet
    """The skills that the selector chooses from. Those that learn have a placeholder as policy,
    ``UntrainedHierarchy`` where one is a hierarchy."""
    guide: ActiveGuide | None = None
    """A ready selector that is asked wherever it decides."""
    skill: Skill | None = None
    """The skill that this hierarchy is in another one, whose reward and ends count; None: those of
    the task count."""
    keep_rewards: bool = False
    """Keep the reward of every step of each call, so that other learners may discount it with their
    own γ."""


class OneLearner:
    """A plain agent, or a skill that learns apart: its path is "", and a row is a step.

    Args:
        who: acts.
        engine: the environments.
        acting: the learner; None: nothing is to act.
    """

    def __init__(self, who: Alone, engine: Engine, acting: Acting | None) -> None:
        self._acting = acting
        self._part = who.part
        self._goals = goals_of(who.skill)
        self._space = engine.action_space if who.part is None else who.part.action_space
        leaf = RowPolicy() if acting is None else Learning(acting, "")
        space = engine.action_space
        self.policy = acting_apart(leaf, who.skill, who.part, who.reflexes, space)
        self.memory = self.policy.start(engine.num_envs)
        self._state: Array | None = own_memory(self.memory).get("rnn")
        self.kept: dict[str, Array] = {}
        self.seen_goals: dict[str, Goals] = {}
        self.whole = True
        self.overrides = bool(who.reflexes)

    def begin(self, request: Request, elapsed: Array) -> None:
        """Act by a request from now on; ``elapsed`` (N,) are steps of calls so far."""
        assert self._acting is not None
        self._acting.begin(request)
        self._record = request.record
        self._before = None if self._state is None else (self._state.copy(), elapsed == 0)

    def reads_infos(self) -> bool:
        """Return whether a skill below is judged by ``info``, or it is recorded."""
        return any(name.startswith(INFO) for name in self._record)

    def write(self, out: TraceWriter, end: Array, whole: bool) -> None:
        """Go on to the next row; see ``LevelLearners.write``."""
        assert self._acting is not None
        self._acting.row = out.row + 1

    def views(self, trace: Trace, steps: Batch) -> dict[str, Batch]:
        """Return the rows of the one learner, at the path "".

        Args:
            steps: as those who act are judged by them.
        """
        goes_on = steps["valid"] & ~steps.ended
        steps = steps.replace(valid=trace.get("valid"))
        calls = {"call_end": trace["end"], "call_elapsed": trace["elapsed"]}
        calls["own"] = np.ones(trace.lead, bool)
        batch = rows_of(trace, steps, "", self._record, self._goals, self._part, calls)
        return {"": _completed(batch, self._space, self._before, goes_on)}


class LevelLearners:
    """A selector that learns, and perhaps skills that learn from the same steps.

    To a selector a row is a decision: its reward is Σ γᵏ rₖ over the call, to be discounted by γ^τ
    afterwards (Sutton, Precup & Singh 1999, sec. 3). To a skill that learns it is a step in which
    the skill acted, judged by its own reward and its own end. A trajectory of a skill goes on from
    call to call, where it is called again at once after a limit; elsewhere the end of a call cuts
    it, and its value goes on. A skill that is a hierarchy is judged in the same way.

    Args:
        who: acts.
        engine: the environments.
        acting: the selector; None: a guide decides.
        learners: all others; None: the selector alone learns, at the path "".
        margins: see ``Collector``.
        shaped: see ``OpenCalls``.
    """

    def __init__(
        self,
        who: Calling,
        engine: Engine,
        acting: Acting | None,
        learners: Mapping[str, Acting] | None,
        margins: Mapping[str, float] | None,
        shaped: dict[str, Array],
    ) -> None:
        self._acting = acting
        self._together = learners is not None
        self._space, skills = engine.action_space, who.skills
        if learners is not None:
            skills = with_learners(skills, learners, margins or {})
        selector = None if acting is None else Learning(acting, SELECTOR, decides=True)
        goals = goals_of(who.skill)
        self.policy = acting_policy(skills, selector, who.guide, goals, outermost=False)
        self.memory = self.policy.start(engine.num_envs)
        """The policy's, of all environments; changed in place."""
        self.root = LearningLevel(
            skills, within(self.policy), self.memory, learners or {}, who.skill
        )
        self.levels = tuple(self.root.all())
        """The levels in which something learns."""
        self.whole = self._together or who.skill is not None
        """They learn from steps as a whole, not only from those where calls begin and end."""
        self.overrides = self._together and any(x.skill_set.reflexes for x in self.levels)
        """It counts for them where reflexes act."""
        self.kept: dict[str, Array] = {}
        """Arrays (N, …) that change when the steps of a request are judged."""
        self.seen_goals: dict[str, Goals] = {}
        """By names of open calls' observations, the goals that stand in them."""
        self._open: dict[str, OpenCalls] = {}  # by the paths of levels whose selectors learn
        for level in self.levels:
            if level.selector is not None or (
                level is self.root and level.hierarchy.selector is None
            ):
                calls = OpenCalls(level, shaped, keep_rewards=who.keep_rewards)
                self._open[level.path] = calls
                if level.goals is not None:
                    self.seen_goals[f"{level.path}obs"] = level.goals
                self.kept |= {level.path + name: value for name, value in calls.kept.items()}

    def begin(self, request: Request, elapsed: Array) -> None:
        """Act by a request from now on; ``elapsed`` (N,) are steps of the episodes so far."""
        self._gammas = dict[str, Array]()  # by path, (N,)
        self._records = {path: below.record for path, below in request.below.items()}
        if self._acting is not None:
            self._begin("", self._acting, request)
        for path, acting in self.root.learners.items():
            self._begin(path.removesuffix(SELECTOR), acting, request.below[path])
        self._states = dict(self._recurrent(elapsed))

    def _begin(self, path: str, acting: Acting, request: Request) -> None:
        """Let a learner act by a request."""
        acting.begin(request, every_step=False)
        self._gammas[path] = request.gamma.astype(np.float64).repeat(acting.each)

    def _recurrent(self, elapsed: Array) -> Iterator[tuple[str, tuple[Array, Array]]]:
        """Yield the paths of skills that learn with a recurrent network; see ``_completed``."""
        acted = {"": elapsed > 0}
        for level in self.levels:
            for i in (*level.learning, *level.below):
                path = level.path + level.skills[i].name
                acted[path + "/"] = acted[level.path] & (level.memory["skill"] == i)
                if i in level.learning and level.learning[i].net.memory_size:
                    rnn = own_memory(level.memory[str(i)])["rnn"]
                    yield path, (rnn.copy(), ~acted[path + "/"])

    def reads_infos(self) -> bool:
        """Return whether a skill below is judged by ``info``, or it is recorded."""
        judges = [level.skills[i] for level in self.levels for i in (*level.learning, *level.below)]
        judged = any(s.defines(method) for s in judges for method in ("reward", "termination"))
        return judged or any(x.startswith(INFO) for names in self._records.values() for x in names)

    def write(self, out: TraceWriter, end: Array, whole: bool) -> None:
        """Write into the trace which calls run after a step, and why others ended.

        Args:
            out: the trace.
            end: (N,) why episodes ended.
            whole: steps are recorded as a whole; else only where a selector decides and calls end.
        """
        for level in self.levels:
            path = level.path
            memory = level.memory
            guide = level.hierarchy.guide
            call_end = memory["end"]
            if level is self.root:
                call_end = call_end.copy()
                end_with_episode(call_end, end != RUNNING)
                if "length" in memory:
                    out.write(call_length=memory["length"])
            values = {"call_end": call_end}
            if whole:
                values |= {"skill": memory["skill"], "call_elapsed": memory["elapsed"]}
                for i in level.hierarchy.goals:
                    values[f"{level.skills[i].name}/goal"] = memory["goal"][str(i)]
            if guide is not None and level.selector is not None:
                every = np.ones((len(end), level.hierarchy.choices), bool)
                values["guide_allows"] = level.hierarchy.guided(memory, np.arange(len(end)), every)
                if guide.tells:
                    values["chances"] = memory["chances"]
            out.write(**{path + name: x for name, x in values.items()})

    def views(self, trace: Trace, steps: Batch) -> dict[str, Batch]:
        """Return the rows of each learner, by path.

        Args:
            steps: as those who act are judged by them.
        """
        self.root.hierarchy.check_lengths(self.root.memory, LONGEST_EPISODE)
        end = trace["call_end"]
        return dict(self._of_level(trace, self.root, steps, end, end != RUNNING))

    def log(self, trace: Trace, info: Sequence[str]) -> Batch:
        """Return a trace's steps with their calls, for a log of calls; ``info`` are its keys."""
        over = trace["call_end"] != RUNNING
        skills = self.root.skills
        goals = (f"{skill.name}/goal" for skill in skills)
        columns = {name: trace[name] for name in (*CALLS, *goals) if name in trace}
        columns["call_succeeded"] = call_successes(trace, skills, "", over)
        return Batch(**columns, **{INFO + key: info_numbers_of(trace, key) for key in info})

    def _of_level(
        self, trace: Trace, level: LearningLevel, steps: Batch, end: Array, closes: Array
    ) -> Iterator[tuple[str, Batch]]:
        """Yield the rows of a level's learners, by path, and of those below it.

        Args:
            steps: see ``OpenCalls.calls_of``.
            end: (T, N) int8, why calls of its skills ended, for what they learn.
            closes: see ``OpenCalls.calls_of``.
        """
        if level.path in self._open:
            gamma = self._gammas[level.path]
            calls = self._open[level.path].calls_of(trace, steps, closes, gamma)
            yield level.path + SELECTOR if self._together else "", calls
        if not self._together:
            return
        if level.path + CRITIC in level.learners:
            yield level.path + CRITIC, self._of_critic(trace, level, steps)
        for i, skill in enumerate(level.skills):
            acts = steps["valid"] & (trace[level.path + "skill"] == i)
            if i in level.learning:
                path = level.path + skill.name
                yield path, self._of_skill(trace, level, i, acts, end, steps["valid"])
            elif i in level.below:
                yield from self._of_level(trace, *self._inside(trace, level, i, acts, end))

    @staticmethod
    def _of_critic(trace: Trace, level: LearningLevel, steps: Batch) -> Batch:
        """Return the rows of a level's critic: all steps of the level."""
        acts = steps["valid"]
        running = trace[level.path + "skill"]
        seen = {name: level.seen(trace, name) for name in ("obs", "next_obs")}
        if own := level.hierarchy.goals:
            names = ((i, f"{level.path}{level.skills[i].name}/goal") for i in own)
            goals = {i: trace[name] for i, name in names}
            where = np.where(acts, running, -1)
            seen = {k: level.hierarchy.beside_calls(obs, where, goals) for k, obs in seen.items()}
        return steps.replace(
            **seen,
            action=np.where(acts, running, 0),
            steps=np.ones(trace.lead, np.int64),
            valid=None if acts.all() else acts,
            call_start=acts & (trace[level.path + "call_elapsed"] == 1),
        )

    def _of_skill(
        self, trace: Trace, level: LearningLevel, i: int, acts: Array, end: Array, anyone: Array
    ) -> Batch:
        """Return the rows of a skill that learns, judged by its own reward and ends.

        Args:
            acts: (T, N) bool, where it acts.
            end: see ``_of_level``.
            anyone: (T, N) bool, where it or another skill of its level acts.
        """
        skill = level.skills[i]
        part = level.skill_set.part(i)
        goals = level.hierarchy.goals.get(i)
        path = level.path + skill.name
        own = OwnSteps.of_skill(trace, level.path, skill, acts)
        steps = own.rows(end)
        # Elsewhere it is called again at once.
        ends = trace.ended | own.timed_out
        if own.goal is not None:  # with another goal another trajectory begins
            other = own.goal[1:] != own.goal[:-1]
            ends[:-1] |= other.any(axis=tuple(range(2, other.ndim)))
        steps["truncated"][:-1] &= ends[:-1] | ~acts[1:]
        calls = {"call_end": end, "call_elapsed": own.elapsed}
        record = self._records[path]
        batch = rows_of(trace, steps, f"{path}/", record, goals, part, calls)
        space = self._space if part is None else part.action_space
        batch = _completed(batch, space, self._states.get(path), acts & ~trace.ended)
        if "own" not in record:
            return batch
        return with_others(batch, trace, anyone, end, part, action_codec(space))

    @staticmethod
    def _inside(
        trace: Trace, level: LearningLevel, i: int, acts: Array, end: Array
    ) -> tuple[LearningLevel, Batch, Array, Array]:
        """Judge a skill that is a hierarchy; return the arguments of ``_of_level`` for it."""
        below = level.below[i]
        own = OwnSteps.of_skill(trace, level.path, level.skills[i], acts)
        steps = own.rows(end)
        over = trace.ended
        ended = trace[below.path + "call_end"]
        closes = (ended != RUNNING) | over | (steps["truncated"] & own.timed_out)
        if own.goal is not None:  # in its next call it decides again
            closes |= end != RUNNING
        # The hierarchy's own end cuts the calls below it, unless it is called again at once.
        cut = (ended == RUNNING) & (end != RUNNING)
        inner = np.where(over, np.int8(EPISODE), np.int8(LIMIT))
        return below, steps, np.where(cut, inner, ended), acts & (closes | steps["terminated"])


def _completed(
    batch: Batch, space: gym.Space[Any], before: tuple[Array, Array] | None, goes_on: Array
) -> Batch:
    """Return a learner's rows, with actions in all of them, and a recurrent network's state.

    Args:
        batch: (T, N).
        space: of the actions.
        before: a recurrent network's state before these rows, (N, M), and where it was empty, (N,)
            bool; None: it is not recurrent.
        goes_on: (T, N) bool, the state stays until the next row.
    """
    if "action" not in batch:
        batch = batch.replace(action=action_codec(space).zeros(*batch.lead))
    if before is None:
        return batch
    starts = np.concatenate([before[1][None], ~goes_on[:-1]])
    return batch.replace(recurrent_state=before[0], episode_start=starts)
