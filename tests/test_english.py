"""Plain English in code and pages: docstrings state what a thing does; some words stay out."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = sorted((ROOT / "skillweave").rglob("*.py"))
PAGES = [
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "skillweave").rglob("*.html")),
    *sorted((ROOT / "skillweave/reporting").rglob("*.js")),
]
QUESTION = re.compile(r"(What|Who|Whose|Whom|Whether|Where|Which|How)\b")
"""A docstring that begins so describes a question, not what a function does or a class is."""
OUT = re.compile(r"\b(told|anew|whoever|by lot)\b")
"""Words that have a plainer one: reported, again, the one that, at random."""


def docstrings(source: str) -> Iterator[str]:
    """Yield the docstrings of a module, its classes and its functions."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_the_search_finds_what_must_stay_out() -> None:
    source = '"""Names."""\ndef f():\n    """Whether it holds."""\n'
    assert [bool(QUESTION.match(text)) for text in docstrings(source)] == [False, True]
    assert OUT.findall("it was told anew, by lot") == ["told", "anew", "by lot"]
    assert not OUT.findall("untold renewal")


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_docstrings_begin_with_a_verb_or_a_noun(path: Path) -> None:
    assert [
        text.splitlines()[0] for text in docstrings(path.read_text()) if QUESTION.match(text)
    ] == []


@pytest.mark.parametrize("path", [*MODULES, *PAGES], ids=name_of)
def test_words_that_have_a_plainer_one_stay_out(path: Path) -> None:
    lines = path.read_text().splitlines()
    assert [f"{i}: {line}" for i, line in enumerate(lines, 1) if OUT.search(line)] == []
