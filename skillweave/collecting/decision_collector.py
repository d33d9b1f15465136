"""The collector of selectors: a row is a decision, and the whole call that followed it.

No environment waits for another: where a call is over, the selector decides again, while the other
calls go on. A call that is open when the rows are full goes on in the next batch.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.call_end import CallEnd
from skillweave.collecting.calls import OpenCalls
from skillweave.collecting.collector import Collector
from skillweave.collecting.guide import ActiveGuide
from skillweave.collecting.judge import judge, seen_by
from skillweave.collecting.levels import SELECTOR, Level
from skillweave.collecting.player import LearnerActor, Player, Turn
from skillweave.collecting.restored import known, ranges_of
from skillweave.collecting.skill_set import SkillSet
from skillweave.collecting.views import rewards_of
from skillweave.collecting.writer import TraceWriter
from skillweave.envs.checks import LONGEST_EPISODE
from skillweave.envs.engine import Engine
from skillweave.errors import SkillError
from skillweave.experience import Batch, Trace
from skillweave.skills import Skill, path_of
from skillweave.types import Array, Memory, Step, prefixed, unprefixed


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
        learners: by path, all others who learn; see ``JointCollector``.
    """

    first = ""
    """The path of the selector's decisions."""

    def __init__(
        self,
        engine: Engine,
        acting: Acting | None,
        skills: SkillSet,
        keep_rewards: bool = False,
        guide: ActiveGuide | None = None,
        as_skill: Skill | None = None,
        learners: Mapping[str, Acting] | None = None,
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
        self.root = Level(self.player, learners or {})
        self._levels = [_InMemory(level, self.memory) for level in self.root.all()]
        self._open: dict[str, OpenCalls] = {}  # by the paths of levels whose selectors learn
        for level in self.root.all():
            root = level is self.root
            if level.selector is not None or (root and (guide is None or not guide.decides)):
                calls = OpenCalls(level, n, self.open, keep_rewards=root and keep_rewards)
                own = {level.path + name: kept for name, kept in calls.kept.items()}
                self._open[level.path], self.kept = calls, self.kept | own
                self.after_request |= own.keys()
                self.ranges[f"{level.path}choice"] = range(level.player.skills.choices)
        self._judges = as_skill is not None or learners is not None
        """Skills judge the steps: whole steps are recorded, not only decisions."""

    def like(self, engine: Engine, acting: Acting) -> DecisionCollector:
        """Return a collector of the same kind over other environments."""
        return DecisionCollector(
            engine, acting, self.skills, self.keep_rewards, self.guide, self.as_skill
        )

    def _forget(self, ids: Array) -> None:
        super()._forget(ids)
        self.player.restart(self.memory, ids)

    def _prepare(self, request: Request) -> None:
        self._gammas: dict[str, Array] = {}  # by path, (N,)
        if self.selector is not None:
            self.selector.acting.begin(request, every_step=False)
            self._gammas[""] = of_envs(request.gamma, self.selector.acting)
        rng = (request.seeds / "skills").numpy()
        self._turn = Turn(request.greedy, rng, self.kept["age"])

    def _writer(self, rows: int) -> TraceWriter:
        return TraceWriter(rows, self.num_envs, keep_infos=self._reads_infos())

    def _reads_infos(self) -> bool:
        """Return True if something that is judged after the steps may read their infos."""
        return self.as_skill is not None

    def _step(self, out: TraceWriter) -> None:
        """One step of every environment."""
        obs, mask = self.obs, self.engine.mask()
        for level in self._levels:
            level.forget_choices()
        action = self.player.act(self.memory, self._all, obs, mask, self._turn)
        if self._judges:
            out.write(obs=obs, env_action=action, mask=mask)
        elif self.selector is not None and self.selector.latest is not None:
            out.write(self.selector.latest.rows, obs=self.selector.latest.obs)
        for level in self._levels:
            level.write_choices(out, whole=self._judges)
        raw = self.engine.step(action)
        self.kept["age"] += 1
        step = raw.seen(obs, action, self.kept["age"].copy())
        end = self.player.observe(self.memory, self._all, step)
        terminated, truncated = self._ends(step, end)
        ended = terminated | truncated
        end[ended] = CallEnd.EPISODE
        for level in self._levels:
            level.write_ends(out, self._all, whole=self._judges)
        out.write(env_reward=raw.reward, terminated=terminated, truncated=truncated, call_end=end)
        if self._judges:
            self._write_step(out, step)
        else:
            ids = np.flatnonzero(end)
            out.write(ids, next_obs=raw.next_obs[ids])
        self.obs = raw.next_obs
        if ended.any():
            ids = np.flatnonzero(ended)
            success = judge(None, step).success
            self._tell(
                out.row, ids, raw.info, None if success is None else success[ids], task=False
            )
            self._begin_anew(ids)
        out.next(raw.info)

    def _write_step(self, out: TraceWriter, step: Step) -> None:
        """Write what the environments did."""
        out.write(
            next_obs=step.next_obs,
            next_mask=self.engine.mask(),
            env_terminated=step.terminated,
            env_truncated=step.truncated,
            elapsed=step.elapsed,
        )

    def _ends(self, step: Step, end: Array) -> tuple[Array, Array]:
        """Return where episodes are terminated, and truncated, (N,) bool each.

        Where all of it is a skill, its ends count. Where a call has ended and no skill may start,
        its own call ends, too; its value goes on.
        """
        if self.as_skill is None:
            return step.terminated, step.truncated & ~step.terminated
        outcome = judge(self.as_skill, seen_by(self.as_skill, step, step.elapsed), self._all)
        terminated, truncated = outcome.terminated, step.truncated | outcome.truncated
        if self.skills.restricts:
            waits = np.flatnonzero(end != CallEnd.RUNNING)
            truncated[waits] |= ~self.skills.startable(step.next_obs[waits]).any(axis=1)
        return terminated, truncated & ~terminated

    def _episodes(self, trace: Trace) -> list[tuple[int, Array, Array]]:
        every = np.ones(trace.lead, bool)
        reward = trace["env_reward"]
        if self.as_skill is not None:
            reward = rewards_of(trace, self.as_skill, every, trace["elapsed"])
        ends = {name: trace[name] for name in ("terminated", "truncated")}
        self._steps = Batch(reward=reward, **ends, valid=every)
        each = np.zeros((*trace.lead, 3))
        each[..., 0], each[..., 2] = reward, 1.0
        return self._count(each)

    def _views(self, trace: Trace) -> dict[str, Batch]:
        self._check_lengths()
        end = trace["call_end"]
        return dict(self._of_level(trace, self.root, self._steps, end, end != CallEnd.RUNNING))

    def _of_level(
        self, trace: Trace, level: Level, steps: Batch, end: Array, closes: Array
    ) -> Iterator[tuple[str, Batch]]:
        """Yield what the learners of a level did, by path, and of those below it.

        Args:
            steps, closes: see ``OpenCalls.calls_of``.
            end: (T, N) int8, why calls of its skills ended, for what they learn.
        """
        if level.path in self._open:
            gamma, path = self._gammas[level.path], level.path + SELECTOR
            calls = self._open[level.path].calls_of(trace, steps, closes, gamma)
            yield path if level.path else self.first, calls

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


def of_envs(gamma: Array, acting: Acting) -> Array:
    """Return the discount of each environment, (N,) float64; ``gamma`` (P,) is of members."""
    return gamma.astype(np.float64).repeat(acting.each)


class _InMemory:
    """A level in the memory of the root's player, from which it writes columns of a trace.

    Args:
        memory: the root player's.
    """

    def __init__(self, level: Level, memory: Memory) -> None:
        path, prefix = level.path, level.prefix
        self._level, self._path = level, path
        self._memory = unprefixed(prefix.removesuffix("."), memory) if prefix else memory
        self._learning = {path + level.skills[i].name: a for i, a in level.learning.items()}
        guide = level.player.guide
        self._guide = guide if level.selector is not None else None
        self._tells = self._guide is not None and self._guide.tells

    def forget_choices(self) -> None:
        """Forget who chose what in the step before."""
        if self._level.selector is not None:
            self._level.selector.latest = None
        for actor in self._learning.values():
            actor.latest = None

    def write_choices(self, out: TraceWriter, *, whole: bool) -> None:
        """Write what those who learn have chosen, and perhaps the running skills."""
        selector, path = self._level.selector, self._path
        if selector is not None and (latest := selector.latest) is not None:
            head, before = latest.acted.dist_params, latest.recurrent_state
            values = {
                path + "choice": np.asarray(selector.acting.to_env(latest.acted.action)),
                path + "allowed": latest.mask,
                f"{path}{SELECTOR}/dist_params": None if head is None else known(head),
                f"{path}{SELECTOR}/state_before": None if before is None else known(before),
            }
            if self._tells:
                values[path + "chances"] = self._memory["chances"][latest.rows]
            out.write(latest.rows, **values)
        for name, actor in self._learning.items():
            if (latest := actor.latest) is not None:
                action, head = latest.acted.action, latest.acted.dist_params
                out.write(latest.rows, **{f"{name}/action": action, f"{name}/dist_params": head})
        if whole:
            out.write(**{path + "skill": self._memory["skill"]})

    def write_ends(self, out: TraceWriter, every: Array, *, whole: bool) -> None:
        """Write why calls ended; ``every`` (N,) are all environments."""
        path, memory = self._path, self._memory
        if whole:
            out.write(
                **{path + "call_elapsed": memory["elapsed"], path + "call_end": memory["end"]}
            )
        if self._guide is not None:
            may = np.ones((len(every), self._level.player.skills.choices), bool)
            out.write(**{path + "guide_allows": self._guide.ahead(memory, every, may)})
