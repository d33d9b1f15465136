"""Environments under way, and the episodes in them: what every loop acts through."""

from __future__ import annotations

import numpy as np
import torch

from skillweave.envs.joined import JoinedEnvs
from skillweave.seeding import Seeds
from skillweave.spaces import to_tensor
from skillweave.training.episodes import Episodes
from skillweave.types import (
    Array,
    SkillweaveError,
    VecEnv,
    VecStep,
    prefixed,
    unprefixed,
)


class Collector:
    """N environments, from one loop to the next and from one process to the next.

    A clean cut does not end episodes: ``state`` holds what is needed to play them again.

    Args:
        env: the environments; they are reset by ``start``, or stand where ``restore`` puts them.
    """

    def __init__(self, env: VecEnv) -> None:
        self.env, self.num_envs = env, env.num_envs
        self.episodes = Episodes()
        self.carried: dict[str, Array] = {"sums": np.zeros((env.num_envs, 3))}
        """By name, what is kept for each environment's open episode, (N, …); changed in place."""
        self.begun = False
        self.begun_anew = np.zeros(0, np.int64)
        """(k,) environments that ``restore`` could not bring back: they began anew."""
        self._counted = env.steps_made

    @property
    def obs(self) -> Array:
        """(N, *obs_shape), what to act on next."""
        return self.env.obs

    def mask(self) -> Array | None:
        """(N, A) bool, the actions allowed now, or None."""
        return self.env.mask()

    def carry(self, name: str, like: Array) -> Array:
        """What is kept under this name; zeros shaped as ``like`` (N, …) the first time.

        Raises:
            SkillweaveError: a checkpoint holds something of another shape or type under this name.
        """
        kept = self.carried.setdefault(name, np.zeros_like(like))
        if kept.shape != like.shape or kept.dtype != like.dtype:
            raise SkillweaveError(
                f"the checkpoint's {name!r} of open episodes is {kept.dtype} {kept.shape}, where "
                f"{like.dtype} {like.shape} belongs: it is not of this stage, or damaged"
            )
        return kept

    def start(self, seeds: Seeds) -> None:
        """Start every environment anew, unless they are under way."""
        if not self.begun:
            self.env.reset(seeds)
            self.begun = True

    def step(self, action: Array) -> VecStep:
        """One action in each environment, in the environment's units."""
        step = self.env.step(action)
        self.episodes.add(step, self.carried["sums"])
        return step

    def spent(self) -> int:
        """Environment steps made since this was last asked, those in search of a start included."""
        made = self.env.steps_made
        since, self._counted = made - self._counted, made
        return since

    def cut(self, seeds: Seeds) -> Array:
        """Make ready for ``state``; (k,) environments that begin anew as it would be too long."""
        return self._forget(self.env.renew(seeds))

    def state(self) -> dict[str, torch.Tensor]:
        """All that ``restore`` needs, right after ``cut``."""
        found = prefixed("env", self.env.state()) | prefixed("carried", self.carried)
        found |= prefixed("episodes", self.episodes.state())
        return {k: to_tensor(v.copy()) for k, v in found.items()}

    def restore(self, state: dict[str, torch.Tensor], seeds: Seeds) -> None:
        """Stand where ``state`` says; ``begun_anew`` are those that could not be brought back."""
        arrays = {k: v.numpy() for k, v in state.items()}
        sums = self.carried["sums"]
        self.carried = {k: v.copy() for k, v in unprefixed("carried", arrays).items()}
        self.carry("sums", sums)
        self.episodes.load(unprefixed("episodes", arrays))
        if env := unprefixed("env", arrays):
            self.begun_anew = self.env.restore(env)
        else:  # a foreign vector, which cannot be brought back
            self.env.reset(seeds)
            self.begun_anew = np.arange(self.num_envs)
        self.begun = True
        self._forget(self.begun_anew)

    def part(self, first: int, last: int) -> Collector:
        """The collector of some parts of ``JoinedEnvs``, from ``first`` to before ``last``.

        What it carries so far is this collector's own; it counts apart.
        """
        assert isinstance(self.env, JoinedEnvs)
        found = Collector(JoinedEnvs(self.env.parts[first:last]))
        each = self.num_envs // len(self.env.parts)
        rows = slice(first * each, last * each)
        found.carried = {k: v[rows] for k, v in self.carried.items()}  # views: changed in place
        found.episodes, found.begun = self.episodes, self.begun
        return found

    def _forget(self, ids: Array) -> Array:
        for kept in self.carried.values():
            kept[ids] = 0
        return ids
