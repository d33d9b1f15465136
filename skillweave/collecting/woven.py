"""The collector of a hierarchy whose skills learn where they are called."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.calls import SkillSet
from skillweave.collecting.decisions import DecisionCollector
from skillweave.collecting.ends import CallEnd
from skillweave.collecting.guide import ActiveGuide
from skillweave.collecting.judge import judge, seen_by, terminated_in_call
from skillweave.collecting.levels import CRITIC, SELECTOR, Level, NestedLevel, with_learners
from skillweave.collecting.woven_rows import Rows
from skillweave.envs.engine import Engine, RawStep
from skillweave.errors import DeclarationError
from skillweave.experience import Batch
from skillweave.skills import Skill
from skillweave.types import Array, Step


class WovenCollector(DecisionCollector):
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
        margins: by the paths of critics: calls are cut where deciding anew is worth so much more.
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
        self._rows: Rows | None = None

    def like(self, engine: Engine, acting: Acting) -> Any:
        """Not possible: populations of hierarchies that learn as a whole are not built."""
        raise DeclarationError("hierarchies that learn as a whole do not evolve")

    def _collect(self, request: Request) -> dict[str, Batch]:
        self._rows = Rows(self, request.rows, self.root.all())
        selectors = super()._collect(request)
        found = {SELECTOR: selectors[""]} if selectors else {}
        found |= {path: self._part(path) for path in self.learners}
        self._rows = None
        return found

    def _part(self, path: str) -> Batch:
        """What was collected for a learner."""
        node, _, name = path.rpartition("/")
        level = next(x for x in self.root.all() if x.path == (f"{node}/" if node else ""))
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
        self._gammas = {}
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
            self._rows.go_on(np.flatnonzero(same))
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
        assert self._rows is not None
        self._rows.put(step, self.kept["leaf"], self._fresh, mask, self.engine.mask())
        truncated = raw.truncated & ~raw.terminated
        self._rows.put_critic(self.root, self._all, raw.reward, raw.terminated, truncated)
        self._walk(self.root, self._all, step, end)
        self._rows.next()

    def _walk(self, level: Level, ids: Array, step: Step, end: Array) -> None:
        """What a step was to the skills of a level, in environments ``ids`` (k,).

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
        goes_on = over & (end != CallEnd.EPISODE) & ~part.timed_out
        latest = level.learning[i].latest
        assert latest is not None
        self._rows.judge(mine, judge(skill, part, mine).reward, terminated, over, goes_on)
        self._rows.put_skill(level.leaves[i], mine, latest.acted)

    def _inside(self, level: Level, i: int, mine: Array, step: Step, end: Array) -> None:
        """Judge a step of skill ``i``, which is a hierarchy, and for all in it."""
        assert self._rows is not None
        below, part = level.below[i], self._part_of(level, i, mine, step)
        skill = level.skills.skills[i]
        reward = judge(skill, part, mine).reward
        terminated = terminated_in_call(skill, part, end, mine)
        over = (end != CallEnd.RUNNING) & ~terminated
        self._rows.put_critic(below, mine, reward, terminated, over)
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
