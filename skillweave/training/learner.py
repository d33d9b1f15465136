"""Learners: what they keep of experience, and when they learn from it.

A loop knows of one interface: ``request`` says what collectors are to do next, ``take`` keeps what
they found, ``learn`` turns it into new parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from skillweave.algorithms.base import ActingParams
from skillweave.buffers.rollout import RolloutStore
from skillweave.collecting.acting import Request
from skillweave.experience import Batch, Reference
from skillweave.seeding import Seeds
from skillweave.types import Array, prefixed, unprefixed


@dataclass
class Stack:
    """Members of one architecture, and the algorithm that they learn by."""

    algorithm: Any
    state: Any  # of P members

    def __post_init__(self) -> None:
        self.algorithm.check_state(self.state)  # it may be one that was read from a file

    @property
    def members(self) -> int:
        """P."""
        return len(self.state.params)


class Learner(Protocol):
    """Stacks that learn from what they did."""

    @property
    def stacks(self) -> Sequence[Stack]:
        """Side by side."""
        ...

    overlap: bool
    """It may learn on a thread of its own, while the next experience is collected."""
    report_every: int
    """Environment steps between reports; 0: after every update."""
    threads: int

    def request(self, update: int, steps: int, progress: float) -> Request:
        """What collectors are to do next."""
        ...

    def take(self, batches: Mapping[str, Batch]) -> None:
        """Store what was collected by the latest request, by path; "" where there is one."""
        ...

    def learn(self, update: int, steps: int, progress: float) -> dict[str, Tensor]:
        """Learn what is due; metrics (P,), none where nothing was."""
        ...

    def cut(self, columns: Array) -> None:
        """The environments of ``columns`` (k,) begin anew."""
        ...

    def kept(self, *, requested: bool = True, replay: bool = True) -> dict[str, Tensor]:
        """Return what going on exactly needs beside the states of the stacks.

        Args:
            requested: the latest request is not yet answered; the parameters it acts by are a part
                of this, as with overlap they are one update older than the states.
            replay: with replay buffers, if the settings save them.
        """
        ...

    def load(self, kept: dict[str, Tensor]) -> None:
        """The inverse of ``kept``."""
        ...


class RolloutLearner:
    """One stack that learns from its latest rollout, then forgets it.

    Args:
        quota: valid rows that each member collects before it learns; 0: what there is.
    """

    report_every = 0

    def __init__(self, stack: Stack, seeds: Seeds, quota: int = 0) -> None:
        self.stacks, self._stack, self._seeds = (stack,), stack, seeds
        config = stack.algorithm.config
        self.overlap, self.threads = bool(config.overlap), int(config.threads)
        self._store = RolloutStore(stack.members, quota, stack.state.params.device)
        self.reference: Reference | None = None
        """The policy that it is to stay near, if there is one."""
        self._progress = 0.0  # where the rollout began, so that the first has the whole rate
        self._resumed: ActingParams | None = None  # of the first request after a checkpoint

    def request(self, update: int, steps: int, progress: float) -> Request:
        """A rollout of ``n_steps`` environment steps of each environment."""
        algorithm, state = self._stack.algorithm, self._stack.state
        params, self._resumed = self._resumed or algorithm.acting_params(state, progress), None
        seeds = self._seeds / "collect" / update
        self._asked = params, progress
        rows, gamma = algorithm.config.n_steps, state.gamma.cpu().numpy()
        return Request(rows, (params,), gamma, seeds, record=algorithm.raw)

    def take(self, batches: Mapping[str, Batch]) -> None:
        """Keep a rollout, and what it was collected with."""
        params, self._progress = self._asked
        log_std = params.views.get("actor.log_std")
        self._store.add(batches[""], None if log_std is None else log_std[:, None])

    def learn(self, update: int, steps: int, progress: float) -> dict[str, Tensor]:
        """An update, where there was something to learn from."""
        stack = self._stack
        gamma, reference = stack.state.gamma, self.reference
        rollout = self._store.rollout(gamma, self._progress, reference)
        if rollout is None:
            return {}
        seeds = member_seeds(self._seeds, "learn", stack.members, update)
        generators = [s.torch() for s in seeds]
        with torch.enable_grad():  # the user may have switched gradients off
            stack.state, report = stack.algorithm.update(stack.state, rollout, generators)
        metrics: dict[str, Tensor] = report.metrics
        if reference is not None and "reference_kl" in metrics:
            kl = metrics["reference_kl"]
            reference.coef = adapted(reference.coef, kl, reference.target_kl)
        return metrics

    def cut(self, columns: Array) -> None:
        """Nothing to do: trajectories end with each experience."""

    def kept(self, *, requested: bool = True, replay: bool = True) -> dict[str, Tensor]:
        """Rows of which there are not enough yet, what a nat of divergence costs, who acts next."""
        reference = self.reference
        coef = {} if reference is None else {"reference_coef": reference.coef.cpu().clone()}
        params, _ = self._asked
        acting = prefixed("acting", params.state()) if requested else {}
        return self._store.state() | coef | acting

    def load(self, kept: dict[str, Tensor]) -> None:
        """Go on from what a checkpoint kept."""
        algorithm = self._stack.algorithm
        acting = unprefixed("acting", kept)
        self._resumed = acting_of(self._stack, acting) if acting else None
        self._store.load(kept, algorithm.observation_space, algorithm.codec)
        if self.reference is not None:
            coef = kept["reference_coef"]
            if coef.shape != self.reference.coef.shape or not bool(coef.isfinite().all()):
                raise ValueError(f"the price of divergence is {coef.tolist()}")
            self.reference.coef = coef.to(self.reference.coef.device)


def acting_of(stack: Stack, saved: dict[str, Tensor]) -> ActingParams:
    """Return the acting parameters of a stack whose state was ``saved``.

    Raises:
        ValueError: it does not fit.
    """
    found: ActingParams = stack.algorithm.acting_params(stack.state, 0.0)
    found.load(saved)
    return found


def keep_to_guide(learner: Learner, target_kl: float | None) -> None:
    """Keep the selector within ``target_kl`` of its guide; None disables this."""
    if target_kl is not None and isinstance(learner, RolloutLearner):
        (stack,) = learner.stacks
        coef = torch.ones_like(stack.state.params[:, 0])
        learner.reference = Reference(None, coef, target_kl)


def adapted(coef: Tensor, kl: Tensor, target_kl: float) -> Tensor:
    """Return the next cost of a nat of KL, so that KL approaches ``target_kl``; (P,) each.

    The rule of the adaptive penalty of Schulman et al. 2017, sec. 4.
    """
    one = torch.ones_like(kl)
    factor = torch.where(
        kl > 1.5 * target_kl, 2.0 * one, torch.where(kl < target_kl / 1.5, 0.5 * one, one)
    )
    return (coef * factor).clamp(1e-3, 1e3)


def member_seeds(seeds: Seeds, name: str, members: int, update: int, first: int = 0) -> list[Seeds]:
    """A node of the seed tree for each member from ``first`` on."""
    return [seeds / name / (first + member) / update for member in range(members)]


def crossed(every: int, before: int, after: int) -> bool:
    """Whether a multiple of ``every`` lies between ``before`` and ``after``, or is ``after``."""
    return after // every > before // every
