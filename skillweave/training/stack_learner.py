"""The learner of one stack: from rollouts or from replay, as its algorithm stores experience."""

from __future__ import annotations

from skillweave._internal.seeding import Seeds
from skillweave.buffers.judged import Judge
from skillweave.training.learner import RolloutLearner, Stack
from skillweave.training.offline import OfflineLearner
from skillweave.training.replay_learner import ReplayLearner, store_of

LEAST_SHARE = 0.5
"""The share of a rollout's rows from which a learner of steps learns.

A skill acts in some of the steps alone, so its batches differ in size. Small ones make noisy
updates, so it waits for half of a rollout. A whole one would often take a second rollout, when the
rows of the first are of older weights. A learner that acts in every step never waits.
"""


def learner_of(
    stack: Stack,
    num_envs: int,
    seeds: Seeds,
    quota: int | None = None,
    *,
    row_steps: int = 1,
    goes_on_at: int = 0,
    judge: Judge | None = None,
    data_steps: int = 0,
    capacity: int | None = None,
) -> RolloutLearner | ReplayLearner:
    """Return the learner of one stack of members in a stage, from rollouts or from replay.

    Args:
        quota: see ``RolloutLearner``; None: ``LEAST_SHARE`` of a rollout where a row is a step,
            and any number of decisions, which are fewer than steps.
        row_steps, goes_on_at: see ``ReplayLearner``.
        judge, capacity: see ``store_of``.
        data_steps: see ``OfflineLearner``; 0: it learns from its own steps from the beginning.
    """
    if stack.algorithm.store == "rollout":
        if quota is None:
            rows = int(stack.algorithm.config.n_steps) * num_envs // stack.members
            quota = int(LEAST_SHARE * rows) if row_steps == 1 else 0
        return RolloutLearner(stack, seeds, quota)
    store = store_of(stack.algorithm, num_envs, stack.members, judge=judge, capacity=capacity)
    if data_steps:
        return OfflineLearner([stack], store, seeds, data_steps)
    return ReplayLearner([stack], store, seeds, row_steps=row_steps, goes_on_at=goes_on_at)
