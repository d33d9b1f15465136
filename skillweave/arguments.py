"""Errors for wrong arguments and attributes: they name the one that was probably meant.

``@checked_names`` decorates public functions and classes. Where an argument is misspelt, missing
or one too many, it raises a ``DeclarationError`` with the right spelling, in place of Python's
TypeError; and it refuses to set an attribute that does not exist.
"""

from __future__ import annotations

import functools
import inspect
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, fields, is_dataclass
from difflib import SequenceMatcher
from typing import Any, NamedTuple, TypeVar

from skillweave.errors import DeclarationError
from skillweave.messages import short

T = TypeVar("T", bound=Callable[..., Any])

SIMILAR = 0.6
"""The least similarity of a name to the one that is suggested: the ratio of ``difflib``."""

ELSEWHERE = {
    "clip_epsilon": "clip_coef",
    "clip_range": "clip_coef",
    "discount": "gamma",
    "discount_factor": "gamma",
    "entropy_coef": "ent_coef",
    "env_id": "env",
    "env_kwargs": "kwargs",
    "epochs": "update_epochs",
    "eval_freq": "eval_every",
    "hidden_layers": "hidden",
    "hidden_sizes": "hidden",
    "horizon": "n_steps",
    "lam": "gae_lambda",
    "log_dir": "run_dir",
    "lr": "learning_rate",
    "max_episode_steps": "max_steps",
    "minibatch_size": "batch_size",
    "n_envs": "num_envs",
    "n_epochs": "update_epochs",
    "n_eval_episodes": "episodes",
    "net_arch": "hidden",
    "num_epochs": "update_epochs",
    "num_steps": "n_steps",
    "options": "skills",
    "polyak": "tau",
    "total_steps": "steps",
    "total_timesteps": "steps",
    "value_coef": "vf_coef",
}
"""Names that other libraries give to settings, with the names that they have here."""


STARTS = (
    "options",
    "reset_options",
    "reset_kwargs",
    "start_state",
    "start_states",
    "initial_state",
    "initial_states",
    "init_state",
    "start_distribution",
)
"""Names under which users look for other starts of episodes."""
STARTS_BY = (
    "episodes start where the environment's reset() puts them; to start elsewhere, give a wrapper "
    "whose reset() passes on options or sets the state, EnvSpec(env, wrappers=(Elsewhere,)): the "
    "documentation has its lines, under 'A curriculum', 'Start episodes elsewhere'"
)

RECORDINGS = (
    "demonstrations",
    "demos",
    "dataset",
    "expert",
    "expert_data",
    "trajectories",
    "transitions",
)
"""Names under which users look for learning from recorded data."""
RECORDINGS_BY = (
    "Skillweave does not learn from demonstrations or other recorded data; learn a policy from "
    "them with another library, and start from it: train(start_from=from_torch(policy, "
    "learn=True)), or from_sb3"
)
ABSENT = dict.fromkeys(STARTS, STARTS_BY) | dict.fromkeys(RECORDINGS, RECORDINGS_BY)
"""By a name that users look for, a sentence on what to do instead."""


def checked_names(target: T) -> T:
    """Let a function, or a class, raise a DeclarationError where its arguments are wrong.

    Of a dataclass, attributes are checked as well: a frozen one's cannot be set, those of
    another only if they exist.

    Args:
        target: a function, a method, or a class (above ``@dataclass``, if it is one).

    Returns:
        The function with its signature; the same class.
    """
    if not isinstance(target, type):
        return typing.cast(T, _checked(target))
    kind: Any = target
    kind.__init__ = _checked(kind.__init__)
    if "__dataclass_params__" in vars(kind):
        _check_attributes(kind, kind.__dataclass_params__.frozen)
    return target


