"""Checks that environments follow Gymnasium's API; errors name the environment and the step.

``CheckedEnv`` checks the return values of one environment, in its process. ``Watch`` checks the
numbers of all environments at once, in a few microseconds per step, with any engine.
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import error_text, short
from skillweave._internal.notices import notice
from skillweave._internal.rewards import LARGEST_REWARD, wrong_reward
from skillweave.envs.env_infos import MASK, observes_mask
from skillweave.envs.image_bounds import ImageBounds
from skillweave.envs.pool import first_row
from skillweave.errors import EnvError, SkillweaveError
from skillweave.policies.core import Array
from skillweave.policies.floats import by_program
from skillweave.policies.spaces import at, space_of
from skillweave.spaces import choice_counts, obs_shape
from skillweave.spaces.packing import leaf_spaces, parts

LONGEST_EPISODE = 100_000
"""Steps after which an engine truncates an episode that has not ended before."""
LARGEST_SEEN = float(np.finfo(np.float32).max)
"""The largest size of a number in an observation: networks compute in float32."""
COARSE = 2.0**24
"""Size from which float32 cannot represent all whole numbers."""
LONG_EPISODE = 10_000
"""Steps after which an evaluation or a video ends an episode without a known time limit; training
gives a notice."""

LIKE_MASKS = (
    "action_masks",
    "legal_actions",
    "legal_moves",
    "valid_actions",
    "available_actions",
    "avail_actions",
    "valid_action_mask",
    "legal_action_mask",
    "valid_moves",
)
"""Keys of masks in other libraries."""
LIKE_METHODS = (
    "action_masks",
    "get_action_mask",
    "valid_action_mask",
    "get_avail_actions",
    "legal_actions",
)
"""Attributes that return masks in other libraries, ``action_masks`` if it is not a method."""
LAST_OBSERVATIONS = ("final_obs", "final_observation", "terminal_observation")
"""Keys of info with an episode's last observation, where the environment resets itself."""
_REWARDS = f"it must be finite, and at most {LARGEST_REWARD:g} in size: learners square it"


def is_batched(env: object) -> bool:
    """Return whether ``env`` is a simulator of many environments at once, or its class."""
    kind = env if isinstance(env, type) else type(env)
    if issubclass(kind, gym.Env):
        return False
    return issubclass(kind, gym.vector.VectorEnv) or (
        hasattr(env, "num_envs") and hasattr(env, "step_async")  # Stable-Baselines3's
    )


def refuse_batched(name: str) -> EnvError:
    """Return the error for an environment that ``is_batched``."""
    return EnvError(
        f"{name} steps many environments at once (a VectorEnv), and Skillweave steps each by "
        "itself, as some stand still while others act; write a gymnasium.Env around a simulator of "
        "one environment (num_envs=1), and give that: the documentation has its lines, under "
        "'Robots', 'Simulators that step many at once'"
    )


