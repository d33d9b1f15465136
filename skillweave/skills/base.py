"""The classes that a user declares: skills and reflexes."""

from __future__ import annotations

import inspect
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, cast

import numpy as np
from gymnasium import Space

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave._internal.notebooks import facts, joined
from skillweave.errors import DeclarationError, SkillError
from skillweave.policies.core import Array, Step
from skillweave.policies.parts import Override
from skillweave.policies.spaces import Space as Data
from skillweave.schema import (
    AtLeastOne,
    Check,
    NonNegative,
    Share,
    annotations_of,
    fitted,
)
from skillweave.skills.goal_spaces import alone, draw_from
from skillweave.skills.learnable import Learnable
from skillweave.skills.outputs import Wrapped, as_array, call_checked, call_user
from skillweave.skills.own_part import declared_acts, declared_sees
from skillweave.skills.residual import Residual
from skillweave.skills.spelling import misspelt

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_\-]{0,63}")
"""Valid names of skills, which are also names of files."""


_OF_TRAINING = ("steps", "task_weight", "target_return", "target_success")

GoalSpace = Annotated[
    Space[Any],
    Check(
        "a Gymnasium space: goal_space = gymnasium.spaces.Box(-1, 1, (2,))",
        lambda x: isinstance(x, Space),
    ),
]
"""The space of a skill's goals."""
Color = Annotated[
    Any,
    Check(
        "red, green and blue, each from 0 to 255: color = (230, 80, 60)",
        lambda x: len(x) == 3 and all(isinstance(c, int | np.integer) and 0 <= c <= 255 for c in x),
        list,
    ),
]
"""Red, green and blue."""
Fade = AtLeastOne | dict[str, AtLeastOne]
"""The steps in which the skill before acts on, perhaps by its name."""
_Method = Annotated[Callable[..., Any], Check("a method")]

_PARAMETERS = {
    **dict.fromkeys(("reward", "termination", "success"), ("step",)),
    "initiation": ("obs",),
    "goals": ("obs", "rng"),
    "clip_goal": ("obs", "goal"),
    "achieved_goal": ("obs",),
}
"""The arguments of a skill's methods."""


