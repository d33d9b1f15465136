"""The episodes by which members of a population are compared."""

from __future__ import annotations

import numpy as np

from skillweave.algorithms.policy import AgentPolicy
from skillweave.collecting.collector import RETURN
from skillweave.seeding import Seeds
from skillweave.training.arena import episodes_of
from skillweave.training.scene import Scene


class FitnessArena:
    """Environments in which one member after another plays the same episodes.

    They are at most as many as in a member's training: more episodes are played in several rounds.

    Args:
        scene: the task that members learn.
        episodes: the number of episodes of each member.
        num_envs: environments of a member's training.
    """

    def __init__(self, scene: Scene, episodes: int, num_envs: int) -> None:
        rounds = -(-episodes // num_envs)
        self._episodes = episodes
        self._collector = scene.collector(-(-episodes // rounds), None)

    @property
    def steps_made(self) -> int:
        """Return the number of steps of all members in these environments."""
        return self._collector.engine.steps_made

    def score(self, policy: AgentPolicy, seeds: Seeds) -> float:
        """Return a policy's mean return of the episodes of these seeds; −inf if not finite."""
        arena, total = self._collector, self._episodes
        returns = np.concatenate(
            [
                episodes_of(policy, arena, seeds, first, min(arena.num_envs, total - first))[
                    :, RETURN
                ]
                for first in range(0, total, arena.num_envs)
            ]
        )
        return float(returns.mean()) if np.isfinite(returns).all() else -np.inf

    def close(self) -> None:
        """Release the environments."""
        self._collector.close()
