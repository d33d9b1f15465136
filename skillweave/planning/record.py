"""A recorder of calls: skills act in an environment, and every call is written down."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np

from skillweave.arguments import checked_names
from skillweave.collecting.call_end import CallEnd
from skillweave.collecting.player import Player, Turn
from skillweave.collecting.skill_set import SkillSet, skills_below
from skillweave.envs.engine import Engine, RawStep
from skillweave.envs.infos import allowed_rows
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import DeclarationError, EnvError
from skillweave.messages import short, whole_number
from skillweave.planning.calls import CallLog, seen_places, skill_checksums
from skillweave.planning.explorer import Explorer
from skillweave.seeding import Seeds, global_generators
from skillweave.selectors import ReadySelector, ready_selector
from skillweave.skills.info_words import missing_key
from skillweave.spaces import same_space
from skillweave.types import Array, Memory, Memoryless

MOST_BYTES = 4 * 2**30
"""The largest log."""


@runtime_checkable
class LearnsFromCalls(Protocol):
    """A selector that plans again on the calls that have been recorded."""

    every: int
    """Steps after which it plans again."""

    def begin(self, choices: int) -> None:
        """Prepare for a recording; ``choices``: of a selector, skills times lengths."""
        ...

    def learn(self, log: CallLog) -> None:
        """Plan on the calls so far."""
        ...


class RandomChoice(Memoryless):
    """A selector that chooses uniformly among what may start.

    Args:
        choices: the number of choices.
    """

    def __init__(self, choices: int) -> None:
        self.choices = choices

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return choices (n,)."""
        score = (rng or np.random.default_rng()).random((len(obs), self.choices))
        return (score if mask is None else np.where(mask, score, -1.0)).argmax(1), memory


@checked_names
def record_calls(
    env: Any,
    skills: Any,
    steps: int,
    *,
    choose: Any = "random",
    num_envs: int = 16,
    seed: int = 0,
    info: Sequence[str] = (),
) -> CallLog:
    """Let skills act in an environment, and return the log of their calls.

    Once the steps are spent no call starts, and those that run are completed, as a log without its
    longest calls would be wrong. So the log has a few steps more.

    Args:
        env: an ``EnvSpec``, a Gymnasium id, or a function that makes an environment.
        skills: a ``HierarchyPolicy`` (``run.policy``), or its ``skills``.
        steps: environment steps to record.
        choose: "random" (uniformly among the skills that may start); "explore" (``Explorer()``); or
            a selector: any policy over the skills, a ready selector, or an ``Explorer``.
        num_envs: environments side by side.
        seed: of the environments and of all that is sampled.
        info: keys of the environment's ``info`` to record, so that tasks may read them.

    Raises:
        DeclarationError: an argument is wrong, or the log would have more than 4 GiB.
        EnvError: the environment cannot be made, or sets no such key of ``info``.
        SkillError: no skill may start in an observation.
    """
    steps, num_envs = whole_number(steps, "steps", 1), whole_number(num_envs, "num_envs", 1)
    skill_set = skills if isinstance(skills, SkillSet) else skills_below(skills)
    if skill_set is None:
        raise DeclarationError(
            f"record_calls(): {short(skills)} has no skills; give a run's policy, run.policy"
        )
    if isinstance(info, str):
        raise DeclarationError(f"info is {info!r}; give a tuple of keys: info=({info!r},)")
    if isinstance(choose, str) and choose == "explore":
        choose = Explorer()
    skill_set = replace(skill_set, interruption=None)  # it belongs to a selector that is left out
    spec = env if isinstance(env, EnvSpec) else EnvSpec(env)
    seeds = Seeds(seed) / "calls"
    with global_generators(seeds), closing(make_engine(spec, num_envs)) as engine:
        selector = _selector(choose, skill_set, engine)
        recorder = Recorder(engine, skill_set, tuple(info), steps)
        player = Player(skill_set, selector)
        rng = (seeds / "choices").numpy()
        sampled = isinstance(selector, RandomChoice)
        _play(recorder, player, steps, Turn(not sampled, rng), seeds.integer(), choose)
        return recorder.log()


