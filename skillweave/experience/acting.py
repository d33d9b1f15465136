"""Learners as they act: members of stacks, side by side in N environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.base import ActingParams, Algorithm
from skillweave.policies.core import Array
from skillweave.spaces import to_tensor


@dataclass(frozen=True)
class ActionRepeat:
    """Repetition of one random action over several steps in an environment (εz-greedy).

    Time is cut into spans of ``longest`` rows. In each, every environment has a chance of a
    repetition, which is as long as the span or shorter, and lies somewhere in it. The place of each
    follows from ``seeds`` and the row, so nothing needs to be kept between requests.
    """

    at: int  # the request's first row, counted from the start of the stage or generation
    chance: float  # of a repetition in a span
    longest: int  # rows
    seeds: Seeds  # the same for all requests of a stage or generation


@dataclass(frozen=True)
class Request:
    """A request to collectors: the number of rows, and the parameters to act by.

    Everything that is random while they are collected follows from ``seeds``.
    """

    rows: int  # T, environment steps of each environment
    params: tuple[ActingParams, ...]  # of each stack
    gamma: Array  # (P,), the discount of one step, of each member
    seeds: Seeds
    at_random: bool = False  # act at random instead
    greedy: bool = False  # do not explore
    below: Mapping[str, Request] = field(default_factory=dict)
    """By path, the requests to those that learn below a selector."""
    action_repeat: ActionRepeat | None = None  # None: there are none
    record: tuple[str, ...] = ()  # raw columns to record

    def of_collector(self, number: int) -> Request:
        """Return the request to one of several collectors."""
        below = {path: part.of_collector(number) for path, part in self.below.items()}
        action_repeat = self.action_repeat and replace(
            self.action_repeat, seeds=self.action_repeat.seeds / number
        )
        return replace(self, seeds=self.seeds / number, below=below, action_repeat=action_repeat)


@dataclass
class Acted:
    """Actions in n environments, and what a learner stores with them."""

    action: Array  # (n, …) in policy units
    dist_params: Array | None  # (n, H), of learners from rollouts
    recurrent_state: Array | None  # (n, M) afterwards, of recurrent networks


@dataclass(frozen=True)
class _Span:
    """The repetitions of N environments in some rows, and the actions that they repeat."""

    key: tuple[Seeds, int]
    chance: Array  # (N,), a repetition takes place where it is below the request's
    first: Array  # (N,), its first row, counted from that of the span
    after: Array  # (N,), the row after the last one
    action: Array  # (N, …) in policy units


class Acting:
    """Acting learners: P members in N = P·B environments; member 0 in the first B, and so on.

    Args:
        stacks: each an algorithm and its number of members.
    """

    def __init__(self, stacks: Sequence[tuple[Algorithm, int]], num_envs: int) -> None:
        self.stacks = tuple(stacks)
        self.members = sum(count for _, count in stacks)
        self.each = num_envs // self.members  # B
        first = stacks[0][0]
        self.to_env, self.memory_size = first.to_env, first.memory_size
        self.widened = first.widened
        self.keeps_head = first.store == "rollout"
        self.row = 0
        """The request's row that is collected."""
        self._span: _Span | None = None

    def begin(self, request: Request, every_step: bool = True) -> None:
        """Load the parameters of a request, by which the members act from now on.

        Args:
            every_step: all act in each of its steps, so what they need of chance is drawn at once.
        """
        self._request = request
        self.row = 0
        self._every = every_step
        self._noises: list[Any] = []
        self._generators = [[s.torch() for s in self._seeds(i)] for i in range(len(self.stacks))]
        if every_step and not (request.at_random or request.greedy):
            self._noises = [
                algorithm.noise(generators, request.rows, self.each)
                for (algorithm, _), generators in zip(self.stacks, self._generators, strict=True)
            ]

    def _hold_actions(
        self, action: Array, action_repeat: ActionRepeat, row: int, mask: Array | None
    ) -> None:
        """Replace the actions (N, …) of environments that repeat a random one, in place."""
        span, place = divmod(row, action_repeat.longest)
        if self._span is None or self._span.key != (action_repeat.seeds, span):
            self._span = self._drawn(action_repeat, span)
        drawn = self._span
        now = (drawn.chance < action_repeat.chance) & (drawn.first <= place) & (place < drawn.after)
        if mask is not None:
            now &= mask[np.arange(len(mask)), drawn.action]
        action[now] = drawn.action[now]

    def _drawn(self, action_repeat: ActionRepeat, span: int) -> _Span:
        """Return the repetitions of a span of rows."""
        times: list[Array] = []  # of each member: chances, first rows, rows after the last one
        actions: list[Array] = []
        for algorithm, count in self.stacks:
            first = len(times)
            seeds = [action_repeat.seeds / span / "act" / (first + i) for i in range(count)]
            for rng in (node.numpy() for node in seeds):
                chance = rng.random(self.each)
                length = rng.integers(1, action_repeat.longest + 1, self.each)
                begins = rng.integers(0, action_repeat.longest - length + 1)
                times.append(np.stack([chance, begins, begins + length]))
            off_policy: Any = algorithm
            drawn = off_policy.random_actions([node.torch() for node in seeds], self.each, None)
            actions.append(_rows(drawn))
        chances, first_rows, after = np.concatenate(times, axis=1)
        return _Span(
            (action_repeat.seeds, span), chances, first_rows, after, np.concatenate(actions)
        )

    @torch.inference_mode()
    def some(self, rows: Array, obs: Array, mask: Array | None, memory: Array | None) -> Acted:
        """Return the members' actions in environments ``rows`` (n,); all arguments are of these."""
        if self.members == 1 and not self._every:
            return self._act(lambda stack: self._draw(stack, len(obs)), obs, mask, memory)

        def noise(stack: int) -> Any:
            return self._noises[stack][self.row] if self._every else self._draw(stack, self.each)

        # Networks of several members take equally many rows of each, so all act, and some count.
        n = self.each * self.members
        if len(rows) < n:
            obs, mask, memory = (_spread(x, rows, n) for x in (obs, mask, memory))
        acted = self._act(noise, obs, mask, memory)
        request = self._request
        repeat = request.action_repeat
        if self._every and repeat is not None and not (request.at_random or request.greedy):
            self._hold_actions(acted.action, repeat, repeat.at + self.row, mask)
        if len(rows) == n:
            return acted
        head, after = acted.dist_params, acted.recurrent_state
        return Acted(
            acted.action[rows],
            None if head is None else head[rows],
            None if after is None else after[rows],
        )

    def _draw(self, stack: int, each: int) -> Any:
        return self.stacks[stack][0].noise(self._generators[stack], 1, each)[0]

    def _act(self, noise: Any, obs: Array, mask: Array | None, memory: Array | None) -> Acted:
        """Return the actions of all members, stack by stack, in as many rows of each member."""
        found = []
        first = 0
        each = len(obs) // self.members
        for stack, (_, count) in enumerate(self.stacks):
            part = slice(first * each, (first + count) * each)
            found.append(self._stack(stack, noise, *(_part(x, part) for x in (obs, mask, memory))))
            first += count
        if len(found) == 1:
            return found[0]
        return Acted(
            np.concatenate([f.action for f in found]),
            _joined([f.dist_params for f in found]),
            _joined([f.recurrent_state for f in found]),
        )

    def _stack(
        self, stack: int, noise: Any, obs: Any, mask: Array | None, memory: Array | None
    ) -> Acted:
        """Return the actions of one stack's members, by its algorithm."""
        algorithm, count = self.stacks[stack]
        allowed = None if mask is None else by_member(mask, count)
        if self._request.at_random:
            generators = self._generators[stack]
            drawn: Any = algorithm
            action = drawn.random_actions(generators, len(obs) // count, allowed)
            return Acted(action.flatten(0, 1).numpy(), None, None)
        before = None if memory is None else by_member(memory, count)
        params = self._request.params[stack]
        chance = None if self._request.greedy else noise(stack)
        action, head, after = algorithm.act(params, by_member(obs, count), allowed, chance, before)
        # A member that has diverged must not spoil what all learn from.
        if not self.keeps_head:
            action = action.nan_to_num()
            head = None
        return Acted(_rows(action), _rows_or_none(head), _rows_or_none(after))

    def _seeds(self, stack: int) -> list[Seeds]:
        first = sum(count for _, count in self.stacks[:stack])
        count = self.stacks[stack][1]
        return [self._request.seeds / "act" / (first + member) for member in range(count)]


def by_member(rows: Array, members: int) -> Tensor:
    """Split rows of environments by member: (P·B, …) to (P, B, …), member 0's first."""
    tensor = to_tensor(rows)
    return tensor.view(members, -1, *tensor.shape[1:])


def _rows(x: Tensor) -> Array:
    """Join rows of members to rows of environments: (P, B, …) to (P·B, …)."""
    rows: Array = x.flatten(0, 1).numpy()
    return rows


def _rows_or_none(x: Tensor | None) -> Array | None:
    return None if x is None else _rows(x)


def _spread(x: Array | None, rows: Array, n: int) -> Any:
    """Return a collector's arrays of n environments: ``x`` in ``rows``, elsewhere its first row."""
    if x is None:
        return x
    whole = np.repeat(x[:1], n, axis=0)
    whole[rows] = x
    return whole


def _part(x: Array | None, part: slice) -> Array | None:
    return None if x is None else x[part]


def _joined(parts: list[Array | None]) -> Array | None:
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if known else None
