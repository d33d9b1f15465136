"""Plain functions as policies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, Literal

from gymnasium.spaces import Dict, Tuple

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave.errors import DeclarationError, PolicyError
from skillweave.policies.core import Array, Memory, RowPolicy, Turn, read_only
from skillweave.policies.mapped import Function
from skillweave.policies.parts import GOAL
from skillweave.skills.foreign_policy import qualified
from skillweave.skills.mapped import MappedPolicy
from skillweave.skills.mapping import (
    PolicyMapping,
    are_names,
    function_name,
    mapping_of,
    takes_call,
)
from skillweave.skills.outputs import (
    Wrapped,
    as_array,
    call_user,
    parameters_of,
    required_arguments,
)


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
        # How it takes a skill's goal: by the name goal, or as its second argument; "": not.
        self._with_goal: Literal["goal", "second", ""] = ""
        if mapping is None or not (mapping.sees or mapping.state):
            self._with_goal = _takes_goal(function)
        name = getattr(function, "__name__", type(function).__name__)
        super().__init__(f"function {name}()", observation_space, action_space, mapping)

    @property
    def model(self) -> Function:
        """The function, which is asked with all that helps when it fails."""
        mapping = self.mapping
        takes_goal = self._with_goal if self.joins else ""
        how = mapping.state, mapping.single_state, takes_goal, self._who
        return Function(Wrapped(self.function, self._ask), *how)

    @cached_property
    def in_place(self) -> RowPolicy:  # type: ignore[override]
        """The policy that acts: the function alone, while its action space is not known."""
        if self.action_space is None and self.mapping == PolicyMapping():
            return _Alone(self._ask)
        return super().in_place

    @property
    def takes_goal(self) -> bool:
        """Return whether the goal of a skill is an argument or an input of it."""
        return bool(self._with_goal) or super().takes_goal

    advice = (
        "let the function take it by this name, policy(obs, goal), or write Goal() at its place in "
        "sees"
    )

    def source(self) -> dict[str, Any]:
        """Return the function's name, and the mapping."""
        return super().source() | {"name": qualified(self.function)}

    def _ask(self, *given: Any, **named: Any) -> Any:
        """Return the function's result for its inputs, and perhaps for a goal or a state."""
        who = self._who
        mapping = self.mapping
        space = self.action_space
        first, more = (given[0], given[1:]) if given else (None, ())
        looks = all(shape[0] is None for shape in mapping.state)
        value = call_user(
            self.function, first, who, kind=PolicyError, more=more, named=named, looks=looks
        )
        if not given:
            return value
        if mapping.state and isinstance(value, tuple | list) and len(value) == 2:
            output, after = value
            several = not mapping.single_state and isinstance(after, tuple | list)
            arrays = [as_array(x, who, PolicyError) for x in (after if several else (after,))]
            after = arrays if several else arrays[0]
            dicts = isinstance(space, Dict | Tuple)
            return output if dicts else as_array(output, who, PolicyError), after
        if mapping.state or isinstance(space, Dict | Tuple):
            return value
        if isinstance(value, Mapping):
            self.must_be_bound()
        return as_array(value, who, PolicyError)


class _Alone(RowPolicy):
    """A function whose action space is not known."""

    def __init__(self, function: Callable[[Array], Any]) -> None:
        self._function = function

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the function's actions for observations."""
        action: Array = self._function(read_only(obs))
        return action


def _takes_goal(function: Any) -> Literal["goal", "second", ""]:
    """Return how a function of observations takes a goal, too; "": it does not.

    A second parameter with a default, and of another name, is no goal: ``scale=2.0``.
    """
    parameters = parameters_of(function)
    if any(
        p.name == GOAL and p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) for p in parameters
    ):
        return "goal"
    # It may be given by its place alone.
    second = [p.name for p in parameters[1:2]] == [GOAL] or required_arguments(function) > 1
    if second or any(p.kind is p.VAR_POSITIONAL for p in parameters):
        return "second"
    return "goal" if any(p.kind is p.VAR_KEYWORD for p in parameters) else ""


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
    anew: Any = (),
    entry: int = 0,
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
        anew: what begins anew where the skill is called again at once: "state", "last_action",
            "held" (of ``every`` and ``chunk``), "elapsed" (clocks, tables and ``call``; with
            ``every`` name "held", too), "history", or several. The rest goes on; after another
            skill's call all begins anew.
        entry: the step at which time starts where the skill takes over, of ``Elapsed``, ``Table``
            and ``call`` in ``sees``: a motion is entered in its middle.
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
    if are_names(state) or isinstance(state, Mapping):
        raise DeclarationError(
            f"from_function(): state is {short(state)}, which has names: give the shape of the "
            "state, (None, 8)"
        )
    if takes_call(function) and not (isinstance(sees, Mapping) and "call" in sees):
        raise DeclarationError(
            f"from_function(): {function_name(function)} takes call, which only functions in sees "
            "get: let one of these return what the call says, as an input"
        )
    mapping = mapping_of(
        "from_function()", sees, goal, acts, every, chunk, state, anew=anew, entry=entry
    )
    return ScriptedPolicy(function, observation_space, action_space, mapping)
