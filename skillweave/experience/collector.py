"""The collector: N environments, the policies in them, and their open episodes between requests."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from skillweave._internal.paths import name_of
from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave._internal.seeding import Seeds, seed_global_generators
from skillweave.algorithms.batches import Batch, Trace, padded_last_axis, side_by_side
from skillweave.envs.engine import Engine, RawStep, checksums
from skillweave.envs.env_infos import info_numbers, notice_odd_success, reported_success
from skillweave.errors import DeclarationError, RunError
from skillweave.experience.acting import Acting, Request
from skillweave.experience.learners import Alone, Calling, LevelLearners, OneLearner
from skillweave.experience.search import Search
from skillweave.experience.views import OwnSteps, seen_by, stops
from skillweave.experience.writer import TraceWriter
from skillweave.policies.core import (
    LIMIT,
    OWN,
    Array,
    Step,
    Turn,
    World,
    end_with_episode,
    flat,
    part_of,
    restart,
)
from skillweave.policies.spaces import Space, space_of
from skillweave.skills.goals import goals_of
from skillweave.skills.outputs import info_keys

RETURN, TASK_RETURN, LENGTH, SUCCESS = range(4)
"""The first columns of ``Collected.episodes``."""
FIRST_INFO = 4
"""The column of the first logged key of ``info``; those of the others follow."""
PLAYED = 64
"""Steps after which episodes that are played are judged."""
OF_LEARNERS = {"state_before", "player.rnn", "player.own.rnn", "player.selector.rnn"}
"""Names in ``Collector.kept`` of the recurrent states of learners: other networks begin afresh."""


@dataclass
class Collected:
    """Result of a request: the rows of each learner, and statistics of episodes for reports."""

    batches: dict[str, Batch]
    """By path, what each learner did; \"\" where there is one."""
    steps: int
    """Environment steps that were made for it, those of rows that are not valid included."""
    episodes: Array  # (K, 4 + I) float64, those that ended; NaN where there is no such number
    checksums: Array | None = None  # (N,) checksums of what the environments show now; of workers
    restarted: Array = field(default_factory=lambda: np.empty(0, np.int64))
    """(k,) environments whose first row here does not follow from their last row before."""
    info_keys: frozenset[str] = frozenset()
    """Keys of ``info`` where episodes ended without a key that is logged."""
    calls: Batch | None = None
    """The steps with what calls did in them, for a log of calls; None: none is kept."""
    longest: int = 0
    """Steps of the longest open episode, where no time limit is known."""


