"""Priorities of replayed transitions in sum trees (Schaul et al. 2016, appendix B.2.1)."""

from __future__ import annotations

import numpy as np

from skillweave.policies.core import Array

FAN_OUT = 32  # children of a node: four levels reach a million leaves
EPSILON = 1e-6  # the smallest priority: a transition without error is still drawn sometimes


class SumTrees:
    """``trees`` sum trees of ``size`` non-negative numbers each, all walked at once.

    A level is one flat array, tree after tree, padded with zeros to whole nodes; the first holds
    the leaves, every further one the sums of the nodes below.
    """

    def __init__(self, trees: int, size: int) -> None:
        self._trees = trees
        self._nodes: list[int] = []
        self._levels: list[Array] = []
        kind: type = np.float32
        while not self._levels or size > 1:
            size = -(-size // FAN_OUT)
            self._nodes.append(size)  # of one tree, by level
            self._levels.append(np.zeros(trees * size * FAN_OUT, kind))
            kind = np.float64

    @property
    def leaves(self) -> Array:
        """The leaves (trees, size and padding), a float32 view."""
        return self._levels[0].reshape(self._trees, -1)

    @property
    def nbytes(self) -> int:
        """Number of bytes of all levels."""
        return sum(level.nbytes for level in self._levels)

    def put(self, tree: Array, leaf: Array, value: Array) -> None:
        """Set leaves, all arguments (K,); the last of repeated ones counts."""
        for level, nodes in zip(self._levels, self._nodes, strict=True):
            level[tree * (nodes * FAN_OUT) + leaf] = value
            leaf = leaf // FAN_OUT
            children = level.reshape(-1, FAN_OUT).take(tree * nodes + leaf, axis=0)
            value = children.sum(1, dtype=np.float64)

    def rebuild(self) -> None:
        """Recompute all sums after ``leaves`` was written."""
        for below, level in zip(self._levels, self._levels[1:], strict=False):
            sums = below.reshape(self._trees, -1, FAN_OUT).sum(2, dtype=np.float64)
            level.reshape(self._trees, -1)[:, : sums.shape[1]] = sums

    def find(self, fraction: Array, first: int = 0) -> tuple[Array, Array]:
        """Find the leaf at which a tree's running sum passes ``fraction`` (K, B) of its total.

        The trees are K from ``first`` on. Fractions are in [0, 1). Returns the leaves and their
        values, both (K, B); a leaf of value 0 is never returned.
        """
        trees = np.arange(first, first + len(fraction))
        tree = np.repeat(trees, fraction.shape[1])
        total = self._levels[-1].reshape(self._trees, -1)[trees].sum(1)
        target = (fraction * total[:, None]).reshape(-1)
        leaf = np.zeros_like(tree)
        each = np.arange(len(tree))
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

    Each of ``members`` has its own priorities for ``slots`` slots, 0 at first.
    """

    def __init__(self, members: int, slots: int, alpha: float) -> None:
        self._trees = SumTrees(members, slots)
        self._alpha = alpha
        self._highest = np.ones(members, np.float32)

    @property
    def nbytes(self) -> int:
        """Number of bytes of the trees."""
        return self._trees.nbytes

    def set_new(self, member: Array, slot: Array, new: Array) -> None:
        """Set slots to the member's highest priority so far where ``new``, else to 0; all (K,)."""
        self._trees.put(member, slot, self._highest[member] ** self._alpha * new)

    def draw(self, uniform: Array, beta: float, first: int = 0) -> tuple[Array, Array]:
        """Draw slots and importance weights (K, B), one from each B-th of the mass (stratified).

        The members are K from ``first`` on. The weights are (N·P(i))^−β divided by the batch's
        highest; N and the total cancel.
        """
        batch = uniform.shape[1]
        slot, value = self._trees.find((np.arange(batch) + uniform) / batch, first)
        return slot, (value.min(1, keepdims=True) / value) ** np.float32(beta)

    def update(self, member: Array, slot: Array, priority: Array) -> None:
        """Set the priorities after learning; all (K,)."""
        # A diverged member has no finite errors; other code stops or replaces it.
        priority = np.nan_to_num(priority, nan=0.0, posinf=0.0)
        priority = np.maximum(priority, np.float32(EPSILON))
        np.maximum.at(self._highest, member, priority)
        self._trees.put(member, slot, priority**self._alpha)

    def inherit(self, parents: Array) -> None:
        """Copy to each member the priorities of its parent (P,)."""
        self._trees.leaves[:] = self._trees.leaves[parents]
        self._trees.rebuild()
        self._highest[:] = self._highest[parents]

    def written(self, used: int) -> dict[str, Array]:
        """Return views of the first ``used`` slots' priorities; call ``rebuild`` after a change."""
        return {"priority": self._trees.leaves[:, :used], "highest_priority": self._highest}

    def forget(self) -> None:
        """Set all priorities to 0."""
        self._trees.leaves[:] = 0.0

    def rebuild(self) -> None:
        """Recompute all sums after the views of ``written`` were changed."""
        self._trees.rebuild()
