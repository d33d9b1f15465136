"""Each error has a kind: no place raises the base class. ``test_mistakes.py`` says which."""

from __future__ import annotations

import ast
import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest

import skillweave as sw
from skillweave.errors import (
    KINDS,
    EnvError,
    Interrupted,
    MissingExtra,
    kind_of,
    make_error,
    reworded,
)
from skillweave.workers.host import error_to_send

ROOT = Path(__file__).parents[1] / "skillweave"


# No place raises the base class


def plain_errors(source: str) -> Iterator[str]:
    """Yield each line that makes or raises the base class of all errors."""
    for node in ast.walk(ast.parse(source)):
        made = node.func if isinstance(node, ast.Call) else None
        made = node.exc if isinstance(node, ast.Raise) else made
        if made is not None and ast.unparse(made).split(".")[-1] == "SkillweaveError":
            yield f"line {node.lineno}: {ast.unparse(node)[:80]}"
        if isinstance(node, ast.ClassDef) and "SkillweaveError" in map(ast.unparse, node.bases):
            yield f"line {node.lineno}: class {node.name}"


def test_no_place_raises_an_error_without_a_kind():
    source = "raise SkillweaveError('x')\nx = sw.SkillweaveError('y')\nraise SkillweaveError\n"
    assert len(set(plain_errors(source))) == 3
    assert list(plain_errors("class A(SkillweaveError): ...")) == ["line 1: class A"]
    allowed = "try:\n    f()\nexcept SkillweaveError:\n    raise RunError('x') from None\n"
    assert list(plain_errors(allowed)) == []
    found = {
        str(path.relative_to(ROOT)): lines
        for path in ROOT.rglob("*.py")
        if path.name not in ("errors.py", "acting_errors.py")
        and (lines := list(plain_errors(path.read_text())))
    }
    assert found == {}


# The tree


def test_the_kinds_are_one_level_below_their_base():
    assert all(issubclass(kind, sw.SkillweaveError) for kind in KINDS.values())
    assert issubclass(MissingExtra, ImportError)
    assert issubclass(Interrupted, KeyboardInterrupt)
    assert not issubclass(Interrupted, Exception)


@pytest.mark.parametrize("name", KINDS)
def test_an_error_of_each_kind_can_be_made_reworded_and_pickled(name):
    error = make_error(name, "first")
    again = reworded(error, "second")
    sent = pickle.loads(pickle.dumps(again))
    assert (type(error), type(again), type(sent)) == (KINDS[name],) * 3
    assert (str(error), str(again), str(sent)) == ("first", "second", "second")


def test_an_error_of_a_users_subclass_is_of_the_kind_that_it_stands_on():
    class Mine(EnvError):
        """A kind of the user's own."""

    assert kind_of(Mine("x")) == "EnvError"
    assert error_to_send(Mine("x")) == ("EnvError", "x")
    assert error_to_send(MissingExtra("a film", "video"))[0] == "MissingExtra"
    assert error_to_send(MemoryError("x"))[0] == "TrainingError"
    assert error_to_send(ValueError("x"))[0] == "EnvError"
