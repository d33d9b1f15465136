"""Every public name says what it is, what it takes, of which shape, what it returns and raises."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
from collections.abc import Iterator
from enum import IntEnum
from importlib import import_module
from typing import Any

import pytest
from installed import HOMES
from pages import BLOCK, train_briefly

from skillweave import SkillweaveError
from skillweave.cli.commands import all_commands
from skillweave.errors import KINDS
from skillweave.types import Array, Policy

ALIASES = ("Array",)
"""Names of what is another library's: the reference explains them."""
BRIEF = ("skillweave.calls", "skillweave.planning")
"""Modules whose classes also have methods that only the library calls, described briefly."""
THINGS = {
    n: getattr(import_module(m), n) for m, homes in HOMES.items() if m not in BRIEF for n in homes
}
"""Every public name's object."""
ARRAY = re.compile(r"\b(Array|Tensor|Views|Float|Int|Bool)\b")


def public_functions(name: str) -> Iterator[tuple[str, Any]]:
    """The function of this name; or the constructor and public methods of the class."""
    thing = THINGS[name]
    if inspect.ismodule(thing):
        for part in vars(thing).values():
            if inspect.isclass(part) and part.__module__ == thing.__name__:
                yield f"{name}.{part.__name__}", part
    elif inspect.isclass(thing):
        yield name, thing
        for key, value in inspect.getmembers_static(thing):
            ours = any(
                key in vars(c) and c.__module__.startswith("skillweave") for c in thing.__mro__
            )
            plain = value.__func__ if isinstance(value, classmethod | staticmethod) else value
            if not key.startswith("_") and ours and inspect.isfunction(plain):
                yield f"{name}.{key}", plain
    else:
        yield name, thing


def arguments_of(thing: Any) -> dict[str, str]:
    """Its arguments with their annotations."""
    told_elsewhere = Exception, IntEnum  # of dataclasses the fields are looked at below
    if inspect.isclass(thing) and (
        dataclasses.is_dataclass(thing) or issubclass(thing, told_elsewhere)
    ):
        return {}
    if getattr(thing, "_is_protocol", False):
        return {}
    function = thing.__init__ if inspect.isclass(thing) else thing
    if function is object.__init__:
        return {}
    found = list(inspect.signature(function).parameters.values())
    return {p.name: str(p.annotation) for p in found if p.name not in ("self", "cls")}


def text_of(thing: Any) -> str:
    """Its docstring; of a method of ``Policy`` also what is said there."""
    text, name = inspect.getdoc(thing) or "", getattr(thing, "__name__", "")
    policy = vars(Policy).get(name) if inspect.isfunction(thing) else None
    same = policy is not None and list(arguments_of(thing)) == list(arguments_of(policy))
    return f"{text}\n\n{inspect.getdoc(policy)}" if same else text


def section(text: str, title: str) -> str:
    """The indented lines under ``Args:``, ``Returns:`` or ``Raises:``."""
    found = re.search(rf"^{title}:\n((?:    .*\n?|\n)+)", text, flags=re.M)
    return found[1] if found else ""


def example_of(name: str) -> str:
    """The Python in a public name's docstring."""
    return "\n".join(BLOCK.findall(inspect.getdoc(THINGS[name]) or ""))


def raises(thing: Any) -> bool:
    """Whether it raises an error for people itself."""
    function = thing
    if inspect.isclass(thing):  # a dataclass checks itself in __post_init__
        kind = "__post_init__" if dataclasses.is_dataclass(thing) else "__init__"
        function = vars(thing).get(kind)
    if function is None:
        return False
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    raised = [ast.dump(n) for n in ast.walk(tree) if isinstance(n, ast.Raise)]
    return any(f"'{kind}'" in text for text in raised for kind in KINDS)


def missing(thing: Any) -> list[str]:
    """What a docstring does not say."""
    text = text_of(thing)
    lacks: list[str] = []
    first = text.split("\n\n")[0].strip()
    if not first.endswith((".", ":")) or len(first.split()) < 3:
        lacks.append("a sentence")
    listed = section(text, "Args") + section(text, "Attributes")
    for name in arguments_of(thing):
        entry = re.search(rf"^    \*{{0,2}}{name}: ((?:.|\n(?!    \S))+)", listed, flags=re.M)
        said = entry[1] if entry else ""
        if not said and f"``{name}``" not in text:
            lacks.append(f"argument {name}")
    if not inspect.isclass(thing):
        kind = str(inspect.signature(thing).return_annotation)
        if ARRAY.search(kind) and not re.search(r"\((\*?[A-Zkn]|\.\.\.|…)[,)]", text):
            lacks.append(f"the shape of {kind}")
    if raises(thing) and not re.search(r"Raises:|Raise an? \w+Error", text):
        lacks.append("its errors")
    return lacks


NAMES = [name for name in THINGS if name not in ALIASES]


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_says_all_that_a_user_needs(name):
    found = {where: lacks for where, thing in public_functions(name) if (lacks := missing(thing))}
    assert found == {}


DATACLASSES = [kind for n in NAMES if dataclasses.is_dataclass(kind := THINGS[n])]


@pytest.mark.parametrize(
    "kind",
    [*DATACLASSES, *(kind for kind, _ in all_commands().values())],
    ids=lambda kind: kind.__name__,
)
def test_every_field_of_a_public_dataclass_is_explained(kind):
    """By the text under it, by the comment beside it, or by the class; ``--help`` shows it, too."""
    said = set[str]()
    for base in kind.__mro__:
        if not base.__module__.startswith("skillweave"):
            continue
        source = textwrap.dedent(inspect.getsource(base))
        (tree,) = ast.parse(source).body
        assert isinstance(tree, ast.ClassDef)
        lines, text = source.splitlines(), inspect.getdoc(base) or ""
        for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                below = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                beside = "  # " in lines[(node.end_lineno or 1) - 1]
                name = node.target.id
                above = re.search(rf"^    {name}: |``{name}``", text, flags=re.M)
                if below or beside or above:
                    said.add(name)
    assert {f.name for f in dataclasses.fields(kind) if f.init or f.name[0] != "_"} - said == set()


EXAMPLES = {name: text for name in NAMES if (text := example_of(name))}


def test_some_public_names_have_an_example():
    assert {"Hierarchy", "Player", "Automaton", "tree", "gae"} <= set(EXAMPLES)


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_an_example_in_a_docstring_runs(name, tmp_path, monkeypatch):
    train_briefly(monkeypatch)
    monkeypatch.chdir(tmp_path)
    exec(compile(EXAMPLES[name], f"example of {name}", "exec", dont_inherit=True), {})


def test_what_is_missing_is_found():
    def bad(size: int, obs: Array) -> Array:
        """Makes."""
        if size < 0:
            raise SkillweaveError("size")
        return obs

    shape = f"the shape of {inspect.signature(bad).return_annotation}"
    lacking = ["a sentence", "argument size", "argument obs", shape, "its errors"]
    assert missing(bad) == lacking
