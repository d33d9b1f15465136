"""The declaration of an environment, ``EnvSpec``, and the choice of its engine."""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np

import skillweave.toys  # registers their ids  # noqa: F401
from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import error_text, short, shortened, suggest
from skillweave._internal.notices import notice
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.envs.checked import CheckedEnv, is_batched, refuse_batched
from skillweave.envs.engine import Engine, GymnasiumEngine
from skillweave.envs.env_infos import ActionMasks, random_actions
from skillweave.envs.envpool_engine import EnvPoolEngine
from skillweave.envs.obs_names import Names, ObsNames, names_in
from skillweave.envs.pool import MakePool, envpool, takes_ids
from skillweave.errors import EnvError, MissingExtra, SkillweaveError
from skillweave.policies.infos import batched_infos
from skillweave.policies.spaces import space_of
from skillweave.schema import Check, Threads, check_fields, to_json
from skillweave.spaces import obs_dtype, obs_shape, put_observation
from skillweave.spaces.packing import parts

MOST = 65_536
"""The most environments in one engine."""
SLOW = 50e-6
"""Seconds of a step above which several processes step the environments."""
PIECES = 5
"""The number of timed pieces, to measure the seconds of a step."""
PIECE_STEPS = 50
"""The most steps of a timed piece."""
PIECE_SECONDS = 0.1
"""The most seconds of a timed piece."""
EngineName = Literal["auto", "envpool", "sync"]
Maker = Annotated[
    str | Callable[..., gym.Env[Any, Any]],
    Check(
        "a Gymnasium id, or a function that makes an environment (many environments are made)",
        lambda x: not isinstance(x, gym.Env),
    ),
]
"""A Gymnasium id, or a function that makes an environment."""
Wrappers = Annotated[
    tuple[Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]], ...],
    Check("a tuple of functions that take an environment and return one"),
]
"""Wrappers of an environment, in the order of application."""
PoolMaker = Annotated[
    MakePool, Check("a function of num_envs, threads and seed that makes a pool", callable)
]
"""A function that makes environments side by side."""


class Spaces(NamedTuple):
    """The observation space and the action space of an environment."""

    observation: gym.Space[Any]
    action: gym.Space[Any]


