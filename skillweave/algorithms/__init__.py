"""Algorithms: how rows of experience become better weights, one file for each algorithm.

Begin with ``ppo``. Settings of all are in ``config``, what they get in ``batches``, what they share
in ``base`` and ``off_policy``.
"""

from typing import TYPE_CHECKING

from skillweave._internal.public import lazy

if TYPE_CHECKING:
    from skillweave.algorithms.base import (
        ActingParams as ActingParams,
        AgentState as AgentState,
        Algorithm as Algorithm,
    )
    from skillweave.algorithms.batches import Report as Report, Rollout as Rollout, Sample as Sample
    from skillweave.algorithms.config import (
        Hindsight as Hindsight,
        OnPolicy as OnPolicy,
        SelfImitationPPO as SelfImitationPPO,
    )
    from skillweave.algorithms.parameters import ParameterGroup as ParameterGroup
    from skillweave.algorithms.registry import register_algorithm as register_algorithm
    from skillweave.algorithms.schedules import Linear as Linear
    from skillweave.networks.config import CNN as CNN, RNN as RNN
    from skillweave.networks.encoders import (
        Encoder as Encoder,
        register_encoder as register_encoder,
    )
    from skillweave.networks.heads import ActionHead as ActionHead
    from skillweave.networks.net import Net as Net
    from skillweave.networks.stacked import Layout as Layout
    from skillweave.ops.distributions import mask_logits as mask_logits
    from skillweave.ops.moments import masked_mean as masked_mean, normalize as normalize
    from skillweave.ops.optim import adam_ as adam_, clip_grad_norm_ as clip_grad_norm_
    from skillweave.ops.returns import gae as gae
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
