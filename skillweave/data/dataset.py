"""``sw.Dataset``: episodes of an environment that were recorded elsewhere, as arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave._internal.notebooks import paragraph
from skillweave.algorithms.batches import number_type
from skillweave.buffers.recorded_steps import RecordedSteps
from skillweave.calls.log import CallLog
from skillweave.data.minari_files import read_minari, write_minari
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError
from skillweave.policies.core import Array, read_only
from skillweave.policies.spaces import at, space_of
from skillweave.spaces import obs_dtype, pack, same_space

KEYS = ("observations", "actions", "rewards", "terminations", "truncations", "infos")
"""The parts of an episode, by Minari's names."""
ENDS = ("terminated", "truncated", "neither")
MEANT = {
    **dict.fromkeys(("obs", "observation", "states", "state"), "observations"),
    **dict.fromkeys(("action", "acts"), "actions"),
    **dict.fromkeys(("reward", "rews"), "rewards"),
    **dict.fromkeys(("terminated", "terminals", "dones", "done"), "terminations"),
    **dict.fromkeys(("truncated", "timeouts"), "truncations"),
    "info": "infos",
}
"""Names that other programs use for the parts of an episode."""


class Dataset:
    """Episodes of an environment: observations, actions, rewards, and how they ended.

    ```python
    import numpy as np
    import skillweave as sw

    episode = {
        "observations": np.zeros((4, 4), np.float32),  # one more than steps
        "actions": np.array([0, 1, 1]),
        "rewards": np.ones(3),
        "terminations": np.array([False, False, True]),
        "truncations": np.zeros(3, bool),
    }
    data = sw.Dataset([episode], "CartPole-v1")
    print(data)
    ```

    An episode has Minari's names. Observations of a Dict or Tuple are dicts and tuples of arrays.
    ``infos`` are arrays by key, one value for each step, or for each observation; or a list of
    dicts, as ``env.step`` returns them. Without a last
    observation, (T, ...), a step that ends nothing is left out, as what it led to is unknown.

    Args:
        episodes: a mapping for each.
        env: an ``EnvSpec``, a Gymnasium id, or a function that makes an environment: whose spaces
            they have. None: ``observation_space`` and ``action_space``.
        observation_space: None: the environment's.
        action_space: None: the environment's.
        name: for messages and reports.

    Raises:
        DeclarationError: an episode does not fit the spaces, has a NaN, or goes on after its end;
            the message names episode and step.
        TrainingError: it is larger than the free memory.
    """

    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    obs: Array
    """(T, *obs_shape), before each step; episodes one after another."""
    next_obs: Array
    """(T, *obs_shape), after each step."""
    action: Array
    """(T, *action_shape), as the environment takes them."""
    reward: Array
    """(T,) float32."""
    terminated: Array
    """(T,) bool."""
    truncated: Array
    """(T,) bool, the environment's time limit."""
    info: dict[str, Array]
    """By key, (T, ...) after each step."""
    offset: Array
    """(E + 1,) int64, the first step of each episode."""
    whole: Array
    """(E,) bool, its last observation is known; else ``next_obs`` repeats the one before."""
    left_out: int
    """Steps that are not here, as what they led to is unknown."""

    @checked_names
    def __init__(
        self,
        episodes: Iterable[Mapping[str, Any]],
        env: Any = None,
        *,
        observation_space: gym.Space[Any] | None = None,
        action_space: gym.Space[Any] | None = None,
        name: str = "a data set",
    ) -> None:
        if env is not None:
            spec = env if isinstance(env, EnvSpec) else EnvSpec(env)
            observation_space = observation_space or spec.spaces.observation
            action_space = action_space or spec.spaces.action
        if observation_space is None or action_space is None:
            raise DeclarationError(
                "Dataset needs the spaces of its observations and actions: give env, or "
                "observation_space and action_space"
            )
        if isinstance(episodes, Mapping) or not isinstance(episodes, Iterable):
            raise DeclarationError(
                f"Dataset(): episodes is {short(episodes)}; it must be a list of episodes, each a "
                f"mapping with {', '.join(KEYS)}"
            )
        self.name = name
        self.observation_space = observation_space
        self.action_space = action_space
        reader = _EpisodeReader(observation_space, action_space, name)
        read = [reader.episode(episode, i) for i, episode in enumerate(episodes)]
        read = [one for one in read if len(one.reward)]
        if not read:
            raise DeclarationError(f"{name} has no episode with a step")
        keys = [key for key in read[0].info if all(key in one.info for one in read)]
        self.info = {key: np.concatenate([one.info[key] for one in read]) for key in keys}
        for column in ("obs", "next_obs", "action", "reward", "terminated", "truncated"):
            joined = np.concatenate([getattr(one, column) for one in read])
            setattr(self, column, read_only(joined))
        self.offset = np.concatenate([[0], np.cumsum([len(one.reward) for one in read])])
        self.whole = np.array([one.whole for one in read])
        self.left_out = sum(one.left_out for one in read)

    @classmethod
    def from_log(cls, log: CallLog, name: str = "a log of calls") -> Dataset:
        """Return the episodes of a log of calls, ``run.calls``, as far as it has their steps.

        Args:
            log: of calls.
            name: for messages and reports.

        Raises:
            DeclarationError: it is no log.
        """
        if not isinstance(log, CallLog):
            raise DeclarationError(
                f"from_log(): log is {short(log)}; it must be a log of calls, run.calls"
            )
        episodes = []
        for calls in _joined_calls(log):
            rows = np.concatenate([np.arange(log.offset[c], log.offset[c + 1]) for c in calls])
            episodes.append(
                {
                    "observations": np.concatenate([log.start[calls[:1]], log.next_obs[rows]]),
                    "actions": log.action[rows],
                    "rewards": log.reward[rows],
                    "terminations": _last(len(rows), bool(log.terminated[calls[-1]])),
                    "truncations": _last(len(rows), bool(log.truncated[calls[-1]])),
                    "infos": {key: value[rows] for key, value in log.info.items()},
                }
            )
        spaces: Any = {
            "observation_space": log.observation_space,
            "action_space": log.action_space,
        }
        return cls(episodes, name=name, **spaces)

    @classmethod
    def from_minari(cls, source: Any) -> Dataset:
        """Return Minari's data set, by the extra ``data``.

        Args:
            source: its id, or what ``minari.load_dataset`` returned.

        Raises:
            RunError: it is not there, or cannot be read.
            DeclarationError: its episodes do not fit its spaces.
            MissingExtra: the extra 'data' is not installed.
        """
        return cls(**read_minari(source))

    @checked_names
    def to_minari(self, name: str, **about: Any) -> Any:
        """Write the episodes as a data set of Minari, and return it, by the extra ``data``.

        Args:
            name: its id, "namespace/name-v0".
            **about: further arguments of ``minari.create_dataset_from_buffers``: ``author``, ...

        Raises:
            RunError: Minari refuses it, as there is one of this name, for example.
            MissingExtra: the extra 'data' is not installed.
        """
        return write_minari(self, name, about)

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.offset) - 1

    @property
    def steps(self) -> int:
        """The number of steps."""
        return len(self.reward)

    @property
    def lengths(self) -> Array:
        """The steps of each episode, (E,) int64."""
        return np.diff(self.offset)

    @property
    def returns(self) -> Array:
        """The sum of rewards of each episode, (E,) float64."""
        return np.add.reduceat(self.reward.astype(np.float64), self.offset[:-1])

    @property
    def ends(self) -> dict[str, int]:
        """How many episodes terminated, were truncated, or ended otherwise."""
        last = self.offset[1:] - 1
        terminated = self.terminated[last]
        truncated = self.truncated[last] & ~terminated
        counts = int(terminated.sum()), int(truncated.sum())
        return dict(zip(ENDS, (*counts, len(self) - sum(counts)), strict=True))

    def recorded(self) -> RecordedSteps:
        """Return the steps as replay buffers take them."""
        last = np.zeros(self.steps, bool)
        last[self.offset[1:] - 1] = True
        elapsed = np.arange(self.steps) - np.repeat(self.offset[:-1], self.lengths) + 1
        columns = self.obs, self.next_obs, self.action, self.reward, self.terminated, self.truncated
        info = {key: x.astype(number_type(x.dtype)) for key, x in self.info.items()}
        return RecordedSteps(*columns, elapsed, last, info, self.name)

    def episode(self, number: int) -> dict[str, Any]:
        """Return an episode as arrays by Minari's names; see the class.

        Args:
            number: from 0.

        Raises:
            DeclarationError: there is no such episode.
        """
        whole = isinstance(number, int | np.integer) and not isinstance(number, bool)
        if not whole or not 0 <= number < len(self):
            raise DeclarationError(
                f"episode(): number is {short(number)}; it must be from 0 to {len(self) - 1}"
            )
        rows = slice(int(self.offset[number]), int(self.offset[number + 1]))
        obs = self.obs[rows]
        if self.whole[number]:
            obs = np.concatenate([obs, self.next_obs[rows][-1:]])
        return {
            "observations": obs,
            "actions": self.action[rows],
            "rewards": self.reward[rows],
            "terminations": self.terminated[rows],
            "truncations": self.truncated[rows],
            "infos": {key: value[rows] for key, value in self.info.items()},
        }

    @checked_names
    def select(self, episodes: Sequence[int] | Array) -> Dataset:
        """Return a data set of some of the episodes.

        Args:
            episodes: their numbers.

        Raises:
            DeclarationError: a number is not there.
        """
        chosen = np.asarray(episodes)
        whole = chosen.dtype.kind in "iu" and chosen.ndim == 1 and chosen.size
        if not whole or chosen.min() < 0 or chosen.max() >= len(self):
            raise DeclarationError(
                f"select(): episodes is {short(episodes)}; it must be numbers from 0 to "
                f"{len(self) - 1}"
            )
        spaces: Any = {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
        }
        return Dataset([self.episode(i) for i in chosen.tolist()], name=self.name, **spaces)

    @checked_names
    def split(self, share: float = 0.1, *, seed: int = 0) -> tuple[Dataset, Dataset]:
        """Return two data sets of its episodes, at random: most of them, and the held-out ones.

        Args:
            share: of the episodes that are held out; each part has one at least.
            seed: of the choice.

        Raises:
            DeclarationError: there is one episode, or the share is not between 0 and 1.
        """
        if len(self) < 2 or not 0 < share < 1:
            raise DeclarationError(
                f"split() needs a share between 0 and 1, and two episodes at least; share is "
                f"{short(share)}, and there are {len(self)}"
            )
        held = int(np.clip(round(share * len(self)), 1, len(self) - 1))
        order = np.random.default_rng(seed).permutation(len(self))
        return self.select(np.sort(order[held:])), self.select(np.sort(order[:held]))

    def check_env(self, spec: EnvSpec) -> None:
        """Check that an environment has the spaces of the data.

        Args:
            spec: of the environment.

        Raises:
            DeclarationError: it has others; the message names both.
        """
        for what, own, other in (
            ("observations", self.observation_space, spec.spaces.observation),
            ("actions", self.action_space, spec.spaces.action),
        ):
            if not same_space(own, other):
                raise DeclarationError(
                    f"{self.name} has {what} of {short(own, 300)}, but the environment {spec.name} "
                    f"has {short(other, 300)}: give data of this environment, or wrap it"
                )

    def __repr__(self) -> str:
        return f"<Dataset: {len(self):,} episodes, {self.steps:,} steps>"

    def __str__(self) -> str:
        lengths, returns = self.lengths, self.returns
        ended = ", ".join(f"{count:,} {how}" for how, count in self.ends.items() if count)
        lines = [
            f"{self.name}: {len(self):,} episodes, {self.steps:,} steps",
            f"lengths: {lengths.min():,} to {lengths.max():,}, mean {lengths.mean():,.1f}",
            f"returns: {returns.min():.4g} to {returns.max():.4g}, mean {returns.mean():.4g}",
            f"ends: {ended}",
        ]
        if self.info:
            lines.append(f"info: {', '.join(self.info)}")
        if self.left_out:
            lines.append(
                f"{self.left_out:,} last steps are left out: their next observation is missing, "
                "and no end is known there"
            )
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return paragraph(str(self))


