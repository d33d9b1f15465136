"""The episodes by which members of a population are compared."""

from __future__ import annotations

import numpy as np

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.policy import AgentPolicy
from skillweave.experience.collector import RETURN
from skillweave.training.learning_task import LearningTask
from skillweave.training.periodic import episodes_of


class FitnessEnvs:
    """Environments in which one member after another plays the same episodes.

    They are at most as many as in a member's training: more episodes are played in several rounds.

    Args:
        learning_task: the task that members learn.
        episodes: the number of episodes of each member.
        num_envs: environments of a member's training.
    """

    def __init__(self, learning_task: LearningTask, episodes: int, num_envs: int) -> None:
        rounds = -(-episodes // num_envs)
        self._episodes, self._who = episodes, learning_task.who
        self._engine = learning_task.engine(-(-episodes // rounds))

    @property
    def steps_made(self) -> int:
        """Return the number of steps of all members in these environments."""
        return self._engine.steps_made

    def score(self, policy: AgentPolicy, seeds: Seeds) -> float:
        """Return a policy's mean return of the episodes of these seeds; −inf if not finite."""
        total, each = self._episodes, self._engine.num_envs
        played = [
            episodes_of(policy, self._who, self._engine, seeds, first, min(each, total - first))
            for first in range(0, total, each)
        ]
        returns = np.concatenate(played)[:, RETURN]
        return float(returns.mean()) if np.isfinite(returns).all() else -np.inf

    def close(self) -> None:
        """Release the environments."""
        self._engine.close()