class Collector:
    """N environments in which policies act, and which return rows to learn from.

    A request names the number of steps, the weights and the seeds. Its rows follow from these and
    from the ``state`` before it, so a collector in another process, or one that is restored from a
    checkpoint, returns the same rows. Episodes stay open between requests; ``state`` holds their
    seeds and actions, by which ``restore`` plays them again.

    A skill that has goals gets one at the start of each call, by ``Skill.goals``.

    Args:
        engine: the environments; ``start`` resets them, or ``restore`` brings them into a state.
        acting: the policy that learns and acts: the plain agent, the skill, or the selector. None:
            a guide decides, or the collector is only a template for ``like``.
        who: a plain agent or skill that acts alone (``Alone``), or a hierarchy (``Calling``).
        learners: the other learners of a hierarchy, by path: ``skill``, ``inner/skill``,
            ``inner/selector``, and the critics of skills, ``skill_critic``. None: one policy learns
            alone, at the path "".
        margins: by the path of a critic, the gain in value at which a new decision ends a call.
    """

    def __init__(
        self,
        engine: Engine,
        acting: Acting | None,
        who: Alone | Calling,
        learners: Mapping[str, Acting] | None = None,
        margins: Mapping[str, float] | None = None,
    ) -> None:
        self.engine = engine
        self.num_envs = engine.num_envs
        n = self.num_envs
        self.acting = acting
        self.who = who
        self.skill = who.skill
        self.learners = learners or {}
        self._together = learners is not None
        self._goals = goals_of(self.skill)
        self.obs: Array = np.empty(0)
        """(N, *obs_shape), the latest observations."""
        self.open: dict[str, Array] = {}
        """Arrays (N, …) of open calls; they are made when the first call starts."""
        self.search: Search | None = None
        """The search for states in which the skill may start; None: episodes start in one."""
        self.limit = None if self.skill is None else self.skill.max_steps
        """The most steps of a call of the skill; None: any number."""
        self.learning: OneLearner | LevelLearners
        if isinstance(who, Alone):
            self.learning = OneLearner(who, engine, acting)
            self.search = who.starts.search(who.skill, engine)
            self.limit = who.limit or self.limit
        else:
            self.learning = LevelLearners(who, engine, acting, learners, margins, self.open)
        self.policy, self.memory = self.learning.policy, self.learning.memory
        self.kept: dict[str, Array] = {
            "age": np.zeros(n, np.int64),  # steps of the open episode
            "sums": np.zeros((n, 3)),  # of it: return, return of the task, length as the skill's
            **flat(self.memory, "player."),
            **self.learning.kept,
        }
        """Arrays (N, …) by name that a checkpoint stores, changed in place: of the open episodes,
        the memory of the policy (``player.…``), and of the learners."""
        self.after_request = {"sums", *self.learning.kept}
        """Names in ``kept`` of arrays that change at the end of a request, not in each step."""
        if self._goals is not None:
            self.kept["goal"] = self._goals.start(n)
            self.kept["needs_goal"] = np.ones(n, bool)  # a call starts
        if self.search is not None:
            self.kept |= self.search.kept
        self._last_actions: Space | None = None  # of the actions, where the last one counts
        if self.policy.holds or (self.search is not None and self.search.holds):
            self._last_actions = space_of(engine.action_space)
            self.kept["last_action"] = self._last_actions.start(n)
        self.overridden = np.zeros(n, bool) if self.learning.overrides else None
        """(N,) bool, where reflexes acted in the latest step; None: not recorded."""
        ends = self.skill is not None and self.skill.defines("termination")
        self._asks = self.policy.watches or self.search is not None or ends
        """Each step is shown to a policy or a skill at once, not only at the end of a request."""
        self.begun = False
        """The environments were reset."""
        self._all = np.arange(n)
        self.log_info: tuple[str, ...] = ()
        """I keys of ``info`` whose values at the ends of episodes are logged."""
        self.log_calls: tuple[str, ...] | None = None
        """Keys of ``info`` in the log of calls; None: none is kept."""
        self._info_keys: set[str] = set()
        self._ended: list[tuple[int, Array, Array]] = []
        """Episodes that ended in the request: the row, environments, and numbers but sums."""

    def like(self, engine: Engine, acting: Acting) -> Collector:
        """Return a collector of the same kind over other environments."""
        if self._together:
            raise DeclarationError("hierarchies that learn as a whole do not evolve")
        return Collector(engine, acting, self.who)

    @property
    def elapsed(self) -> Array:
        """Return the steps (N,) of the calls of the skill that acts, or of the episodes."""
        return self.kept["age" if self.search is None else "elapsed"]

    def start(self, seeds: Seeds) -> None:
        """Start every environment, unless they have started."""
        if not self.begun:
            self.obs = np.array(self.engine.reset((seeds / "env").integer()))
            self._clear(self._all)
            self._forget(self._all)
            self.begun = True

    def collect(self, request: Request) -> Collected:
        """Step each environment ``request.rows`` times, and return each learner's rows."""
        before = self.engine.steps_made
        self._info_keys = set()
        self._ended = []
        self._prepare(request)
        writer = self._writer(request.rows)
        for _ in range(request.rows):
            self._step(writer)
        self._world.trace = None  # only learners hold it from here on
        trace = writer.trace()
        judged, found = self._judge(trace)
        batches = self._views(trace, judged)
        steps = self.engine.steps_made - before
        episodes = np.concatenate(
            [np.zeros((0, FIRST_INFO + len(self.log_info))), *(x for _, _, x in found)]
        )
        limited = self.engine.time_limit is not None
        longest = 0 if limited else int(self.kept["age"].max())
        keys = frozenset(self._info_keys)
        calls = None
        if self.log_calls is not None and isinstance(self.learning, LevelLearners):
            calls = self.learning.log(trace, self.log_calls)
        return Collected(batches, steps, episodes, info_keys=keys, longest=longest, calls=calls)

    def play(self, request: Request, seeds: Seeds, max_steps: int) -> Array:
        """Play one episode in each environment, from its start.

        Args:
            request: the parameters to act by; ``rows`` does not count.
            max_steps: steps after which an episode is cut.

        Returns:
            (N, 4 + I), as ``Collected.episodes``; NaN where none could begin.
        """
        self.begun = False
        self.start(seeds)
        found = np.full((self.num_envs, FIRST_INFO + len(self.log_info)), np.nan)
        playing, unknown = np.ones(self.num_envs, bool), np.ones(self.num_envs, bool)
        steps, self._ended = 0, []
        while steps < max_steps and playing.any():
            if not request.greedy:  # what it needs of chance is drawn for so many steps
                self._prepare(replace(request, rows=PLAYED, seeds=request.seeds / steps))
            elif not steps:
                self._prepare(request)
            writer = self._writer(min(PLAYED, max_steps - steps))
            while writer.row < min(PLAYED, max_steps - steps) and playing.any():
                self._step(writer)
                for _, ids, _ in self._ended[-1:]:
                    playing[ids] = False
                if self.search is not None:
                    playing &= ~self.search.given_up
            steps += writer.row
            for _, ids, episodes in self._judge(writer.trace())[1]:
                first = unknown[ids]
                found[ids[first]] = episodes[first]
                unknown[ids[first]] = False
        found[playing, :3] = self.kept["sums"][playing]
        return found

    def state(self) -> dict[str, Array]:
        """Return the open episodes and calls, for ``restore``; nothing changes."""
        kept = {k: as_numbers(v).copy() for k, v in self.kept.items()}
        kept["obs"] = checksums(self.obs)
        opened = {k: v.copy() for k, v in self.open.items()}
        found = prefixed("kept", kept) | prefixed("open", opened)
        return found | prefixed("engine", self.engine.state())

    def restore(self, state: dict[str, Array]) -> Array:
        """Restore the open episodes of ``state``: play them again.

        Returns:
            (k,) environments that start again, as they did not repeat themselves.

        Raises:
            RunError: it has other names, shapes or types, as environment or skills have changed.
        """
        # Environments that draw from global generators go on otherwise than they began.
        seed_global_generators(Seeds(_checksum(state)) / "global")
        kept = unprefixed("kept", state)
        if others := sorted(kept.keys() ^ {*self.kept, "obs"}):
            raise RunError(
                f"the checkpoint's open episodes differ in {others[0]!r}: the environment, the "
                "skills or Skillweave have changed since it was written"
            )
        for name, values in self.kept.items():
            _check_fits(name, kept[name], values)
            as_numbers(values)[:] = kept[name]
        obs, early = self.engine.restore(unprefixed("engine", state))
        self.obs = np.array(obs)
        self.begun = True
        self.open.clear()
        for name, saved in unprefixed("open", state).items():
            self.open[name] = saved.copy()
            if name_of(name) == "obs":  # of a hierarchy below: "inner/obs"
                like = self.obs
                if (goals := self.learning.seen_goals.get(name)) is not None:
                    like = goals.join(like, goals.start(len(like)))
                _check_fits(name, saved, like)
                self.open[name] = self.open[name].view(like.dtype).reshape(like.shape)
        other = np.flatnonzero(checksums(self.obs) != kept["obs"])
        ids = np.union1d(early, other)
        self._clear(ids)
        return self._reset(ids)

    def finish(self) -> None:
        """Check at the end of training what it has left in the environments."""
        self.engine.finish()

    def close(self) -> None:
        """Release the environments."""
        self.engine.close()

    # Steps are made -----------------------------------------------------------------------------

    def _prepare(self, request: Request) -> None:
        """Load the parameters and seeds of a request, by which the collector acts from now on."""
        self.learning.begin(request, self.elapsed)
        self._greedy = request.greedy
        self._goal_rng = (request.seeds / "goals").numpy()
        rng = (request.seeds / "skills").numpy()
        last = self.kept.get("last_action")
        self._world = World(rng, self.kept["age"], last, overridden=self.overridden)

    def _writer(self, rows: int) -> TraceWriter:
        """Return a writer for the trace of the next ``rows`` steps."""
        skill = self.skill
        reads = skill is not None and any(map(skill.defines, skill.methods))
        reads |= self.learning.reads_infos()
        if self.log_calls is not None and isinstance(self.who, Calling):
            reads |= bool(self.log_calls)
            reads |= any(s.defines("success") for s in self.who.skills.skills)
        self._world.trace = writer = TraceWriter(rows, self.num_envs, keep_infos=reads)
        return writer

    def _step(self, out: TraceWriter) -> None:
        """Step every environment, and write the step into the trace."""
        obs = self.obs
        mask = self.engine.mask()
        rows = self._all
        waiting = self._all[:0]
        if self.search is not None:
            rows, waiting = self.search.playing(obs, self._world)
        if self.overridden is not None:
            self.overridden[:] = False
        goal = self._goal(rows)
        turn = Turn(self._world, mask, goal, self._greedy)
        if len(waiting):
            action = self._searched(rows, waiting, turn)
            out.write(waiting, valid=np.zeros(len(waiting), bool))
        else:
            action = self.policy.act(self.memory, rows, obs, turn)
        whole = self.learning.whole or self.log_calls is not None
        if whole:  # else only where a selector decides and calls end
            out.write(obs=obs, env_action=action, mask=mask, goal=goal, overridden=self.overridden)
        raw = self.engine.step(action)
        self.kept["age"] += 1
        if self.search is not None:
            self.elapsed[rows] += 1
        if self._last_actions is not None:
            self.kept["last_action"][:] = action
        step = raw.seen(obs, action, self.kept["age"].copy()) if self._asks else None
        end = self._ends(raw, step, rows, goal)
        self.learning.write(out, end, whole)
        out.write(
            elapsed=self.elapsed,
            end=end,
            env_reward=raw.reward,
            env_terminated=raw.terminated,
            env_truncated=raw.truncated,
            next_obs=raw.next_obs if whole else None,
            next_mask=self.engine.mask() if whole else None,
        )
        if not whole:
            over = np.flatnonzero(self.memory["end"])
            out.write(over, next_obs=raw.next_obs[over])
        self.obs = raw.next_obs
        if len(over := np.flatnonzero(end)):
            self._record_episodes(out.row, over, raw.info)
        if self.search is not None and (len(over) or len(waiting)):
            assert step is not None
            over = self._start_calls(end, over, waiting, step)
        self._reset(over)
        out.next(raw.info)

    def _searched(self, rows: Array, waiting: Array, turn: Turn) -> Array:
        """Return actions (N, …): of the skill in ``rows``, and of the search in ``waiting``."""
        assert self.search is not None
        own = None
        if len(rows):
            own = self.policy.act(self.memory, rows, self.obs[rows], turn.some(rows))
        found = self.search.act(waiting, self.obs, turn.mask, turn.world)
        action = np.zeros((self.num_envs, *found.shape[1:]), found.dtype)
        action[waiting] = found
        if own is not None:
            action[rows] = own
        return action

    def _start_calls(self, end: Array, over: Array, waiting: Array, step: Step) -> Array:
        """Start new calls in episodes that go on, and continue the search for a start.

        Args:
            end: (N,), why calls ended.
            over: environments (k,) in which they did.
            waiting: environments (k,) in which a start was searched for.
            step: of all environments.

        Returns:
            The environments (k,) in which a new episode is to begin.
        """
        assert self.search is not None
        if len(again := self.search.again(over[end[over] == LIMIT])):
            self._begin_call(again, episodes=False)
        lost = waiting[(step.terminated | step.truncated)[waiting]]
        if len(going := np.setdiff1d(waiting, lost)):
            lost = np.union1d(lost, self.search.observe(going, step))
        return np.union1d(np.setdiff1d(over, again), lost)

    def _goal(self, rows: Array) -> Array | None:
        """Return the goals of calls in all environments, (N, *goal_shape); new calls draw theirs.

        Args:
            rows: (k,) environments in which the skill acts.
        """
        if self._goals is None:
            return None
        needs, kept = self.kept["needs_goal"], self.kept["goal"]
        if len(ids := rows[needs[rows]]):
            kept[ids] = self._goals.draw(self.obs[ids], self._goal_rng)
            needs[ids] = False
        return kept.copy()

    def _ends(self, raw: RawStep, step: Step | None, rows: Array, goal: Array | None) -> Array:
        """Let the policy notice a step; return why calls or episodes ended, (N,) int8 ``CallEnd``.

        Where skills that are called have ended, and none may start, the call of the whole ends,
        too; its value goes on.

        Args:
            rows: (k,) environments in which the policy acted.
            goal: (N, *goal_shape).
        """
        end = np.zeros(self.num_envs, np.int8)
        skill = self.skill
        if self.limit is not None:
            end[rows[self.elapsed[rows] >= self.limit]] = LIMIT
        if step is not None and len(rows):
            elapsed = self.elapsed[rows]
            own_goal = None if goal is None else goal[rows]
            if self.policy.watches:
                seen = step
                if self.search is not None or goal is not None:
                    seen = part_of(step, elapsed, rows, None, own_goal)
                self.policy.observe(self.memory, rows, seen)
            if skill is not None:
                if self.policy.restricts:
                    end[rows[self.policy.stuck(self.memory, rows, raw.next_obs[rows])]] = LIMIT
                seen = seen_by(skill, step, elapsed, rows, own_goal)
                end[rows[stops(skill, seen, rows)]] = OWN
        over = raw.terminated | raw.truncated
        if self.search is not None:
            over &= ~self.search.kept["searching"]
        end_with_episode(end, over)
        return end

    # They are judged ----------------------------------------------------------------------------

    def _judge(self, trace: Trace) -> tuple[Batch, list[tuple[int, Array, Array]]]:
        """Judge the steps of a trace by the acting skill, or by the task.

        Returns:
            The steps as those who act are judged by them, and the episodes that ended in them:
            row, environments, and numbers (k, 4 + I), as in ``Collected.episodes``.
        """
        acts = trace.valid_rows
        own = OwnSteps(trace, self.skill, acts, trace["elapsed"], trace.get("goal"))
        steps = own.rows(trace["end"])
        each = np.empty((*trace.lead, 3))
        each[..., 0] = steps["reward"]
        each[..., 1] = trace["env_reward"] * acts
        each[..., 2] = acts
        found = self._count(each)
        if self.skill is not None and self.skill.defines("success"):
            success = own.judged("success")
            for row, ids, episodes in found:
                episodes[:, SUCCESS] = success[row, ids]
        return steps, found

    def _views(self, trace: Trace, steps: Batch) -> dict[str, Batch]:
        """Return the rows of each learner, by path; ``steps`` are those of ``_judge``."""
        return self.learning.views(trace, steps)

    def _count(self, each: Array) -> list[tuple[int, Array, Array]]:
        """Add numbers (T, N, 3) to the sums of the open episodes; return those that ended."""
        found = self._ended
        self._ended = []
        sums: Any = self.kept["sums"]
        at = 0
        for row, numbers in enumerate(each):
            sums += numbers
            while at < len(found) and found[at][0] == row:
                _, ids, episodes = found[at]
                known = ~np.isnan(episodes[:, :3])
                episodes[:, :3][known] = sums[ids][known]
                sums[ids] = 0.0
                at = at + 1
        return found

    def _forget(self, ids: Array) -> None:
        """Clear the memory of environments ``ids`` (k,), whose episodes have just started."""
        self.kept["age"][ids] = 0
        if self._last_actions is not None:
            self.kept["last_action"][ids] = self._last_actions.start(len(ids))
        self._begin_call(ids, episodes=True)

    def _begin_call(self, ids: Array, *, episodes: bool) -> None:
        """Start a new call in environments ``ids`` (k,), perhaps a new episode."""
        restart(self.policy, self.memory, ids)
        if self._goals is not None:
            self.kept["needs_goal"][ids] = True
        if self.search is not None:
            self.search.begin(ids, self.obs, episodes=episodes)

    def _clear(self, ids: Array) -> None:
        """Clear the numbers that requests keep of environments ``ids`` (k,), which were reset."""
        for name in self.after_request:
            self.kept[name][ids] = 0

    def _reset(self, ids: Array) -> Array:
        """Reset environments ``ids`` (k,) and clear their memory; return them."""
        if len(ids):
            self.obs = self.obs.copy()
            self.obs[ids] = self.engine.reset_some(ids)
            self._forget(ids)
        return ids

    def _record_episodes(self, row: int, ids: Array, info: Mapping[str, Any]) -> None:
        """Record the episodes that have ended in environments ``ids`` (k,), for reports.

        Args:
            row: of the step.
            ids: (k,).
            info: of all environments, at this step.
        """
        episodes = np.full((len(ids), FIRST_INFO + len(self.log_info)), np.nan)
        for column, key in enumerate(self.log_info, FIRST_INFO):
            numbers = info_numbers(info, key, ids, self.num_envs)
            if numbers is None:
                self._info_keys |= set(info_keys(info))
            else:
                episodes[:, column] = numbers
        episodes[:, [RETURN, LENGTH]] = 0.0
        if self.skill is not None:  # the return of the task is another one
            episodes[:, TASK_RETURN] = 0.0
        if self.skill is None or not self.skill.defines("reward"):  # the reward is the task's
            success = reported_success(info, self.num_envs)
            if success is not None:
                episodes[:, SUCCESS] = success[ids]
                if np.isnan(success[ids]).any():
                    notice_odd_success(info, self.num_envs)
        self._ended.append((row, ids, episodes))