class CheckedEnv(gym.Wrapper[Any, Any, Any, Any]):
    """An environment whose exceptions and invalid return values raise with its number and step.

    Args:
        env: the environment.
        name: its name in messages.
        number: its number among several.

    Raises:
        EnvError: the environment has no spaces; later, it raised or returned an invalid value.
    """

    def __init__(self, env: gym.Env[Any, Any], name: str, number: int | None = None) -> None:
        if is_batched(env):
            raise refuse_batched(name)
        if not isinstance(env, gym.Env):
            raise EnvError(f"{name} made {short(env)}, which is no environment (no gymnasium.Env)")
        super().__init__(env)
        self._name = name
        self._number = number
        self._elapsed = 0
        for kind in ("observation_space", "action_space"):
            space = getattr(env, kind, None)
            if not isinstance(space, gym.Space):
                raise EnvError(f"{name}: {kind} is {short(space)}; it must be a Gymnasium space")
        self._fits = _fits(env.observation_space)
        for wrapper in _wrappers(env):
            _refuse_changing(wrapper, name)
        self._drawn_spaces = _drawn_spaces(env)
        self._looked = number != 0  # only the first of several is checked
        self._chooses = bool(choice_counts(env.action_space))
        masks = _attribute(env, "action_masks") if self._chooses else None
        self._masks = masks if _takes_nothing(masks) else None
        """The method of masks that sb3-contrib's MaskablePPO also calls."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Reset the environment and check the result."""
        self._elapsed = 0
        if seed is not None:
            for i, space in enumerate(self._drawn_spaces, 1):  # not the stream of env.np_random
                space.seed((seed + i * 0x5BD1E995) % 2**31)
        reset = partial(self.env.reset, seed=seed, options=options)
        values = self._called(reset, "reset()")
        self._check(values, 2, "reset() returned", "obs, info")
        obs, info = values
        if not self._looked:
            self._looked = True
            self._look_for_masks(info)
        return obs, self._with_mask(info) if self._chooses else info

    def step(self, action: Any) -> Any:
        """Step the environment and check the result."""
        self._elapsed += 1
        values = self._called(self.env.step, "step()", action)
        needed = "five: obs, reward, terminated, truncated, info"
        self._check(values, 5, "step() returned", needed)
        obs, reward, terminated, truncated, info = values
        if type(reward) is not float:
            reward = float(self._scalar(reward, "its reward", "a number"))
        if not -LARGEST_REWARD <= reward <= LARGEST_REWARD:
            raise self._wrong(f"its reward is {reward}; {_REWARDS}")
        if type(terminated) is not bool:
            terminated = self._flag(terminated, "terminated")
        if type(truncated) is not bool:
            truncated = self._flag(truncated, "truncated")
        if terminated or truncated:
            obs, info = last_observation(obs, info, self.env)
        if self._chooses:
            info = self._with_mask(info, over=terminated or truncated)
        return obs, reward, terminated, truncated, info

    def _check(self, values: Any, size: int, returned: str, needed: str) -> None:
        """Raise an EnvError where ``reset`` or ``step`` returned no observation and info."""
        if not isinstance(values, tuple) or len(values) != size:
            many = isinstance(values, tuple)
            what = f"{len(values)} values" if many else f"a {type(values).__name__}"
            raise self._wrong(f"{returned} {what}; Gymnasium needs {needed}")
        if not self._fits(values[0]):
            raise self._wrong(f"its observation{_misfit(self.env.observation_space, values[0])}")
        if not isinstance(values[-1], dict):
            raise self._wrong(f"its info is {short(values[-1])}; it must be a dict")

    def _called(self, function: Callable[..., Any], name: str, *args: Any) -> Any:
        """Return the result of a function of the environment."""
        try:
            return by_program(function, *args)
        except SkillweaveError:
            raise
        except (Exception, SystemExit) as error:
            raise self._wrong(f"{name} raised {error_text(error)}") from error

    def _look_for_masks(self, info: dict[str, Any]) -> None:
        """Give a notice where a key or attribute that is not used looks like an action mask."""
        space = self.env.observation_space
        actions = self.env.action_space
        observed = space.spaces if isinstance(space, gym.spaces.Dict) else {}
        if not self._chooses:
            real = isinstance(actions, gym.spaces.Box) and np.issubdtype(actions.dtype, np.floating)
            if not real and (  # nobody expects real numbers to have masks
                MASK in info or MASK in observed or _attribute(self.env, "action_masks") is not None
            ):
                notice(
                    f"{self._name}: its action mask is not used, as actions of {short(actions)} "
                    "are real numbers alone, none of which can be forbidden"
                )
            return
        if self._masks is not None or MASK in info or observes_mask(space, actions):
            return
        names = (MASK, *LIKE_MASKS)
        similar = [f"info[{n!r}]" for n in names if n in info]
        similar += [f"the observation's {n!r}" for n in names if n in observed]
        similar += [f"its {n}" for n in LIKE_METHODS if _attribute(self.env, n) is not None]
        if similar:
            notice(
                f"{self._name}: {similar[0]} looks like an action mask, but is not used as one: "
                f"every action counts as allowed. Give info['{MASK}'] in reset() and step(), or a "
                f"method action_masks(): a number for each choice of {actions}, 0 where it is "
                "forbidden"
            )

    def _with_mask(self, info: dict[str, Any], *, over: bool = False) -> dict[str, Any]:
        """Return the info with its mask as (A,) bool, from the info or ``action_masks()``.

        Args:
            over: the episode has ended, so no action needs to be allowed.
        """
        if MASK in info:
            mask = info[MASK]
        elif self._masks is None or over:
            return info
        else:
            mask = self._called(self._masks, "action_masks()")
        others = {key: value for key, value in info.items() if key != MASK}
        if mask is None:  # all actions are allowed
            return others
        try:
            return {**others, MASK: space_of(self.env.action_space).allowed(mask)}
        except ValueError as error:
            raise self._wrong(str(error)) from error

    def close(self) -> None:
        """Close the environment; an error becomes a notice, so no result is lost."""
        try:
            super().close()
        except (Exception, SystemExit) as error:
            notice(
                f"{self._name}: close() raised {error_text(error)}. The training result is kept, "
                "but resources of the environment may not have been released"
            )

    def _scalar(self, value: Any, which: str, needed: str) -> Array:
        """Return the only number in a value, ()."""
        try:
            array = np.asarray(value)
        except Exception:
            array = np.asarray(None)
        if array.dtype.kind not in "fiub" or array.size != 1:
            raise self._wrong(f"{which} is {short(value)}; it must be {needed}")
        return array.reshape(())

    def _flag(self, value: Any, which: str) -> bool:
        """Return ``terminated`` or ``truncated`` of an environment as a bool."""
        needed = "True or False"
        number = self._scalar(value, which, needed)
        if number not in (0, 1):
            raise self._wrong(f"{which} is {short(value)}; it must be {needed}")
        return bool(number)

    def _wrong(self, what: str) -> EnvError:
        where = f"environment {self._number}, " if self._number is not None else ""
        return EnvError(f"{self._name}: {where}step {self._elapsed} of its episode: {what}")


