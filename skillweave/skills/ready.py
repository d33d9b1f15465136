"""Values of the attribute ``policy`` of a skill, converted to policies and fitted to spaces."""

from __future__ import annotations

import sys
from pathlib import Path
from types import MethodType
from typing import Any

from gymnasium import Space

from skillweave._internal.messages import short
from skillweave._internal.policy_protocol import Policy, is_policy
from skillweave.errors import DeclarationError, PolicyError, SkillweaveError, reworded
from skillweave.extensions import fetch_from, names_of
from skillweave.policies.parts import GOAL
from skillweave.skills.base import Skill, is_trained
from skillweave.skills.foreign_policy import fitted
from skillweave.skills.goal_spaces import goal_part, other_goals, with_goal, without_goal
from skillweave.skills.goals import goals_of
from skillweave.skills.outputs import parameters_of, required_arguments
from skillweave.skills.own_part import OwnPart, file_of
from skillweave.skills.residual import Residual, correction, refuse_skill
from skillweave.skills.scripted import from_function
from skillweave.skills.torch_module import from_torch


def ready_policy(skill: Skill) -> Policy | None:
    """Return a skill's ready policy, converted from a function or module; None: it is trained.

    Raises:
        DeclarationError: the attribute ``policy`` cannot act.
    """
    if isinstance(skill.policy, str | Path):
        skill.policy = _as_policy(skill.policy, skill)  # so that the file is read once
    return None if is_trained(skill) else _as_policy(skill.policy, skill)


def _as_policy(value: Any, skill: Skill) -> Policy:
    """Return the value of a skill's attribute ``policy`` as a policy; a method may be one."""
    # A function in a class body becomes a method when it is looked up. It is a method if it needs
    # two arguments (``def policy(self, obs)``), and a function of obs if it needs one.
    bound = isinstance(value, MethodType) and value.__self__ is skill
    if bound and not _is_method(value.__func__, skill):
        value = value.__func__
    return as_policy(value, f"skill {skill.name!r}: policy")


def as_policy(value: Any, where: str) -> Policy:
    """Return a policy as it is; a torch module, a function or a file as one that acts.

    Raises:
        DeclarationError: it cannot act; ``where`` begins the message.
    """
    refuse_skill(value, where)
    if isinstance(value, type):
        raise DeclarationError(f"{where} is the class {value.__name__}, not a policy")
    if is_policy(value):
        policy: Policy = value
        return policy
    torch = sys.modules.get("torch")  # imported if the user has a module
    if torch is not None and isinstance(value, torch.nn.Module):
        return from_torch(value)
    if callable(value):
        return from_function(value)
    own = getattr(value, "policy", None)
    if is_policy(own):  # of a run, or of a skill that is ready
        raise DeclarationError(
            f"{where} is {short(value)}, which has a policy, but is none: write its .policy"
        )
    advice = (
        "give a function of observations, a torch module, from_sb3(...), from_onnx(...), or a "
        "policy"
    )
    if hasattr(value, "predict") and hasattr(value, "observation_space"):
        advice = "a model of Stable-Baselines3 acts by from_sb3(model)"
    elif isinstance(value, str | Path):
        suffix = Path(value).suffix
        if suffix[1:] in names_of("reader"):
            return _read(value, suffix[1:], where)
        if make := FILES.get(suffix):
            advice = f"a file acts by {make.format(str(value))}"
    raise DeclarationError(f"{where} is {short(value)}, which cannot act; {advice}")


def _read(path: str | Path, kind: str, where: str) -> Policy:
    """Return the policy in a file, by the reader of its ``kind``.

    Raises:
        SkillweaveError: the file is missing or wrong; ``where`` begins the message.
    """
    try:
        policy: Policy = fetch_from("reader", kind)(path)
    except SkillweaveError as error:
        raise reworded(error, f"{where}: {error}") from error
    return policy


FILES = {
    ".zip": "from_sb3({!r}, algorithm, trust=True)",
    ".pt": "from_torch({!r}, trust=True)",
    ".pt2": "from_torch({!r}, trust=True)",
}
"""Calls that make a policy of a file which may run code, by its suffix."""


PART = ", of which the skill has a part (sees, acts),"
"""Follows the name of an environment in messages."""


def fitted_to_skill(
    policy: Policy,
    skill: Skill | None,
    observation_space: Space[Any],
    action_space: Space[Any],
    who: str,
    env: str,
) -> Policy:
    """Return the ready policy of a skill, fitted to the skill's spaces.

    Args:
        skill: None: it is a selector's.
        observation_space: with the goal, where the skill has goals.
        action_space: of its actions.
        who: begins messages.
        env: the name of the environment.

    Raises:
        PolicyError: it does not fit.
    """
    from skillweave.spaces import same_space  # needs torch, which declaring a skill does not

    goals = goals_of(skill)
    seen = policy.observation_space
    if goals is not None:
        if seen is not None and same_space(seen, observation_space):  # as saved here, for example
            if says := other_goals(goal_part(seen), goals.goal_space):
                raise PolicyError(f"{who}: its policy {says}")
        elif hasattr(policy, "bind_with_goals"):
            plain = without_goal(observation_space)
            policy = policy.bind_with_goals(plain, action_space, who, goals)
        else:
            raise PolicyError(
                f"{who} has goals, but its policy observes {seen}: one for it observes the goal, "
                f"too, as {observation_space}; or give a function, policy(self, obs, goal), or a "
                "policy from elsewhere with Goal() at its place in sees"
            )
    return fitted(policy, observation_space, action_space, who, env)


def has_part(skill: Skill) -> bool:
    """Return whether a skill's learner or policy has a part of observations or actions alone."""
    changed = isinstance(skill.policy, Residual) or file_of(skill) is not None
    return skill.sees is not None or skill.acts is not None or changed


def own_part(
    skill: Skill, rest: Any, spaces: tuple[Space[Any], Space[Any]], who: str, env: str
) -> OwnPart:
    """Return a skill's own part of observations and actions.

    Args:
        rest: of its hierarchy.
        spaces: the environment's, of observations and actions.
        who: begins messages.
        env: the name of the environment.

    Raises:
        DeclarationError: the part does not fit the environment's spaces.
        PolicyError: the ready policy that it corrects does not.
    """
    part = OwnPart(skill, rest, *spaces, who)
    residual, seen = skill.policy, part.observation_space
    if not isinstance(residual, Residual):
        return part
    added = correction(residual.scale, part.action_space, who)
    base = _as_policy(residual.policy, skill)
    if skill.goal_space is not None:
        seen = with_goal(seen, skill.goal_space)
    env += "" if skill.sees is None and skill.acts is None else PART
    fit = fitted_to_skill(base, skill, seen, part.action_space, who, env)
    part.correct(fit, added)
    return part


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
    names = [p.name for p in parameters_of(function)]
    if names[:1] == ["self"] or required >= 3:
        return True
    if required == 2 and GOAL not in names:
        raise DeclarationError(
            f"skill {skill.name!r}: its policy takes ({', '.join(names)}), which may be (self, "
            "obs) or (obs, goal): give the parameters these names, policy(self, obs, goal)"
        )
    return required == 2 and names.index(GOAL) > 1
