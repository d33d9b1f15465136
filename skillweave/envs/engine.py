"""Engines: many environments of one kind, stepped together, reset only by an explicit call.

Gymnasium resets on the next step, in the same step or never; EnvPool resets on the next step
and ignores the action of that step. An ``Engine`` hides these differences: ``step`` steps the given
environments and returns their true successors, ``reset_some`` resets the given ones. An environment
whose episode has ended must be reset before its next step. An episode without an end is truncated
after ``LONGEST_EPISODE`` steps.

``state`` returns seeds and actions, from which ``restore`` repeats the open episodes. It works only
for environments whose dynamics follow from these two.
"""

from __future__ import annotations

import copy
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import short
from skillweave._internal.notices import are_collected, notice
from skillweave._internal.seeding import GlobalDraws, are_shared
from skillweave.envs.checked import Watch, time_limit
from skillweave.envs.env_infos import ActionMasks, time_limits
from skillweave.envs.history import History
from skillweave.envs.repeats import check_first_steps, check_used
from skillweave.errors import EnvError, SkillweaveError, reworded
from skillweave.policies.core import Array, Step
from skillweave.policies.infos import InfoKeys, batched_infos
from skillweave.policies.spaces import space_of
from skillweave.skills.outputs import keys_of
from skillweave.spaces import leaves, obs_dtype, obs_shape, put_observation

OWN_GENERATOR = "self.np_random instead, which super().reset(seed=seed) seeds"
LOOKS = 40
"""Resets and steps in which draws from global generators are detected."""


@dataclass(slots=True)
class RawStep:
    """The result of a step, rows in the order of the requested ids."""

    next_obs: Array  # (n, *obs_shape)
    reward: Array  # (n,) float32
    terminated: Array  # (n,) bool
    truncated: Array  # (n,) bool
    info: dict[str, Any]

    def seen(self, obs: Array, action: Array, elapsed: Array) -> Step:
        """Return the step as policies see it: from ``obs`` by ``action``, (n, …) each.

        ``elapsed`` (n,) counts the steps of the episode or call, this one included.
        """
        return Step(
            obs=obs,
            action=action,
            next_obs=self.next_obs,
            reward=self.reward,
            terminated=self.terminated,
            truncated=self.truncated,
            timed_out=np.zeros(len(self.reward), bool),
            elapsed=elapsed,
            info=self.info,
        )


class Engine(Protocol):
    """N environments of one kind; ``ids`` are row numbers, None means all of them."""

    num_envs: int
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    steps_made: int
    """Steps that all environments have made together."""
    time_limit: int | None
    """Steps after which an environment itself truncates an episode; None: unknown."""

    def reset(self, seed: int) -> Array:
        """Reset all environments from one seed; return observations (N, *obs_shape)."""
        ...

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        """Reset some environments; return observations (n, *obs_shape).

        ``seeds``: one for each, where supported.
        """
        ...

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        """Step some environments; the others do not change."""
        ...

    def state(self) -> dict[str, Array]:
        """Return the seeds and the actions since, for ``restore``."""
        ...

    def restore(self, state: dict[str, Array]) -> tuple[Array, Array]:
        """Repeat all actions in ``state``.

        The steps are not counted again.

        Returns:
            The resulting observations (N, *obs_shape), and the environments (k,) whose episodes
            ended earlier than before: they must be reset.
        """
        ...

    def mask(self) -> Array | None:
        """Return the actions allowed in the latest observations, (N, A) bool; None: always all."""
        ...

    def finish(self) -> None:
        """Check at the end of training what it has left in the environments, before ``close``."""
        ...

    def close(self) -> None:
        """Release processes and memory."""
        ...


