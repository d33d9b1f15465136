"""The collector of a selector: a row is a decision, and the whole call that followed it.

No environment waits for another: where a call is over, the selector decides again, while the other
calls go on. A call that is open when the rows are full goes on in the next batch.
"""

from __future__ import annotations

import numpy as np

from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.call_end import CallEnd
from skillweave.collecting.collector import Collector
from skillweave.collecting.guide import ActiveGuide
from skillweave.collecting.judge import judge, seen_by
from skillweave.collecting.pending_calls import Decisions, PendingCalls
from skillweave.collecting.player import LearnerActor, Player, Turn
from skillweave.collecting.restored import ranges_of
from skillweave.collecting.skill_set import SkillSet
from skillweave.envs.checks import LONGEST_EPISODE
from skillweave.envs.engine import Engine, RawStep
from skillweave.errors import SkillError
from skillweave.experience import Batch
from skillweave.skills import Skill, path_of
from skillweave.types import Array, Step, prefixed


class DecisionCollector(Collector):
    """N environments in which a selector decides which skill is called.

    The reward of a decision is Σ γᵏ rₖ over its call, to be discounted by γ^τ afterwards (Sutton,
    Precup & Singh 1999, sec. 3).

    Args:
        engine: the environments.
        acting: the selectors that learn; None: the guide decides, or only ``like`` is to act.
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
        super().__init__(engine)
        n = self.num_envs
        self.skills, self.keep_rewards = skills, keep_rewards
        self.guide, self.as_skill = guide, as_skill
        self.selector = None if acting is None else LearnerActor(acting)
        self.player = Player(skills, self.selector, guide)
        self.memory = self.player.start(n)
        """The player's, (N, …) each; changed in place."""
        self.kept |= prefixed("player", self.memory)
        self.ranges |= prefixed("player", ranges_of(self.player))
        self._open: PendingCalls | None = None  # None: a guide decides, and no selector learns
        if guide is None or not guide.decides or acting is not None:
            self._open = PendingCalls(self, self.player, self.selector, self.memory, keep_rewards)

    def like(self, engine: Engine, acting: Acting) -> DecisionCollector:
        """Return a collector of the same kind over other environments."""
        return DecisionCollector(
            engine, acting, self.skills, self.keep_rewards, self.guide, self.as_skill
        )

    def _forget(self, ids: Array) -> None:
        super()._forget(ids)
        self.player.restart(self.memory, ids)
        if self._open is not None:
            self._open.kept["first"][ids] = True

    def _collect(self, request: Request) -> dict[str, Batch]:
        self._prepare(request)
        out = Decisions(self.num_envs)
        for _ in range(request.rows):
            self._step(out)
        self._check_lengths()
        return {} if self._open is None else {"": out.batch(self._open, self.obs)}

    def _prepare(self, request: Request) -> None:
        if self.selector is not None:
            self.selector.acting.begin(request, every_step=False)
            self._gamma = request.gamma.astype(np.float64).repeat(self.selector.acting.each)
        rng = (request.seeds / "skills").numpy()
        self._turn = Turn(request.greedy, rng, self.kept["age"])

    def _step(self, out: Decisions | None = None) -> None:
        """One step of every environment."""
        obs, mask = self.obs, self.engine.mask()
        if self.selector is not None:
            self.selector.latest = None
        action = self._act(obs, mask)
        if self._open is not None:
            self._open.begin()
        raw = self.engine.step(action)
        self.kept["age"] += 1
        step = raw.seen(obs, action, self.kept["age"].copy())
        end = self.player.observe(self.memory, self._all, step)
        counts = raw if self.as_skill is None else self._judged(self.as_skill, step, end)
        self.kept["sums"][:, 0] += counts.reward
        self.kept["sums"][:, 2] += 1
        if self._open is not None:
            self._open.count(self._all, counts.reward, self._gamma)
        ended = counts.terminated | counts.truncated
        end[ended] = CallEnd.EPISODE
        if out is not None:
            self._record(step, counts, mask, end)
        self.obs = raw.next_obs
        ids = np.flatnonzero(end != CallEnd.RUNNING)
        if not len(ids):
            return
        if out is not None and self._open is not None:
            ends = counts.terminated[ids], counts.truncated[ids]
            out.put(ids, self._open.row(ids, *ends, counts.next_obs[ids]))
        if self._open is not None:
            self._open.kept["first"][ids] = False
        ids = np.flatnonzero(ended)
        if len(ids):
            success = judge(None, step).success
            succeeded = None if success is None else success[ids]
            self._tell(ids, raw.info, succeeded, task=False)
            self._begin_anew(ids)

    def _act(self, obs: Array, mask: Array | None) -> Array:
        """Return the actions of the running skills, after decisions where calls have ended."""
        return self.player.act(self.memory, self._all, obs, mask, self._turn)

    def _judged(self, skill: Skill, step: Step, end: Array) -> RawStep:
        """Return a step with the reward and the ends of the skill that all of it is.

        Where a call has ended and no skill may start, its own call ends, too; its value goes on.
        """
        outcome = judge(skill, seen_by(skill, step, step.elapsed), self._all)
        terminated, truncated = outcome.terminated, step.truncated | outcome.truncated
        if self.skills.restricts:
            waits = np.flatnonzero(end != CallEnd.RUNNING)
            truncated[waits] |= ~self.skills.startable(step.next_obs[waits]).any(axis=1)
        truncated &= ~terminated
        return RawStep(step.next_obs, outcome.reward, terminated, truncated, dict(step.info))

    def _record(self, step: Step, raw: RawStep, mask: Array | None, end: Array) -> None:
        """Keep the step for skills that learn; here they do not."""

    def _check_lengths(self) -> None:
        """Raise a SkillError where a call has run for so long that nothing seems to end it."""
        steps = self.memory["elapsed"]
        if steps.max() >= LONGEST_EPISODE:
            row = int(steps.argmax())
            name = path_of(self.skills.skills[int(self.memory["skill"][row])])
            raise SkillError(
                f"skill {name!r} has run for {int(steps[row]):,} steps in environment {row}, and "
                "neither its termination() nor the episode's end has come: give it max_steps, or "
                "the hierarchy call_steps"
            )