def _checked(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def checked(*args: Any, **named: Any) -> Any:
        try:
            return function(*args, **named)
        except TypeError:
            # The function's body may have raised it: then the arguments fit.
            if (wrong := _wrong_arguments(function, args, named)) is None:
                raise
        raise DeclarationError(wrong)

    return checked


# Arguments


def _wrong_arguments(
    function: Callable[..., Any], args: tuple[Any, ...], named: dict[str, Any]
) -> str | None:
    """Return a sentence about arguments that do not fit a function; None: they fit."""
    signature = inspect.signature(function)
    try:
        signature.bind(*args, **named)
    except TypeError:
        pass
    else:
        return None
    parameters = list(signature.parameters.values())
    owner = None
    if parameters and parameters[0].name in ("self", "cls") and args:
        owner = args[0] if isinstance(args[0], type) else type(args[0])
        parameters = parameters[1:]
        args = args[1:]
    makes = function.__name__ == "__init__" and owner is not None
    name = owner.__name__ if makes and owner is not None else function.__name__
    who, what = (name, "setting") if makes and is_dataclass(owner) else (f"{name}()", "argument")
    by_name = [p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    if makes and not parameters:
        example = next((f"{k} = {short(v, 40)}" for k, v in named.items()), "")
        advice = f"write {example} in the body of the class, or give" if example else "give"
        return f"{who} takes no arguments: {advice} it an __init__ of its own"
    takes_all = any(p.kind is p.VAR_KEYWORD for p in parameters)
    if not takes_all and (unknown := [k for k in named if k not in by_name]):
        places = [_Place(k, "", "") for k in by_name]
        if owner is not None:
            places += _other_places(owner, makes)
        if unknown[0] in ABSENT and not (unknown[0] in ELSEWHERE and "skills" in by_name):
            return f"{who} has no {what} {unknown[0]!r}: {ABSENT[unknown[0]]}"
        end = meant(unknown[0], places, f"its {what}s are")
        return f"{who} has no {what} {unknown[0]!r}{end}"
    ordered = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if len(args) > len(ordered):
        most = f"at most {len(ordered)}" if ordered else "none"
        rest = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name not in named]
        hint = f": name the others, {rest[0]}=... for example" if rest else ""
        return f"{who} takes {most} of its arguments by position, but {len(args)} were given{hint}"
    if twice := [p.name for p in ordered[: len(args)] if p.name in named]:
        return f"{who} was given {twice[0]} twice, by position and by name: leave one of them out"
    given = {p.name for p in ordered[: len(args)]} | named.keys()
    needed = [p for p in parameters if p.default is p.empty and p.kind is not p.VAR_POSITIONAL]
    needed = [p for p in needed if p.kind is not p.VAR_KEYWORD]
    lacking = " and ".join(p.name for p in needed if p.name not in given)
    example = ", ".join(f"{p.name}=..." if p.kind is p.KEYWORD_ONLY else p.name for p in needed)
    return f"{who} needs {lacking}: write {name}({example})"


class _Place(NamedTuple):
    """A place where an argument of some name can be given."""

    name: str
    where: str
    """Part of a sentence: "a setting of apart"; empty: the place where it was written."""
    example: str


def meant(name: str, places: Sequence[_Place | str], otherwise: str, least: float = SIMILAR) -> str:
    """Return the end of a sentence about an unknown name: where a similar one can be given.

    Args:
        name: what was written.
        places: what exists, by name.
        otherwise: introduces all names where none is similar; empty: they are not listed.
        least: how similar a name must be, from 0 to 1.

    Returns:
        A text that begins with a colon or a semicolon, or nothing.
    """
    known = [_Place(p, "", "") if isinstance(p, str) else p for p in places]
    wanted = name.lower().replace("-", "_")
    for spelling in (wanted, ELSEWHERE.get(wanted, "")):
        # Names of this place come first.
        exact = [p for p in known if p.name == spelling]
        if exact and (exact[0].where or exact[0].name != name):
            return _where(exact[0], exact=spelling == name)
    similar = [(SequenceMatcher(None, wanted, p.name).ratio(), p) for p in known]
    if similar:
        likeness, place = max(similar, key=lambda pair: (pair[0], not pair[1].where))
        if likeness >= least:
            return _where(place, exact=False)
    here = ", ".join(p.name for p in known if not p.where)
    return f"; {otherwise} {here}" if here and otherwise else ""


def _where(place: _Place, exact: bool) -> str:
    if not place.where:
        return f": is {place.name!r} meant?"
    if exact:
        return f"; it is {place.where}: write {place.example}"
    return f": is {place.name!r} meant, {place.where}? Write {place.example}"


def _other_places(owner: type, makes: bool) -> Iterator[_Place]:
    """Yield the other places of a class's arguments: its groups of settings, ``train``."""
    if makes:
        yield from _groups(owner, "{}")
        train = getattr(owner, "train", None)
        for name in _names(train) if callable(train) else ():
            yield _Place(name, "an argument of train()", f"train({name}=...)")
        return
    if is_dataclass(owner):
        for field in fields(owner):
            example = f"{owner.__name__}({field.name}=...)"
            yield _Place(field.name, f"a setting of {owner.__name__}", example)
        yield from _groups(owner, f"{owner.__name__}({{}})")


def _names(function: Callable[..., Any]) -> list[str]:
    """Return the arguments of a method that have names."""
    parameters = list(inspect.signature(function).parameters.values())
    return [p.name for p in parameters if p.name != "self" and p.kind is not p.VAR_KEYWORD]


def _groups(owner: Any, example: str) -> Iterator[_Place]:
    """Yield the settings in the fields of a dataclass that hold settings, and below them."""
    if not is_dataclass(owner):
        return
    for field in fields(owner):
        if (group := _group(owner, field)) is None:
            continue
        below = example.format(f"{field.name}={group.__name__}({{}})")
        for part in fields(group):
            text = below.format(f"{part.name}=...")
            yield _Place(part.name, f"a setting of {field.name}", text)
        yield from _groups(group, below)


def _group(owner: Any, field: Any) -> Any:
    """Return the dataclass of a field's instance; None: it holds something else."""
    made = field.default if field.default_factory is MISSING else field.default_factory()
    if is_dataclass(made) and not isinstance(made, type):
        return type(made)
    try:
        hint = typing.get_type_hints(owner)[field.name]
    except Exception:  # a name that only type checkers import
        return None
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    options = [t for t in typing.get_args(hint) if t is not type(None)] if union else [hint]
    one = options[0] if len(options) == 1 else None
    return one if isinstance(one, type) and is_dataclass(one) else None


# Attributes


def _check_attributes(kind: Any, frozen: bool) -> None:
    kind.__setattr__ = _refuse_change if frozen else _set_known


def _refuse_change(self: Any, name: str, value: Any) -> None:
    kind = type(self).__name__
    own = [f.name for f in fields(self)]
    if name not in own:
        raise DeclarationError(f"{kind} has no setting {name!r}{meant(name, own, 'they are')}")
    raise DeclarationError(
        f"{kind} cannot be changed: make another one, with "
        f"dataclasses.replace(..., {name}={short(value)})"
    )


def _set_known(self: Any, name: str, value: Any) -> None:
    """Set an attribute that exists, or a private one."""
    kind = type(self)
    own = [f.name for f in fields(self)]
    if not name.startswith("_") and name not in own and not hasattr(kind, name):
        places = [_Place(k, "", "") for k in own]
        if kind.__module__.split(".")[0] == __name__.split(".")[0]:
            groups = list(_groups(kind, "{}"))
            end = meant(name, places + groups, "its settings are")
            raise DeclarationError(f"{kind.__name__} has no setting {name!r}{end}")
        # A user's subclass may have attributes of its own, but none that looks like a misspelt one.
        if end := meant(name, places, "", 0.85):
            raise DeclarationError(f"{kind.__name__} has no setting {name!r}{end}")
    if isinstance(computed := getattr(kind, name, None), property) and computed.fset is None:
        raise DeclarationError(f"{kind.__name__}.{name} is computed; it cannot be set")
    object.__setattr__(self, name, value)


__all__ = ["checked_names", "meant"]
