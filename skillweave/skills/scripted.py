"""Plain functions as policies."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
from gymnasium.spaces import Dict, Tuple

from skillweave.arguments import checked_names
from skillweave.errors import DeclarationError, PolicyError
from skillweave.messages import short
from skillweave.policies.parts import GOAL, OBSERVATION
from skillweave.skills.foreign_policy import qualified
from skillweave.skills.mapped import (
    MappedPolicy,
    model_state,
    parted,
    rows_first,
    state_shapes,
)
from skillweave.skills.mapping import PolicyMapping, mapping_of
from skillweave.skills.outputs import as_array, called, checked_actions, required_arguments
from skillweave.skills.probing import probe
from skillweave.types import Array, Memory, read_only


class ScriptedPolicy(MappedPolicy):
    """A function from observations (n, *obs_shape) to actions (n, *action_shape) as a policy."""

    kind = "function"
    logits = False

    def __init__(
        self,
        function: Callable[..., Any],
        observation_space: Any = None,
        action_space: Any = None,
        mapping: PolicyMapping | None = None,
    ) -> None:
        self.function = function
        # How it takes a skill's goal: by the name goal, or as its second argument; None: not.
        self._with_goal: Literal["goal", "second"] | None = None
        if mapping is None or not (mapping.sees or mapping.state):
            self._with_goal = _takes_goal(function)
        name = getattr(function, "__name__", type(function).__name__)
        super().__init__(f"function {name}()", observation_space, action_space, mapping)

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
        goal: Array | None = None,
    ) -> tuple[Array, Memory]:
        """Return the function's actions, checked if the action space is known."""
        if self.action_space is None and self.mapping.is_identity:
            return self.call(obs, (), mask, deterministic, rng)[0], memory
        return super().act(memory, obs, mask, deterministic=deterministic, rng=rng, goal=goal)

    def call(
        self,
        inputs: Any,
        state: tuple[Array, ...],
        mask: Array | None,
        deterministic: bool,
        rng: np.random.Generator | None,
    ) -> tuple[Array, tuple[Array, ...]]:
        """Call the function."""
        who = self._who
        mapping = self.mapping
        only = inputs.get("") if isinstance(inputs, dict) else inputs
        if only is not None and not mapping.state:
            return self._actions(read_only(only)), ()
        before = tuple(read_only(x) for x in model_state(state, mapping.state))
        more: tuple[Any, ...] = before if mapping.single_state else (before,)
        given: Any = only
        if only is None:
            given = {k: read_only(v) for k, v in inputs.items()}
            given |= {"state": more[0]} if mapping.state else {}
        value = called(self.function, given, who, kind=PolicyError, more=more)
        action, after = parted(value, mapping, who)
        # Copies: the function may return the same arrays each time.
        arrays = [np.array(as_array(x, who, PolicyError)) for x in after]
        n = len(next(iter(inputs.values())) if only is None else only)
        return self._array(action, n), rows_first(arrays, mapping.state, who)

    @property
    def takes_goal(self) -> bool:
        """Return whether the goal of a skill is an argument or an input of it."""
        return self._with_goal is not None or super().takes_goal

    @property
    def with_goal(self) -> Literal["goal", "second"] | None:
        """Return how the function is given the goal of its skill; None: it is given none."""
        return self._with_goal if self.has_goals else None

    advice = (
        "let the function take it by this name, policy(obs, goal), or write Goal() at its place in "
        "sees"
    )

    def split(self, obs: Array) -> tuple[Array, Array | None]:
        """Return observations and goals for its inputs; a function takes both from the whole."""
        return (obs, None) if self._with_goal is not None else super().split(obs)

    def _actions(self, given: Array) -> Array:
        """Return what the function makes of its only input."""
        who, function = self._who, self.function
        if self.with_goal is not None:
            obs, goal = read_only(given[OBSERVATION]), read_only(given[GOAL])
            by_name = self.with_goal == GOAL
            function = partial(function, goal=goal) if by_name else function
            action = called(function, obs, who, kind=PolicyError, more=() if by_name else (goal,))
            return self._array(action, len(given))
        value = called(function, given, who, kind=PolicyError)
        action = self._array(value, len(given))
        mapping = self.mapping
        space, n = self.action_space, len(given)
        if space is not None and mapping.acts is None and mapping.chunk is None:
            shape = space.shape or ()
            if action.shape == (n, *shape):
                probe(function, given, n, who, space, PolicyError)
        return action

    def _array(self, value: Any, n: int) -> Array:
        """Return what the function returned for n observations as one array."""
        if isinstance(value, Mapping):
            self.must_be_bound()
        if isinstance(self.action_space, Dict | Tuple):
            return checked_actions(value, n, self.action_space, self._who)
        return as_array(value, self._who, PolicyError)

    def states(self) -> Sequence[tuple[tuple[int, ...], Any]]:
        """Return the declared shapes of its state, in float64."""
        return state_shapes(self.mapping, np.float64)

    def source(self) -> dict[str, Any]:
        """Return the function's name, and the mapping."""
        return super().source() | {"name": qualified(self.function)}