def as_numbers(x: Array) -> Array:
    """Return an array (N, …) as a checkpoint holds it, the same memory: records as bytes."""
    return x if x.dtype.names is None else x.view(np.uint8).reshape(len(x), -1)


def _check_fits(name: str, saved: Array, like: Array) -> None:
    """Raise a RunError where a collector's array in a checkpoint is of another shape or type."""
    found = as_numbers(saved)
    own = as_numbers(like)
    if found.shape != own.shape or found.dtype != own.dtype:
        raise RunError(
            f"the checkpoint's {name!r} of open episodes is {found.dtype} {found.shape}, where "
            f"{own.dtype} {own.shape} belongs: the environment, the skills or Skillweave have "
            "changed since it was written"
        )


def _checksum(state: Mapping[str, Array]) -> int:
    """Return one checksum of all arrays of a collector's state."""
    found = 0
    for array in state.values():
        found = zlib.crc32(array.tobytes(), found)
    return found


def joined_from(collectors: Sequence[Collector], engine: Engine, acting: Acting) -> Collector:
    """Return several collectors of one kind as one, over an engine of all their environments."""
    found: Collector = collectors[0].like(engine, acting)
    found.log_info = collectors[0].log_info
    for name, rows in found.kept.items():
        if name not in OF_LEARNERS:
            rows[:] = np.concatenate([c.kept[name] for c in collectors])
    for name, example in collectors[0].open.items():
        parts = [c.open.get(name, np.zeros_like(example)) for c in collectors]
        found.open[name] = np.concatenate(padded_last_axis(parts) if name == "rewards" else parts)
    found.obs = np.concatenate([c.obs for c in collectors])
    found.begun = True
    return found


