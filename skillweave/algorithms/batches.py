"""Experience: the columns that pass from acting to learning, and the batches that algorithms get.

``SCHEMA`` is the only list of columns. Collectors fill a ``Batch`` of NumPy arrays; a store turns
it into a ``Rollout`` or a ``Sample`` of tensors on the learner's device.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from skillweave._internal.paths import name_of
from skillweave.policies.core import Array

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Column:
    """Description of a column: how batches of it are joined, and which stores carry it."""

    fill: Any = 0
    """The value of rows that are not valid, and of environments without this column."""
    per_env: bool = False
    """One value for each environment, (N, …), not one for each row."""
    ragged: bool = False
    """The last axis is as long as the longest row needs; zeros follow shorter ones."""
    rollout: bool = True
    """``Rollout`` has it."""
    raw: bool = False
    """It is the same for every learner; recorded only where a learner needs it."""


_RAW = Column(raw=True, rollout=False)
SCHEMA: dict[str, Column] = {
    # Lead axes (T, N): T rows, in the order of time, of N environments.
    "obs": Column(),  # (T, N, *obs_shape)
    "action": Column(),  # (T, N) int64, or (T, N, A) float32 in policy units
    "reward": Column(),  # (T, N) float32, the learner's own; of a call Σ γᵏ rₖ
    "steps": Column(fill=1),  # (T, N) int64, environment steps: 1, or τ of a call
    "terminated": Column(),  # (T, N) bool, the value of what follows is 0
    "truncated": Column(),  # (T, N) bool, cut here, but the value continues; never where terminated
    "next_obs": Column(),  # (T, N, *obs_shape), the true successors
    "valid": Column(fill=True),  # (T, N) bool, rows of this learner; absent: all
    "mask": Column(fill=True),  # (T, N, A) bool, allowed actions in ``obs``; absent: all
    "next_mask": Column(fill=True, rollout=False),  # (T, N, A) bool, in ``next_obs``
    "dist_params": Column(),  # (T, N, H) float32, the distribution that ``action`` is from
    "recurrent_state": Column(per_env=True),  # (N, M) float32, before each first valid row
    "episode_start": Column(),  # (T, N) bool, the recurrent state is empty before this row
    "rewards": Column(ragged=True, rollout=False),  # (T, N, L) float32, of each step of a call
    "advantage": Column(),  # (T, N) float32, added to the learner's own advantage
    "guide": Column(),  # (T, N, A) float32, logits of a ready selector's choice
    "overridden": Column(),  # (T, N) bool, a reflex acted instead of ``action``
    "call_start": Column(),  # (T, N) bool, a call starts here; for critics of skills
    # As the environment itself gave them; skills are judged by these:
    "env_reward": Column(raw=True),  # (T, N) float32, the environment's own
    "env_action": _RAW,  # (T, N, …), in the environment's units
    "env_terminated": _RAW,  # (T, N) bool, the environment's own end
    "env_truncated": _RAW,  # (T, N) bool, the environment's own limit
    "call_elapsed": _RAW,  # (T, N) int64, steps of the call so far
    "own": _RAW,  # (T, N) bool, rows that the learner made itself, not others of its hierarchy
    # In a trace alone. Under the path of a level (``inner/skill``), of its steps:
    "elapsed": _RAW,  # (T, N) int64, steps so far of the episode, or
    # of the call of a skill that learns apart
    "end": _RAW,  # (T, N) int8, ``CallEnd`` of these
    "skill": _RAW,  # (T, N) int64, the skill that acts
    "goal": _RAW,  # (T, N, *goal_shape), under the path of a skill
    "call_end": _RAW,  # (T, N) int8, ``CallEnd`` after the step
    "call_length": _RAW,  # (T, N) int64, the length that was chosen
    "call_succeeded": _RAW,  # (T, N) bool, where calls ended
    "chances": _RAW,  # (T, N, A) float32, of the guide's latest choice
    "guide_allows": _RAW,  # (T, N, A) bool, of next choices
    # Under the path of a learner (``inner/selector/decided``), where it decided:
    "decided": _RAW,  # (T, N) bool, here
    "allowed": _RAW,  # (T, N, A) bool, among which choices
    "state_before": _RAW,  # (T, N, M) float32, its recurrent state
}
"""All columns, by name. A row is a step of an environment, or a decision with its whole call."""
OF_STEP = {
    "obs": "obs",
    "env_action": "action",
    "next_obs": "next_obs",
    "env_reward": "reward",
    "env_terminated": "terminated",
    "env_truncated": "truncated",
}
"""By a column of a trace, the field of a ``Step``."""
INFO = "info."
"""Prefix of the names of columns of ``info``: ``info.key``. They are recorded like raw columns."""


def number_type(kind: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type in which numbers of ``info`` of a type are stored: torch has it."""
    if kind.kind == "b" or kind == np.float32:
        return kind
    return np.dtype(np.float64 if kind.kind == "f" else np.int64)


