"""Experience: what a collector gives to a learner, and the batches that a learner learns from.

Arrays of NumPy end here and tensors begin: a store turns ``Experience`` into ``Rollout`` or
``Sample``, on the learner's device.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

from skillweave.types import Array

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(slots=True)
class Experience:
    """What one learner did in N environments: T rows of N columns, in the order of time.

    A row of a column is one transition: a primitive step of a skill or of a plain agent, or one
    decision of a selector with the whole call that followed. Columns need not be full: only where
    ``valid`` holds did this learner act. Where a valid row neither terminated nor was truncated,
    the column's next valid row, here or in the next experience, begins where this one ended.

    N = P·B: the environments of member 0 come first, then those of member 1, and so on.
    """

    obs: Array  # (T, N, *obs_shape)
    action: Array  # (T, N) int64, or (T, N, A) float32 in policy units
    reward: Array  # (T, N) float32, the learner's own; of a call Σ γᵏ rₖ
    steps: Array  # (T, N) int64, environment steps: 1, or τ of a call
    terminated: Array  # (T, N) bool, nothing is worth anything after it
    truncated: Array  # (T, N) bool, cut here, but its value goes on; never where terminated
    next_obs: Array  # (T, N, *obs_shape), the true successors
    obs_mask: Array | None = None  # (T, N, A) bool, allowed actions in ``obs``; None: all
    next_obs_mask: Array | None = None  # (T, N, A) bool, in ``next_obs``; None: all
    valid: Array | None = None  # (T, N) bool, rows of this learner; None: all
    head: Array | None = None  # (T, N, H) float32, the distribution that ``action`` is from
    memory: Array | None = None  # (N, M) float32, before each column's first valid row
    starts: Array | None = None  # (T, N) bool, an episode begins here, so memory is empty before it
    rewards: Array | None = None  # (T, N, L) float32, of each step of a call, then zeros
    advantage: Array | None = None  # (T, N) float32, what counts beside the learner's own
    guide: Array | None = None  # (T, N, A) float32, logits of a ready selector's choice
    overridden: Array | None = None  # (T, N) bool, a reflex acted, not ``action``; None: nowhere
    decided: Array | None = None  # (T, N) bool, a call begins here; of critics of skills
    parts: tuple[Experience, ...] = ()
    """Of a selector: what its skills did in the same steps, those that learn, in their order."""
    spent: int = 0
    """Environment steps that were made for it, those of rows that are not valid included."""

    @property
    def ended(self) -> Array:
        """(T, N) bool, the trajectory ends here, by termination or truncation."""
        ended: Array = self.terminated | self.truncated
        return ended


@dataclass(slots=True)
class Rollout:
    """Trajectories for an on-policy learner: P members, T rows of B columns each.

    ``discount`` is 0 where the trajectory terminated, else γ^τ; ``last`` says that it is cut here
    (terminated, truncated, or the rollout's end). The ``valid`` rows of a column come first; the
    others repeat valid ones.
    """

    obs: Tensor  # (P, T, B, *obs_shape)
    action: Tensor  # (P, T, B) int64 or (P, T, B, A) float32
    reward: Tensor  # (P, T, B)
    discount: Tensor  # (P, T, B)
    next_obs: Tensor  # (P, T, B, *obs_shape), the true successors
    last: Tensor  # (P, T, B) bool; False where not valid
    obs_mask: Tensor | None = None  # (P, T, B, A) bool
    valid: Tensor | None = None  # (P, T, B) bool; None: all
    head: Tensor | None = None  # (P, T, B, H)
    log_std: Tensor | None = None
    """Of who acted, where it is no part of ``head``: (P, 1, 1, A), or (P, 1, B, A), by column."""
    memory: Tensor | None = None  # (P, B, M), before the first row
    starts: Tensor | None = None  # (P, T, B) bool, memory is empty before this row
    advantage: Tensor | None = None  # (P, T, B), what counts beside the learner's own advantage
    guide: Tensor | None = None  # (P, T, B, A), logits of a ready selector's choice
    overridden: Tensor | None = None  # (P, T, B) bool, a reflex acted instead; None: nowhere
    decided: Tensor | None = None  # (P, T, B) bool, a call begins here; of critics of skills
    anchor: Anchor | None = None  # the policy to stay near
    progress: float = 0.0  # share of the budget that is spent, for schedules


@dataclass(slots=True)
class Anchor:
    """The policy that a learner is to stay near."""

    params: Any | None  # ``ActingParams`` of P members; None: ``Rollout.guide`` says what it does
    coef: Tensor  # (P,), what a nat of KL from it costs
    nats: float = 0.0  # how far from it the learner is to be; the cost follows it


@dataclass(slots=True)
class Sample:
    """A batch from replay: P members, B transitions of up to n rows each.

    ``reward`` is the discounted sum over the n rows, ``discount`` what the value of ``next_obs``
    counts after them: 0 where the episode terminated, else γ^Στ.
    """

    obs: Tensor  # (P, B, *obs_shape)
    action: Tensor  # (P, B) int64 or (P, B, A)
    reward: Tensor  # (P, B) float32
    discount: Tensor  # (P, B) float32
    next_obs: Tensor  # (P, B, *obs_shape), the true successors
    obs_mask: Tensor | None  # (P, B, A) bool, allowed actions in ``obs``; None: all
    next_obs_mask: Tensor | None  # (P, B, A) bool, allowed actions in ``next_obs``; None: all
    weight: Tensor | None  # (P, B) float32, importance weights; None where drawn uniformly
    index: Array  # (P, B) int64, which transitions these are, to give them new priorities
    # Where an algorithm asks for them, the n − 1 observations between ``obs`` and ``next_obs``:
    between_obs: Tensor | None = None  # (P, B, n − 1, *obs_shape)
    between_mask: Tensor | None = None  # (P, B, n − 1, A) bool, allowed actions; None: all
    between_discount: Tensor | None = None
    """(P, B, n − 1), what a reward there counts: γ^Στ, or 0 where the rows ended before."""
    progress: float = 0.0  # share of the budget that is spent, for schedules

    def split(self, batch: int) -> Iterator[Sample]:
        """Samples of ``batch`` transitions of each member, one after another."""
        size = self.reward.shape[1]
        whole: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        for start in range(0, size, batch):
            part = slice(start, start + batch)
            found: dict[str, Any] = {
                k: v if v is None or isinstance(v, float) else v[:, part] for k, v in whole.items()
            }
            yield Sample(**found)


@dataclass(slots=True)
class Report:
    """What an update tells: metrics of each member, and how far off each sample was."""

    metrics: dict[str, Tensor] = field(default_factory=dict)  # each (P,)
    error: Tensor | None = None  # (P, B), for the priorities of replay
