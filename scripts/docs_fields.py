"""Extensions of griffe: comments beside fields, plain annotations, and options of functions."""

from __future__ import annotations

import ast
import copy
import re
from collections.abc import Iterator
from dataclasses import fields
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


class _Dataclass(griffe.ExprName):
    """The decorator of dataclasses, wherever it stands."""

    canonical_path = "dataclasses.dataclass"


class Settings(griffe.Extension):
    """``@settings`` makes a dataclass."""

    def on_class_instance(self, *, cls: griffe.Class, **_: Any) -> None:
        """Give the class the decorator that griffe knows."""
        if any(one.callable_path == "skillweave.schema.settings" for one in cls.decorators):
            cls.labels.add("dataclass")
            cls.decorators.append(griffe.Decorator(_Dataclass("dataclass"), lineno=0, endlineno=0))


class PlainTypes(griffe.Extension):
    """``gamma: Fraction`` reads in the reference as ``gamma: float``: a type without its checks."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Replace every annotated type in the annotations of classes' fields."""
        named = {
            attribute.canonical_path: attribute.value.slice
            for module in _modules(pkg)
            for attribute in module.attributes.values()
            if _is_annotated(attribute.value)
        }
        for module in _modules(pkg):
            for kind in module.classes.values():
                for attribute in kind.attributes.values() if not kind.is_alias else ():
                    if attribute.annotation is not None:
                        attribute.annotation = plain(attribute.annotation, named)


class InheritedTexts(griffe.Extension):
    """A field that a class declares again, without a text, has that of the class above."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Give fields without a docstring those of their bases."""
        for module in _modules(pkg):
            for kind in (k for k in module.classes.values() if not k.is_alias):
                for field in kind.attributes.values():
                    if field.docstring is None:
                        above = (b.members.get(field.name) for b in kind.mro())
                        field.docstring = next((a.docstring for a in above if a is not None), None)


def plain(part: Any, named: dict[str, Any]) -> Any:
    """Return an annotation with plain types in place of annotated ones, which may have a name."""
    if isinstance(part, list | tuple):
        return type(part)(plain(one, named) for one in part)
    if isinstance(part, griffe.ExprName) and part.canonical_path in named:
        return plain(named[part.canonical_path].elements[0], named)
    if _is_annotated(part):
        return plain(part.slice.elements[0], named)
    if not isinstance(part, griffe.Expr) or isinstance(part, griffe.ExprName):
        return part
    changed = copy.copy(part)
    for field in fields(part):
        setattr(changed, field.name, plain(getattr(part, field.name), named))
    return changed


def _is_annotated(part: Any) -> bool:
    left = getattr(part, "left", None)
    return isinstance(part, griffe.ExprSubscript) and getattr(left, "name", "") == "Annotated"


def _modules(module: griffe.Module) -> Iterator[griffe.Module]:
    yield module
    for inner in module.modules.values():
        if not inner.is_alias:
            yield from _modules(inner)