def _attribute(env: gym.Env[Any, Any], name: str) -> Any:
    """Return an attribute of an environment or of one of its wrappers; None: it has none.

    Looks up attributes statically: an environment may forward any name to a server.
    """
    for layer in (*_wrappers(env), env.unwrapped):
        if inspect.getattr_static(layer, name, None) is not None:
            return getattr(layer, name)
    return None


def _takes_nothing(method: Any) -> bool:
    """Return whether an attribute of an environment can be called without arguments."""
    if not callable(method):
        return False
    try:
        inspect.signature(method).bind()
    except (TypeError, ValueError):
        return False
    return True


def _wrappers(env: gym.Env[Any, Any]) -> Iterator[gym.Wrapper[Any, Any, Any, Any]]:
    """Yield the wrappers of an environment, outermost first."""
    while isinstance(env, gym.Wrapper):
        yield env
        env = env.env


def _drawn_spaces(env: gym.Env[Any, Any]) -> list[gym.Space[Any]]:
    """Return the spaces from which an environment and its wrappers may draw.

    A space that stands in a class is copied, so that each environment draws from its own. The copy
    becomes an attribute of the environment, whose code draws by ``self.action_space``: to exchange
    the generator of the class's space around each call would change an object of all environments.
    """
    by_id: dict[int, gym.Space[Any]] = {}
    for layer in (env.unwrapped, *_wrappers(env)):
        for kind in ("action_space", "observation_space"):
            shared = inspect.getattr_static(type(layer), kind, None)
            if isinstance(shared, gym.Space) and kind not in vars(layer):
                setattr(layer, kind, copy.deepcopy(shared))
            if isinstance(space := getattr(layer, kind, None), gym.Space):
                by_id[id(space)] = space
    return list(by_id.values())


def last_observation(obs: Any, info: dict[str, Any], env: Any) -> tuple[Any, dict[str, Any]]:
    """Return the true last observation of an episode, and ``info`` without it.

    An environment that resets itself returns the first observation of the next episode, and puts
    the last one into ``info``, perhaps as a batch of one; its wrappers have not converted that.

    Args:
        obs, info: of the last step.
        env: the environment that returned them.
    """
    for key in LAST_OBSERVATIONS:
        value = info.get(key)
        if value is None or not np.all(info.get(f"_{key}", True)):
            continue
        fits = _fits(env.observation_space)
        for unbatched in (copy.copy, first_row):
            with suppress(Exception):
                last = unbatched(value)
                for layer in reversed(list(_wrappers(env))):
                    if isinstance(layer, gym.ObservationWrapper):
                        last = layer.observation(last)
                if fits(last):
                    return last, {k: v for k, v in info.items() if k != key}
        notice(
            f"info[{key!r}] at an episode's end is {_described(value)}, which is not in the "
            f"observation_space {short(env.observation_space, 200)}, so it is not used. If the "
            "environment resets itself, put the episode's last observation there"
        )
    return obs, info


_INSTEAD = {
    "NormalizeObservation": "algorithms normalise observations themselves (normalize_obs=True) and "
    "save the statistics with the policy",
    "NormalizeReward": "algorithms scale rewards themselves (normalize_returns=True of PPO, "
    "normalize_rewards=True of DQN, TD3 and SAC), and scores stay in the environment's own unit",
}
"""Settings that replace Gymnasium's wrappers of changing statistics."""


