"""Recipes: Python files that declare a hierarchy and its budgets. Some are shipped here."""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from skillweave import SkillweaveError

if TYPE_CHECKING:
    from skillweave.api import Hierarchy

_HERE = Path(__file__).parent


def names() -> list[str]:
    """The shipped recipes."""
    return sorted(p.stem.replace("_", "-") for p in _HERE.glob("[a-z]*.py"))


def source(name: str) -> Path:
    """The file of a shipped recipe."""
    return _HERE / f"{name.replace('-', '_')}.py"


def file_of(recipe: str) -> Path:
    """The file of a recipe: of a shipped one its source, else ``recipe`` itself."""
    return source(recipe) if recipe in names() else Path(recipe)


def load(recipe: str) -> Hierarchy:
    """The hierarchy of a shipped recipe, or of a Python file that defines one.

    A file's hierarchy is its variable ``hierarchy``, or its only ``Hierarchy``.

    Raises:
        SkillweaveError: no such recipe (with close matches) or file, no hierarchy in it, or the
            file trains as soon as it is read.
    """
    from skillweave.api import Hierarchy
    from skillweave.api.running import READING

    path = file_of(recipe)
    if path.suffix == ".py" and path.is_file():
        spec = importlib.util.spec_from_file_location(f"skillweave_recipe_{path.stem}", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        outer = READING.set(recipe)
        try:
            spec.loader.exec_module(module)
        finally:
            READING.reset(outer)
    else:
        near = difflib.get_close_matches(recipe, names(), n=3, cutoff=0.4)
        hint = f" Did you mean {' or '.join(near)}?" if near else ""
        raise SkillweaveError(
            f"no recipe or Python file {recipe!r}.{hint} Shipped recipes: {', '.join(names())}"
        )
    found = {k: v for k, v in vars(module).items() if isinstance(v, Hierarchy)}
    if "hierarchy" not in found and len(found) != 1:
        raise SkillweaveError(
            f"{recipe} defines {len(found) or 'no'} Hierarchy; define one, as the variable "
            "'hierarchy'"
        )
    hierarchy = found.get("hierarchy") or next(iter(found.values()))
    hierarchy.recipe = recipe
    return hierarchy


def weights_path(name: str) -> Path:
    """The shipped weights of a shipped recipe.

    Raises:
        SkillweaveError: there are none.
    """
    path = source(name).with_suffix(".safetensors")
    if not path.exists():
        with_weights = [n for n in names() if source(n).with_suffix(".safetensors").exists()]
        raise SkillweaveError(
            f"no weights are shipped for {name!r}; there are for: "
            f"{', '.join(with_weights) or 'none'}"
        )
    return path
