"""Plain functions as policies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from skillweave.arguments import checked_names
from skillweave.errors import DeclarationError, PolicyError
from skillweave.messages import short
from skillweave.skills.foreign_policy import Foreign, qualified
from skillweave.skills.outputs import as_array, called, checked_actions
from skillweave.skills.probing import probe
from skillweave.types import Array, Memory, read_only


class ScriptedPolicy(Foreign):
    """A function from observations (n, *obs_shape) to actions (n, *action_shape) as a policy."""

    kind = "function"

    def __init__(
        self,
        function: Callable[[Array], Any],
        observation_space: Any = None,
        action_space: Any = None,
    ) -> None:
        self.function = function
        name = getattr(function, "__name__", type(function).__name__)
        super().__init__(f"function {name}()", observation_space, action_space)

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return the function's actions, checked if the action space is known."""
        action = called(self.function, read_only(obs), self._who, kind=PolicyError)
        if self.action_space is None:
            return as_array(action, self._who, PolicyError), memory
        n, shape = len(obs), self.action_space.shape or ()
        actions = checked_actions(action, n, self.action_space, self._who)
        probe(self.function, obs, n, self._who, shape, PolicyError)
        return actions, memory

    def source(self) -> dict[str, Any]:
        """Return the function's name."""
        return {"kind": self.kind, "name": qualified(self.function)}


@checked_names
def from_function(
    function: Callable[[Array], Any], *, observation_space: Any = None, action_space: Any = None
) -> ScriptedPolicy:
    """Return a Python function as a skill's policy; a skill takes the bare function too.

    ```python
    import skillweave as sw

    lean = sw.from_function(lambda obs: (obs[:, 2] > 0).astype(int))
    print(sw.evaluate(lean, "CartPole-v1", episodes=2))
    ```

    Args:
        function: maps observations (n, *obs_shape) to actions (n, *action_shape), whole numbers for
            discrete spaces. Keep no state in it: it is called for any environments in any order.
        observation_space: None: the environment's.
        action_space: None: the environment's.

    Returns:
        The policy, for a skill's ``policy`` or ``evaluate``.

    Raises:
        DeclarationError: it is not a function of observations.
    """
    if not callable(function):
        raise DeclarationError(
            f"from_function takes a function of observations, not {short(function)}"
        )
    return ScriptedPolicy(function, observation_space, action_space)
