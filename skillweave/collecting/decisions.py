"""The collector of a selector: a row is a decision, and the whole call that followed it.

No environment waits for another: where a call is over, the selector decides anew, while the other
calls go on. A call that is under way when the rows are full goes on in the next experience.
"""

from __future__ import annotations

import numpy as np

from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.calls import SkillSet
from skillweave.collecting.collector import Collector
from skillweave.collecting.ends import Why, judged, skill_step
from skillweave.collecting.guide import ActiveGuide, tell_guide
from skillweave.collecting.open_calls import Decisions, OpenCalls
from skillweave.collecting.restored import ranges_of, ranges_of_guide
from skillweave.envs.checks import LONGEST_EPISODE
from skillweave.envs.engine import Engine, RawStep
from skillweave.envs.infos import told_success
from skillweave.errors import SkillError
from skillweave.experience import Batch
from skillweave.skills import Skill, path_of
from skillweave.types import Array, Memory, Step, prefixed


class DecisionCollector(Collector):
    """N environments in which a selector decides which skill is called.

    The reward of a decision is Σ γᵏ rₖ over its call, to be discounted by γ^τ afterwards (Sutton,
    Precup & Singh 1999, sec. 3).

    Args:
        engine: the environments.
        acting: the selectors that learn.
        skills: what their actions mean.
        keep_rewards: of each call, keep the reward of every step, so that others may learn from it
            with a γ of their own.
        guide: a ready selector that is asked wherever they decide.
        as_skill: the skill that all of it is, in another hierarchy: its reward and its ends count;
            None: the environment's.
    """

    def __init__(
        self,
        engine: Engine,
        acting: Acting | None,
        skills: SkillSet,
        keep_rewards: bool = False,
        guide: ActiveGuide | None = None,
        as_skill: Skill | None = None,
    ) -> None:
        super().__init__(engine, acting)
        n = self.num_envs
        self.skills, self.keep_rewards = skills, keep_rewards
        self.guide, self.as_skill = guide, as_skill
        self._watches = skills.watches or guide is not None or as_skill is not None
        self._calls: Memory = skills.start(n)  # what the skills remember of each environment
        self._never = np.zeros(n, bool)
        self.kept |= prefixed("skills", self._calls)
        self.ranges |= prefixed("skills", ranges_of(skills)) | ranges_of_guide(guide)
        self.kept["over"] = np.zeros(n, bool)  # there is no call: the selector must decide
        if guide is not None:
            self.kept |= guide.start(n)
            self.kept["chances"] = np.zeros((n, skills.choices), np.float32)  # when it was asked
        size = self.kept["memory"].shape[1]
        self._open = OpenCalls(self, skills, size, keep_rewards, guide, self.kept)

    def like(self, engine: Engine, acting: Acting) -> DecisionCollector:
        """The same over other environments."""
        return DecisionCollector(
            engine, acting, self.skills, self.keep_rewards, self.guide, self.as_skill
        )

    def _forget(self, ids: Array) -> None:
        super()._forget(ids)
        self.skills.forget(self._calls, ids)
        self.kept["over"][ids] = True
        self.kept["first"][ids] = True
        if self.guide is not None:
            for name, value in self.guide.start(len(ids)).items():
                self.kept[name][ids] = value

    def _collect(self, request: Request) -> dict[str, Batch]:
        self._prepare(request)
        out = Decisions(self.num_envs)
        for _ in range(request.rows):
            self._step(out)
        self._check_lengths()
        return {"": out.batch(self._open, self.obs)}

    def _prepare(self, request: Request) -> None:
        self.acting.begin(request, every_step=False)
        self._gamma = request.gamma.astype(np.float64).repeat(self.acting.each)
        self._rng, self._greedy = (request.seeds / "skills").numpy(), request.greedy

    def _step(self, out: Decisions | None = None) -> None:
        """One step of every environment."""
        rows = np.flatnonzero(self.kept["over"])
        if len(rows):
            self._decide(rows)
        obs, mask = self.obs, self.engine.mask()
        action = self._act(obs, mask)
        raw = self.engine.step(action)
        seen = self._seen(obs, action, raw) if self._watches else None
        why = self.skills.observe(self._calls, self._all, seen)
        counts = raw if self.as_skill is None else self._judged(self.as_skill, seen, raw, why)
        self._count(counts)
        ended = counts.terminated | counts.truncated
        why[ended] = Why.EPISODE
        if self.guide is not None and seen is not None:
            tell_guide(self.guide, self.kept, self.skills, self._calls, seen, why)
        if out is not None and seen is not None:
            self._record(seen, counts, mask, why)
        self.obs = raw.next_obs
        ids = np.flatnonzero(why != Why.RUNNING)
        if len(ids):
            self.kept["over"][ids] = True
            if out is not None:
                out.put(ids, self._row(ids, counts))
            self.kept["first"][ids] = False
            if ended.any():
                ids = np.flatnonzero(ended)
                success = told_success(raw.info, self.num_envs)
                succeeded = None if success is None else success[ids]
                self._tell(ids, raw.info, succeeded, task=False)
                self._begin_anew(ids)

    def _act(self, obs: Array, mask: Array | None) -> Array:
        """What the skills that are called do in all environments."""
        return self.skills.act(self._calls, self._all, obs, self._rng, mask)

    def _seen(self, obs: Array, action: Array, raw: RawStep) -> Step:
        """The step as skills are shown it."""
        return Step(
            obs, action, raw.next_obs, raw.reward, raw.terminated, raw.truncated,
            self._never, self._calls["elapsed"], raw.info,
        )  # fmt: skip

    def _judged(self, skill: Skill, seen: Step | None, raw: RawStep, why: Array) -> RawStep:
        """A step with the reward and the ends of the skill that all of it is.

        Where a call is over (``why``) and no skill may start, it ends, too; its value goes on.
        """
        assert seen is not None
        step = skill_step(seen, self._all, self.kept["age"] + 1, skill.max_steps)
        reward, terminated = judged(skill, step, self._all)
        truncated = raw.truncated | step.timed_out
        if self.skills.restricts:
            waits = np.flatnonzero(why != Why.RUNNING)
            truncated[waits] |= ~self.skills.startable(raw.next_obs[waits]).any(axis=1)
        truncated &= ~terminated
        return RawStep(raw.next_obs, reward, terminated, truncated, raw.info)

    def _row(self, ids: Array, raw: RawStep) -> dict[str, Array]:
        """The decisions of environments ``ids`` (k,), whose calls are over."""
        return self._open.row(ids, raw.terminated[ids], raw.truncated[ids], raw.next_obs[ids])

    def _record(self, step: Step, raw: RawStep, mask: Array | None, why: Array) -> None:
        """Keep the step for skills that learn; here they do not."""

    def _decide(self, rows: Array) -> None:
        """The selector chooses a skill in environments ``rows`` (k,), and its call begins."""
        kept, here = self.kept, self.obs[rows]
        allowed = None
        if "allowed" in kept:
            kept["allowed"][rows] = self._allowed(rows, here)
            allowed = kept["allowed"]
        acted = self.acting.some(rows, self.obs, allowed, self.memory)
        choice = np.asarray(self.acting.to_env(acted.action))
        kept["over"][rows] = False
        self._open.begin(rows, here, choice, acted, kept["memory"][rows])
        if acted.recurrent_state is not None:
            kept["memory"][rows] = acted.recurrent_state
        self.skills.begin(self._calls, rows, choice)

    def _allowed(self, rows: Array, here: Array) -> Array:
        """Choices that are allowed in environments ``rows`` (k,), in observations ``here``."""
        may = self.skills.mask(here, self.kept["age"][rows])
        if self.guide is None:
            assert may is not None
            return may
        may = self.skills.startable(here) if may is None else may
        return self.guide.mask(self.kept, rows, here, may, self._greedy, self._rng)

    def _count(self, raw: RawStep) -> None:
        """Add a step to the open calls and episodes."""
        kept = self.kept
        self._open.count(slice(None), raw.reward, self._gamma)
        kept["age"] += 1
        kept["sums"][:, 0] += raw.reward
        kept["sums"][:, 2] += 1

    def _check_lengths(self) -> None:
        """Raise a SkillError where a call has run for so long that nothing seems to end it."""
        steps = self.kept["tau"]
        if steps.max() >= LONGEST_EPISODE:
            row = int(steps.argmax())
            name = path_of(self.skills.skills[int(self._calls["skill"][row])])
            raise SkillError(
                f"skill {name!r} has run for {int(steps[row]):,} steps in environment {row}, and "
                "neither its termination() nor the episode's end has come: give it max_steps, or "
                "the hierarchy call_steps"
            )
