"""Terms of a policy's observation, as its training names them, as entries of ``sees``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from skillweave._internal.messages import short, suggest
from skillweave.errors import DeclarationError, PolicyError
from skillweave.robots.read_mapping import ReadTerm
from skillweave.robots.robot_keys import JointOrder, Places, RobotKeys, plain_places
from skillweave.skills.fit_mapping import places_in
from skillweave.skills.mapping import (
    Elapsed,
    Goal,
    LastAction,
    Part,
    Source,
    Table,
    as_source,
    is_places,
)

COMMANDS = ("velocity_commands", "keyboard_velocity_commands", "command", "twist")
"""Names of a command: forward, left, and the turn."""
LAST = ("last_action", "actions")
"""Names of the last output."""
ANGLES, SPEEDS = "joint angles", "joint speeds"
TERMS = {
    "base_ang_vel": "angular velocity",
    "projected_gravity": "gravity",
    "base_lin_vel": "linear velocity",
    "joint_pos_rel": ANGLES,
    "joint_pos": ANGLES,
    "joint_vel_rel": SPEEDS,
    "joint_vel": SPEEDS,
}
"""The quantity of each usual name of a term."""
KEYS = {
    "angular velocity": ("base_ang_vel", "gyro", "ang_vel", "angular_velocity", "imu_ang_vel"),
    "gravity": ("projected_gravity", "gravity", "gravity_vec", "gravity_orientation"),
    "linear velocity": ("base_lin_vel", "lin_vel", "velocity", "linear_velocity"),
    ANGLES: ("joint_pos", "joints", "q", "dof_pos", "joint_positions", "joint_angles"),
    SPEEDS: ("joint_vel", "speeds", "dq", "dof_vel", "joint_velocities", "joint_speeds"),
}
"""The usual keys of each quantity in an environment."""
MOTION = "the reference's {}, as the robot sees it since the call began: no data say it, write a "
MOTION += "function of observations and call that returns (n, {})"
HINTS = {
    "motion_command": "the angles and speeds of a reference: sw.Table(motion)",
    "motion_anchor_ori_b": MOTION.format("orientation", 6),
    "motion_anchor_pos_b": MOTION.format("place", 3),
}
"""What terms are that no environment has."""
WIDTH = 3
"""The numbers of a velocity, of gravity and of a command."""


@dataclass(frozen=True)
class Term:
    """A term of a policy's observation, as a file has it.

    Attributes:
        name: its name.
        settings: of its entry of ``sees``: scale, clip, history, layout.
        sources: the field of the file, by setting.
        numbers: how many; None: the file does not say it.
        joints: the policy's joints of which it is; None: all.
        relative: the default pose is subtracted.
        entry: the whole entry, or several, if the file decides it.
    """

    name: str
    settings: dict[str, Any]
    sources: dict[str, str] = field(default_factory=dict)
    numbers: int | None = None
    joints: Places | None = None
    relative: bool = False
    entry: Source | tuple[Source, ...] | None = None


@dataclass(frozen=True)
class TermReader:
    """A reader of terms, for one environment.

    Attributes:
        file: the name of the file, for messages.
        robot: the environment.
        joints: the policy's joints in it.
        names: the user's entries, by term.
        outputs: the numbers of the policy's output.
    """

    file: str
    robot: RobotKeys
    joints: JointOrder
    names: Mapping[str, Any]
    outputs: int

    def read(self, terms: Sequence[Term]) -> list[ReadTerm]:
        """Return the entries of ``sees`` of an input.

        Raises:
            DeclarationError: a term is unknown, or ``names`` has a wrong entry.
            PolicyError: numbers do not add up.
        """
        found: list[ReadTerm] = []
        unknown: list[str] = []
        for term in terms:
            if term.name in self.names or isinstance(term.entry, tuple):
                found += self._given(term, self.names.get(term.name, term.entry))
            elif (entry := self._usual(term)) is not None:
                found.append(self._checked(term, entry, dict(term.sources)))
            else:
                hint = HINTS.get(term.name)
                unknown.append(f"{term.name!r}{f' ({hint})' if hint else ''}")
        if unknown:
            first = unknown[0].split("'")[1]
            raise DeclarationError(
                f"{self.file}: it is unknown where the policy sees {', '.join(unknown)}; the "
                f"environment has the keys {self._keys()}: write names={{{first!r}: ...}}, with a "
                "key, places, a Part, a Table or a function of observations for each"
            )
        return found

    def check_names(self, terms: Sequence[Term]) -> None:
        """Raise a DeclarationError where ``names`` has a name that is no term."""
        known = [term.name for term in terms]
        for name in self.names:
            if name not in known:
                raise DeclarationError(
                    f"names has {short(name)}, which is no term of {self.file}"
                    f"{suggest(name, known)}"
                )

    def _keys(self) -> str:
        return ", ".join(f"{key!r} ({n})" for key, n in self.robot.sizes.items() if key) or "none"

    def _given(self, term: Term, value: Any) -> list[ReadTerm]:
        """Return the user's entry, or entries, of a term; the file's settings fill the others."""
        where = f"names[{term.name!r}]"
        several = isinstance(value, list | tuple) and not is_places(value)
        entries = [as_source(x, where) for x in (value if several else [value])]
        sources = {"entry": where}
        if len(entries) == 1:
            entry = self._filled(term, entries[0], where)
            kept = sources | {k: x for k, x in term.sources.items() if hasattr(entry, k)}
            mine = [k for k in kept if k in term.settings and getattr(entry, k) != term.settings[k]]
            return [self._checked(term, entry, kept | dict.fromkeys(mine, where))]
        wide = [k for k, x in term.settings.items() if isinstance(x, tuple) and k != "clip"]
        if wide or term.settings.get("history", 1) > 1:
            raise DeclarationError(
                f"{self.file} has a {wide[0] if wide else 'history'} of the whole term "
                f"{term.name!r}, which {len(entries)} entries of sees cannot have: give one, "
                f"names={{{term.name!r}: ...}}"
            )
        plain = replace(term, numbers=None)
        read = [self._checked(plain, self._filled(term, x, where), sources) for x in entries]
        total = [x.numbers for x in read if x.numbers is not None]
        if len(total) == len(read) and term.numbers not in (None, sum(total)):
            raise PolicyError(f"{where} has {sum(total)} numbers, {self._wants(term)}")
        return read

    def _filled(self, term: Term, entry: Source, where: str) -> Source:
        """Return an entry with the file's settings, where it has none of its own."""
        settings = dict(term.settings)
        if TERMS.get(term.name) in (ANGLES, SPEEDS) and isinstance(entry, Part):
            settings |= self._of_joints(term)
        defaults: dict[str, Any] = {x.name: x.default for x in fields(entry)}
        if settings.get("history", 1) > 1 and "history" not in defaults:
            raise DeclarationError(
                f"{where} is a {type(entry).__name__}, but {self.file} has a history of "
                f"{settings['history']} of {term.name}: give a key, or a Part"
            )
        known = {k: x for k, x in settings.items() if k in defaults}
        return replace(
            entry, **{k: x for k, x in known.items() if getattr(entry, k) == defaults[k]}
        )

    def _of_joints(self, term: Term) -> dict[str, Any]:
        """Return places and offset of a term of joints."""
        chosen = range(len(self.joints.places)) if term.joints is None else term.joints
        places = tuple(self.joints.places[i] for i in chosen)
        found: dict[str, Any] = {"places": plain_places(places, self.joints.count)}
        if term.relative:
            found["offset"] = plain([self.joints.pose[i] for i in chosen])
        return {k: x for k, x in found.items() if x is not None}

    def _usual(self, term: Term) -> Source | None:
        """Return the entry of a term with a usual name; None: it has none."""
        if isinstance(term.entry, Source):
            return self._filled(term, term.entry, term.name)
        if term.name in COMMANDS or term.name in LAST:
            return self._filled(term, Goal() if term.name in COMMANDS else LastAction(), term.name)
        quantity = TERMS.get(term.name)
        if quantity is None:
            return None
        of_joints = quantity in (ANGLES, SPEEDS)
        wanted = self.joints.count if of_joints else (term.numbers or WIDTH)
        named = [
            key for key in self.robot.sizes if key.rpartition(".")[2].lower() in KEYS[quantity]
        ]
        fitting = [key for key in named if self.robot.sizes[key] == wanted]
        if not named:
            return None
        if len(fitting) > 1:
            raise DeclarationError(
                f"{self.file}: {term.name} may be any of {', '.join(map(repr, fitting))} of the "
                f"environment: write names={{{term.name!r}: {fitting[0]!r}}}"
            )
        if not fitting:
            n = self.robot.sizes[named[0]]
            whose = f"the robot has {wanted} joints" if of_joints else f"it has {wanted} numbers"
            raise PolicyError(
                f"{self.file}: {term.name} is of {quantity}, and {whose}, but the environment's "
                f"{named[0]!r} has {n} numbers: write names={{{term.name!r}: Part({named[0]!r}, "
                "places)}"
            )
        return self._filled(term, Part(fitting[0]), term.name)

    def _checked(self, term: Term, entry: Source, sources: dict[str, str]) -> ReadTerm:
        """Return a term with its entry, whose numbers add up."""
        numbers = self._numbers(term, entry)
        if None not in (numbers, term.numbers) and numbers != term.numbers:
            what = repr(entry.key) if isinstance(entry, Part) else f"{type(entry).__name__}()"
            raise PolicyError(
                f"{self.file}: {what} gives {numbers} numbers, {self._wants(term)}: write "
                f"names={{{term.name!r}: ...}}"
            )
        if isinstance(entry, Part) and TERMS.get(term.name) in (ANGLES, SPEEDS):
            own = self.joints.sources
            sources |= {k: own[k] for k in ("places",) if entry.places is not None and k in own}
            sources |= {k: own[k] for k in ("offset",) if term.relative and k in own}
        return ReadTerm(term.name, entry, numbers if numbers else term.numbers, sources)

    def _wants(self, term: Term) -> str:
        return f"but {term.name} has {term.numbers} by {self.file}"

    def _numbers(self, term: Term, entry: Source) -> int | None:
        """Return how many numbers an entry has; None: unknown."""
        if isinstance(entry, Part):
            size = sum(
                n
                for key, n in self.robot.sizes.items()
                if not entry.key or f"{key}.".startswith(f"{entry.key}.")
            )
            if not size:
                raise DeclarationError(
                    f"names[{term.name!r}] reads {entry.key!r}, which the environment does not "
                    f"have; it has the keys {self._keys()}"
                )
            return len(places_in(entry.places, size, f"names[{term.name!r}].places"))
        if isinstance(entry, Goal):
            return term.numbers or WIDTH
        if isinstance(entry, Table):
            columns = entry.file.numbers.shape[1]
            return len(places_in(entry.columns, columns, f"names[{term.name!r}].columns"))
        if isinstance(entry, LastAction):
            return self.outputs
        return int(np.size(entry.first)) if isinstance(entry, Elapsed) else None


def plain(values: Sequence[float] | float) -> float | tuple[float, ...]:
    """Return one number for a list of equal ones."""
    if isinstance(values, int | float):
        return float(values)
    return float(values[0]) if len(set(values)) == 1 else tuple(map(float, values))
