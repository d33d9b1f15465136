"""What a user declares: skills and reflexes."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from skillweave.types import Array, SkillweaveError, Step

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_\-]{0,63}")
"""What a skill may be named: its name names files, too."""


class Skill:
    """An option: where it may start, what it maximises, when it stops.

    Sutton, Precup & Singh 1999, "Between MDPs and semi-MDPs".

    Subclass it and define ``reward``; all else is optional. Every method is batched: arrays
    over N environments in, one array (N,) out, so the same class runs on one environment and on
    a thousand. Methods must be functions of their arguments: keep no state of an environment in
    ``self`` (``step`` has the observation before and after).

    Attributes:
        name: used in messages, files and captions; default: the class name in lower case.
        max_steps: the skill stops after so many steps; None: only by ``termination``.
        steps: training budget in environment steps; None: the hierarchy's ``skill_steps``.
        algorithm: settings of the algorithm that trains it (its network is among them);
            None: the hierarchy's.
        policy: what acts without being trained: a function of observations (n, *obs_shape), which
            needs no ``staticmethod``, or a method ``policy(self, obs)``; a torch module;
            ``from_sb3(...)``, ``from_onnx(...)``; any ``Policy``. None: it is trained. Where an
            environment tells an action mask, networks that return logits keep to it; what others
            return goes to the environment as it is.
        color: RGB in captions and plots; None: chosen from a palette.
    """

    name: str = ""
    max_steps: int | None = None
    steps: int | None = None
    algorithm: Any = None
    policy: Any = None
    color: tuple[int, int, int] | None = None

    methods: ClassVar[tuple[str, ...]] = ("reward", "initiation", "termination", "success")

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" not in cls.__dict__:
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower().strip("_")

    def reward(self, step: Step) -> Array:
        """What the skill maximises, (N,). The default is the environment's own reward."""
        return step.reward

    def initiation(self, obs: Array) -> Array:
        """Where it may start: (N, *obs_shape) to (N,) bool. The default is everywhere."""
        return np.ones(len(obs), bool)

    def termination(self, step: Step) -> Array:
        """Where it stops: (N,) bool; its value ends there. The default is nowhere."""
        return np.zeros(len(step.reward), bool)

    def success(self, step: Step) -> Array:
        """What counts as having succeeded, (N,) bool, read where the skill stops."""
        return np.zeros(len(step.reward), bool)

    def defines(self, method: str) -> bool:
        """Whether the subclass gives its own version of ``method``."""
        return getattr(type(self), method) is not getattr(Skill, method)

    def validate(self) -> None:
        """Raise a SkillweaveError that names what is wrong with the declaration."""
        where = f"skill {self.name!r} ({type(self).__name__})"
        if not self.name:
            raise SkillweaveError(f"{where} has no name: set the class attribute 'name'")
        if not NAME.fullmatch(self.name):
            raise SkillweaveError(
                f"{where}: the name names files too; use letters, digits, '_' and '-', at most 64"
            )
        for field in ("max_steps", "steps"):
            value = getattr(self, field)
            if value is not None and (not isinstance(value, int) or value < 1):
                raise SkillweaveError(
                    f"{where}: {field} is {value!r}; it must be at least 1, or None"
                )


class Reflex:
    """A rule that overrides the running skill's action while its condition holds.

    Args:
        condition: observations (N, *obs_shape) to (N,) bool.
        action: the action to take instead, or a function from observations (n, *obs_shape) to
            actions (n, ...).
        name: used in messages and captions; default: the condition's name.
    """

    def __init__(
        self,
        condition: Callable[[Array], Array],
        action: Any,
        name: str | None = None,
    ) -> None:
        self.condition, self.action = condition, action
        self.name = name or getattr(condition, "__name__", "reflex")

    def apply(self, obs: Array, action: Array) -> tuple[Array, Array]:
        """The actions with this reflex in force, and (N,) bool: where it acted."""
        holds = checked(self.condition(obs), len(obs), bool, f"reflex {self.name!r}", "condition")
        if holds.any():
            action = action.copy()
            action[holds] = self.action(obs[holds]) if callable(self.action) else self.action
        return action, holds


def apply_reflexes(reflexes: tuple[Reflex, ...], obs: Array, action: Array) -> Array:
    """Every reflex in order; the last whose condition holds wins."""
    for reflex in reflexes:
        action, _ = reflex.apply(obs, action)
    return action


def checked(
    value: Any, n: int, dtype: type, who: str, method: str, elapsed: Array | int | None = None
) -> Array:
    """``value`` as an array (n,) of ``dtype``; ``elapsed`` (n,) or () says at which steps.

    Raises:
        SkillweaveError: it has another shape, or is a NaN or an infinity; the message names the
            skill, the method and the step.
    """
    array = np.asarray(value)
    if array.shape != (n,):
        when = "" if elapsed is None else f" at step {np.max(elapsed)}"
        raise SkillweaveError(
            f"{who}: {method}() returned shape {array.shape}{when}, but ({n},) was expected: one "
            f"number for each of the {n} environments"
        )
    if dtype is bool:
        return array if array.dtype == bool else array.astype(bool)
    with np.errstate(over="ignore"):  # an overflow is an infinity, reported below
        array = array.astype(dtype, copy=False)
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array))[0])
        when = "" if elapsed is None else f" at step {np.broadcast_to(elapsed, n)[row]}"
        raise SkillweaveError(
            f"{who}: {method}() returned {array[row]}{when} for environment {row}: "
            "rewards must be finite"
        )
    return array