def parted(joined: Collector, collectors: Sequence[Collector]) -> None:
    """Invert ``joined_from``: each stands where its part of ``joined`` does."""
    first = 0
    for collector in collectors:
        part = slice(first, first + collector.num_envs)
        for name, rows in collector.kept.items():
            if name not in OF_LEARNERS:
                rows[:] = joined.kept[name][part]
        collector.open.clear()
        collector.open |= {k: v[part].copy() for k, v in joined.open.items()}
        collector.obs = joined.obs[part].copy()
        first = part.stop


def joined_collected(parts: Sequence[Collected], members: int) -> Collected:
    """Join the answers of several collectors: each member's environments stand side by side."""
    if len(parts) == 1:
        return parts[0]
    paths = parts[0].batches
    steps = sum(p.steps for p in parts)
    batches = {path: side_by_side([p.batches[path] for p in parts], members) for path in paths}
    keys = frozenset[str]().union(*(p.info_keys for p in parts))
    longest = max(p.longest for p in parts)
    logged = [p.calls for p in parts if p.calls is not None]
    calls = None
    if logged:
        calls = Batch(**{k: np.concatenate([c[k] for c in logged], axis=1) for k in logged[0]})
    episodes = np.concatenate([p.episodes for p in parts])
    return Collected(batches, steps, episodes, info_keys=keys, longest=longest, calls=calls)