def _last(steps: int, value: bool) -> Array:
    """Return (T,) bool, false but perhaps at the last step."""
    found = np.zeros(steps, bool)
    found[-1] = value
    return found


def _joined_calls(log: CallLog) -> Iterator[Array]:
    """Yield the calls of each episode of a log that follow one another without a gap."""
    order = np.lexsort((log.order, log.episode))
    follows = np.zeros(len(order), bool)
    before, after = order[:-1], order[1:]
    follows[1:] = (log.episode[before] == log.episode[after]) & (
        log.age[before] + log.tau[before] == log.age[after]
    )
    yield from np.split(order, np.flatnonzero(~follows)[1:])


class _Episode:
    """The arrays of one episode; ``Dataset`` describes them."""

    obs: Array
    next_obs: Array
    action: Array
    reward: Array
    terminated: Array
    truncated: Array
    info: dict[str, Array]
    whole: bool
    left_out: int


class _EpisodeReader:
    """A reader of episodes as users have them."""

    def __init__(self, observation: gym.Space[Any], action: gym.Space[Any], name: str) -> None:
        self._observation = observation
        self._action = action
        self._name = name
        obs_dtype(observation)  # raises where the space is not supported
        self._actions = space_of(action)

    def episode(self, given: Mapping[str, Any], number: int) -> _Episode:
        """Return an episode.

        Raises:
            DeclarationError: it does not fit.
        """
        who = f"{self._name}: episode {number}"
        if not isinstance(given, Mapping) or not {"observations", "actions"} <= given.keys():
            raise DeclarationError(
                f"{who} is {short(given)}; it must be a mapping with {', '.join(KEYS)}"
            )
        for key, name in MEANT.items():
            if key in given and name not in given:
                raise DeclarationError(
                    f"{who} has {key!r}, which is not read: call it {name!r} (Minari's name)"
                )
        actions = self._packed(self._action, given["actions"], f"{who}: actions")
        steps = len(actions)
        seen = self._packed(self._observation, given["observations"], f"{who}: observations")
        if len(seen) not in (steps, steps + 1):
            raise DeclarationError(
                f"{who} has {len(seen)} observations for {steps} actions; it must have one more, "
                "or as many where the last one is missing"
            )
        reward = self._column(given, "rewards", steps, np.float32, who)
        terminated = self._column(given, "terminations", steps, np.bool_, who)
        truncated = self._column(given, "truncations", steps, np.bool_, who)
        if not np.isfinite(reward).all():
            step = int(np.flatnonzero(~np.isfinite(reward))[0])
            raise DeclarationError(f"{who}: its reward of step {step} is {reward[step]}")
        if (terminated | truncated)[:-1].any():
            step = int(np.flatnonzero((terminated | truncated)[:-1])[0])
            raise DeclarationError(
                f"{who} ends at step {step} (terminations, truncations), but has {steps} steps: "
                "split it there"
            )
        if steps and not (inside := self._actions.holds(actions)).all():
            step = int(np.flatnonzero(~inside)[0])
            raise DeclarationError(
                f"{who}: its action of step {step} is {short(actions[step].tolist())}, which is "
                f"not in {short(self._action, 200)}"
            )
        found = _Episode()
        found.whole = len(seen) == steps + 1
        ends = bool(steps) and bool(terminated[-1])
        found.left_out = int(bool(steps) and not found.whole and not ends)
        keep = slice(0, steps - found.left_out)
        following = seen[1:] if found.whole else np.concatenate([seen[1:], seen[-1:]])
        found.obs, found.next_obs = seen[:steps][keep], following[keep]
        found.action, found.reward = actions[keep], reward[keep]
        found.terminated, found.truncated = terminated[keep], truncated[keep]
        found.whole = found.whole or bool(found.left_out)
        found.info = self._infos(given.get("infos"), steps, keep, who)
        return found

    def _packed(self, space: gym.Space[Any], given: Any, who: str) -> Array:
        """Return values of a space, (n, *shape), as one array.

        Raises:
            DeclarationError: they are of another space, or have a NaN.
        """
        data = space_of(space)
        try:
            packed = given if isinstance(given, np.ndarray) else pack(space, given)
            if packed.dtype != data.record:
                packed = _cast(packed, data.record)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise DeclarationError(
                f"{who} do not fit {short(space, 300)}: {type(error).__name__}: {str(error)[:200]}"
            ) from error
        if packed.shape[1:] != tuple(data.shape):
            raise DeclarationError(
                f"{who} have the shape {packed.shape}, but {short(space, 200)} needs "
                f"(steps, {', '.join(map(str, data.shape))})"
            )
        for path in data.leaves:
            leaf = at(packed, path)
            if leaf.dtype.kind == "f" and not (finite := np.isfinite(leaf)).all():
                row = int(np.argwhere(~finite)[0, 0])
                raise DeclarationError(f"{who} have a NaN or an infinity at step {row}")
        return packed

    def _column(
        self, given: Mapping[str, Any], key: str, steps: int, kind: type[np.generic], who: str
    ) -> Array:
        """Return a column with a number for each step; zeros where it is not given."""
        value = given.get(key)
        if value is None:
            return np.zeros(steps, kind)
        try:
            numbers = np.asarray(value)
        except ValueError as error:
            raise DeclarationError(f"{who}: {key} are no numbers: {str(error)[:200]}") from error
        if numbers.dtype.kind not in "biuf" and numbers.size:
            raise DeclarationError(f"{who}: {key} are no numbers: {short(value)}")
        with np.errstate(over="ignore"):  # what becomes infinite is refused
            found = numbers.astype(kind).reshape(-1)
        if len(found) != steps:
            raise DeclarationError(f"{who} has {len(found)} {key} for {steps} actions")
        return found

    def _infos(self, given: Any, steps: int, keep: slice, who: str) -> dict[str, Array]:
        """Return the numbers in infos, by key; what is no number is left out."""
        found: dict[str, Array] = {}
        if isinstance(given, Sequence) and all(isinstance(one, Mapping) for one in given):
            keys = [key for key in given[0] if all(key in one for one in given)] if given else []
            given = {key: [one[key] for one in given] for key in keys}
        for key, value in given.items() if isinstance(given, Mapping) else ():
            numbers = _numbers(value)
            if numbers is None or numbers.dtype.kind not in "biuf" or not numbers.ndim:
                continue
            if len(numbers) not in (steps, steps + 1):
                raise DeclarationError(
                    f"{who}: infos[{key!r}] has {len(numbers)} values for {steps} actions"
                )
            found[str(key)] = numbers[len(numbers) - steps :][keep]
        return found


def _numbers(value: Any) -> Array | None:
    """Return what is in infos as an array; None: it is none."""
    if isinstance(value, Mapping):
        return None
    try:
        return np.asarray(value)
    except ValueError:  # of different lengths
        return None


def _cast(x: Array, kind: np.dtype[Any]) -> Array:
    """Return numbers of another type; raise a ValueError where they would change."""
    cast = x.astype(kind)
    if x.dtype.names is None and kind.kind in "iub" and not np.array_equal(cast, x):
        raise ValueError(f"numbers of {x.dtype} are none of {kind}")
    return cast