class Skill:
    """An option: an initiation set, a reward to maximise, and a termination condition.

    Sutton, Precup & Singh 1999, "Between MDPs and semi-MDPs".

    Subclass it and define ``reward``; all else is optional. Where skills and selector learn
    together (the default), a skill also follows the task's advantage, with ``task_weight``.

    Every method is batched: arrays over N environments in, one array (N,) out, so the same class
    runs on one environment and on a thousand. Methods must be functions of their arguments: keep no
    state of an environment in ``self`` (``step`` has the observation before and after). Before
    its first call each is called several times, and one that answers otherwise is refused, or gets
    a notice.

    Attributes:
        name: used in messages, files and captions; default: the class name in lower case.
        max_steps: the most steps until the skill stops; None: it stops only by ``termination``.
        call_steps: the most steps of a call, wherever it is trained; None: the hierarchy's.
        fade: the steps of a call in which the skill before acts on, and both actions are mixed: the
            k-th of n steps has k/n of this skill's. A number, or numbers by the name of the skill
            before. Only of a skill that is ready, with actions of a Box. A skill that is left
            while it fades in counts as if it had acted alone. None: it takes over at once.
        steps: training steps where it learns apart; None: its share of ``Hierarchy.steps``.
        task_weight: weight of the task's advantage beside its own reward where skills learn
            together; None: ``Together.task_weight`` (1). 0: only its own reward counts, as it
            should in a skill for other hierarchies.
        algorithm: settings of the algorithm that trains it, its network included; None: the
            hierarchy's.
        target_return: mean return of the periodic evaluation (the hierarchy's ``eval_every``) at
            which its training ends early; None: it uses all its steps.
        target_success: the same for the share of successful episodes, from 0 to 1.
        goal_space: the space of its goals, any that observations may have; None: it has none. Its
            networks see the observation and the goal of the call, and ``step.goal`` holds it.
        sees: the parts of the observation that its policy sees, as the ``sees`` of a policy from
            elsewhere: a key, a place, a slice, a ``Part``, a function of observations, or a tuple
            of these, joined in this order; a dict of them gives inputs with names. None: all.
        acts: the part of the action that it writes: places of a Box, a MultiDiscrete or a
            MultiBinary (``slice(0, 3)``, ``(3,)``), names of parts of a Dict (``"arm"``), or the
            choices of a Discrete that it may make. The rest of the action is what
            ``Hierarchy.rest`` says. None: all of it. Its methods see all, with or without these.
        policy: acts without training: a function of observations (n, *obs_shape), which needs no
            ``staticmethod``, or a method ``policy(self, obs)``, with a goal ``policy(self, obs,
            goal)``; a torch module; ``from_sb3(...)``, ``from_onnx(...)``, or the path of an ONNX
            file; any ``Policy``. None: it is trained; so is a
            ``Residual`` of such a policy, and one with ``learn=True``. Where an
            environment has an action mask, networks that return logits respect it; actions of
            others go to the environment unchanged.
        reward_changes: True if ``reward`` is meant to change for the same step, as a bonus for what
            was seldom seen does. It may then keep a state.
        color: RGB in captions and plots; None: chosen from a palette.
    """

    name: str = ""
    max_steps: AtLeastOne | None = None
    call_steps: AtLeastOne | None = None
    fade: Fade | None = None
    steps: AtLeastOne | None = None
    task_weight: NonNegative | None = None
    algorithm: Any = None
    target_return: float | None = None
    target_success: Share | None = None
    goal_space: GoalSpace | None = None
    sees: Any = None
    acts: Any = None
    policy: Any = None
    reward_changes: bool = False
    color: Color | None = None

    methods: ClassVar[tuple[str, ...]] = ("reward", "initiation", "termination", "success")
    of_goals: ClassVar[tuple[str, ...]] = ("goals", "clip_goal", "achieved_goal")

    _path: str = ""

    @checked_names
    def __init__(self) -> None:
        super().__init__()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" not in cls.__dict__:
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower().strip("_")

    def __repr__(self) -> str:
        parts = [*own_methods(self), *(f"{k}={short(v, 60)}" for k, v in _own_fields(self))]
        return f"<Skill {self.name!r}: {', '.join(parts) or 'all defaults'}>"

    def _repr_html_(self) -> str:
        """Return a table of the declaration, for notebooks."""
        rows = [
            ("skill", path_of(self)),
            ("about", about(self)),
            ("defines", ", ".join(own_methods(self)) or "nothing: all defaults"),
            *((name, short(value, 200)) for name, value in _own_fields(self)),
        ]
        return joined([facts((k, v) for k, v in rows if v)])

    def reward(self, step: Step) -> Array:
        """Return the reward of a ``step``, (N,). Default: the environment's reward."""
        return step.reward

    def initiation(self, obs: Array) -> Array:
        """Return where it may start: ``obs`` (N, *obs_shape) to (N,) bool. Default: everywhere."""
        return np.ones(len(obs), bool)

    def termination(self, step: Step) -> Array:
        """Return where it stops after a ``step``, (N,) bool; its value ends. Default: nowhere."""
        return np.zeros(len(step.reward), bool)

    def success(self, step: Step) -> Array:
        """Return where it has succeeded, (N,) bool, by the last ``step`` before it stops.

        Default: nowhere in evaluations; for automata and trees, where ``termination`` stopped it.
        """
        return np.zeros(len(step.reward), bool)

    def goals(self, obs: Array, rng: np.random.Generator) -> Array:
        """Return goals to practise where it learns or is evaluated by itself, (n, *goal_shape).

        Elsewhere the selector chooses goals. Default: elements of ``goal_space`` at random. It is
        asked again for goals that hold already (``termination`` is true for a step that stands
        still), at most 16 times.

        Args:
            obs: (n, *obs_shape), where the calls start.
            rng: the only source of chance.
        """
        assert self.goal_space is not None
        return draw_from(self.goal_space, len(obs), rng)

    def clip_goal(self, obs: Array, goal: Array) -> Array:
        """Return goals in reach of ``obs`` (n, *obs_shape), in place of those that were chosen.

        Default: they stay as they are, and one that is not in ``goal_space`` is an error.

        Args:
            obs: where the calls start.
            goal: (n, *goal_shape), as it was chosen.
        """
        return goal

    def achieved_goal(self, obs: Array) -> Array:
        """Return the goals that ``obs`` (n, *obs_shape) have reached, (n, *goal_shape).

        A call with such a goal would have succeeded there. Needed for ``hindsight`` alone.
        """
        raise NotImplementedError

    def defines(self, method: str) -> bool:
        """Return whether the subclass overrides ``method``."""
        return getattr(type(self), method) is not getattr(Skill, method)

    def validate(self) -> None:
        """Raise a DeclarationError that names an error in the declaration."""
        where = f"skill {short(self.name)} ({type(self).__name__})"
        fitted(str, self.name, f"{where}: name")
        if not self.name:
            raise DeclarationError(f"{where} has no name: set the class attribute 'name'")
        if not NAME.fullmatch(self.name):
            raise DeclarationError(
                f"{where}: the name names files too; use letters, digits, '_' and '-', at most 64"
            )
        kinds = annotations_of(Skill)
        for field in ("color", "goal_space", "fade"):
            fitted(kinds[field], getattr(self, field), f"{where}: {field}")
        for field in ("max_steps", "call_steps", "reward_changes", *_OF_TRAINING):
            value = getattr(self, field)
            converted = fitted(kinds[field], value, f"{where}: {field}")
            if converted is not value and (is_trained(self) or field not in _OF_TRAINING):
                with suppress(AttributeError):  # of a property
                    setattr(self, field, converted)
        if self.goal_space is None and (given := list(filter(self.defines, self.of_goals))):
            raise DeclarationError(
                f"{where} has {given[0]}(), but no goals: set goal_space, the space of its goals: "
                "goal_space = gymnasium.spaces.Box(-1, 1, (2,))"
            )
        if self.sees is not None:
            declared_sees(self.sees, where)
        if self.acts is not None:
            declared_acts(self.acts, where)
        known = (*FIELDS, *self.methods, *self.of_goals, "Hierarchy.rest")
        for name, meant in misspelt(self, Skill, known):
            code = getattr(getattr(self, name), "__code__", None)
            line = code and f" ({Path(code.co_filename).name}, line {code.co_firstlineno})"
            warnings.warn(
                f"{where} has {name!r}, which is no attribute of a skill: is {meant!r} meant?"
                f"{line or ''}",
                stacklevel=2,
            )
        for method in (*self.methods, *self.of_goals):
            fitted(_Method, getattr(self, method), f"{where}: {method}")
            self._check_parameters(method, where)

    def _check_parameters(self, method: str, where: str) -> None:
        """Raise a DeclarationError where a method cannot be called with its arguments."""
        names = _PARAMETERS[method]
        try:
            signature = inspect.signature(getattr(self, method))
        except (TypeError, ValueError):  # of some functions written in C
            return
        try:
            signature.bind(*names)
        except TypeError:
            goal = "goal" in signature.parameters and "goal" not in names
            advice = "; it is called before the goal is chosen" if names == ("obs",) else ""
            advice = "; the goal is step.goal" if names == ("step",) else advice
            raise DeclarationError(
                f"{where}: {method}() is called with ({', '.join(names)}), but takes {signature}: "
                f"a method of a skill takes (self, {', '.join(names)}){advice if goal else ''}"
            ) from None


