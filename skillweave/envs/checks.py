"""Whether environments return what Gymnasium says they return; if not, which one and when.

``CheckedEnv`` looks at one environment's answers, in the process it runs in. ``Watch`` looks at the
numbers of all of them at once, which costs a few microseconds a step, whatever the engine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.messages import short, told
from skillweave.notices import notice
from skillweave.spaces import obs_dtype, obs_shape
from skillweave.types import (
    LARGEST_REWARD,
    Array,
    SkillweaveError,
    finite,
    wrong_reward,
)

LONGEST_EPISODE = 100_000
"""Steps after which an engine truncates an episode that nothing else has ended."""
LONGEST_FILM = 10_000
"""The same of a video."""


_REWARDS = f"it must be finite, and at most {LARGEST_REWARD:g} in size: learners square it"


class CheckedEnv(gym.Wrapper[Any, Any, Any, Any]):
    """An environment whose errors, and whose wrong answers, are told with its number and its step.

    Args:
        env: the environment.
        name: what messages call it.
        number: which one of several it is.

    Raises:
        SkillweaveError: it has no spaces; later, whatever it does or returns that is wrong.
    """

    def __init__(self, env: gym.Env[Any, Any], name: str, number: int | None = None) -> None:
        if not isinstance(env, gym.Env):
            raise SkillweaveError(
                f"{name} made {short(env)}, which is no environment (no gymnasium.Env)"
            )
        super().__init__(env)
        self._name, self._number, self._elapsed = name, number, 0
        for kind in ("observation_space", "action_space"):
            found = getattr(env, kind, None)
            if not isinstance(found, gym.Space):
                raise SkillweaveError(
                    f"{name}: {kind} is {short(found)}; it must be a space of Gymnasium's"
                )
        self._fits = _fits(env.observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start anew."""
        self._elapsed = 0
        try:
            found = self.env.reset(seed=seed, options=options)
        except SkillweaveError:
            raise
        except Exception as error:
            raise self._wrong(f"reset() raised {told(error)}") from error
        if not isinstance(found, tuple) or len(found) != 2:
            raise self._wrong(f"reset() returned {_many(found)}; Gymnasium asks for obs, info")
        obs, info = found
        if not self._fits(obs):
            raise self._misfit(obs)
        self._check_info(info)
        return obs, info

    def step(self, action: Any) -> Any:
        """Act."""
        self._elapsed += 1
        try:
            found = self.env.step(action)
        except SkillweaveError:
            raise
        except Exception as error:
            raise self._wrong(f"step() raised {told(error)}") from error
        if not isinstance(found, tuple) or len(found) != 5:
            raise self._wrong(
                f"step() returned {_many(found)}; Gymnasium asks for five: obs, reward, "
                "terminated, truncated, info"
            )
        obs, reward, terminated, truncated, info = found
        if not self._fits(obs):
            raise self._misfit(obs)
        if type(reward) is not float:
            reward = self._number_of(reward)
        if not -LARGEST_REWARD <= reward <= LARGEST_REWARD:
            raise self._wrong(f"its reward is {reward}; {_REWARDS}")
        if type(terminated) is not bool:
            terminated = self._flag(terminated, "terminated")
        if type(truncated) is not bool:
            truncated = self._flag(truncated, "truncated")
        if type(info) is not dict:
            self._check_info(info)
        return obs, reward, terminated, truncated, info

    def close(self) -> None:
        """Release it; what goes wrong is told, and costs nothing that was learnt."""
        try:
            super().close()
        except (Exception, SystemExit) as error:
            notice(
                f"{self._name}: close() raised {told(error)}. What was learnt is kept; what the "
                "environment holds may not have been released"
            )

    def _number_of(self, reward: Any) -> float:
        try:
            array = np.asarray(reward)
        except Exception:
            array = np.asarray(None)
        if array.dtype.kind not in "fiub" or array.size != 1:
            raise self._wrong(f"its reward is {short(reward)}; it must be a number")
        return float(array.reshape(()))

    def _flag(self, value: Any, which: str) -> bool:
        try:
            array = np.asarray(value)
        except Exception:
            array = np.asarray(None)
        if array.dtype.kind not in "fiub" or array.size != 1 or array.reshape(())[()] not in (0, 1):
            raise self._wrong(f"{which} is {short(value)}; it must be True or False")
        return bool(array.reshape(()))

    def _check_info(self, info: Any) -> None:
        if not isinstance(info, dict):
            raise self._wrong(f"its info is {short(info)}; it must be a dict")

    def _misfit(self, obs: Any) -> SkillweaveError:
        space = short(self.env.observation_space, 200)
        return self._wrong(
            f"its observation is {_described(obs)}, which is not in its observation_space {space}"
        )

    def _wrong(self, what: str) -> SkillweaveError:
        where = f"environment {self._number}, " if self._number is not None else ""
        return SkillweaveError(f"{self._name}: {where}step {self._elapsed} of its episode: {what}")


