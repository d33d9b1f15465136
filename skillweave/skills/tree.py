"""Behaviour trees as selectors: ``Sequence``, ``Fallback`` and ``Condition``; leaves are skills.

```python
from skillweave import tree


def has_key(obs):
    return obs[:, 1] == 1


selector = tree.Sequence(
    tree.Fallback(has_key, "get_key"),
    "open_door",
    "leave",
)
```

Text is a skill's name; a function of observations (n, *obs_shape) to (n,) bool is a condition. A
skill that has goals stands with its goal, ``("go_to", (0.5, 1.0))``: an element of its
``goal_space``, or a function of observations (n, *obs_shape) that returns goals (n, *goal_shape).

The tree is evaluated only where a call is over. A skill's leaf is RUNNING during its call, SUCCESS
if the call succeeded (by the skill's ``success``; without it, by its ``termination``), and FAILURE
if it ended otherwise: at a limit (``max_steps``, ``call_steps``) without success. A skill that may
not start is FAILURE at once. When the whole tree is SUCCESS or FAILURE, it starts again from its
root. Terms as in Colledanchise & Ögren 2018, "Behavior Trees in Robotics and AI".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave.errors import DeclarationError
from skillweave.policies.core import Array
from skillweave.policies.selectors import Status as Status, function_name, skill_and_goal
from skillweave.schema import fitted


@checked_names
class Condition:
    """A function of observations (n, *obs_shape) to (n,) bool: SUCCESS where it holds.

    Args:
        function: evaluated where a call is over.
        name: used in messages; default: the function's name.

    Raises:
        DeclarationError: it is not a function of observations.
    """

    def __init__(self, function: Callable[[Array], Any], name: str = "") -> None:
        if not callable(function) or isinstance(function, type):
            raise DeclarationError(
                f"tree: a Condition is {short(function)}; it must be a function of observations"
            )
        self.function = function
        self.name = name or function_name(function)


@checked_names
class Composite:
    """A node with children: a ``Sequence`` or a ``Fallback``.

    Args:
        children: skills' names (with a goal: ``(name, goal)``), conditions (or bare functions),
            sequences and fallbacks.
        memory: continue with the running child; else begin with the first child at each evaluation,
            so conditions before it are evaluated again, and skills before it are called again.

    Raises:
        DeclarationError: it has no children, or a child of a wrong type.
    """

    def __init__(
        self,
        *children: str | tuple[str, Any] | Callable[[Array], Any] | Condition | Composite,
        memory: bool = True,
    ) -> None:
        where = f"tree: {type(self).__name__}"
        if not children:
            raise DeclarationError(f"{where} has no children: give skills' names or conditions")
        self.children = tuple(_child(c, where) for c in children)
        self.memory = fitted(bool, memory, f"{where}: memory")


class Sequence(Composite):
    """A node that runs its children one after another, as long as they succeed.

    FAILURE as soon as one fails, SUCCESS when all have succeeded. ``children`` and ``memory`` are
    as in ``Composite``.

    Raises:
        DeclarationError: it has no children, or a child that is not a name, a condition, a sequence
            or a fallback.
    """


class Fallback(Composite):
    """A node that runs its children one after another until one succeeds; also called a selector.

    SUCCESS as soon as one succeeds, FAILURE when all have failed. ``children`` and ``memory`` are
    as in ``Composite``.

    Raises:
        DeclarationError: it has no children, or a child that is not a name, a condition, a sequence
            or a fallback.
    """


Node = str | tuple[str, Any] | Condition | Composite


def _child(child: Any, where: str) -> Node:
    """Return a declared child of a behaviour tree as a node."""
    if isinstance(child, str | Condition | Composite) or skill_and_goal(child)[1] is not None:
        node: Node = child
        return node
    if callable(child) and not isinstance(child, type):
        return Condition(child)
    raise DeclarationError(
        f"{where} has the child {short(child)}; give a skill's name, a condition, a Sequence or a "
        "Fallback"
    )
