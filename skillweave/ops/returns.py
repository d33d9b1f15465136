"""Returns, targets and advantages from rows that carry a number ``discount``."""

from __future__ import annotations

import torch
from torch import Tensor

from skillweave._internal.shapes import Bool, Float


def gae(
    reward: Float[Tensor, "P T B"],
    discount: Float[Tensor, "P T B"],
    value: Float[Tensor, "P T B"],
    next_value: Float[Tensor, "P T B"],
    last: Bool[Tensor, "P T B"],
    gae_lambda: Float[Tensor, " P"],
    importance: Float[Tensor, "P T B"] | None = None,
) -> Float[Tensor, "P T B"]:
    """Compute generalised advantage estimates, exact for semi-MDPs and time limits.

    ``δ = r + discount·V(next) − V``; ``A = δ + discount·λ·(1 − last)·A⁺``
    (Schulman et al. 2016, eq. 16, with the discount as data: γ^τ after a call of τ steps).

    ```python
    import torch
    from skillweave.algorithms import gae

    row = torch.ones(1, 3, 1)  # one member, three steps, one environment
    last = torch.tensor([False, False, True]).view(1, 3, 1)
    advantage = gae(row, 0.9 * row, 0 * row, 0 * row, last, torch.tensor([1.0]))
    assert torch.allclose(advantage.flatten(), torch.tensor([2.71, 1.9, 1.0]))
    ```

    Args:
        reward: (P, T, B), r of each row; of a call Σγᵏrₖ.
        discount: (P, T, B), 0 where terminated, else γ^τ.
        value: (P, T, B), V.
        next_value: (P, T, B), V of the true successor; ignored where ``discount`` is 0.
        last: (P, T, B) bool, the trajectory is cut here.
        gae_lambda: (P,) float.
        importance: (P, T, B), at most 1: the probability of each action under the policy whose
            advantages are wanted ÷ that under the one that acted. Later rows count by it, as in
            Retrace (Munos et al. 2016, eq. 4), so that ``V + importance·A`` is V-trace's target
            (Espeholt et al. 2018, eq. 1). None: one policy, all are 1.

    Returns:
        Advantages, (P, T, B).
    """
    delta = td_target(reward, discount, next_value) - value
    decay = discount * gae_lambda[:, None, None] * (~last)
    if importance is not None:
        decay[:, :-1] *= importance[:, 1:]
    advantage = torch.empty_like(delta)
    running = torch.zeros_like(delta[:, 0])
    for t in range(delta.shape[1] - 1, -1, -1):
        running = torch.addcmul(delta[:, t], decay[:, t], running)
        advantage[:, t] = running
    return advantage


def td_target(reward: Tensor, discount: Tensor, value: Tensor) -> Tensor:
    """Return ``r + discount·V(s′)``, the target of a value (Sutton 1988); all of one shape."""
    return reward + discounted(discount, value)


def discounted(discount: Tensor, value: Tensor) -> Tensor:
    """Return ``discount·value``, but 0 where ``discount`` is 0; both of one shape.

    Not a product: the value of a terminal observation may be any number, and 0·NaN is NaN.
    """
    return torch.where(discount == 0.0, 0.0, discount * value)
