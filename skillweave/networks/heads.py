"""Action heads: the meaning of a policy network's outputs as parameters of a distribution."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Literal

import torch
from torch import Tensor

from skillweave.ops.device import BOOL, FLOAT, INT, Constant
from skillweave.ops.distributions import (
    categorical_kl,
    categorical_sample,
    categorical_stats,
    clamp_inward,
    gumbel,
    mask_logits,
    normal_kl,
    normal_stats,
    tanh_log_det,
    with_epsilon,
)
from skillweave.policies.core import Array
from skillweave.spaces import ActionCodec, ChoiceCodec, JointCodec
from skillweave.spaces.choices import chosen

LOG_STD = (-5.0, 2.0)
"""Range of a log deviation that depends on the state."""
WIDEST = 1.0
"""The deviation of bounded actions beyond which the entropy bonus becomes a cost; their range spans
[−1, 1]."""


class ActionHead:
    """The action distribution whose parameters (..., width) a network computes.

    For discrete actions they are logits; for a Box the mean, and perhaps the log deviation after
    it. Actions are (...) int64 for Discrete, (..., K) int64 for MultiDiscrete and MultiBinary,
    (..., A) float in policy units for a Box. A squashed Box action is stored before tanh, where its
    log-probability is exact; ``to_env`` applies tanh.

    Args:
        codec: the codec of the action space.
        std: "parameter": a Box's deviation is a parameter; "state": the network computes it.
        squash: apply tanh to a Box's actions.
    """

    def __init__(
        self,
        codec: ActionCodec,
        std: Literal["parameter", "state"] = "parameter",
        squash: bool = False,
    ) -> None:
        self.codec = codec
        self.squash = squash and not codec.discrete
        self.std_in_head = std == "state" and not codec.discrete
        self.width = codec.size * (2 if self.std_in_head else 1)
        widest = max(codec.parts, default=0)
        # The columns of each part's logits (K, widest): parts of different sizes are padded.
        rows = []
        start = 0
        for n in codec.parts:
            rows.append([start + min(i, n - 1) for i in range(widest)])
            start += n
        self._columns = Constant(torch.tensor(rows, **INT))
        exists = [[i < n for i in range(widest)] for n in codec.parts]
        self._exists = Constant(torch.tensor(exists, **BOOL))
        # The dimensions of a Box with two bounds, whose units therefore span [−1, 1].
        bounded = [] if codec.discrete else codec.span[2].tolist()
        self._narrows = any(bounded) and not self.squash
        self._bounded = Constant(torch.tensor(bounded, **BOOL))

    @property
    def discrete(self) -> bool:
        """Return whether actions are discrete."""
        return self.codec.discrete

    @property
    def noises(self) -> tuple[tuple[str, int], ...]:
        """Return the kinds and widths of the noise of ``act``, in its order."""
        return (("gumbel" if self.discrete else "standard_normal", self.codec.size),)

    def masked(
        self, dist_params: Tensor, mask: Tensor | None, epsilon: Tensor | None = None
    ) -> Tensor:
        """Return dist_params (..., width) without the choices that are not allowed.

        Args:
            dist_params: (..., width), a network's outputs.
            mask: (..., A) bool, allowed choices; None: all.
            epsilon: the least share of choices at random; None: 0.
        """
        if not self.discrete:
            return dist_params
        if epsilon is None:
            return mask_logits(dist_params, mask)
        return with_epsilon(dist_params, mask, epsilon)

    @property
    def log_std_size(self) -> int:
        """Return the numbers of a log deviation that is a parameter; 0: there is none."""
        return 0 if self.discrete or self.std_in_head else self.codec.size

    @property
    def std_columns(self) -> list[int]:
        """Return the outputs of the network that are log deviations."""
        return list(range(self.codec.size, self.width)) if self.std_in_head else []

    def noise(self, generators: Sequence[torch.Generator], steps: int, batch: int) -> Tensor:
        """Draw noise for calls of ``act``.

        Args:
            generators: one for each of P members.
            steps: the number of calls.
            batch: environments of each member.

        Returns:
            Normal or Gumbel noise, (S, P, B, A): steps, members, batch.
        """
        shape = (steps, batch, self.codec.size)
        if self.discrete:
            drawn = [gumbel(torch.rand(shape, generator=g, **FLOAT)) for g in generators]
        else:
            drawn = [torch.randn(shape, generator=g, **FLOAT) for g in generators]
        return torch.stack(drawn, dim=1)

    def act(self, dist_params: Tensor, log_std: Tensor | None, noise: Tensor | None) -> Tensor:
        """Return greedy or sampled actions of the distribution.

        Args:
            dist_params: (..., width), logits already masked.
            log_std: (..., A) or broadcast to it, the log deviation where it is a parameter; else
                None.
            noise: one step of ``noise``; None: act greedily.

        Returns:
            Actions, (...) for Discrete, else (..., K) or (..., A).
        """
        if not self.discrete:
            mean, log_std = self.moments(dist_params, log_std)
            return mean if noise is None else torch.addcmul(mean, log_std.exp(), noise)
        if self.codec.multi:
            dist_params = self._parts(dist_params)
            noise = None if noise is None else self._spread(noise)
        return dist_params.argmax(-1) if noise is None else categorical_sample(dist_params, noise)

    def stats(
        self, dist_params: Tensor, log_std: Tensor | None, mask: Tensor | None, action: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Compute log-probabilities of actions and the entropy of the distribution.

        Args:
            dist_params: (..., width), a network's outputs.
            log_std: (..., A) or broadcast to it, the log deviation where it is a parameter; else
                None.
            mask: (..., A) bool, allowed actions; None: all.
            action: (...) or (..., A), the actions.

        Returns:
            Log-probability and entropy in nats, each (...).
        """
        if self.discrete:
            dist_params = mask_logits(dist_params, mask)
            if not self.codec.multi:
                return categorical_stats(dist_params, action)
            log_prob, entropy = categorical_stats(self._parts(dist_params), action)
            return log_prob.sum(-1), entropy.sum(-1)
        mean, log_std = self.moments(dist_params, log_std)
        log_prob, entropy = normal_stats(mean, log_std, action)
        if self.squash:
            log_prob = log_prob - tanh_log_det(action).sum(-1)
            # No closed form: estimated with one sample, the action, as a function of mean and std.
            z = ((action - mean) * (-log_std).exp()).detach()
            entropy = entropy + tanh_log_det(mean + log_std.exp() * z).sum(-1)
        return log_prob, entropy

    def surplus(self, dist_params: Tensor, log_std: Tensor | None) -> Tensor | None:
        """Compute the cost of too much entropy, in nats, (...); None: no cost.

        A normal's entropy grows with its deviation without limit. Where rewards are rare, a bonus
        for it would widen the deviation forever, until the mean has no effect. Bounded actions are
        clipped to their range: with a deviation of 1 (``WIDEST``) a third of them, with 2 two
        thirds. So a wider normal explores no more, and each nat beyond is a cost.

        Args:
            dist_params: (..., width), a network's outputs.
            log_std: (..., A) or broadcast to it, the log deviation where it is a parameter; else
                None.
        """
        if not self._narrows:
            return None
        mean, log_std = self.moments(dist_params, log_std)
        beyond = (log_std - math.log(WIDEST)).clamp_min(0.0).expand_as(mean)
        return 2.0 * (beyond * self._bounded.on(beyond.device)).sum(-1)

    def kl(
        self,
        dist_params: Tensor,
        log_std: Tensor | None,
        other: Tensor,
        other_log_std: Tensor | None,
        mask: Tensor | None,
    ) -> Tensor:
        """Compute KL(p ‖ q) before any squashing, p of ``dist_params`` and q of ``other``.

        Args:
            dist_params: (..., width) of p.
            log_std: (..., A) or broadcast to it, the log deviation where it is a parameter; else
                None.
            other: dist_params (..., width) of q.
            other_log_std: ``log_std`` of q.
            mask: (..., A) bool, allowed actions; None: all.

        Returns:
            The divergence in nats, (...).
        """
        if not self.discrete:
            return normal_kl(
                *self.moments(dist_params, log_std), *self.moments(other, other_log_std)
            )
        dist_params, other = mask_logits(dist_params, mask), mask_logits(other, mask)
        if not self.codec.multi:
            return categorical_kl(dist_params, other)
        return categorical_kl(self._parts(dist_params), self._parts(other)).sum(-1)

    def with_log_prob(self, action: Tensor, log_prob: Tensor, log_std: Tensor | None) -> Tensor:
        """Return dist_params under which actions have exactly these log-probabilities (...).

        For a caller with actions and their probabilities, but without the distribution; for
        Discrete and Box.

        Args:
            action: (...) int64 or (..., A).
            log_prob: (...), in nats.
            log_std: (..., A) or broadcast to it, of a Box; else None.
        """
        if self.discrete:
            rest = torch.log1p(-log_prob.exp().clamp(max=1.0 - 1e-6))
            rest = rest - math.log(max(1, self.codec.size - 1))
            dist_params = rest[..., None].expand(*rest.shape, self.codec.size)
            return dist_params.scatter(-1, action[..., None], log_prob[..., None])
        assert log_std is not None
        peak, _ = normal_stats(action, log_std.expand_as(action), action)
        away = (2.0 * (peak - log_prob)).clamp(min=0.0) / self.codec.size
        return action - away.sqrt()[..., None] * log_std.exp()

    def moments(self, dist_params: Tensor, log_std: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return mean and log deviation of a Box's normal, each (..., A) or broadcast to it.

        Args:
            dist_params: (..., width), a network's outputs.
            log_std: (..., A) or broadcast to it, the log deviation where it is a parameter; else
                None.
        """
        if not self.std_in_head:
            assert log_std is not None
            return dist_params, log_std
        mean, raw = dist_params.chunk(2, dim=-1)
        return mean, clamp_inward(raw, *LOG_STD)

    def to_env(self, action: Array) -> Array:
        """Convert an ``action`` (n, …) from policy units to the environment's."""
        return self.codec.to_env(torch.from_numpy(action).tanh().numpy() if self.squash else action)

    def _parts(self, logits: Tensor) -> Tensor:
        """Spread logits (..., ΣN) to (..., K, widest); padding has the smallest number."""
        return mask_logits(self._spread(logits), self._exists.on(logits.device))

    def _spread(self, x: Tensor) -> Tensor:
        """Spread (..., ΣN) to (..., K, widest), the last entry of short parts repeated."""
        return x[..., self._columns.on(x.device)]


class JointHead:
    """The distribution of actions with several parts, which are independent of each other.

    A network computes the parameters of each part, one after another. log π is the sum over the
    parts, and so is the entropy. Its methods are those of ``ActionHead``; actions are (..., W)
    float in policy units.

    Args:
        codec: the codec of the actions.
        std: "parameter": deviations are parameters; "state": the network computes them.
        squash: apply tanh to parts of a Box.
    """

    discrete = False
    std_in_head = False

    def __init__(
        self,
        codec: JointCodec,
        std: Literal["parameter", "state"] = "parameter",
        squash: bool = False,
    ) -> None:
        self.codec = codec
        self.heads: tuple[ActionHead | JointHead, ...] = tuple(
            head_of(part, std, squash) for _, part in codec.members
        )
        self.width: int = sum(head.width for head in self.heads)
        self.log_std_size: int = sum(head.log_std_size for head in self.heads)
        self.squash: bool = any(head.squash for head in self.heads)
        starts = [sum(h.width for h in self.heads[:i]) for i in range(len(self.heads))]
        self.std_columns: list[int] = [
            first + column
            for first, head in zip(starts, self.heads, strict=True)
            for column in head.std_columns
        ]

    @property
    def noises(self) -> tuple[tuple[str, int], ...]:
        """Return the kinds and widths of the noise of ``act``; see ``ActionHead``."""
        return tuple(one for head in self.heads for one in head.noises)

    def noise(self, generators: Sequence[torch.Generator], steps: int, batch: int) -> Tensor:
        """Draw noise for calls of ``act``; see ``ActionHead``."""
        return torch.cat([head.noise(generators, steps, batch) for head in self.heads], dim=-1)

    def masked(
        self, dist_params: Tensor, mask: Tensor | None, epsilon: Tensor | None = None
    ) -> Tensor:
        """Return dist_params (..., width) without the choices that are not allowed."""
        if mask is None:
            return dist_params
        widths = [head.width for head in self.heads]
        found = zip(self.heads, dist_params.split(widths, dim=-1), self._masks(mask), strict=True)
        return torch.cat([head.masked(params, allowed) for head, params, allowed in found], dim=-1)

    def _masks(self, mask: Tensor | None) -> list[Tensor | None]:
        """Return the part of a mask (..., A) that each part of an action has."""
        if mask is None:
            return [None] * len(self.heads)
        return [
            mask[..., columns] if head.codec.counts else None
            for head, columns in zip(self.heads, self.codec.mask_columns, strict=True)
        ]

    def act(self, dist_params: Tensor, log_std: Tensor | None, noise: Tensor | None) -> Tensor:
        """Return greedy or sampled actions, (..., W)."""
        drawn: Sequence[Tensor | None] = [None] * len(self.heads)
        if noise is not None:
            widths = [sum(size for _, size in head.noises) for head in self.heads]
            drawn = noise.split(widths, dim=-1)
        parts = []
        for (head, params, std), one in zip(self._split(dist_params, log_std), drawn, strict=True):
            action = head.act(params, std, one)
            action = action if not head.discrete or head.codec.multi else action[..., None]
            parts.append(action.to(dist_params.dtype))
        return torch.cat(parts, dim=-1)

    def stats(
        self, dist_params: Tensor, log_std: Tensor | None, mask: Tensor | None, action: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Compute log-probabilities of actions and the entropy; see ``ActionHead``."""
        log_prob = entropy = torch.zeros_like(dist_params[..., 0])
        masks = self._masks(mask)
        for i, (head, params, std) in enumerate(self._split(dist_params, log_std)):
            one, spread = head.stats(params, std, masks[i], self.codec.units(action, i))
            log_prob, entropy = log_prob + one, entropy + spread
        return log_prob, entropy

    def surplus(self, dist_params: Tensor, log_std: Tensor | None) -> Tensor | None:
        """Compute the cost of too much entropy; see ``ActionHead``."""
        found = [
            head.surplus(params, std) for head, params, std in self._split(dist_params, log_std)
        ]
        costs = [cost for cost in found if cost is not None]
        return sum(costs[1:], costs[0]) if costs else None

    def kl(
        self,
        dist_params: Tensor,
        log_std: Tensor | None,
        other: Tensor,
        other_log_std: Tensor | None,
        mask: Tensor | None,
    ) -> Tensor:
        """Compute KL(p ‖ q), the sum over the parts; see ``ActionHead``."""
        pairs = zip(
            self._split(dist_params, log_std),
            self._split(other, other_log_std),
            self._masks(mask),
            strict=True,
        )
        total = torch.zeros_like(dist_params[..., 0])
        for (head, params, std), (_, theirs, their_std), allowed in pairs:
            total = total + head.kl(params, std, theirs, their_std, allowed)
        return total

    def to_env(self, action: Array) -> Array:
        """Convert an ``action`` (n, W) from policy units to the environment's (n,)."""
        return self.codec.to_env(self.squashed(action) if self.squash else action)

    def squashed(self, action: Array) -> Array:
        """Return actions (n, W) with tanh applied to the parts that need it."""
        action = action.copy()
        for head, columns in zip(self.heads, self.codec.columns, strict=True):
            part = action[:, columns]
            if isinstance(head, JointHead):
                action[:, columns] = head.squashed(part)
            elif head.squash:
                action[:, columns] = torch.from_numpy(part).tanh().numpy()
        return action

    def _split(
        self, dist_params: Tensor, log_std: Tensor | None
    ) -> list[tuple[ActionHead | JointHead, Tensor, Tensor | None]]:
        """Return the head, parameters and log deviation of each part."""
        found = []
        start = 0
        first = 0
        for head in self.heads:
            params = dist_params[..., start : start + head.width]
            std = None
            if head.log_std_size:
                assert log_std is not None
                std = log_std[..., first : first + head.log_std_size]
            found.append((head, params, std))
            start, first = start + head.width, first + head.log_std_size
        return found


class ChoiceHead(JointHead):
    """The distribution of a skill and its goal: log π(k, g) = log π(k) + log π(g | k).

    A network computes the logits of the choices, then the parameters of each skill's goal. The
    goals of skills that are not chosen are drawn, but count for nothing; of the entropy that of the
    chosen skill's goal counts. Actions are the number of the choice, then all goals.

    Args:
        codec: the codec of the choices.
        std: as of ``JointHead``.
        squash: apply tanh to goals of a Box.
    """

    codec: ChoiceCodec

    def __init__(
        self,
        codec: ChoiceCodec,
        std: Literal["parameter", "state"] = "parameter",
        squash: bool = False,
    ) -> None:
        super().__init__(codec, std, squash)
        self.choices = codec.choices

    def masked(
        self, dist_params: Tensor, mask: Tensor | None, epsilon: Tensor | None = None
    ) -> Tensor:
        """Return dist_params (..., width) without the skills that may not start."""
        logits, goals = dist_params[..., : self.choices], dist_params[..., self.choices :]
        return torch.cat([self.heads[0].masked(logits, mask, epsilon), goals], dim=-1)

    def stats(
        self, dist_params: Tensor, log_std: Tensor | None, mask: Tensor | None, action: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Compute log-probabilities of choices and the entropy; see ``ActionHead``."""
        choice, logits, _ = self._split(dist_params, log_std)[0]
        log_prob, entropy = choice.stats(logits, None, mask, self.codec.units(action, 0))
        for one, spread in self._of_goals(dist_params, log_std, action):
            log_prob, entropy = log_prob + one, entropy + spread
        return log_prob, entropy

    def of_goals(self, dist_params: Tensor, log_std: Tensor | None, action: Tensor) -> Tensor:
        """Compute log π(g | k) of choices (…, W), (…); 0 where the chosen skill has no goals."""
        log_prob = torch.zeros_like(dist_params[..., 0])
        for one, _ in self._of_goals(dist_params, log_std, action):
            log_prob = log_prob + one
        return log_prob

    def _of_goals(
        self, dist_params: Tensor, log_std: Tensor | None, action: Tensor
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield ``stats`` of each skill's goals, (…), 0 where another skill is chosen."""
        for i, (head, params, std) in enumerate(self._split(dist_params, log_std)[1:]):
            found = head.stats(params, std, None, self.codec.units(action, 1 + i))
            counts = chosen(action[..., 0], self.codec.owners[i])
            log_prob, entropy = (torch.where(counts, x, 0.0) for x in found)
            yield log_prob, entropy

    def kl(
        self,
        dist_params: Tensor,
        log_std: Tensor | None,
        other: Tensor,
        other_log_std: Tensor | None,
        mask: Tensor | None,
    ) -> Tensor:
        """Compute KL(p ‖ q): of the skill, and of each goal as often as its skill is chosen.

        A guide is q by its choices alone: ``other`` (..., choices) has no goals.
        """
        (choice, logits, _), *goals = self._split(dist_params, log_std)
        of_choices = choice.kl(logits, None, other[..., : self.choices], None, mask)
        if other.shape[-1] == self.choices:
            return of_choices
        share = mask_logits(logits, mask).softmax(-1)
        total = of_choices
        for owner, mine, theirs in zip(
            self.codec.owners, goals, self._split(other, other_log_std)[1:], strict=True
        ):
            head, params, std = mine
            divergence = head.kl(params, std, theirs[1], theirs[2], None)
            total = total + share[..., owner[0] : owner[1]].sum(-1) * divergence
        return total


def head_of(
    codec: ActionCodec, std: Literal["parameter", "state"] = "parameter", squash: bool = False
) -> ActionHead | JointHead:
    """Return the head of an action space, or of a selector's choices with goals."""
    if isinstance(codec, ChoiceCodec):
        return ChoiceHead(codec, std, squash)
    if isinstance(codec, JointCodec):
        return JointHead(codec, std, squash)
    return ActionHead(codec, std, squash)