FIELDS = tuple(x for x in Skill.__annotations__ if x not in ("methods", "of_goals", "_path"))
"""The names of a skill's settings."""


def about(skill: Skill) -> str:
    """Return the first line of the docstring of a skill's class; "" if it has none."""
    lines = (type(skill).__dict__.get("__doc__") or "").strip().splitlines()
    return lines[0] if lines else ""


def own_methods(skill: Skill) -> list[str]:
    """Return the methods that a skill overrides."""
    return [method for method in (*skill.methods, *skill.of_goals) if skill.defines(method)]


def _own_fields(skill: Skill) -> Iterator[tuple[str, Any]]:
    """Yield the settings of a skill that differ from the defaults, except its name."""
    for field in FIELDS:
        if field != "name" and (value := getattr(skill, field)) is not getattr(Skill, field):
            yield field, value


def is_trained(skill: Skill) -> bool:
    """Return whether a skill is trained: it has no policy, or one with which it learns."""
    return skill.policy is None or isinstance(skill.policy, Learnable | Residual)


def path_of(skill: Skill) -> str:
    """Return a skill's name in messages, after the names of the hierarchies that it is in."""
    return skill._path or skill.name


class RecordedSkill(Skill):
    """A skill of a run that was loaded without its code, so without reward and success."""


