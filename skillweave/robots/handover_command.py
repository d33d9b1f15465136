"""``skillweave handover``: which of the policies in a Python file can follow which."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from skillweave._internal.messages import shown_path
from skillweave.api.recipe_file import read_recipe_file
from skillweave.cli.output import Result
from skillweave.errors import DeclarationError
from skillweave.robots.commands import HandoverCommand
from skillweave.robots.measuring import handovers

NAMES = tuple(name for name in inspect.signature(handovers).parameters if name != "quiet")
"""The variables of the file that count."""
NEEDED = ("env", "skills", "steps")


def handover(command: HandoverCommand) -> Result:
    """Carry out ``skillweave handover``: play the skills that a file defines."""
    path = Path(command.file)
    if path.suffix != ".py" or not path.is_file():
        raise DeclarationError(
            f"{command.file} is no Python file that is there: give one that defines "
            f"{', '.join(NEEDED)}, and stays or done"
        )
    defined = vars(read_recipe_file(path, command.file))
    given: dict[str, Any] = {name: defined[name] for name in NAMES if name in defined}
    if missing := [name for name in NEEDED if name not in given]:
        raise DeclarationError(
            f"{command.file} defines no variable {missing[0]!r}; it must define "
            f"{', '.join(NEEDED)}, and may define {', '.join(n for n in NAMES if n not in NEEDED)}"
        )
    for name in ("calls", "seed"):
        if (value := getattr(command, name)) is not None:
            given[name] = value
    env, skills = given.pop("env"), given.pop("skills")
    found = handovers(env, skills, **given, quiet=command.quiet)
    text = str(found)
    if command.out is not None:
        text += f"\n\nall entries: {shown_path(found.save(command.out))}"
    return {"file": command.file, **found.to_json()}, text
