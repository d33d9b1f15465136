"""A learnt correction on a ready policy, as the ``policy`` of a skill.

Residual policy learning: Silver et al. 2018, arXiv:1812.06298; Johannink et al. 2019,
arXiv:1812.03201.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Tuple

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave.errors import DeclarationError
from skillweave.policies.parts import Correction
from skillweave.policies.spaces import space_of
from skillweave.schema import Check, check_fields
from skillweave.skills.learnable import Learnable
from skillweave.skills.mapping import floats

TAKES = "a function of observations, from_sb3(...), from_onnx(...), or another ready policy"


def _scale(value: Any) -> Any:
    scale = np.array(floats(value))
    if scale.min() <= 0:
        raise ValueError
    return scale.tolist()


Scale = Annotated[
    Any, Check("a number over 0, or one for each number of the action", convert=_scale)
]
"""The size of a correction."""


@checked_names
@dataclass(frozen=True, eq=False)
class Residual:
    """A ready policy with a learnt correction: ``clip(ready + scale * learnt)``.

    A skill with this ``policy`` learns the correction, from about zero on, by its algorithm. The
    ready policy does not change; it acts greedily, and keeps its recurrent state, chunks and rate.
    The network sees what the skill sees, and not the ready policy's action.

    ```python
    import skillweave as sw


    def swing(obs):  # a first guess by hand
        return 2 * obs[:, 2:]


    class Up(sw.Skill):
        policy = sw.Residual(swing, scale=0.5)
        algorithm = sw.SAC()


    hierarchy = sw.Hierarchy("Pendulum-v1", [Up()], learn="apart")
    ```

    Source: residual policy learning (Silver et al. 2018; Johannink et al. 2019).

    Raises:
        DeclarationError: a setting is wrong; the message names it.
    """

    policy: Any
    """The ready policy: a function of observations, ``from_sb3(...)``, ``from_onnx(...)``,
    ``from_torch(...)``, ``load_policy(...)``, or any ``Policy``; its actions are of a Box."""
    scale: Scale = 0.2
    """The largest correction, as a share of half of an action's range: 1 may undo any action. One
    number, or one for each number of the action. Where an action has no bounds, it is in the
    action's own unit."""

    def __post_init__(self) -> None:
        refuse_skill(self.policy, "Residual.policy")
        if self.policy is None or isinstance(self.policy, type | Residual):
            raise DeclarationError(f"Residual.policy is {short(self.policy)}; it must be {TAKES}")
        if isinstance(self.policy, Learnable):
            raise DeclarationError(
                f"Residual.policy is {self.policy.name} with learn=True, but a correction leaves "
                "the policy as it is: leave out learn, or let the skill learn on with the policy "
                "itself, without Residual"
            )
        check_fields(self)

    def __repr__(self) -> str:
        return f"Residual({short(self.policy, 60)}, scale={self.scale})"


def refuse_skill(value: Any, where: str) -> None:
    """Raise a DeclarationError where a skill, or its class, is given as a policy.

    ``where`` begins the message.
    """
    methods = getattr(value, "methods", None)  # of ``Skill``, whose module imports this one
    if not (isinstance(methods, tuple) and "initiation" in methods):
        return
    kind = value if isinstance(value, type) else type(value)
    what = f"the class {kind.__name__}" if value is kind else f"the skill {value.name!r}"
    if value.policy is None or isinstance(value.policy, Learnable | Residual):
        raise DeclarationError(
            f"{where} is {what}, a skill that learns, and no policy: train a hierarchy of it "
            "first, and give the policy of that run, run.policy"
        )
    instance = f"{kind.__name__}()" if value is kind else "skill"
    raise DeclarationError(
        f"{where} is {what}, and no policy: give what acts in that skill, {instance}.policy"
    )


def correction(scale: Any, space: Space[Any], who: str) -> Correction:
    """Return the residual that adds learnt numbers in [−1, 1] to a ready policy's actions.

    Args:
        scale: as of ``Residual``.
        space: of the skill's actions.
        who: begins messages.

    Raises:
        DeclarationError: actions of the space cannot be corrected, or ``scale`` does not fit them.
    """
    if not isinstance(space, Box) or space.dtype is None or space.dtype.kind != "f":
        has_parts = isinstance(space, Dict | Tuple)
        part = ", or let it own and correct one part of real numbers (acts)" if has_parts else ""
        raise DeclarationError(
            f"{who}: Residual adds to actions, which needs a Box of real numbers, but actions are "
            f"of {short(space)}: let the skill learn without it, policy = None{part}"
        )
    size = int(np.prod(space.shape))
    if isinstance(scale, list) and len(scale) != size:
        raise DeclarationError(
            f"{who}: Residual.scale has {len(scale)} numbers, but the action has {size}"
        )
    bounded = np.isfinite(space.low) & np.isfinite(space.high)
    low, high = (np.where(bounded, x, 0.0).astype(np.float64) for x in (space.low, space.high))
    half = np.where(bounded, 0.5 * (high - low), 1.0)
    return Correction(half * np.broadcast_to(scale, size).reshape(space.shape), space_of(space))