def _selector(choose: Any, skills: SkillSet, engine: Engine) -> Any:
    names = tuple(s.name for s in skills.skills)
    choices = gym.spaces.Discrete(skills.choices)
    if isinstance(choose, str) and choose == "random":
        return RandomChoice(skills.choices)
    if isinstance(choose, LearnsFromCalls) and not isinstance(choose, type):
        choose.begin(skills.choices)
        return choose
    if isinstance(choose, ReadySelector) or not hasattr(choose, "act"):
        if (ready := ready_selector(choose, names)) is not None:
            return ready.bind(engine.observation_space, choices, "selector")
    elif hasattr(choose, "start") and not isinstance(choose, type):
        space = getattr(choose, "action_space", choices)
        if not same_space(space, choices):
            raise DeclarationError(
                f"choose is a policy with the actions {space}, but it has to choose among "
                f"{len(names)} skills ({', '.join(names)}): give a policy over the skills, "
                "run.policy.selector for example"
            )
        return choose
    raise DeclarationError(
        f"choose is {short(choose)}; it must be 'random', 'explore', an Explorer, a function of "
        "observations that returns names of skills, another ready selector, or a policy over the "
        "skills"
    )


def _play(
    recorder: Recorder, player: Player, steps: int, turn: Turn, seed: int, choose: Any
) -> None:
    """Play until ``steps`` steps are recorded, then complete the open calls."""
    engine = recorder.engine
    n = engine.num_envs
    memory, obs = player.start(n), np.array(engine.reset(seed))
    turn.age = np.zeros(n, np.int64)
    rows, planned = np.arange(n), 0
    while len(rows):
        decides = rows[memory["end"][rows] != CallEnd.RUNNING]
        here = obs[rows]
        action = player.act(memory, rows, here, allowed_rows(engine.mask(), rows), turn)
        recorder.begin(decides, obs[decides], memory, turn.age[decides])
        raw = engine.step(action, rows)
        turn.age[rows] += 1
        step = raw.seen(here, action, turn.age[rows])
        running = memory["skill"][rows]
        end = player.observe(memory, rows, step)
        won = player.succeeded(rows, step, running, memory["elapsed"][rows], end)
        recorder.add(rows, action, raw)
        recorder.finish(rows, end, won, raw)
        obs[rows] = raw.next_obs
        over = rows[raw.terminated | raw.truncated]
        if len(over):
            obs[over] = engine.reset_some(over)
            player.restart(memory, over)
            turn.age[over] = 0
        if recorder.steps >= steps:
            rows = rows[end == CallEnd.RUNNING]
        elif isinstance(choose, LearnsFromCalls) and recorder.steps - planned >= choose.every:
            planned = recorder.steps
            if recorder.calls:
                choose.learn(recorder.log())


