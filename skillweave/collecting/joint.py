"""The collector of a hierarchy whose skills learn where they are called."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.call_end import CallEnd
from skillweave.collecting.decision_collector import DecisionCollector
from skillweave.collecting.guide import ActiveGuide
from skillweave.collecting.judge import judge, raw_columns, seen_by, terminated_in_call
from skillweave.collecting.levels import Level, NestedLevel, with_learners
from skillweave.collecting.skill_set import SkillSet
from skillweave.collecting.writer import BatchWriter
from skillweave.envs.engine import Engine, RawStep
from skillweave.errors import DeclarationError
from skillweave.experience import Batch
from skillweave.paths import CRITIC, SELECTOR, name_of
from skillweave.skills import Skill
from skillweave.spaces import action_codec
from skillweave.types import Array, Step


class JointCollector(DecisionCollector):
    """N environments in which a selector calls skills, and all learn from the same steps.

    A row is the skill's that acted in it, judged by its own reward and its own end. A trajectory of
    a skill goes on from call to call, where it is called again at once after a limit; elsewhere the
    end of a call cuts it, and its value goes on. A skill that is a hierarchy is judged in the same
    way; to its selector a row is a decision, as to the first selector.

    Args:
        engine: the environments.
        acting: the selector.
        skills: those that learn have any policy; ``UntrainedHierarchy`` where one is a hierarchy.
        learners: by path, all others who learn: ``skill``, ``inner/skill``, ``inner/selector``;
            ``skill_critic`` and ``inner/skill_critic`` say what skills are worth.
        margins: by the paths of critics: calls end where a new decision is worth this much more.
        guide, as_skill: as of ``DecisionCollector``.
    """

    def __init__(
        self,
        engine: Engine,
        acting: Acting | None,
        skills: SkillSet,
        learners: Mapping[str, Acting],
        margins: Mapping[str, float] | None = None,
        guide: ActiveGuide | None = None,
        as_skill: Skill | None = None,
    ) -> None:
        self.learners = dict(learners)
        acts = with_learners(skills, learners, margins or {})
        super().__init__(engine, acting, acts, guide=guide, as_skill=as_skill)
        self.root = Level(self, self.memory, self.player, learners)
        reflexes = any(level.skills.reflexes for level in self.root.all())
        self.overridden = np.zeros(self.num_envs, bool) if reflexes else None
        """(N,), where reflexes acted in the latest step; None: there are none."""
        self.kept["leaf"] = np.zeros(self.num_envs, np.int64)  # the latest that acted; 0: none yet
        self.ranges["leaf"] = range(self.root.end)
        self._fresh = np.zeros(self.num_envs, bool)  # the leaf that acts starts to
        self._rows: _Rows | None = None

    def like(self, engine: Engine, acting: Acting) -> Any:
        """Not possible: populations of hierarchies that learn as a whole are not built."""
        raise DeclarationError("hierarchies that learn as a whole do not evolve")

    def _collect(self, request: Request) -> dict[str, Batch]:
        self._rows = _Rows(self, request.rows)
        selectors = super()._collect(request)
        found = {SELECTOR: selectors[""]} if selectors else {}
        found |= {path: self._part(path) for path in self.learners}
        self._rows = None
        return found

    def _part(self, path: str) -> Batch:
        """Return what was collected for a learner."""
        name = name_of(path)
        level = next(x for x in self.root.all() if x.path == path.removesuffix(name))
        assert self._rows is not None
        if name == CRITIC:
            return self._rows.of_critic(level.path)
        if name == SELECTOR:
            assert isinstance(level, NestedLevel)
            return level.taken(self.obs)
        number = [s.name for s in level.skills.skills].index(name)
        return self._rows.of_leaf(level.leaves[number])

    def _prepare(self, request: Request) -> None:
        super()._prepare(request)
        self._gammas, self._request_raw = {}, request.record
        for path, acting in self.learners.items():
            acting.begin(request.below[path], every_step=False)
            self._gammas[path] = request.below[path].gamma.astype(np.float64).repeat(acting.each)

    def _act(self, obs: Array, mask: Array | None) -> Array:
        """Return the actions; which leaf acts, and what selectors below have chosen, is kept."""
        for level in self.root.all():
            if isinstance(level, NestedLevel) and level.selector is not None:
                level.selector.latest = None
        if self.overridden is not None:
            self.overridden[:] = False
            self._turn.overridden = self.overridden
        action = super()._act(obs, mask)
        leaf = self.root.leaf(self.memory, self._all)
        same = leaf == self.kept["leaf"]
        self._fresh, self.kept["leaf"][:] = ~same, leaf
        self._decided(self.root, self._all)
        if self._rows is not None:
            self._rows.go_on(same)
        return action

    def _decided(self, level: Level, ids: Array) -> None:
        """Keep what selectors below ``level`` have chosen in environments ``ids`` (k,)."""
        running = self.memory[f"{level.prefix}skill"][ids]
        for i, below in level.below.items():
            mine = ids[running == i]
            below.decided(self.obs, mine)
            self._decided(below, mine)

    def _record(self, step: Step, raw: RawStep, mask: Array | None, end: Array) -> None:
        """Keep the step for all who learn below the selector."""
        rows = self._rows
        assert rows is not None
        rows.goes_on[:] = False
        rows.shared.write(
            obs=step.obs,
            next_obs=step.next_obs,
            mask=mask,
            next_mask=self.engine.mask(),
            overridden=self.overridden,
            **self._raw(step),
        )
        rows.leaf[rows.shared.row], rows.fresh[rows.shared.row] = self.kept["leaf"], self._fresh
        truncated = raw.truncated & ~raw.terminated
        self._write_critic(self.root, self._all, raw.reward, raw.terminated, truncated)
        self._walk(self.root, self._all, step, end)
        rows.next()

    def _raw(self, step: Step) -> dict[str, Array]:
        """Return the raw columns of a step that learners ask for."""
        if not self._request_raw:
            return {}
        return raw_columns(step, self.root.elapsed(self.memory, self._all), self._request_raw)

    def _write_critic(
        self, level: Level, ids: Array, reward: Array, terminated: Array, truncated: Array
    ) -> None:
        """Write a step for a level's critic, in environments ``ids`` (k,) where the level acts."""
        assert self._rows is not None
        if (out := self._rows.critics.get(level.path)) is not None:
            out.write(
                ids,
                action=self.memory[f"{level.prefix}skill"][ids],
                reward=reward,
                terminated=terminated,
                truncated=truncated,
                call_start=self.memory[f"{level.prefix}elapsed"][ids] == 1,
            )
            self._rows.acts[level.path][out.row, ids] = True

    def _walk(self, level: Level, ids: Array, step: Step, end: Array) -> None:
        """Judge a step for the skills of a level, in environments ``ids`` (k,).

        Args:
            step: of all environments.
            end: (k,), why calls of these skills ended.
        """
        for i, rows in level.called(self.memory, ids):
            if i in level.learning:
                self._judge(level, i, ids[rows], step, end[rows])
            elif i in level.below:
                self._inside(level, i, ids[rows], step, end[rows])

    def _judge(self, level: Level, i: int, mine: Array, step: Step, end: Array) -> None:
        """Judge a step of skill ``i``, in environments ``mine`` (k,)."""
        assert self._rows is not None
        skill, part = level.skills.skills[i], self._part_of(level, i, mine, step)
        terminated = terminated_in_call(skill, part, end, mine)
        over = (end != CallEnd.RUNNING) & ~terminated
        latest = level.learning[i].latest
        assert latest is not None
        self._rows.shared.write(
            mine,
            action=latest.acted.action,
            reward=judge(skill, part, mine).reward,
            terminated=terminated,
            truncated=over,
        )
        self._rows.goes_on[mine] = over & (end != CallEnd.EPISODE) & ~part.timed_out
        self._rows.own[level.leaves[i]].write(mine, dist_params=latest.acted.dist_params)

    def _inside(self, level: Level, i: int, mine: Array, step: Step, end: Array) -> None:
        """Judge a step of skill ``i``, which is a hierarchy, and for all in it."""
        assert self._rows is not None
        below, part = level.below[i], self._part_of(level, i, mine, step)
        skill = level.skills.skills[i]
        reward = judge(skill, part, mine).reward
        terminated = terminated_in_call(skill, part, end, mine)
        over = (end != CallEnd.RUNNING) & ~terminated
        self._write_critic(below, mine, reward, terminated, over)
        if below.selector is not None:
            gamma = self._gammas[below.path + SELECTOR]
            own = self.memory[f"{below.prefix}end"][mine] != CallEnd.RUNNING
            closes = own | terminated | (end == CallEnd.EPISODE) | (over & part.timed_out)
            below.learn_from(mine, reward, terminated, over, part.next_obs, closes, gamma)
        self._walk(below, mine, step, below.ends(self.memory, mine, end))

    def _part_of(self, level: Level, i: int, mine: Array, step: Step) -> Step:
        """A step of environments ``mine`` (k,) as skill ``i`` of a level sees it."""
        elapsed = self.memory[f"{level.prefix}elapsed"][mine]
        return seen_by(level.skills.skills[i], step, elapsed, mine)