@checked_names
@dataclass(frozen=True)
class EnvSpec:
    """The declaration of an environment, from which any number can be made.

    ```python
    import skillweave as sw

    short = sw.EnvSpec("CartPole-v1", kwargs={"max_episode_steps": 100})
    ```

    Args:
        env: a Gymnasium id, or a function that makes one environment.
        kwargs: passed to ``gymnasium.make``, or to that function; not to ``pool``. A run records
            them, so to train they must be numbers, texts, lists and dicts.
        wrappers: applied to each environment, in this order.
        engine: envpool (C++ threads); sync (Python); auto uses EnvPool where it has the environment
            as Gymnasium defines it, else sync.
        pool: makes the same environments side by side, for training: EnvPool's, perhaps wrapped
            (``PoolWrapper``). Scores are of ``env``; engine sync steps ``env``, too. The pool also
            decides which weights are kept after learning together.
        workers: processes that step environments and act in them during training. None: one for a
            pool; else measured when a run begins: one for each core if steps are slow enough, and
            if a process would not run the program again (see ``multiprocessing``'s start methods).
            The run records the number, because results depend on it. The members of a population
            are split among them; None: one process.
        obs_names: names of an observation's numbers in reports: a name for each, or for a Dict such
            lists by key. None: those of the environment's attribute ``obs_names``.
        check_seed: before training, play a few steps twice from one seed, and once with a second
            environment in between; after training, also in a new environment. Give a notice if the
            outcomes differ. Not in a pool.

    Raises:
        DeclarationError: a field has a wrong type, or fields do not fit each other; the message
            names it.
    """

    env: Maker
    kwargs: dict[str, Any] = field(default_factory=dict)
    wrappers: Wrappers = ()
    engine: EngineName = "auto"
    workers: Threads | None = None
    pool: PoolMaker | None = None
    # These do not make a different environment.
    obs_names: Names | None = field(default=None, compare=False, repr=False)
    check_seed: bool = field(default=True, compare=False, repr=False)
    _spaces: Spaces | None = field(default=None, init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        if is_batched(self.env):
            raise refuse_batched(short(self.env))
        check_fields(self)

    @property
    def spaces(self) -> Spaces:
        """Return the environment's spaces; the first time, make one to read them."""
        return self._spaces or self.read_spaces()

    @global_generators(Seeds(0) / "spaces")
    def read_spaces(self) -> Spaces:
        """Make an environment, and return its spaces.

        Raises:
            EnvError: the environment cannot be made.
        """
        with closing(self.make()) as env:
            spaces = Spaces(env.observation_space, env.action_space)
        object.__setattr__(self, "_spaces", spaces)
        return spaces

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_spaces": None}

    def make(self, render_mode: str | None = None, number: int | None = None) -> CheckedEnv:
        """Make one environment, whose errors name it and its ``number``.

        Args:
            render_mode: Gymnasium's, "rgb_array" for films.
            number: its number in messages.

        Returns:
            The environment, whose steps are checked.

        Raises:
            EnvError: the environment does not exist (with a similar one), or cannot be made.
            MissingExtra: a dependency is not installed.
        """
        try:
            env = self._unchecked(render_mode)
            for wrapper in self.wrappers:
                env = wrapper(env)
        except SkillweaveError:
            raise
        except (Exception, SystemExit) as error:
            which = "" if number is None else f" (environment {number})"
            advice = ""
            if "render mode is none" in str(error).lower():  # RecordVideo's, for example
                advice = "; write EnvSpec(..., kwargs={'render_mode': 'rgb_array'})"
            raise EnvError(
                f"{self.name}{which} could not be made: {error_text(error)}{advice}"
            ) from error
        return CheckedEnv(env, self.name, number)

    def _unchecked(self, render_mode: str | None) -> gym.Env[Any, Any]:
        """Make the environment without wrappers; a film's ``render_mode`` goes before kwargs'."""
        kwargs = dict(self.kwargs)
        if "render_mode" in kwargs:
            own = kwargs.pop("render_mode")
            render_mode = own if render_mode is None else render_mode
            if render_mode == "human":
                notice(
                    f"{self.name}: kwargs has render_mode='human', so each environment draws each "
                    "step in a window, in training, too: leave it out to train; run.render(...) "
                    "makes films without it"
                )
        if isinstance(self.env, str):
            return self._from_registry(self.env, render_mode, kwargs)
        if render_mode is None:
            return self.env(**kwargs)
        try:
            return self.env(render_mode=render_mode, **kwargs)
        except TypeError as error:
            if kwargs and "'render_mode'" not in str(error):
                raise  # it is about kwargs
            raise EnvError(
                f"{self.name} cannot be rendered: the function that makes it must take "
                f"render_mode ({error})"
            ) from error

    def _from_registry(
        self, env_id: str, render_mode: str | None, kwargs: dict[str, Any]
    ) -> gym.Env[Any, Any]:
        """Make an environment by its Gymnasium id; an error names what is not installed."""
        try:
            try:
                return gym.make(env_id, render_mode=render_mode, **kwargs)
            except TypeError as error:
                word = "unexpected keyword argument 'render_mode'"
                if render_mode is not None or word not in str(error):
                    raise
                return gym.make(env_id, **kwargs)  # an environment that cannot be rendered
        except gym.error.DependencyNotInstalled as error:
            if "box2d" in str(error).lower():
                raise MissingExtra(f"the environment {env_id}", "box2d") from error
            raise EnvError(f"the environment {env_id} needs more: {error}") from error
        except (gym.error.Error, ImportError) as error:
            entry = gym.registry.get(env_id)
            if entry is not None and entry.entry_point is None and entry.vector_entry_point:
                raise refuse_batched(env_id) from error
            others = gym.registry.keys() - {env_id}
            advice = suggest(env_id, others, listed=False)
            if not advice and ":" not in env_id:
                advice = (
                    "; if another package registers it, install and import that package, or write "
                    f"its module first: 'module:{env_id}'"
                )
            why = shortened(str(error)).rstrip(".")
            raise EnvError(f"no environment {short(env_id)} ({why}){advice}") from error

    def observation_names(self) -> ObsNames | None:
        """Return the names of an observation's numbers; None: they have no names.

        They are ``obs_names``, else the environment's attribute ``obs_names``, else the names in
        Gymnasium's documentation of its environments.
        """
        if self.obs_names is not None:
            return self.obs_names
        env = self.make()
        try:
            plain = isinstance(self.env, str) and not self.wrappers
            return names_in(env, str(self.env) if plain else None)
        finally:
            env.close()

    @property
    def name(self) -> str:
        """Return the id, or the name of the function."""
        if isinstance(self.env, str):
            return self.env
        return str(getattr(self.env, "__name__", type(self.env).__name__))

    @property
    def json_kwargs(self) -> dict[str, Any]:
        """Return ``kwargs`` in the form that a run records.

        Raises:
            DeclarationError: a value cannot be recorded; the message names it and proposes a
                function.
        """
        recorded = {}
        function = self.name if self.name.isidentifier() else "your_function"
        known = isinstance(self.env, str)
        call = f"gymnasium.make({self.env!r}, " if known else f"{function}("
        for name, value in self.kwargs.items():
            recorded[name] = to_json(
                value,
                f"{self.name}: kwargs[{name!r}]",
                f"put it into a function, and pass that as env: def make(): return {call}"
                f"{name}=...)",
            )
        return recorded

    @property
    def is_data(self) -> bool:
        """Return whether an id and plain settings define the environment, without user code."""
        plain = not self.wrappers and self.pool is None
        return isinstance(self.env, str) and ":" not in self.env and plain


def make_engine(spec: EnvSpec, num_envs: int, threads: int | None = None, first: int = 0) -> Engine:
    """Return the engine for ``num_envs`` environments of this kind.

    Args:
        threads: threads of EnvPool's pool; None: one for each core.
        first: the number of the first environment, for messages.
    """
    if num_envs > MOST:
        raise EnvError(f"{num_envs:,} environments of {spec.name}: at most {MOST:,} are made")
    if spec.engine in ("auto", "envpool"):
        reference = spec.make()
        try:
            if (make := _pool_of(spec, reference)) is not None:
                return EnvPoolEngine(make, spec.name, num_envs, threads or cores(), reference)
        finally:
            reference.close()
        if spec.engine == "envpool":
            raise EnvError(
                f"EnvPool cannot run {spec.name}: it is not installed (extra 'envpool'), or "
                "lacks the environment with these spaces, settings and wrappers; use engine='auto'"
            )
    return GymnasiumEngine(spec.make, num_envs, spec.name, first, spec.check_seed)


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def workers_for(spec: EnvSpec) -> int:
    """Return the number of processes that step the environments: the spec's, or measured.

    A step of one environment is timed, a few hundred times if it is fast. If it is slow, each core
    gets a process, else one process steps all.
    """
    if spec.workers is not None:
        return spec.workers
    if cores() < 2:
        return 1
    env = spec.make()
    try:
        if in_pool(spec, env):
            return 1
        return cores() if _step_seconds(env) > SLOW else 1
    finally:
        env.close()


def in_pool(spec: EnvSpec, reference: gym.Env[Any, Any]) -> bool:
    """Return whether ``make_engine`` makes a pool of this environment."""
    return spec.engine != "sync" and _pool_of(spec, reference) is not None


def _pool_of(spec: EnvSpec, reference: gym.Env[Any, Any]) -> MakePool | None:
    """Return the function that makes pools of this environment; None: it has none."""
    if spec.pool is not None:
        return spec.pool if _fits(spec, spec.pool, reference) else None
    plain = isinstance(spec.env, str) and not spec.kwargs and not spec.wrappers
    if plain and EnvPoolEngine.supports(str(spec.env), reference):
        return functools.partial(envpool, str(spec.env))
    return None


def _fits(spec: EnvSpec, make: MakePool, reference: gym.Env[Any, Any]) -> bool:
    """Return whether the user's pool can be made.

    Raises:
        EnvError: it is a pool of another environment.
    """
    try:
        pool = make(num_envs=1, threads=1, seed=0)
    except MissingExtra:
        return False
    if isinstance(pool, gym.vector.VectorEnv) and not takes_ids(pool):
        raise EnvError(
            f"{spec.name}: pool made {short(pool)}, a VectorEnv, which steps all its environments "
            "at once; a pool must step some while the others do not change, as EnvPool does: omit "
            "pool, and each environment is stepped by itself"
        )
    for what in ("observation_space", "action_space"):
        theirs, ours = getattr(pool, what), getattr(reference, what)
        if not _alike(theirs, ours):
            raise EnvError(
                f"{spec.name}: its pool's {what} is {short(theirs)}, but the environment's is "
                f"{short(ours)}; wrap the pool in a PoolWrapper that makes them equal"
            )
    return True


def _alike(a: gym.Space[Any], b: gym.Space[Any]) -> bool:
    """Return whether spaces of an environment and its pool have the same kind, shape and type."""
    if not isinstance(a, type(b)) or a.shape != b.shape or a.dtype != b.dtype:
        return False
    ones, others = parts(a) or {}, parts(b) or {}
    return ones.keys() == others.keys() and all(_alike(ones[k], others[k]) for k in ones)


def _step_seconds(env: gym.Env[Any, Any]) -> float:
    """Measure the seconds of a random step: the least of several means, to exclude load."""
    space = env.observation_space
    rng = np.random.default_rng(0)
    masks = ActionMasks(env.action_space, 1, space)
    means = []
    form = space_of(env.action_space)

    def see(obs: Any, info: dict[str, Any], ended: bool = False) -> None:
        batch = np.zeros((1, *obs_shape(space)), obs_dtype(space))
        put_observation(space, batch, 0, obs)
        masks.see(batched_infos([info]), ended=np.array([ended]), obs=batch)

    see(*env.reset(seed=0))
    for _ in range(PIECES):
        spent = 0.0
        steps = 0
        until = time.perf_counter() + PIECE_SECONDS
        while steps == 0 or (steps < PIECE_STEPS and time.perf_counter() < until):
            drawn = random_actions(env.action_space, 1, rng, masks.now)
            action = form.unpacked(drawn[0])
            began = time.perf_counter()
            obs, _, terminated, truncated, info = env.step(action)
            spent += time.perf_counter() - began
            steps += 1
            see(obs, info, terminated or truncated)
            if terminated or truncated:
                see(*env.reset())
        means.append(spent / steps)
    return min(means)
