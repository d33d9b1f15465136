"""``skillweave handover`` and ``inputs``: the ready policies that a Python file defines."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from skillweave._internal.messages import shown_path
from skillweave.api.recipe_file import read_recipe_file
from skillweave.cli.output import Result
from skillweave.errors import DeclarationError
from skillweave.robots.commands import HandoverCommand, InputsCommand
from skillweave.robots.inputs import inputs
from skillweave.robots.measured import check_suffix
from skillweave.robots.measuring import handovers

NAMES = tuple(name for name in inspect.signature(handovers).parameters if name != "quiet")
"""The variables of the file that count."""
NEEDED = ("env", "skills", "steps")


def handover(command: HandoverCommand) -> Result:
    """Carry out ``skillweave handover``: play the skills that a file defines."""
    if command.out is not None:
        check_suffix(command.out)  # before anything is played
    defined = _defined(command.file)
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
        text += f"\n\nwritten: {shown_path(found.save(command.out))}"
    return {"file": command.file, **found.to_json()}, text


def show_inputs(command: InputsCommand) -> Result:
    """Carry out ``skillweave inputs``: look at what the policies of a file are shown."""
    defined = _defined(command.file)
    policies = defined.get("skills", {})
    if "policy" in defined:
        policies = {"policy": defined["policy"]}
    if "env" not in defined or not isinstance(policies, Mapping) or not policies:
        raise DeclarationError(
            f"{command.file} must define env, and policy or skills, policies by their names"
        )
    how = {"steps": command.steps, "episodes": command.episodes, "seed": command.seed}
    vary = defined.get("vary")
    sheets = {
        name: inputs(policy, defined["env"], vary=vary, **how) for name, policy in policies.items()
    }
    text = "\n\n".join(f"{name}\n\n{sheet}" for name, sheet in sheets.items())
    found = {name: sheet.to_json() for name, sheet in sheets.items()}
    return {"file": command.file, "policies": found}, text


def _defined(file: str) -> dict[str, Any]:
    """Return the variables of a Python file, which is run."""
    path = Path(file)
    if path.suffix != ".py" or not path.is_file():
        raise DeclarationError(
            f"{file} is no Python file that is there: give one that defines env and skills"
        )
    return vars(read_recipe_file(path, file))
