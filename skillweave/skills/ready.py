"""Values of the attribute ``policy`` of a skill, converted to policies."""

from __future__ import annotations

import inspect
import sys
from types import MethodType
from typing import Any

from skillweave.errors import DeclarationError
from skillweave.messages import short
from skillweave.skills.base import Skill, is_trained
from skillweave.skills.goal_spaces import GOAL
from skillweave.skills.outputs import required_arguments
from skillweave.skills.scripted import from_function
from skillweave.skills.torch_module import from_torch
from skillweave.types import Policy


def ready_policy(skill: Skill) -> Policy | None:
    """Return a skill's ready policy, converted from a function or module; None: it is trained.

    Raises:
        DeclarationError: the attribute ``policy`` cannot act.
    """
    value: Any = skill.policy
    if is_trained(skill):
        return None
    where = f"skill {skill.name!r}: policy is"
    if isinstance(value, type):
        raise DeclarationError(f"{where} the class {value.__name__}, not a policy")
    if hasattr(value, "act") and hasattr(value, "start"):
        policy: Policy = value
        return policy
    torch = sys.modules.get("torch")  # imported if the user has a module
    if torch is not None and isinstance(value, torch.nn.Module):
        return from_torch(value)
    # A function in a class body becomes a method when it is looked up. It is a method if it needs
    # two arguments (``def policy(self, obs)``), and a function of obs if it needs one.
    bound = isinstance(value, MethodType) and value.__self__ is skill
    if bound and not _is_method(value.__func__, skill):
        value = value.__func__
    if callable(value):
        return from_function(value)
    raise DeclarationError(
        f"{where} {short(value)}, which cannot act; give a function of observations, a torch "
        "module, from_sb3(...), from_onnx(...), or a policy"
    )


def _is_method(function: Any, skill: Skill) -> bool:
    """Return whether a function in a class body takes the skill as its first argument.

    Where the skill has goals, it also takes a goal: ``policy(self, obs, goal)``, or
    ``policy(obs, goal)``.

    Raises:
        DeclarationError: the skill has goals, and it may be ``(self, obs)`` or ``(obs, goal)``.
    """
    required = required_arguments(function)
    if skill.goal_space is None:
        return required >= 2
    try:
        names = list(inspect.signature(function).parameters)
    except (TypeError, ValueError):  # of some functions written in C
        return False
    if names[:1] == ["self"] or required >= 3:
        return True
    if required == 2 and GOAL not in names:
        raise DeclarationError(
            f"skill {skill.name!r}: its policy takes ({', '.join(names)}), which may be (self, "
            "obs) or (obs, goal): give the parameters these names, policy(self, obs, goal)"
        )
    return required == 2 and names.index(GOAL) > 1
