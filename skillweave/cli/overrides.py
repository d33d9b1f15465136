"""Settings by dotted name: ``--set selector.gamma=0.99``, ``--evolve population=8``."""

from __future__ import annotations

import ast
import re
import typing
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

from skillweave._internal.messages import ELSEWHERE, suggest
from skillweave.algorithms.config import AlgorithmConfig, named_config
from skillweave.algorithms.schedules import Linear
from skillweave.api.running import apart_to_evolve
from skillweave.errors import DeclarationError
from skillweave.evolution.config import Evolution, Range, Tournament, Truncation
from skillweave.hierarchy.declaration import Declaration
from skillweave.schema import annotations_of, described, flat, options_of
from skillweave.skills import Skill, is_trained
from skillweave.skills.lengths import Lengths

PLAIN = ("call_steps", "steps", "learn")
"""Fields of a hierarchy that are set by themselves."""
OF_SKILLS = ("steps", "task_weight", "target_return", "target_success")
"""Fields of a skill that are set by themselves; its other settings are its algorithm's."""
GROUPS = {
    "apart": "apart",
    "together": "together",
    "selection": "selection",
    "guide": "guide",
    "train": "train_defaults",
}
"""By the first part of a name, the field that holds the group."""
ALGORITHMS = ("algorithm", "selector", "flat")
"""First parts of the names of algorithms' settings."""


Changes = dict[tuple[str, ...], tuple[str, str]]
"""By the path of a field, the setting's full name and the text of its value."""
SELECTIONS: dict[str, Any] = {"tournament": Tournament, "truncation": Truncation}


MOST_SHOWN = 4
"""The most settings that an error lists."""

_PART = re.compile(r"(skills\.[^.]+|together)\.steps|apart\.(skill|selector)_steps")
"""Names of the budgets of parts."""
_LINEAR = re.compile(r"[lL]inear\(([^,()]*,[^,()]*)\)")


def apply_overrides(declaration: Declaration, overrides: Sequence[str]) -> None:
    """Change a declaration in place by ``--set name=value`` strings, in any order.

    The name of an agent alone sets its algorithm: ``selector=DQN``, ``skills.center=SAC``.

    Raises:
        DeclarationError: no such setting (with a similar one), or a value out of range.
    """
    owners: dict[tuple[str, ...], Changes] = {}
    names = []
    steps = declaration.steps
    for setting in overrides:
        name, text = _split(
            setting, f"--set {setting!r}: write name=value, for example call_steps=20"
        )
        names.append(name)
        head, *rest = path = name.split(".")
        if head in PLAIN and not rest:
            hint = annotations_of(type(declaration))[head]
            setattr(declaration, head, _parse(name, text, hint))
        elif head == "skills" and len(rest) == 2 and rest[1] in OF_SKILLS:
            hint = annotations_of(Skill)[rest[1]]
            setattr(declaration.skill(rest[0]), rest[1], _parse(name, text, hint))
        elif (head == "skills" and rest) or head in ALGORITHMS or (head in GROUPS and rest):
            at = 2 if head == "skills" else 1
            owners.setdefault(tuple(path[:at]), {})[tuple(path[at:])] = name, text
        else:
            known = [*list_settings(declaration), *(f"{c}." for c in (*ALGORITHMS, *GROUPS))]
            raise _unknown(name, known)
    # Agents first that are set as a whole: others may have their settings.
    for owner in sorted(owners, key=lambda owner: () not in owners[owner]):
        _change(declaration, owner, owners[owner])
    if "steps" in names and declaration.steps:
        _set_total(declaration, declaration.steps, steps, list(filter(_PART.fullmatch, names)))
    declaration.validate()


def _split(setting: str, wrong: str) -> tuple[str, str]:
    """Return name and value of a ``--set name=value``; raise the error ``wrong`` without them."""
    name, sign, text = (part.strip() for part in setting.partition("="))
    if not sign:
        raise DeclarationError(wrong)
    return name, text


