"""The collector of a plain agent, or of a skill that learns by itself: a row is a step.

Stands alone because it is one of two collectors, beside ``hierarchy_collector``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.collector import SUCCESS, Collector
from skillweave.collecting.judge import judge, seen_by
from skillweave.collecting.skill_set import SkillSet, base_of
from skillweave.collecting.start_policy import StartPolicy
from skillweave.collecting.views import rows_of, steps_of, successes_of
from skillweave.collecting.writer import TraceWriter
from skillweave.envs.engine import Engine, RawStep
from skillweave.envs.infos import reported_success
from skillweave.errors import TrainingError
from skillweave.experience import INFO, Batch, Trace
from skillweave.policies.core import (
    LIMIT,
    OWN,
    RUNNING,
    Policy,
    Turn,
    World,
    end_with_episode,
    flat,
    observed,
    part_of,
    restart,
)
from skillweave.policies.parts import Reflexes
from skillweave.policies.spaces import space_of
from skillweave.skills import Reflex, Skill, asked
from skillweave.skills.goals import goals_of
from skillweave.skills.own_part import OwnPart
from skillweave.types import Array, Memory, Step

PATIENCE = 5_000
"""Steps of an environment in search of a state where the skill may start, if none is ever found."""
NAMED_SHARE = 0.5
"""Share of the episodes that start after a call of a named skill; the others start as usual, so
that what a skill can do from there is not forgotten."""


class SkillCollector(Collector):
    """Environments seen through a skill: its reward, its ends.

    After each end comes a real reset, but for a call that ended at the skill's limit where an
    episode has several.

    A skill's ``termination`` terminates the episode (nothing is worth anything after it), its
    ``max_steps`` truncates it (its value goes on). Where the skill may not start, skills that can
    act already are called until it may, while other environments go on; these rows are not valid.
    A number of such calls may also come first where it may start at once.

    A skill that has goals gets one where a call of it starts, by ``Skill.goals``, until it ends.

    Args:
        engine: the environments.
        acting: the learners.
        skill: None for the task itself: the environment's own reward and ends.
        reflexes: in force while the skill acts.
        starters: skills that can act already; None: random actions lead to where it may start.
        start_calls: the most calls of theirs that come first; their number is drawn evenly.
        search_steps: reset an episode in which the skill cannot start within this many steps; None:
            it goes on.
        episode_calls: the most calls of the skill in an episode.
        start_after: names among ``starters``; a call of one of them comes last before the skill
            starts in a share of the episodes.
        call_limit: the most steps of a call of the skill; None: its ``max_steps``.
        named_share: that share.
        part: the skill's own part of observations and actions; None: it has all.
    """

    def __init__(
        self,
        engine: Engine,
        acting: Acting | None,
        skill: Skill | None = None,
        reflexes: tuple[Reflex, ...] = (),
        starters: SkillSet | None = None,
        start_calls: int = 0,
        search_steps: int | None = None,
        episode_calls: int = 1,
        start_after: tuple[str, ...] = (),
        call_limit: int | None = None,
        named_share: float = NAMED_SHARE,
        part: OwnPart | None = None,
    ) -> None:
        super().__init__(engine)
        if acting is not None:
            self.acting = acting
        self.skill, self.reflexes = skill, reflexes
        self._reflexes = Reflexes(Policy(), reflexes, space_of(engine.action_space))
        self._start_calls = 0 if starters is None else start_calls
        self._search_steps, self._episode_calls = search_steps, episode_calls
        self._named_share = named_share
        self.call_limit = call_limit
        """The most steps of a call of the skill; None: any number."""
        if call_limit is None and skill is not None:
            self.call_limit = skill.max_steps
        n = self.num_envs
        self._never = np.zeros(n, bool)
        size = 0 if acting is None else acting.memory_size
        self.kept["memory"] = np.zeros((n, size), np.float32)  # the learner's
        self.kept["elapsed"] = np.zeros(n, np.int64)  # the skill's steps in the open episode
        if episode_calls > 1:
            self.kept["calls_made"] = np.zeros(n, np.int64)  # of the skill, in the open episode
        self._restricted = skill is not None and skill.defines("initiation")
        known = () if starters is None else (s.name for s in starters.skills)
        self._start_after = tuple(name for name in known if name in start_after)
        self._draws = self._start_calls > 0 or bool(self._start_after)
        """Whether calls come first is drawn for each episode."""
        self._searches = self._restricted or self._draws
        self._part = part
        holds = (part is not None and part.part.holds) or (
            starters is not None and starters.hierarchy.holds
        )
        self._last_actions = space_of(engine.action_space) if holds else None
        if self._last_actions is not None:
            self.kept["last_action"] = self._last_actions.start(n)
        self._base: Any = None
        if part is not None and part.base is not None:
            self._base = base_of(part, goals_of(skill))
            self._base_memory: Memory = self._base.start(n)
            self.kept |= flat(self._base_memory, "base.")
        self._goals = goals_of(skill)
        if self._goals is not None:
            self.kept["goal"] = self._goals.start(n)
            self.values["goal"] = self._goals
            self.kept["needs_goal"] = np.zeros(n, bool)  # a call of the skill starts
        self._asks = self._searches or (skill is not None and skill.defines("termination"))
        self._asks |= self._base is not None and self._base.watches
        """Something is asked about each step while it is made."""
        if self._searches:
            self.kept["searching"] = np.zeros(n, bool)  # the skill may not start yet
            self.kept["searched"] = np.zeros(n, np.int64)  # steps since it last might
            self.kept["found"] = np.zeros(n, bool)  # it ever might
            self.kept["calls_left"] = np.zeros(n, np.int64)  # that come first; −1: to be drawn
            if self._start_after:
                self.kept["named"] = np.zeros(n, bool)  # the last of these calls must be named
                self.kept["sought"] = np.zeros(n, np.int64)  # steps until one ended; −1: one has
            self._starters = StartPolicy(starters, n, engine.action_space, self._start_after)
            self.kept |= self._starters.kept
            self.values |= self._starters.values

    @property
    def memory(self) -> Array | None:
        """(N, M), the recurrent state of the learners; None: they have none."""
        return self.kept["memory"] if self.kept["memory"].shape[1] else None

    def like(self, engine: Engine, acting: Acting) -> SkillCollector:
        """Return a collector of the same kind over other environments."""
        starters = self._starters.skills if self._searches else None
        how = self._start_calls, self._search_steps, self._episode_calls, self._start_after
        return SkillCollector(
            engine,
            acting,
            self.skill,
            self.reflexes,
            starters,
            *how,
            self.call_limit,
            self._named_share,
            self._part,
        )

    def _prepare(self, request: Request) -> None:
        self.acting.begin(request)
        self._rng, self._record = (request.seeds / "search").numpy(), request.record
        self._goal_rng = None if self._goals is None else (request.seeds / "goals").numpy()
        self._before = None if self.memory is None else self.memory.copy()
        self._starts = self.kept["elapsed"] == 0

    def _writer(self, rows: int) -> TraceWriter:
        reads = self.skill is not None and any(map(self.skill.defines, self.skill.methods))
        reads |= any(name.startswith(INFO) for name in self._record)
        return TraceWriter(rows, self.num_envs, keep_infos=reads)

    def _step(self, out: TraceWriter) -> None:
        """One step of every environment."""
        if self._draws:
            self._draw_calls()
        obs, mask, memory, playing = self.obs, self.engine.mask(), self.memory, self._playing()
        goal, part = None, self._part
        own = seen = obs if part is None else part.part.see(obs)
        if self._goals is not None:
            goal = self._choose_goals(playing)
            seen = self._goals.join(own, goal)
        acted = self.acting.all(seen, mask if part is None else part.part.mask(mask), memory)
        action, overridden = self._actions(obs, own, goal, acted.action, mask, playing)
        out.write(
            obs=obs,
            action=acted.action,
            env_action=action,
            valid=playing,
            mask=mask,
            dist_params=acted.dist_params,
            overridden=overridden,
            goal=goal,
        )
        raw = self.engine.step(action)
        if self._last_actions is not None:
            self.kept["last_action"][:] = action
        self.kept["age"] += 1
        self.kept["elapsed"] += 1 if playing is None else playing
        step = raw.seen(obs, action, self.kept["age"].copy()) if self._asks else None
        if part is not None and step is not None and self._base is not None and self._base.watches:
            rows = self._all if playing is None else np.flatnonzero(playing)
            aim = None if goal is None else goal[rows]
            seen_step = part_of(step, self.kept["elapsed"][rows], rows, None, aim)
            self._base.observe(self._base_memory, rows, part.part.own_step(seen_step))
        end = self._ends(raw, step, playing, goal)
        out.write(
            next_obs=raw.next_obs,
            next_mask=self.engine.mask(),
            env_reward=raw.reward,
            env_terminated=raw.terminated,
            env_truncated=raw.truncated,
            call_elapsed=self.kept["elapsed"],
            call_end=end,
        )
        if memory is not None and acted.recurrent_state is not None:
            memory[:] = acted.recurrent_state
            if playing is not None:
                memory[~playing] = 0
        self.obs = raw.next_obs
        if len(called := np.flatnonzero(end)):
            success = None if self.skill is not None else reported_success(raw.info, self.num_envs)
            success = None if success is None else success[called]
            self._tell(out.row, called, raw.info, success, task=self.skill is not None)
            more = self._call_again(called[end[called] == LIMIT])
            self._begin_anew(np.setdiff1d(called, more) if len(more) else called)
        if step is not None and playing is not None:
            self._search(step, np.flatnonzero(~playing))
        out.next(raw.info)

    def _playing(self) -> Array | None:
        """Return where the skill acts, (N,) bool; None: everywhere."""
        if not self._searches or not self.kept["searching"].any():
            return None
        return ~self.kept["searching"]

    def _actions(
        self,
        obs: Array,
        own: Array,
        goal: Array | None,
        chosen: Array,
        mask: Array | None,
        playing: Array | None,
    ) -> tuple[Array, Array | None]:
        """Return the actions (N, …) of the skill, of reflexes, and of the search for its start.

        Args:
            own: its part of ``obs``.
            goal: of the skill, (N, …).
            chosen: what the learner chose, in policy units.

        Returns:
            The actions, and where reflexes act, (N,) bool; None: there are none.
        """
        action, overridden = self.acting.to_env(chosen), None
        last = self.kept.get("last_action")
        if self._part is not None:
            rows = self._all if playing is None else np.flatnonzero(playing)
            part = self._part.part
            action = part.write(self._corrected(action, own, goal, rows), last)
            part.check_mask(None if mask is None else mask[rows], action[rows])
        if self.reflexes:
            action, overridden = self._reflexes.over(obs, action)
        if playing is not None:
            searching, action = np.flatnonzero(~playing), action.copy()
            action[searching] = self._starters.act(
                searching, obs, mask, self._rng, self._last(), last
            )
        return action, overridden

    def _corrected(self, action: Array, own: Array, goal: Array | None, rows: Array) -> Array:
        """Return the actions (N, …) of the skill, added to those of the policy that it corrects.

        Args:
            own: (N, …), its part of the observation.
            goal: of the skill, (N, …).
            rows: (k,) where it acts; elsewhere what it corrects is 0.
        """
        if self._part is None or self._part.correction is None:
            return action
        base = np.zeros((self.num_envs, *(self._part.action_space.shape or ())), np.float64)
        if len(rows):
            turn = Turn(World(self._rng), None, None if goal is None else goal[rows])
            base[rows] = self._base.act(self._base_memory, rows, own[rows], turn)
        return self._part.correction.apply(base, action)

    def _search(self, step: Step, searching: Array) -> None:
        """Let environments ``searching`` (k,) go on until the skill may start in them."""
        over = (step.terminated | step.truncated)[searching]
        self._begin_anew(searching[over])
        ids = searching[~over]
        last, is_named = self._last(), self._never
        if last is not None:
            is_named = is_named.copy()
            is_named[ids] = self._starters.named(ids)
        free = self._starters.observe(ids, part_of(step, step.elapsed[ids], ids))
        left = self.kept["calls_left"]
        left[free] = np.maximum(left[free] - 1, 0)
        if last is not None:
            left[ids[last[ids] & ~is_named[ids]]] = 1  # another call must follow
            self._seek(ids)
        self._give_up(self._look(ids))

    def _last(self) -> Array | None:
        """Return where the next call must be a named skill's, (N,) bool; None: nowhere."""
        if not self._start_after:
            return None
        last: Array = self.kept["named"] & (self.kept["calls_left"] == 1)
        return last

    def _seek(self, ids: Array) -> None:
        """Count the steps in environments ``ids`` (k,) until a call of a named skill has ended."""
        sought = self.kept["sought"]
        named = ids[self.kept["named"][ids]]
        sought[named[self.kept["calls_left"][named] == 0]] = -1
        sought[named] += sought[named] >= 0
        if sought.max() > PATIENCE and sought.min() >= 0:
            assert self.skill is not None
            names = " or ".join(map(repr, self._start_after))
            raise TrainingError(
                f"skill {self.skill.name!r} is to start after a call of {names} (start_calls), but "
                f"none has ended in {PATIENCE:,} steps: perhaps its initiation() is never true, or "
                "its calls have no limit. Give it max_steps, or leave it out of start_calls"
            )

    def _choose_goals(self, playing: Array | None) -> Array:
        """Return the goals of all environments, (N, *goal_shape), after those of new calls."""
        assert self._goals is not None
        assert self._goal_rng is not None
        needs, kept = self.kept["needs_goal"], self.kept["goal"]
        ids = np.flatnonzero(needs if playing is None else needs & playing)
        if len(ids):
            kept[ids] = self._goals.draw(self.obs[ids], self._goal_rng)
            needs[ids] = False
        return kept

    def _ends(
        self, raw: RawStep, step: Step | None, playing: Array | None, goal: Array | None
    ) -> Array:
        """Return why the skill's call ended in each environment, (N,) int8; as of ``CallEnd``."""
        end, skill, elapsed = np.zeros(self.num_envs, np.int8), self.skill, self.kept["elapsed"]
        if self.call_limit is not None:
            end[elapsed >= self.call_limit] = LIMIT
        if skill is not None and step is not None:
            rows = self._all if playing is None else np.flatnonzero(playing)
            if len(rows):
                part = seen_by(
                    skill, step, elapsed[rows], rows, None if goal is None else goal[rows]
                )
                end[rows[judge(skill, part, rows).stops]] = OWN
        end_with_episode(end, raw.terminated | raw.truncated)
        if playing is not None:
            end[~playing] = RUNNING
        return end

    def _judge(self, trace: Trace) -> tuple[Batch, list[tuple[int, Array, Array]]]:
        acts, elapsed = trace.valid_rows, trace["call_elapsed"]
        goal = trace.get("goal")
        steps = steps_of(trace, self.skill, acts, elapsed, trace["call_end"], goal)
        each = np.empty((*trace.lead, 3))
        each[..., 0], each[..., 1], each[..., 2] = steps["reward"], trace["env_reward"] * acts, acts
        found = self._count(each)
        if self.skill is not None and self.skill.defines("success"):
            success = successes_of(trace, self.skill, acts, elapsed, goal)
            for row, ids, episodes in found:
                episodes[:, SUCCESS] = success[row, ids]
        return steps.replace(valid=trace.get("valid")), found

    def _views(self, trace: Trace, steps: Batch) -> dict[str, Batch]:
        elapsed = trace["call_elapsed"]
        batch = rows_of(trace, steps, "", elapsed, self._record, self._goals, self._part)
        if self._before is None:
            return {"": batch}
        starts = np.concatenate([self._starts[None], batch.ended[:-1]])
        if (valid := batch.get("valid")) is not None:  # the first row after a search
            starts[1:] |= valid[1:] & ~valid[:-1]
        return {"": batch.replace(recurrent_state=self._before, episode_start=starts)}

    def _call_again(self, limited: Array) -> Array:
        """The skill's calls in environments ``limited`` (k,) ended at its limit and nothing else.

        Returns:
            Those whose episodes go on: perhaps others are called next, and then the skill again.
        """
        if self._episode_calls == 1:
            return limited[:0]
        made = self.kept["calls_made"]
        ids = limited[made[limited] + 1 < self._episode_calls]
        age, calls = self.kept["age"][ids], made[ids] + 1
        last = self.kept["last_action"][ids] if self._last_actions is not None else None
        self._forget(ids)
        if last is not None:  # the episode goes on
            self.kept["last_action"][ids] = last
        self.kept["age"][ids], made[ids] = age, calls
        return ids

    def _draw_calls(self) -> None:
        """Draw how many calls of others come first, where an episode has just started."""
        ids = np.flatnonzero(self.kept["calls_left"] < 0)
        if len(ids):
            left = self._rng.integers(self._start_calls + 1, size=len(ids))
            if self._start_after:
                named = self._rng.random(len(ids)) < self._named_share
                self.kept["named"][ids] = named
                left += named
            self.kept["calls_left"][ids] = left
            self._look(ids)

    def _forget(self, ids: Array) -> None:
        keys = ("searched", "found", "sought")
        counted = {k: self.kept[k][ids] for k in keys if k in self.kept}
        super()._forget(ids)
        if self._last_actions is not None:
            self.kept["last_action"][ids] = self._last_actions.start(len(ids))
        if self._base is not None:
            restart(self._base, self._base_memory, ids)
        if self._goals is not None:
            self.kept["needs_goal"][ids] = True
        if self._searches:
            for name, value in counted.items():  # they count on from episode to episode
                self.kept[name][ids] = value
            self.kept["searching"][ids] = True
            self._starters.stop(ids)
            if self._draws:
                self.kept["calls_left"][ids] = -1
            else:
                self._look(ids)

    def _look(self, ids: Array) -> Array:
        """Find where the skill may start now among environments ``ids`` (k,) that search.

        Returns:
            Those in which it may not.
        """
        if not len(ids):
            return ids
        assert self.skill is not None
        holds = np.ones(len(ids), bool)
        if self._restricted:
            holds = asked(self.skill, "initiation", self.obs[ids], ids)
        found = ids[holds & (self.kept["calls_left"][ids] == 0)]
        waiting = ids[~holds]
        self.kept["searching"][found] = False
        self.kept["searched"][found] = 0
        self.kept["found"][found] = True
        self._starters.stop(found)
        self.kept["searched"][waiting] += 1
        if self.kept["searched"].max() > PATIENCE and not self.kept["found"].any():
            raise TrainingError(
                f"skill {self.skill.name!r}: initiation() was never true in {PATIENCE:,} steps "
                f"{self._sought()}, so there is nothing to train on; the latest observation was "
                f"{observed(self.obs[waiting[0]])}. Widen it; or put the skills that lead to where "
                "it holds before it in skills, as skills are trained in that order; or give an "
                "environment that starts where it holds"
            )
        return waiting

    def _give_up(self, waiting: Array) -> None:
        """Reset where it has waited for long enough: after a call of its own, at once."""
        enough = self._never[waiting]
        if self._search_steps is not None:
            enough = self.kept["age"][waiting] >= self._search_steps
        if self._episode_calls > 1:
            called = self.kept["calls_made"][waiting] > 0
            enough = np.where(called, self.kept["calls_left"][waiting] == 0, enough)
        self._begin_anew(waiting[enough])

    def _given_up(self) -> Array:
        if not self._searches:
            return self._never
        given_up: Array = self.kept["searched"] > PATIENCE
        return given_up

    def _sought(self) -> str:
        """Describe what searched for a start."""
        by = "random acting"
        if (skills := self._starters.skills) is not None:
            by = f"calling {', '.join(repr(s.name) for s in skills.skills)}"
        if self._search_steps is None:
            return f"of {by}"
        return f"of {by}, reset after {self._search_steps:,} of them (search_steps)"
