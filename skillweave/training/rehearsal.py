"""The rehearsal of a repair: observations in which a skill keeps what it did, in a file of the run.

A learner that changes is likely to forget what its new episodes seldom show. Where its calls were
done, the earlier policy works, so there it is a teacher (kickstarting, Schmitt et al. 2018); where
they failed, it is none. The observations were recorded before, so they cost no step.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.batches import Rehearsal
from skillweave.algorithms.ppo import PPOAlgorithm
from skillweave.errors import RunError
from skillweave.policies.core import Array
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import check_unchanged, read_tensors
from skillweave.runs.manifest import StageEntry
from skillweave.spaces import to_tensor
from skillweave.training.learner import RolloutLearner

MOST_BYTES = 2**26
"""The most bytes of observations."""
KIND = "rehearsal"


def can_rehearse(algorithm: Algorithm) -> bool:
    """Return whether an algorithm learns with a repair's rehearsal: PPO without a memory.

    Algorithms of replay have no policy loss in which a nat has the same cost everywhere, and in a
    recurrent network an observation is not all that the policy sees.
    """
    return isinstance(algorithm, PPOAlgorithm) and not algorithm.memory_size


def save_rehearsal(run: RunDirectory, stage: str, obs: Array) -> None:
    """Write the observations (n, *obs_shape) of a repair's rehearsal; some, where they are many.

    The stage records the file's checksum.
    """
    most = max(1, MOST_BYTES // max(1, obs[0].nbytes))
    if len(obs) > most:
        rng = (Seeds(0) / KIND).numpy()
        obs = obs[np.sort(rng.choice(len(obs), most, replace=False))]
    tensors = {"obs": to_tensor(np.ascontiguousarray(obs))}
    repair = run.stage(stage).repair
    assert repair is not None
    repair.rehearsal = run.write("starts", stage, tensors, {"kind": KIND}, stage)


def rehearse(learner: RolloutLearner, run: RunDirectory, entry: StageEntry, policy: Any) -> None:
    """Let a learner keep what ``policy`` does in the observations of its stage's rehearsal, if any.

    Raises:
        RunError: the file is missing, damaged, or belongs to another run.
    """
    recorded = None if entry.repair is None else entry.repair.rehearsal
    if recorded is None:
        return
    assert isinstance(policy, AgentPolicy)
    path = run.file("starts", entry.name)
    if not path.exists():
        raise RunError(
            f"{path} is missing: the repair keeps to it what the skill could do. Restore the file, "
            "or repair again in another directory"
        )
    tensors, header = read_tensors(path)
    run.must_be_ours(header.get("run"), path)
    check_unchanged(path, header, recorded)
    (stack,) = learner.stacks
    device = stack.state.params.device
    learner.rehearsal = rehearsal_of(policy, tensors["obs"].to(device), device)


@torch.no_grad()
def rehearsal_of(policy: AgentPolicy, obs: torch.Tensor, device: torch.device) -> Rehearsal:
    """Return the rehearsal for a repair of a policy in observations (n, *obs_shape)."""
    algorithm: Any = policy.algorithm
    state = algorithm.init([Seeds(0)])
    algorithm.set_weights(state, policy.weights)
    params = algorithm.learning_params(state)
    obs = obs[None]
    dist_params = algorithm.actor_net(params.views, algorithm.inputs(params, obs.cpu()))
    log_std = params.views.get("actor.log_std")
    return Rehearsal(
        obs, dist_params.to(device), None if log_std is None else log_std.clone().to(device)
    )