def column(name: str) -> Column:
    """Return a column of ``SCHEMA``, perhaps under a path; or the column of a key of ``info``."""
    if name.startswith(INFO):
        return _RAW
    return SCHEMA.get(name) or SCHEMA[name_of(name)]


class Batch(Mapping[str, Array]):
    """Columns of ``SCHEMA`` with the same lead axes (T, N): the rows of one learner.

    N = P·B: the environments of member 0 come first, then those of member 1, and so on. Where a
    valid row neither terminated nor was truncated, the next valid row of its environment, here or
    in the next batch, starts where this one ended.
    """

    __slots__ = ("_columns",)

    def __init__(self, **columns: Array | None) -> None:
        """Take the columns that are not None."""
        if not columns.keys() <= SCHEMA.keys():
            names = (name_of(k) for k in columns if not k.startswith(INFO))
            unknown = [name for name in names if name not in SCHEMA]
            assert not unknown, f"no column of SCHEMA: {unknown}"
        self._columns = {name: x for name, x in columns.items() if x is not None}

    def __getitem__(self, name: str) -> Array:
        return self._columns[name]

    def get(self, name: str, default: Any = None) -> Any:
        """Return a column, or the default; many times as fast as that of ``Mapping``."""
        return self._columns.get(name, default)

    def __contains__(self, name: object) -> bool:
        return name in self._columns

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    @property
    def lead(self) -> tuple[int, int]:
        """T and N."""
        rows, envs = self._columns["reward"].shape
        return rows, envs

    @property
    def ended(self) -> Array:
        """Rows (T, N) bool that end the trajectory, by termination or truncation."""
        ended: Array = self["terminated"] | self["truncated"]
        return ended

    @property
    def valid_rows(self) -> Array:
        """Rows (T, N) bool of this learner."""
        valid = self.get("valid")
        return np.ones(self.lead, bool) if valid is None else valid

    @property
    def own_rows(self) -> Array:
        """Rows (T, N) bool that this learner made itself, and not others of its hierarchy."""
        own = self.get("own")
        return self.valid_rows if own is None else self.valid_rows & own

    def replace(self, **columns: Array | None) -> Batch:
        """Return a batch with other values of some columns; None removes one."""
        return Batch(**(self._columns | columns))

    def rows(self, part: slice) -> Batch:
        """Return a slice of the T rows."""
        whole = {k: v if column(k).per_env else v[part] for k, v in self.items()}
        return Batch(**whole)


class Trace(Batch):
    """Record of T steps of N environments, from which every learner gets its rows.

    Its columns are raw: what the environments did, who acted, and why calls ended. The columns of
    a level have its path before their name, those of a learner the learner's.
    """

    __slots__ = ("infos",)

    def __init__(self, infos: Sequence[Mapping[str, Any]], columns: Mapping[str, Array]) -> None:
        """Take the columns, and the ``info`` of each step; no infos: nothing reads them."""
        super().__init__(**columns)
        self.infos = infos

    @property
    def lead(self) -> tuple[int, int]:
        """T and N."""
        rows, envs = self["next_obs"].shape[:2]
        return rows, envs

    @property
    def ended(self) -> Array:
        """Rows (T, N) bool that end an episode, or the call of a skill that learns apart."""
        ended: Array = self["end"] != 0
        return ended

    def rows(self, part: slice) -> Trace:
        """Return a slice of the T steps."""
        return Trace(self.infos[part], {k: v[part] for k, v in self.items()})


