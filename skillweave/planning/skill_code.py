"""The code of a skill that decides how its calls start and end, in a form that can be compared.

Stands alone because it reads Python's source, and a log only compares the result.
"""

from __future__ import annotations

import ast
import functools
import inspect
import textwrap
from collections.abc import Callable
from typing import Any

from skillweave.skills import Reflex, Skill
from skillweave.types import Policy

WITHOUT = frozenset(
    ("reward", "steps", "algorithm", "task_weight", "target_return", "target_success", "color")
)
"""Members of a skill's class that do not change its calls."""


def code_of(skill: Skill, policy: Policy, reflexes: tuple[Reflex, ...]) -> list[str | None]:
    """Return the code of a skill's classes, of a policy that is a function, and of reflexes.

    Comments, docstrings and what only counts in training are left out. None: Python has no source
    of a part, as of a class that a program has made. What these functions call elsewhere is not
    included.
    """
    above = type(skill).__mro__
    classes = above[: above.index(Skill)]
    functions = [getattr(policy, "function", None)]
    functions += [f for reflex in reflexes for f in (reflex.condition, reflex.action)]
    return [_written(part) for part in (*classes, *filter(callable, functions))]


@functools.lru_cache(maxsize=256)
def _written(part: type | Callable[..., Any]) -> str | None:
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(part)))
    except (OSError, TypeError, SyntaxError, ValueError):
        return None
    return ast.dump(_Plain().visit(tree))


class _Plain(ast.NodeTransformer):
    """Leaves out docstrings, and members of a class that do not change calls."""

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        node.body = [one for one in node.body if not WITHOUT & set(_names(one))]
        return self._without_docstring(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        return self._without_docstring(node)

    def _without_docstring(self, node: Any) -> ast.AST:
        if ast.get_docstring(node) is not None:
            node.body = node.body[1:]
        self.generic_visit(node)
        return node  # type: ignore[no-any-return]


def _names(node: ast.stmt) -> list[str]:
    """Return the names that a statement of a class's body defines."""
    match node:
        case ast.FunctionDef(name=name):
            return [name]
        case ast.Assign(targets=targets):
            return [target.id for target in targets if isinstance(target, ast.Name)]
        case ast.AnnAssign(target=ast.Name(id=name)):
            return [name]
    return []
