"""The learner of a selector and its skills that learn together, from the same steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from skillweave._internal.paths import CRITIC, SELECTOR, decides, join, name_of, relative
from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave.algorithms.batches import Batch
from skillweave.buffers.rollout import RolloutStore
from skillweave.experience.acting import Request
from skillweave.ops.device import FLOAT, INT
from skillweave.ops.moments import normalize
from skillweave.policies.core import Array
from skillweave.training.learner import Learner, RolloutLearner, Stack


class JointLearner:
    """A selector and skills, each with its own learner, which gets only its own rows.

    Args:
        learners: by path, the selector first unless it is ready, then all other learners.
        level: the path of their level.
        task_weight: the weight of the task's advantage for skills, at the end of the stage.
        weights: weights of skills with another weight, by path.
    """

    def __init__(
        self,
        learners: Mapping[str, Learner],
        level: str,
        task_weight: float = 0.0,
        weights: Mapping[str, float] | None = None,
    ) -> None:
        self.learners = dict(learners)
        self._progress = 0.0
        weights = weights or {}
        # Learners from replay store no advantage, so they follow their own reward alone.
        self._weights = {
            name: weights.get(name, task_weight)
            for name, learner in learners.items()
            if isinstance(learner, RolloutLearner) and not decides(name)
        }
        self._level = level
        self._selector = join(level, SELECTOR)
        self._critic = join(level, CRITIC)
        self.counts = {name: [0, 0] for name in learners}
        """Rows in which each has acted, and updates from them, by path."""
        self._acted: dict[str, Tensor] = {}
        self.stacks: Sequence[Stack] = [s for learner in learners.values() for s in learner.stacks]
        self.overlap = all(learner.overlap for learner in learners.values())
        self.report_every = max(learner.report_every for learner in learners.values())
        self.threads = max(learner.threads for learner in learners.values())

    def request(self, update: int, steps: int, progress: float) -> Request:
        """Return the selector's request, with the requests of all others below it.

        Where the selector is ready, the number of rows is the largest that a skill requests.
        """
        self._progress = progress
        requests = {k: p.request(update, steps, progress) for k, p in self.learners.items()}
        first = next(iter(requests.values()))
        if self._selector in self.learners:
            del requests[self._selector]
        else:
            rows = max(r.rows for r in requests.values())
            first = Request(rows, (), first.gamma, first.seeds / self._selector)
        below = {relative(k, self._level): r for k, r in requests.items()}
        return replace(first, below=below)

    def take(self, batches: Mapping[str, Batch]) -> None:
        """Give each learner its own rows, and skills the task's advantage, if it has a weight."""
        by_learner = {name: batches[relative(name, self._level)] for name in self.learners}
        if any(self._weights.values()):
            advantage = self._progress * self._task_advantage(by_learner[self._critic])
            for name, weight in self._weights.items():
                if weight:
                    by_learner[name] = by_learner[name].replace(advantage=weight * advantage)
        for name, rows in by_learner.items():
            self.counts[name][0] += int(rows.own_rows.sum())
            self._acted |= prefixed(name, how_it_acted(name, rows))
            self.learners[name].take({"": rows})

    def _task_advantage(self, rows: Batch) -> Array:
        """Return the task's advantage of each step, (T, N) float32, with standard deviation 1.

        Small advantages have less, in units of reward: see ``PPO.min_advantage_std``. It becomes a
        column of the skills' batches, whose columns are arrays until a store gathers their rows.
        """
        (stack,) = self.learners[self._critic].stacks
        store = RolloutStore(1, device=stack.state.params.device)
        store.add(rows)
        rollout = store.rollout(stack.state.gamma)
        assert rollout is not None
        advantage = stack.algorithm.advantage(stack.state, rollout)
        min_std = stack.algorithm.config.min_advantage_std / stack.state.return_scale.item()
        scaled: Array = normalize(advantage, eps=1e-3, min_std=min_std)[0].cpu().numpy()
        return scaled

    def learn(self, update: int, steps: int, progress: float) -> dict[str, Tensor]:
        """Update the learners that have enough rows; return metrics under ``<name>.``."""
        all_metrics = self._acted
        self._acted = {}
        for name, learner in self.learners.items():
            metrics = learner.learn(update, steps, progress)
            self.counts[name][1] += bool(metrics)
            all_metrics |= prefixed(name, metrics)
        return all_metrics

    def cut(self, columns: Array) -> None:
        """End the open trajectories of ``columns`` (k,), whose environments were reset."""
        for learner in self.learners.values():
            learner.cut(columns)

    def kept(self, *, requested: bool = True, replay: bool = True) -> dict[str, Tensor]:
        """Return the tensors of a checkpoint beside the states of the stacks."""
        tensors = {"counts": torch.tensor(list(self.counts.values()), **INT)}
        for name, learner in self.learners.items():
            tensors |= prefixed(name, learner.kept(requested=requested, replay=replay))
        return tensors

    def load(self, kept: dict[str, Tensor]) -> None:
        """Restore the tensors that ``kept`` returned."""
        self.counts = dict(zip(self.counts, kept["counts"].tolist(), strict=True))
        for name, learner in self.learners.items():
            learner.load(unprefixed(name, kept))


def how_it_acted(name: str, rows: Batch) -> dict[str, Tensor]:
    """Return metrics of a learner's rows: a selector's call length, or a skill's usage and reward.

    Args:
        name: the path of the learner; a critic has no such metrics.
        rows: the learner's own.

    Returns:
        ``call_length``, or ``usage`` (a share of all steps) and ``reward`` (mean of its own
        steps), each (1,).
    """
    valid = rows.own_rows
    metrics: dict[str, float] = {}
    if name_of(name) == SELECTOR:
        if valid.any():
            metrics["call_length"] = rows["steps"][valid].mean()
    elif not decides(name):
        metrics["usage"] = valid.mean()
        if valid.any():
            metrics["reward"] = rows["reward"][valid].mean()
    return {key: torch.tensor([float(value)], **FLOAT) for key, value in metrics.items()}