def _takes_goal(function: Any) -> Literal["goal", "second"] | None:
    """Return how a function of observations takes a goal, too; None: it does not.

    A second parameter with a default, and of another name, is no goal: ``scale=2.0``.
    """
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of some functions written in C
        return None
    kinds = {p.kind for p in parameters}
    if any(p.name == GOAL and p.kind in _BY_NAME for p in parameters):
        return "goal"
    if required_arguments(function) > 1 or inspect.Parameter.VAR_POSITIONAL in kinds:
        return "second"
    second = list(parameters)[1:2]
    if second and second[0].name == GOAL:  # to be given by its place alone
        return "second"
    return "goal" if inspect.Parameter.VAR_KEYWORD in kinds else None


_BY_NAME = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


@checked_names
def from_function(
    function: Callable[..., Any],
    *,
    sees: Any = None,
    goal: Any = None,
    acts: Any = None,
    every: int = 1,
    chunk: int | None = None,
    state: Any = None,
    observation_space: Any = None,
    action_space: Any = None,
) -> ScriptedPolicy:
    """Return a Python function as a skill's policy; a skill takes the bare function too.

    ```python
    import skillweave as sw

    lean = sw.from_function(lambda obs: (obs[:, 2] > 0).astype(int))
    print(sw.evaluate(lean, "CartPole-v1", episodes=2))
    ```

    With ``state`` the function takes it as its second argument (by the name ``state``, where the
    inputs have names), and returns the action and the next state.

    Args:
        function: maps observations (n, *obs_shape) to actions (n, *action_shape), whole numbers for
            discrete spaces. Keep no state in it: it is called for any environments in any order.
        sees: the parts of the observation that the function takes; see ``from_onnx``.
        goal: the value of ``Goal()`` in ``sees``; see ``from_onnx``.
        acts: the meaning of the result, ``Acts(...)``; None: it is the action.
        every: each action is held for this number of steps.
        chunk: the number of actions that are used of each result (n, H, ...).
        state: the shape of a recurrent state, None as the axis of the environments: (None, 8); or a
            list of shapes. It starts with zeros.
        observation_space: None: the environment's.
        action_space: None: the environment's.

    Returns:
        The policy, for a skill's ``policy`` or ``evaluate``.

    Raises:
        DeclarationError: it is not a function of observations, or an argument is wrong.
    """
    if not callable(function):
        raise DeclarationError(
            f"from_function takes a function of observations, not {short(function)}"
        )
    mapping = mapping_of(
        "from_function()", sees=sees, goal=goal, acts=acts, every=every, chunk=chunk, state=state
    )
    return ScriptedPolicy(function, observation_space, action_space, mapping)