class _Rows:
    """Rows of leaves that learn, and of critics of skills, from the same steps."""

    def __init__(self, collector: JointCollector, rows: int) -> None:
        n, levels = collector.num_envs, list(collector.root.all())
        self.shared = BatchWriter(rows, n)
        """Of all leaves that learn: in each step exactly one acts."""
        codec = action_codec(collector.engine.action_space)  # all skills act in this space
        units = codec.from_env(np.asarray(codec.space.sample())[None])
        # These are there even if no leaf that learns acts.
        self.shared.column("action", units)
        self.shared.column("reward", np.zeros(1, np.float32))
        self.shared.column("terminated", _FLAG)
        self.shared.column("truncated", _FLAG)
        self.leaf = np.empty((rows, n), np.int64)
        """(T, N), which leaf acts."""
        self.fresh = np.empty((rows, n), bool)
        """(T, N), it starts to."""
        self.goes_on = np.zeros(n, bool)
        """(N,), the trajectory continues if the same leaf acts in the next step."""
        learning = [(x, i) for x in levels for i in x.learning]
        self.own = {x.leaves[i]: BatchWriter(rows, n) for x, i in learning}
        """By leaf, what is its alone."""
        self._states = {
            x.leaves[i]: collector.memory[f"{x.prefix}{i}.rnn"].copy()
            for x, i in learning
            if x.learning[i].acting.memory_size
        }
        critics = [level.path for level in levels if level.has_critic]
        self.critics = {path: BatchWriter(rows, n) for path in critics}
        """By the path of a level."""
        for out in self.critics.values():
            out.column("action", np.zeros(1, np.int64))
            out.column("reward", np.zeros(1, np.float32))
            for name in ("terminated", "truncated", "call_start"):
                out.column(name, _FLAG)
        self.acts = {path: np.zeros((rows, n), bool) for path in critics}
        """(T, N), the level acts."""

    def go_on(self, same: Array) -> None:
        """Continue trajectories where the ``same`` leaf (N,) acts again."""
        if self.shared.row:
            truncated = self.shared.column("truncated", _FLAG)
            truncated[self.shared.row - 1, self.goes_on & same] = False

    def next(self) -> None:
        """Start the next row."""
        for out in (self.shared, *self.own.values(), *self.critics.values()):
            out.next()

    def of_leaf(self, leaf: int) -> Batch:
        """Return what a leaf did."""
        state = self._states.get(leaf)
        return self.shared.batch(
            valid=self.leaf == leaf,
            dist_params=self.own[leaf].get("dist_params"),
            recurrent_state=state,
            episode_start=None if state is None else self.fresh,
        )

    def of_critic(self, path: str) -> Batch:
        """Return all steps of a level, for its critic."""
        out, acts = self.critics[path], self.acts[path]
        shared = {name: self.shared.get(name) for name in ("obs", "next_obs")}
        return out.batch(**shared, valid=None if acts.all() else acts)


_FLAG = np.zeros(1, bool)