def time_limit(env: gym.Env[Any, Any]) -> int | None:
    """Steps after which an environment truncates its episodes; None: nobody knows."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.TimeLimit):
            return int(env._max_episode_steps)
        env = env.env
    return None


class Watch:
    """Counts the steps of N environments' episodes, and sees where a number is not finite.

    Args:
        name: what messages call the environment.
        space: of one observation.
        num_envs: N.
        first: the number of the first environment, for messages.
    """

    def __init__(self, name: str, space: gym.Space[Any], num_envs: int, first: int = 0) -> None:
        self._name, self._num_envs, self._first = name, num_envs, first
        self._places = tuple(_real(obs_dtype(space)))
        self._elapsed = np.zeros(num_envs, np.int64)

    def begun(self, obs: Array, ids: Array | None = None) -> Array:
        """The first observations of environments ``ids`` (None: all), unchanged.

        Raises:
            SkillweaveError: one is not finite; the message names the environment.
        """
        self._elapsed[slice(None) if ids is None else ids] = 0
        self._check(obs, ids)
        return obs

    def stepped(self, raw: Any, ids: Array | None = None) -> Any:
        """The answer (a ``RawStep``) of environments ``ids`` to a step, unchanged.

        Raises:
            SkillweaveError: an observation or a reward is not finite; the message names the
                environment and the step.
        """
        if ids is None:
            self._elapsed += 1
        else:
            self._elapsed[ids] += 1
        self._check(raw.next_obs, ids)
        if (row := wrong_reward(raw.reward)) is not None:
            raise self._wrong(row, ids, f"its reward is {raw.reward[row]}; {_REWARDS}")
        return raw

    def too_long(self, ids: Array | None = None) -> Array:
        """Return (n,) bool: the episodes of environments ``ids`` have had enough steps."""
        found: Array = self._elapsed[slice(None) if ids is None else ids] >= LONGEST_EPISODE
        return found

    def _check(self, obs: Array, ids: Array | None) -> None:
        for place in self._places:
            part = obs
            for name in place:
                part = part[name]
            if not finite(part):
                raise self._not_finite(part, place, ids)

    def _not_finite(
        self, part: Array, place: tuple[str, ...], ids: Array | None
    ) -> SkillweaveError:
        bad = ~np.isfinite(part).reshape(len(part), -1)
        row = int(np.flatnonzero(bad.any(axis=1))[0])
        count, size = int(bad[row].sum()), bad.shape[1]
        first = part[row].reshape(-1)[bad[row]][0]
        which = f" ({'.'.join(place)})" if place else ""
        return self._wrong(
            row, ids, f"its observation{which} has {count} of {size} numbers that are not finite, "
            f"the first is {first}. No agent can learn from that: mend the environment, or wrap it"
        )  # fmt: skip

    def _wrong(self, row: int, ids: Array | None, what: str) -> SkillweaveError:
        number = row if ids is None else int(ids[row])
        step = int(self._elapsed[number])
        return SkillweaveError(
            f"{self._name}: environment {number + self._first}, step {step} of its episode: {what}"
        )


def _real(dtype: np.dtype[Any], place: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Where the floats of an observation are: names of the parts."""
    if dtype.fields is not None:
        for name, (part, *_) in dtype.fields.items():
            yield from _real(part.base, (*place, name))
    elif dtype.kind == "f":
        yield place


def _fits(space: gym.Space[Any]) -> Callable[[Any], bool]:
    """Whether an observation has a space's shape and kind, and is a choice that exists.

    The bounds of a Box are not asked for: many good environments step beyond them.
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
    shape, dtype = obs_shape(space), np.dtype(space.dtype)

    def fits(obs: Any) -> bool:
        if type(obs) is np.ndarray and obs.dtype == dtype:
            return bool(obs.shape == shape)
        try:
            array = np.asarray(obs)
        except Exception:
            return False
        # Whole numbers where reals are asked are fine, and reals of another size.
        return array.shape == shape and _kind_fits(array, dtype)

    return fits


def _kind_fits(array: Array, dtype: np.dtype[Any]) -> bool:
    return array.dtype.kind in "fiub" and np.can_cast(array.dtype, dtype, "same_kind")


def _holds(space: gym.Space[Any], obs: Any) -> bool:
    try:
        obs = int(obs) if isinstance(obs, np.ndarray) and obs.shape == () else obs
        return bool(space.contains(obs))
    except Exception:
        return False


def _many(found: Any) -> str:
    return f"{len(found)} values" if isinstance(found, tuple) else f"a {type(found).__name__}"


def _described(obs: Any) -> str:
    if isinstance(obs, np.ndarray) and obs.size > 1:
        return f"an array {obs.shape} of {obs.dtype}"
    return short(obs)