def _set_total(
    declaration: Declaration, total: int, before: int | None, parts: Sequence[str]
) -> None:
    """Scale the budgets by ``--set steps=``, of a declaration that sets some itself.

    Args:
        before: the declaration's own ``steps``.
        parts: names of budgets that were set, too.
    """
    trained = declaration.total_steps
    stages = len(declaration.budgets())
    if not trained or abs(trained - total) <= stages:  # shares are rounded
        return
    if parts:
        raise DeclarationError(
            f"steps={total} is for all training, but with {', '.join(parts)} it would be "
            f"{trained} steps: leave out one or the other"
        )
    declaration.steps = before
    declaration.scale(total / declaration.total_steps)


def list_settings(declaration: Declaration) -> dict[str, Any]:
    """Return the dotted name and value of every setting that ``--set`` can change."""
    values: dict[str, Any] = {name: getattr(declaration, name) for name in PLAIN}
    for name, field in GROUPS.items():
        if (group := getattr(declaration, field)) is not None:
            values |= {f"{name}.{f.name}": getattr(group, f.name) for f in fields(group)}
    values = {k: v for k, v in values.items() if k not in ("train.flat", "guide.selector")}
    budgets = declaration.budgets()
    for skill in declaration.skills:
        if is_trained(skill):
            values[f"skills.{skill.name}.steps"] = budgets.get(skill.name, skill.steps)
            values[f"skills.{skill.name}.task_weight"] = skill.task_weight
            config = skill.algorithm or declaration.algorithm
            values |= flat(config, f"skills.{skill.name}.")
    trained = isinstance(declaration.selector, AlgorithmConfig)
    return values | (flat(declaration.selector, "selector.") if trained else {})


def _change(declaration: Declaration, owner: tuple[str, ...], changes: Changes) -> None:
    """Change by ``--set`` the settings whose names start with ``owner``.

    All at once: some fit only together (num_envs, batch_size).
    """
    head = owner[0]
    holder: Any = declaration.train_defaults if head == "flat" else declaration
    field = GROUPS.get(head, head)
    if head == "skills":
        holder = declaration.skill(owner[1])
        field = "algorithm"
    config = getattr(holder, field)
    if config is None and field in ("algorithm", "flat"):
        config = declaration.algorithm
    if () in changes:
        name, text = changes.pop(())
        config = named_config(text, f"--set {name}={text}")
    if not is_dataclass(config):
        name, _ = next(iter(changes.values()))
        if head == "guide":
            raise DeclarationError(
                f"{name}: the hierarchy has no guide; declare one: guide=Guide(automaton)"
            )
        raise DeclarationError(
            f"{name}: the selector is ready, so it has no settings; with --set selector=PPO it is "
            "trained"
        )
    config = replaced(config, changes)
    if head == "flat":
        declaration.train_defaults = replace(holder, flat=config)
    else:
        setattr(holder, field, config)


def parse_evolve(
    settings: Sequence[str], declaration: Declaration, flat: bool
) -> dict[str, Evolution | None] | None:
    """Return the evolution of each stage by ``--evolve``, or None where nothing is to evolve.

    A name may begin with a stage; settings without one hold for all. ``selection=truncation``
    takes that selection, ``ranges.gamma=0.9,0.999,complement`` lets a setting mutate.

    Raises:
        DeclarationError: no such setting (with a similar one), or a value out of range.
    """
    if not settings:
        return None
    if flat:
        stages = declaration.plain_agent().stages()
    else:
        stages = apart_to_evolve(declaration)[0].stages()
    shared: Changes = {}
    by_stage: dict[str, Changes] = {stage.name: {} for stage in stages}
    for setting in settings:
        name, text = _split(
            setting, f"--evolve {setting!r}: write name=value, such as population=8"
        )
        head, *rest = name.split(".")
        if head in by_stage and rest:
            by_stage[head][tuple(rest)] = name, text
        else:
            shared[head, *rest] = name, text
    return {
        stage: _evolution(shared | own) if shared or own else None
        for stage, own in by_stage.items()
    }


