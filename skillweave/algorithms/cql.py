"""Conservative Q-learning of discrete actions for P members at once (Kumar et al. 2020).

DQN with a cost in its loss, which keeps values of actions low that the data do not show. The
settings are ``config.CQL``.
"""

from __future__ import annotations

from torch import Tensor

from skillweave.algorithms.batches import Sample
from skillweave.algorithms.dqn import DQNAlgorithm
from skillweave.ops.losses import conservative_cost, weighted_mean


class CQLAlgorithm(DQNAlgorithm):
    """CQL on one pair of spaces; all that is learnt is in DQN's ``State``."""

    def cost(self, out: Tensor, sample: Sample) -> Tensor:
        """Return the cost of values of actions beside those of the data, (P,)."""
        each = conservative_cost(self._q(out), sample.action, sample.mask)
        cost: Tensor = self.config.cql_alpha * weighted_mean(each, sample.weight)
        return cost