class Recorder:
    """Columns of calls in the making.

    Args:
        engine: the environments.
        skills: that act in them.
        info: keys of ``info`` to record.
        steps: about how many are to come.

    Raises:
        DeclarationError: they would take more than 4 GiB.
    """

    def __init__(self, engine: Engine, skills: SkillSet, info: tuple[str, ...], steps: int) -> None:
        self.engine, self.skills, self.info = engine, skills, info
        self.steps = 0
        """Steps that have been recorded."""
        n = engine.num_envs
        self._call = np.full(n, -1)  # the open call of each environment
        self._episode, self._order = np.full(n, -1), np.zeros(n, np.int64)
        self._episodes = self._calls = 0
        self._starts: list[tuple[Array, ...]] = []
        self._ended: list[tuple[Array, ...]] = []
        self._steps: list[tuple[Array, ...]] = []
        self._limit = steps

    @property
    def calls(self) -> int:
        """The number of calls that have ended."""
        return sum(len(part[0]) for part in self._ended)

    def begin(self, rows: Array, obs: Array, memory: Memory, age: Array) -> None:
        """Begin the calls that were chosen in environments ``rows`` (k,), at ``obs`` (k, …).

        ``age`` (k,) are the steps of their episodes so far.
        """
        if not len(rows):
            return
        fresh = rows[self._episode[rows] < 0]
        self._episode[fresh] = self._episodes + np.arange(len(fresh))
        self._episodes += len(fresh)
        call = self._calls + np.arange(len(rows))
        self._calls += len(rows)
        self._call[rows] = call
        choice, lengths = memory["skill"][rows].copy(), self.skills.lengths
        if lengths:
            choice = choice * len(lengths) + np.searchsorted(lengths, memory["limit"][rows])
        episode, order = self._episode[rows].copy(), self._order[rows].copy()
        self._starts.append((call, obs.copy(), choice, episode, order, age.copy()))
        self._order[rows] += 1

    def add(self, rows: Array, action: Array, raw: RawStep) -> None:
        """Add a step of environments ``rows`` (k,)."""
        values = []
        for key in self.info:
            if key not in raw.info:
                raise EnvError(f"info[{key!r}] is to be recorded, but {missing_key(raw.info)}")
            values.append(_numbers(key, raw.info[key], len(rows)))
        part = (self._call[rows].copy(), raw.next_obs.copy(), np.array(action), raw.reward.copy())
        self._steps.append((*part, *values))
        if not self.steps:
            self._check_size(self._steps[0], len(rows))
        self.steps += len(rows)

    def finish(self, rows: Array, end: Array, succeeded: Array, raw: RawStep) -> None:
        """End the calls whose ``end`` (k,) is not RUNNING, in environments ``rows`` (k,)."""
        at = np.flatnonzero(end != CallEnd.RUNNING)
        if len(at):
            may = self.skills.startable(raw.next_obs[at])
            ends = (end[at], succeeded[at], raw.terminated[at], raw.truncated[at])
            self._ended.append((self._call[rows[at]].copy(), *(e.copy() for e in ends), may))
        over = rows[raw.terminated | raw.truncated]
        self._episode[over], self._order[over] = -1, 0

    def log(self) -> CallLog:
        """Return the calls that have ended so far."""
        ended = [np.concatenate(c) for c in zip(*self._ended, strict=True)]
        starts = [np.concatenate(c) for c in zip(*self._starts, strict=True)]
        steps = [np.concatenate(c) for c in zip(*self._steps, strict=True)]
        by_call = np.argsort(ended[0], kind="stable")
        ended = [c[by_call] for c in ended]
        known, of = ended[0], steps[0]
        rows = np.flatnonzero(np.isin(of, known))
        rows = rows[np.argsort(of[rows], kind="stable")]
        counts = np.bincount(of, minlength=self._calls)[known]
        _, start, choice, episode, order, age = (c[known] for c in starts)
        end_reason, succeeded, terminated, truncated, may = ended[1:]
        _, next_obs, action, reward, *info = (c[rows] for c in steps)
        return CallLog(
            tuple(s.name for s in self.skills.skills),
            self.skills.lengths,
            skill_checksums(self.skills),
            seen_places(self.skills),
            tuple(bool(policy.start(1)) for policy in self.skills.policies),
            self.engine.observation_space,
            self.engine.action_space,
            start=start,
            choice=choice.astype(np.int64),
            end_reason=end_reason.astype(np.int8),
            succeeded=succeeded,
            terminated=terminated,
            truncated=truncated,
            episode=episode,
            order=order,
            age=age,
            may_follow=may,
            offset=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            next_obs=next_obs,
            action=action,
            reward=reward.astype(np.float32),
            info=dict(zip(self.info, info, strict=True)),
        )

    def _check_size(self, columns: tuple[Array, ...], n: int) -> None:
        each = sum(column.nbytes for column in columns) // n
        if each * self._limit > MOST_BYTES:
            raise DeclarationError(
                f"a log of {self._limit:,} steps would have {each * self._limit / 2**30:.1f} GiB "
                f"({each:,} bytes a step); at most {MOST_BYTES // 2**30} GiB are recorded: record "
                f"at most {MOST_BYTES // each:,} steps"
            )


def _numbers(key: str, value: Any, n: int) -> Array:
    array = np.asarray(value)
    if array.dtype.kind not in "biuf" or array.shape[:1] != (n,):
        raise EnvError(
            f"info[{key!r}] is to be recorded, but it is {short(value)}; a number for each "
            "environment is needed"
        )
    return array.copy()
