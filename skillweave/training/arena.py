"""Episodes of a learner in the environments that it learns in, to see how good it is."""

from __future__ import annotations

import numpy as np

from skillweave.algorithms.policy import AgentPolicy
from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.collector import RETURN, Collector
from skillweave.envs.checks import longest_evaluation
from skillweave.ops.threads import torch_threads
from skillweave.seeding import Seeds, global_generators
from skillweave.types import Array


def returns_of(policy: AgentPolicy, arena: Collector, seeds: Seeds) -> Array:
    """Returns of one episode in each of the arena's environments, as of ``episodes_of``."""
    returns: Array = episodes_of(policy, arena, seeds)[:, RETURN]
    return returns


def episodes_of(policy: AgentPolicy, arena: Collector, seeds: Seeds) -> Array:
    """What one episode in each environment came to, acting greedily, as ``Collected.episodes``.

    Returns:
        (n, 4), n at least 1; environments where a skill could never start are left out.
    """
    algorithm = policy.algorithm
    player = arena.like(arena.engine, Acting([(algorithm, 1)], arena.num_envs))
    params = algorithm.acting_params_of(policy.weights)
    gamma = np.array([algorithm.config.gamma])
    request = Request(0, (params,), gamma, seeds / "act", greedy=True)
    limit = longest_evaluation(arena.engine.time_limit)
    # Several threads wait for each other, for ever on a busy machine.
    with torch_threads(1), global_generators(seeds / "global"):
        found: Array = player.play(request, seeds / "start", limit)
    began: Array = ~np.isnan(found[:, RETURN])
    return found[began]
