"""Priorities of replayed transitions in sum trees (Schaul et al. 2016, appendix B.2.1)."""

from __future__ import annotations

import numpy as np

from skillweave.types import Array

FAN_OUT = 32  # children of a node: four levels reach a million leaves
FLOOR = 1e-6  # the smallest priority: what has no error left is still seen now and then


class SumTrees:
    """``trees`` sum trees of ``size`` non-negative numbers each, all walked at once.

    A level is one flat array, tree after tree, padded with zeros to whole nodes; the first holds
    the leaves, every further one the sums of the nodes below.
    """

    def __init__(self, trees: int, size: int) -> None:
        self._trees, self._nodes = trees, []
        self._levels: list[Array] = []
        kind: type = np.float32
        while not self._levels or size > 1:
            size = -(-size // FAN_OUT)
            self._nodes.append(size)  # of one tree at each level
            self._levels.append(np.zeros(trees * size * FAN_OUT, kind))
            kind = np.float64

    @property
    def leaves(self) -> Array:
        """(trees, size and padding) float32, a view."""
        return self._levels[0].reshape(self._trees, -1)

    @property
    def nbytes(self) -> int:
        """Bytes of all levels."""
        return sum(level.nbytes for level in self._levels)

    def put(self, tree: Array, leaf: Array, value: Array) -> None:
        """Set leaves, all arguments (K,); the last of repeated ones counts."""
        for level, nodes in zip(self._levels, self._nodes, strict=True):
            level[tree * (nodes * FAN_OUT) + leaf] = value
            leaf = leaf // FAN_OUT
            children = level.reshape(-1, FAN_OUT).take(tree * nodes + leaf, axis=0)
            value = children.sum(1, dtype=np.float64)

    def rebuild(self) -> None:
        """Sum everything anew, after ``leaves`` was written to."""
        for below, level in zip(self._levels, self._levels[1:], strict=False):
            sums = below.reshape(self._trees, -1, FAN_OUT).sum(2, dtype=np.float64)
            level.reshape(self._trees, -1)[:, : sums.shape[1]] = sums

    def find(self, fraction: Array, first: int = 0) -> tuple[Array, Array]:
        """Where the running sum of a tree's leaves passes ``fraction`` (K, B) of its total.

        Of K trees from ``first`` on. Fractions are in [0, 1). Returns the leaves and their values,
        both (K, B); a leaf of value 0 is never found.
        """
        trees = np.arange(first, first + len(fraction))
        tree = np.repeat(trees, fraction.shape[1])
        total = self._levels[-1].reshape(self._trees, -1)[trees].sum(1)
        target = (fraction * total[:, None]).reshape(-1)
        leaf, each = np.zeros_like(tree), np.arange(len(tree))
        for level, nodes in zip(reversed(self._levels), reversed(self._nodes), strict=True):
            children = level.reshape(-1, FAN_OUT).take(tree * nodes + leaf, axis=0)
            running = children.cumsum(1, dtype=np.float64)
            # Rounding must lead neither past the last child that is not 0, nor to one that is.
            target = np.minimum(target, np.nextafter(running[:, -1], 0.0))
            child = (running > target[:, None]).argmax(1)
            value = children[each, child]
            target = np.maximum(target - (running[each, child] - value), 0.0)
            leaf = leaf * FAN_OUT + child
        return leaf.reshape(fraction.shape), value.reshape(fraction.shape)


class Priorities:
    """Proportional prioritisation: a slot is drawn with a probability ∝ priority^alpha.

    Every one of ``members`` has priorities of its own for ``slots`` slots, 0 at first.
    """

    def __init__(self, members: int, slots: int, alpha: float) -> None:
        self._trees, self._alpha = SumTrees(members, slots), alpha
        self._highest = np.ones(members, np.float32)

    @property
    def nbytes(self) -> int:
        """Bytes of the trees."""
        return self._trees.nbytes

    def set_new(self, member: Array, slot: Array, new: Array) -> None:
        """Give slots the member's highest priority so far where ``new``, else none; all (K,)."""
        self._trees.put(member, slot, self._highest[member] ** self._alpha * new)

    def draw(self, uniform: Array, beta: float, first: int = 0) -> tuple[Array, Array]:
        """Slots and importance weights (K, B), one of each B-th of the mass (stratified).

        Of K members from ``first`` on.

        The weights are (N·P(i))^−β over the batch's highest, in which N and the total cancel.
        """
        batch = uniform.shape[1]
        slot, value = self._trees.find((np.arange(batch) + uniform) / batch, first)
        return slot, (value.min(1, keepdims=True) / value) ** np.float32(beta)

    def update(self, member: Array, slot: Array, priority: Array) -> None:
        """New priorities after learning; all (K,)."""
        # A member that has diverged gives none; it is stopped or replaced by others.
        priority = np.nan_to_num(priority, nan=0.0, posinf=0.0)
        priority = np.maximum(priority, np.float32(FLOOR))
        np.maximum.at(self._highest, member, priority)
        self._trees.put(member, slot, priority**self._alpha)

    def inherit(self, parents: Array) -> None:
        """Every member (P,) goes on with the priorities of the one it descends from."""
        self._trees.leaves[:] = self._trees.leaves[parents]
        self._trees.rebuild()
        self._highest[:] = self._highest[parents]

    def written(self, used: int) -> dict[str, Array]:
        """Views of the first ``used`` slots' priorities, by name; after writing ``rebuild``."""
        return {"priority": self._trees.leaves[:, :used], "highest_priority": self._highest}

    def forget(self) -> None:
        """No slot has a priority."""
        self._trees.leaves[:] = 0.0

    def rebuild(self, member: Array, slot: Array) -> None:
        """Sum everything anew, after what ``written`` gave was written to.

        Args:
            member, slot: (K,), where a transition is, so there must be a priority.

        Raises:
            ValueError: those are no priorities.
        """
        leaves = self._trees.leaves
        for found in leaves, self._highest:
            if not np.isfinite(found).all() or (found < 0).any():
                raise ValueError("a priority of its replay buffer is negative or not finite")
        if not leaves[member, slot].all() or np.count_nonzero(leaves) != len(member):
            raise ValueError("not the transitions of its replay buffer have the priorities")
        self._trees.rebuild()