@checked_names
class Reflex:
    """A rule that overrides the running skill's action while its condition holds.

    Args:
        condition: observations (N, *obs_shape) to (N,) bool.
        action: the action to take instead, or a function from observations (n, *obs_shape) to
            actions (n, ...).
        name: used in messages and captions; default: the condition's name.

    Raises:
        DeclarationError: the condition is not a function, or the name not a text.
    """

    def __init__(
        self, condition: Callable[[Array], Array], action: Any, name: str | None = None
    ) -> None:
        if not callable(condition):
            raise DeclarationError(
                f"a Reflex's condition is {short(condition)}; it must be a function of observations"
            )
        fitted(str | None, name, "a Reflex's name")
        self.condition = condition
        self.action = action
        self.name = str(name or getattr(condition, "__name__", "reflex"))

    def override(self, space: Data) -> Override:
        """Return the reflex for actions of a space, called with this library's messages.

        Raises:
            DeclarationError: its action is fixed, and is not in ``space``.
        """
        action: Any = self.action
        action = (
            Wrapped(action, partial(self._act, space)) if callable(action) else self._fixed(space)
        )
        return Override(self.name, Wrapped(self.condition, self.holds), action)

    def holds(self, obs: Array) -> Array:
        """Evaluate its condition: ``obs`` (N, *obs_shape) to (N,) bool.

        Raises:
            SkillError: the condition returned a wrong result; the message names it.
        """
        return call_checked(self.condition, obs, bool, f"{self._label}: condition()")

    def _act(self, space: Data, obs: Array) -> Array:
        """Return the actions (n, ...) of its function."""
        label = f"{self._label}: action()"
        convert = partial(space.actions, n=len(obs), who=label, kind=SkillError)
        return cast(Array, call_user(self.action, obs, label, convert=convert))

    def _fixed(self, space: Data) -> Array:
        """Return a fixed action, (1, ...)."""
        label = f"{self._label}: action"
        if space.parts is not None:
            batch = alone(space, self.action)
        else:
            value = as_array(self.action, label, DeclarationError)
            # A number fills a row: Reflex(leaning, 0.5) in a Box of one dimension.
            batch = (np.full(space.shape, value) if value.shape == () else value)[None]
        return space.actions(batch, 1, label, DeclarationError)

    @property
    def _label(self) -> str:
        return f"reflex {self.name!r}"


def call_method(
    skill: Skill,
    method: str,
    about: Step | Array,
    ids: Array | None = None,
) -> Array:
    """Call a method of a skill with a step or observations; return (n,) float32 or bool.

    Args:
        ids: environments of the rows, (n,), for messages; None: all n.

    Raises:
        SkillError: see ``call_checked``.
    """
    dtype = np.float32 if method == "reward" else bool
    who = f"skill {path_of(skill)!r}: {method}()"
    may_change = method == "reward" and skill.reward_changes
    return call_checked(getattr(skill, method), about, dtype, who, ids, may_change=may_change)
