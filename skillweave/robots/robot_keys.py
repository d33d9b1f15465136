"""What a robot's environment has: the keys of its observation, its action, and names of joints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import short
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError, PolicyError
from skillweave.policies.spaces import space_of

SLIDE = 2
"""MuJoCo's lowest number of a kind of joint with one angle or length: slides and hinges."""
Places = tuple[int, ...]
"""Places of numbers, counted from 0."""


@dataclass(frozen=True)
class RobotKeys:
    """The keys of an environment's observation, its action, and its joints.

    Attributes:
        name: the environment's.
        sizes: the numbers of each key; of a Box the key is "".
        actions: the numbers of the action.
        joints: names of joints in the environment's order; empty: unknown.
    """

    name: str
    sizes: dict[str, int]
    actions: int
    joints: tuple[str, ...]


@dataclass(frozen=True)
class JointOrder:
    """The joints of a policy in an environment.

    Attributes:
        places: of each joint of the policy, in its order, among the environment's joints.
        count: the environment's joints.
        pose: the default angle of each joint of the policy.
        sources: the field of the file from which ``places`` and ``offset`` are.
    """

    places: Places
    count: int
    pose: tuple[float, ...]
    sources: dict[str, str]

    def gains(self, values: Sequence[float]) -> Any:
        """Return gains, given in the policy's order, in the environment's; NaN: not given."""
        found = np.full(self.count, np.nan)
        found[list(self.places)] = values
        return found


def read_robot(env: Any) -> RobotKeys:
    """Make an environment, and return what it has.

    Args:
        env: an ``EnvSpec``, a Gymnasium id, or a function that makes an environment.

    Raises:
        EnvError: it cannot be made.
        PolicyError: its actions are no Box.
    """
    spec = env if isinstance(env, EnvSpec) else EnvSpec(env)
    with global_generators(Seeds(0) / "joints"), closing(spec.make()) as made:
        if not isinstance(made.action_space, gym.spaces.Box):
            raise PolicyError(
                f"{spec.name} has the actions {made.action_space}; targets of joints need a Box"
            )
        leaves = space_of(made.observation_space).leaves
        sizes = {".".join(path): math.prod(leaf.shape) for path, leaf in leaves.items()}
        names = _joint_names(made)
        return RobotKeys(spec.name, sizes, math.prod(made.action_space.shape), names)


def _joint_names(env: gym.Env[Any, Any]) -> tuple[str, ...]:
    """Return the attribute ``joint_names``, or names in MuJoCo's model; nothing: unknown."""
    try:
        names: Any = env.get_wrapper_attr("joint_names")
    except AttributeError:
        try:
            model: Any = env.unwrapped.model  # type: ignore[attr-defined]
            movable = np.flatnonzero(np.asarray(model.jnt_type) >= SLIDE).tolist()
            names = [model.joint(i).name for i in movable]
        except (AttributeError, TypeError):
            return ()
    if isinstance(names, str) or not isinstance(names, Sequence):
        return ()
    good = all(isinstance(name, str) and name for name in names) and len(set(names)) == len(names)
    return tuple(names) if good else ()


def checked_joints(joints: Any, who: str) -> tuple[str, ...]:
    """Return names of joints that a user gives; none: ().

    Raises:
        DeclarationError: they are no different texts.
    """
    if joints is None:
        return ()
    names = () if isinstance(joints, str) or not isinstance(joints, Sequence) else tuple(joints)
    texts = [name for name in names if isinstance(name, str) and name]
    if not texts or len(texts) < len(names) or len(set(texts)) < len(texts):
        raise DeclarationError(
            f"{who}: joints is {short(joints)}; it must be a list of different names"
        )
    return tuple(texts)


def places_by_name(wanted: Sequence[str], there: Sequence[str], what: str, where: str) -> Places:
    """Return the place of each wanted joint among those that are there.

    Args:
        what: the wanted names, for messages: "spin.onnx: joint_names".
        where: the names that are there: "the environment".

    Raises:
        PolicyError: a joint is not there.
    """
    if missing := [name for name in wanted if name not in there]:
        raise PolicyError(
            f"{what} has {short(missing[0])}{_more(missing)}, but the joints of {where} are "
            f"{short(list(there), 300)}: give joints=, names that agree"
        )
    return tuple(there.index(name) for name in wanted)


def ends(names: Sequence[str]) -> str:
    """Return the first and the last of names, for messages."""
    return ", ".join(names) if len(names) < 4 else f"{names[0]}, {names[1]}, ..., {names[-1]}"


def _more(names: Sequence[str]) -> str:
    return f" and {len(names) - 1} more" if len(names) > 1 else ""


def action_places(places: Places, robot: RobotKeys, file: str, unsaid: list[str]) -> Any:
    """Return the places of outputs in the action, for ``Acts.to``; note those that are left.

    Raises:
        PolicyError: the action has fewer numbers.
    """
    if max(places) >= robot.actions:
        raise PolicyError(
            f"{file} writes {len(places)} joints up to place {max(places)}, but the action of "
            f"{robot.name} has {robot.actions} numbers"
        )
    if len(places) < robot.actions:
        unsaid.append(
            f"who holds the other {robot.actions - len(places)} numbers of the action: "
            'read["acts"] = dataclasses.replace(read["acts"], rest=...)'
        )
    return plain_places(places, robot.actions)


def plain_places(places: Places, size: int) -> Any:
    """Return places in the shortest form: None for all, a slice, or the places."""
    if places == tuple(range(size)):
        return None
    return slice(0, len(places)) if places == tuple(range(len(places))) else places