def _evolution(settings: Changes) -> Evolution:
    """Return the evolution that the ``--evolve`` options describe."""
    ranges: dict[str, Range] = {}
    changes: Changes = {}
    start = Evolution()
    for path, (written, text) in settings.items():
        if path == ("selection",):
            if text.lower() not in SELECTIONS:
                known = ", ".join(SELECTIONS)
                raise DeclarationError(f"--evolve {written}={text}: expected one of {known}")
            start = replace(start, selection=SELECTIONS[text.lower()]())
        elif path[:-1] in (("ranges",), ("mutations", "ranges")):
            ranges[path[-1]] = _range(written, text)
        else:
            changes[path] = written, text
    evolution: Evolution = replaced(start, changes)
    if ranges:
        evolution = replace(evolution, mutations=replace(evolution.mutations, ranges=ranges))
    return evolution


def _range(written: str, text: str) -> Range:
    """Return the range that ``--evolve`` sets for a setting: low,high or low,high,scale."""
    try:
        low, high, *scale = (part.strip() for part in text.split(","))
        return Range(float(low), float(high), *scale)  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise DeclarationError(
            f"--evolve {written}={text}: write low,high or low,high,scale ({error})"
        ) from error


def replaced(config: Any, changes: Changes) -> Any:
    """Return ``config`` with the fields that ``--set`` or ``--evolve`` names parsed and set."""
    known = [f.name for f in fields(config)]
    hints = annotations_of(type(config))
    values: dict[str, Any] = {}
    deeper: dict[str, Changes] = {}
    for (field, *rest), (name, text) in changes.items():
        if field not in known:
            prefix = name.removesuffix(".".join([field, *rest]))
            raise _unknown(name, [prefix + k for k in known])
        if rest:
            deeper.setdefault(field, {})[tuple(rest)] = name, text
        else:
            values[field] = _parse(name, text, hints[field])
    for field, inner_changes in deeper.items():
        inner = values.get(field, getattr(config, field))
        if inner is None and field == "critic":
            inner = values.get("network", getattr(config, "network", None))  # its default
        if inner is None:
            parts: list[Any] = [kind for kind in options_of(hints[field]) if is_dataclass(kind)]
            inner = parts[0]() if parts else None
        if not is_dataclass(inner):
            name = next(iter(inner_changes.values()))[0]
            raise DeclarationError(f"{name}: {field} has no parts")
        values[field] = replaced(inner, inner_changes)
    return replace(config, **values)


def _parse(name: str, text: str, hint: Any) -> Any:
    """Return the text after ``--set name=`` as a value of the annotated type."""
    options = options_of(hint)
    if type(None) in options and text.lower() in ("none", "null"):
        return None
    try:
        value = ast.literal_eval(text.capitalize() if text.lower() in ("true", "false") else text)
    except (ValueError, SyntaxError):
        value = text
    for option in options:
        origin = typing.get_origin(option)
        if option is bool and isinstance(value, bool):
            return value
        whole = isinstance(value, int | float) and not isinstance(value, bool)
        if option is int and whole and float(value).is_integer():
            return int(value)
        if option is float and whole:
            return float(value)
        if option is Linear and (linear := _LINEAR.fullmatch(text)):
            return Linear(*(_parse(name, part.strip(), float) for part in linear[1].split(",")))
        if isinstance(value, tuple | list) and (option is Lengths or origin in (Sequence, tuple)):
            return Lengths(*value) if option is Lengths else tuple(value)
        texts = origin is Sequence or (origin is tuple and typing.get_args(option)[0] is str)
        if texts and isinstance(value, str):
            return tuple(part.strip() for part in value.split(","))
        if origin is tuple and isinstance(value, int):
            return (value,)
        if origin is typing.Literal and value in typing.get_args(option):
            return value
    expected = described(hint)
    if typing.get_origin(options[0]) is Sequence:
        expected = "names with commas between them"
    raise DeclarationError(f"{name}={text}: expected {expected}")


def _unknown(name: str, known: Sequence[str]) -> DeclarationError:
    """Return the error for a name that ``--set`` or ``--evolve`` does not have."""
    last = ELSEWHERE.get(name, name)
    longer = [k for k in known if k.rpartition(".")[2] == last != k]
    if longer and name not in known:
        more = ", ..." if len(longer) > MOST_SHOWN else ""
        end = f"; there are {', '.join(longer[:MOST_SHOWN])}{more}"
    else:
        end = suggest(name, known, listed=False)
    return DeclarationError(f"no setting {name!r}{end} (skillweave info RECIPE lists them)")
