"""The part that all collectors share: open environments, from one request to the next."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.restored import check_numbers, opened
from skillweave.collecting.writer import TraceWriter
from skillweave.envs.engine import Engine, checksums
from skillweave.envs.infos import info_numbers
from skillweave.errors import RunError
from skillweave.experience import Batch, Trace, padded_last_axis, side_by_side
from skillweave.seeding import Seeds, seed_global_generators
from skillweave.skills.goals import Goals
from skillweave.skills.info_words import info_keys
from skillweave.types import Array, prefixed, unprefixed

RETURN, TASK_RETURN, LENGTH, SUCCESS = range(4)
"""The first columns of ``Collected.episodes``."""
FIRST_INFO = 4
"""The column of the first logged key of ``info``; those of the others follow."""
PLAYED = 64
"""Steps after which episodes that are played are judged."""


@dataclass
class Collected:
    """The answer to a request: what learners learn from, and numbers for people."""

    batches: dict[str, Batch]
    """By path, what each learner did; \"\" where there is one."""
    steps: int
    """Environment steps that were made for it, those of rows that are not valid included."""
    episodes: Array  # (K, 4 + I) float64, those that ended; NaN where there is no such number
    stands: Array | None = None  # (N,) checksums of what the environments show now; of workers
    begun_anew: Array = field(default_factory=lambda: np.empty(0, np.int64))
    """(k,) environments whose first row here does not follow from their last row before."""
    info_keys: frozenset[str] = frozenset()
    """Keys of ``info`` where episodes ended without a key that is logged."""
    calls: Batch | None = None
    """The steps with what calls did in them, for a log of calls; None: none is kept."""
    longest: int = 0
    """Steps of the longest open episode, where no time limit is known."""