class WatchedEngine:
    """A base class of engines: it checks the environments' results, and records their actions.

    Args:
        env: one of the environments, for its spaces and its time limit.
        name: the environments' name in messages.
        first: the number of the first environment, for messages.
        seen: the space of observations, if they may hold an action mask.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        num_envs: int,
        name: str,
        first: int = 0,
        seen: gym.Space[Any] | None = None,
    ) -> None:
        self.num_envs = num_envs
        self.steps_made = 0
        self.observation_space: gym.Space[Any] = env.observation_space
        self.action_space: gym.Space[Any] = copy.deepcopy(env.action_space)  # seeded by others
        self.time_limit = time_limit(env)
        self.name = name
        self._all = np.arange(num_envs)
        self._root = 0
        self._discrete = isinstance(self.action_space, gym.spaces.Discrete)
        self._masks = ActionMasks(self.action_space, num_envs, seen)
        self._keys = InfoKeys()
        self._watch = Watch(name, self.observation_space, num_envs, first)
        action = np.zeros((num_envs, *obs_shape(self.action_space)), obs_dtype(self.action_space))
        self._history = History(num_envs, action)

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        """Step some environments; the others do not change."""
        ids = self._all if ids is None else ids
        self._history.add(action, ids)
        self.steps_made += len(ids)
        return self._act(action, ids)

    def mask(self) -> Array | None:
        """Return the actions allowed in the latest observations, (N, A) bool; None: always all."""
        return self._masks.now

    def finish(self) -> None:
        """Check nothing."""

    def close(self) -> None:
        """Give a notice of keys of info that were read, and that no environment has given."""
        for key in sorted(self._keys.asked):
            notice(
                f"{self.name}: no environment set info[{short(key)}], which is read: 0 stood in "
                f"its place (the keys are: {keys_of(self._keys.examples)})"
            )

    def _act(self, action: Array, ids: Array) -> RawStep:
        """Step environments ``ids`` (n,), also again, without an entry in the history."""
        raise NotImplementedError

    def _after_reset(self, obs: Array, info: dict[str, Any], ids: Array) -> Array:
        """Return observations after a reset, which are checked."""
        self._masks.see(info, ids, obs=obs)
        self._watch.check_reset(obs, ids)
        return obs

    def _after_step(self, raw: RawStep, ids: Array) -> RawStep:
        """Return the result of a step, which is checked, and truncated after too many steps."""
        n = len(ids)
        over = raw.terminated | raw.truncated
        self._masks.see(raw.info, ids, over, raw.next_obs)
        self._watch.check_step(raw, ids)
        ended = b"\1" in over.tobytes()  # for small arrays ten times as fast as any()
        if ended:
            limited = time_limits(raw.info, n)
            raw.terminated = raw.terminated & ~limited
            raw.truncated = raw.truncated | (over & limited)
        raw.truncated = (raw.truncated | self._watch.too_long(ids)) & ~raw.terminated
        raw.info = self._keys.see(raw.info, n, ended=ended)
        return raw


class GymnasiumEngine(WatchedEngine):
    """Gymnasium environments, stepped one after another in this process.

    Every episode has its own seed, so that it can be repeated.

    Args:
        make: makes the environment of a ``number``.
        name: their name in messages.
        first: the number of the first environment.
        check_seed: check before training that the first environment repeats itself.

    Raises:
        EnvError: the environments have different spaces, or two are the same object.
    """

    def __init__(
        self, make: Any, num_envs: int, name: str, first: int = 0, check_seed: bool = False
    ) -> None:
        self.envs: list[gym.Env[Any, Any]] = []
        try:
            for number in range(first, first + num_envs):
                self.envs.append(self._made(make, number))
            self._check_alike(name)
        except BaseException:
            for env in self.envs:
                env.close()
            raise
        env = self.envs[0]
        super().__init__(env, num_envs, name, first, env.observation_space)
        self._check_seed = check_seed and first == 0
        self._make = make
        self._started = False
        self.trains = False
        """Learners learn from these environments."""
        self._draws = GlobalDraws(LOOKS if are_collected() else 0)
        self.draws_globally = False
        """They have drawn from global generators."""
        self._dtype = obs_dtype(env.observation_space)
        self._shape = obs_shape(env.observation_space)
        self._action_dtype = obs_dtype(self.action_space)
        whole = space_of(self.action_space)
        self._parts = None if whole.parts is None else whole
        self._over = np.zeros(num_envs, bool)  # True where the episode has ended
        self._episode = np.zeros(num_envs, np.int64)  # episodes started since the root seed
        self._seed = np.zeros(num_envs, np.int64)  # of the open episode

    def reset(self, seed: int) -> Array:
        """Reset all environments from one seed; return observations (N, *obs_shape)."""
        if self.trains and self._check_seed and not self._started:
            self._started = True
            check_first_steps(self)
        self._root = seed
        self._episode[:] = 0
        return self.reset_some(self._all)

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        """Reset some environments; return observations (n, *obs_shape)."""
        if seeds is None:
            seeds = [episode_seed(self._root, int(i), int(self._episode[i])) for i in ids]
        self._episode[ids] += 1
        self._seed[ids] = seeds
        self._history.forget(ids)
        return self._begin(ids)

    def state(self) -> dict[str, Array]:
        """Return the seeds and the actions since."""
        seeds = {"root": np.array([self._root]), "episode": self._episode, "seed": self._seed}
        return {k: v.copy() for k, v in seeds.items()} | self._history.state()

    def restore(self, state: dict[str, Array]) -> tuple[Array, Array]:
        """Repeat the open episodes; return observations (N, *obs_shape) and early ends (k,)."""
        self._root = int(state["root"][0])
        self._episode = state["episode"].copy()
        self._seed = state["seed"].copy()
        self._history.load(state)
        obs = self._begin(self._all)
        early = [np.zeros(0, np.int64)]
        for _, ids, action in self._history.play():
            if len(ids):
                raw = self._act(action, ids)
                obs[ids] = raw.next_obs
                ended = ids[raw.terminated | raw.truncated]
                if len(ended):  # later actions in them are skipped
                    obs[ended] = self.reset_some(ended)
                    early.append(ended)
        return obs, np.unique(np.concatenate(early))

    def close(self) -> None:
        """Close all environments."""
        super().close()
        for env in self.envs:
            env.close()

    def _begin(self, ids: Array) -> Array:
        """Reset environments ``ids`` (n,) to their seeds."""
        if self._draws.looks:
            self._draws.begin()
        obs = self._empty(len(ids))
        infos = []
        for row, (i, seed) in enumerate(zip(ids.tolist(), self._seed[ids].tolist(), strict=True)):
            observation, info = self.envs[i].reset(seed=seed)
            with np.errstate(over="ignore"):
                put_observation(self.observation_space, obs, row, observation)
            infos.append(info)
        self._over[ids] = False
        if self._draws.looks:
            self._notice_draws()
        return self._after_reset(obs, batched_infos(infos), ids)

    def _act(self, action: Array, ids: Array) -> RawStep:
        """Step environments ``ids`` (n,) one after another, and join their results."""
        assert not self._over[ids].any(), "an episode that is over must be reset first"
        n = len(ids)
        obs = self._empty(n)
        infos = []
        reward = np.zeros(n)
        terminated, truncated = np.zeros(n, bool), np.zeros(n, bool)
        # A copy: environments receive views of it, and may keep them.
        acted = np.array(action, self._action_dtype)
        each: Iterable[Any]
        if self._parts is not None:
            each = map(self._parts.unpacked, acted)
        else:
            # A row without axes is a NumPy scalar, which a Box does not contain.
            each = acted.tolist() if self._discrete else map(np.asarray, acted)
        if self._draws.looks:
            self._draws.begin()
        for row, (i, one) in enumerate(zip(ids.tolist(), each, strict=True)):
            result = self.envs[i].step(one)
            observation, reward[row], terminated[row], truncated[row], info = result
            # At once: several environments may share one buffer of observations.
            try:
                if self._dtype.names is not None:
                    put_observation(self.observation_space, obs, row, observation)
                else:
                    obs[row] = observation
            except RuntimeWarning:  # the program's warnings are errors; infinities are named below
                with np.errstate(over="ignore"):
                    put_observation(self.observation_space, obs, row, observation)
            infos.append(info)
        self._over[ids] = terminated | truncated
        if self._draws.looks:
            self._notice_draws()
        paid = reward.astype(np.float32)  # CheckedEnv has refused what would be an infinity
        return self._after_step(
            RawStep(obs, paid, terminated, truncated, batched_infos(infos)), ids
        )

    def finish(self) -> None:
        """Check that training has left nothing in the environments; only ``close`` follows."""
        if self.trains and self._check_seed:
            check_used(self)

    def act(self, action: Array, ids: Array) -> RawStep:
        """Step environments ``ids`` (n,), for a check: the steps are not counted."""
        return self._act(action, ids)

    def numbers(self, obs: Array) -> list[Array]:
        """Return copies of observations (n, …) as arrays of numbers."""
        return [part.copy() for part in leaves(obs)]

    def renew(self) -> None:
        """Close the environments, and make a new one in their place: no more may exist at once."""
        for env in self.envs:
            env.close()
        self.envs = []
        self.envs = [self._made(self._make, 0)]

    def _notice_draws(self) -> None:
        """Give a notice if the environments have just drawn from global generators."""
        if drawn := self._draws.end():
            self._draws.looks, self.draws_globally = 0, True
            modules = " and ".join(drawn)
            if are_shared():
                notice(
                    f"several threads train or play, and their environments draw from {modules}, "
                    "whose generator they share, so the same seed does not give the same weights. "
                    f"Draw from {OWN_GENERATOR}; or train in processes in place of threads"
                )
                return
            notice(
                f"{self.name} draws from {modules}, whose generator the whole program shares. The "
                "run seeds it, so the same seed gives the same weights, unless another thread "
                "draws from it, too; but an episode that is open when a run is resumed cannot be "
                f"repeated. Draw from {OWN_GENERATOR}"
            )

    def _made(self, make: Any, number: int) -> gym.Env[Any, Any]:
        """Return a new environment; an error says how many could be made."""
        try:
            made: gym.Env[Any, Any] = make(number=number)
        except SkillweaveError as error:
            if not (count := len(self.envs)):
                raise
            raise reworded(
                error,
                f"{error}. {count} could be made: if no more can exist at once, set "
                f"num_envs={count} in each algorithm, the selector's too",
            ) from error
        return made

    def _empty(self, n: int) -> Array:
        # Zeros, because the bytes between the parts of an observation are written to files.
        return np.zeros((n, *self._shape), self._dtype)

    def _check_alike(self, name: str) -> None:
        """Raise an EnvError where the environments differ in their spaces, or are one object."""
        first = self.envs[0]
        for number, env in enumerate(self.envs):
            for kind in ("observation_space", "action_space"):
                if getattr(env, kind) != getattr(first, kind):
                    raise EnvError(
                        f"{name}: its environments differ: the {kind} of environment {number} is "
                        f"{getattr(env, kind)}, but the one of environment 0 is "
                        f"{getattr(first, kind)}"
                    )
        if len({id(env.unwrapped) for env in self.envs}) < len(self.envs):
            raise EnvError(
                f"{name} returns the same environment each time; the function must make a new one"
            )


def episode_seed(root: int, row: int, episode: int) -> int:
    """Return the seed of an episode of environment ``row`` after a reset to ``root``."""
    node = np.random.SeedSequence(root, spawn_key=(row, episode))
    return int(node.generate_state(1, np.uint32)[0] >> 1)


def checksums(obs: Array) -> Array:
    """Return a checksum for each row of an engine's observations, (n,) int64."""
    sums = [0] * len(obs)
    for part in leaves(obs):
        rows = (np.ascontiguousarray(row).tobytes() for row in part)
        sums = [zlib.crc32(row, before) for row, before in zip(rows, sums, strict=True)]
    return np.array(sums, np.int64)