def side_by_side(batches: Sequence[Batch], members: int) -> Batch:
    """Join batches of several collectors: the environments of each member stand side by side."""
    if len(batches) == 1:
        return batches[0]
    height = max(batch.lead[0] for batch in batches)
    batches = [_as_high(batch, height) for batch in batches]
    names = {name: None for batch in batches for name in batch}
    return Batch(**{name: _joined([b.get(name) for b in batches], members, name) for name in names})


def _as_high(batch: Batch, height: int) -> Batch:
    """Add rows that are not valid to a batch until there are ``height``."""
    rows, envs = batch.lead
    if rows == height:
        return batch
    valid = np.concatenate([batch.valid_rows, np.zeros((height - rows, envs), bool)])
    whole = {k: v if column(k).per_env else _padded(v, height - rows) for k, v in batch.items()}
    return Batch(**(whole | {"valid": valid}))


def _padded(x: Array, more: int) -> Array:
    return np.concatenate([x, np.zeros((more, *x.shape[1:]), x.dtype)])


def _joined(parts: list[Array | None], members: int, name: str) -> Array:
    """Return one column of a batch, joined of the same column of several batches."""
    described = column(name)
    axis = 0 if described.per_env else 1
    example = next(part for part in parts if part is not None)
    filled = [np.full_like(example, described.fill) if p is None else p for p in parts]
    if described.ragged:
        filled = padded_last_axis(filled)
    split = [x.reshape(*x.shape[:axis], members, -1, *x.shape[axis + 1 :]) for x in filled]
    whole = np.concatenate(split, axis + 1)
    return whole.reshape(*whole.shape[:axis], -1, *whole.shape[axis + 2 :])


def padded_last_axis(parts: Sequence[Array]) -> list[Array]:
    """Return a column's arrays with last axes as long as the longest; zeros are added."""
    longest = max(part.shape[-1] for part in parts)
    before = [(0, 0)] * (parts[0].ndim - 1)
    return [
        p if p.shape[-1] == longest else np.pad(p, [*before, (0, longest - p.shape[-1])])
        for p in parts
    ]


@dataclass(slots=True)
class Rollout:
    """Trajectories for an on-policy learner: P members, T rows of B columns each.

    ``discount`` is 0 where the trajectory terminated, else γ^τ; ``last`` is True where it is cut
    (terminated, truncated, or the rollout's end). The ``valid`` rows of a column come first; the
    others repeat valid ones.
    """

    obs: Tensor  # (P, T, B, *obs_shape)
    action: Tensor  # (P, T, B) int64 or (P, T, B, A) float32
    reward: Tensor  # (P, T, B)
    discount: Tensor  # (P, T, B)
    next_obs: Tensor  # (P, T, B, *obs_shape), the true successors
    last: Tensor  # (P, T, B) bool; False where not valid
    mask: Tensor | None = None  # (P, T, B, A) bool, allowed actions; None: all
    valid: Tensor | None = None  # (P, T, B) bool; None: all
    dist_params: Tensor | None = None  # (P, T, B, H), the distribution that ``action`` is from
    log_std: Tensor | None = None
    """The policy's log standard deviation, where ``dist_params`` does not contain it: (P, 1, 1, A),
    or (P, 1, B, A), by column."""
    recurrent_state: Tensor | None = None  # (P, B, M), before the first row
    episode_start: Tensor | None = None  # (P, T, B) bool, the recurrent state is empty before
    advantage: Tensor | None = None  # (P, T, B), added to the learner's own advantage
    guide: Tensor | None = None  # (P, T, B, A), logits of a ready selector's choice
    overridden: Tensor | None = None  # (P, T, B) bool, a reflex acted instead; None: nowhere
    call_start: Tensor | None = None  # (P, T, B) bool, a call starts here; for critics of skills
    env_reward: Tensor | None = None  # (P, T, B), the environment's own, where it is needed
    reference: Reference | None = None  # the policy that the learner stays near
    rehearsal: Rehearsal | None = None  # observations in which it keeps what it did
    keeps_scaling: bool = False  # observations stay scaled as for the policy that was given
    critic_alone: bool = False  # the policy stays as it is, while its critic learns
    progress: float = 0.0  # share of the budget that is spent, for schedules