class Collector:
    """N environments, and who acts in them. A function of requests, seeds and ``state``.

    A checkpoint ends no episode: ``state`` holds what is needed to play the open ones again.

    Args:
        engine: the environments; they are reset by ``start``, or stand where ``restore`` puts them.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine, self.num_envs = engine, engine.num_envs
        n = self.num_envs
        self.obs: Array = np.empty(0)
        """(N, *obs_shape), what to act on next."""
        self.kept: dict[str, Array] = {
            "age": np.zeros(n, np.int64),  # steps of the open episode
            "sums": np.zeros((n, 3)),  # of it: return, return of the task, length as the skill's
        }
        """What is kept of each environment, (N, …) each; changed in place."""
        self.values: dict[str, range | Goals] = {}
        """By names of these, what numbers that choose among something may be, or whose goals."""
        self.seen_goals: dict[str, Goals] = {}
        """By names of open calls' observations, the goals that stand in them."""
        self.open: dict[str, Array] = {}
        """The same of what has a shape that is known only when it begins."""
        self.after_request = {"sums"}
        """Names in ``kept`` that change when the steps of a request are judged, not in a step."""
        self.begun = False
        self._all = np.arange(n)
        self.log_info: tuple[str, ...] = ()
        """I keys of ``info`` whose values at the ends of episodes are logged."""
        self.log_calls: tuple[str, ...] | None = None
        """Keys of ``info`` in the log of calls; None: none is kept."""
        self._info_keys: set[str] = set()
        self._ended: list[tuple[int, Array, Array]] = []
        """Of episodes that ended in a request: row, environments, and numbers without sums."""

    def start(self, seeds: Seeds) -> None:
        """Start every environment, unless they have started."""
        if not self.begun:
            self.obs = np.array(self.engine.reset((seeds / "env").integer()))
            self._clear(self._all)
            self._forget(self._all)
            self.begun = True

    def collect(self, request: Request) -> Collected:
        """``request.rows`` steps of each environment."""
        before, self._info_keys, self._ended = self.engine.steps_made, set(), []
        self._prepare(request)
        writer = self._writer(request.rows)
        for _ in range(request.rows):
            self._step(writer)
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
        calls = None if self.log_calls is None else self._calls(trace, self.log_calls)
        return Collected(batches, steps, episodes, info_keys=keys, longest=longest, calls=calls)

    def play(self, request: Request, seeds: Seeds, limit: int) -> Array:
        """Play one episode in each environment, from its start.

        Args:
            request: who acts; ``rows`` does not count.
            limit: steps after which an episode is cut.

        Returns:
            (N, 4 + I), as ``Collected.episodes``; NaN where none could begin.
        """
        self.begun = False
        self.start(seeds)
        found = np.full((self.num_envs, FIRST_INFO + len(self.log_info)), np.nan)
        playing, unknown = np.ones(self.num_envs, bool), np.ones(self.num_envs, bool)
        self._prepare(request)
        steps, self._ended = 0, []
        while steps < limit and playing.any():
            writer = self._writer(min(PLAYED, limit - steps))
            while writer.row < min(PLAYED, limit - steps) and playing.any():
                self._step(writer)
                for _, ids, _ in self._ended[-1:]:
                    playing[ids] = False
                playing &= ~self._given_up()
            steps += writer.row
            for _, ids, episodes in self._judge(writer.trace())[1]:
                first = unknown[ids]
                found[ids[first]], unknown[ids[first]] = episodes[first], False
        found[playing, :3] = self.kept["sums"][playing]
        return found

    def _given_up(self) -> Array:
        """(N,) bool, environments in which an episode cannot begin, as it seems."""
        return np.zeros(self.num_envs, bool)

    def state(self) -> dict[str, Array]:
        """Return what ``restore`` needs. It changes nothing."""
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
            RunError: the state is another collector's.
        """
        # Environments that draw from global generators go on otherwise than they began.
        seed_global_generators(Seeds(_checksum(state)) / "global")
        kept = unprefixed("kept", state)
        for name, values in self.kept.items():
            found, own = kept[name], as_numbers(values)
            if found.shape != own.shape or found.dtype != own.dtype:
                raise RunError(
                    f"the checkpoint's {name!r} of open episodes is {found.dtype} {found.shape}, "
                    f"where {own.dtype} {own.shape} belongs: it is not of this stage, or damaged"
                )
            own[:] = found
        check_numbers(self.kept, self.values)
        obs, early = self.engine.restore(unprefixed("engine", state))
        self.obs, self.begun = np.array(obs), True
        space = self.engine.observation_space
        self.open.clear()
        saved = unprefixed("open", state)
        self.open |= opened(saved, self.kept, self.obs, space, self.seen_goals)
        other = np.flatnonzero(checksums(self.obs) != kept["obs"])
        ids = np.union1d(early, other)
        self._clear(ids)
        return self._begin_anew(ids)

    def close(self) -> None:
        """Release the environments."""
        self.engine.close()

    def like(self, engine: Engine, acting: Acting) -> Any:
        """Return a collector of the same kind over other environments."""
        raise NotImplementedError

    def _prepare(self, request: Request) -> None:
        """Act by this request from now on."""
        raise NotImplementedError

    def _writer(self, rows: int) -> TraceWriter:
        """Return what writes the trace of ``rows`` steps."""
        return TraceWriter(rows, self.num_envs)

    def _step(self, out: TraceWriter) -> None:
        """Step every environment, and write what happened."""
        raise NotImplementedError

    def _judge(self, trace: Trace) -> tuple[Batch, list[tuple[int, Array, Array]]]:
        """Judge the steps of a trace.

        Returns:
            The steps as those who act are judged by them, and the episodes that ended in them:
            row, environments, and numbers (k, 4 + I), as in ``Collected.episodes``.
        """
        raise NotImplementedError

    def _views(self, trace: Trace, steps: Batch) -> dict[str, Batch]:
        """Return what each learner did, by path; ``steps`` are those of ``_judge``."""
        raise NotImplementedError

    def _calls(self, trace: Trace, info: Sequence[str]) -> Batch:
        """Return the steps with what calls did in them; ``info`` are keys that are logged."""
        raise NotImplementedError

    def _count(self, each: Array) -> list[tuple[int, Array, Array]]:
        """Add numbers (T, N, 3) to the sums of the open episodes; return those that ended."""
        found, self._ended = self._ended, []
        sums: Any = self.kept["sums"]
        at = 0
        for row, numbers in enumerate(each):
            sums += numbers
            while at < len(found) and found[at][0] == row:
                _, ids, episodes = found[at]
                known = ~np.isnan(episodes[:, :3])
                episodes[:, :3][known] = sums[ids][known]
                sums[ids], at = 0.0, at + 1
        return found

    def _forget(self, ids: Array) -> None:
        """Episodes of environments ``ids`` (k,) have just begun."""
        for name, kept in self.kept.items():
            if name not in self.after_request:
                kept[ids] = 0
        for name, goals in self.values.items():
            if not isinstance(goals, range):  # zero may be no goal
                self.kept[name][ids] = goals.start(len(ids))

    def _keep_after_request(self, prefix: str, kept: Mapping[str, Array]) -> None:
        """Keep arrays (N, …) that change when the steps of a request are judged."""
        named = {prefix + name: value for name, value in kept.items()}
        self.kept |= named
        self.after_request |= named.keys()

    def _clear(self, ids: Array) -> None:
        """Nothing of environments ``ids`` (k,) is left of the requests before."""
        for name in self.after_request:
            self.kept[name][ids] = 0

    def _begin_anew(self, ids: Array) -> Array:
        if len(ids):
            self.obs = self.obs.copy()
            self.obs[ids] = self.engine.reset_some(ids)
            self._forget(ids)
        return ids

    def _tell(
        self,
        row: int,
        ids: Array,
        info: Mapping[str, Any],
        success: Array | None = None,
        *,
        task: bool,
    ) -> None:
        """Keep the numbers of the episodes of environments ``ids`` (k,), which are over.

        Args:
            row: of the step.
            info: of all environments, at this step.
            success: (k,), whether they have succeeded.
            task: their return of the task is another one than that of who acts.
        """
        episodes = np.full((len(ids), FIRST_INFO + len(self.log_info)), np.nan)
        for column, key in enumerate(self.log_info, FIRST_INFO):
            numbers = info_numbers(info, key, ids, self.num_envs)
            if numbers is None:
                self._info_keys |= set(info_keys(info))
            else:
                episodes[:, column] = numbers
        episodes[:, [RETURN, TASK_RETURN, LENGTH] if task else [RETURN, LENGTH]] = 0.0
        if success is not None:
            episodes[:, SUCCESS] = success
        self._ended.append((row, ids, episodes))


def as_numbers(x: Array) -> Array:
    """Return an array (N, …) as a checkpoint holds it, the same memory: records as bytes."""
    return x if x.dtype.names is None else x.view(np.uint8).reshape(len(x), -1)


def _checksum(state: Mapping[str, Array]) -> int:
    """Return a number that follows from all arrays of a state."""
    found = 0
    for array in state.values():
        found = zlib.crc32(array.tobytes(), found)
    return found


_OF_LEARNERS = {"memory", "state_before", "player.selector.rnn"}
"""What is kept of the learners' memory: others begin without."""


