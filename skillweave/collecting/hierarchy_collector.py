"""The collector of a hierarchy: its selector learns from decisions, and skills perhaps from steps.

No environment waits for another: where a call is over, the selector decides again, while the other
calls go on. A call that is open when the rows are full goes on in the next batch.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.calls import OpenCalls
from skillweave.collecting.collector import Collector
from skillweave.collecting.judge import judge, seen_by
from skillweave.collecting.levels import Level, own_memory, with_learners
from skillweave.collecting.skill_set import SkillSet, acting_policy, within
from skillweave.collecting.views import (
    call_successes,
    info_numbers_of,
    rewards_of,
    rows_of,
    steps_of,
    timed_out,
)
from skillweave.collecting.writer import TraceWriter
from skillweave.envs.checks import LONGEST_EPISODE
from skillweave.envs.engine import Engine
from skillweave.errors import DeclarationError
from skillweave.experience import INFO, Batch, Trace
from skillweave.paths import CRITIC, SELECTOR
from skillweave.policies.core import (
    EPISODE,
    LIMIT,
    RUNNING,
    Turn,
    World,
    end_with_episode,
    flat,
    restart,
)
from skillweave.policies.hierarchy import ActiveGuide
from skillweave.policies.leaves import Learning
from skillweave.skills import Skill
from skillweave.skills.goals import goals_of
from skillweave.spaces import action_codec
from skillweave.types import Array, Step, prefixed

CALLS = (
    "obs",
    "env_action",
    "next_obs",
    "env_reward",
    "env_terminated",
    "env_truncated",
    "elapsed",
    "skill",
    "call_elapsed",
    "call_end",
    "call_limit",
)
"""The columns of a trace from which calls are logged."""


class HierarchyCollector(Collector):
    """N environments in which a selector calls skills, and all learn from the same steps.

    To a selector a row is a decision: its reward is Σ γᵏ rₖ over the call, to be discounted by γ^τ
    afterwards (Sutton, Precup & Singh 1999, sec. 3). To a skill that learns it is a step in which
    the skill acted, judged by its own reward and its own end. A trajectory of a skill goes on from
    call to call, where it is called again at once after a limit; elsewhere the end of a call cuts
    it, and its value goes on. A skill that is a hierarchy is judged in the same way.

    Args:
        engine: the environments.
        acting: the selectors that learn; None: the guide decides, or only ``like`` is to act.
        skills: what their actions mean; those that learn have any policy, ``UntrainedHierarchy``
            where one is a hierarchy.
        keep_rewards: of each call, keep the reward of every step, so that others may learn from it
            with a γ of their own.
        guide: a ready selector that is asked wherever they decide.
        as_skill: the skill that all of it is, in another hierarchy: its reward and its ends count;
            None: the environment's.
        learners: by path, all others who learn: ``skill``, ``inner/skill``, ``inner/selector``;
            ``skill_critic`` and ``inner/skill_critic`` say what skills are worth. None: the
            selector alone learns; its decisions have the path "" then, else ``selector``.
        margins: by the paths of critics: calls end where a new decision is worth this much more.
    """

    def __init__(
        self,
        engine: Engine,
        acting: Acting | None,
        skills: SkillSet,
        keep_rewards: bool = False,
        guide: ActiveGuide | None = None,
        as_skill: Skill | None = None,
        learners: Mapping[str, Acting] | None = None,
        margins: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(engine)
        n, self.learners = self.num_envs, dict(learners or {})
        self.skills = skills
        if learners is not None:
            self.skills = with_learners(skills, learners, margins or {})
        self.keep_rewards, self.guide, self.as_skill = keep_rewards, guide, as_skill
        self.acting = acting
        selector = None if acting is None else Learning(acting, SELECTOR, decides=True)
        self._goals = goals_of(as_skill)
        self.policy = acting_policy(self.skills, selector, guide, self._goals)
        self.memory = self.policy.start(n)
        """The policy's, of all environments; changed in place."""
        self.kept |= flat(self.memory, "player.")
        self.values |= prefixed("player", self.policy.values())
        if self._goals is not None:
            self.kept["goal"] = self._goals.start(n)
            self.values["goal"] = self._goals
            self.kept["needs_goal"] = np.ones(n, bool)  # an episode starts
        self.root = Level(self.skills, within(self.policy), self.memory, self.learners, self._goals)
        self.levels = tuple(self.root.all())
        """The levels in which something learns."""
        self._together = learners is not None
        self._whole = self._together or as_skill is not None
        """All learn from the steps, or what they are judged by needs them as a whole."""
        self._open: dict[str, OpenCalls] = {}  # by the paths of levels whose selectors learn
        for level in self.levels:
            if level.selector is not None or (
                level is self.root and level.hierarchy.selector is None
            ):
                calls = OpenCalls(level, n, self.open, keep_rewards=keep_rewards)
                self._open[level.path] = calls
                if level.goals is not None:
                    self.seen_goals[f"{level.path}obs"] = level.goals
                self._keep_after_request(level.path, calls.kept)
                if "action" in calls.kept:
                    self.values[f"{level.path}action"] = range(level.hierarchy.choices)
        self._recurrent = {
            level.path + level.skills[i].name: own_memory(level.memory[str(i)])["rnn"]
            for level in self.levels
            for i, learning in level.learning.items()
            if learning.net.memory_size
        }
        for path in self._recurrent:  # whether the skill acted in the latest step
            self._keep_after_request(f"{path}/", {"acted": np.zeros(n, bool)})
        reflexes = any(level.skill_set.reflexes for level in self.levels)
        self.overridden = np.zeros(n, bool) if reflexes and self._together else None
        """(N,), where reflexes acted in the latest step; None: not recorded."""

    def like(self, engine: Engine, acting: Acting) -> HierarchyCollector:
        """Return a collector of the same kind over other environments."""
        if self._together:
            raise DeclarationError("hierarchies that learn as a whole do not evolve")
        return HierarchyCollector(
            engine, acting, self.skills, self.keep_rewards, self.guide, self.as_skill
        )

    def _forget(self, ids: Array) -> None:
        super()._forget(ids)
        restart(self.policy, self.memory, ids)
        if self._goals is not None:
            self.kept["needs_goal"][ids] = True

    # Steps are made -----------------------------------------------------------------------------

    def _prepare(self, request: Request) -> None:
        self._record, self._gammas = request.record, dict[str, Array]()  # by path, (N,)
        if self.acting is not None:
            self._begin("", self.acting, request)
        for path, acting in self.learners.items():
            self._begin(path.removesuffix(SELECTOR), acting, request.below[path])
        self._states = {path: memory.copy() for path, memory in self._recurrent.items()}
        self._goal_rng = (request.seeds / "goals").numpy()
        rng = (request.seeds / "skills").numpy()
        self._world = World(rng, self.kept["age"], overridden=self.overridden)
        self._greedy = request.greedy

    def _begin(self, path: str, acting: Acting, request: Request) -> None:
        """Let a learner act by a request."""
        acting.begin(request, every_step=False)
        self._gammas[path] = request.gamma.astype(np.float64).repeat(acting.each)

    def _writer(self, rows: int) -> TraceWriter:
        judges = [level.skills[i] for level in self.levels for i in (*level.learning, *level.below)]
        root = self.skills.skills
        logs = self.log_calls is not None
        reads = self.as_skill is not None or any(name.startswith(INFO) for name in self._record)
        reads |= any(s.defines(method) for s in judges for method in ("reward", "termination"))
        reads |= logs and (bool(self.log_calls) or any(s.defines("success") for s in root))
        writer = TraceWriter(rows, self.num_envs, keep_infos=reads)
        self._world.trace = writer
        return writer

    def _step(self, out: TraceWriter) -> None:
        """One step of every environment."""
        obs, mask = self.obs, self.engine.mask()
        if self.overridden is not None:
            self.overridden[:] = False
        goal = self._goal(obs)
        turn = Turn(self._world, mask, goal, self._greedy)
        action = self.policy.act(self.memory, self._all, obs, turn)
        if self._records:
            out.write(goal=goal)
            out.write(obs=obs, env_action=action, mask=mask, overridden=self.overridden)
            for level in self.levels:
                out.write(**{level.path + "skill": level.memory["skill"]})
                for i in level.hierarchy.goals:
                    of_call = level.memory["goal"][str(i)]
                    out.write(**{f"{level.path}{level.skills[i].name}/goal": of_call})
        raw = self.engine.step(action)
        self.kept["age"] += 1
        step = raw.seen(obs, action, self.kept["age"].copy())
        if goal is not None:
            step = replace(step, goal=goal)
        self.policy.observe(self.memory, self._all, step)
        end = self.memory["end"].copy()
        terminated, truncated = self._ends(step, end)
        end_with_episode(end, terminated | truncated)
        ended = np.flatnonzero(terminated | truncated)
        self._write(out, step, end)
        out.write(terminated=terminated, truncated=truncated)
        self.obs = raw.next_obs
        if len(ended):
            success = judge(None, step).success
            succeeded = None if success is None else success[ended]
            self._tell(out.row, ended, raw.info, succeeded, task=False)
            self._begin_anew(ended)
        out.next(raw.info)

    def _goal(self, obs: Array) -> Array | None:
        """Return the hierarchy's goals, (N, …), after those of new episodes; None: it has none."""
        if self._goals is None:
            return None
        needs, kept = self.kept["needs_goal"], self.kept["goal"]
        if len(ids := np.flatnonzero(needs)):
            kept[ids] = self._goals.draw(obs[ids], self._goal_rng)
            needs[ids] = False
        return kept.copy()

    def _ends(self, step: Step, end: Array) -> tuple[Array, Array]:
        """Return where episodes are terminated, and truncated, (N,) bool each.

        Where all of it is a skill, its ends count. Where a call has ended and no skill may start,
        its own call ends, too; its value goes on.
        """
        if self.as_skill is None:
            return step.terminated, step.truncated & ~step.terminated
        own = seen_by(self.as_skill, step, step.elapsed, goal=step.goal)
        outcome = judge(self.as_skill, own, self._all)
        terminated, truncated = outcome.terminated, step.truncated | outcome.truncated
        if self.skills.hierarchy.restricts:
            waits = np.flatnonzero(end != RUNNING)
            truncated[waits] |= ~self.skills.hierarchy.may_start(step.next_obs[waits]).any(axis=1)
        return terminated, truncated & ~terminated

    def _write(self, out: TraceWriter, step: Step, end: Array) -> None:
        """Write what a step has led to, and why calls ended, (N,)."""
        for level in self.levels:
            path, memory, guide = level.path, level.memory, level.hierarchy.guide
            if self._records:
                ends = {"call_elapsed": memory["elapsed"], "call_end": memory["end"]}
                out.write(**{path + name: value for name, value in ends.items()})
            if guide is not None and level.selector is not None:
                every = np.ones((self.num_envs, level.hierarchy.choices), bool)
                allows = level.hierarchy.guided(memory, self._all, every)
                out.write(**{path + "guide_allows": allows})
                if guide.tells:
                    out.write(**{path + "chances": memory["chances"]})
        out.write(env_reward=step.reward, call_end=end)
        if self.log_calls is not None and "limit" in self.memory:
            out.write(call_limit=self.memory["limit"])
        if not self._records:
            over = np.flatnonzero(end)
            out.write(over, next_obs=step.next_obs[over])
            return
        out.write(
            next_obs=step.next_obs,
            next_mask=self.engine.mask(),
            env_terminated=step.terminated,
            env_truncated=step.truncated,
            elapsed=step.elapsed,
        )

    @property
    def _records(self) -> bool:
        """Steps are recorded as a whole; else only where the selector decides and calls end."""
        return self._whole or self.log_calls is not None

    # They are judged ----------------------------------------------------------------------------

    def _judge(self, trace: Trace) -> tuple[Batch, list[tuple[int, Array, Array]]]:
        every = np.ones(trace.lead, bool)
        reward = trace["env_reward"]
        if self.as_skill is not None:
            elapsed, goal = trace["elapsed"], trace.get("goal")
            reward = rewards_of(trace, self.as_skill, every, elapsed, goal)
        ends = {name: trace[name] for name in ("terminated", "truncated")}
        each = np.zeros((*trace.lead, 3))
        each[..., 0], each[..., 2] = reward, 1.0
        return Batch(reward=reward, **ends, valid=every), self._count(each)

    def _views(self, trace: Trace, steps: Batch) -> dict[str, Batch]:
        self.root.hierarchy.check_lengths(self.memory, LONGEST_EPISODE)
        self._world.trace = None  # only learners hold it from here on
        end = trace["call_end"]
        return dict(self._of_level(trace, self.root, steps, end, end != RUNNING))

    def _calls(self, trace: Trace, info: Sequence[str]) -> Batch:
        over = trace["call_end"] != RUNNING
        goals = (f"{skill.name}/goal" for skill in self.skills.skills)
        columns = {name: trace[name] for name in (*CALLS, *goals) if name in trace}
        columns["call_succeeded"] = call_successes(trace, self.skills.skills, "", over)
        return Batch(**columns, **{INFO + key: info_numbers_of(trace, key) for key in info})

    def _of_level(
        self, trace: Trace, level: Level, steps: Batch, end: Array, closes: Array
    ) -> Iterator[tuple[str, Batch]]:
        """Yield what the learners of a level did, by path, and of those below it.

        Args:
            steps, closes: see ``OpenCalls.calls_of``.
            end: (T, N) int8, why calls of its skills ended, for what they learn.
        """
        if level.path in self._open:
            gamma = self._gammas[level.path]
            calls = self._open[level.path].calls_of(trace, steps, closes, gamma)
            yield level.path + SELECTOR if self._together else "", calls
        if not self._together:
            return
        if level.path + CRITIC in self.learners:
            yield level.path + CRITIC, self._of_critic(trace, level, steps)
        for i, skill in enumerate(level.skills):
            acts = steps["valid"] & (trace[level.path + "skill"] == i)
            if i in level.learning:
                yield level.path + skill.name, self._of_skill(trace, level, skill, acts, end)
            elif i in level.below:
                yield from self._of_level(trace, *self._inside(trace, level, i, acts, end))

    @staticmethod
    def _of_critic(trace: Trace, level: Level, steps: Batch) -> Batch:
        """Return all steps of a level, for its critic."""
        acts, running = steps["valid"], trace[level.path + "skill"]
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

    def _of_skill(self, trace: Trace, level: Level, skill: Skill, acts: Array, end: Array) -> Batch:
        """Return what a skill that learns did, judged by its own reward and ends."""
        path, elapsed = level.path + skill.name, trace[level.path + "call_elapsed"]
        goal, goals = (
            trace.get(f"{path}/goal"),
            level.hierarchy.goals.get(level.skills.index(skill)),
        )
        steps = steps_of(trace, skill, acts, elapsed, end, goal)
        # Elsewhere it is called again at once.
        ends = trace.ended | timed_out(trace, skill, elapsed)
        if goal is not None:  # with another goal another trajectory begins
            other = goal[1:] != goal[:-1]
            ends[:-1] |= other.any(axis=tuple(range(2, other.ndim)))
        steps["truncated"][:-1] &= ends[:-1] | ~acts[1:]
        part = level.skill_set.part(level.skills.index(skill))
        batch = rows_of(trace, steps, f"{path}/", elapsed, self._record, goals, part)
        if "action" not in batch:
            space = self.engine.action_space if part is None else part.action_space
            batch = batch.replace(action=action_codec(space).zeros(*trace.lead))
        if path not in self._states:
            return batch
        before = self.kept[f"{path}/acted"]
        goes_on = acts & ~trace.ended
        starts = ~np.concatenate([before[None], goes_on[:-1]])
        before[:] = goes_on[-1]
        return batch.replace(recurrent_state=self._states[path], episode_start=starts)

    @staticmethod
    def _inside(
        trace: Trace, level: Level, i: int, acts: Array, end: Array
    ) -> tuple[Level, Batch, Array, Array]:
        """Judge a skill that is a hierarchy; return the arguments of ``_of_level`` for it."""
        skill, below = level.skills[i], level.below[i]
        elapsed, goal = trace[level.path + "call_elapsed"], trace.get(f"{below.path}goal")
        steps = steps_of(trace, skill, acts, elapsed, end, goal)
        own = trace[below.path + "call_end"]
        limited = steps["truncated"] & timed_out(trace, skill, elapsed)
        over = trace.ended
        closes = (own != RUNNING) | over | limited
        if goal is not None:  # in its next call it decides again
            closes |= end != RUNNING
        # The hierarchy's own end cuts the calls below it, unless it is called again at once.
        cut = (own == RUNNING) & (end != RUNNING)
        inner = np.where(over, np.int8(EPISODE), np.int8(LIMIT))
        return below, steps, np.where(cut, inner, own), acts & (closes | steps["terminated"])
