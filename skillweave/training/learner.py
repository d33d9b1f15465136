"""Learners: storage of experience, and updates from it.

A loop uses one interface: ``request`` returns the next task of the collectors, ``take`` stores the
result, ``learn`` updates the parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.base import ActingParams
from skillweave.algorithms.batches import Batch, Reference, Rehearsal
from skillweave.buffers.rollout import RolloutStore
from skillweave.experience.acting import Request
from skillweave.ops.device import INT
from skillweave.policies.core import Array

KNOWN = 0.5
"""The explained variance of returns from which a policy is changed by its critic."""


@dataclass
class Stack:
    """Members of one architecture, and the algorithm that they learn by."""

    algorithm: Any
    state: Any  # of P members

    @property
    def members(self) -> int:
        """Number of members, P."""
        return len(self.state.params)


class Learner(Protocol):
    """Stacks that learn from their own experience."""

    @property
    def stacks(self) -> Sequence[Stack]:
        """The stacks, side by side."""
        ...

    overlap: bool
    """True if it may learn on a separate thread while the next experience is collected."""
    report_every: int
    """Environment steps between reports; 0: after every update."""
    threads: int

    def request(self, update: int, steps: int, progress: float) -> Request:
        """Return the next task of the collectors."""
        ...

    def take(self, batches: Mapping[str, Batch]) -> None:
        """Store the batches of the latest request, by path; "" for a single learner."""
        ...

    def learn(self, update: int, steps: int, progress: float) -> dict[str, Tensor]:
        """Make the updates that are due; return metrics (P,), {} where none was due."""
        ...

    def cut(self, columns: Array) -> None:
        """End the open trajectories of ``columns`` (k,), whose environments were reset."""
        ...

    def kept(self, *, requested: bool = True, replay: bool = True) -> dict[str, Tensor]:
        """Return the tensors that an exact continuation needs beside the states of the stacks.

        Args:
            requested: the latest request is still unanswered; its acting parameters are included,
                as with overlap they are one update older than the states.
            replay: include replay buffers, if the settings save them.
        """
        ...

    def load(self, kept: dict[str, Tensor]) -> None:
        """Restore the tensors that ``kept`` returned."""
        ...


class RolloutLearner:
    """Learner of one stack from its latest rollout, which is used once.

    Args:
        quota: valid rows that each member collects before it learns; 0: any number.
    """

    report_every = 0

    def __init__(self, stack: Stack, seeds: Seeds, quota: int = 0) -> None:
        self.stacks = (stack,)
        self._stack = stack
        self._seeds = seeds
        config = stack.algorithm.config
        self.overlap = bool(config.overlap)
        self.threads = int(config.threads)
        self._store = RolloutStore(stack.members, quota, stack.state.params.device)
        self.reference: Reference | None = None
        """The reference policy that it stays near; None: without one."""
        self.rehearsal: Rehearsal | None = None
        """Observations in which it keeps what an earlier policy did; None: it may change all."""
        self.critic_first = (0, 0)
        """The fewest and the most of the next updates in which the critic learns alone, as its
        policy was learnt without it: until it explains returns."""
        self.keeps_scaling = False
        """Observations stay scaled as for the policy that was given."""
        self.rows = 0
        """Rows so far, of a member."""
        self.updates = 0
        """Updates so far."""
        self.quota = quota
        self._progress = 0.0  # at the start of the rollout, so that the first has the whole rate
        self._resumed: ActingParams | None = None  # of the first request after a checkpoint

    def request(self, update: int, steps: int, progress: float) -> Request:
        """Return a request for a rollout of ``n_steps`` steps of each environment."""
        algorithm, state = self._stack.algorithm, self._stack.state
        params = self._resumed or algorithm.acting_params(state, progress)
        self._resumed = None
        self._requested = params, progress
        return Request(
            algorithm.config.n_steps,
            (params,),
            state.gamma.cpu().numpy(),
            self._seeds / "collect" / update,
            record=algorithm.raw,
        )

    def take(self, batches: Mapping[str, Batch]) -> None:
        """Store a rollout, with the exploration noise of its acting policy."""
        params, self._progress = self._requested
        log_std = params.views.get("actor.log_std")
        batch = batches[""]
        self.rows += int(batch.own_rows.sum()) // self._stack.members
        self._store.add(batch, None if log_std is None else log_std[:, None])

    def learn(self, update: int, steps: int, progress: float) -> dict[str, Tensor]:
        """Make an update if the store has enough rows."""
        stack = self._stack
        gamma = stack.state.gamma
        reference = self.reference
        rollout = self._store.rollout(gamma, self._progress, reference)
        if rollout is None:
            return {}
        rollout.rehearsal = self.rehearsal
        rollout.keeps_scaling = self.keeps_scaling
        rollout.critic_alone = self.critic_first[1] > 0
        seeds = member_seeds(self._seeds, "learn", stack.members, update)
        generators = [s.torch() for s in seeds]
        with torch.enable_grad():  # the user may have switched gradients off
            stack.state, report = stack.algorithm.update(stack.state, rollout, generators)
        metrics: dict[str, Tensor] = report.metrics
        self.updates += 1
        if rollout.critic_alone:
            fewest, most = (max(0, updates - 1) for updates in self.critic_first)
            known = not fewest and float(metrics["explained_variance"].min()) > KNOWN
            self.critic_first = (0, 0) if known else (fewest, most)
        if reference is not None and "reference_kl" in metrics:
            kl = metrics["reference_kl"]
            reference.coef = adapted(reference.coef, kl, reference.target_kl)
        return metrics

    def cut(self, columns: Array) -> None:
        """Do nothing: trajectories end with each batch."""

    def kept(self, *, requested: bool = True, replay: bool = True) -> dict[str, Tensor]:
        """Return stored rows, the KL coefficient, and the next acting parameters."""
        reference = self.reference
        coef = {} if reference is None else {"reference_coef": reference.coef.cpu().clone()}
        params, _ = self._requested
        acting = prefixed("acting", params.state()) if requested else {}
        first = {}
        if any(self.critic_first):
            first = {"critic_first": torch.tensor(self.critic_first, **INT)}
        counts = {"counts": torch.tensor([self.rows, self.updates], **INT)}
        return self._store.state() | coef | acting | first | counts

    def load(self, kept: dict[str, Tensor]) -> None:
        """Restore the tensors of a checkpoint."""
        algorithm = self._stack.algorithm
        acting = unprefixed("acting", kept)
        self._resumed = acting_of(self._stack, acting) if acting else None
        self._store.load(kept, algorithm.observation_space, algorithm.codec)
        self.rows, self.updates = kept["counts"].tolist()
        fewest, most = kept["critic_first"].tolist() if "critic_first" in kept else (0, 0)
        self.critic_first = fewest, most
        if self.reference is not None:
            self.reference.coef = kept["reference_coef"].to(self.reference.coef.device)


def acting_of(stack: Stack, saved: dict[str, Tensor]) -> ActingParams:
    """Return the acting parameters of a stack whose state was ``saved``."""
    params: ActingParams = stack.algorithm.acting_params(stack.state, 0.0)
    params.load(saved)
    return params


def keep_to_guide(learner: RolloutLearner, target_kl: float | None) -> None:
    """Keep the selector within ``target_kl`` of its guide; None disables this."""
    if target_kl is not None:
        (stack,) = learner.stacks
        coef = torch.ones_like(stack.state.params[:, 0])
        learner.reference = Reference(None, coef, target_kl)


def adapted(coef: Tensor, kl: Tensor, target_kl: float) -> Tensor:
    """Return a learner's next coefficient of the KL to its guide, to near ``target_kl``; (P,).

    The rule of the adaptive penalty of Schulman et al. 2017, sec. 4.
    """
    one = torch.ones_like(kl)
    factor = torch.where(
        kl > 1.5 * target_kl, 2.0 * one, torch.where(kl < target_kl / 1.5, 0.5 * one, one)
    )
    return (coef * factor).clamp(1e-3, 1e3)


def member_seeds(seeds: Seeds, name: str, members: int, update: int, first: int = 0) -> list[Seeds]:
    """Return a node of the seed tree for each member from ``first`` on."""
    return [seeds / name / (first + member) / update for member in range(members)]


def crossed(every: int, before: int, after: int) -> bool:
    """Return True if a task due every ``every`` steps is due in (``before``, ``after``]."""
    return after // every > before // every
