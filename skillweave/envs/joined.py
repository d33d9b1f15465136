"""Several vectorised environments of one kind as one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from skillweave.seeding import Seeds
from skillweave.types import Array, VecEnv, VecStep, prefixed, unprefixed


class JoinedEnvs:
    """A ``VecEnv`` whose environments are those of its parts, one part after another.

    All parts have as many environments.
    """

    def __init__(self, parts: Sequence[VecEnv]) -> None:
        self.parts = list(parts)
        self._each = parts[0].num_envs
        self.num_envs = self._each * len(self.parts)
        self.observation_space = parts[0].observation_space
        self.action_space = parts[0].action_space

    @property
    def steps_made(self) -> int:
        """Steps that all environments have made."""
        return sum(part.steps_made for part in self.parts)

    @property
    def obs(self) -> Array:
        """(N, *obs_shape), what to act on next."""
        return np.concatenate([part.obs for part in self.parts])

    def reset(self, seeds: Seeds) -> Array:
        """Start all anew, each part from a node of its own."""
        return np.concatenate([part.reset(seeds / i) for i, part in enumerate(self.parts)])

    def mask(self) -> Array | None:
        """(N, A) bool, the actions allowed now, or None."""
        return _joined([part.mask() for part in self.parts])

    def step(self, action: Array) -> VecStep:
        """One action in each environment."""
        actions = np.split(action, len(self.parts))
        steps = [part.step(own) for part, own in zip(self.parts, actions, strict=True)]
        if len(steps) == 1:
            return steps[0]

        def all_of(field: Callable[[VecStep], Array]) -> Array:
            return np.concatenate([field(step) for step in steps])

        return VecStep(
            next_obs=all_of(lambda s: s.next_obs),
            obs=all_of(lambda s: s.obs),
            reward=all_of(lambda s: s.reward),
            terminated=all_of(lambda s: s.terminated),
            truncated=all_of(lambda s: s.truncated),
            steps=all_of(lambda s: s.steps),
            mask=_joined([s.mask for s in steps]),
            info=self._infos([s.info for s in steps]),
            next_mask=_joined([s.next_mask for s in steps]),
        )

    def renew(self, seeds: Seeds) -> Array:
        """Take new seeds; the environments that begin anew."""
        return self._ids([part.renew(seeds / i) for i, part in enumerate(self.parts)])

    def state(self) -> dict[str, Array]:
        """All that ``restore`` needs."""
        found: dict[str, Array] = {}
        for i, part in enumerate(self.parts):
            found |= prefixed(str(i), part.state())
        return found

    def restore(self, state: dict[str, Array]) -> Array:
        """Stand where ``state`` says; the environments that begin anew."""
        return self._ids([p.restore(unprefixed(str(i), state)) for i, p in enumerate(self.parts)])

    def set_gamma(self, gamma: Array) -> None:
        """γ of one step in each environment, (N,), from now on."""
        for part, own in zip(self.parts, np.split(gamma, len(self.parts)), strict=True):
            part.set_gamma(own)

    def close(self) -> None:
        """Release all parts."""
        for part in self.parts:
            part.close()

    def _ids(self, parts: list[Array]) -> Array:
        return np.concatenate([ids + i * self._each for i, ids in enumerate(parts)])

    def _infos(self, infos: list[dict[str, Any]]) -> dict[str, Any]:
        """What all parts tell, array by array."""

        def batched(value: Any) -> bool:
            return isinstance(value, np.ndarray) and value.shape[:1] == (self._each,)

        return {
            k: _concatenated([info[k] for info in infos])
            for k in infos[0]
            if all(batched(info.get(k)) for info in infos)
        }


def _concatenated(parts: list[Array]) -> Array:
    """Rows of all parts; rows of numbers as long as the longest, zeros behind the others."""
    if parts[0].ndim == 2:
        widest = max(part.shape[1] for part in parts)
        parts = [np.pad(part, ((0, 0), (0, widest - part.shape[1]))) for part in parts]
    return np.concatenate(parts)


def _joined(masks: list[Array | None]) -> Array | None:
    """Masks (n, A) of all parts; a part without one allows everything."""
    known = next((mask for mask in masks if mask is not None), None)
    if known is None:
        return None
    return np.concatenate([np.ones_like(known) if mask is None else mask for mask in masks])
