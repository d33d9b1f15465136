"""Policies as values: how they act in N environments at once, and what they remember there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .acting_errors import SkillError
from .infos import with_missing

Array: TypeAlias = NDArray[Any]
Memory: TypeAlias = dict[str, Any]
"""Arrays whose first axis is the environment, and the memories of parts, by name."""


class CallEnd(IntEnum):
    """Reason why a call ended."""

    RUNNING = 0
    """It has not ended."""
    OWN = 1
    """The skill's ``termination`` ended it, perhaps in the episode's last step."""
    LIMIT = 2
    """A limit was reached: ``max_steps``, ``call_steps``, or the length that was chosen."""
    INTERRUPTED = 3
    """The selector ended it, as a new decision was worth more."""
    EPISODE = 4
    """The episode ended the call, or has just started: no call runs."""


RUNNING, OWN, LIMIT, INTERRUPTED, EPISODE = map(int, CallEnd)
"""``CallEnd`` as plain integers, with which arrays are compared six times as fast."""


def end_with_episode(end: Array, over: Array) -> None:
    """Set in ``end`` (n,) that episodes ended running calls, but for those that ended themselves.

    Args:
        over: (n,) bool, the episode is over.
    """
    end[over & (end != OWN)] = EPISODE


# Steps ------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Step:
    """An environment transition in the form that a skill's methods receive, of N environments.

    Its arrays are read-only, because they are shared.

    ``elapsed`` counts the steps of the current episode or call, this one included (so it is 1
    on the first). ``timed_out`` is True where the skill's ``max_steps`` ended the call. ``goal`` is
    what the call is for, where the skill has goals (``Skill.goal_space``).
    """

    obs: Array  # (N, *obs_shape)
    action: Array  # (N,) or (N, *action_shape)
    next_obs: Array  # (N, *obs_shape), always the true successor
    reward: Array  # (N,) float32, the environment's own reward
    terminated: Array  # (N,) bool
    truncated: Array  # (N,) bool, the environment's time limit
    timed_out: Array  # (N,) bool, the skill's time limit
    elapsed: Array  # (N,) int64, steps
    info: Mapping[str, Any]  # the environment's, arrays over N
    goal: Any = None  # (N, *goal_shape), the same in all steps of a call; None: a skill without

    def __post_init__(self) -> None:
        # Runs in every step of training: a loop over the names takes three times as long.
        self.obs = read_only(self.obs)
        self.next_obs = read_only(self.next_obs)
        self.action = read_only(self.action)
        self.reward = read_only(self.reward)
        self.terminated = read_only(self.terminated)
        self.truncated = read_only(self.truncated)
        self.timed_out = read_only(self.timed_out)
        self.elapsed = read_only(self.elapsed)
        if self.goal is not None:
            self.goal = read_only(self.goal)


@dataclass(frozen=True)
class InCall:
    """The time of a call, for a function of a ready policy's ``sees`` that takes ``call``.

    Time starts where the skill takes over; a skill that is called again at once goes on.
    """

    steps: Array
    """(n,) int64, the steps since then, and ``entry`` more."""
    start: Array
    """(n, *obs_shape), the observations of that step."""
    entry: int = 0
    """The step at which the policy starts, of ``from_onnx(..., entry=)``."""


def read_only(array: Array) -> Array:
    """Return a view that cannot be written to."""
    view = array.view()
    view.setflags(False)  # type: ignore[call-arg]  # a keyword takes three times as long
    return view


def part_of(
    step: Step,
    elapsed: Array,
    rows: Array | None = None,
    max_steps: int | None = None,
    goal: Array | None = None,
) -> Step:
    """Return a step as an acting skill sees it, with steps and a limit of its own call.

    Args:
        elapsed: (m,) steps so far, this one included.
        rows: (m,) ascending, some rows of the step; None: all.
        max_steps: steps after which its time is over; None: never.
        goal: (m, *goal_shape); None: it has no goals.
    """
    every = rows is None or len(rows) == len(step.reward)  # then there is nothing to copy
    at = slice(None) if every else rows
    terminated = step.terminated[at]
    late = np.zeros(len(terminated), bool)
    if max_steps is not None:
        late = (elapsed >= max_steps) & ~terminated
    info = step.info if rows is None or every else info_rows(step.info, rows, len(step.reward))
    return Step(
        step.obs[at],
        step.action[at],
        step.next_obs[at],
        step.reward[at],
        terminated,
        step.truncated[at],
        late,
        elapsed,
        info,
        goal,
    )


def info_rows(info: Mapping[str, Any], rows: Array, n: int) -> dict[str, Any]:
    """Return ``rows`` (k,) of a batched info, nested dicts too, for the policy that acts there.

    Values that are not arrays over the n environments are returned unchanged.
    """
    part = {key: _rows(value, rows, n) for key, value in info.items()}
    return with_missing(part, info, len(rows))


def _rows(value: Any, rows: Array, n: int) -> Any:
    if isinstance(value, dict):
        return info_rows(value, rows, n)
    batched = isinstance(value, np.ndarray) and value.ndim > 0 and len(value) == n
    return value[rows] if batched else value


OWN_REWARD = "env_reward"
OWN_SUCCESS = "env_success"
SUCCESS = "success"
"""Keys of info: the first two where a task gives the reward and says what success is."""


def own_step(step: Step) -> Step:
    """Return a task's step, for a policy that acts, as the environment itself gave it.

    A task's environment (``planning.task_env``) has the task's reward and success, and keeps the
    environment's own in ``info``. A step of another environment is returned unchanged.
    """
    if OWN_REWARD not in step.info:
        return step
    info = {k: v for k, v in step.info.items() if k.removeprefix("_") not in (SUCCESS, OWN_REWARD)}
    for mark in ("", "_"):  # batches mark under "_key" where a key is there
        if mark + OWN_SUCCESS in info:
            info[mark + SUCCESS] = info.pop(mark + OWN_SUCCESS)
    reward = np.asarray(step.info[OWN_REWARD], np.float32)
    return replace(step, reward=reward, info=with_missing(info, step.info, len(reward)))


@dataclass(frozen=True, slots=True)
class LastCall:
    """The last call of n environments, and how it ended; RUNNING where it has not."""

    skill: Array  # (n,) int64, its place in the hierarchy's list; −1: the episode has just begun
    why: Array  # (n,) int8, ``CallEnd`` it ended
    succeeded: Array  # (n,) bool: by the skill's success(), where it has none by its own end


# Policies ---------------------------------------------------------------------------------------


@dataclass(slots=True)
class World:
    """The state of all N environments while policies act in them."""

    rng: np.random.Generator | None = None
    """The source of chance for policies that sample."""
    age: Array | None = None
    """(N,), steps of the episodes so far, for messages."""
    last_action: Array | None = None
    """(N, …), the last actions of the environments; None: nobody needs them."""
    acted: Array | None = None
    """(N,) bool, where their episodes have a last action; None: where ``age`` is over 0."""
    overridden: Array | None = None
    """(N,) bool, set where a reflex acts."""
    trace: Any = None
    """Writer of learning policies' columns, ``write(rows, **columns)``; None: none is kept."""

    def has_acted(self, rows: Array) -> Array:
        """Return where the last action is of the episode in environments ``rows``, (k,) bool."""
        if self.acted is not None:
            return np.asarray(self.acted[rows])
        nowhere = np.zeros(len(rows), bool)
        return nowhere if self.age is None else np.asarray(self.age[rows] > 0)