def _refuse_changing(wrapper: gym.Wrapper[Any, Any, Any, Any], name: str) -> None:
    """Raise an EnvError where a wrapper has statistics that change while it is used."""
    for kind, instead in _INSTEAD.items():
        changing = getattr(wrapper, "update_running_mean", True)
        if isinstance(wrapper, getattr(gym.wrappers, kind)) and changing:
            raise EnvError(
                f"{name}: the wrapper {type(wrapper).__name__} changes while it is used, "
                "differently in each environment, and its statistics are not saved with a "
                f"policy. Omit it: {instead}. (With fixed statistics, set its "
                "update_running_mean = False)"
            )


def time_limit(env: gym.Env[Any, Any]) -> int | None:
    """Return the steps after which an environment truncates its episodes; None: unknown."""
    frames = None if env.spec is None else env.spec.kwargs.get("max_num_frames_per_episode")
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.TimeLimit):
            return int(env._max_episode_steps)
        env = env.env
    return frames if isinstance(frames, int) and frames > 0 else None  # Atari's limit


def longest_evaluation(limit: int | None) -> int:
    """Return the steps after which an evaluation truncates an episode, for a time limit."""
    return min(limit or LONG_EPISODE, LONGEST_EPISODE)


class Watch:
    """A counter of N environments' steps that checks that all numbers are finite.

    Args:
        name: the environment's name in messages.
        space: the space of one observation.
        num_envs: N.
        first: the number of the first environment, for messages.
    """

    def __init__(self, name: str, space: gym.Space[Any], num_envs: int, first: int = 0) -> None:
        self._name = name
        self._first = first
        # Floats, and whole numbers that float32 may not represent.
        self._places = [
            place
            for place, leaf in leaf_spaces(space).items()
            if isinstance(leaf, gym.spaces.Box)
            and (leaf.dtype.kind == "f" or (leaf.dtype.kind in "iu" and leaf.dtype.itemsize >= 4))
        ]
        self._elapsed = np.zeros(num_envs, np.int64)
        self._coarse_noticed = first != 0  # only the first of several gives notices
        self._bounds = ImageBounds(name, space) if first == 0 else None

    def check_reset(self, obs: Array, ids: Array) -> None:
        """Check the first observations of environments ``ids`` (n,).

        Raises:
            EnvError: an observation is not finite; the message names the environment.
        """
        self._elapsed[ids] = 0
        self._check(obs, ids)

    def check_step(self, raw: Any, ids: Array) -> None:
        """Check the result (a ``RawStep``) of a step of environments ``ids`` (n,).

        Raises:
            EnvError: an observation or a reward is not finite; the message names the
                environment and the step.
        """
        self._elapsed[ids] += 1
        self._check(raw.next_obs, ids)
        if (row := wrong_reward(raw.reward)) is not None:
            raise self._wrong(row, ids, f"its reward is {raw.reward[row]}; {_REWARDS}")

    def too_long(self, ids: Array) -> Array:
        """Return where episodes of environments ``ids`` reach ``LONGEST_EPISODE``, (n,) bool."""
        reached: Array = self._elapsed[ids] >= LONGEST_EPISODE
        return reached

    def _check(self, obs: Array, ids: Array) -> None:
        """Check that all numbers in observations of environments ``ids`` are finite."""
        for place in self._places:
            part = at(obs, place)
            coarse = part.dtype.itemsize > 4
            real = part.dtype.kind == "f"
            if not real and self._coarse_noticed:
                continue
            size = np.abs(part) if coarse or not real else part
            if real:
                fits = size <= LARGEST_SEEN if coarse else np.isfinite(part)
                if b"\0" in fits.tobytes():  # for small arrays twice as fast as all()
                    raise self._out_of_range(part, place, ids)
            if (coarse or not real) and not self._coarse_noticed and size.max(initial=0) > COARSE:
                self._coarse_noticed = True
                self._notice_coarse(float(size.max()), place, part.dtype)
        if self._bounds is not None and not self._bounds.see(obs):
            self._bounds = None

    def _out_of_range(self, part: Array, place: tuple[str, ...], ids: Array) -> EnvError:
        """Return the error for observations whose numbers are not finite, or too large."""
        bad = ~(np.abs(part) <= LARGEST_SEEN).reshape(len(part), -1)
        row = int(np.flatnonzero(bad.any(axis=1))[0])
        wrong = part[row].reshape(-1)[bad[row]]
        what = "are not finite"
        if np.isfinite(wrong).all():
            what = f"are larger than {LARGEST_SEEN:.3g}, too large for networks (float32)"
        return self._wrong(
            row,
            ids,
            f"its observation{_named(place)} has {len(wrong)} of {bad.shape[1]} numbers that "
            f"{what}, the first is {wrong[0]}. No agent can learn from them: fix the environment, "
            "or wrap it",
        )

    def _notice_coarse(self, size: float, place: tuple[str, ...], dtype: np.dtype[Any]) -> None:
        """Give a notice of numbers that networks cannot distinguish."""
        step = float(np.spacing(np.float32(size / 2)) * 2)
        notice(
            f"{self._name}: its observation{_named(place)} has a number as large as {size:,.0f}, "
            f"in {dtype}. Networks compute in float32, where numbers of this size are {step:g} "
            "apart: smaller changes cannot be seen. Let the environment subtract a constant, or "
            "use other units"
        )

    def _wrong(self, row: int, ids: Array, what: str) -> EnvError:
        """Return an error that names the environment and the step of its episode."""
        number = int(ids[row])
        step = int(self._elapsed[number])
        return EnvError(
            f"{self._name}: environment {number + self._first}, step {step} of its episode: {what}"
        )


