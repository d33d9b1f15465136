"""The user's code and arguments that an environment and skills depend on, to be compared later.

They are recorded as texts by part: of the environment, of each skill, of each reflex. Code is a
checksum, without comments, docstrings, annotations and layout, and without the place of the code.
It covers what the code uses: functions and classes of the user's, constants, closures, attributes.
Of code without source the text is empty, and empty texts are not compared.
"""

from __future__ import annotations

import ast
import functools
import inspect
import json
import re
import textwrap
from collections.abc import Iterable, Mapping
from contextlib import suppress
from types import FunctionType, ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator

from skillweave._internal.notices import notice
from skillweave._internal.tracebacks import is_own_code, is_own_module
from skillweave.envs.make import EnvSpec
from skillweave.policies.untrusted import checksum, shown
from skillweave.skills import Reflex, Skill

Texts = dict[str, str]
"""Texts to compare, by what they are about: checksums of code, or arguments."""
SUM = "sha256:"
"""The beginning of a checksum."""
UNCOMPARED = ("render", "close")
"""Methods that do not change what an environment does."""
MUTATORS = {"append", "add", "clear", "extend", "fill", "insert", "pop", "remove", "update"}
"""Methods that change a list, a dict, a set or an array."""


def environment_texts(spec: EnvSpec) -> Texts:
    """Return the texts of an environment that a run records: name, arguments, code."""
    # The library's object that scores a planned task changes no step.
    wrappers = [w for w in spec.wrappers if not type(w).__module__.startswith("skillweave.")]
    kinds = [getattr(wrapper, "func", wrapper) for wrapper in wrappers]
    names = ", ".join(getattr(kind, "__name__", type(kind).__name__) for kind in kinds) or "none"
    return {
        "the environment": spec.name,
        "the dict kwargs of the environment": _text(spec.kwargs),
        "the list of its wrappers": names,
        "the code of the environment": code_sum([_maker(spec.env), spec.pool]),
        f"the code of its wrappers ({names})": code_sum(wrappers),
    }


def skill_texts(
    skills: Mapping[str, Skill], reflexes: Iterable[Reflex], without: str = ""
) -> Texts:
    """Return the texts of skills that a run records: methods, policies, reflexes.

    Args:
        skills: by name.
        without: a method that is left out.
    """
    code: dict[str, Any] = {"the reflexes": [(r.condition, r.action) for r in reflexes]}
    for name, skill in skills.items():
        for method in (*Skill.methods, *Skill.of_goals):
            if method != without and skill.defines(method):
                code[f"the {method} of skill {name!r}"] = getattr(skill, method)
        function = getattr(skill.policy, "function", skill.policy)
        if hasattr(function, "__code__"):
            code[f"the policy of skill {name!r}"] = function
    return {what: code_sum(thing) for what, thing in code.items()}


def notice_changes(then: Texts, now: Texts, since: str) -> None:
    """Give a notice of what has changed; ``since``: when the first texts were recorded."""
    if says := changes(then, now):
        notice(f"{says} since {since}. If that changes results, train or record again")


def changes(then: Texts, now: Texts) -> str:
    """Return how a run's recorded user code differs from now, as clauses; empty: it does not."""
    clauses = []
    for what, text in now.items():
        before = then.get(what)
        if before and text and before != text:
            values = "" if text.startswith(SUM) else f" from {shown(before)} to {shown(text)}"
            clauses.append(f"{what} has changed{values}")
    return "; ".join(clauses)


def code_sum(thing: Any) -> str:
    """Return a checksum of code and of the values that it uses; empty: it has no source."""
    text = _text(thing)
    return text and SUM + checksum(text.encode())


def _text(thing: Any) -> str:
    try:
        return json.dumps(_form(thing, {}), sort_keys=True)
    except (ValueError, RecursionError):  # also where a variable of a closure has no value yet
        return ""


def _maker(env: Any) -> Any:
    """Return the function that makes an environment, whose code a run records."""
    entry = gym.registry.get(str(env).rpartition(":")[2])
    if entry is None:
        return env
    made: Any = entry.entry_point
    if isinstance(made, str):
        if not is_own_module(re.split("[.:]", made)[0]):
            return None
        with suppress(ImportError, AttributeError):
            made = load_env_creator(made)
    return made, entry.kwargs, entry.max_episode_steps