@dataclass(slots=True)
class Turn:
    """The way to act in k of these environments."""

    world: World
    mask: Array | None = None
    """(k, A) bool, what is allowed; None: all."""
    goal: Array | None = None
    """(k, *goal_shape), what the call is for; None: the policy has no goals."""
    greedy: bool = True
    """Else it samples."""

    def some(self, at: Array) -> Turn:
        """Return the turn of some of these rows."""
        mask, goal = self.mask, self.goal
        return Turn(
            self.world,
            None if mask is None else mask[at],
            None if goal is None else goal[at],
            self.greedy,
        )


class Choices:
    """The numbers that a selector chooses: the first skill with each length, then the next skill.

    Without lengths, a number is the place of a skill.
    """

    skills: Any
    lengths: Any

    @property
    def each(self) -> int:
        """The number of choices of each skill."""
        return max(1, len(self.lengths))

    @property
    def choices(self) -> int:
        """The number of choices."""
        return len(self.skills) * self.each

    def skill_of(self, choice: Any) -> Any:
        """Return the places of the skills that choices are of."""
        return choice // self.each


class RowPolicy:
    """A policy in some of N environments; the base of all, complete for those without memory."""

    watches = False
    """``observe`` has something to notice."""
    restricts = False
    """It may not start everywhere."""
    fresh_calls = False
    """Each call with a goal begins with a fresh memory."""
    holds = False
    """The last action of the environment counts."""
    forgets = False
    """It begins something anew where it is called again at once."""

    def start(self, n: int) -> Memory:
        """Return the memory of n environments in which it has not acted yet."""
        return {}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return actions (k, …) in environments ``rows`` (k,); ``obs`` and ``turn`` are of these.

        Args:
            memory: of all N environments; changed in place.
        """
        raise NotImplementedError

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Notice a step of environments ``rows`` (k,); ``memory`` is changed in place."""

    def again(self, memory: Memory, rows: Array) -> None:
        """Begin anew, in environments ``rows`` (k,), what is not to outlast a call.

        Only where its skill is called again at once; after another skill all begins anew.
        """

    def startable(self, obs: Array) -> Array:
        """Return where it may start, (k,) bool, for observations (k, …)."""
        return np.ones(len(obs), bool)

    def stuck(self, memory: Memory, rows: Array, obs: Array) -> Array | bool:
        """Return where it cannot go on, (k,) bool."""
        return False

    def redraws(self, greedy: bool) -> bool:
        """Return whether it may choose otherwise for the same observations."""
        return not greedy

    def check(self, sees: Any, acts: Any, goal: Any, where: str) -> None:
        """Raise a PolicyError where it does not fit these spaces: it may be from a file.

        Args:
            sees: ``Space`` of its observations.
            acts: ``Space`` of its actions.
            goal: of the calls that it acts in; None: they have none.
            where: begins the message.
        """


