"""Recipes: Python files that declare a hierarchy and its budgets. Some are shipped here.

Those bring the environments that they train in: rooms, an arm, mazes. Recipes stand above ``api``,
which finds shipped ones by ``shipped`` and imports none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from skillweave._internal.shipped import file_of, names, source, weights_path

if TYPE_CHECKING:
    from skillweave import Hierarchy


def load(recipe: str) -> Hierarchy:
    """Return the hierarchy of a shipped recipe, or of a Python file that defines one.

    A file's hierarchy is its variable ``hierarchy``, or its only ``Hierarchy``. The file may import
    others that lie beside it.

    Raises:
        DeclarationError: no such recipe (with a similar one) or file, no hierarchy in it, the file
            trains as soon as it is read, or it raises an error.
    """
    from skillweave import Hierarchy
    from skillweave.api.recipe_file import hierarchy_in

    return hierarchy_in(recipe, Hierarchy)


__all__ = ["file_of", "load", "names", "source", "weights_path"]
