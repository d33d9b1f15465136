"""Several learners from one stream of steps, each with its own rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from skillweave.buffers.rollout import RolloutStore
from skillweave.collecting.acting import Request
from skillweave.experience import Batch
from skillweave.ops.device import FLOAT
from skillweave.training.learner import Learner, RolloutLearner, Stack
from skillweave.training.stage import CRITIC, SELECTOR, decides
from skillweave.types import Array, prefixed, unprefixed


class WovenLearner:
    """A selector and skills, each with a learner of its own; nobody learns from others' rows.

    Args:
        parts: by path, the selector first unless it is ready, then all others who learn.
        node: the path of the hierarchy: empty, or ``inner/`` for example.
        task_weight: the weight of the task's advantage for skills, at the end of the stage.
        weights: by path, skills with another weight.
    """

    def __init__(
        self,
        parts: Mapping[str, Learner],
        node: str,
        task_weight: float = 0.0,
        weights: Mapping[str, float] | None = None,
    ) -> None:
        self.parts, self._progress = dict(parts), 0.0
        weights = weights or {}
        # Learners from replay keep no advantage, so they follow their own reward alone.
        self._weights = {
            name: weights.get(name, task_weight)
            for name, part in parts.items()
            if isinstance(part, RolloutLearner) and not decides(name)
        }
        self._node = node
        self._selector, self._critic = node + SELECTOR, node + CRITIC
        self.counts = {name: [0, 0] for name in parts}
        """By path, in how many rows each has acted, and how often it has learnt from them."""
        self._acted: dict[str, Tensor] = {}
        self.stacks: Sequence[Stack] = [s for part in parts.values() for s in part.stacks]
        self.overlap = all(part.overlap for part in parts.values())
        self.report_every = max(part.report_every for part in parts.values())
        self.threads = max(part.threads for part in parts.values())

    def request(self, update: int, steps: int, progress: float) -> Request:
        """As many rows as the selector's learner asks for, with the parameters of all.

        Where the selector is ready, as many as the skill asks for that asks for most.
        """
        self._progress = progress
        below = {k: p.request(update, steps, progress) for k, p in self.parts.items()}
        first = next(iter(below.values()))
        if self._selector in self.parts:
            del below[self._selector]
        else:
            rows, seeds = max(r.rows for r in below.values()), first.seeds / self._selector
            first = Request(rows, (), first.gamma, seeds)
        record = tuple(dict.fromkeys(name for r in below.values() for name in r.record))
        below = {k.removeprefix(self._node): r for k, r in below.items()}
        return replace(first, below=below, record=record)

    def take(self, batches: Mapping[str, Batch]) -> None:
        """Give each learner its own rows, and skills the task's advantage, if it has a weight."""
        own = {name: batches[name.removeprefix(self._node)] for name in self.parts}
        if any(self._weights.values()):
            advantage = self._progress * self._task_advantage(own[self._critic])
            for name, weight in self._weights.items():
                if weight:
                    own[name] = own[name].replace(advantage=weight * advantage)
        for name, rows in own.items():
            self.counts[name][0] += int(rows.valid_rows.sum())
            self._acted |= prefixed(name, how_it_acted(name, rows))
            self.parts[name].take({"": rows})

    def _task_advantage(self, rows: Batch) -> Array:
        """What each step did for the task, (T, N) float32, with deviation 1.

        With less where it is small, in units of reward: see ``PPO.min_advantage_std``.
        """
        (stack,) = self.parts[self._critic].stacks
        store = RolloutStore(1, device=stack.state.params.device)
        store.add(rows)
        rollout = store.rollout(stack.state.gamma)
        assert rollout is not None
        found: Array = stack.algorithm.advantage(stack.state, rollout)[0].cpu().numpy()
        least = stack.algorithm.config.min_advantage_std / stack.state.return_scale.item()
        scaled: Array = (found - found.mean()) / (max(found.std(), least) + np.float32(1e-3))
        return scaled

    def learn(self, update: int, steps: int, progress: float) -> dict[str, Tensor]:
        """Let those learn that have enough rows; metrics under ``<name>.``."""
        found, self._acted = self._acted, {}
        for name, part in self.parts.items():
            metrics = part.learn(update, steps, progress)
            self.counts[name][1] += bool(metrics)
            found |= prefixed(name, metrics)
        return found

    def cut(self, columns: Array) -> None:
        """The environments of ``columns`` (k,) begin anew."""
        for part in self.parts.values():
            part.cut(columns)

    def kept(self, *, requested: bool = True, replay: bool = True) -> dict[str, Tensor]:
        """Return what a checkpoint needs beside the states of the stacks."""
        found: dict[str, Tensor] = {}
        for name, part in self.parts.items():
            found |= prefixed(name, part.kept(requested=requested, replay=replay))
        return found

    def load(self, kept: dict[str, Tensor]) -> None:
        """The inverse of ``kept``."""
        for name, part in self.parts.items():
            part.load(unprefixed(name, kept))


def how_it_acted(name: str, rows: Batch) -> dict[str, Tensor]:
    """Of a selector the mean steps of its calls; of a skill how much it acted, and its reward.

    Args:
        name: its path; of a critic there is nothing to say.
        rows: its own.

    Returns:
        ``call_length``, or ``usage`` (a share of all steps) and ``reward`` (mean of a step, where
        it acted), each (1,).
    """
    valid = rows.valid_rows
    found: dict[str, float] = {}
    if name.rpartition("/")[2] == SELECTOR:
        if valid.any():
            found["call_length"] = rows["steps"][valid].mean()
    elif not decides(name):
        found["usage"] = valid.mean()
        if valid.any():
            found["reward"] = rows["reward"][valid].mean()
    return {key: torch.tensor([float(value)], **FLOAT) for key, value in found.items()}
