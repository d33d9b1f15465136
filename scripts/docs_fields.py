"""What griffe asks while it reads the library: a comment beside a field says what the field is."""

from __future__ import annotations

import ast
import re
from typing import Any

import griffe


class Comments(griffe.Extension):
    """``reward: Tensor  # (P, T, B)`` reads in the reference as if the text stood under it."""

    def on_attribute_instance(self, *, node: Any, attr: griffe.Attribute, **_: Any) -> None:
        """Give the attribute its docstring, if it has none."""
        if attr.docstring is not None or not isinstance(node, ast.AnnAssign):
            return
        line = attr.lines_collection[attr.filepath][node.end_lineno - 1]
        if found := re.search(r"  # (.+)$", line):
            text = found[1][0].upper() + found[1][1:] + "."
            attr.docstring = griffe.Docstring(text, lineno=node.lineno, parent=attr)
