"""The collector of a hierarchy whose skills learn where they are called."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.call_end import CallEnd
from skillweave.collecting.decision_collector import DecisionCollector, of_envs
from skillweave.collecting.guide import ActiveGuide
from skillweave.collecting.levels import CRITIC, SELECTOR, Level, with_learners
from skillweave.collecting.skill_set import SkillSet
from skillweave.collecting.views import raw_columns, steps_of, timed_out
from skillweave.collecting.writer import TraceWriter
from skillweave.envs.engine import Engine
from skillweave.errors import DeclarationError
from skillweave.experience import INFO, Batch, Trace
from skillweave.skills import Skill
from skillweave.spaces import action_codec
from skillweave.types import Array


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

    first = SELECTOR

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
        super().__init__(
            engine, acting, acts, guide=guide, as_skill=as_skill, learners=self.learners
        )
        reflexes = any(level.player.skills.reflexes for level in self.root.all())
        self.overridden = np.zeros(self.num_envs, bool) if reflexes else None
        """(N,), where reflexes acted in the latest step; None: there are none."""
        self.kept["leaf"] = np.zeros(self.num_envs, np.int64)  # the latest that acted; 0: none yet
        self.after_request.add("leaf")
        self.ranges["leaf"] = range(self.root.leaves() + 1)

    def like(self, engine: Engine, acting: Acting) -> Any:
        """Not possible: populations of hierarchies that learn as a whole are not built."""
        raise DeclarationError("hierarchies that learn as a whole do not evolve")

    def _prepare(self, request: Request) -> None:
        super()._prepare(request)
        self._request_raw = request.record
        self._turn.overridden = self.overridden
        for path, acting in self.learners.items():
            acting.begin(request.below[path], every_step=False)
            if path.endswith(f"/{SELECTOR}"):
                gamma = of_envs(request.below[path].gamma, acting)
                self._gammas[path.removesuffix(SELECTOR)] = gamma
        self._states = {
            (level.path, i): self.memory[f"{level.prefix}{i}.rnn"].copy()
            for level in self.root.all()
            for i, actor in level.learning.items()
            if actor.acting.memory_size
        }

    def _reads_infos(self) -> bool:
        levels = list(self.root.all())
        judges = [level.skills[i] for level in levels for i in (*level.learning, *level.below)]
        reads = any(s.defines(m) for s in judges for m in ("reward", "termination"))
        records = any(name.startswith(INFO) for name in self._request_raw)
        return super()._reads_infos() or reads or records

    def _step(self, out: TraceWriter) -> None:
        if self.overridden is not None:
            self.overridden[:] = False
        super()._step(out)

    def _write_step(self, out: TraceWriter, step: Any) -> None:
        super()._write_step(out, step)
        out.write(overridden=self.overridden)

    def _views(self, trace: Trace) -> dict[str, Batch]:
        ended = trace["call_end"] == CallEnd.EPISODE
        leaf, _ = self.root.leaf(trace)
        before = np.concatenate([self.kept["leaf"][None], np.where(ended, 0, leaf)])
        self._same = leaf == before[:-1]
        self.kept["leaf"][:] = before[-1]
        return super()._views(trace)

    def _of_level(
        self, trace: Trace, level: Level, steps: Batch, end: Array, closes: Array
    ) -> Iterator[tuple[str, Batch]]:
        yield from super()._of_level(trace, level, steps, end, closes)
        running, elapsed = trace[level.path + "skill"], trace[level.path + "call_elapsed"]
        if level.has_critic:
            yield level.path + CRITIC, self._of_critic(trace, steps, running, elapsed)
        for i, skill in enumerate(level.skills):
            acts = steps["valid"] & (running == i)
            if i in level.learning:
                yield level.path + skill.name, self._of_leaf(trace, level, i, acts, end)
            elif i in level.below:
                yield from self._of_level(trace, *self._inside(trace, level, i, acts, end))

    @staticmethod
    def _of_critic(trace: Trace, steps: Batch, running: Array, elapsed: Array) -> Batch:
        """Return all steps of a level, for its critic."""
        acts = steps["valid"]
        return steps.replace(
            obs=trace["obs"],
            action=np.where(acts, running, 0),
            steps=np.ones(trace.lead, np.int64),
            next_obs=trace["next_obs"],
            valid=None if acts.all() else acts,
            call_start=acts & (elapsed == 1),
        )

    def _of_leaf(self, trace: Trace, level: Level, i: int, acts: Array, end: Array) -> Batch:
        """Return what a skill that learns did, judged by its own reward and ends."""
        skill, path = level.skills[i], level.path + level.skills[i].name
        elapsed = trace[level.path + "call_elapsed"]
        steps = steps_of(trace, skill, acts, elapsed, end)
        ends = (end == CallEnd.EPISODE) | timed_out(trace, skill, elapsed)
        steps["truncated"][:-1] &= ends[:-1] | ~self._same[1:]  # it is called again at once
        raw = {name for name in self._request_raw if name != "call_elapsed"}
        own = {"call_elapsed": elapsed} if "call_elapsed" in self._request_raw else {}
        action, state = trace.get(f"{path}/action"), self._states.get((level.path, i))
        return steps.replace(
            obs=trace["obs"],
            action=self._no_actions(trace.lead) if action is None else action,
            steps=np.ones(trace.lead, np.int64),
            next_obs=trace["next_obs"],
            mask=trace.get("mask"),
            next_mask=trace.get("next_mask"),
            dist_params=trace.get(f"{path}/dist_params"),
            recurrent_state=state,
            episode_start=None if state is None else ~self._same,
            overridden=trace.get("overridden"),
            **raw_columns(trace, sorted(raw)),
            **own,
        )

    def _no_actions(self, lead: tuple[int, int]) -> Array:
        """Return the actions of a skill that has not acted, (T, N, …) in policy units."""
        codec = action_codec(self.engine.action_space)  # all skills act in this space
        units = codec.from_env(np.asarray(codec.space.sample())[None])
        return np.zeros((*lead, *units.shape[1:]), units.dtype)

    def _inside(
        self, trace: Trace, level: Level, i: int, acts: Array, end: Array
    ) -> tuple[Level, Batch, Array, Array]:
        """Judge a skill that is a hierarchy; return the arguments of ``_of_level`` for it."""
        skill, below = level.skills[i], level.below[i]
        elapsed = trace[level.path + "call_elapsed"]
        steps = steps_of(trace, skill, acts, elapsed, end)
        own = trace[below.path + "call_end"]
        limited = steps["truncated"] & timed_out(trace, skill, elapsed)
        closes = (own != CallEnd.RUNNING) | (end == CallEnd.EPISODE) | limited
        # The hierarchy's own end cuts the calls below it, unless it is called again at once.
        cut = (own == CallEnd.RUNNING) & (end != CallEnd.RUNNING)
        inner = np.where(end == CallEnd.EPISODE, np.int8(CallEnd.EPISODE), np.int8(CallEnd.LIMIT))
        return below, steps, np.where(cut, inner, own), acts & (closes | steps["terminated"])