@dataclass(slots=True)
class Reference:
    """The reference policy that a learner stays near."""

    params: Any | None  # ``ActingParams`` of P members; None: ``Rollout.guide`` is its choice
    coef: Tensor  # (P,), the cost of one nat of KL from it
    target_kl: float = 0.0  # the KL from it that the cost is adapted to


@dataclass(slots=True)
class Rehearsal:
    """K observations, not of the rollout, in which a learner keeps what an earlier policy did."""

    obs: Tensor  # (P, K, *obs_shape)
    dist_params: Tensor  # (P, K, H), of the earlier policy there, without a mask
    log_std: Tensor | None  # (P, 1, A), of the earlier policy; None: no parameter of its own


@dataclass(slots=True)
class Sample:
    """A batch from replay: P members, B transitions of up to n rows each.

    ``reward`` is the discounted sum over the n rows, ``discount`` the factor of the value of
    ``next_obs`` after them: 0 where the episode terminated, else γ^Στ.
    """

    obs: Tensor  # (P, B, *obs_shape)
    action: Tensor  # (P, B) int64 or (P, B, A)
    reward: Tensor  # (P, B) float32
    discount: Tensor  # (P, B) float32
    next_obs: Tensor  # (P, B, *obs_shape), the true successors
    mask: Tensor | None  # (P, B, A) bool, allowed actions in ``obs``; None: all
    next_mask: Tensor | None  # (P, B, A) bool, allowed actions in ``next_obs``; None: all
    weight: Tensor | None  # (P, B) float32, importance weights; None where drawn uniformly
    index: Array  # (P, B) int64, which transitions these are, to give them new priorities
    # Where an algorithm needs them, the n − 1 observations between ``obs`` and ``next_obs``:
    between_obs: Tensor | None = None  # (P, B, n − 1, *obs_shape)
    between_mask: Tensor | None = None  # (P, B, n − 1, A) bool, allowed actions; None: all
    between_discount: Tensor | None = None
    """(P, B, n − 1), the factor of a reward there: γ^Στ, or 0 where the rows ended before."""
    env_reward: Tensor | None = None
    """(P, B) the environment's own in the first row, where it is needed."""
    critic_alone: bool = False  # the policy stays as it is, while its critics learn
    progress: float = 0.0  # share of the budget that is spent, for schedules

    def split(self, batch: int) -> Iterator[Sample]:
        """Yield samples of ``batch`` transitions of each member, one after another."""
        size = self.reward.shape[1]
        whole: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        for start in range(0, size, batch):
            rows = slice(start, start + batch)
            part: dict[str, Any] = {
                k: v if v is None or isinstance(v, float | bool) else v[:, rows]
                for k, v in whole.items()
            }
            yield Sample(**part)


@dataclass(frozen=True)
class RawRows:
    """Rows (k, …) as the environment gave them, without a reward of a learner."""

    obs: Array
    next_obs: Array
    columns: Mapping[str, Array]
    """Raw columns, by name."""


@dataclass(slots=True)
class Report:
    """The result of an update: metrics of each member, and the error of each sample."""

    metrics: dict[str, Tensor] = field(default_factory=dict)  # each (P,)
    error: Tensor | None = None  # (P, B), for the priorities of replay