def _named(place: tuple[str, ...]) -> str:
    return f" ({'.'.join(place)})" if place else ""


def _fits(space: gym.Space[Any]) -> Callable[[Any], bool]:
    """Return a function that checks an observation's shape, type and choices for a space.

    It does not check the bounds of a Box: many good environments exceed them.
    """
    if isinstance(space, gym.spaces.Dict):
        inner = {name: _fits(part) for name, part in space.spaces.items()}
        return lambda obs: (
            isinstance(obs, dict)
            and obs.keys() == inner.keys()
            and all(fits(obs[name]) for name, fits in inner.items())
        )
    if isinstance(space, gym.spaces.Tuple):
        each = [_fits(part) for part in space.spaces]
        return lambda obs: (
            isinstance(obs, tuple | list)
            and len(obs) == len(each)
            and all(fits(part) for fits, part in zip(each, obs, strict=True))
        )
    if not isinstance(space, gym.spaces.Box):
        return lambda obs: _holds(space, obs)
    shape = obs_shape(space)
    dtype = np.dtype(space.dtype)

    def fits(obs: Any) -> bool:
        """Return whether an observation has the shape and type of its space."""
        if type(obs) is np.ndarray and obs.dtype == dtype:
            return bool(obs.shape == shape)
        try:
            array = np.asarray(obs)
        except Exception:
            return False
        # Whole numbers are accepted as reals, and reals of another size.
        fits = array.dtype.kind in "fiub" and np.can_cast(array.dtype, dtype, "same_kind")
        return array.shape == shape and fits

    return fits


def _holds(space: gym.Space[Any], obs: Any) -> bool:
    """Return whether a space contains an observation; an exception means no."""
    try:
        obs = int(obs) if isinstance(obs, np.ndarray) and obs.shape == () else obs
        return bool(space.contains(obs))
    except Exception:
        return False


def _misfit(space: gym.Space[Any], obs: Any, place: str = "") -> str:
    """Return the place where an observation does not fit its space, and how, in words.

    Args:
        place: the part so far, as a user writes it.
    """
    inner = parts(space)
    of_dict = isinstance(space, gym.spaces.Dict)
    named: Any = None
    if inner is not None and isinstance(obs, dict if of_dict else tuple | list):
        named = obs if of_dict else {str(i): part for i, part in enumerate(obs)}
    if inner is None or named is None:
        whole = "" if place else "its observation_space "
        return f"{place} is {_described(obs)}, which is not in {whole}{short(space, 200)}"
    names = ", ".join(map(short, inner))
    if lacking := next((name for name in inner if name not in named), None):
        has = ", ".join(map(short, named)) or "none"
        return f"{place} lacks the part {short(lacking)} of its space; its parts are {has}"
    if added := next((name for name in named if name not in inner), None):
        return (
            f"{place} has the part {short(added)}, which its space lacks (it has {names}): declare "
            "the part in observation_space, or leave it out"
        )
    for name, part in inner.items():
        if not _fits(part)(named[name]):
            at_part = f"[{name!r}]" if of_dict else f"[{name}]"
            return _misfit(part, named[name], place + at_part)
    return " is not in its observation_space"


def _described(obs: Any) -> str:
    if isinstance(obs, np.ndarray) and obs.size > 1:
        return f"an array {obs.shape} of {obs.dtype}"
    return short(obs)
