"""Recipes: Python files that declare a hierarchy and its budgets. Some are shipped here."""

from __future__ import annotations

import difflib
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

    A file's hierarchy is its variable ``hierarchy``, or its only ``Hierarchy``. The file may import
    others that lie beside it.

    Raises:
        SkillweaveError: no such recipe (with close matches) or file, no hierarchy in it, the file
            trains as soon as it is read, or it raises an error.
    """
    from skillweave.api import Hierarchy
    from skillweave.api.recipe_file import read_recipe_file

    path = file_of(recipe)
    if path.suffix == ".py" and path.is_file():
        module = read_recipe_file(path, recipe, shipped=path.parent == _HERE)
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
