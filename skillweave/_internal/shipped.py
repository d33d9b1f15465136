"""The recipes that are shipped in ``recipes/``: their names, files and weights; none is imported.

This module stands alone so that ``api`` can find a recipe, and recipes can import ``api``.
"""

from __future__ import annotations

from pathlib import Path

from skillweave.errors import DeclarationError

FOLDER = Path(__file__).parents[1] / "recipes"
"""The folder of the shipped recipes."""


def names() -> list[str]:
    """Return the names of the shipped recipes."""
    return sorted(p.stem.replace("_", "-") for p in FOLDER.glob("[a-z]*.py"))


def source(name: str) -> Path:
    """Return the file of a shipped recipe."""
    return FOLDER / f"{name.replace('-', '_')}.py"


def file_of(recipe: str) -> Path:
    """Return the file of a recipe: of a shipped one its source, else ``recipe`` itself."""
    return source(recipe) if recipe in names() else Path(recipe)


def weights_path(name: str) -> Path:
    """Return the shipped weights of a shipped recipe.

    Raises:
        DeclarationError: none are shipped for it.
    """
    path = source(name).with_suffix(".safetensors")
    if not path.exists():
        with_weights = [n for n in names() if source(n).with_suffix(".safetensors").exists()]
        raise DeclarationError(
            f"no weights are shipped for {name!r}; there are for: "
            f"{', '.join(with_weights) or 'none'}"
        )
    return path