@dataclass(eq=False)
class Around(RowPolicy):
    """A policy that changes what another one sees or does; the base of combinators.

    It forwards every method of a ``RowPolicy``.
    """

    policy: RowPolicy

    def __post_init__(self) -> None:
        policy = self.policy
        self.watches = policy.watches
        self.restricts = policy.restricts
        self.fresh_calls = policy.fresh_calls
        self.holds = policy.holds
        self.forgets = policy.forgets

    def start(self, n: int) -> Memory:
        """Return the policy's fresh memory."""
        return self.policy.start(n)

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the policy's actions."""
        return self.policy.act(memory, rows, obs, turn)

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Let the policy notice a step."""
        self.policy.observe(memory, rows, step)

    def again(self, memory: Memory, rows: Array) -> None:
        """Let the policy begin anew what is not to outlast a call."""
        self.policy.again(memory, rows)

    def startable(self, obs: Array) -> Array:
        """Return where the policy may start."""
        return self.policy.startable(obs)

    def stuck(self, memory: Memory, rows: Array, obs: Array) -> Array | bool:
        """Return where the policy cannot go on."""
        return self.policy.stuck(memory, rows, obs)

    def redraws(self, greedy: bool) -> bool:
        """Return whether the policy may choose otherwise where it is asked the same again."""
        return self.policy.redraws(greedy)

    def check(self, sees: Any, acts: Any, goal: Any, where: str) -> None:
        """Check the policy."""
        self.policy.check(sees, acts, goal, where)


def innermost(policy: RowPolicy) -> RowPolicy:
    """Return the policy inside of all combinators."""
    while isinstance(policy, Around):
        policy = policy.policy
    return policy


def code(what: str, label: str = "", *, needed: bool = True) -> Any:
    """Return a field of a policy with a user's function, which exports name and do not write.

    Args:
        what: what it takes and returns, for the list of functions that an export needs.
        label: its name there, after that of the skill; "": the function's own.
        needed: else it may be None.
    """
    metadata = {"what": what, "label": label}
    return field(metadata=metadata) if needed else field(default=None, metadata=metadata)


CallUser: TypeAlias = Callable[[Callable[..., Any], Any, Array, str, str], Array]
"""A caller of users' functions: takes a function, a step or observations, their rows (k,), the
skill's path and the function's name, and returns its answer, (k,) bool."""


def call_plainly(
    function: Callable[..., Any], about: Any, rows: Array, path: str, name: str
) -> Array:
    """Call a function of a policy as exports do, without the library's long messages.

    Raises:
        SkillError: it did not return (k,) bool.
    """
    found = np.asarray(function(about))
    if found.shape != (len(rows),) or found.dtype.kind not in "biuf":
        raise SkillError(
            f"{path!r}: {name}() returned {found.dtype} of shape {found.shape}, but ({len(rows)},) "
            "bool was expected: one yes or no for each environment"
        )
    return found.astype(bool, copy=False)


def observed(obs: Array) -> str:
    """Return an observation for a message, in one line, its middle left out where it is long."""
    text = " ".join(np.array2string(obs, precision=3, threshold=20).split())
    return text if len(text) <= 200 else f"{text[:100]} ... {text[-100:]}"


# Memories ---------------------------------------------------------------------------------------


def put(memory: Memory, rows: Array, values: Memory) -> None:
    """Write an acting policy's memory of environments ``rows`` (k,) in place."""
    for k, v in values.items():
        if isinstance(v, dict):
            put(memory[k], rows, v)
        else:
            memory[k][rows] = v


def take(memory: Memory, rows: Array) -> Memory:
    """Return a copy of the memory of environments ``rows`` (k,)."""
    return {k: take(v, rows) if isinstance(v, dict) else v[rows] for k, v in memory.items()}


def restart(policy: RowPolicy, memory: Memory, rows: Array) -> None:
    """Start new episodes in environments ``rows`` (k,): nothing of earlier ones is remembered."""
    put(memory, rows, policy.start(len(rows)))


def flat(memory: Memory, prefix: str = "") -> dict[str, Array]:
    """Return the arrays of a policy's memory, the same ones, by dotted names."""
    found: dict[str, Array] = {}
    for k, v in memory.items():
        found |= flat(v, f"{prefix}{k}.") if isinstance(v, dict) else {prefix + k: v}
    return found


def nested(like: Memory, arrays: Mapping[str, Array], prefix: str = "") -> Memory:
    """Return arrays by dotted names as a policy's memory, as of ``like``; undoes ``flat``."""
    return {
        k: nested(v, arrays, f"{prefix}{k}.") if isinstance(v, dict) else arrays[prefix + k]
        for k, v in like.items()
    }


def split(arrays: Mapping[str, Array]) -> Memory:
    """Return arrays by dotted names as a policy's memory; empty parts are left out."""
    found: Memory = {}
    for name, value in arrays.items():
        *parts, last = name.split(".")
        inside = found
        for part in parts:
            inside = inside.setdefault(part, {})
        inside[last] = value
    return found
