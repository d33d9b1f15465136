"""Goals as tasks: one planner serves every goal that an observation may hold."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave.calls.predicates import Predicate
from skillweave.errors import DeclarationError
from skillweave.planning.machine import RewardMachine
from skillweave.policies.core import Array, Step, read_only
from skillweave.policies.selectors import function_name
from skillweave.skills.outputs import call_user, checked


@checked_names
class GoalTask:
    """A task that pays 1 where a goal is reached, and ends there.

    ```python
    import numpy as np

    from skillweave.planning import GoalTask


    def near(obs, goal):
        return np.hypot(*(obs[:, :2] - goal).T) < 0.45


    to_a_point = GoalTask(near, goal=[3.0, -1.0])
    as_observed = GoalTask(near, columns=(4, 5))  # each episode's observations hold its goal
    ```

    Args:
        reached: of observations (n, …) and goals (n, G), or one goal (G,): (n,) bool.
        goal: (G,), one goal for all episodes; or give ``columns``.
        columns: the places of the goal in observations, which are vectors.

    Raises:
        DeclarationError: not exactly one of ``goal`` and ``columns`` is given, or it has a wrong
            type.
    """

    def __init__(
        self,
        reached: Callable[[Array, Array], Any],
        *,
        goal: Any = None,
        columns: tuple[int, ...] | slice | None = None,
    ) -> None:
        if not callable(reached) or isinstance(reached, type):
            raise DeclarationError(
                f"a GoalTask's reached is {short(reached)}; give a function of observations and "
                "goals"
            )
        if (goal is None) == (columns is None):
            raise DeclarationError("a GoalTask needs either goal= or columns=")
        self.reached = reached
        self.columns = columns
        self.goal = None if goal is None else _goal(goal)
        # A slice or a list: both are indices of an axis.
        self._at: Any = list(columns) if isinstance(columns, tuple | list) else columns

    def of(self, obs: Array) -> Array:
        """Return the goals of observations (n, …), (n, G) float64."""
        if self.goal is not None:
            return np.broadcast_to(self.goal, (len(obs), len(self.goal)))
        if obs.ndim != 2:
            raise DeclarationError(
                f"a GoalTask's columns are places in vectors, but observations have shape "
                f"{obs.shape[1:]}; give goal= and a function that reads it"
            )
        try:
            goals: Array = obs[:, self._at].astype(np.float64)
        except (IndexError, TypeError) as error:
            raise DeclarationError(
                f"a GoalTask's columns are {short(self.columns)}, but observations have "
                f"{obs.shape[1]} numbers"
            ) from error
        return goals

    def put(self, obs: Array, goal: Array) -> Array:
        """Return observations (n, …) that hold another ``goal`` (G,), where they hold one."""
        if self.columns is None:
            return obs
        changed = obs.copy()
        changed[:, self._at] = goal
        return changed

    def holds(self, obs: Array, goal: Array) -> Array:
        """Return where ``goal``, (G,) or (n, G), is reached in ``obs`` (n, …), (n,) bool."""
        who = f"goal: {function_name(self.reached)}()"
        one = goal.ndim == 1
        more, fixed = ((), (goal,)) if one else ((goal,), ())
        convert = partial(checked, n=len(obs), dtype=bool, who=who)
        return cast(
            Array,
            call_user(self.reached, read_only(obs), who, more=more, fixed=fixed, convert=convert),
        )

    def at(self, goal: Array | None) -> RewardMachine:
        """Return the task of one goal (G,), or None: of that which each observation holds."""
        there = Predicate(self.arrives, "the goal", "step")
        if goal is not None:
            there = Predicate(lambda obs: self.holds(obs, goal), "the goal", "obs")
        return RewardMachine({("on the way", "there"): (there, 1.0)}, accepting={"there"})

    def arrives(self, step: Step) -> Array:
        """Return where a step reaches the goal that its first observation holds, (n,) bool."""
        return self.holds(step.next_obs, self.of(step.obs))


@checked_names
def reached(function: Callable[[Array, Array], Any], goal: Any) -> Predicate:
    """Return the predicate that a goal is reached, for missions.

    Args:
        function: of observations (n, …) and one goal (G,): (n,) bool.
        goal: (G,) numbers.

    Raises:
        DeclarationError: the goal is not finite numbers.
    """
    task = GoalTask(function, goal=goal)
    fixed = _goal(goal)
    place = ", ".join(f"{x:g}" for x in fixed[:4])
    return Predicate(lambda obs: task.holds(obs, fixed), f"{function_name(function)}({place})")


def _goal(value: Any) -> Array:
    """Return a goal of a task as float64 numbers (G,)."""
    try:
        goal = np.atleast_1d(np.asarray(value))
        if goal.dtype.kind not in "iuf":
            raise TypeError
    except (TypeError, ValueError) as error:
        raise DeclarationError(f"a goal is {short(value)}; give numbers: [3.0, -1.0]") from error
    goal = goal.astype(np.float64)
    if goal.ndim != 1 or not len(goal) or not np.isfinite(goal).all():
        raise DeclarationError(f"a goal is {short(value)}; give one row of finite numbers")
    return goal
