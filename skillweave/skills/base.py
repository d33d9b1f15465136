"""What a user declares: skills and reflexes."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np
from gymnasium import Space

from skillweave.arguments import checked_names
from skillweave.errors import DeclarationError, SkillError
from skillweave.messages import short
from skillweave.notebooks import facts, joined
from skillweave.settings import AtLeastOne, NonNegative, Share, annotations_of, fitted
from skillweave.skills.answers import answer
from skillweave.skills.outputs import as_array, called, checked_actions
from skillweave.skills.probing import probe
from skillweave.skills.spelling import misspelt
from skillweave.types import Array, Step

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_\-]{0,63}")
DEVICE = re.compile(r"con|prn|aux|nul|com\d|lpt\d", re.IGNORECASE)
"""What a skill may be named: its name names files, too."""


_OF_TRAINING = ("steps", "task_weight", "target_return", "target_success")


class Skill:
    """An option: where it may start, what it maximises, when it stops.

    Sutton, Precup & Singh 1999, "Between MDPs and semi-MDPs".

    Subclass it and define ``reward``; all else is optional. Where skills and selector learn
    together (the default), a skill also follows the task's advantage, with ``task_weight``.

    Every method is batched: arrays over N environments in, one array (N,) out, so the same class
    runs on one environment and on a thousand. Methods must be functions of their arguments: keep no
    state of an environment in ``self`` (``step`` has the observation before and after).

    Attributes:
        name: used in messages, files and captions; default: the class name in lower case.
        max_steps: the skill stops after so many steps; None: only by ``termination``.
        call_steps: its calls last at most so long, wherever it is trained; None: the hierarchy's.
        steps: training steps where it learns apart; None: its share of ``Hierarchy.steps``.
        task_weight: weight of the task's advantage beside its own reward where skills learn
            together; None: ``Together.task_weight`` (1). 0: it follows its own reward alone, as a
            skill should that other hierarchies will use.
        algorithm: settings of the algorithm that trains it (its network is among them);
            None: the hierarchy's.
        target_return: its training ends early at this mean return of the periodic evaluation (the
            hierarchy's ``eval_every``); None: it takes all its steps.
        target_success: the same for the share of successful episodes, from 0 to 1.
        policy: what acts without being trained: a function of observations (n, *obs_shape), which
            needs no ``staticmethod``, or a method ``policy(self, obs)``; a torch module;
            ``from_sb3(...)``, ``from_onnx(...)``; any ``Policy``. None: it is trained. Where an
            environment tells an action mask, networks that return logits keep to it; what others
            return goes to the environment as it is.
        color: RGB in captions and plots; None: chosen from a palette.
    """

    name: str = ""
    max_steps: AtLeastOne | None = None
    call_steps: AtLeastOne | None = None
    steps: AtLeastOne | None = None
    task_weight: NonNegative | None = None
    algorithm: Any = None
    target_return: float | None = None
    target_success: Share | None = None
    policy: Any = None
    color: tuple[int, int, int] | None = None

    methods: ClassVar[tuple[str, ...]] = ("reward", "initiation", "termination", "success")

    _path: str = ""

    @checked_names
    def __init__(self) -> None:
        super().__init__()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" not in cls.__dict__:
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower().strip("_")

    def __repr__(self) -> str:
        own = [*own_methods(self), *(f"{k}={short(v, 60)}" for k, v in _own_fields(self))]
        return f"<Skill {self.name!r}: {', '.join(own) or 'all defaults'}>"

    def _repr_html_(self) -> str:
        """Return a table of what it declares, for notebooks."""
        rows = [
            ("skill", path_of(self)),
            ("about", about(self)),
            ("defines", ", ".join(own_methods(self)) or "nothing: all defaults"),
            *((name, short(value, 200)) for name, value in _own_fields(self)),
        ]
        return joined([facts((k, v) for k, v in rows if v)])

    def reward(self, step: Step) -> Array:
        """What it maximises in a ``step``, (N,). The default is the environment's own reward."""
        return step.reward

    def initiation(self, obs: Array) -> Array:
        """Where it may start: ``obs`` (N, *obs_shape) to (N,) bool. The default is everywhere."""
        return np.ones(len(obs), bool)

    def termination(self, step: Step) -> Array:
        """Where it stops, after a ``step``: (N,) bool; its value ends there. Default: nowhere."""
        return np.zeros(len(step.reward), bool)

    def success(self, step: Step) -> Array:
        """What counts as having succeeded, (N,) bool, by the last ``step`` before it stops.

        Default: none in evaluations; to automata and trees, that ``termination`` stopped it.
        """
        return np.zeros(len(step.reward), bool)

    def defines(self, method: str) -> bool:
        """Return whether the subclass gives its own version of ``method``."""
        return getattr(type(self), method) is not getattr(Skill, method)

    def validate(self) -> None:
        """Raise a DeclarationError that names what is wrong with the declaration."""
        where = f"skill {short(self.name)} ({type(self).__name__})"
        if not isinstance(self.name, str):
            raise DeclarationError(f"{where}: the name must be text")
        if not self.name:
            raise DeclarationError(f"{where} has no name: set the class attribute 'name'")
        if not NAME.fullmatch(self.name):
            raise DeclarationError(
                f"{where}: the name names files too; use letters, digits, '_' and '-', at most 64"
            )
        if DEVICE.fullmatch(self.name):
            raise DeclarationError(
                f"{where}: the name names files too, and {self.name!r} is a device on Windows; "
                "choose another name"
            )
        kinds = annotations_of(Skill)
        for field in ("max_steps", "call_steps", *_OF_TRAINING):
            value = getattr(self, field)
            found = fitted(kinds[field], value, f"{where}: {field}")
            if found is not value and (self.policy is None or field not in _OF_TRAINING):
                with suppress(AttributeError):  # of a property
                    setattr(self, field, found)
        if self.color is not None and not _is_color(self.color):
            raise DeclarationError(
                f"{where}: color is {short(self.color)}; it must be red, green and blue, each from "
                "0 to 255: color = (230, 80, 60)"
            )
        known = [*Skill.__annotations__.keys() - {"methods", "_path"}, *self.methods]
        for name, meant in misspelt(self, Skill, known):
            warnings.warn(
                f"{where} has {name!r}, which Skillweave does not know: is {meant!r} meant?",
                stacklevel=2,
            )
        for method in self.methods:
            if not callable(getattr(self, method)):
                raise DeclarationError(
                    f"{where}: {method} is {short(getattr(self, method))}; it must be a method"
                )


def _is_color(value: object) -> bool:
    """Return whether a value is red, green and blue, each from 0 to 255."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, tuple | list) or len(value) != 3:
        return False
    return all(isinstance(v, int | np.integer) and 0 <= v <= 255 for v in value)


def about(skill: Skill) -> str:
    """Return the first line of the docstring of a skill's class; "" where it has none."""
    lines = (type(skill).__dict__.get("__doc__") or "").strip().splitlines()
    return lines[0] if lines else ""


def own_methods(skill: Skill) -> list[str]:
    """Return the methods of which a skill has its own version."""
    return [method for method in skill.methods if skill.defines(method)]


def _own_fields(skill: Skill) -> Iterator[tuple[str, Any]]:
    """Yield the settings of a skill that differ from the defaults, but for its name."""
    for field in Skill.__annotations__:
        value = getattr(skill, field)
        if field not in ("name", "methods", "_path") and value is not getattr(Skill, field):
            yield field, value


def path_of(skill: Skill) -> str:
    """What messages call a skill: its name, after those of the hierarchies that it is in."""
    return skill._path or skill.name


class RecordedSkill(Skill):
    """A skill of a run that was loaded without its code: its reward and success are not known."""


@checked_names
class Reflex:
    """A rule that overrides the running skill's action while its condition holds.

    Args:
        condition: observations (N, *obs_shape) to (N,) bool.
        action: the action to take instead, or a function from observations (n, *obs_shape) to
            actions (n, ...).
        name: used in messages and captions; default: the condition's name.

    Raises:
        DeclarationError: the condition is no function, or the name no text.
    """

    def __init__(
        self, condition: Callable[[Array], Array], action: Any, name: str | None = None
    ) -> None:
        if not callable(condition):
            raise DeclarationError(
                f"a Reflex's condition is {short(condition)}; it must be a function of observations"
            )
        if not isinstance(name, str | None):
            raise DeclarationError(f"a Reflex's name is {short(name)}; it must be text")
        self.condition, self.action = condition, action
        self.name = name or getattr(condition, "__name__", "reflex")

    def check(self, space: Space[Any]) -> None:
        """Raise a DeclarationError where a fixed action is none of ``space``."""
        if not callable(self.action):
            self._actions(np.empty((1, 0)), space)

    def apply(self, obs: Array, action: Array, space: Space[Any]) -> tuple[Array, Array]:
        """Each ``action`` (N, ...) in ``space`` with this reflex; (N,) bool: where ``obs`` asks it.

        Raises:
            SkillError: what it answers is not what was asked for; the message names it.
        """
        holds = self.holds(obs)
        if holds.any():
            action = action.copy()
            action[holds] = self._actions(obs[holds], space)
        return action, holds

    def holds(self, obs: Array) -> Array:
        """Evaluate its condition: ``obs`` (N, *obs_shape) to (N,) bool.

        Raises:
            SkillError: the condition returned something else; the message names it.
        """
        return answer(self.condition, obs, len(obs), bool, self._who, "condition")

    def fixed(self, space: Space[Any]) -> Array:
        """Its action, where that is no function, as one of ``space``; (...)."""
        who, shape = f"{self._who}: action", space.shape or ()
        one = as_array(self.action, who, DeclarationError)
        # A number fills a row: Reflex(leaning, 0.5) in a Box of one dimension.
        value = np.full(shape, one) if one.shape == () else one
        found: Array = checked_actions(value[None], 1, space, who, DeclarationError)[0]
        return found

    @property
    def _who(self) -> str:
        return f"reflex {self.name!r}"

    def _actions(self, obs: Array, space: Space[Any]) -> Array:
        """Its actions for observations (n, ...)."""
        n, who = len(obs), f"{self._who}: action"
        if not callable(self.action):
            return np.repeat(self.fixed(space)[None], n, axis=0)
        answered = called(self.action, obs, f"{who}()")
        actions = checked_actions(answered, n, space, f"{who}()", SkillError)
        probe(self.action, obs, n, f"{who}()", space.shape or ())
        return actions


def apply_reflexes(
    reflexes: tuple[Reflex, ...], obs: Array, action: Array, space: Space[Any]
) -> tuple[Array, Array]:
    """Return the actions with every reflex in force, and (n,) bool: where one of them acted.

    Where several hold, the last one counts.
    """
    overridden = np.zeros(len(obs), bool)
    for reflex in reflexes:
        action, holds = reflex.apply(obs, action, space)
        overridden |= holds
    return action, overridden


def asked(
    skill: Skill,
    method: str,
    about: Step | Array,
    n: int,
    elapsed: Array | int | None = None,
    ids: Array | None = None,
) -> Array:
    """What a method of a skill says about a step or observations: (n,) float32 or bool.

    Raises:
        SkillError: as of ``answer``.
    """
    dtype = np.float32 if method == "reward" else bool
    who = f"skill {path_of(skill)!r}"
    return answer(getattr(skill, method), about, n, dtype, who, method, elapsed, ids)