def joined_from(collectors: Sequence[Collector], engine: Engine, acting: Acting) -> Collector:
    """Several collectors of one kind as one, over an engine of all their environments."""
    found: Collector = collectors[0].like(engine, acting)
    found.log_info = collectors[0].log_info
    for name, rows in found.kept.items():
        if name not in _OF_LEARNERS:
            rows[:] = np.concatenate([c.kept[name] for c in collectors])
    for name, example in collectors[0].open.items():
        parts = [c.open.get(name, np.zeros_like(example)) for c in collectors]
        found.open[name] = np.concatenate(padded_last_axis(parts) if name == "rewards" else parts)
    found.obs, found.begun = np.concatenate([c.obs for c in collectors]), True
    return found


def parted(joined: Collector, collectors: Sequence[Collector]) -> None:
    """The inverse of ``joined_from``: each stands where its part of ``joined`` does."""
    first = 0
    for collector in collectors:
        part = slice(first, first + collector.num_envs)
        for name, rows in collector.kept.items():
            if name not in _OF_LEARNERS:
                rows[:] = joined.kept[name][part]
        collector.open.clear()
        collector.open |= {k: v[part].copy() for k, v in joined.open.items()}
        collector.obs, first = joined.obs[part].copy(), part.stop


def joined_collected(parts: Sequence[Collected], members: int) -> Collected:
    """Join the answers of several collectors: each member's environments stand side by side."""
    if len(parts) == 1:
        return parts[0]
    paths, steps = parts[0].batches, sum(p.steps for p in parts)
    batches = {path: side_by_side([p.batches[path] for p in parts], members) for path in paths}
    keys = frozenset[str]().union(*(p.info_keys for p in parts))
    longest = max(p.longest for p in parts)
    logged = [p.calls for p in parts if p.calls is not None]
    calls = None
    if logged:
        calls = Batch(**{k: np.concatenate([c[k] for c in logged], axis=1) for k in logged[0]})
    episodes = np.concatenate([p.episodes for p in parts])
    return Collected(batches, steps, episodes, info_keys=keys, longest=longest, calls=calls)