def _form(x: Any, seen: dict[int, Any], owner: Any = None) -> Any:
    """Return a value that a run records of the user's code, as JSON; of others the class's name.

    Args:
        seen: the values that were read already; each is read once.
        owner: the object whose method it is.
    """
    match x:
        case None | bool() | int() | float() | str():
            return x
        case np.generic() | np.ndarray():
            return str(x)
        case list() | tuple():
            return [_form(value, seen) for value in x]
        case set() | frozenset():
            return sorted(map(repr, x))
        case Mapping():
            return {str(key): _form(value, seen) for key, value in x.items()}
        case functools.partial():
            return _form([x.func, x.args, x.keywords], seen)
    owner = getattr(x, "__self__", owner)
    x = getattr(x, "__func__", None) or getattr(x, "fget", x)  # of a method or a property
    code = x if isinstance(x, FunctionType | type) else type(x)
    if not is_own_code(code):
        return code.__name__
    if id(x) in seen:
        return None
    seen[id(x)] = x
    text, names = _source(code)
    scope: dict[str, Any] = {}
    for function in (code, *vars(code).values()):
        if isinstance(function, FunctionType):
            cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
            scope |= function.__globals__ | {name: cell.cell_contents for name, cell in cells}
    scope |= {"self": owner, "super": type(owner).__mro__[1:]}
    values = {}
    for name in names:
        first, _, attribute = name.partition(".")
        value = scope.get(first)
        if attribute:
            known = first == "self" or (
                isinstance(value, ModuleType) and is_own_module(value.__name__)
            )
            value = inspect.getattr_static(value, attribute, None) if known else None
        values[name] = _form(value, seen, owner if first == "self" else None)
    rest = code.__bases__ if isinstance(code, type) else code.__defaults__
    more = None if code is x else getattr(x, "__dict__", None)
    return [text, values, _form([rest, more], seen)]


@functools.lru_cache(maxsize=1024)
def _source(code: Any) -> tuple[str, list[str]]:
    """Return the source of a user's function or class as a run records it, and its names.

    These are names that it does not assign, and attributes of them: ``self.gain``.

    Raises:
        ValueError: Python has no source of it.
    """
    try:
        tree: ast.AST = ast.parse(textwrap.dedent(inspect.getsource(code)))
    except (OSError, TypeError, SyntaxError) as error:
        raise ValueError from error
    if code.__name__ == "<lambda>":  # its lines may hold more
        names = code.__code__.co_varnames[: code.__code__.co_argcount]
        lambdas = [node for node in ast.walk(tree) if isinstance(node, ast.Lambda)]
        alike = [n for n in lambdas if tuple(a.arg for a in n.args.args) == names]
        tree = ast.Tuple([*alike], ast.Load())
    for node in ast.walk(tree):
        match node:
            case ast.arg():
                node.annotation = None
            case ast.FunctionDef():
                node.returns = None
            case ast.ClassDef():
                node.body = [n for n in node.body if getattr(n, "name", "") not in UNCOMPARED]
        if isinstance(body := getattr(node, "body", None), list):
            constant = ast.Expr, ast.Constant
            body[:] = [n for n in body if (type(n), type(getattr(n, "value", 0))) != constant]
    used, assigned = set[str](), set[str]()
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Load()):
                used.add(name)
            case ast.Name(id=name) | ast.arg(arg=name):
                assigned.add(name)
            case ast.Global(names=several) | ast.Nonlocal(names=several):
                assigned.update(several)
            case ast.Attribute(attr=attribute, value=base) if attribute in MUTATORS:
                assigned.add(ast.unparse(base))
            case ast.Subscript(value=base, ctx=ast.Store()):
                assigned.add(ast.unparse(base))
            case ast.Attribute(value=ast.Name(), ctx=ctx):
                (used if isinstance(ctx, ast.Load) else assigned).add(ast.unparse(node))
    return ast.unparse(tree), sorted(name for name in used - assigned if name[:2] != "__")
